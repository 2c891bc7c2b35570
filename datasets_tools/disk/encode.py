"""Write a view as a new dataset: pictures decoded once and encoded once, or not touched at all where none changes."""

import dataclasses
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from lerobot.configs import RGBEncoderConfig
from lerobot.datasets.compute_stats import sample_indices
from rich.progress import Progress

from lerobot_cqn.errors import DataError

from ..terminal.console import note
from ..views.episode import Camera
from ..views.view import View
from .decoded import Decoded
from .rewrite import all_features, rewrite, traced_columns, write_bounds
from .source import NOT_NUMBERS, Source
from .target import Target, new_dataset, skip_entry, write_history
from .timing import TOLERANCE

__all__ = ["Written", "pictures_unchanged", "write"]

KNOWN_META = {"info.json", "stats.json", "tasks.parquet", "cqn_history.json", "episodes"}


@dataclass
class Written:
    """State of the new dataset on disk.

    Attributes:
        episodes, frames: how many were written.
        copied: the video files are those of the source, byte by byte.
        skipped: episodes left out since they could not be read, with the reason.
    """

    episodes: int = 0
    frames: int = 0
    copied: bool = False
    skipped: dict[int, str] = field(default_factory=dict)


def write(
    view: View, source: Source, repo_id: str, root: Path, bar: Progress, *, skip: bool = False, crf: int | None = None
) -> Written:
    """Write ``view`` to ``root``, complete or not at all.

    Args:
        view: what is left after the last operation.
        source: the dataset at the bottom of it.
        repo_id: name of the new dataset.
        root: its folder, which must not exist.
        bar: progress to show.
        skip: leave out episodes whose pictures cannot be read, instead of stopping.
        crf: quality of new videos, as the codec counts it; None for the source's.

    Raises:
        DataError: nothing is left, or a picture cannot be read; names file, episode and frame.
        OutputExistsError: something is at ``root``.
    """
    lengths = {index: len(view.episode(index)) for index in view.episodes}
    if not lengths:
        raise DataError("No episode would be left; nothing was written.")
    empty = [i for i, n in lengths.items() if n == 0]
    if empty:
        raise DataError(f"Nothing would be left of episode {', '.join(map(str, empty[:5]))}; drop it instead.")
    single = [i for i, n in lengths.items() if n == 1]
    tables = [k for k, f in view.features.items() if f["dtype"] not in NOT_NUMBERS and len(f["shape"]) > 1]
    if single and tables:
        raise DataError(
            f"Episode {single[0]} has one step, of which LeRobot cannot keep statistics of '{tables[0]}'"
            f" {tuple(view.features[tables[0]]['shape'])}; leave such episodes out: cqn-data drop --where='steps < 2'."
        )
    try:
        if pictures_unchanged(view, source):
            rewrite(view, source, root, bar)
            return Written(len(lengths), sum(lengths.values()), copied=bool(source.meta.video_keys))
    except DataError:
        if not skip:
            raise
        note("Some videos cannot be copied as they are: what can be read of them is encoded anew.")
    return _encode(view, source, repo_id, root, bar, lengths, skip=skip, crf=crf)


def pictures_unchanged(view: View, source: Source) -> bool:
    """Whether every frame of every episode stays, as it is and where it is, and LeRobot finds it there."""
    if view.cameras != source.cameras or view.fps != source.fps:
        return False
    if list(view.episodes) != list(source.episodes):
        return False
    if not all(len(view.episode(i)) == len(source.episode(i)) for i in view.episodes):
        return False
    apart = max((source.drift(i, source.episode(i).times) for i in source.episodes), default=0.0)
    if apart > TOLERANCE:
        note(
            f"Rows and pictures are up to {1000 * apart:.3g} ms apart, which LeRobot refuses: videos are encoded anew."
        )
    return apart <= TOLERANCE


def _encode(
    view: View,
    source: Source,
    repo_id: str,
    root: Path,
    bar: Progress,
    lengths: dict[int, int],
    *,
    skip: bool,
    crf: int | None,
) -> Written:
    done = Written()
    _refuse_unknown_kinds(source)
    features = {k: {n: v for n, v in f.items() if n != "info"} for k, f in all_features(view).items()}
    encoder = _encoder(source, crf)
    unchanged = {
        k for k in view.cameras if view.cameras[k] == Camera() and encoder and _settings_of(source, k) == encoder
    }
    alike = {k for k in unchanged if _says_all(source, k)}
    _note_losses(source)
    line = bar.add_task("Writing frames", total=sum(lengths.values()))
    writer = new_dataset(
        repo_id, root, fps=view.fps, features=features, robot_type=source.meta.robot_type, encoder=encoder
    )
    with writer as target:
        kept: list[int] = []
        for index in view.episodes:
            try:
                for frame, task in _frames(view, index, alike, copied=unchanged if crf is None else set()):
                    target.add(frame, task)
                    bar.advance(line)
                target.save_episode()
                kept.append(index)
            except DataError as error:
                if not skip:
                    raise
                target.drop_episode()
                done.skipped[index] = source.without_place(str(error))
        if not kept:
            raise DataError(f"Not one episode could be read; the last one: {done.skipped[max(done.skipped)]}")
        _finish(view, target, kept, done)
        for table in _side_tables(source):
            shutil.copyfile(table, target.folder / "meta" / table.name)
    done.episodes, done.frames = len(kept), sum(lengths[i] for i in kept)
    return done


