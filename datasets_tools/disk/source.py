"""A local LeRobotDataset v3, read without ever touching it or the network."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.io_utils import load_nested_dataset
from lerobot.utils.constants import DEFAULT_FEATURES
from numpy.typing import NDArray

from lerobot_cqn.delta_actions import DeltaJoints, current_description, parse
from lerobot_cqn.errors import DataError

from ..views.episode import Bounds, Camera, Episode
from ..views.view import View
from .decoded import Colours, Decoded
from .folders import local_root
from .pictures import picture_size, shaped, video_pictures
from .target import read_history

__all__ = ["Source", "open_source"]

CACHE_BYTES = 256 * 2**20
NOT_NUMBERS = ("image", "video", "language")  # what an episode does not hold in memory
JITTER = 0.2  # share of a step by which a timestamp may be off


class Source(View):
    """A dataset on disk, opened by :func:`open_source`; episodes are read one at a time."""

    def __init__(self, meta: LeRobotDatasetMetadata, root: Path) -> None:
        self.meta = meta
        self.root = root
        self.rows = load_nested_dataset(root / "data", features=get_hf_features_from_features(meta.features))
        self._arrow = self.rows.with_format("arrow")
        self._cache: dict[int, Episode] = {}
        self._cached_bytes = 0
        self._colours: dict[str, tuple[Path, Colours]] = {}
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

    @property
    def fps(self) -> int:
        """Steps a second."""
        return int(self.meta.fps)

    @property
    def episodes(self) -> Sequence[int]:
        """All episodes."""
        return range(int(self.meta.total_episodes))

    @property
    def cameras(self) -> dict[str, Camera]:
        """Every camera as it is."""
        return {k: Camera() for k in (*self.meta.video_keys, *self.meta.image_keys) if k not in self.meta.depth_keys}

    @property
    def deltas(self) -> DeltaJoints | None:
        """Deltas of which the dataset's own history tells; None where it tells of none."""
        now = current_description(self.history())
        return None if now is None else parse(now, self.features, self.root)

    @property
    def bounds(self) -> Bounds | None:
        """Bounds that an earlier operation put into the statistics, as long as they are still there."""
        for entry in reversed(self.history()):
            if "bounds" in entry:
                low, high = (np.asarray(entry["bounds"][k], np.float64) for k in ("low", "high"))
                there = (self.meta.stats or {}).get("action", {})
                same = all(k in there and np.allclose(there[k], v) for k, v in (("min", low), ("max", high)))
                return Bounds(low, high) if same else None
        return None

    def settle(self, written: Sequence[int]) -> None:
        """No-op: nothing here depends on what is written."""

    def history(self) -> list[dict[str, Any]]:
        """Operations that led to this dataset, as its own file tells."""
        return read_history(self.root)

    def video_path(self, episode: int, key: str) -> Path:
        """File that holds the episode's pictures of a camera stored as video."""
        return self.root / str(self.meta.get_video_file_path(episode, key))

    def without_place(self, text: str) -> str:
        """A sentence for the history, which others will read: files without the folder of this machine."""
        return text.replace(f"{self.root}/", "")

    def check_videos(self, episodes: Sequence[int] | None = None) -> None:
        """Make sure that every video file is there.

        Raises:
            DataError: naming the first missing file.
        """
        for key in self.meta.video_keys:
            for episode in self.episodes if episodes is None else episodes:
                path = self.video_path(episode, key)
                if not path.is_file():
                    raise DataError(f"Video file {path} of episode {episode} is missing; restore it.")

    def episode(self, index: int) -> Episode:
        """Numbers and strings of one episode.

        Raises:
            DataError: the episode is empty or not where its metadata says, its timestamps do not fit the frame rate,
                or a number is NaN, infinite or missing.
        """
        if index in self._cache:
            return self._cache[index]
        row = self.meta.episodes[index]
        start, stop = int(row["dataset_from_index"]), int(row["dataset_to_index"])
        table = self._arrow[start:stop]
        if stop <= start or set(table["episode_index"].to_pylist()) != {index}:
            raise DataError(f"{self.root}: rows {start}:{stop} are not those of episode {index}; the index is damaged.")
        times = np.asarray(table["timestamp"].to_numpy(), dtype=np.float64)
        _refuse_uneven(index, times, self.fps)
        columns: dict[str, Any] = {}
        for key, feature in self.features.items():
            if feature["dtype"] not in NOT_NUMBERS:
                columns[key] = _column(index, key, feature, table[key])
        names = self.meta.tasks.index
        tasks = [str(names[i]) for i in table["task_index"].to_pylist()]
        episode = Episode(index, start, np.arange(len(tasks), dtype=np.int64), times, columns, tasks)
        self._remember(episode)
        return episode

    def camera_frames(
        self,
        episode: Episode,
        steps: NDArray[np.int64],
        cameras: Mapping[str, Camera] | None = None,
        *,
        decoded: bool = False,
    ) -> Iterator[dict[str, Any]]:
        """As :meth:`View.camera_frames`; ``episode`` may be what a view made of the one here."""
        wanted = self.cameras if cameras is None else cameras
        stills = [k for k in wanted if k in self.meta.image_keys]
        videos = {k: self._video(episode, k, steps) for k in wanted if k in self.meta.video_keys}
        for step in steps:
            pictures = {k: next(frames).shaped(wanted[k]) for k, frames in videos.items()}
            row = int(episode.start + episode.frames[step])
            single = {k: shaped(self._still(episode, k, row), wanted[k]) for k in stills}
            yield single | (pictures if decoded else {k: p.rgb() for k, p in pictures.items()})

    def _video(self, episode: Episode, key: str, steps: NDArray[np.int64]) -> Iterator[Decoded]:
        """Pictures of a camera; raises DataError where they are of another size or colour space than they should be."""
        offset = float(self.meta.episodes[episode.index][f"videos/{key}/from_timestamp"])
        path, declared = self.video_path(episode.index, key), picture_size(self.features[key])
        times = offset + episode.times[steps]
        for picture in video_pictures(path, times, self.fps, episode.index, episode.frames[steps]):
            if picture.size != declared:
                raise DataError(
                    f"Video {path}: its pictures are {picture.size[0]}x{picture.size[1]}, but meta/info.json says"
                    f" {declared[0]}x{declared[1]} (height x width); correct the shape of '{key}' there."
                )
            first, colours = self._colours.setdefault(key, (path, picture.colours))
            if colours != picture.colours:
                raise DataError(
                    f"Video {path}: its colours ({picture.colours}) are not those of {first} ({colours}); encode both"
                    " alike before they come into one dataset."
                )
            yield picture

    def _still(self, episode: Episode, key: str, row: int) -> NDArray[np.uint8]:
        try:
            return np.asarray(self.rows.with_format(None)[row][key].convert("RGB"))
        except (OSError, AttributeError, SyntaxError) as error:
            frame = row - episode.start
            raise DataError(f"Episode {episode.index}, frame {frame}: the picture '{key}' cannot be read.") from error

    def _remember(self, episode: Episode) -> None:
        size = sum(getattr(v, "nbytes", 0) for v in episode.columns.values())
        if self._cached_bytes + size <= CACHE_BYTES:
            self._cache[episode.index] = episode
            self._cached_bytes += size


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
            f" cqn-data convert --from=lerobot_v21 --input={folder} --new_repo_id={repo_id}_v30 --new_root={folder}_v30"
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


