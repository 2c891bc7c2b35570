"""`cqn-data record` with a toy environment that LeRobot makes from its registry."""

import logging
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import EnvConfig

from cqn_data.cli import main
from lerobot_cqn.errors import ConfigError

FPS = 20


class Teleoperator:
    """Walks towards 1; a paused step commands 0. Fails for seeds divisible by ``env.fail_every``."""

    def __init__(self, env, pause_share, seed):
        self.env, self.pause_share = env, pause_share

    def reset(self, seed):
        self.random = np.random.default_rng(seed)
        self.lost = self.env.fail_every > 0 and seed % self.env.fail_every == 0

    def act(self):
        time.sleep(self.env.delay)
        if self.lost or self.random.random() < self.pause_share:
            return np.zeros(2)
        return np.array([0.1, 0.0])


class Toy(gym.Env):
    """One joint and a gripper; success at joint >= 1."""

    state_names = ("joint.pos", "gripper.pos")
    action_names = ("joint.pos", "gripper.pos")
    environment_state_names = ("goal",)
    task_description = "Go to one."

    def __init__(self, camera=False, fail_every=0, delay=0.0, helper=True):
        self.camera, self.fail_every, self.delay = camera, fail_every, delay
        self.action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        spaces = {
            "agent_pos": gym.spaces.Box(-9, 9, (2,), np.float32),
            "environment_state": gym.spaces.Box(-9, 9, (1,), np.float32),
        }
        if camera:
            spaces["pixels"] = gym.spaces.Dict({"top": gym.spaces.Box(0, 255, (32, 32, 3), np.uint8)})
        self.observation_space = gym.spaces.Dict(spaces)
        if helper:
            self.scripted_teleoperator = lambda pause_share, seed: Teleoperator(self, pause_share, seed)

    def observe(self):
        seen = {"agent_pos": self.state.copy(), "environment_state": np.ones(1, np.float32)}
        if self.camera:
            seen["pixels"] = {"top": np.full((32, 32, 3), round(float(self.state[0]) * 200), np.uint8)}
        return seen

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = np.zeros(2, np.float32)
        return self.observe(), {}

    def step(self, action):
        self.state = self.state + action
        success = bool(self.state[0] >= 0.95)
        return self.observe(), float(success), success, False, {"is_success": success}


if "cqn_data_toy/go-v0" not in gym.registry:
    gym.register("cqn_data_toy/go-v0", entry_point=Toy, max_episode_steps=60)


@EnvConfig.register_subclass("cqn_data_toy")
@dataclass
class ToyConfig(EnvConfig):
    """Settings of the toy."""

    task: str | None = "go"
    fps: int = FPS
    camera: bool = False
    fail_every: int = 0
    delay: float = 0.0
    helper: bool = True

    def __post_init__(self):
        if self.delay < 0:
            raise ConfigError("delay is below 0.")

    @property
    def gym_id(self):
        return "cqn_data_toy/go-v0"

    @property
    def gym_kwargs(self):
        names = ("camera", "fail_every", "delay", "helper")
        return {name: getattr(self, name) for name in names}


@pytest.fixture(autouse=True)
def _logs():
    yield
    logging.disable(logging.NOTSET)


def run(root, *options):
    return main(["record", "--env.type=cqn_data_toy", "--repo_id=local/toy", f"--root={root}", *options])


