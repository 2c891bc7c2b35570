"""gym_hil's simulation behind our interface: pictures, operator, ends and actions."""

import numpy as np
import pytest

pytest.importorskip("gym_hil")

from cqn_train.envs.hil import HilSim
from lerobot_cqn.errors import ConfigError


@pytest.fixture(scope="module")
def cube():
    env = HilSim()
    yield env
    env.close()


def play(env, operator, seed, limit=100):
    """One episode by the operator: steps, pauses, and the last step's reward, end and info."""
    env.reset(seed=seed)
    operator.reset(seed)
    steps = pauses = 0
    terminated = False
    while not terminated and steps < limit:
        steps += 1
        action = operator.act()
        assert env.action_space.contains(action)
        assert not (operator.pausing and action[:3].any())
        pauses += operator.pausing
        _, reward, terminated, truncated, info = env.step(action)
        assert not truncated
        assert info["is_success"] is bool(reward)
    return steps, pauses, reward, terminated, info


def test_pictures_show_the_cube():
    env = HilSim(obs_type="pixels", cameras=["front"], image_size=64)
    try:
        one, _ = env.reset(seed=0)
        other, _ = env.reset(seed=1)
        assert (one["pixels"]["front"] != other["pixels"]["front"]).any(axis=-1).sum() > 10
        assert env.render().shape == (360, 480, 3)
    finally:
        env.close()


def test_fixed_position():
    env = HilSim(random_position=False)
    places = [env.reset(seed=seed)[0]["environment_state"] for seed in range(3)]
    assert np.array_equal(places[0], places[1])
    assert np.array_equal(places[1], places[2])


def test_the_operator_picks_the_cube(cube):
    operator = cube.scripted_teleoperator()
    for seed in range(5):
        steps, pauses, reward, terminated, info = play(cube, operator, seed)
        assert (reward, terminated, info["is_success"], pauses) == (1.0, True, True, 0)
        assert steps < 40


def test_the_operator_pauses_as_asked_and_still_succeeds(cube):
    operator = cube.scripted_teleoperator(pause_share=0.45, seed=1)
    played = [play(cube, operator, seed) for seed in range(5)]
    assert all(info["is_success"] for *_, info in played)
    assert 0.25 < sum(p for _, p, *_ in played) / sum(s for s, *_ in played) < 0.6
    assert play(cube, operator, 3)[:2] == played[3][:2]
    with pytest.raises(ConfigError, match=r"pause_share is 0\.95"):
        cube.scripted_teleoperator(pause_share=0.95)


@pytest.mark.slow
def test_the_operator_arranges_the_boxes():
    env = HilSim(task="arrange_boxes")
    assert play(env, env.scripted_teleoperator(), 0, limit=500)[4]["is_success"]


def test_leaving_the_bounds_is_a_failure(cube):
    cube.reset(seed=0)
    cube._sim.data.joint("block").qpos[:3] = 0.3, 0.25, 0.02
    _, reward, terminated, _, info = cube.step(np.zeros(4, np.float32))
    assert (reward, terminated, info) == (0.0, True, {"is_success": False})


def test_actions_move_the_target_and_close_the_gripper(cube):
    cube.reset(seed=0)
    before = cube.target
    cube.step(np.array([1.0, -1.0, 5.0, 1.0]))
    assert cube.target - before == pytest.approx([0.025, -0.025, 0.025])
    assert cube.closure == 1.0
    cube.step(np.array([0.0, 0.0, 0.0, 0.25]))
    assert cube.closure == pytest.approx(0.25)
