"""gym_hil's simulation behind our interface: seeded, headless, cheap to look at."""

import sys

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("gym_hil")

import mujoco

from cqn_train.envs import HilSimEnv
from cqn_train.envs.hil import HilSim
from lerobot_cqn.errors import ConfigError, DataError

MAKE = {name: gym.registry[f"cqn_hil/{name}-v0"] for name in ("pick_cube", "arrange_boxes")}


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


@pytest.mark.parametrize("task", MAKE)
@pytest.mark.parametrize("obs_type", ["state", "pixels", "both"])
def test_observations_fit_spaces_and_config(task, obs_type):
    config = HilSimEnv(task=task, obs_type=obs_type, image_size=32)
    env = gym.make(config.gym_id, **config.gym_kwargs)
    try:
        observation, info = env.reset(seed=0, options={"lerobot_new_rollout": True})
        assert env.observation_space.contains(observation)
        assert info == {"is_success": False}
        observation, reward, terminated, _, info = env.step(env.action_space.sample())
        assert env.observation_space.contains(observation)
        assert (reward, terminated, info["is_success"]) == (0.0, False, False)
        flat = {name: value.shape for name, value in observation.items() if name != "pixels"}
        flat |= {f"observation.images.{n}": p.shape for n, p in observation.get("pixels", {}).items()}
        assert {**flat, "action": env.action_space.shape} == {n: tuple(f.shape) for n, f in config.features.items()}
        plain = env.unwrapped
        assert (len(plain.state_names), len(plain.action_names)) == (18, 4)
        assert len(plain.environment_state_names) == {"pick_cube": 3, "arrange_boxes": 15}[task]
        assert env.spec.max_episode_steps == config.max_episode_steps
    finally:
        env.close()


def test_state_mode_opens_no_renderer(monkeypatch):
    monkeypatch.setattr(mujoco, "Renderer", lambda *_, **__: pytest.fail("a renderer was opened"))
    renderer = mujoco.Renderer
    env = HilSim(obs_type="state")
    assert mujoco.Renderer is renderer  # put back after gym_hil's own was kept from opening one
    env.reset(seed=0)
    env.step(np.zeros(4, np.float32))


def test_pictures_show_the_cube():
    env = HilSim(obs_type="pixels", cameras=["front"], image_size=64)
    try:
        one, _ = env.reset(seed=0)
        other, _ = env.reset(seed=1)
        assert (one["pixels"]["front"] != other["pixels"]["front"]).any(axis=-1).sum() > 10
        assert env.render().shape == (360, 480, 3)
    finally:
        env.close()


def test_an_episode_is_a_function_of_its_seed_and_numpy_is_left_alone(cube):
    def trace(seed):
        rng = np.random.default_rng(0)
        states = [cube.reset(seed=seed)[0]]
        states += [cube.step(rng.uniform(-1, 1, 4).astype(np.float32))[0] for _ in range(3)]
        return np.stack([np.concatenate(list(s.values())) for s in states])

    np.random.seed(3)
    expected = np.random.random()
    np.random.seed(3)
    first = trace(5)
    assert np.random.random() == expected
    np.random.seed(4)  # what others do to numpy's global state changes nothing
    assert np.array_equal(trace(5), first)
    assert not np.array_equal(trace(6), first)
    # Without a seed the stream goes on, and is itself determined.
    cube.reset(seed=5)
    a, b = (cube.reset()[0]["environment_state"] for _ in range(2))
    assert not np.array_equal(a, b)
    cube.reset(seed=5)
    assert np.array_equal(cube.reset()[0]["environment_state"], a)


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
    with pytest.raises(DataError, match=r"shape \(3,\): expected \(4,\)"):
        cube.step(np.zeros(3))
    with pytest.raises(DataError, match="not finite at 'gripper'"):
        cube.step(np.array([0.0, 0.0, 0.0, np.nan]))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"task": "pick_cub"}, "Did you mean 'pick_cube'"),
        ({"obs_type": "pixel"}, "Did you mean 'pixels'"),
        ({"cameras": ["top"], "obs_type": "pixels"}, "Unknown camera 'top'"),
        ({"image_size": 8}, "image_size is 8"),
        ({"fps": 20}, "fps is 20: expected 10"),
        ({"episode_length": 0}, "episode_length is 0"),
    ],
)
def test_wrong_settings_are_one_line(given, message):
    with pytest.raises(ConfigError, match=message) as raised:
        HilSimEnv(**given)
    assert "\n" not in str(raised.value)


def test_without_gym_hil_the_extra_is_named(monkeypatch):
    for name in [n for n in sys.modules if n.split(".")[0] == "gym_hil"]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ConfigError, match=r"pip install 'lerobot_policy_cqn\[hil\]'"):
        HilSim()
