"""The RLBench adapter, against a stand-in.

RLBench, PyRep and CoppeliaSim cannot be installed here (no package registry carries them). `fake_rlbench` stands in
for the part of their public interface that the adapter uses; it shows that the adapter makes the right calls, not that
a real simulator answers them.
"""

import sys
from types import ModuleType, SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

from cqn_train.envs import RLBenchEnv
from cqn_train.envs.rlbench import RLBenchGym
from cqn_train.envs.rlbench_config import CAMERAS, TASKS
from lerobot_cqn.errors import ConfigError, DataError

HOME = np.array([-0.5, -0.5, -0.5, -1.0, -0.5, 1.0, -0.5])  # within the Panda's limits, whatever is added


class InvalidActionError(Exception):
    pass


class FakeCamera:
    def __init__(self):
        self.rgb = self.depth = self.mask = self.point_cloud = True
        self.image_size = (128, 128)


class FakeObservationConfig:
    def __init__(self):
        for name in (*CAMERAS, "overhead"):
            setattr(self, f"{name}_camera", FakeCamera())
        self.joint_positions = self.gripper_open = self.task_low_dim_state = True

    def set_all(self, value):
        for name in (*CAMERAS, "overhead"):
            camera = getattr(self, f"{name}_camera")
            camera.rgb = camera.depth = camera.mask = camera.point_cloud = value
        self.joint_positions = self.gripper_open = self.task_low_dim_state = value


class FakeTask:
    """Joints reach their goals; the task succeeds in its third step."""

    def __init__(self, environment, task_class):
        self.environment, self.task_class, self.variation = environment, task_class, None

    def variation_count(self):
        return 3

    def set_variation(self, number):
        self.variation = number

    def reset(self):
        self.joints, self.steps, self.actions = np.random.random(7) * [1, 1, 1, -1, 1, 1, 1] + HOME, 0, []
        return [f"variation {self.variation}", "said otherwise"], self._observation(1.0)

    def step(self, action):
        if action[0] - self.joints[0] > 0.15:
            raise InvalidActionError("cannot be reached")
        self.actions.append(action)
        self.joints = np.array(action[:7])
        self.steps += 1
        success = self.steps == 3
        return self._observation(action[7]), float(success), success

    def _observation(self, gripper):
        wanted = self.environment.obs_config
        pictures = {
            f"{name}_rgb": np.full((*camera.image_size, 3), i, np.uint8) if camera.rgb else None
            for i, name in enumerate(CAMERAS)
            for camera in [getattr(wanted, f"{name}_camera")]
        }
        return SimpleNamespace(joint_positions=self.joints, gripper_open=gripper, **pictures)


class FakeEnvironment:
    made: list["FakeEnvironment"]
    launch_error: Exception | None = None

    def __init__(self, action_mode, dataset_root="", obs_config=None, headless=False):
        self.action_mode, self.obs_config, self.headless = action_mode, obs_config, headless
        self.launched = self.closed = 0
        FakeEnvironment.made.append(self)

    def launch(self):
        if self.launch_error:
            raise self.launch_error
        self.launched += 1

    def get_task(self, task_class):
        self.task = FakeTask(self, task_class)
        return self.task

    def shutdown(self):
        self.closed += 1


@pytest.fixture
def fake_rlbench(monkeypatch):
    """Put the stand-in where `import rlbench` finds it; returns the environments made."""
    FakeEnvironment.made = []
    record = lambda name: lambda **kwargs: (name, kwargs)  # noqa: E731
    classes = ["".join(w.capitalize() for w in task.split("_")) for task in TASKS]
    modules = {
        "rlbench": {},
        "rlbench.tasks": {name: type(name, (), {}) for name in classes},
        "rlbench.environment": {"Environment": FakeEnvironment},
        "rlbench.observation_config": {"ObservationConfig": FakeObservationConfig},
        "rlbench.action_modes": {},
        "rlbench.action_modes.action_mode": {"MoveArmThenGripper": record("MoveArmThenGripper")},
        "rlbench.action_modes.arm_action_modes": {"JointPosition": record("JointPosition")},
        "rlbench.action_modes.gripper_action_modes": {"Discrete": record("Discrete")},
        "rlbench.backend": {},
        "rlbench.backend.exceptions": {"InvalidActionError": InvalidActionError},
    }
    for name, content in modules.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
        parent, _, child = name.rpartition(".")
        if parent:
            setattr(sys.modules[parent], child, module)
    return FakeEnvironment.made


