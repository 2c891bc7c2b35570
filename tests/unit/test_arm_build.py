"""What an arm may do follows from the demonstrations: limits, home, and whether the robot is the right one."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_pre_post_processors
from lerobot.robots.config import RobotConfig
from lerobot.robots.utils import make_robot_from_config

from cqn_train.agent import Agent
from cqn_train.arm.build import _check_home, check_commands, check_robot_fits, home_of, limits_of
from cqn_train.arm.devices import register_devices
from cqn_train.config import DatasetSettings
from cqn_train.replay.demonstrations import Demonstrations
from cqn_train.robot.limits import Limits
from cqn_train.robot.settings import ArmSettings
from lerobot_cqn.configuration_cqn import CQNConfig
from lerobot_cqn.errors import ConfigError
from lerobot_cqn.modeling_cqn import CQNPolicy

from .test_joint_goals import ACTION_NAMES, STATE_NAMES, entry, history

FPS = 10
STATE = {
    "min": [-90.0, -5.0, 0.0, 0.0, 20.0],  # pan, button, lift, gripper, wrist
    "max": [90.0, 5.0, 40.0, 100.0, 20.0],
}
DELTAS = {"min": [-4.0, -1.0, 10.0, 0.0], "max": [2.0, 3.0, 90.0, 0.0]}  # pan, lift, gripper, wrist
GOALS = {"min": [-100.0, 5.0, 0.0, 20.0], "max": [80.0, 45.0, 90.0, 20.0]}


def robot(**changes: Any) -> Any:
    """A robot with the joints of the dataset, a value of the scene, and a camera."""
    features = {**dict.fromkeys(STATE_NAMES, float), "wrist": (84, 84, 3)}
    parts = {"action_features": dict.fromkeys(ACTION_NAMES, float), "observation_features": features}
    return SimpleNamespace(**{**parts, **changes})


def agent(root: Path, action: dict[str, Any], *, deltas: bool, state: Any = STATE, inputs: Any = None) -> Agent:
    """A policy of the toy arm, whose statistics are those of its demonstrations."""
    given = {"observation.state": PolicyFeature(FeatureType.STATE, (len(STATE_NAMES),))} if inputs is None else inputs
    config = CQNConfig(
        preset="laptop_state", device="cpu", hidden_dim=8, feature_dim=4, encoder_channels=(4,), input_features=given,
        output_features={"action": PolicyFeature(FeatureType.ACTION, (len(ACTION_NAMES),))},
    )  # fmt: skip
    stats = {key: {n: np.array(v) for n, v in values.items()} for key, values in (("action", action),)}
    if state is not None:
        stats["observation.state"] = {name: np.array(values) for name, values in state.items()}
    meta = history(root, entry("delta", "command")) if deltas else None
    pre, post = make_pre_post_processors(config, dataset_stats=stats, dataset_meta=meta)
    return Agent(CQNPolicy(config), pre, post)


def test_limits_of_joint_differences(tmp_path: Path) -> None:
    made = limits_of(
        robot(), agent(tmp_path, DELTAS, deltas=True), ArmSettings(joint_margin=0.1, step_factor=1.5), FPS, FPS
    )
    # Seen joints and the goals from them, with a tenth of that range on each side.
    assert made.low == pytest.approx([-94 - 18.6, -1 - 4.4, -10, 20])
    assert made.high == pytest.approx([92 + 18.6, 43 + 4.4, 110, 20])
    assert made.max_step[:2] == pytest.approx([6.0, 4.5])
    assert made.max_speed == pytest.approx(FPS * made.max_step)
    # A joint that never moved stays where it was, and has the steps to hold itself there against gravity.
    assert made.max_step[3] == pytest.approx(0.6)


@pytest.mark.parametrize("deltas", [True, False])
def test_a_higher_rate_than_the_demonstrations_shortens_the_steps(tmp_path: Path, deltas: bool) -> None:
    known = agent(tmp_path, DELTAS if deltas else GOALS, deltas=deltas)
    usual = limits_of(robot(), known, ArmSettings(), FPS, FPS)
    faster, slower = (limits_of(robot(), known, ArmSettings(), fps, FPS) for fps in (4 * FPS, FPS // 2))
    assert faster.max_step[:2] == pytest.approx(usual.max_step[:2] / 4)
    assert faster.max_speed[:2] == pytest.approx(usual.max_speed[:2])
    assert slower.max_step == pytest.approx(usual.max_step)  # and half the speed
    assert slower.max_speed == pytest.approx(usual.max_speed / 2)


def test_limits_of_absolute_goals(tmp_path: Path) -> None:
    made = limits_of(
        robot(), agent(tmp_path, GOALS, deltas=False), ArmSettings(joint_margin=0, step_factor=2), FPS, FPS
    )
    assert made.low[:3] == pytest.approx([-100, 0, 0])
    assert made.high[:3] == pytest.approx([90, 45, 100])
    assert made.max_step[:2] == pytest.approx([0.1 * 190, 0.1 * 45])  # a twentieth of the range, twice
    assert made.max_step[2] == pytest.approx(100)  # a gripper may close at once


def test_what_is_given_replaces_what_was_seen(tmp_path: Path) -> None:
    settings = ArmSettings(joint_limits={"lift.pos": [-7.0, 8.0]}, joint_margin=0)
    made = limits_of(robot(), agent(tmp_path, DELTAS, deltas=True), settings, FPS, FPS)
    assert (made.low[1], made.high[1]) == (-7, 8)
    assert (made.low[0], made.high[0]) == (-94, 92)


@pytest.mark.parametrize("given", [[-100_000.0, 100_000.0], [-7.0, 5000.0], [-5000.0, 8.0]])
def test_limits_far_beyond_what_was_demonstrated_are_refused(tmp_path: Path, given: list[float]) -> None:
    settings = ArmSettings(joint_limits={"lift.pos": given})
    with pytest.raises(ConfigError, match=r"--arm\.joint_limits of 'lift\.pos'.*Is it in another unit"):
        limits_of(robot(), agent(tmp_path, DELTAS, deltas=True), settings, FPS, FPS)


def test_joints_nobody_knows_are_named(tmp_path: Path) -> None:
    known = agent(tmp_path, DELTAS, deltas=True)
    for settings in (ArmSettings(joint_limits={"lft.pos": [0, 1]}), ArmSettings(home={"lft.pos": 1})):
        with pytest.raises(ConfigError, match=r"Unknown joint 'lft\.pos'.*Did you mean 'lift\.pos'"):
            limits_of(robot(), known, settings, FPS, FPS)
    blind = agent(
        tmp_path, DELTAS, deltas=True, state=None,
        inputs={"observation.images.wrist": PolicyFeature(FeatureType.VISUAL, (3, 84, 84))},
    )  # fmt: skip
    with pytest.raises(ConfigError, match=r"No range of 'pan\.pos'.*give --arm\.joint_limits"):
        limits_of(robot(), blind, ArmSettings(), FPS, FPS)


def test_a_workspace_needs_kinematics(tmp_path: Path) -> None:
    known = agent(tmp_path, DELTAS, deltas=True)
    settings = ArmSettings(workspace=[0, 1, -1, 1, 0.1, 0.9])
    with pytest.raises(ConfigError, match=r"give --arm\.urdf=FILE"):
        limits_of(robot(), known, settings, FPS, FPS)
    own = robot(tip_position=lambda joints: [joints["pan.pos"], 0.0, joints["wrist.pos"]])
    made = limits_of(own, known, settings, FPS, FPS)
    assert made.box is not None
    assert made.forward is not None
    assert (made.box[0].tolist(), made.box[1].tolist()) == ([0, -1, 0.1], [1, 1, 0.9])
    assert made.forward(np.array([0.3, 0.0, 0.0, 0.7])).tolist() == [0.3, 0.0, 0.7]
    lost = ArmSettings(workspace=[0, 1, -1, 1, 0.1, 0.9], urdf=str(tmp_path / "none.urdf"))
    with pytest.raises(ConfigError, match=r"--arm\.urdf=.*none\.urdf cannot be used"):
        limits_of(robot(), known, lost, FPS, FPS)


# -- home ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory: pytest.TempPathFactory) -> DatasetSettings:
    """Three episodes that start at pan 1, 2, 30, and move away from there."""
    root = tmp_path_factory.mktemp("arm_parts") / "data"
    features: dict[str, Any] = {
        "action": {"dtype": "float32", "shape": (4,), "names": ACTION_NAMES},
        "observation.state": {"dtype": "float32", "shape": (5,), "names": STATE_NAMES},
    }
    dataset = LeRobotDataset.create("local/arm", fps=FPS, features=features, root=root, use_videos=False)
    for pan in (1, 2, 30):
        for step in range(3):
            state = np.array([pan, 0, 10, 50, 20], np.float32) + 100 * step
            dataset.add_frame({"action": np.zeros(4, np.float32), "observation.state": state, "task": "Press."})
        dataset.save_episode()
    dataset.finalize()
    return DatasetSettings("local/arm", str(root))


def test_home_is_where_the_demonstrations_start(demonstrations: DatasetSettings) -> None:
    assert home_of(Demonstrations(demonstrations).first_states(), robot(), ArmSettings()).tolist() == [2, 10, 50, 20]
    given = ArmSettings(home={"gripper.pos": 0.0})
    assert home_of(Demonstrations(demonstrations).first_states(), robot(), given).tolist() == [2, 10, 0, 20]
    some = DatasetSettings("local/arm", demonstrations.root, [2])
    assert home_of(Demonstrations(some).first_states(), robot(), ArmSettings()).tolist() == [30, 10, 50, 20]


def test_home_must_be_known_for_every_joint() -> None:
    everything = {name: float(i) for i, name in enumerate(ACTION_NAMES)}
    assert home_of(None, robot(), ArmSettings(home=everything)).tolist() == [0, 1, 2, 3]
    with pytest.raises(ConfigError, match=r"Where is home for 'lift\.pos'\?.*--arm\.home='\{lift\.pos: 0\}'"):
        home_of(None, robot(), ArmSettings(home={"pan.pos": 1.0}))


def test_a_home_that_limits_keep_the_arm_from_is_refused() -> None:
    limits = Limits(low=np.zeros(4), high=np.full(4, 10.0), max_step=np.ones(4), max_speed=np.ones(4))
    _check_home(None, tuple(ACTION_NAMES), limits)
    _check_home(np.array([0.0, 10.0, 5.0, 3.0]), tuple(ACTION_NAMES), limits)
    with pytest.raises(ConfigError, match=r"Home of 'lift\.pos' is 12, its limits are 0 to 10"):
        _check_home(np.array([0.0, 12.0, 5.0, 3.0]), tuple(ACTION_NAMES), limits)


# -- the right robot -------------------------------------------------------------------------------------------------


def test_the_robot_of_the_demonstrations_fits(tmp_path: Path) -> None:
    both = {
        "observation.state": PolicyFeature(FeatureType.STATE, (5,)),
        "observation.images.wrist": PolicyFeature(FeatureType.VISUAL, (3, 84, 84)),
    }
    check_robot_fits(robot(), agent(tmp_path, DELTAS, deltas=True, inputs=both))


@pytest.mark.parametrize(("changes", "said"), [
    ({"observation_features": {**dict.fromkeys(STATE_NAMES, float), "wirst": (8, 8, 3)}}, "Did you mean 'wirst'"),
    ({"observation_features": {**dict.fromkeys(STATE_NAMES[:4], float), "wrist": (8, 8, 3)}},
     "policy's state has 5 values, the robot's 4"),
    ({"action_features": dict.fromkeys(ACTION_NAMES[:3], float)}, "policy's action has 4 values, the robot takes 3"),
])  # fmt: skip
def test_another_robot_is_refused(changes: dict[str, Any], said: str, tmp_path: Path) -> None:
    both = {
        "observation.state": PolicyFeature(FeatureType.STATE, (5,)),
        "observation.images.wrist": PolicyFeature(FeatureType.VISUAL, (3, 84, 84)),
    }
    with pytest.raises(ConfigError, match=said):
        check_robot_fits(robot(**changes), agent(tmp_path, DELTAS, deltas=True, inputs=both))


@pytest.mark.parametrize(
    ("kind", "settings", "said"),
    [
        ("so101_follower", {"port": "/dev/none"}, ""),
        (
            "lekiwi_client",
            {"remote_ip": "127.0.0.1"},
            "takes x.vel, y.vel, theta.vel, by their names no positions",
        ),
        ("lekiwi", {}, "lekiwi takes x.vel, y.vel, theta.vel"),
        ("earthrover_mini_plus", {}, "takes linear_velocity, angular_velocity"),
    ],
)
def test_lerobots_robots_that_drive_are_refused_by_name(kind: str, settings: dict[str, Any], said: str) -> None:
    """A hold would go on with the last velocity."""
    if kind.startswith("lekiwi"):
        pytest.importorskip("zmq")
    pytest.importorskip("scservo_sdk")
    register_devices()
    made = make_robot_from_config(RobotConfig.get_choice_class(kind)(**settings))
    if not said:
        check_commands(made)
        return
    with pytest.raises(ConfigError, match=said):
        check_commands(made)


def test_a_joint_that_is_moved_unread_is_refused_by_name() -> None:
    """As a third party's simulated arm has it: `gripper.value` is commanded, `gripper.pos` is read."""
    names = dict.fromkeys(("lift.pos", "gripper.pos"), float)
    arm = robot(action_features=dict.fromkeys(("lift.pos", "gripper.value"), float), observation_features=names)
    arm.name = "hex"
    with pytest.raises(ConfigError, match=r"hex takes gripper.value, but its observation has only lift.pos, g"):
        check_commands(arm)


def test_what_only_a_simulator_gives_is_refused(tmp_path: Path) -> None:
    inputs = {
        "observation.state": PolicyFeature(FeatureType.STATE, (5,)),
        "observation.environment_state": PolicyFeature(FeatureType.ENV, (3,)),
    }
    with pytest.raises(ConfigError, match="which only a simulator gives"):
        check_robot_fits(robot(), agent(tmp_path, DELTAS, deltas=True, inputs=inputs))
