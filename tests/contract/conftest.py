"""What the tests of the commands share: datasets, made once a process, and a way to run a command."""

import logging
import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cqn_data.cli import main as cqn_data
from cqn_train.cli import main as cqn_train

from ..toy_datasets import make_dataset
from .data_recording import make_recording
from .zygote import Zygote, zygote

Command = Callable[..., subprocess.CompletedProcess[str]]

# A network and a station that answer in milliseconds.
TINY_POLICY = [
    "--policy.type=cqn", "--policy.preset=laptop_state", "--policy.device=cpu", "--policy.hidden_dim=16",
    "--policy.feature_dim=8",
]  # fmt: skip
STATION = ["--env.type=ur5e_station", "--env.obs_type=state", "--env.episode_length=10"]
TINY_RUN = [
    *TINY_POLICY, *STATION, "--batch_size=4", "--demo_batch_size=4", "--offline_updates=10", "--steps=60",
    "--eval.freq=30", "--eval.n_episodes=1", "--eval.final_n_episodes=1", "--save_freq=10", "--log_freq=5", "--seed=3",
]  # fmt: skip


# What every command imports, of ours nothing: that LeRobot finds the policy by itself is part of what is tested.
PRELOAD = (
    "torch._dynamo, lerobot.scripts.lerobot_train, lerobot.scripts.lerobot_edit_dataset, mujoco, matplotlib.pyplot"
)


@pytest.fixture(scope="session")
def processes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Zygote]:
    """Starts installed commands without importing LeRobot each time."""
    with zygote(tmp_path_factory.mktemp("zygote") / "log", PRELOAD) as started:
        yield started


@pytest.fixture(scope="session")
def command(processes: Zygote, tmp_path_factory: pytest.TempPathFactory) -> Command:
    """Run an installed command with the given arguments; fails the test unless the exit code is the expected one."""

    def run(name: str, *arguments: str, code: int = 0) -> subprocess.CompletedProcess[str]:
        out, err = (tmp_path_factory.mktemp("said") / kind for kind in ("out", "err"))
        number = processes.start(name, *arguments, out=str(out), err=str(err))
        returned = os.waitstatus_to_exitcode(processes.wait(number, 180))
        done = subprocess.CompletedProcess([name, *arguments], returned, out.read_text(), err.read_text())
        assert done.returncode == code, done.stderr[-3000:]
        return done

    return run


@pytest.fixture(scope="session")
def click(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Arguments that name three scripted demonstrations in the station, without rewards."""
    pytest.importorskip("mujoco")
    root = tmp_path_factory.mktemp("click") / "click"
    record = ["record", "--env.type=ur5e_station", "--repo_id=local/click", f"--root={root}", "--episodes=3"]
    environment = dict(os.environ)
    try:
        assert cqn_data([*record, "--pause_share=0"]) == 0
    finally:  # the command silences its own process for good; this one goes on
        logging.disable(logging.NOTSET)
        os.environ.clear()
        os.environ.update(environment)
    return ["--dataset.repo_id=local/click", f"--dataset.root={root}"]


@pytest.fixture(scope="session")
def rewarded(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Arguments that name a dataset with rewards, one of its episodes a failure."""
    root = make_dataset(tmp_path_factory.mktemp("rewarded") / "data", reward=True, failed=(1,))
    return ["--dataset.repo_id=local/toy", f"--dataset.root={root}"]


@pytest.fixture(scope="session")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Arguments that name a dataset with a camera, state and rewards."""
    root = make_dataset(tmp_path_factory.mktemp("filmed") / "data", camera=True, reward=True)
    return ["--dataset.repo_id=local/toy", f"--dataset.root={root}"]


@pytest.fixture(scope="session")
def straight(click: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a short cqn-train run that nothing interrupted."""
    folder = tmp_path_factory.mktemp("straight") / "run"
    assert cqn_train([*TINY_RUN, *click, f"--output_dir={folder}"]) == 0
    return folder


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a small recording with a camera; see `data_recording`."""
    return make_recording(tmp_path_factory.mktemp("recording") / "src")


@pytest.fixture(autouse=True)
def _logs_again() -> Iterator[None]:
    """The dataset commands silence logging for the rest of their process; tests share one."""
    yield
    logging.disable(logging.NOTSET)
