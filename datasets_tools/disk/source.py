"""A local LeRobotDataset v3, read without ever touching it or the network."""

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.io_utils import load_nested_dataset
from lerobot.utils.constants import DEFAULT_FEATURES
from numpy.typing import NDArray

from lerobot_cqn.delta_actions import DeltaJoints, current_description, parse
from lerobot_cqn.errors import DataError

from ..views.episode import Bounds, Camera, Episode
from ..views.view import View
from .columns import places, read_column, refuse_disorder, refuse_uneven, tasks_by_index
from .decoded import Colours, Decoded
from .fetch import fetched
from .folders import local_root
from .pictures import picture_size, shaped, video_pictures
from .target import read_history
from .timing import distances, picture_times

__all__ = ["Source", "open_source"]

CACHE_BYTES = 256 * 2**20
NOT_NUMBERS = ("image", "video", "language")  # what an episode does not hold in memory


class Source(View):
    """A dataset on disk, opened by :func:`open_source`; episodes are read one at a time.

    Attributes:
        meta: LeRobot's metadata.
        root: its folder.
        tasks: sentence of each task_index.
    """

    def __init__(self, meta: LeRobotDatasetMetadata, root: Path) -> None:
        self.meta = meta
        self.root = root
        self.rows = load_nested_dataset(root / "data", features=get_hf_features_from_features(meta.features))
        self._arrow = self.rows.with_format("arrow")
        self._cache: dict[int, Episode] = {}
        self._cached_bytes = 0
        self._picture_times: dict[Path, NDArray[np.float64]] = {}
        self._colours: dict[str, tuple[Path, Colours]] = {}
        self._places = places(np.asarray(self.rows.data.column("episode_index").to_numpy()))
        self.tasks = tasks_by_index(root, meta.tasks)
        if len(self.rows) != meta.total_frames:
            raise DataError(
                f"{root}: meta/info.json declares {meta.total_frames} frames, the parquet files hold"
                f" {len(self.rows)}; record or download the dataset again."
            )
        listed = [int(i) for i in meta.episodes["episode_index"]]
        if listed != list(range(meta.total_episodes)):
            lacking = [i for i in range(max(listed, default=0)) if i not in set(listed)][:8]
            raise DataError(
                f"{root}: meta/episodes lists {len(listed)} episodes out of order or with gaps (lacking"
                f" {', '.join(map(str, lacking)) or 'none'}); restore them, and leave episodes out with cqn-data drop."
            )

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """The features a recorder gave, without LeRobot's own index columns; shapes are tuples."""
        own = {k: v for k, v in self.meta.features.items() if k not in DEFAULT_FEATURES}
        return {k: {**v, "shape": tuple(v["shape"])} for k, v in own.items()}

    @property
    def fps(self) -> float:
        """Steps a second; an int where it is a whole number."""
        rate = float(self.meta.fps)
        return int(rate) if rate.is_integer() else rate

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
        table = self.table(index)
        refuse_disorder(index, np.asarray(table["frame_index"].to_numpy()))
        recorded = np.asarray(table["timestamp"].to_numpy(), dtype=np.float64)
        refuse_uneven(index, recorded, self.fps)
        columns: dict[str, Any] = {}
        for key, feature in self.features.items():
            if feature["dtype"] not in NOT_NUMBERS:
                columns[key] = read_column(index, key, feature, table[key])
        tasks = [self._task(index, number) for number in table["task_index"].to_pylist()]
        frames = np.arange(len(tasks), dtype=np.int64)
        # Where there are as many pictures as rows they belong to one another in order, whatever a clock said.
        times = frames / self.fps if self._pictures_in(index) in (None, len(tasks)) else recorded
        episode = Episode(index, self._places[index][0], frames, times, columns, tasks)
        self._remember(episode)
        return episode

    def recorded_times(self, index: int) -> NDArray[np.float64]:
        """(T,) time stamps of an episode as they are in the table, which LeRobot's loader takes, in seconds."""
        return np.asarray(self.table(index)["timestamp"].to_numpy(), dtype=np.float64)

    def table(self, index: int) -> Any:
        """Rows of an episode as an Arrow table, wherever they lie in the data files.

        Raises:
            DataError: they are not as many as its metadata says, or lie in several places.
        """
        length, (start, stop) = int(self.meta.episodes[index]["length"]), self._places.get(index, (0, 0))
        if stop - start != length or length < 1:
            raise DataError(
                f"{self.root}: meta/episodes says that episode {index} has {length} rows, the data files hold"
                f" {stop - start} of it in one piece; the index is damaged, or the episode empty: drop it."
            )
        return self._arrow[start:stop]

    @cached_property
    def in_order(self) -> bool:
        """Whether rows, their numbers and tasks are where LeRobot looks for them: by their place, from 0."""
        starts = [self._places.get(i, (-1, 0))[0] for i in self.episodes]
        numbers = np.asarray(self.rows.data.column("index").to_numpy())
        return (
            starts == [int(start) for start in self.meta.episodes["dataset_from_index"]]
            and starts == sorted(starts)
            and bool((numbers == np.arange(len(numbers))).all())
            and list(self.tasks) == list(range(len(self.tasks)))
        )

    def _task(self, index: int, number: int) -> str:
        if number not in self.tasks:
            raise DataError(
                f"Episode {index}: task_index {number} is not in {self.root}/meta/tasks.parquet; add it there."
            )
        return self.tasks[number]

    def drift(self, index: int, times: NDArray[np.float64]) -> float:
        """Largest distance, in seconds, between rows of an episode that lie at (T,) ``times`` in it and their pictures.

        Raises:
            DataError: a row has no picture of its own.
        """
        worst = 0.0
        for key in self.meta.video_keys:
            path, offset = self.video_path(index, key), self.span(index, key)[0]
            if path not in self._picture_times:
                self._picture_times[path] = picture_times(path)
            apart = distances(path, self._picture_times[path], offset + times, self.fps, index)
            worst = max(worst, float(apart.max()))
        return worst

    def span(self, index: int, key: str) -> tuple[float, float]:
        """Seconds in the file of a camera between which an episode's pictures lie."""
        row = self.meta.episodes[index]
        return float(row[f"videos/{key}/from_timestamp"]), float(row[f"videos/{key}/to_timestamp"])

    def _pictures_in(self, index: int) -> int | None:
        """How many pictures each camera has of an episode; None without videos, -1 where they do not agree."""
        spans = (self.span(index, key) for key in self.meta.video_keys)
        found = {round((stop - start) * self.fps) for start, stop in spans}
        return None if not found else found.pop() if len(found) == 1 else -1

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
        """Pictures of a camera; raises DataError for rows beyond them, another size, or other colours than before."""
        (offset, end), path = self.span(episode.index, key), self.video_path(episode.index, key)
        times, declared = offset + episode.times[steps], picture_size(self.features[key])
        beyond = np.flatnonzero(times > end - 0.5 / self.fps)
        if len(beyond):
            raise DataError(
                f"Video {path}: the pictures of episode {episode.index} end at {end:.3f} s, before frame"
                f" {int(episode.frames[steps][beyond[0]])} at {times[beyond[0]]:.3f} s; cut such rows off (cqn-data"
                " trim), or drop the episode."
            )
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
            picture = self.rows.with_format(None)[row][key]
            if picture.mode[0] in "IF":  # converting them would cut everything above 255 off
                raise DataError(
                    f"Episode {episode.index}, frame {row - episode.start}: the picture '{key}' has more than 8 bits"
                    f" ({picture.mode}), as depth has; take the column out first: lerobot-edit-dataset"
                    " --operation.type=remove_feature."
                )
            return np.asarray(picture.convert("RGB"))
        except (OSError, AttributeError, SyntaxError) as error:
            frame = row - episode.start
            raise DataError(f"Episode {episode.index}, frame {frame}: the picture '{key}' cannot be read.") from error

    def _remember(self, episode: Episode) -> None:
        size = sum(getattr(v, "nbytes", 0) for v in episode.columns.values())
        if self._cached_bytes + size <= CACHE_BYTES:
            self._cache[episode.index] = episode
            self._cached_bytes += size


def open_source(repo_id: str, root: str | None, revision: str | None = None) -> Source:
    """Open a dataset on this disk; one that is not here, and has the name of one on the Hub, is downloaded.

    Args:
        repo_id: ``user/name``.
        root: its folder, which is never downloaded to; by default LeRobot's home and the name, then LeRobot's cache.
        revision: branch, tag or commit on the Hub; what lies in LeRobot's home is left aside for it.

    Raises:
        DataError: nothing there, another format version, empty, or damaged.
    """
    folder = local_root(repo_id, root)
    if root is None and (revision is not None or not (folder / "meta/info.json").is_file()):
        folder = fetched(repo_id, revision)
    elif revision is not None:
        raise DataError(
            f"--revision={revision} names a state on the Hub, --root={root} a folder here: give one of them."
        )
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
