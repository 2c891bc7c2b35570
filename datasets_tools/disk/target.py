"""A new LeRobotDataset v3 while it is being written, and the history that is kept in it."""

import contextlib
import ctypes
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot.configs import RGBEncoderConfig
from lerobot.datasets.io_utils import write_info
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.video_utils import StreamingVideoEncoder

from lerobot_cqn.errors import OutputError
from lerobot_cqn.history_text import numbered
from lerobot_cqn.schema import HISTORY, read_history

from .decoded import Decoded, Handed
from .folders import new_folder
from .video_encoder import VideoEncoder

__all__ = [
    "HISTORY",
    "Target",
    "append_history",
    "new_dataset",
    "read_history",
    "skip_entry",
    "write_history",
]

ENCODER_THREADS = 2  # for each camera; the encoder's memory grows with them, up to gigabytes on many cores


class Target:
    """A dataset that is being written in a temporary folder beside its final place."""

    def __init__(self, dataset: LeRobotDataset, folder: Path) -> None:
        self.dataset = dataset
        self.folder = folder

    def add(self, frame: dict[str, Any], task: str) -> None:
        """Append one step; shapes and dtypes are those of the features, pictures arrays or decoded ones."""
        handed = {k: Handed.of(v) if isinstance(v, Decoded) else v for k, v in frame.items()}
        self.dataset.add_frame({**handed, "task": task})

    def save_episode(self) -> None:
        """Close the episode: statistics, video, parquet."""
        # One encoder after the other: a process for each camera would outlive an interrupt.
        try:
            self.dataset.save_episode(parallel_encoding=False)
        except RuntimeError as error:  # how LeRobot passes on what happened in an encoder's thread
            raise OutputError(f"{self.folder} could not be written: {error}") from error
        self._say_rate()
        _give_back_memory()

    def _say_rate(self) -> None:
        """LeRobot writes down the whole part of a video's rate."""
        meta = self.dataset.meta
        if not float(meta.fps).is_integer():
            for key in meta.video_keys:
                meta.info.features[key]["info"]["video.fps"] = meta.fps
            write_info(meta.info, meta.root)

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


class _Dataset(LeRobotDataset):
    """LeRobot's dataset with an encoder that loses nothing."""

    @staticmethod
    def _build_streaming_encoder(
        fps: float, rgb_encoder: Any, depth_encoder: Any, encoder_queue_maxsize: int, encoder_threads: int | None
    ) -> StreamingVideoEncoder:
        return VideoEncoder(fps, rgb_encoder, depth_encoder, encoder_queue_maxsize, encoder_threads)


@contextlib.contextmanager
def new_dataset(
    repo_id: str,
    root: Path,
    *,
    fps: float,
    features: Mapping[str, Mapping[str, Any]],
    robot_type: str | None = None,
    encoder: RGBEncoderConfig | None = None,
) -> Iterator[Target]:
    """Create a dataset for the time of a ``with`` block and put it in place when the block ends well.

    Raises:
        OutputExistsError: something is at ``root`` already, at the start or by the end.
    """
    cameras = sum(f["dtype"] in ("image", "video") for f in features.values())
    with new_folder(root) as folder:
        dataset: LeRobotDataset | None = None
        try:
            dataset = _Dataset.create(
                repo_id,
                fps=fps,
                features={k: dict(v) for k, v in features.items()},
                root=folder,
                robot_type=robot_type,
                use_videos=any(f["dtype"] == "video" for f in features.values()),
                image_writer_threads=2 if cameras else 0,
                rgb_encoder=encoder,
                streaming_encoding=True,
                encoder_threads=ENCODER_THREADS,
            )
            yield Target(dataset, folder)
            dataset.finalize()
            shutil.rmtree(folder / "images", ignore_errors=True)
        finally:
            if dataset is not None:
                # Finalised before the folder goes: the writer would otherwise recreate it when it is collected.
                with contextlib.suppress(Exception):
                    dataset.writer.cancel_pending_videos()
                with contextlib.suppress(Exception):
                    dataset.finalize()


def write_history(folder: Path, operations: Sequence[Mapping[str, Any]]) -> None:
    """Write ``meta/cqn_history.json``."""
    path = folder / HISTORY
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"version": 1, "operations": list(operations)}, indent=2) + "\n")


def skip_entry(episodes: Mapping[int, str]) -> dict[str, Any]:
    """Entry of episodes that were left out since they could not be read: number -> reason."""
    said = f"Left out {numbered(list(episodes))}, which could not be read."  # reasons are long
    return {"operation": "skip_bad_episodes", "episodes": dict(episodes), "told": said}


def append_history(folder: Path, previous: Path | None, entry: Mapping[str, Any]) -> None:
    """Write the operations on ``previous`` (a dataset folder) and then ``entry``."""
    write_history(folder, [*(read_history(previous) if previous else []), dict(entry)])


def _give_back_memory() -> None:
    """Return freed memory to the system: each episode's encoder threads leave pools of it, which glibc keeps."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
