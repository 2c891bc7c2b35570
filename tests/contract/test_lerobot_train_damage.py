"""Damaged datasets given to the real `lerobot-train`: nothing is learned from rows that are not what they say."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_cqn.errors import DataError
from lerobot_cqn.rows_check import check_rows

from .conftest import TINY_POLICY
from .test_data_damage_table import KINDS, recording  # noqa: F401  # a fixture
from .zygote import Zygote, zygote

# Texts are no input of the policy, and pictures of another size than was said are scaled to it.
HARMLESS = ("tasks_reversed", "other_size")
BY_ROWS = (
    "late", "gap_in_time", "places_from_100", "files_out_of_order", "shuffled", "scattered", "shorter",
)  # fmt: skip


@pytest.fixture(scope="module")
def trainer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Zygote]:
    with zygote(tmp_path_factory.mktemp("zygote") / "log", "lerobot.scripts.lerobot_train") as started:
        yield started


def train(trainer: Zygote, root: Path, folder: Path) -> tuple[int, str]:
    """Exit status of twelve updates with pictures, and what was said last."""
    process = trainer.start(
        "lerobot-train", *TINY_POLICY, "--policy.push_to_hub=false", "--policy.encoder_channels=[4,8]",
        "--policy.shift_pixels=2", "--dataset.repo_id=local/src", f"--dataset.root={root}", "--batch_size=8",
        "--num_workers=0", "--steps=12", "--save_freq=12", "--wandb.enable=false", f"--output_dir={folder / 'run'}",
        err=str(folder / "err"),
    )  # fmt: skip
    return os.waitstatus_to_exitcode(trainer.wait(process)), (folder / "err").read_text()


@pytest.mark.parametrize("kind", KINDS)
def test_rows_that_are_not_where_lerobot_looks_are_named(recording: Path, tmp_path: Path, kind: str) -> None:  # noqa: F811
    root = tmp_path / "src"
    shutil.copytree(recording, root)
    check_rows(LeRobotDatasetMetadata("local/src", root))
    if kind in ("half_a_table", "gap"):  # which LeRobot's own reader refuses before
        return
    KINDS[kind](root)
    if kind not in BY_ROWS:
        check_rows(LeRobotDatasetMetadata("local/src", root))
        return
    with pytest.raises(DataError, match=rf"{root}: .*episode 0 .*cqn-data trim"):
        check_rows(LeRobotDatasetMetadata("local/src", root))


def test_shuffled_rows_are_refused_by_the_real_command(recording: Path, tmp_path: Path, trainer: Zygote) -> None:  # noqa: F811
    root = tmp_path / "src"
    shutil.copytree(recording, root)
    KINDS["shuffled"](root)
    code, said = train(trainer, root, tmp_path)
    assert code != 0
    assert "rows of episode 0 are not in order" in said


@pytest.mark.slow
@pytest.mark.parametrize("kind", [None, *KINDS])
def test_no_damage_is_trained_on(recording: Path, tmp_path: Path, trainer: Zygote, kind: str | None) -> None:  # noqa: F811
    root = tmp_path / "src"
    shutil.copytree(recording, root)
    if kind is not None:
        KINDS[kind](root)
    code, said = train(trainer, root, tmp_path)
    assert (code == 0) == (kind in (None, *HARMLESS)), said[-500:]
