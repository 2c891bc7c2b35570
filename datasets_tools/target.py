"""Write a new LeRobotDataset v3 in one piece: it is complete under its name, or there is nothing."""

import contextlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from lerobot.configs import RGBEncoderConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_cqn.errors import ConfigError, OutputExistsError

__all__ = ["HISTORY", "Target", "append_history", "new_dataset", "refuse_existing", "refuse_inside"]

HISTORY = Path("meta") / "cqn_history.json"


def refuse_existing(root: Path) -> None:
    """Raise OutputExistsError when there is anything at ``root``."""
    if root.exists() or root.is_symlink():
        raise OutputExistsError(f"{root} exists already and is left as it is; choose another folder.")


def refuse_inside(source: Path, root: Path) -> None:
    """Raise ConfigError when ``root`` lies in the dataset folder ``source``, which must stay as it is."""
    if source.resolve() in root.resolve().parents:
        raise ConfigError(f"{root} lies inside the source {source}; choose a folder outside.")


class Target:
    """A dataset that is being written in a temporary folder beside its final place."""

    def __init__(self, dataset: LeRobotDataset, folder: Path) -> None:
        self.dataset = dataset
        self.folder = folder

    def add(self, frame: dict[str, Any], task: str) -> None:
        """Append one step; shapes and dtypes are those of the features."""
        self.dataset.add_frame({**frame, "task": task})

    def save_episode(self) -> None:
        """Close the episode: statistics, video, parquet."""
        # One encoder after the other: a process for each camera would outlive an interrupt.
        self.dataset.save_episode(parallel_encoding=False)

    def drop_episode(self) -> None:
        """Forget the steps added since the last saved episode."""
        self.dataset.clear_episode_buffer()

    @property
    def episodes(self) -> int:
        """Episodes saved so far."""
        return int(self.dataset.meta.total_episodes)

    @property
    def frames(self) -> int:
        """Steps in the saved episodes."""
        return int(self.dataset.meta.total_frames)


@contextlib.contextmanager
def new_dataset(
    repo_id: str,
    root: Path,
    *,
    fps: int,
    features: Mapping[str, Mapping[str, Any]],
    robot_type: str | None = None,
    encoder: RGBEncoderConfig | None = None,
) -> Iterator[Target]:
    """Create a dataset for the time of a ``with`` block and put it in place when the block ends well.

    Any exception, Ctrl-C included, removes what was written; a killed process leaves only a hidden
    ``.NAME.PID.tmp`` folder beside the place.

    Raises:
        OutputExistsError: something is at ``root`` already, at the start or by the end.
    """
    refuse_existing(root)
    root.parent.mkdir(parents=True, exist_ok=True)
    folder = root.parent / f".{root.name}.{os.getpid()}.tmp"
    cameras = sum(f["dtype"] in ("image", "video") for f in features.values())
    dataset: LeRobotDataset | None = None
    try:
        dataset = LeRobotDataset.create(
            repo_id,
            fps=fps,
            features={k: dict(v) for k, v in features.items()},
            root=folder,
            robot_type=robot_type,
            use_videos=any(f["dtype"] == "video" for f in features.values()),
            image_writer_threads=2 if cameras else 0,
            rgb_encoder=encoder,
        )
        yield Target(dataset, folder)
        dataset.finalize()
        shutil.rmtree(folder / "images", ignore_errors=True)
        refuse_existing(root)
        os.replace(folder, root)
    finally:
        if dataset is not None:
            # Finalised before the folder goes: the writer would otherwise recreate it when it is collected.
            with contextlib.suppress(Exception):
                dataset.finalize()
        shutil.rmtree(folder, ignore_errors=True)


def append_history(folder: Path, previous: Path | None, entry: Mapping[str, Any]) -> None:
    """Write ``meta/cqn_history.json``: the operations on ``previous`` (a dataset folder) and then ``entry``."""
    operations: list[Any] = []
    if previous is not None and (previous / HISTORY).is_file():
        with contextlib.suppress(ValueError, KeyError):
            operations = list(json.loads((previous / HISTORY).read_text())["operations"])
    path = folder / HISTORY
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"version": 1, "operations": [*operations, dict(entry)]}, indent=2) + "\n")
