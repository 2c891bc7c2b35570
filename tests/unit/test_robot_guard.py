"""Limits as properties, and the guard against a robot that misbehaves: judged by what reaches the motors."""

import contextlib
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cqn_train.robot.guard import LATE, TELLS_S, Guard, GuardSettings, StoppedError
from cqn_train.robot.limits import Limits, allowed_goal
from cqn_train.robot.readings import RobotFault
from lerobot_cqn.errors import ConfigError

from ..driven_clock import DrivenClock, until

D = 3
NAMES = ("a.pos", "b.pos", "c.pos")
numbers = st.floats(-500, 500)
vectors = arrays(np.float64, D, elements=numbers)


def limits(**changes: Any) -> Limits:
    ranges = {"low": -90.0 * np.ones(D), "high": 90.0 * np.ones(D), "max_step": np.full(D, 5.0)}
    return Limits(**{**ranges, "max_speed": np.full(D, 50.0), **changes})


@given(vectors, vectors, arrays(np.float64, D, elements=st.floats(-90, 90)), st.floats(0.001, 0.5))
def test_a_goal_is_always_inside_the_joint_limits(wanted: Any, measured: Any, last: Any, seconds: float) -> None:
    goal = allowed_goal(wanted, measured, last, seconds, limits()).goal
    assert (goal >= -90).all()
    assert (goal <= 90).all()


@given(vectors, vectors, st.floats(0.001, 0.5))
def test_an_arm_outside_its_limits_comes_in_without_a_leap(wanted: Any, place: Any, seconds: float) -> None:
    goal = allowed_goal(wanted, place, place, seconds, limits()).goal
    assert np.abs(goal - place).max() <= min(5.0, 50.0 * seconds) + 1e-9
    assert (np.abs(goal) <= np.maximum(90, np.abs(place))).all()  # and never farther out


@given(vectors, arrays(np.float64, D, elements=st.floats(-80, 80)), st.floats(0.01, 0.5))
def test_steps_and_speed_are_bounded_where_the_arm_is_inside_its_limits(
    wanted: Any, measured: Any, seconds: float
) -> None:
    verdict = allowed_goal(wanted, measured, measured, seconds, limits())
    assert np.abs(verdict.goal - measured).max() <= min(5.0, 50.0 * seconds) + 1e-9
    if not verdict.reasons:
        assert np.array_equal(verdict.goal, wanted)
    else:
        assert not np.array_equal(verdict.goal, wanted)


@given(arrays(np.float64, D, elements=st.one_of(numbers, st.just(np.nan), st.just(np.inf))))
def test_what_is_not_finite_holds(wanted: Any) -> None:
    last = np.array([1.0, 2.0, 3.0])
    verdict = allowed_goal(wanted, last, last, 0.1, limits())
    assert np.isfinite(verdict.goal).all()
    if not np.isfinite(wanted).all():
        assert np.array_equal(verdict.goal, last)
        assert verdict.reasons == ("not finite",)


def test_the_workspace() -> None:
    box = (np.array([-10.0, -10.0, 0.0]), np.array([10.0, 10.0, 10.0]))
    with_box = limits(box=box, forward=lambda joints: joints)
    last = np.array([0.0, 0.0, 1.0])
    inside = allowed_goal(np.array([1.0, 1.0, 2.0]), last, last, 0.1, with_box)
    assert inside.reasons == ()
    below = allowed_goal(np.array([0.0, 0.0, -1.0]), last, last, 0.1, with_box)
    assert below.reasons == ("workspace",)
    assert np.array_equal(below.goal, last)


