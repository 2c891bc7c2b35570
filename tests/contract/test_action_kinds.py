"""What a policy of goals or of differences sends: always what was recorded, whatever was made of it in between."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies.factory import make_policy, make_pre_post_processors

from cqn_data.cli import main as cqn_data
from cqn_train.cli import main as cqn_train
from lerobot_cqn.configuration_cqn import CQNConfig

from ..foreign_formats import write_rlbench
from .columns import ACTION, STATE
from .conftest import TINY_RUN
from .data_recording import column

SETTINGS: dict[str, Any] = {"preset": "laptop_state", "hidden_dim": 16, "feature_dim": 8, "device": "cpu"}


def made(operation: str, source: Path, target: Path, *options: str) -> Path:
    names = ["--repo_id=local/a", f"--root={source}", "--new_repo_id=local/b", f"--new_root={target}"]
    assert cqn_data([operation, *names, *options]) == 0
    return target


def sent(root: Path, tmp_path: Path) -> list[np.ndarray[Any, Any]]:
    """What the saved pipelines send where the policy answers as the dataset says, by episode: [T, D]."""
    meta = LeRobotDatasetMetadata("local/b", root)
    config = CQNConfig(**SETTINGS)
    policy: Any = make_policy(config, ds_meta=meta)
    stats: Any = meta.stats
    for part in make_pre_post_processors(config, dataset_stats=stats):
        part.save_pretrained(tmp_path / "saved")
    policy.save_pretrained(tmp_path / "saved")
    pre, post = make_pre_post_processors(config, pretrained_path=str(tmp_path / "saved"))
    states, actions = (column(root, key) for key in (STATE, ACTION))
    low, high = (np.asarray(stats[ACTION][end], np.float64) for end in ("min", "max"))
    spread = np.where(high > low, high - low, 1.0)
    episodes = []
    for episode in meta.episodes:
        pre.reset()
        post.reset()
        found = []
        for row in range(int(episode["dataset_from_index"]), int(episode["dataset_to_index"])):
            observation = {STATE: torch.from_numpy(states[row]).float()}
            cameras = {key: torch.zeros(3, *meta.features[key]["shape"][:2]) for key in meta.camera_keys}
            pre({**observation, **cameras})
            answer = torch.from_numpy(2 * (actions[row] - low) / spread - 1).float()[None]
            found.append(post(answer)[0].numpy())
        episodes.append(np.stack(found))
    return episodes


def by_episode(root: Path) -> list[np.ndarray[Any, Any]]:
    meta, actions = LeRobotDatasetMetadata("local/b", root), column(root, ACTION)
    return [actions[int(e["dataset_from_index"]) : int(e["dataset_to_index"])] for e in meta.episodes]


@pytest.fixture
def recorded(click: list[str]) -> Path:
    return Path(click[1].partition("=")[2])


def test_in_the_station_differences_are_sent_whatever_the_policy_learned(recorded: Path, tmp_path: Path) -> None:
    goals = made("delta", recorded, tmp_path / "goals", "--to=absolute")
    again = made("delta", goals, tmp_path / "again", "--of=command_steps")
    assert np.abs(by_episode(goals)[0] - by_episode(recorded)[0]).max() > 0.3  # they are not the same
    for root in (recorded, goals, again):
        for one, other in zip(sent(root, tmp_path / root.name), by_episode(recorded), strict=True):
            np.testing.assert_allclose(one, other, atol=2e-5)


def test_merged_recordings_are_driven_as_each_of_them(recorded: Path, tmp_path: Path) -> None:
    once = by_episode(recorded)
    for name, options in (("differences", None), ("goals", ["--to=absolute"])):
        parts = [tmp_path / f"{name}{i}" for i in range(2)]
        for part in parts:
            if options is None:
                shutil.copytree(recorded, part)
            else:
                made("delta", recorded, part, *options)
        given = ["--repo_ids=[local/a, local/c]", f"--roots=[{parts[0]}, {parts[1]}]", "--new_repo_id=local/b"]
        assert cqn_data(["merge", *given, f"--new_root={tmp_path / name}"]) == 0
        for one, other in zip(sent(tmp_path / name, tmp_path / f"of_{name}"), [*once, *once], strict=True):
            np.testing.assert_allclose(one, other, atol=2e-5)


def test_in_rlbench_goals_are_sent_whatever_the_policy_learned(tmp_path: Path) -> None:
    write_rlbench(tmp_path / "in")
    convert = ["convert", "--from=rlbench", f"--input={tmp_path / 'in'}", "--new_repo_id=local/a", "--video=false"]
    assert cqn_data([*convert, f"--new_root={tmp_path / 'goals'}"]) == 0
    delta = made("delta", tmp_path / "goals", tmp_path / "delta")
    for root in (tmp_path / "goals", delta):
        for one, other in zip(sent(root, tmp_path / f"of_{root.name}"), by_episode(tmp_path / "goals"), strict=True):
            np.testing.assert_allclose(one, other, atol=2e-5)


def test_goals_of_the_station_are_learned_and_driven_online(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from cqn_train.envs.ur5e_station.station import UR5eStation

    goals, taken = made("delta", recorded, tmp_path / "goals", "--to=absolute"), []
    step = UR5eStation.step

    def noted(self: Any, action: Any) -> Any:
        taken.append(np.array(action))
        return step(self, action)

    monkeypatch.setattr(UR5eStation, "step", noted)
    data = ["--dataset.repo_id=local/b", f"--dataset.root={goals}"]
    assert cqn_train([*TINY_RUN, *data, f"--output_dir={tmp_path / 'run'}"]) == 0
    moved = np.abs(np.stack(taken)[:, :6])
    asked = np.abs(column(goals, ACTION)[:, :6]).max()
    assert len(taken) > 50
    assert asked > 1  # rad: a goal taken for a difference would be as large
    assert np.median(moved.max(axis=1)) < 0.5


@pytest.mark.parametrize(("origin", "said"), [("convert", "recorded as goals"), ("record", "recorded as goals")])
def test_an_environment_that_takes_other_actions_is_refused(
    recorded: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], origin: str, said: str
) -> None:
    root = Path(shutil.copytree(recorded, tmp_path / "src"))
    path = root / "meta/cqn_history.json"
    path.write_text(json.dumps({"version": 1, "operations": [{"operation": origin, "deltas": None}]}))
    data = ["--dataset.repo_id=local/b", f"--dataset.root={root}"]
    assert cqn_train([*TINY_RUN, *data, f"--output_dir={tmp_path / 'run'}"]) == 2
    last = capfd.readouterr().err.strip().splitlines()[-1]
    assert said in last
    assert "--env.type=ur5e_station takes differences" in last
    assert not (tmp_path / "run").exists()
