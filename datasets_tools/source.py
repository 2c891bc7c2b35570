"""Read a local LeRobotDataset v3 without ever touching it or the network."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.io_utils import load_nested_dataset
from lerobot.datasets.video_utils import decode_video_frames
from lerobot.utils.constants import DEFAULT_FEATURES, HF_LEROBOT_HOME
from numpy.typing import NDArray

from lerobot_cqn.errors import DataError

__all__ = ["Episode", "Source", "dimension_names", "local_root", "open_source"]

VIDEO_CHUNK = 64
TOLERANCE_S = 1e-4


def local_root(repo_id: str, root: str | None) -> Path:
    """Dataset folder: ``root`` itself, else LeRobot's home with the repository name below it."""
    return Path(root).expanduser() if root else Path(HF_LEROBOT_HOME) / repo_id


def dimension_names(feature: Mapping[str, Any]) -> list[str]:
    """Names of a vector's dimensions, whichever way the recorder nested them; numbers where there are none."""

    def flat(names: Any) -> Iterator[str]:
        if isinstance(names, str):
            yield names
        elif isinstance(names, Mapping):
            for value in names.values():
                yield from flat(value)
        elif isinstance(names, Sequence):
            for value in names:
                yield from flat(value)

    size = int(np.prod(feature["shape"]))
    names = list(flat(feature.get("names") or ()))
    return names if len(names) == size else [str(i) for i in range(size)]


@dataclass(frozen=True)
class Episode:
    """One episode: where its rows are and its columns that are neither image nor video.

    Attributes:
        index: number of the episode in its dataset.
        start: row of its first step in the whole dataset.
        columns: name -> array with T rows, or list of T strings.
        tasks: the T task sentences.
    """

    index: int
    start: int
    columns: dict[str, Any]
    tasks: list[str]

    def __len__(self) -> int:
        return len(self.tasks)


