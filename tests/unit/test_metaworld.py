"""Meta-World's tasks behind our interface: the twenty of the benchmark, each for a few steps, and the rest by size."""

import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("metaworld")

from cqn_train.envs import MetaworldSparseEnv
from cqn_train.envs.cameras import Cameras
from cqn_train.envs.metaworld_config import CAMERAS, TASKS, state_size
from cqn_train.envs.simulator import load_mujoco
from lerobot_cqn.errors import ConfigError, DataError

TWENTY = [
    "assembly", "button-press", "button-press-topdown", "dial-turn", "door-close", "door-open", "door-unlock",
    "drawer-open", "faucet-close", "faucet-open", "handle-press", "handle-pull", "peg-unplug-side", "pick-place",
    "plate-slide", "push", "shelf-place", "sweep", "window-close", "window-open",
]  # fmt: skip


@pytest.fixture
def make():
    opened = []

    def _make(task="drawer-open", **kwargs):
        env = gym.make(MetaworldSparseEnv(task=task).gym_id, **kwargs)
        opened.append(env)
        return env

    yield _make
    for env in opened:
        env.close()


def play(env, operator, seed):
    """One episode by the operator: (steps, pauses, success, actions)."""
    env.reset(seed=seed)
    operator.reset(seed)
    actions, pauses, over, info = [], 0, False, {}
    while not over:
        actions.append(operator.act())
        pauses += operator.pausing
        assert env.action_space.contains(actions[-1])
        _, reward, terminated, truncated, info = env.step(actions[-1])
        assert (reward, terminated) == (float(info["is_success"]), info["is_success"])
        over = terminated or truncated
    return len(actions), pauses, info["is_success"], np.stack(actions)


def walk(env, seed):
    """Observations of a reset and three steps, (4, S)."""
    observations = [env.reset(seed=seed, options={"lerobot_new_rollout": True})[0]]
    actions = np.array([[1, 0, -1, 1], [0, 1, 0, -1], [0.3, -0.2, -0.5, 0]], np.float32)
    observations.extend(env.step(action)[0] for action in actions)
    for observation in observations:
        assert env.observation_space.contains(observation)
    return np.stack([np.append(o["agent_pos"], o["environment_state"]) for o in observations])


@pytest.mark.parametrize("task", TWENTY)
def test_an_episode_is_a_function_of_its_seed(make, task):
    env = make(task)
    first = walk(env, 3)
    assert first.shape == (4, 4 + state_size(task))
    assert len(env.unwrapped.environment_state_names) == state_size(task)
    assert env.reset(seed=4)[1] == {"is_success": False}
    env.action_space.seed(0)
    for _ in range(5):
        _, reward, terminated, _, info = env.step(env.action_space.sample())
        assert (reward, terminated) == (float(info["is_success"]), info["is_success"])
    np.testing.assert_array_equal(walk(env, 3), first)
    # Without a seed the stream goes on, and the scene is another one.
    again = env.reset()[0]["environment_state"]
    assert np.abs(again - first[0, 4:]).max() > 1e-3


@pytest.mark.parametrize("task", TWENTY)
def test_what_is_observed_at_the_start_is_where_things_are(make, task):
    env = make(task)
    simulator = env.unwrapped.simulator
    mujoco = load_mujoco()
    for seed in range(2):
        observed = env.reset(seed=seed)[0]["environment_state"]
        mujoco.mj_forward(simulator.model, simulator.data)
        frame = simulator._get_curr_obs_combined_no_goal().astype(np.float32)
        np.testing.assert_array_equal(observed[:-3], frame[4 : 4 + len(observed) - 3])
        np.testing.assert_array_equal(observed[-3:], simulator._get_pos_goal().astype(np.float32))