def _column(episode: int, key: str, feature: dict[str, Any], values: Any) -> Any:
    """(T, …) array of one column, or list of T strings."""
    if feature["dtype"] == "string":
        return values.to_pylist()
    flat = values.combine_chunks() if isinstance(values, pa.ChunkedArray) else values
    if isinstance(flat, pa.ChunkedArray):  # some versions keep an empty or extension column in chunks
        flat = pa.concat_arrays(flat.chunks)
    if pa.types.is_list(flat.type) or pa.types.is_fixed_size_list(flat.type):
        flat = flat.flatten()
    if isinstance(flat, pa.ExtensionArray):  # matrices
        array = np.asarray(values.to_pylist(), dtype=feature["dtype"])
    else:
        array = flat.to_numpy(zero_copy_only=False)
    try:
        array = np.asarray(array).reshape(len(values), *feature["shape"])
        missing = array.dtype == object
    except ValueError:
        missing = True
    if missing:
        raise DataError(f"Episode {episode}: '{key}' has missing values or another size than {feature['shape']}.")
    array = array.astype(feature["dtype"])  # a copy that outlives the table
    if np.issubdtype(array.dtype, np.floating):
        bad = ~np.isfinite(array.reshape(len(array), -1)).all(axis=1)
        if bad.any():
            frame = int(np.flatnonzero(bad)[0])
            raise DataError(f"Episode {episode}, frame {frame}: '{key}' is not finite; drop or mend this episode.")
    return array


def _refuse_uneven(episode: int, times: NDArray[np.float64], fps: int) -> None:
    uneven = np.flatnonzero(np.abs(np.diff(times) * fps - 1) > JITTER)
    if len(uneven):
        frame = int(uneven[0]) + 1
        raise DataError(
            f"Episode {episode}, frame {frame}: {times[frame] - times[frame - 1]:.4f} s after the frame before it, not"
            f" {1 / fps:.4f} s at {fps} fps; record at one rate, or drop this episode."
        )