def test_the_simulator_is_asked_for_what_the_paper_uses(fake_rlbench):
    env = RLBenchGym(image_size=64, cameras=["front", "wrist"], variation=2)
    made = fake_rlbench[0]
    assert made.action_mode == (
        "MoveArmThenGripper",
        {"arm_action_mode": ("JointPosition", {"absolute_mode": True}), "gripper_action_mode": ("Discrete", {})},
    )
    assert (made.headless, made.launched) == (True, 1)
    assert (made.task.task_class.__name__, made.task.variation) == ("TakeLidOffSaucepan", 2)
    config = made.obs_config
    assert [n for n in (*CAMERAS, "overhead") if getattr(config, f"{n}_camera").rgb] == ["front", "wrist"]
    assert not any(getattr(config, f"{n}_camera").depth for n in CAMERAS)
    assert config.front_camera.image_size == (64, 64)
    assert (config.joint_positions, config.gripper_open, config.task_low_dim_state) == (True, True, False)
    env.close()
    env.close()
    assert made.closed == 1


def test_an_episode(fake_rlbench):
    config = RLBenchEnv(image_size=32)
    env = gym.make(config.gym_id, **config.gym_kwargs)
    observation, info = env.reset(seed=1, options={"lerobot_new_rollout": True})
    assert info == {"is_success": False}
    assert env.observation_space.contains(observation)
    shapes = {name: value.shape for name, value in observation.items() if name != "pixels"}
    shapes |= {f"observation.images.{name}": picture.shape for name, picture in observation["pixels"].items()}
    assert {**shapes, "action": (8,)} == {name: tuple(f.shape) for name, f in config.features.items()}
    assert env.unwrapped.task_description == "variation 0"
    assert env.spec.max_episode_steps == 100
    action = np.append(observation["agent_pos"][:7] + np.array([0.1, -9.0, *[0.0] * 5]), 0.0).astype(np.float32)
    following, reward, terminated, _, info = env.step(action)
    moved = following["agent_pos"][:7] - observation["agent_pos"][:7]
    assert moved == pytest.approx([0.1, -0.2, 0, 0, 0, 0, 0], abs=1e-6)
    assert (observation["agent_pos"][7], following["agent_pos"][7]) == (1.0, 0.0)
    assert (reward, terminated, info["is_success"]) == (0.0, False, False)
    assert env.render().shape == (32, 32, 3)
    env.step(action)
    _, reward, terminated, truncated, info = env.step(action)
    assert (reward, terminated, truncated, info["is_success"]) == (1.0, True, False, True)
    env.close()


def test_a_refused_action_ends_the_episode_as_a_failure(fake_rlbench):
    env = RLBenchGym(image_size=32)
    before, _ = env.reset(seed=0)
    action = before["agent_pos"].astype(np.float64)
    action[0] += 0.18
    observation, reward, terminated, _, info = env.step(action)
    assert (reward, terminated, info["is_success"]) == (0.0, True, False)
    assert np.array_equal(observation["agent_pos"], before["agent_pos"])
    with pytest.raises(DataError, match=r"shape \(7,\): expected \(8,\)"):
        env.step(np.zeros(7))


def test_a_seed_places_the_objects_and_numpy_is_left_alone(fake_rlbench):
    env = RLBenchGym(image_size=32)
    np.random.seed(3)
    expected = np.random.random()
    np.random.seed(3)
    one = env.reset(seed=4)[0]["agent_pos"]
    assert np.random.random() == expected
    other = env.reset()[0]["agent_pos"]
    assert np.array_equal(env.reset(seed=4)[0]["agent_pos"], one)
    assert np.array_equal(env.reset()[0]["agent_pos"], other)
    assert not np.array_equal(one, other)


def test_a_task_that_cannot_be_placed_is_said_in_one_line(fake_rlbench, monkeypatch):
    env = RLBenchGym(image_size=32)
    monkeypatch.setattr(env._task, "reset", lambda: (_ for _ in ()).throw(RuntimeError("no place")))
    with pytest.raises(DataError, match=r"'take_lid_off_saucepan' .no place.: .* try another seed"):
        env.reset(seed=0)


def test_the_papers_tasks_and_limits():
    assert len(TASKS) == 20
    assert sum(TASKS.values()) == 2675
    for task, limit in TASKS.items():
        assert RLBenchEnv(task=task).max_episode_steps == limit == gym.spec(f"cqn_rlbench/{task}-v0").max_episode_steps
    assert RLBenchEnv(episode_length=7).gym_kwargs["max_episode_steps"] == 7


def test_a_variation_the_task_does_not_have(fake_rlbench):
    with pytest.raises(ConfigError, match="variation is 3: expected 0 to 2"):
        RLBenchGym(variation=3)
    assert fake_rlbench[0].closed == 1


def test_without_rlbench_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "rlbench", None)
    with pytest.raises(ConfigError, match=r"RLBench, PyRep and CoppeliaSim .* COPPELIASIM_ROOT") as raised:
        RLBenchGym()
    assert "\n" not in str(raised.value)


def test_without_coppeliasim_too(fake_rlbench, monkeypatch):
    monkeypatch.setattr(FakeEnvironment, "launch_error", RuntimeError("COPPELIASIM_ROOT not defined."))
    with pytest.raises(ConfigError, match=r"does not start .COPPELIASIM_ROOT not defined"):
        RLBenchGym()
