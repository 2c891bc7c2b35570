"""Stop and pause, wherever an arm may move: judged by the goals that reached the simulated motors, and when."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from cqn_train.arm import attendant
from cqn_train.interfaces import Interrupted
from cqn_train.loop.evaluate import evaluate
from cqn_train.loop.gym_env import OneScene
from cqn_train.operator.session import Event, RefusedError, State
from cqn_train.run.stop import StopRequest

from .arm_bench import FPS, HOME_DEG, Bench, bench

pytest.importorskip("mujoco")
BOUND_S = 0.23  # after it was asked for, nothing moves


class Waving:
    """A policy that is always on the move, as far as `evaluate` needs one."""

    def __init__(self) -> None:
        self.steps = 0

    def reset(self) -> None: ...

    def prepare(self, frame: Any) -> Any:
        return frame

    def low_dim(self, _: Any) -> None: ...

    def act(self, _: Any, *, explore: bool) -> tuple[Any, Any]:
        assert not explore
        self.steps += 1
        goal = HOME_DEG.copy()
        goal[:2] += 14 * np.sin(self.steps / 8), 10 * np.sin(self.steps / 5)
        return torch.tensor(goal, dtype=torch.float32)[None], np.zeros(1)

    def postprocessor(self, action: Any) -> Any:
        return action

    def retake(self, *, first: bool) -> None: ...


def running(arm: Bench) -> None:
    """An episode that goes on until somebody stops it."""
    arm.begin()
    for step in range(2000):
        arm.step(14 * np.sin(step / 8), 10 * np.sin(step / 5))


def teaching(arm: Bench) -> None:
    arm.begin()
    arm.do(Event.TAKE_OVER)
    arm.leader.pose = lambda: HOME_DEG + np.append(14 * np.sin(len(arm.goals) / 8), np.zeros(6))
    for _ in range(2000):
        arm.step()


def evaluating(arm: Bench) -> None:
    arm.session.expect(None)
    arm.meanwhile(lambda: (arm.soon(lambda: not arm.session.busy), arm.do(Event.START)))
    evaluate(Waving(), OneScene(arm.env), 3)  # type: ignore[arg-type]


def homing(arm: Bench) -> None:
    """The arm is far away and sets off, while the loop is at something that does not ask."""
    arm.begin()
    for _ in range(12):
        arm.step(18, -18)
    arm.do(Event.SUCCESS)
    arm.step()
    arm.clock.sleep(2.0)


def recovering(arm: Bench) -> None:
    """The robot is gone now and then, and is taken up again and again."""
    read, count = arm.robot.get_observation, iter(range(10**6))

    def now_and_then() -> dict[str, Any]:
        if next(count) % 20 == 19:
            raise ConnectionError("gone for a moment")
        return read()

    def person() -> None:
        while arm.session.state is not State.STOPPED:
            arm.clock.sleep(0.01)
            for event in (Event.FAILURE,) if arm.session.state is State.LABELLING else (Event.READY, Event.START):
                with contextlib.suppress(RefusedError):
                    arm.do(event)

    arm.robot.get_observation = now_and_then  # type: ignore[method-assign]
    arm.meanwhile(person)
    arm.session.expect(0)
    arm.env.reset(0)
    for step in range(2000):
        if arm.step(14 * np.sin(step / 8)).ended:
            arm.env.reset(0)


DOING: dict[str, Callable[[Bench], None]] = {
    "running": running, "teaching": teaching, "evaluating": evaluating, "homing": homing, "recovering": recovering,
}  # fmt: skip


@pytest.fixture(autouse=True)
def _soon_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attendant, "RETRY_S", 0.05)


@pytest.mark.parametrize("by", ["signal", "page"])
@pytest.mark.parametrize("doing", DOING)
@pytest.mark.parametrize("moment", [0.45, 0.5, 0.777])
def test_nothing_moves_after_a_stop(doing: str, by: str, moment: float) -> None:
    asked: list[float] = []
    with bench(should_stop=lambda: by == "signal" and bool(asked), home_speed=0.1) as arm:
        times: list[float] = []
        send = arm.robot.send_action

        def noted(action: dict[str, Any]) -> dict[str, Any]:
            times.append(arm.clock.now)
            return send(action)

        arm.robot.send_action = noted  # type: ignore[method-assign]
        first = len(arm.goals)

        def stop() -> None:
            arm.clock.sleep(moment)
            asked.append(arm.clock.now)
            if by == "page":
                arm.do(Event.STOP)

        arm.meanwhile(stop)
        with contextlib.suppress(Interrupted):
            DOING[doing](arm)
        assert asked, "it came to an end by itself"
        arm.clock.sleep(2.0)
        late = [arm.goals[first + i] for i, at in enumerate(times) if at > asked[0] + BOUND_S]
        just_before = [arm.goals[first + i] for i, at in enumerate(times) if asked[0] - 0.4 < at <= asked[0]]
        assert len({tuple(goal) for goal in just_before}) > 1, "it did not move"
        assert len({tuple(goal) for goal in [*late, arm.goals[-1]]}) == 1, "a goal after the stop that is no hold"
        assert arm.session.state is State.STOPPED
        assert arm.at_rest()
        arm.check()


@pytest.mark.parametrize("event", [Event.PAUSE, Event.STOP])
def test_an_arm_on_its_way_home_is_held_at_once(event: Event) -> None:
    with bench(home_speed=0.1) as arm:
        arm.begin()
        for _ in range(12):
            arm.step(18, -18)
        arm.do(Event.SUCCESS)
        arm.step()
        arm.soon(lambda: arm.session.homing)
        arm.clock.sleep(0.1)
        arm.do(event)
        arm.clock.sleep(1 / FPS + 0.01)
        sent = len(arm.goals)
        arm.soon(arm.at_rest)
        assert len({tuple(goal) for goal in arm.goals[sent - 1 :]}) == 1
        assert np.abs(arm.joints - HOME_DEG[:6]).max() > 3
        assert not arm.session.homing
        if event is Event.PAUSE:  # and goes on when it is asked to
            with pytest.raises(RefusedError, match="nothing moves"):
                arm.do(Event.PAUSE)
            arm.do(Event.HOME)
            arm.soon(lambda: np.abs(arm.joints - HOME_DEG[:6]).max() < 0.5, 60)
        arm.check()


# -- signals -----------------------------------------------------------------------------------------------------------

WATCHED = """
import hashlib, sys, threading, time
from cqn_train.run.stop import StopRequest

