"""The session steered by single keys in a terminal, where no browser is at hand; works over SSH, too."""

import contextlib
import os
import sys
import threading
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Self, TextIO

from ..clock import REAL, Clock
from .session import Event, RefusedError, Session, State

__all__ = ["KEYS", "TerminalKeys"]

KEYS: Mapping[str, tuple[Event, ...]] = {
    " ": (Event.START, Event.PAUSE, Event.RESUME), "s": (Event.SUCCESS,), "f": (Event.FAILURE,),
    "d": (Event.DISCARD,), "t": (Event.TAKE_OVER, Event.HAND_BACK), "h": (Event.HOME,), "m": (Event.FREE,),
    "r": (Event.READY,), "\x1b": (Event.STOP,),
}  # fmt: skip
_KEY_NAMES = {" ": "space", "\x1b": "Esc"}
_WORDS = {Event.FREE: "move by hand or hold"}
_MOVES = frozenset({Event.START, Event.RESUME, Event.HAND_BACK, Event.HOME, Event.FREE})
_SEQUENCE_S = 0.1  # an arrow key begins like Escape, and the rest follows at once
_HELD_S = 0.7  # a key that comes again sooner may be one that is held down


class TerminalKeys:
    """Reads keys while entered, and prints a line at each change of the session.

    stream: where keys come from, standard input unless told; without a terminal there it does nothing and says so.
    out: where lines go, standard error unless told. The terminal is as before on leaving, however that comes about;
    Ctrl-C stays what it is.
    """

    def __init__(
        self,
        session: Session,
        stream: TextIO | None = None,
        out: TextIO | None = None,
        poll_s: float = 0.1,
        clock: Clock = REAL,
    ) -> None:
        self._session, self._poll_s, self._clock = session, poll_s, clock
        self._stream = stream if stream is not None else sys.stdin
        self._out = out if out is not None else sys.stderr
        self._leave = threading.Event()
        self._thread: threading.Thread | None = None
        self._mode: list[Any] | None = None
        self._last = ("", -float("inf"))
        self._shown: tuple[Any, ...] = ()

    def __enter__(self) -> Self:
        """Begin to read keys."""
        try:
            import termios
            import tty

            self._mode = termios.tcgetattr(self._stream.fileno())
            tty.setcbreak(self._stream.fileno(), termios.TCSANOW)
        except Exception:  # no termios, no descriptor, or termios.error, which shares no base with the others
            self._mode = None
            self._say("Keys are off: standard input is no terminal. Use the page, or start the run from a terminal.")
            return self
        self._leave.clear()
        self._thread = threading.Thread(target=self._run, name="terminal-keys", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Give the terminal back as it was."""
        self._leave.set()
        if self._thread is not None:
            self._thread.join(2.0)
            self._thread = None
        if self._mode is not None:
            import termios

            with contextlib.suppress(termios.error, OSError, ValueError):  # the terminal was closed meanwhile
                termios.tcsetattr(self._stream.fileno(), termios.TCSANOW, self._mode)
            self._mode = None

    def press(self, key: str, now: float = float("inf")) -> None:
        """Apply a key; `now` in seconds tells a key that is held down from one that is pressed again."""
        key = key.lower()
        held = key == self._last[0] and now - self._last[1] < _HELD_S
        self._last = (key, now)
        events = KEYS.get(key)
        if events is None:
            return
        allowed = self._session.allowed()
        urgent = sorted(events, key=lambda event: event is not Event.PAUSE)  # an arm on its way home could start, too
        event = next((event for event in urgent if event in allowed), events[0])
        if held and event in _MOVES:  # a key that is held may stop the arm, never move it
            return
        try:
            self._session.apply(event)
        except RefusedError as error:
            self._say(str(error))

    def _run(self) -> None:
        import select

        descriptor = self._stream.fileno()
        try:
            while not self._leave.is_set():
                self._tell()
                if not select.select([descriptor], [], [], self._poll_s)[0]:
                    continue
                data = os.read(descriptor, 64)
                if not data:
                    break
                if data == b"\x1b" and select.select([descriptor], [], [], _SEQUENCE_S)[0]:
                    data += os.read(descriptor, 64)
                if len(data) > 1 and data[0] == 0x1B:
                    continue
                for key in data.decode(errors="ignore"):
                    self.press(key, self._clock.now)
            self._tell()
        except (OSError, ValueError):
            self._say("Keys are off: the terminal is gone.")

    def _tell(self) -> None:
        """A line where something has changed: the state, and what can be pressed now."""
        snapshot = self._session.snapshot()
        state, allowed, busy = snapshot["state"], snapshot["allowed"], snapshot.get("busy", "")
        seen = (state, snapshot["episode"], snapshot["fault"], tuple(allowed), bool(busy), snapshot.get("free"))
        if seen == self._shown:
            return
        self._shown = seen
        number = snapshot["episode"]
        parts = [f"{state}, episode {number}" if number >= 0 else state]
        parts += [snapshot["fault"]] if snapshot["fault"] and state == State.FAULTED else []
        parts += ["evaluation"] if snapshot.get("evaluating") else []
        parts += ["the arm can be moved by hand"] if snapshot.get("free") else []
        parts += [f"the learner is busy ({busy})"] if busy else []
        keys = [
            f"{_KEY_NAMES.get(key, key)} {_WORDS.get(event, event.replace('_', ' '))}"
            for key, events in KEYS.items() for event in events if event in allowed
        ]  # fmt: skip
        self._say(f"[{'; '.join(parts)}] " + ("run over" if state == State.STOPPED else ", ".join(keys)))

    def _say(self, text: str) -> None:
        with contextlib.suppress(OSError, ValueError):  # whoever read it is gone; the run goes on
            print(text, file=self._out, flush=True)
