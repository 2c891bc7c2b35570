"""The simulated arm between episodes: on its way home, started early, taken by hand."""

from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest

from cqn_train.operator.session import Event, State

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
