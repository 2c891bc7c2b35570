"""LeRobot's own format v2.1, converted by LeRobot's own converter on a copy."""

import contextlib
import io
import json
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich.console import Console

from lerobot_cqn.errors import DataError

from .common import reading

__all__ = ["Summary", "converted_copy", "look"]

WORK = ".converting"
CONVERTED = {"data", "meta", "videos", "images"}


class Summary:
    """Declarations of a v2.1 dataset's ``meta/info.json``.

    Attributes:
        episodes, frames, fps: its totals.
        features: as LeRobot writes them.
    """

    def __init__(self, info: dict[str, Any]) -> None:
        self.episodes, self.frames = int(info["total_episodes"]), int(info["total_frames"])
        self.fps: float = info["fps"]
        self.features: dict[str, dict[str, Any]] = info["features"]
        self.data_path, self.video_path = str(info["data_path"]), info.get("video_path")
        self.chunk = int(info.get("chunks_size", 1000))


def look(folder: Path) -> Summary:
    """Check a dataset before anything is copied.

    Raises:
        DataError: no LeRobot dataset, another version of the format, no episodes, or a file is missing.
    """
    path = folder / "meta" / "info.json"
    if not path.is_file():
        raise DataError(f"{folder}: expected a LeRobot v2.1 dataset, but meta/info.json is missing.")
    with reading(str(path)):
        info = json.loads(path.read_text())
        version = str(info["codebase_version"])
    if version.startswith("v3"):
        raise DataError(f"{folder} has format {version} already: there is nothing to convert.")
    if version != "v2.1":
        raise DataError(
            f"{folder} has format {version}, expected v2.1; bring it to v2.1 first, with the converter of a LeRobot"
            " from before v3."
        )
    with reading(str(path)):
        summary = Summary(info)
    if not summary.episodes or not summary.frames:
        raise DataError(f"{folder} holds no episodes.")
    with reading(str(path)):
        missing = next((p for p in _files(summary) if not (folder / p).is_file()), None)
    if missing is not None:
        raise DataError(f"{folder / missing} is missing; restore it before converting.")
    return summary


@contextlib.contextmanager
def converted_copy(folder: Path, target: Path, repo_id: str) -> Iterator[Path]:
    """Convert a copy beside ``target``; what is yielded is put in place when the ``with`` block ends well.

    Raises:
        DataError: LeRobot's converter or reader refuses the data.
        OutputExistsError: something is at ``target``.
    """
    from ..disk.folders import new_folder
    from ..disk.source import open_source

    with new_folder(target) as new:
        copy, before = new / WORK, new / f"{WORK}_old"  # the second is where LeRobot puts what it was given
        shutil.copytree(folder, copy, ignore=shutil.ignore_patterns(".cache", ".git"))
        _run(folder, copy, repo_id)
        for left in before.iterdir():
            if left.name not in CONVERTED:  # licence, description
                os.replace(left, new / left.name)
        for made in copy.iterdir():
            os.replace(made, new / made.name)
        copy.rmdir()
        shutil.rmtree(before)
        with reading(f"The converted {folder}"):
            open_source(repo_id, str(new)).check_videos()
        yield new


def _run(folder: Path, copy: Path, repo_id: str) -> None:
    """LeRobot's converter, without its progress bars and without the network."""
    from lerobot.scripts.convert_dataset_v21_to_v30 import convert_dataset

    console = Console(file=sys.stderr)
    with (
        console.status("Converting with LeRobot …"),
        contextlib.redirect_stderr(io.StringIO()),
        reading(f"{folder} (by LeRobot's converter)"),
    ):
        convert_dataset(repo_id, root=copy, push_to_hub=False)


def _files(summary: Summary) -> Iterator[str]:
    """Every data and video file that has to be there."""
    cameras = [key for key, feature in summary.features.items() if feature["dtype"] == "video"]
    for index in range(summary.episodes):
        place = {"episode_chunk": index // summary.chunk, "episode_index": index}
        yield summary.data_path.format(**place)
        for camera in cameras:
            yield str(summary.video_path).format(**place, video_key=camera)