def _frames(view: View, index: int, alike: set[str], copied: set[str]) -> Iterator[tuple[dict[str, Any], str]]:
    """The steps of an episode as LeRobot frames.

    alike: cameras whose pictures are encoded as they were; copied: those whose bytes are taken over where they can be.
    """
    episode, columns = view.episode(index), traced_columns(view, index)
    rows, measured = np.arange(len(episode)), set(sample_indices(len(episode)))
    for row, pictures in enumerate(view.camera_frames(episode, rows, decoded=True)):
        for key, picture in pictures.items():
            if isinstance(picture, Decoded):
                pictures[key] = dataclasses.replace(
                    picture,
                    key=picture.key or key not in alike,
                    measured=row in measured,
                    coded=picture.coded if key in copied else None,
                )
        yield {**{k: v[row] for k, v in columns.items()}, **pictures}, episode.tasks[row]


def _finish(view: View, target: Target, kept: Sequence[int], done: Written) -> None:
    view.settle(kept)
    write_bounds(target.folder, view.bounds)
    skipped = [skip_entry(done.skipped)] if done.skipped else []
    write_history(target.folder, [*view.history(), *skipped])


def _refuse_unknown_kinds(source: Source) -> None:
    """LeRobot's writer takes neither annotations nor depth as they were read; copying them is no problem."""
    for key, feature in source.features.items():
        if feature["dtype"] == "language" or key in source.meta.depth_keys:
            kind = "language" if feature["dtype"] == "language" else "depth"
            raise DataError(
                f"'{key}' is a {kind} column, which can be carried along only where every frame stays as it is (label,"
                " delta, bounds); take it out first: lerobot-edit-dataset --operation.type=remove_feature."
            )
        if (feature.get("info") or {}).get("has_audio"):
            note(f"The sound of '{key}' is lost: LeRobot does not keep it when videos are encoded anew.")


def _encoder(source: Source, crf: int | None) -> RGBEncoderConfig | None:
    """The source's video settings, where this machine can encode them; else LeRobot's default."""
    settings = {k: source.meta.features[k].get("info") or {} for k in source.meta.video_keys}
    for key, info in settings.items():
        try:
            encoder = RGBEncoderConfig.from_video_info(info)
        except ValueError:
            note("The source's video codec cannot be encoded here; LeRobot's default is used.")
            return None if crf is None else RGBEncoderConfig(crf=crf)
        if any(_codec(other) != _codec(info) for other in settings.values()):
            note(f"The cameras were encoded differently; all are written like '{key}'.")
        return encoder if crf is None else dataclasses.replace(encoder, crf=crf)
    return None


def _settings_of(source: Source, key: str) -> RGBEncoderConfig | None:
    """How a camera's video was encoded, as far as the source says it; None without a video that can be encoded here."""
    try:
        info = source.meta.features[key].get("info") or {}
        return RGBEncoderConfig.from_video_info(info) if key in source.meta.video_keys else None
    except ValueError:
        return None


def _says_all(source: Source, key: str) -> bool:
    """Whether the source says of a video all that its quality depends on."""
    info = source.meta.features[key].get("info") or {}
    return all(info.get(f"video.{name}") is not None for name in ("codec", "pix_fmt", "g", "crf"))


def _codec(info: dict[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in info.items() if k not in ("video.height", "video.width", "video.fps")}


def _side_tables(source: Source) -> list[Path]:
    """Tables in ``meta/`` that are of the whole dataset, such as ``subtasks.parquet``, not of its episodes."""
    tables = [p for p in sorted((source.root / "meta").glob("*.parquet")) if p.name not in KNOWN_META]
    return [p for p in tables if not {"episode_index", "frame_index", "index"} & set(pq.read_schema(p).names)]


def _note_losses(source: Source) -> None:
    """Name what LeRobot's writer does not know and hence cannot write."""
    carried = {*KNOWN_META, *(p.name for p in _side_tables(source))}
    files = [p.name for p in sorted((source.root / "meta").iterdir()) if p.name not in carried]
    if files:
        note(f"Not carried over, since their meaning is unknown: meta/{', meta/'.join(files)}.")
    own = ("videos/", "data/", "meta/", "stats/", "dataset_", "episode_index", "tasks", "length")
    extra = [c for c in source.meta.episodes.column_names if not c.startswith(own)]
    if extra:
        note(f"Not carried over from meta/episodes: {', '.join(extra)}.")