def test_the_goal_belongs_to_the_place_of_the_object(make):
    env = make("drawer-open")
    states = [env.reset(seed=seed)[0]["environment_state"] for seed in range(4)]
    assert np.ptp([state[0] for state in states]) > 0.02
    for state in states:
        np.testing.assert_allclose(state[-3:] - state[:3], [0, -0.19, 0], atol=1e-3)
    env = make("button-press")
    for seed in range(4):
        env.reset(seed=seed)
        simulator = env.unwrapped.simulator
        np.testing.assert_allclose(simulator._target_pos, simulator._get_site_pos("hole"), atol=1e-6)


def test_the_table_of_tasks_is_meta_worlds():
    from metaworld.policies import ENV_POLICY_MAP

    assert {f"{task}-v3" for task in TASKS} == set(ENV_POLICY_MAP)
    assert set(TWENTY) <= set(TASKS)


@pytest.mark.parametrize("task", ["drawer-open", "hammer", "pick-place", "stick-pull", "stick-push"])
def test_the_state_has_a_pose_for_each_object(make, task):
    simulator = make(task).unwrapped.simulator
    assert len(simulator._get_pos_objects()) + len(simulator._get_quat_objects()) + 3 == state_size(task)


@pytest.mark.parametrize("task", ["drawer-open", "button-press", "pick-place", "peg-unplug-side"])
def test_the_expert_succeeds(make, task):
    env = make(task)
    operator = env.unwrapped.scripted_teleoperator()
    for seed in range(2):
        steps, pauses, success, _ = play(env, operator, seed)
        assert success
        assert steps < 50
        assert pauses == 0


@pytest.mark.parametrize("fps", [10, 80])
def test_the_expert_succeeds_at_other_rates(make, fps):
    env = make("peg-unplug-side", fps=fps, max_episode_steps=5 * fps)
    assert play(env, env.unwrapped.scripted_teleoperator(), 0)[2]


def test_pauses_take_their_share_stand_still_and_repeat_themselves(make):
    env = make("door-unlock", max_episode_steps=400)
    operator = env.unwrapped.scripted_teleoperator(pause_share=0.45)
    results = [play(env, operator, seed) for seed in range(16)]
    assert all(success for _, _, success, _ in results)
    steps, pauses = (sum(result[i] for result in results) for i in (0, 1))
    assert pauses / steps == pytest.approx(0.45, abs=0.12)
    for _, paused, _, actions in results:
        assert paused <= (~actions[:, :3].any(axis=1)).sum()
    np.testing.assert_array_equal(play(env, operator, 3)[3], results[3][3])


def test_a_pause_keeps_the_gripper_as_it_was(make):
    env = make("pick-place", max_episode_steps=400)
    operator = env.unwrapped.scripted_teleoperator(pause_share=0.6)
    gripper, paused_closed = -1.0, False
    env.reset(seed=1)
    operator.reset(1)
    for _ in range(100):
        action = operator.act()
        if operator.pausing:
            assert not action[:3].any()
            assert action[3] == gripper
            paused_closed = paused_closed or gripper > 0
        gripper = action[3]
        if env.step(action)[2]:
            break
    assert paused_closed


@pytest.mark.parametrize("share", [-0.1, 1.0])
def test_wrong_shares_are_refused(make, share):
    with pytest.raises(ConfigError, match=r"expected 0 to 0\.9"):
        make().unwrapped.scripted_teleoperator(pause_share=share)


def test_actions_move_the_hand_and_are_clipped(make):
    env = make("reach")
    x = env.reset(seed=0)[0]["agent_pos"][0]
    for _ in range(3):
        observation, *_ = env.step(np.array([9, 0, 0, 0], np.float32))
    # Four simulator steps of a centimetre each; the hand follows a little later.
    assert 0.06 < observation["agent_pos"][0] - x < 0.125


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros(3), r"shape \(3,\): expected \(4,\), hand_x"),
        (np.zeros((1, 4)), r"shape \(1, 4\)"),
        (np.array([0, np.nan, 0, 0]), "not finite at 'hand_y'"),
    ],
)
def test_wrong_actions_are_refused_in_one_line(make, action, message):
    env = make()
    env.reset(seed=0)
    with pytest.raises(DataError, match=message) as error:
        env.unwrapped.step(action)
    assert "\n" not in str(error.value)


