"""Wrong readings: a robot that lies keeps every goal that reached it; they are judged by where its joints truly are.

Nothing here asks our own code whether a goal was right.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from cqn_train.robot.guard import Guard, GuardSettings, HeldError
from cqn_train.robot.limits import Limits
from cqn_train.robot.readings import RobotFault

from ..driven_clock import DrivenClock

D, FPS, STEP = 3, 10, 5.0
NAMES = ("a.pos", "b.pos", "c.pos")
LOW, HIGH = -40.0, 40.0
READ_S = 0.004
OVERFLOW = 360.0  # a turn of the encoder, in degrees
# What is told of any reading: numbers near by and far away, and what no joint can be.
LIES = st.one_of(
    st.floats(-40, 40), st.sampled_from([OVERFLOW, -OVERFLOW, 200.0, -120.0, 32.7, 4096.0, 1e12, np.nan, np.inf])
)


@dataclass
class Sent:
    """A goal [D] as it reached the motors: when, where the joints were, and which goal they had before."""

    goal: Any
    at: float
    joints: Any
    before: Any
    before_at: float


class Liar:
    """Joints that follow their goals within `lag_s`; readings and torque as a test wants them."""

    action_features = dict.fromkeys(NAMES, float)
    observation_features = dict.fromkeys(NAMES, float) | {"force": float, "eye": (4, 4, 3)}

    def __init__(self, clock: DrivenClock, lag_s: float) -> None:
        self.clock, self.lag_s = clock, lag_s
        self.joints, self.goal, self.torque = np.zeros(D), np.zeros(D), True
        self.sent: list[Sent] = []
        self.reads = 0
        self.lie: Callable[[int, dict[str, Any]], None] = lambda _, __: None
        self.is_connected = False
        self.bus = self
        self._looked, self._sent_at = clock.now, clock.now
        self._fresh = True  # without a goal of before: the motors were off

    def connect(self) -> None:
        self.is_connected, self._fresh = True, True

    def disconnect(self) -> None:
        self.is_connected = False

    def let_pass(self) -> None:
        passed, self._looked = self.clock.now - self._looked, self.clock.now
        if self.torque and passed:
            self.joints = self.joints + (self.goal - self.joints) * (1 - np.exp(-passed / self.lag_s))

    def get_observation(self) -> dict[str, Any]:
        self.clock.sleep(READ_S)
        self.let_pass()
        self.reads += 1
        picture = np.full((4, 4, 3), self.reads % 256, np.uint8)
        raw: dict[str, Any] = {**dict(zip(NAMES, self.joints.tolist(), strict=True)), "force": 0.1, "eye": picture}
        self.lie(self.reads, raw)
        return raw

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        self.let_pass()
        goal = np.array([action[name] for name in NAMES])
        before = goal if self._fresh else self.goal
        self.sent.append(Sent(goal, self.clock.now, self.joints.copy(), before.copy(), self._sent_at))
        self.goal, self._sent_at, self._fresh = goal, self.clock.now, False
        return action

    def disable_torque(self) -> None:
        self.let_pass()
        self.torque, self._fresh = False, True

    def enable_torque(self) -> None:
        self.let_pass()
        self.torque = True
        self.sent.append(Sent(self.goal, self.clock.now, self.joints.copy(), self.goal.copy(), self._sent_at))


def made(lag_s: float = 0.001, low: Any = LOW, high: Any = HIGH) -> tuple[Guard, Liar, DrivenClock]:
    clock = DrivenClock(0.0)
    robot = Liar(clock, lag_s)
    low, high = np.full(D, low), np.full(D, high)
    limits = Limits(low=low, high=high, max_step=np.full(D, STEP), max_speed=np.full(D, STEP * FPS))
    return Guard(robot, limits, GuardSettings(), clock), robot, clock  # type: ignore[arg-type]


def drive(guard: Guard, clock: DrivenClock, goals: list[float]) -> None:
    """As the loop does: a goal of all joints, a period, a reading."""
    for goal in goals:
        guard.send(np.full(D, goal))
        clock.sleep(1 / FPS)
        guard.read()


def session(guard: Guard, robot: Liar, clock: DrivenClock) -> None:
    """Everything that is done with an arm, once: driven, paused, moved by hand, lost and found, stopped."""
    robot.connect()
    guard.read()
    drive(guard, clock, [4, 8, 12, 50, 50, 50, 50, 50, 50])  # up to a limit
    guard.hold()  # a pause, in the middle of a movement
    clock.sleep(1.0)
    guard.read()
    drive(guard, clock, [0, -40, -40, -40])
    clock.sleep(1.0)  # nobody sends anything: the watchdog looks, and then the loop goes on
    guard.watch()
    drive(guard, clock, [-20])
    guard.recover()  # a fault that was none of the connection
    guard.release()
    robot.joints = robot.joints + np.array([-28.0, -12.0, 1.0])
    for _ in range(3):
        clock.sleep(0.1)
        guard.read()
    guard.engage()
    drive(guard, clock, [10, 10, 10])
    robot.disconnect()
    robot.joints = robot.goal = robot.joints - 25.0  # it sank while it had no power
    guard.recover()
    drive(guard, clock, [0, 0, 0])
    guard.read()
    guard.stop()


def excess(sent: list[Sent]) -> Any:
    """Worst goals over what is allowed, judged by the true joints: [distance, speed, degrees out of the limits].

    Speed counts where a goal leads farther away from the joint than the one before: a hold leads back, by a step.
    """
    distance = max(np.abs(one.goal - one.joints).max() for one in sent) / STEP
    speed = 0.0
    for one in sent:
        moved = np.abs(one.goal - one.before)
        away = np.abs(one.goal - one.joints) > np.abs(one.before - one.joints) + 1e-9
        allowed = np.where(away, min(STEP, STEP * FPS * (one.at - one.before_at)), STEP)
        speed = max(speed, float((moved / np.maximum(allowed, 1e-12)).max())) if moved.any() else speed
    out = max(max(one.goal.max() - HIGH, LOW - one.goal.min()) for one in sent)
    return np.array([distance, speed, out])


def tell(number: int, joint: str, off: float, *, count: int = 1) -> Callable[[int, dict[str, Any]], None]:
    """Readings from `number` on that are off by so much, or that value itself where it is no number."""

    def lie(reads: int, raw: dict[str, Any]) -> None:
        if number <= reads < number + count:
            raw[joint] = raw[joint] + off

    return lie


def readings_of_a_session(lag_s: float) -> int:
    guard, robot, clock = made(lag_s)
    session(guard, robot, clock)
    return robot.reads


# An arm that lags may be believed to have arrived: then a goal is a step from there.
@pytest.mark.parametrize(("lag_s", "most"), [(0.001, 1.0), (0.1, 1.0 + np.exp(-1))])
def test_no_single_wrong_reading_moves_the_arm_farther_than_allowed(lag_s: float, most: float) -> None:
    """Every reading of a session in turn, each of these lies: no goal is farther, faster or more outside than ever."""
    worst = np.full(3, -np.inf)
    for number in range(1, readings_of_a_session(lag_s) + 1):
        for off in (OVERFLOW, -200.0, 32.7, 8.0, 4.0, -4.0, np.nan):
            guard, robot, clock = made(lag_s)
            robot.lie = tell(number, NAMES[number % D], off)
            session(guard, robot, clock)  # and it is no fault
            worst = np.maximum(worst, excess(robot.sent))
    assert worst[0] <= most + 1e-9
    assert worst[1] <= 1.0 + 1e-9
    assert worst[2] <= 0.0


def test_right_readings_are_judged_alike() -> None:
    """The judge itself: what is allowed is used to the full, and goals of another arm are found out."""
    guard, robot, clock = made()
    session(guard, robot, clock)
    assert excess(robot.sent)[:2] == pytest.approx([1.0, 1.0])
    assert guard.interventions.get("wrong reading", 0) == 0
    robot.send_action(dict.fromkeys(NAMES, 200.0))
    assert (excess(robot.sent) > [10, 10, 100]).all()


def wrong_from(robot: Liar, off: float, *, joint: str = NAMES[0], count: int = 10**6) -> None:
    """From the next reading on, so many in a row."""
    robot.lie = tell(robot.reads + 1, joint, off, count=count)


@pytest.mark.parametrize("off", [OVERFLOW, -32.7, np.nan])
@pytest.mark.parametrize("count", [1, 2])
def test_fewer_than_three_in_a_row_are_read_again(off: float, count: int) -> None:
    guard, robot, clock = made()
    robot.connect()
    guard.read()
    drive(guard, clock, [4, 8])
    wrong_from(robot, off, count=count)
    assert guard.read().joints == pytest.approx(robot.joints)
    assert guard.interventions["wrong reading"] == count


@pytest.mark.parametrize(
    ("off", "said"), [(OVERFLOW, "'a.pos' reads 368 and read 8 just before"), (np.nan, "reads nan")]
)
def test_three_in_a_row_are_a_fault_and_the_hold_does_not_believe_them(off: float, said: str) -> None:
    guard, robot, clock = made()
    robot.connect()
    guard.read()
    drive(guard, clock, [4, 8])
    clock.sleep(0.1)
    wrong_from(robot, off)
    with pytest.raises(RobotFault, match=said):
        guard.read()
    guard.stop()
    assert robot.sent[-1].goal == pytest.approx(robot.joints)


def test_an_arm_that_was_knocked_is_a_fault_and_found_again() -> None:
    """A real jump by hand, against motors that hold: readings that agree with one another, far from the last one."""
    guard, robot, clock = made(lag_s=1e9)  # and it stays where it was pushed
    robot.connect()
    guard.read()
    drive(guard, clock, [0, 0])
    robot.joints = np.array([30.0, 0.0, 0.0])
    with pytest.raises(RobotFault, match="the arm was knocked"):
        guard.read()
    guard.recover()
    assert guard.joints == pytest.approx(robot.joints)
    assert robot.sent[-1].goal == pytest.approx([STEP, 0.0, 0.0])  # the motors had a goal: at most a step from there
    drive(guard, clock, [0] * 10)
    assert excess(robot.sent)[1] <= 1.0 + 1e-9


def test_a_mild_push_is_none() -> None:
    guard, robot, clock = made(lag_s=1e9)
    robot.connect()
    guard.read()
    for _ in range(5):
        robot.joints = robot.joints + 0.9 * STEP
        clock.sleep(0.1)
        guard.read()
    assert guard.interventions == {}


@pytest.mark.parametrize("count", [1, 2])
def test_recovery_and_engaging_ask_for_three_that_agree(count: int) -> None:
    for find in ("engage", "recover"):
        guard, robot, clock = made()
        robot.connect()
        guard.read()
        drive(guard, clock, [4, 8])
        if find == "engage":
            guard.release()
        else:
            robot.disconnect()
        robot.joints = robot.goal = np.array([20.0, -30.0, 35.0])  # moved meanwhile
        wrong_from(robot, 120.0, count=count)
        before = robot.reads
        getattr(guard, find)()
        assert robot.reads - before == count + 3
        assert robot.torque
        assert robot.sent[-1].goal == pytest.approx(robot.joints)


@pytest.mark.parametrize("find", ["engage", "recover"])
def test_readings_that_never_agree_hold_nothing(find: str) -> None:
    guard, robot, _ = made()
    robot.connect()
    guard.read()
    guard.release() if find == "engage" else robot.disconnect()
    sent = len(robot.sent)
    robot.lie = lambda reads, raw: raw.update({"b.pos": 100.0 * (reads % 2)})
    with pytest.raises(RobotFault, match=r"do not agree: 'b\.pos' read (100, then 0|0, then 100)"):
        getattr(guard, find)()
    assert len(robot.sent) == sent
    assert robot.torque == (find == "recover")


@pytest.mark.parametrize("find", ["engage", "recover"])
def test_an_arm_beyond_its_limits_is_brought_back_by_hand_first(find: str) -> None:
    """Found there, or only said to be there: no goal lies outside, and the motors stay as they are."""
    guard, robot, clock = made()
    robot.connect()
    guard.read()
    drive(guard, clock, [4, 8])
    guard.release() if find == "engage" else robot.disconnect()
    sent = len(robot.sent)
    wrong_from(robot, 255.0, joint="c.pos")
    with pytest.raises(RobotFault, match=r"'c\.pos' is at 263, its limits are -40 to 40: bring it back by hand"):
        getattr(guard, find)()
    assert len(robot.sent) == sent
    robot.lie = lambda _, __: None
    getattr(guard, find)()
    assert robot.sent[-1].goal == pytest.approx(robot.joints)


def test_no_goal_rests_on_an_old_reading() -> None:
    guard, robot, clock = made()
    robot.connect()
    guard.read()
    drive(guard, clock, [4, 8])
    read = robot.reads
    clock.sleep(0.25)
    guard.send(np.full(D, 8.0))
    assert robot.reads == read
    clock.sleep(0.1)  # 0.35 s since the reading
    guard.send(np.full(D, 8.0))
    assert robot.reads == read + 1
    moving = [True]
    clock.sleep(1.0)
    robot.lie = lambda _, __: moving.clear() or moving.append(False)  # paused while it is read
    sent = len(robot.sent)
    with pytest.raises(HeldError):
        guard.send(np.full(D, 8.0), lambda: moving[0])
    assert len(robot.sent) == sent


@pytest.mark.parametrize("slow_s", [0.2, 0.4, 1.2])
def test_a_robot_that_answers_slowly_never_leaps(slow_s: float) -> None:
    """Its readings are as old as it is slow: goals keep to a step all the same, or it is a fault."""
    guard, robot, clock = made()
    robot.connect()
    guard.read()
    drive(guard, clock, [4, 8])
    robot.lie = lambda _, __: clock.sleep(slow_s)  # after the joints were read
    for _ in range(5):
        try:
            drive(guard, clock, [80])
        except RobotFault as fault:
            assert "took" in str(fault)  # noqa: PT017  # the slow one only
    assert (excess(robot.sent)[:2] <= 1.0 + 1e-9).all()


@given(st.integers(1, 75), st.sampled_from(NAMES), LIES)
@example(1, "a.pos", OVERFLOW)
def test_whatever_one_reading_says(number: int, joint: str, off: float) -> None:
    guard, robot, clock = made()
    robot.lie = tell(number, joint, off)
    session(guard, robot, clock)
    assert (excess(robot.sent) <= [1.0 + 1e-9, 1.0 + 1e-9, 0.0]).all()
