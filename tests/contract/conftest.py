"""What the tests of the commands share: datasets, made once for all workers, and a way to run a command."""

import fcntl
import logging
import os
import shutil
import socket
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cqn_data.cli import main as cqn_data
from cqn_train.cli import main as cqn_train

from ..toy_datasets import make_dataset
from .data_recording import make_recording
from .terminal import record_demonstrations
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


ARM_CAMERA = ["--robot.camera_names=[upper_wrist]", "--robot.image_height=96", "--robot.image_width=128"]
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


def once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """A folder in which `make` has put what tests only read, once for all workers of a run."""
    base = factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "shared" / name
    folder.parent.mkdir(exist_ok=True)
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            folder.mkdir()
            try:
                make(folder)
            except BaseException:
                shutil.rmtree(folder)
                raise
    return folder


@pytest.fixture(scope="session")
def click(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Arguments that name three scripted demonstrations in the station, without rewards."""
    pytest.importorskip("mujoco")

    def record(folder: Path) -> None:
        options = ["record", "--env.type=ur5e_station", "--repo_id=local/click", f"--root={folder / 'click'}"]
        environment = dict(os.environ)
        try:
            assert cqn_data([*options, "--episodes=3", "--pause_share=0"]) == 0
        finally:  # the command silences its own process for good; this one goes on
            logging.disable(logging.NOTSET)
            os.environ.clear()
            os.environ.update(environment)

    return ["--dataset.repo_id=local/click", f"--dataset.root={once(tmp_path_factory, 'click', record) / 'click'}"]


@pytest.fixture(scope="session")
def rewarded(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Arguments that name a dataset with rewards, one of its episodes a failure."""
    made = once(tmp_path_factory, "rewarded", lambda at: make_dataset(at / "data", reward=True, failed=(1,)))
    return ["--dataset.repo_id=local/toy", f"--dataset.root={made / 'data'}"]


@pytest.fixture(scope="session")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Arguments that name a dataset with a camera, state and rewards."""
    made = once(tmp_path_factory, "filmed", lambda at: make_dataset(at / "data", camera=True, reward=True))
    return ["--dataset.repo_id=local/toy", f"--dataset.root={made / 'data'}"]


@pytest.fixture(scope="session")
def straight(click: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a short cqn-train run that nothing interrupted."""

    def train(folder: Path) -> None:
        assert cqn_train([*TINY_RUN, *click, f"--output_dir={folder / 'run'}"]) == 0

    return once(tmp_path_factory, "straight", train) / "run"


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a small recording with a camera; see `data_recording`."""
    return once(tmp_path_factory, "recording", lambda at: make_recording(at / "src")) / "src"


@pytest.fixture(scope="session")
def recorded_arm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of three demonstrations that lerobot-record took of the simulated arm and leader, with ARM_CAMERA."""

    def record(folder: Path) -> None:
        record_demonstrations(folder, *ARM_CAMERA, "--robot.state=true", episodes=3)

    return once(tmp_path_factory, "recorded_arm", record) / "demos"


@pytest.fixture(scope="session")
def cleaned_arm(recorded_arm: Path, command: Command, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of `recorded_arm` after the paper's recipe, as local/cqn: joint differences, pictures of 84x84."""

    def clean(folder: Path) -> None:
        command(
            "cqn-data", "run", "paper_real_world", "--repo_id=local/demos", f"--root={recorded_arm}",
            "--new_repo_id=local/cqn", f"--new_root={folder / 'cqn'}",
        )  # fmt: skip

    return once(tmp_path_factory, "cleaned_arm", clean) / "cqn"


@pytest.fixture
def free_port() -> Iterator[int]:
    """A free port that nobody else is given meanwhile: it is bound here, and a server may listen on it all the same."""
    with socket.socket() as ours:
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        ours.bind(("127.0.0.1", 0))
        yield ours.getsockname()[1]


@pytest.fixture(autouse=True)
def _logs_again() -> Iterator[None]:
    """The dataset commands silence logging for the rest of their process; tests share one."""
    yield
    logging.disable(logging.NOTSET)
