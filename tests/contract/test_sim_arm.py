"""The simulated arm and its leader through LeRobot's commands, in real time and faster."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from lerobot.robots import make_robot_from_config
from lerobot.teleoperators import make_teleoperator_from_config

from cqn_train.envs.ur5e_station.ur5e import HOME
from cqn_train.sim_arm import FAULTS, Fault, SimLeaderConfig, SimUR5eConfig
from cqn_train.sim_arm.sim_ur5e import SimUR5e, from_robot_units, to_robot_units
from cqn_train.sim_arm.world import WORLDS
from lerobot_cqn.errors import ConfigError

from ..driven_clock import DrivenClock

pytest.importorskip("mujoco")
PAN = np.array([1.0, 0, 0, 0, 0, 0])


@pytest.fixture
def clock() -> DrivenClock:
    return DrivenClock()


@pytest.fixture
def arm(clock: DrivenClock) -> Iterator[SimUR5e]:
    robot = make_robot_from_config(
        SimUR5eConfig(camera_names=["upper_wrist"], image_height=32, image_width=48, speed=5)
    )
    robot.clock = clock
    robot.connect()
    yield robot
    if robot.is_connected:
        robot.disconnect()


def goal(robot: SimUR5e, **changes: float) -> dict[str, float]:
    now = {name: value for name, value in robot.get_observation().items() if name in robot.action_features}
    return {**now, **{f"{name}.pos": value for name, value in changes.items()}}


def test_units_are_degrees_and_percent() -> None:
    spoken = to_robot_units(np.array(HOME), 0.25)
    assert spoken["shoulder_pan.pos"] == pytest.approx(np.degrees(HOME[0]))
    assert spoken["gripper.pos"] == 25
    joints, closure = from_robot_units(spoken)
    assert joints == pytest.approx(HOME)
    assert closure == 0.25


def test_it_gives_what_its_features_say_and_goes_where_it_is_sent(arm: SimUR5e) -> None:
    observation = arm.get_observation()
    assert observation.keys() == arm.observation_features.keys()
    assert observation["upper_wrist"].shape == (32, 48, 3)
    assert observation["upper_wrist"].dtype == np.uint8
    target = goal(arm, shoulder_pan=observation["shoulder_pan.pos"] + 8, gripper=100)
    assert arm.send_action(target) == pytest.approx(target)
    reached = lambda: abs(arm.get_observation()["shoulder_pan.pos"] - target["shoulder_pan.pos"]) < 0.5  # noqa: E731
    assert arm.world.until(reached, 5)


def test_time_passes_whether_it_is_asked_or_not(arm: SimUR5e, clock: DrivenClock) -> None:
    arm.get_observation()
    before = arm.world.now
    clock.sleep(0.2)
    arm.get_observation()
    assert 0.9 < arm.world.now - before < 2.5  # at five times the speed


def test_the_scene_is_laid_out_anew_at_home(arm: SimUR5e) -> None:
    world = arm.world
    first = world.scenes
    assert world.until(lambda: world.now > 1, 5)
    assert world.scenes == first  # it has not been away
    away = np.array(HOME) + 0.4 * PAN
    assert world.until(lambda: (world.command(away, 0.0), world.away)[1], 10)
    assert world.until(lambda: (world.command(np.array(HOME), 0.0), world.scenes > first)[1], 10)
    assert not world.away


def test_what_is_not_connected_says_so() -> None:
    robot = make_robot_from_config(SimUR5eConfig())
    for call in (robot.get_observation, lambda: robot.send_action({}), robot.disconnect):
        with pytest.raises(ConnectionError, match="not connected"):
            call()
    leader = make_teleoperator_from_config(SimLeaderConfig())
    with pytest.raises(ConnectionError, match="not connected"):
        leader.get_action()
    leader.connect()
    with pytest.raises(ConfigError, match=r"Unknown world 'default'.*Connect --robot.type=sim_ur5e"):
        leader.get_action()


def test_two_arms_need_two_worlds(arm: SimUR5e) -> None:
    with pytest.raises(ConfigError, match=r"give another --robot\.world"):
        make_robot_from_config(SimUR5eConfig()).connect()
    other = make_robot_from_config(SimUR5eConfig(world="other", camera_names=[]))
    other.connect()
    other.disconnect()
    assert list(WORLDS) == ["default"]


@pytest.mark.parametrize("kind", ["disconnect", "error"])
def test_faults_of_reading(arm: SimUR5e, kind: str) -> None:
    now = arm.world.now
    arm.config.faults = [Fault(kind, now, 0.5)]
    with pytest.raises(RuntimeError if kind == "error" else ConnectionError, match=f"injected fault '{kind}'"):
        arm.get_observation()
    arm.world.until(lambda: arm.world.now > now + 0.5, 5)
    assert arm.get_observation()


def test_faults_of_sending_and_of_sensors(arm: SimUR5e) -> None:
    seen, now = arm.get_observation(), arm.world.now
    arm.config.faults = [Fault(kind, now) for kind in ("send_error", "frozen_camera", "frozen_joints", "nan")]
    with pytest.raises(ConnectionError, match="send_error"):
        arm.send_action(goal(arm, elbow=0.0))
    arm.world.command(np.array(HOME) + 0.2 * PAN, 1.0)
    arm.world.until(lambda: arm.world.now > now + 1, 5)
    later = arm.get_observation()
    assert np.isnan(later["shoulder_pan.pos"])
    assert later["elbow.pos"] == seen["elbow.pos"]
    assert np.array_equal(later["upper_wrist"], seen["upper_wrist"])


def test_a_stuck_joint_stays_and_a_delay_delays(arm: SimUR5e, clock: DrivenClock) -> None:
    before = arm.get_observation()
    arm.config.faults = [Fault("stuck_joint", 0, amount=2)]
    for _ in range(20):
        arm.send_action(goal(arm, elbow=before["elbow.pos"] + 10, shoulder_pan=before["shoulder_pan.pos"] + 5))
        clock.sleep(0.02)
    after = arm.get_observation()
    assert after["elbow.pos"] == pytest.approx(before["elbow.pos"], abs=1)
    assert after["shoulder_pan.pos"] > before["shoulder_pan.pos"] + 3
    arm.config.faults = [Fault("delay", 0, amount=0.3)]
    begun = clock.now = 200.0  # 0.3 s after a round moment is not a little less
    arm.get_observation()
    assert clock.now - begun >= 0.3


@pytest.mark.parametrize(("settings", "said"), [
    ({"task": "click_buton"}, "Did you mean 'click_button'?"), ({"speed": 0}, "speed is 0"),
    ({"camera_names": ["top"]}, "Unknown camera 'top'"), ({"image_width": 8}, "image_width is 8"),
])  # fmt: skip
def test_wrong_settings(settings: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(said)):
        SimUR5eConfig(**settings)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="Unknown fault"):
        Fault("smoke", 0)
    assert len(FAULTS) == 8


@pytest.mark.real_time(reason="lerobot-record keeps its rate by the machine's own clock")
def test_lerobot_record_mirrors_the_leader(recorded_arm: Path) -> None:
    """As a person at the terminal: ends the episode when the task is done, and the reset when the arm is home."""
    rows = pd.concat([pd.read_parquet(file) for file in sorted(recorded_arm.glob("data/**/*.parquet"))])
    lengths = rows.groupby("episode_index").size()
    assert len(lengths) == 3
    assert (lengths > 15).all()
    assert (lengths < 300).all()
    state, action = (np.stack(rows[name].to_numpy()) for name in ("observation.state", "action"))
    assert state.shape[1] == 7 + 3
    assert action.shape[1] == 7
    # The arm follows the leader: where it is sent is where it is a few steps later, and it travels far.
    first = (rows["episode_index"] == 0).to_numpy()
    assert np.median(np.abs(action[first][:-4, :6] - state[first][4:, :6])) < 3  # degrees
    assert np.ptp(action[first][:, :6], axis=0).max() > 5