def watch(stop):
    print("ready", flush=True)
    while not stop():
        time.sleep(0.002)
    with open(sys.argv[1], "w") as file:
        file.write(str(time.monotonic()))

with StopRequest() as stop:
    watcher = threading.Thread(target=watch, args=(stop,))
    watcher.start()
    for _ in range(3):  # lets other threads run, but no handler of a signal
        hashlib.pbkdf2_hmac("sha256", b"", b"", int(sys.argv[2]))
    print("a line for a terminal that may be gone", flush=True)
    print("another one", file=sys.stderr, flush=True)
    watcher.join()
sys.exit(7)
"""


@pytest.mark.real_time(reason="another process is sent signals")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_is_seen_at_once_whatever_the_main_thread_is_at(number: signal.Signals, tmp_path: Path) -> None:
    seen = tmp_path / "seen"
    process = subprocess.Popen([sys.executable, "-c", WATCHED, str(seen), "1000000"], stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"ready\n"
    time.sleep(0.05)
    sent = time.monotonic()
    process.send_signal(number)
    assert process.wait(60) == 7
    assert float(seen.read_text()) - sent < BOUND_S


@pytest.mark.real_time(reason="a terminal of another process is closed")
def test_a_closed_terminal_is_a_stop_and_what_is_printed_then_no_error(tmp_path: Path) -> None:
    ours, theirs = os.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", f"import fcntl, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0)\n{WATCHED}",
         str(tmp_path / "seen"), "300000"],
        stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True,
    )  # fmt: skip
    os.close(theirs)
    said = b""
    while not said.endswith(b"\n"):  # closed in the middle of the line, its writer would fail
        said += os.read(ours, 100)
    os.close(ours)
    assert process.wait(60) == 7
    assert (tmp_path / "seen").exists()


def test_twice_is_at_once_but_a_terminal_closes_several_times() -> None:
    with StopRequest() as stop:
        assert not stop()
        for _ in range(3):
            os.kill(os.getpid(), signal.SIGHUP)
        assert stop()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopRequest() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            time.sleep(0.01)
            assert not stop()
    finally:
        signal.signal(signal.SIGHUP, before)