class Source:
    """A dataset on disk, opened by :func:`open_source`; episodes are read one at a time."""

    def __init__(self, meta: LeRobotDatasetMetadata, root: Path) -> None:
        self.meta = meta
        self.root = root
        self.rows = load_nested_dataset(root / "data", features=get_hf_features_from_features(meta.features))
        self._arrow = self.rows.with_format("arrow")
        if len(self.rows) != meta.total_frames:
            raise DataError(
                f"{root}: meta/info.json declares {meta.total_frames} frames, the parquet files hold"
                f" {len(self.rows)}; record or download the dataset again."
            )

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """The features a recorder gave, without LeRobot's own index columns; shapes are tuples."""
        own = {k: v for k, v in self.meta.features.items() if k not in DEFAULT_FEATURES}
        return {k: {**v, "shape": tuple(v["shape"])} for k, v in own.items()}

    def check_videos(self) -> None:
        """Make sure that every video file is there.

        Raises:
            DataError: naming the first missing file.
        """
        for key in self.meta.video_keys:
            for episode in range(self.meta.total_episodes):
                path = self.root / self.meta.get_video_file_path(episode, key)
                if not path.is_file():
                    raise DataError(f"Video file {path} of episode {episode} is missing; restore it.")

    def episode(self, index: int) -> Episode:
        """Read the numbers and strings of one episode.

        Raises:
            DataError: the episode is empty or not where its metadata says, or a number is NaN or infinite.
        """
        row = self.meta.episodes[index]
        start, stop = int(row["dataset_from_index"]), int(row["dataset_to_index"])
        table = self._arrow[start:stop]
        if stop <= start or set(table["episode_index"].to_pylist()) != {index}:
            raise DataError(f"{self.root}: rows {start}:{stop} are not those of episode {index}; the index is damaged.")
        columns: dict[str, Any] = {"timestamp": np.asarray(table["timestamp"].to_pylist(), dtype=np.float64)}
        for key, feature in self.features.items():
            if feature["dtype"] in ("image", "video"):
                continue
            values = table[key].to_pylist()
            if feature["dtype"] != "string":
                values = np.asarray(values, dtype=feature["dtype"]).reshape(len(values), *feature["shape"])
                _refuse_non_finite(index, key, values)
            columns[key] = values
        names = self.meta.tasks.index
        tasks = [str(names[i]) for i in table["task_index"].to_pylist()]
        return Episode(index=index, start=start, columns=columns, tasks=tasks)

    def camera_frames(self, episode: Episode, steps: NDArray[np.int64]) -> Iterator[dict[str, Any]]:
        """Pictures of the given steps in order, each decoded once; yields {camera: (H, W, 3) uint8 or PIL}.

        Args:
            episode: from :meth:`episode`.
            steps: (K,) ascending steps in the episode.
        """
        stills = [k for k in self.meta.image_keys if k in self.features]
        for chunk in np.array_split(steps, max(1, -(-len(steps) // VIDEO_CHUNK))):
            videos = {key: self._decode(episode, key, chunk) for key in self.meta.video_keys}
            for position, step in enumerate(chunk):
                row = self.rows.with_format(None)[int(episode.start + step)] if stills else {}
                yield {
                    **{key: frames[position] for key, frames in videos.items()},
                    **{key: row[key] for key in stills},
                }

    def _decode(self, episode: Episode, key: str, steps: NDArray[np.int64]) -> NDArray[np.uint8]:
        """(K, H, W, 3) pictures of one camera."""
        start = float(self.meta.episodes[episode.index][f"videos/{key}/from_timestamp"])
        times = [start + float(t) for t in episode.columns["timestamp"][steps]]
        path = self.root / self.meta.get_video_file_path(episode.index, key)
        try:
            frames = decode_video_frames(path, times, TOLERANCE_S, return_uint8=True)
        except (ValueError, RuntimeError, OSError, IndexError) as error:
            first = " ".join(str(error).split())[:160]
            raise DataError(f"Video {path} does not hold episode {episode.index} as declared: {first}") from error
        pictures: NDArray[np.uint8] = frames.permute(0, 2, 3, 1).contiguous().numpy()
        return pictures


def open_source(repo_id: str, root: str | None) -> Source:
    """Open a dataset that lies on this disk.

    Raises:
        DataError: nothing there, another format version, empty, or damaged.
    """
    folder = local_root(repo_id, root)
    info_path = folder / "meta" / "info.json"
    if not info_path.is_file():
        raise DataError(
            f"No LeRobotDataset '{repo_id}' at {folder}: meta/info.json not found; set --root to its folder."
        )
    try:
        info = json.loads(info_path.read_text())
        version = str(info["codebase_version"])
        episodes, frames = int(info["total_episodes"]), int(info["total_frames"])
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"{info_path} is damaged: {error!r}.") from error
    if not version.startswith("v3"):
        raise DataError(
            f"{folder} has format {version}, expected v3.0; convert it with"
            " python -m lerobot.scripts.convert_dataset_v21_to_v30"
            f" --repo-id={repo_id} --root={folder} --push-to-hub=false"
        )
    if episodes == 0 or frames == 0:
        raise DataError(f"{folder} holds no episodes; record some first.")
    try:
        return Source(LeRobotDatasetMetadata(repo_id, folder), folder)
    except DataError:
        raise
    except Exception as error:  # parquet, json and schema readers each raise their own kind
        text = " ".join(str(error).split())[:200]
        raise DataError(f"{folder} cannot be read as a LeRobotDataset: {type(error).__name__}: {text}") from error


def _refuse_non_finite(episode: int, key: str, values: NDArray[Any]) -> None:
    if not np.issubdtype(values.dtype, np.floating):
        return
    bad = ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)
    if bad.any():
        frame = int(np.flatnonzero(bad)[0])
        raise DataError(f"Episode {episode}, frame {frame}: '{key}' is not finite; drop or mend this episode.")
