"""`cqn-data record --human` in real environments, and what `cqn-data inspect --value_probe` says of it."""

import json
from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from cqn_data.cli import main
from lerobot_cqn.schema import read_history

pytest.importorskip("mujoco")
STATION = ["--env.type=ur5e_station", "--env.task=click_button", "--env.obs_type=state"]


def record(root: Path, *options: str, episodes: int = 12) -> LeRobotDataset:
    given = ["--repo_id=l/p", f"--root={root}", f"--episodes={episodes}", "--pause_share=0", "--seed=40"]
    assert main(["record", *STATION, *given, *options]) == 0
    return LeRobotDataset("l/p", root=root)


def actions(dataset: LeRobotDataset) -> list[np.ndarray]:
    rows = dataset.hf_dataset.with_format("numpy")
    episodes = np.asarray(rows["episode_index"])
    return [np.stack(rows["action"])[episodes == e] for e in range(dataset.num_episodes)]


def probe(root: Path, capsys: pytest.CaptureFixture[str]) -> dict:
    capsys.readouterr()
    assert main(["inspect", "--repo_id=l/p", f"--root={root}", "--value_probe", "--json"]) == 0
    return json.loads(capsys.readouterr().out)["sequences"]


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Folders of the same scenes by the script and by a person's hand."""
    folder = tmp_path_factory.mktemp("human")
    record(folder / "script")
    record(folder / "human", "--human=true")
    return folder / "script", folder / "human"


def test_a_hand_is_unsteady_and_stays_inside_the_bounds(
    both: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    script, human = (LeRobotDataset("l/p", root=root) for root in both)
    assert all(np.abs(each[:, :6]).max() <= 0.1 + 1e-6 for each in actions(human))
    noise = [np.mean(list(probe(root, capsys)["noise"].values())) for root in both]
    assert noise[0] < 0.05
    assert noise[1] > 0.1
    assert human.num_frames > script.num_frames  # slower, on the whole


def test_the_history_tells_the_hand(both: tuple[Path, Path]) -> None:
    entry = read_history(both[1])[0]
    assert entry["settings"]["human"] is True
    assert entry["settings"]["overshoot"] == 0.3
    assert "moves as a person's hand does" in entry["told"]
    assert "overshoot" not in read_history(both[0])[0]["settings"]


def test_the_page_shows_it(both: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "page.html"
    assert main(["inspect", "--repo_id=l/p", f"--root={both[1]}", "--value_probe", f"--html={page}"]) == 0
    assert "Of the return's variance" in capsys.readouterr().out
    assert "<h2>Action sequences</h2>" in page.read_text()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--overshoot=0.5"], "need --human=true"),
        (["--human=true", "--overshoot=2"], "`overshoot` must be 0 to 0.9, got 2"),
        (["--human=true", "--reaction_s=nan"], "`reaction_s` must be 0 to 1 seconds"),
    ],
)
def test_habits_are_checked_before_anything_is_written(
    options: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["record", *STATION, "--repo_id=l/p", f"--root={tmp_path / 'x'}", *options]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "x").exists()
