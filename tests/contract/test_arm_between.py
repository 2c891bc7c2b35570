"""The simulated arm between episodes: on its way home, started early, taken by hand."""

from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest

from cqn_train.operator.session import Event, State
from cqn_train.sim_arm import Fault

from .arm_bench import FPS, HOME_DEG, STEP_DEG, SWING_DEG, Bench, bench

pytest.importorskip("mujoco")


@pytest.fixture
def arm() -> Iterator[Bench]:
    with bench() as made:
        yield made


def test_between_episodes_it_goes_home_slowly(arm: Bench) -> None:
    arm.begin()
    for _ in range(14):  # and rests there
        arm.step(18, -18, 10)
    arm.do(Event.FAILURE)
    arm.step()
    arm.world.fastest = 0.0
    arm.soon(lambda: np.abs(arm.joints - HOME_DEG[:6]).max() < 4)  # then the simulator lays out the scene: a small jerk
    arm.check(speed_deg=0.5 * STEP_DEG * FPS)  # `home_speed`
    arm.soon(lambda: np.abs(arm.joints - HOME_DEG[:6]).max() < 0.5)
    arm.soon(lambda: arm.at_rest(0.05))
    assert np.abs(arm.joints - HOME_DEG[:6]).max() < SWING_DEG
    assert arm.session.state is State.RESETTING  # a person says when the scene is ready


def test_a_start_on_the_way_home_begins_where_the_arm_is(arm: Bench) -> None:
    arm.begin()
    for _ in range(12):
        arm.step(18)
    arm.do(Event.SUCCESS)
    arm.step()
    away = arm.joints
    arm.session.learning("")
    arm.soon(lambda: np.abs(arm.joints - away).max() > 2)
    arm.begin()
    here = arm.joints
    assert np.abs(here - HOME_DEG[:6]).max() > 3
    for _ in range(4):
        outcome = arm.step(*(here - HOME_DEG[:6]))
        assert not outcome.skipped
    assert np.abs(arm.joints - here).max() < STEP_DEG  # nobody else drives it
    arm.check()


def test_an_arm_on_its_way_home_can_be_taken_by_hand(arm: Bench) -> None:
    """It lets go at once, nothing is sent to it meanwhile, and held again it stays where it was put."""
    torque: list[bool] = []
    bus = SimpleNamespace(disable_torque=lambda: torque.append(False), enable_torque=lambda: torque.append(True))
    arm.robot.bus = bus  # type: ignore[attr-defined]
    arm.session.can_free = True
    arm.begin()
    for _ in range(12):
        arm.step(18)
    arm.do(Event.SUCCESS)
    arm.step()
    away = arm.joints
    arm.soon(lambda: np.abs(arm.joints - away).max() > 2)
    arm.do(Event.FREE)
    arm.soon(lambda: torque == [False], 0.3)
    sent = len(arm.goals)
    arm.soon(arm.at_rest)
    assert np.abs(arm.joints - HOME_DEG[:6]).max() > 3
    assert len(arm.goals) == sent
    arm.do(Event.FREE)
    arm.soon(lambda: torque == [False, True], 0.3)
    place = arm.joints
    assert arm.at_rest(0.3)
    assert np.abs(arm.goals[-1][:6] - place).max() < 0.5
    arm.check()


def test_home_is_asked_for_at_the_page(arm: Bench) -> None:
    arm.env.arm.settings.go_home = False
    arm.begin()
    for _ in range(8):
        arm.step(15)
    arm.do(Event.SUCCESS)
    arm.step()
    arm.soon(arm.at_rest)
    assert np.abs(arm.joints - HOME_DEG[:6]).max() > 5
    arm.do(Event.HOME)
    arm.soon(lambda: np.abs(arm.joints - HOME_DEG[:6]).max() < 0.5)
    arm.check()


def sagging(arm: Bench, degrees: float) -> None:
    """The arm stands so far below its goals in the second joint, as gravity pulls it."""
    send = arm.robot.send_action

    def send_lower(action: dict[str, float]) -> dict[str, float]:
        return send({**action, "shoulder_lift.pos": action["shoulder_lift.pos"] + degrees})

    arm.robot.send_action = send_lower  # type: ignore[method-assign]