def test_the_time_limit_truncates_and_may_be_longer_than_meta_worlds_own(make):
    env = make(max_episode_steps=130)
    env.reset(seed=0)
    still = np.zeros(4, np.float32)
    ends = [env.step(still)[2:4] for _ in range(130)]  # 520 simulator steps
    assert ends == [(False, False)] * 129 + [(False, True)]


def test_cameras_show_different_upright_pictures(make):
    env = make("drawer-open", obs_type="pixels", cameras=list(CAMERAS))
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert set(observation) == {"agent_pos", "pixels"}
    pictures = list(observation["pixels"].values())
    for index, picture in enumerate(pictures):
        assert picture.shape == (84, 84, 3)
        assert picture.std() > 15
        for other in pictures[index + 1 :]:
            assert np.abs(picture.astype(int) - other).mean() > 5
    data = env.unwrapped.simulator.data
    for name in ("corner", "corner2", "corner3"):
        assert data.camera(name).xmat[7] > 0.1  # the picture's upward axis points up
    frame = env.render()
    assert frame.dtype == np.uint8
    assert frame.shape == (360, 480, 3)
    assert frame.mean() > 40


def test_state_mode_opens_no_graphics(make, monkeypatch):
    def refuse(*_):
        raise AssertionError

    monkeypatch.setattr(Cameras, "picture", refuse)
    env = make()
    env.reset(seed=0)
    env.step(np.zeros(4, np.float32))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"task": "drawer-opn"}, "Did you mean 'drawer-open'"),
        ({"task": None}, "Unknown Meta-World task ''"),
        ({"obs_type": "pixel"}, "Did you mean 'pixels'"),
        ({"cameras": ["corner4"]}, "Unknown camera"),
        ({"cameras": [], "obs_type": "both"}, "at least one"),
        ({"image_size": 8}, "16 to 1024"),
        ({"fps": 30}, "10, 20, 40 or 80"),
        ({"episode_length": 0}, "at least 1"),
    ],
)
def test_wrong_settings_are_refused_in_one_line(settings, message):
    with pytest.raises(ConfigError, match=message) as error:
        MetaworldSparseEnv(**settings)
    assert "\n" not in str(error.value)


def test_a_task_may_leave_out_its_version_and_the_horizon_goes_with_the_rate():
    short, full = MetaworldSparseEnv(task="drawer-open"), MetaworldSparseEnv(task="drawer-open-v3")
    assert short == full
    assert short.task == "drawer-open-v3"
    assert short.max_episode_steps == 100
    assert MetaworldSparseEnv(fps=80).max_episode_steps == 400
    assert MetaworldSparseEnv(episode_length=7).max_episode_steps == 7
    assert [tuple(f.shape) for f in MetaworldSparseEnv(task="hammer").features.values()] == [(4,), (4,), (17,)]


def test_a_fresh_process_imports_no_simulator_explains_its_absence_and_leaves_quietly():
    code = """
import sys
import cqn_train.envs
import gymnasium

name = cqn_train.envs.MetaworldSparseEnv().gym_id
assert not {"mujoco", "metaworld"} & set(sys.modules)
sys.modules["metaworld"] = None
try:
    gymnasium.make(name)
except Exception as error:
    print(type(error).__name__, error)
del sys.modules["metaworld"]
env = gymnasium.make(name, obs_type="pixels", cameras=["corner2"], image_size=32)
env.reset(seed=0)  # and no close
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    assert done.stdout.count("\n") == 1
    assert done.stdout.startswith("ConfigError")
    assert "pip install 'lerobot_policy_cqn[metaworld]'" in done.stdout