@pytest.fixture
def root(tmp_path):
    yield tmp_path / "toy"
    assert [p for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_records_what_lerobot_record_would(root, capsys):
    assert run(root, "--episodes=3", "--pause_share=0.5", "--env.camera=true") == 0
    assert "Recorded 3 episodes" in capsys.readouterr().out
    dataset = LeRobotDataset("local/toy", root)
    assert (dataset.num_episodes, dataset.fps, dataset.meta.robot_type) == (3, FPS, "cqn_data_toy")
    own = {k for k in dataset.features if k.startswith(("observation", "action", "next"))}
    assert own == {"observation.state", "observation.environment_state", "observation.images.top", "action"}
    assert dataset.features["observation.state"]["names"] == ["joint.pos", "gripper.pos"]
    assert dataset.features["observation.images.top"]["dtype"] == "video"
    assert dataset[0]["task"] == "Go to one."
    states = np.array([dataset[i]["observation.state"][0] for i in range(len(dataset))])
    actions = np.array([dataset[i]["action"][0] for i in range(len(dataset))])
    episode = np.array([int(dataset[i]["episode_index"]) for i in range(len(dataset))])
    same = episode[1:] == episode[:-1]
    # The observation is the one before the action: the next state is this one plus the action.
    np.testing.assert_allclose((states + actions)[:-1][same], states[1:][same], atol=1e-6)
    assert (states[np.flatnonzero(np.diff(episode, prepend=-1))] == 0).all()
    assert 0.2 < (actions == 0).mean() < 0.8
    seen = np.array([float(dataset[i]["observation.images.top"].mean()) for i in range(len(dataset))])
    assert np.abs(seen * 255 - states * 200).max() < 8


def test_recording_then_filtering_leaves_the_moving_steps(root, tmp_path):
    assert run(root, "--episodes=4", "--pause_share=0.6") == 0
    new = tmp_path / "filtered"
    assert main(["filter", "--repo_id=local/toy", f"--root={root}", f"--new_root={new}"]) == 0
    dataset = LeRobotDataset("local/toy_filter", new)
    assert [e["length"] for e in dataset.meta.episodes] == [10] * 4
    assert all(float(dataset[i]["action"][0]) > 0.05 for i in range(len(dataset)))


def test_failures_are_left_out_and_retried_with_the_next_seed(root, capsys):
    assert run(root, "--episodes=3", "--env.fail_every=2", "--seed=4") == 0
    assert "3 failed attempts were left out." in capsys.readouterr().out
    assert LeRobotDataset("local/toy", root).num_episodes == 3


def test_gives_up_after_too_many_failures(root, capsys):
    assert run(root, "--episodes=2", "--max_steps=3") == 2
    error = capsys.readouterr().err
    assert "20 attempts in a row failed, the last with seed 19; nothing was saved" in error
    assert error.count("\n") == 1
    assert not root.exists()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--env.helper=false"], "has no scripted teleoperator"),
        (["--env.type=cqn_data_to"], "Did you mean 'cqn_data_toy'?"),
        (["--env.delay=-1"], "--env.type=cqn_data_toy: delay is below 0."),
        (["--env.camra=true"], "Did you mean '--camera'?"),
        (["--env.discover_packages_path=no_such_package"], "no_such_package"),
    ],
)
def test_errors_are_one_line(root, capsys, options, said):
    assert run(root, "--episodes=1", *options) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not root.exists()


def test_existing_folder_is_left_alone(root, capsys):
    root.mkdir()
    assert run(root, "--episodes=1") == 2
    assert "exists already" in capsys.readouterr().err
    assert list(root.iterdir()) == []


def test_ctrl_c_saves_the_finished_episodes(root):
    code = "import sys, test_data_record; from cqn_data.cli import main; sys.exit(main(sys.argv[1:]))"
    flags = ["--env.type=cqn_data_toy", "--env.delay=0.02", "--pause_share=0", "--episodes=500"]
    here = str(Path(__file__).parent)
    process = subprocess.Popen(
        [sys.executable, "-c", code, "record", "--repo_id=local/toy", f"--root={root}", *flags],
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": here, "OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1"},
    )
    deadline = time.monotonic() + 180
    while not list(root.parent.glob(".toy.*/data/*/*.parquet")) and time.monotonic() < deadline:
        time.sleep(0.1)
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=180)
    assert process.returncode == 130, error
    dataset = LeRobotDataset("local/toy", root)
    assert dataset.num_episodes >= 1
    assert f"Interrupted: {dataset.num_episodes} of 500 episodes are saved" in error
    assert len(dataset) == 10 * dataset.num_episodes
    assert not (root / "images").exists()