@pytest.mark.parametrize("joint", ["sags", "is stuck"])
def test_the_way_home_comes_to_an_end(arm: Bench, joint: str) -> None:
    """Gravity or an obstacle keeps it from home: nobody has to keep clear for ever, and an obstacle is said."""
    arm.begin()
    for _ in range(12):
        arm.step(18, -18)
    if joint == "sags":
        sagging(arm, 0.8 * STEP_DEG)
    else:
        with arm.world.lock:
            arm.world.catch_up()
            arm.robot.config.faults = [Fault("stuck_joint", arm.world.now, 100.0, 1.0)]
    arm.do(Event.SUCCESS)
    arm.step()
    arm.soon(lambda: arm.session.homing)
    arm.soon(lambda: not arm.session.homing, 6.0)
    assert arm.at_rest(0.3)
    away = np.abs(arm.joints - HOME_DEG[:6])
    assert away[0] < 0.5  # it went as far as it could
    assert away[1] == pytest.approx(0.8 * STEP_DEG, abs=0.5) if joint == "sags" else away[1] > 10
    told = [line for line in arm.display.lines if "from home in 'shoulder_lift.pos': is something in its way" in line]
    assert len(told) == (joint == "is stuck")
    assert arm.session.state is State.RESETTING
    arm.robot.config.faults = []
    arm.begin()  # and the next episode starts


def test_a_failed_reading_does_not_take_the_arm_out_of_a_hand(arm: Bench) -> None:
    torque: list[bool] = []
    arm.robot.bus = SimpleNamespace(  # type: ignore[attr-defined]
        disable_torque=lambda: torque.append(False), enable_torque=lambda: torque.append(True)
    )
    arm.session.can_free = True
    arm.session.learning("")
    arm.do(Event.FREE)
    arm.soon(lambda: torque == [False])
    sent, read, fails = len(arm.goals), arm.robot.get_observation, [True]

    def fail_once() -> dict[str, float]:
        if fails and fails.pop():
            raise ConnectionError("no answer")
        return read()

    arm.robot.get_observation = fail_once  # type: ignore[method-assign]
    arm.soon(arm.is_state(State.FAULTED))
    arm.soon(arm.is_state(State.RESETTING))
    arm.clock.sleep(1.0)
    assert torque == [False]
    assert len(arm.goals) == sent
    assert arm.session.free
    arm.do(Event.FREE)
    arm.soon(lambda: torque == [False, True])
    assert np.abs(arm.goals[-1][:6] - arm.joints).max() < 0.5


def test_an_arm_put_beyond_its_limits_is_not_held_before_it_is_brought_back(arm: Bench) -> None:
    torque: list[bool] = []
    arm.robot.bus = SimpleNamespace(  # type: ignore[attr-defined]
        disable_torque=lambda: torque.append(False), enable_torque=lambda: torque.append(True)
    )
    arm.session.can_free = True
    arm.session.learning("")
    arm.do(Event.FREE)
    arm.soon(lambda: torque == [False])
    sent, read, off = len(arm.goals), arm.robot.get_observation, [60.0]

    def moved() -> dict[str, float]:
        raw = read()
        return {**raw, "elbow.pos": raw["elbow.pos"] + off[0]}

    arm.robot.get_observation = moved  # type: ignore[method-assign]
    arm.do(Event.FREE)
    arm.soon(arm.is_state(State.FAULTED))
    arm.clock.sleep(2.0)
    assert "bring it back by hand" in arm.session.fault  # for as long as it is there
    assert (torque, len(arm.goals), arm.session.free) == ([False], sent, True)
    off[0] = 0.0
    arm.soon(arm.is_state(State.RESETTING))
    assert arm.session.free
    arm.do(Event.FREE)
    arm.soon(lambda: torque == [False, True])
    assert np.abs(arm.goals[-1][:6] - arm.joints).max() < 0.5
