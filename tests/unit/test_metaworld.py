"""Meta-World's tasks behind our interface: objects where they are, experts that succeed, upright pictures."""

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("metaworld")

from cqn_train.envs import MetaworldSparseEnv
from cqn_train.envs.metaworld_config import CAMERAS, TASKS, state_size
from cqn_train.envs.simulator import load_mujoco
from lerobot_cqn.errors import ConfigError

from .test_envs import TWENTY


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


def test_a_task_may_leave_out_its_version_and_the_horizon_goes_with_the_rate():
    short, full = MetaworldSparseEnv(task="drawer-open"), MetaworldSparseEnv(task="drawer-open-v3")
    assert short == full
    assert short.task == "drawer-open-v3"
    assert short.max_episode_steps == 100
    assert MetaworldSparseEnv(fps=80).max_episode_steps == 400
    assert MetaworldSparseEnv(episode_length=7).max_episode_steps == 7
    assert [tuple(f.shape) for f in MetaworldSparseEnv(task="hammer").features.values()] == [(4,), (4,), (17,)]
