"""An arm's environment over the simulated arm and a scripted person, without a page; judged in the simulator.

All of them, the attendant and the watchdog live by one clock, which is the bench's: see `driven_clock`.
"""

import contextlib
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from lerobot.robots import make_robot_from_config
from numpy.typing import NDArray

from cqn_train.arm.environment import ArmEnvironment
from cqn_train.clock import Clock
from cqn_train.envs.ur5e_station.ur5e import HOME
from cqn_train.interfaces import Outcome
from cqn_train.operator.session import Event, RefusedError, Session, State
from cqn_train.robot.arm import Arm
from cqn_train.robot.guard import Guard, GuardSettings
from cqn_train.robot.limits import Limits
from cqn_train.robot.settings import ArmSettings
from cqn_train.sim_arm import Fault, SimUR5eConfig
from cqn_train.sim_arm.sim_ur5e import SimUR5e
from cqn_train.sim_arm.world import World

from ..driven_clock import DrivenClock, until

Array = NDArray[np.float64]
FPS, SPEED = 40, 8.0  # control steps and simulated seconds, in a second of the clock
RAMP_S = SPEED / FPS  # a period of the simulated clock: the arm is led evenly from goal to goal
HOME_DEG = np.append(np.degrees(HOME), 0.0)
STEP_DEG = 2.0
READ_S = 0.004  # that a reading takes: others run meanwhile, and find the guard busy
# What the physics adds to the speed of the goals (a joint swings when it starts, and is led by a clock that is read a
# little early or late); measured over runs without faults, with room.
SWING = 1.6
SWING_DEG = 1.0  # and to the angles


def arm_limits() -> Limits:
    """Twenty degrees around home, two degrees a step; the gripper as it likes."""
    span, step = np.append(np.full(6, 20.0), 100.0), np.append(np.full(6, STEP_DEG), 100.0)
    low, high = HOME_DEG - span, HOME_DEG + span
    low[6], high[6] = 0.0, 100.0
    return Limits(low=low, high=high, max_step=step, max_speed=step * FPS)


class Display:
    """Keeps what a person would see."""

    def __init__(self) -> None:
        self.shown = 0
        self.said: dict[str, float | str] = {}
        self.lines: list[str] = []
        self.begun: list[int] = []
        self.ended: list[tuple[int, int]] = []

    def show(self, pictures: Mapping[str, NDArray[np.uint8]]) -> None:
        self.shown += 1

    def message(self, text: str) -> None:
        self.lines.append(text)

    def health(self, **values: float | str) -> None:
        self.said = values

    def begin_episode(self, number: int) -> None:
        self.begun.append(number)

    def end_episode(self, number: int, steps: int, seconds: float) -> None:
        self.ended.append((number, steps))


class HandLeader:
    """A leader that a test moves: its joints are what `pose` says."""

    def __init__(self) -> None:
        self.pose: Callable[[], Array] = lambda: np.zeros(7)
        self.is_connected = False
        self.action_features = dict.fromkeys(NAMES, float)
        self.feedback_features: dict[str, type] = {}

    def connect(self) -> None:
        self.is_connected = True

    def disconnect(self) -> None:
        self.is_connected = False

    def get_action(self) -> dict[str, float]:
        return dict(zip(NAMES, self.pose().tolist(), strict=True))


NAMES = (
    "shoulder_pan.pos", "shoulder_lift.pos", "elbow.pos", "wrist_1.pos", "wrist_2.pos", "wrist_3.pos", "gripper.pos",
)  # fmt: skip