@pytest.mark.parametrize(("changes", "said"), [
    ({"low": np.full(D, 91.0)}, "low <= high"), ({"high": np.full(D, np.nan)}, "finite"),
    ({"max_step": np.zeros(D)}, "positive"), ({"box": (np.zeros(3), np.ones(3))}, "kinematics"),
])  # fmt: skip
def test_limits_that_make_no_sense(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        limits(**changes)


class Motors:
    """Stands in for a robot: remembers every goal, follows at once, and fails on request."""

    def __init__(self) -> None:
        self.joints = np.zeros(D)
        self.goals: list[np.ndarray[Any, Any]] = []
        self.is_connected = False
        self.on_read: Callable[[dict[str, Any]], None] = lambda _: None
        self.on_send: Callable[[], None] = lambda: None
        self.picture = np.zeros((4, 4, 3), np.uint8)
        self.noise = 0
        self.bus: Any = None

    action_features = dict.fromkeys(NAMES, float)
    observation_features = dict.fromkeys(NAMES, float) | {"eye": (4, 4, 3)}

    def connect(self) -> None:
        self.is_connected = True

    def disconnect(self) -> None:
        self.is_connected = False

    def get_observation(self) -> dict[str, Any]:
        self.noise += 1
        self.picture[0, 0, 0] = self.noise % 256
        observation = {**dict(zip(NAMES, self.joints, strict=True)), "eye": self.picture.copy()}
        self.on_read(observation)
        return observation

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        self.on_send()
        self.goals.append(np.array([action[name] for name in NAMES]))
        self.joints = self.goals[-1].copy()
        return action


def guarded(settings: GuardSettings | None = None) -> tuple[Guard, Motors, DrivenClock]:
    """With a clock of its own and without the watchdog's thread."""
    motors, clock = Motors(), DrivenClock(0.0)
    motors.connect()
    guard = Guard(motors, limits(), settings or GuardSettings(watchdog_s=1.0), clock)  # type: ignore[arg-type]
    guard.read()
    return guard, motors, clock


@given(st.lists(st.tuples(vectors, st.floats(0.001, 2.0)), min_size=1, max_size=30))
def test_no_sequence_of_goals_breaks_a_limit(goals: list[tuple[Any, float]]) -> None:
    guard, motors, clock = guarded()
    before, sent_at = motors.joints.copy(), 0.0
    for wanted, seconds in goals:
        clock.now += seconds
        guard.read()
        guard.send(wanted)
        sent = motors.goals[-1]
        assert (np.abs(sent) <= 90).all()
        assert np.abs(sent - before).max() <= min(5.0, 50.0 * (clock.now - sent_at)) + 1e-9
        before, sent_at = sent, clock.now


def test_stop_wins() -> None:
    guard, motors, clock = guarded()
    clock.now = 0.1
    guard.send(np.ones(D))
    guard.stop()
    assert guard.stopped
    held = motors.goals[-1]
    for _ in range(3):
        with pytest.raises(StoppedError):
            guard.send(np.full(D, 2.0))
    guard.stop()
    assert all(np.array_equal(goal, held) for goal in motors.goals[1:])


def test_stop_wins_over_a_goal_that_is_on_its_way() -> None:
    guard, motors, clock = guarded()
    clock.now = 0.1
    reached, go_on = threading.Event(), threading.Event()

    def wait() -> None:
        if not reached.is_set():
            reached.set()
            clock.wait(go_on, 5)

    motors.on_send = wait
    sender = clock.thread(lambda: guard.send(np.ones(D)), "sender")
    sender.start()
    assert clock.wait(reached, 5)
    stopper = clock.thread(guard.stop, "stopper")
    stopper.start()
    until(clock, lambda: guard.stopped)
    go_on.set()
    sender.join(5)
    stopper.join(5)
    assert len(motors.goals) == 2  # the one on its way, and then the hold
    with pytest.raises(StoppedError):
        guard.send(np.ones(D))


def failing(error: Exception) -> Callable[..., None]:
    def fail(*_: Any) -> None:
        raise error

    return fail


@pytest.mark.parametrize("error", [ConnectionError("unplugged"), RuntimeError("odd"), KeyError("motor")])
def test_drivers_errors_become_one_kind(error: Exception) -> None:
    guard, motors, _ = guarded()
    motors.on_read = failing(error)
    with pytest.raises(RobotFault, match="cannot be read"):
        guard.read()
    motors.on_read = lambda _: None
    motors.on_send = failing(error)
    with pytest.raises(RobotFault, match="takes no goal"):
        guard.send(np.ones(D))
    guard.stop()  # does not raise
    motors.on_send = lambda: None
    guard.close()
    assert not motors.is_connected


@pytest.mark.parametrize("late", [1, LATE - 1, LATE])
def test_the_first_readings_may_take_long(late: int) -> None:
    """Cameras warm up, and nothing moves yet; once something does, one late reading is a fault."""
    motors, clock, left = Motors(), DrivenClock(0.0), iter(range(late))
    guard = Guard(motors, limits(), GuardSettings(current_s=0.3), clock)  # type: ignore[arg-type]

    def slow(_: Any) -> None:
        clock.now += 1.2 if next(left, None) is not None else 0.0

    motors.on_read = slow
    motors.connect()
    if late == LATE:
        with pytest.raises(RobotFault, match=r"took 1\.2 s"):
            guard.read()
        return
    guard.read()
    left = iter(range(1))
    with pytest.raises(RobotFault, match=r"took 1\.2 s"):
        guard.read()


def test_an_arm_that_rests_off_its_goal_can_be_taken_up_again() -> None:
    """Held by gravity or by what is in its way, an encoder may say the same for ever: that must end no run."""
    guard, motors, clock = guarded(GuardSettings(stale_s=1.0, current_s=0.5, watchdog_s=100.0))
    motors.send_action = lambda action: action  # type: ignore[method-assign]
    with contextlib.suppress(RobotFault):
        for _ in range(40):
            clock.now += 0.1
            guard.send(np.array([0.0, 9.0, 0.0]))
            guard.read()
    clock.now += 1.0
    with pytest.raises(RobotFault, match="The joints have not changed"):  # it was asked to move a moment ago
        guard.read()
    for _ in range(100):
        clock.now += TELLS_S / 10
        with contextlib.suppress(RobotFault):
            guard.read()
    for _ in range(40):
        clock.now += 0.5
        guard.read()


def test_readings_that_cannot_be_true() -> None:
    guard, motors, clock = guarded(GuardSettings(stale_s=1.0, current_s=0.5))
    motors.on_read = lambda observation: observation.update({"b.pos": float("nan")})
    with pytest.raises(RobotFault, match=r"'b\.pos' reads nan"):
        guard.read()
    motors.on_read = lambda _: setattr(clock, "now", clock.now + 0.6)
    with pytest.raises(RobotFault, match=r"took 0\.6 s"):
        guard.read()
    frozen = motors.picture.copy()
    motors.on_read = lambda observation: observation.update(eye=frozen)
    guard.read()
    clock.now += 0.9
    guard.read()
    clock.now += 0.2
    with pytest.raises(RobotFault, match=r"camera 'eye' has not changed for 1\.1 s"):
        guard.read()


def test_joints_that_do_not_move_although_they_are_told_to() -> None:
    guard, motors, clock = guarded(GuardSettings(stale_s=1.0, watchdog_s=10.0))
    stuck = dict(zip(NAMES, motors.joints.copy(), strict=True))
    motors.on_read = lambda observation: observation.update(stuck)

    def drive() -> None:
        for _ in range(30):
            clock.now += 0.1
            guard.read()
            guard.send(np.full(D, 40.0))

    with pytest.raises(RobotFault, match="joints have not changed"):
        drive()
    last = motors.goals[-1]
    guard.hold()
    assert np.array_equal(motors.goals[-1], last)  # what the joints say is not believed


def test_an_arm_that_is_told_to_stay_may_stay() -> None:
    guard, motors, clock = guarded()
    still = dict(zip(NAMES, motors.joints.copy(), strict=True))
    motors.on_read = lambda observation: observation.update(still)
    for _ in range(50):
        clock.now += 0.1
        guard.read()
        guard.send(np.zeros(D))


def test_the_watchdog_holds_an_arm_that_nobody_commands() -> None:
    motors, clock = Motors(), DrivenClock()
    settings = GuardSettings(watchdog_s=0.1)
    with Guard(motors, limits(), settings, clock) as guard:  # type: ignore[arg-type]
        assert motors.is_connected
        clock.sleep(0.01)
        guard.send(np.ones(D))
        sent = len(motors.goals)
        clock.sleep(0.09)
        assert len(motors.goals) == sent
        clock.sleep(0.31)
        assert len(motors.goals) == sent + 1  # once
        assert guard.interventions["watchdog"] == 1
        guard.read()
        guard.send(np.ones(D))  # and the arm can be moved again
    assert not motors.is_connected
    assert np.array_equal(motors.goals[-1], motors.joints)


def test_one_look_of_the_watchdog_at_a_time() -> None:
    guard, motors, clock = guarded(GuardSettings(watchdog_s=1.0))
    for moment in (0.0, 5.0):  # no goal was sent yet
        clock.now += moment
        guard.watch()
    assert motors.goals == []
    guard.send(np.ones(D))
    clock.now += 1.0
    guard.watch()
    assert len(motors.goals) == 1
    clock.now += 0.001
    for _ in range(3):
        guard.watch()
    assert len(motors.goals) == 2
    assert guard.interventions["watchdog"] == 1


def test_leaving_by_an_error_holds_and_disconnects() -> None:
    motors, clock = Motors(), DrivenClock()

    def fail() -> None:
        with Guard(motors, limits(), clock=clock) as guard:  # type: ignore[arg-type]
            clock.sleep(0.01)
            guard.send(np.ones(D))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert not motors.is_connected
    assert np.array_equal(motors.goals[-1], motors.goals[-2])
