"""The session by single keys, in a terminal of the test's own."""

import io
import os
import subprocess
import sys
import termios
import time
from collections.abc import Iterator

import pytest

from cqn_train.operator.keys import TerminalKeys
from cqn_train.operator.session import Event, Session, State

from ..driven_clock import DrivenClock


@pytest.fixture
def terminal() -> Iterator[tuple[int, io.TextIOWrapper]]:
    ours, theirs = os.openpty()
    with os.fdopen(theirs, "r", buffering=1) as stream:
        yield ours, stream
    os.close(ours)


def until(what: object, seconds: float = 60) -> None:
    deadline = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_session_by_keys(terminal: tuple[int, io.TextIOWrapper], monkeypatch: pytest.MonkeyPatch) -> None:
    ours, stream = terminal
    pressed, seen, read = b"", bytearray(), os.read
    monkeypatch.setattr(os, "read", lambda *of: (data := read(*of), seen.extend(data))[0])
    session, out, clock = Session(), io.StringIO(), DrivenClock()
    before = termios.tcgetattr(stream.fileno())
    with TerminalKeys(session, stream, out, poll_s=0.01, clock=clock):
        until(lambda: "space start" in out.getvalue())
        for key, state in [
            (b" ", State.RUNNING), (b"t", State.TEACHING), (b"T", State.RUNNING), (b" ", State.PAUSED),
            (b"\x1b[A", State.PAUSED), (b"s", State.RESETTING), (b"r", State.WAITING), (b"\x1b", State.STOPPED),
        ]:  # fmt: skip
            session._home = False
            pressed += key
            os.write(ours, key)
            until(lambda state=state, pressed=pressed: session.state is state and seen == pressed)
            clock.now += 0.75  # pressed again, and not held down
        until(lambda: "run over" in out.getvalue())
    assert termios.tcgetattr(stream.fileno()) == before
    lines = out.getvalue().splitlines()
    assert lines[0] == "[waiting] space start, h home, m move by hand or hold, Esc stop"
    assert "[paused, episode 0] space resume, s success, f failure, d discard, t take over, Esc stop" in lines


def test_a_key_without_a_place_is_told_why() -> None:
    session, out = Session(), io.StringIO()
    keys = TerminalKeys(session, io.StringIO(), out)
    keys.press("s")
    keys.press("x")
    session.learning("updates")
    keys.press(" ")
    assert session.state is State.WAITING
    first, second = out.getvalue().splitlines()
    assert "'success' has no place while waiting" in first
    assert "busy (updates)" in second


def test_a_key_that_is_held_stops_the_arm_and_never_moves_it() -> None:
    session = Session()
    keys = TerminalKeys(session, io.StringIO(), io.StringIO())
    for moment in range(41):
        keys.press(" ", 10 + 0.05 * moment)
    assert session.state is State.PAUSED
    keys.press(" ", 20)
    assert session.state is State.RUNNING
    keys.press(" ", 20.2)  # at once: somebody was frightened
    assert session.state is State.PAUSED


def test_without_a_terminal_it_says_so_and_does_nothing() -> None:
    out = io.StringIO()
    with TerminalKeys(Session(), io.StringIO("s"), out) as keys:
        assert keys._thread is None
    assert out.getvalue().splitlines() == [
        "Keys are off: standard input is no terminal. Use the page, or start the run from a terminal."
    ]


def test_the_terminal_is_given_back_after_an_exception(terminal: tuple[int, io.TextIOWrapper]) -> None:
    _, stream = terminal
    before = termios.tcgetattr(stream.fileno())

    def fail() -> None:
        with TerminalKeys(Session(), stream, io.StringIO()):
            assert termios.tcgetattr(stream.fileno()) != before
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert termios.tcgetattr(stream.fileno()) == before


def test_a_terminal_that_goes_away_ends_nothing() -> None:
    ours, theirs = os.openpty()
    session = Session()
    session.apply(Event.START)
    with os.fdopen(theirs, "r") as stream, TerminalKeys(session, stream, io.StringIO(), poll_s=0.01) as keys:
        os.close(ours)
        until(lambda: not keys._thread.is_alive())
    assert session.state is State.RUNNING


PROGRAM = """
import fcntl, termios, time
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
from cqn_train.operator.session import Session
from cqn_train.operator.keys import TerminalKeys
try:
    with TerminalKeys(Session()):
        time.sleep(60)
except KeyboardInterrupt:
    raise SystemExit(42)
"""


def test_ctrl_c_is_still_ctrl_c() -> None:
    ours, theirs = os.openpty()
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM], stdin=theirs, stderr=subprocess.PIPE, start_new_session=True
    ) as program:
        os.close(theirs)
        assert b"[waiting]" in program.stderr.readline()
        os.write(ours, b"\x03")
        assert program.wait(60) == 42
    os.close(ours)
