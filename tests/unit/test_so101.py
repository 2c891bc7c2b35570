"""The simulated SO-101 behind our interface: its own controller as the operator, ends, actions and what it gives."""

import numpy as np
import pytest

pytest.importorskip("lerobot_env_so101")

from lerobot_env_so101 import SO101PickPlaceGymEnv

from cqn_train.envs.so101 import So101Sim
from cqn_train.envs.so101_config import So101SimEnv
from lerobot_cqn.errors import ConfigError


@pytest.fixture(scope="module")
def sim():
    env = So101Sim()
    yield env
    env.close()


def play(env, operator, seed, limit=200):
    """One episode by the operator: steps, pauses, and whether it succeeded."""
    env.reset(seed=seed)
    operator.reset(seed)
    for step in range(1, limit):
        action = operator.act()
        assert env.action_space.contains(action)
        assert not (operator.pausing and action[:3].any())
        yield step, operator.pausing, action
        _, reward, terminated, _, info = env.step(action)
        assert info["is_success"] is bool(reward)
        if terminated:
            assert info["is_success"]
            return
    pytest.fail("the operator did not get there")


def test_the_operator_succeeds_with_and_without_pauses(sim):
    for share, least, most in ((0.0, 0.0, 0.0), (0.45, 0.25, 0.6)):
        operator = sim.scripted_teleoperator(share, 1)
        pausing = [paused for seed in range(5) for _, paused, _ in play(sim, operator, seed)]
        assert least <= np.mean(pausing) <= most
    with pytest.raises(ConfigError, match=r"pause_share is 0\.95"):
        sim.scripted_teleoperator(pause_share=0.95)


def test_a_pause_moves_nothing_and_leaves_the_jaws(sim):
    operator, before = sim.scripted_teleoperator(0.6, 2), None
    for _, pausing, action in play(sim, operator, 4):
        if pausing and before is not None:
            assert action[3] == pytest.approx(before[3], abs=1e-6)
        before = action


def test_state_and_success_are_the_package_s_own(sim):
    observation, _ = sim.reset(seed=7)
    native = SO101PickPlaceGymEnv(random_block_position=True, action_scale=0.02)
    theirs, _ = native.reset(seed=int(np.random.Generator(np.random.PCG64(7)).integers(2**32)))
    for name, value in theirs.items():
        np.testing.assert_array_equal(observation[name], value)
    for action in sim.action_space.sample() * np.ones((5, 1), np.float32):
        np.testing.assert_array_equal(sim.step(action)[0]["agent_pos"], native.step(action)[0]["agent_pos"])


def test_movements_are_steps_of_the_given_size_and_are_clipped():
    env = So101Sim(step_size=0.01, random_position=False)
    env.reset(seed=0)
    before = env._sim._target_ee_pos.copy()
    env.step(np.array([5.0, -1.0, 0.0, 1.0]))
    # The first movement begins where the arm is, which sags below where it was sent: x and y alone.
    assert (env._sim._target_ee_pos - before)[:2] == pytest.approx([0.01, -0.01], abs=2e-3)
    assert env.opening == pytest.approx(1.0)


def test_the_cube_off_the_table_ends_it_as_a_failure(sim):
    sim.reset(seed=0)
    sim._sim.data.joint("block").qpos[:2] = 0.25, 0.35
    _, reward, terminated, _, info = sim.step(np.zeros(4, np.float32))
    assert (reward, terminated, info) == (0.0, True, {"is_success": False})


def test_pictures_show_the_cube_and_leave_its_place_out():
    env = So101Sim(obs_type="pixels", image_size=96)
    try:
        one, _ = env.reset(seed=0)
        other, _ = env.reset(seed=1)
        assert env.environment_state_names == ["goal.x", "goal.y", "goal.z"]
        assert (one["pixels"]["front"] != other["pixels"]["front"]).any(axis=-1).sum() > 10
        np.testing.assert_allclose(other["environment_state"], env.places()[2], atol=1e-6)
    finally:
        env.close()


@pytest.mark.parametrize(("given", "message"), [({"step_size": 0.0}, "step_size is 0"), ({"fps": 20}, "fps is 20")])
def test_settings_are_checked(given, message):
    with pytest.raises(ConfigError, match=message):
        So101SimEnv(**given)