@dataclass
class Bench:
    """What a test looks at and acts through."""

    clock: Clock
    env: ArmEnvironment
    session: Session
    robot: SimUR5e
    leader: HandLeader
    display: Display
    world: World  # of the robot, also while it is not connected
    goals: list[Array] = field(default_factory=list)  # everything that reached the motors
    farthest: float = 0.0  # of a goal from where the joint was in the simulator, degrees
    _threads: list[threading.Thread] = field(default_factory=list)
    _failed: list[BaseException] = field(default_factory=list)

    @property
    def joints(self) -> Array:
        """Of the simulator, degrees [6]."""
        with self.world.lock:
            self.world.catch_up()
            return np.degrees(self.world.arm.joints)

    def meanwhile(self, act: Callable[[], Any]) -> None:
        """What the person does, in a thread of its own; its errors fail the test when the bench is closed."""

        def run() -> None:
            try:
                act()
            except BaseException as error:
                self._failed.append(error)
                with contextlib.suppress(RefusedError):
                    self.session.apply(Event.STOP)

        self._threads.append(self.clock.thread(run, "person"))
        self._threads[-1].start()

    def do(self, *events: Event) -> None:
        """The person presses these, one after the other."""
        for event in events:
            self.session.apply(event)

    def begin(self) -> dict[str, Any]:
        """An episode begins, as the loop and the person begin it; returns its first frame."""

        def start() -> None:
            self.soon(lambda: not self.session.busy)
            if self.session.state is State.RESETTING:
                self.session.apply(Event.READY)
            self.session.apply(Event.START)

        self.session.expect(len(self.display.begun))
        self.meanwhile(start)
        return self.env.reset(0)

    def step(self, *move: float) -> Outcome:
        """A step of the policy: a goal so many degrees from home, in the first joints."""
        goal = HOME_DEG.copy()
        goal[: len(move)] += move
        return self.env.step(torch.tensor(goal, dtype=torch.float32)[None])

    def soon(self, ready: Callable[[], Any], seconds: float = 10.0) -> None:
        """Let time pass until something is so; fails the test where it does not become so."""
        until(self.clock, ready, seconds)

    def is_state(self, *states: State) -> Callable[[], bool]:
        return lambda: self.session.state in states

    def at_rest(self, seconds: float = 0.15) -> bool:
        """Whether the arm does not move for so many seconds (more than a simulated one)."""
        before = self.joints
        self.clock.sleep(seconds)
        return bool(np.abs(self.joints - before).max() < 0.3)

    def check(self, speed_deg: float = STEP_DEG * FPS, *, springs: bool = False) -> None:
        """The simulator saw no joint faster or farther than allowed, and no goal far from the arm.

        speed_deg: degrees in a second. springs: a joint came free and went to its goal as fast as motors do:
        goals can keep that short, at a step, and not slow.
        """
        limits, world = self.env.arm.limits, self.world
        assert springs or np.degrees(world.fastest) * SPEED <= SWING * speed_deg
        # A goal is at most a step from the joint as it was read, and the joint has moved since: at most a step.
        assert self.farthest <= 2 * STEP_DEG + 0.1
        assert (np.degrees(world.lowest) >= limits.low[:6] - SWING_DEG).all()
        assert (np.degrees(world.highest) <= limits.high[:6] + SWING_DEG).all()

    def close(self) -> None:
        """End everything, and raise what failed beside the test."""
        with contextlib.suppress(RefusedError):
            self.session.apply(Event.STOP)
        for thread in self._threads:
            thread.join(10)
        self.env.close()
        if self._failed:
            raise self._failed[0]


@contextlib.contextmanager
def bench(
    *,
    cameras: tuple[str, ...] = (),
    faults: tuple[Fault, ...] = (),
    should_stop: Callable[[], bool] = lambda: False,
    clock: Clock | None = None,
    start: Array | None = None,
    **arm: Any,
) -> Iterator[Bench]:
    """The arm connected and held, the session waiting.

    clock: by which all live; None: one of their own. start: joints [6], rad, where it is found; None: home.
    """
    settings = ArmSettings(**{"episode_s": 60.0, "stale_s": 0.3, "watchdog_s": 0.25, "home_speed": 0.5, **arm})
    clock = clock or DrivenClock()
    robot = make_robot_from_config(
        SimUR5eConfig(
            speed=SPEED,
            ramp_s=RAMP_S,
            camera_names=list(cameras),
            image_height=16,
            image_width=16,
            state=True,
            faults=list(faults),
        )
    )
    assert isinstance(robot, SimUR5e)
    robot.clock = clock
    robot.connect()
    if start is not None:
        robot.world.arm.place(start, 0.0)
        robot.world.lay_out()
    hand = HandLeader()
    guard = Guard(robot, arm_limits(), GuardSettings(settings.stale_s, settings.watchdog_s, current_s=0.4), clock)
    made = Arm(
        guard, settings, FPS, leader=hand, clutched=range(6), home=HOME_DEG  # type: ignore[arg-type]
    )  # fmt: skip
    session, display = Session(can_free=guard.can_release), Display()
    env = ArmEnvironment(made, session, display, should_stop, clock)
    made_bench = Bench(clock, env, session, robot, hand, display, robot.world)
    read, send = robot.get_observation, robot.send_action

    def slowly() -> dict[str, Any]:
        clock.sleep(READ_S)
        return read()

    def spy(action: dict[str, Any]) -> dict[str, Any]:
        sent = send(action)
        made_bench.goals.append(np.array([action[name] for name in NAMES]))
        away = np.abs(made_bench.goals[-1][:6] - np.degrees(made_bench.world.arm.joints)).max()
        made_bench.farthest = max(made_bench.farthest, float(away))
        return sent

    robot.get_observation = slowly  # type: ignore[method-assign]
    robot.send_action = spy  # type: ignore[method-assign]
    hand.pose = HOME_DEG.copy
    env.open()
    try:
        yield made_bench
    finally:
        made_bench.close()
