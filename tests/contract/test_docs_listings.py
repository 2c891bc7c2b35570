"""The listings of docs/extending.md and the commands of the tutorial, run as they are printed, with few steps."""

import logging
import os
import re
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import get_policy_class
from lerobot.scripts import lerobot_eval
from lerobot.utils.import_utils import register_third_party_plugins

from cqn_data.cli import main as cqn_data
from cqn_train.cli import main as cqn_train
from cqn_train.operator.session import Event
from cqn_train.push.cli import main as cqn_push

from .conftest import TINY_POLICY
from .documents import ROOT, Command, commands, listings
from .test_arm_training import drive
from .test_arm_training import run as arm_session

EXTENDING, TUTORIAL = ROOT / "docs" / "extending.md", ROOT / "docs" / "tutorial.md"
# What a page says -> what is run here. Everything else stays as it is printed.
SMALL = {
    "--episodes": "3", "--offline_updates": "2", "--steps": "6", "--eval.freq": "6", "--eval.n_episodes": "1",
    "--eval.batch_size": "1", "--eval.videos": "1", "--save_freq": "6",
}  # fmt: skip
SMALL_RUN = [
    "--eval.final_n_episodes=1", "--batch_size=2", "--demo_batch_size=2", "--log_freq=2", "--policy.hidden_dim=16",
    "--policy.feature_dim=8", "--policy.device=cpu", "--env.episode_length=8",
]  # fmt: skip
ELSEWHERE = {"pip", "make", "git", "cd", "hf", "tensorboard"}  # set-up and accounts


def smaller(command: Command) -> list[str]:
    """The words of a command with small numbers; cqn-train's new runs get a small network as well."""
    words = []
    for word in command.words:
        name, equals, value = word.partition("=")
        words.append(f"{name}={SMALL[name]}" if equals and name in SMALL and value != "0" else word)
    starts = words[0] == "cqn-train" and not any(word.startswith(("--resume", "--policy.path")) for word in words)
    known = [option for option in SMALL_RUN if starts and option.partition("=")[0] not in command.words]
    if not any("ur5e_station" in word for word in words):  # other environments have no such option
        known = [option for option in known if not option.startswith("--env.")]
    return [*words, *known]


def execute(command: Command, patch: pytest.MonkeyPatch) -> None:
    """Run a command in this process, where everything is imported already. Fails where it does."""
    name, *words = smaller(command)
    environment = dict(os.environ)
    try:
        if name == "cqn-data":
            assert cqn_data(words) == 0, command
        elif name == "cqn-train":
            assert cqn_train(words) == 0, command
        elif name == "cqn-push":
            assert cqn_push(words) == 0, command
        elif name == "lerobot-eval":
            patch.setattr(sys, "argv", [name, *words])
            lerobot_eval.main()
        else:
            assert name in ELSEWHERE, command
    finally:  # `cqn-data` silences its process for good; this one goes on
        logging.disable(logging.NOTSET)
        os.environ.clear()
        os.environ.update(environment)


@pytest.fixture(scope="module")
def shop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A working folder in which the packages of docs/extending.md are installed."""
    folder = tmp_path_factory.mktemp("shop")
    for listing in listings(EXTENDING):
        if listing.language == "python" and listing.named:
            file = folder / "lib" / listing.named
            file.parent.mkdir(parents=True)
            file.write_text(listing.text)
            name = file.parent.name
            (folder / "lib" / f"{name}-0.1.dist-info").mkdir()
            metadata = f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1\n"
            (folder / "lib" / f"{name}-0.1.dist-info" / "METADATA").write_text(metadata)
    before = os.getcwd()
    sys.path.insert(0, str(folder / "lib"))
    os.chdir(folder)
    register_third_party_plugins()
    yield folder
    os.chdir(before)
    sys.path.remove(str(folder / "lib"))


def test_extending_runs_from_top_to_bottom(shop: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mujoco")  # of the plugin's environments
    shown = commands(EXTENDING, tmp_path)
    for listing in listings(EXTENDING):
        if listing.language == "python" and not listing.named:
            script = shop / f"line_{listing.line}.py"
            script.write_text(listing.text)
            runpy.run_path(str(script))
        for command in shown if listing.language == "bash" else ():
            if command.line == listing.line:
                execute(command, monkeypatch)
    reach, seen = (shop / f"outputs/{name}/checkpoints/last/pretrained_model" for name in ("reach", "seen"))
    assert (reach / "config.json").is_file()
    policy = get_policy_class("pooled").from_pretrained(seen)  # type: ignore[attr-defined]
    assert type(policy).__module__ == "lerobot_policy_pooled"
    assert type(policy.model.encoders[0]).__name__ == "PooledEncoder"
    takes, turned = (
        np.stack(LeRobotDataset(f"local/{name}", shop / "data" / name).hf_dataset.with_format("numpy")["action"])
        for name in ("takes", "turned")
    )
    np.testing.assert_allclose(turned, takes * [1, -1])


def test_the_robot_of_extending_is_trained_on(shop: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two episodes with a person who is a thread, as in the tests of the simulated arm."""
    vector: dict[str, Any] = {"dtype": "float32", "shape": (2,), "names": ["base.pos", "tip.pos"]}
    features = {"action": vector, "observation.state": vector}
    data = LeRobotDataset.create("local/pair", fps=40, features=features, root=tmp_path / "data", use_videos=False)
    for number in range(2):
        for step in range(10):
            joints = np.array([step, -step - number], np.float32)
            data.add_frame({"action": joints + 1, "observation.state": joints, "task": "Move."})
        data.save_episode()
    data.finalize()
    drive(monkeypatch)
    options = ["--robot.type=pair", "--operator_page=false", "--batch_size=4", "--demo_batch_size=4", "--log_freq=1"]
    source = ["--dataset.repo_id=local/pair", f"--dataset.root={tmp_path / 'data'}", f"--output_dir={tmp_path / 'run'}"]
    plan = [Event.SUCCESS, Event.FAILURE]
    trainer, _ = arm_session([*TINY_POLICY, *options, *source, "--updates_per_episode=2"], plan)
    assert trainer.counters.episodes == 2
    assert trainer.counters.env_steps >= 2 * 6
    assert (tmp_path / "run/checkpoints/last/pretrained_model/config.json").is_file()


def test_the_tutorial_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)
    shown = commands(TUTORIAL, tmp_path)
    assert {"cqn-data", "cqn-train", "lerobot-eval"} <= {command.words[0] for command in shown}
    for command in shown:
        execute(command, monkeypatch)
    for path in named_files(TUTORIAL):
        assert list(tmp_path.glob(path)), f"the tutorial speaks of {path}"


def named_files(page: Path) -> list[str]:
    """Files of a run that a page names, as patterns."""
    return re.findall(r"`(outputs/[\w./*]+\.\w+)`", page.read_text(encoding="utf-8"))
