"""Faults on the wire of LeRobot's SO-101 at every moment of a session, judged at the goals that reach the motors."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("scservo_sdk", reason="needs the extra feetech of lerobot")

from lerobot.teleoperators.so_leader import SO101Leader, SO101LeaderConfig

from cqn_train.arm.environment import ArmEnvironment
from cqn_train.clock import REAL
from cqn_train.interfaces import Label
from cqn_train.operator.session import Event, RefusedError, Session, State
from cqn_train.robot.arm import Arm
from cqn_train.robot.guard import Guard, GuardSettings
from cqn_train.robot.limits import Limits
from cqn_train.robot.settings import ArmSettings
from cqn_train.virtual_so101.arm import assembled, at_middle
from cqn_train.virtual_so101.chain import Fault, FaultKind
from cqn_train.virtual_so101.joints import JOINTS
from cqn_train.virtual_so101.port import VirtualPort

from .arm_bench import Display
from .test_virtual_so101 import DEGREES, SPAN_DEG, STEP_DEG, Watched, calibrated, hurried

pytestmark = pytest.mark.real_time(reason="serial ports, and motors that move in the machine's own time")

FPS = 20
KINDS = [*FaultKind, "unplugged"]
MOMENTS = ["idle", "running", "teaching", "homing"]


@dataclass
class Wire:
    """A session on two arms behind their ports."""

    ports: dict[str, VirtualPort]
    env: ArmEnvironment
    session: Session
    display: Display
    watched: Watched
    here: np.ndarray
    failed: list[BaseException] = field(default_factory=list)

    def soon(self, ready: Callable[[], Any], seconds: float = 30.0) -> None:
        """Wait until something is so."""
        deadline = time.monotonic() + seconds
        while not ready():
            assert time.monotonic() < deadline, (self.session.state, self.session.fault, self.display.lines)
            time.sleep(0.02)

    def press(self, event: Event, seconds: float = 30.0) -> None:
        """As a person does: again, where it was refused."""

        def taken() -> bool:
            with contextlib.suppress(RefusedError):
                self.session.apply(event)
                return True
            return False

        self.soon(taken, seconds)

    def start(self) -> None:
        """Start an episode once the arm is well and at rest; after a fault the scene must be called ready first."""
        self.soon(lambda: self.session.state is not State.FAULTED and not self.session.busy)
        if self.session.state is State.RESETTING:
            self.press(Event.READY)
        self.press(Event.START)

    def goes_wrong(self, arm: str, kind: str) -> None:
        """Let it go wrong for a while, and end it."""
        port = self.ports[arm]
        if kind == "unplugged":
            port.unplug()
            time.sleep(0.4)
            port.plug()
            return
        for motor, left in ((2, 1), (2, 4), (None, 4)):
            port.chain.faults.append(Fault(kind=FaultKind(kind), motor=motor, left=left))
            time.sleep(0.3)
        port.chain.faults.clear()

    def episode(self, person: Callable[[], None]) -> bool:
        """Run an episode as the loop does, with a person beside it; whether it was called a success."""

        def run() -> None:
            try:
                person()
            except BaseException as error:
                self.failed.append(error)
                with contextlib.suppress(RefusedError):
                    self.session.apply(Event.STOP)

        self.session.expect(len(self.display.begun))
        beside = threading.Thread(target=run, daemon=True)
        beside.start()
        try:
            self.env.reset(0)
            for step in range(2000):
                goal = self.here + 12 * np.sin(step / 6)
                outcome = self.env.step(torch.tensor(goal, dtype=torch.float32)[None])
                if outcome.ended:
                    return bool(outcome.success)
            raise AssertionError("the episode does not end")
        finally:
            beside.join(60)
            if self.failed:
                raise self.failed[0]


@contextlib.contextmanager
def wire(folder: Path) -> Iterator[Wire]:
    with contextlib.ExitStack() as stack:
        ports, robots = {}, {}
        for seed, arm in enumerate(("follower", "leader")):
            (folder / arm).mkdir()
            ports[arm] = stack.enter_context(VirtualPort(assembled(seed), folder / f"tty-{arm}"))
            robots[arm] = calibrated(ports[arm], folder / arm)
        follower = robots["follower"]
        follower.bus.port = follower.bus.port_handler.port_name = str(ports["follower"].link)
        robots["leader"].disconnect()
        robots["leader"]._save_calibration()
        leader = SO101Leader(
            SO101LeaderConfig(port=str(ports["leader"].link), id="virtual", calibration_dir=folder / "leader")
        )
        leader.connect(calibrate=False)
        here = np.array([float(follower.get_observation()[name]) for name in follower.action_features])
        hurried(follower)
        step = np.full(6, STEP_DEG)
        limits = Limits(low=here - SPAN_DEG, high=here + SPAN_DEG, max_step=step, max_speed=FPS * step)
        settings = ArmSettings(episode_s=60.0, stale_s=2.0, watchdog_s=0.5, home_speed=0.5)
        guard = Guard(follower, limits, GuardSettings(settings.stale_s, settings.watchdog_s), REAL)
        arm = Arm(guard, settings, FPS, leader=leader, clutched=range(5), home=here)  # type: ignore[arg-type]
        session, display = Session(leader=True, can_free=guard.can_release), Display()
        env = ArmEnvironment(arm, session, display, lambda: False, REAL)
        watched = Watched(ports["follower"].chain)
        env.open()
        try:
            yield Wire(ports, env, session, display, watched, here)
        finally:
            with contextlib.suppress(RefusedError):
                session.apply(Event.STOP)
            env.close()


def lead(port: VirtualPort, done: threading.Event) -> None:
    """A hand that waves the leader."""
    begun = time.monotonic()
    while not done.is_set():
        for number, joint in enumerate(JOINTS[:3]):
            port.chain.servos[number].hand = at_middle(port.chain, joint) + 150 * np.sin(2 * (time.monotonic() - begun))
        time.sleep(0.01)


def check(kind: str, moment: str, arm: str, folder: Path) -> None:
    with wire(folder) as made:
        sent = made.watched.leaps

        def to_label(label: Event) -> None:
            made.soon(lambda: made.session.state is not State.FAULTED)
            made.press(label)

        def first() -> None:
            if moment == "idle":
                made.goes_wrong(arm, kind)
            made.start()
            made.soon(lambda: len(sent) > 30)
            waving, done = None, threading.Event()
            if moment == "teaching":
                waving = threading.Thread(target=lead, args=(made.ports["leader"], done), daemon=True)
                made.press(Event.TAKE_OVER)
                waving.start()
                time.sleep(0.3)
            if moment in ("running", "teaching"):
                made.goes_wrong(arm, kind)
            to_label(Event.FAILURE)
            done.set()

        def second() -> None:
            if moment == "homing":
                made.press(Event.HOME)
                made.soon(lambda: made.session.busy)
                made.goes_wrong(arm, kind)
            made.start()
            before = len(sent)
            made.soon(lambda: len(sent) > before + 30)
            to_label(Event.SUCCESS)

        assert made.episode(first) is False
        made.episode(second)
        assert made.session.labels[0] is Label.FAILURE  # as the person said, whatever happened
        assert made.session.labels[1] is Label.SUCCESS
        assert len(made.display.ended) == 2
        assert max(sent) <= STEP_DEG + 3 * DEGREES  # what rounding to steps of the encoder makes of a step


@pytest.mark.parametrize(("kind", "moment"), [("silent", "idle"), ("overflow", "running"), ("unplugged", "homing")])
def test_some_faults_at_some_moments(kind: str, moment: str, tmp_path: Path) -> None:
    check(kind, moment, "follower", tmp_path)


def test_a_leader_that_is_silent_while_it_leads(tmp_path: Path) -> None:
    check("silent", "teaching", "leader", tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("moment", MOMENTS)
@pytest.mark.parametrize("kind", KINDS)
def test_every_fault_at_every_moment(kind: str, moment: str, tmp_path: Path) -> None:
    check(kind, moment, "follower", tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_every_fault_of_the_leader(kind: str, tmp_path: Path) -> None:
    check(kind, "teaching", "leader", tmp_path)
