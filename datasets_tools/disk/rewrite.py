"""Write a view whose pictures do not change: videos copied byte by byte, only numbers and their statistics anew."""

import itertools
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import datasets
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.compute_stats import aggregate_stats, compute_episode_stats
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.io_utils import write_stats
from rich.progress import Progress

from ..views.episode import SOURCE_EPISODE, SOURCE_FRAME, Bounds
from ..views.view import View
from .folders import new_folder
from .source import NOT_NUMBERS, Source
from .target import write_history

__all__ = ["INDEX", "all_features", "rewrite", "traced_columns", "write_bounds"]

INDEX: dict[str, Any] = {"dtype": "int64", "shape": (1,), "names": None}
ANEW = ("data", "meta/info.json", "meta/tasks.parquet", "meta/stats.json", "meta/episodes", "meta/cqn_history.json")

type Stats = dict[str, dict[str, Any]]
type Places = dict[int, dict[str, int]]


def all_features(view: View) -> dict[str, dict[str, Any]]:
    """Features of the view and the two columns that say where each step was recorded."""
    return {SOURCE_EPISODE: dict(INDEX), SOURCE_FRAME: dict(INDEX)} | view.features


def traced_columns(view: View, index: int) -> dict[str, Any]:
    """An episode's columns with those of its recording; a dataset that has them keeps pointing further back."""
    episode = view.episode(index)
    frames = episode.frames[:, None]
    return {SOURCE_EPISODE: np.full_like(frames, episode.index), SOURCE_FRAME: frames} | episode.columns


def rewrite(view: View, source: Source, root: Path, bar: Progress) -> None:
    """Write ``view`` of ``source`` to ``root``; every frame of the source must still be in it.

    Raises:
        DataError: a file of the source cannot be read.
        OutputExistsError: something is at ``root``.
    """
    _refuse_cut_videos(source)
    with new_folder(root) as folder:
        _copy_rest(source.root, folder, bar)
        numbers = _task_numbers(view, source)
        stats, places = _write_numbers(view, source, folder, bar, numbers)
        _write_episodes(view, source, folder, stats, places)
        pd.DataFrame({"task_index": range(len(numbers))}, index=pd.Index(numbers, name="task")).to_parquet(
            folder / "meta/tasks.parquet"
        )
        known = source.meta.stats or _from_episodes(source)
        old = {k: v for k, v in known.items() if k in view.features or "." not in k}
        write_stats({**old, **aggregate_stats(list(stats.values()))}, folder)
        info = json.loads((source.root / "meta/info.json").read_text())
        own = {k: v for k, v in info["features"].items() if k not in source.features}
        info["total_tasks"] = len(numbers)
        info["features"] = {**_plain(all_features(view)), **own}
        (folder / "meta/info.json").write_text(json.dumps(info, indent=4) + "\n")
        view.settle(view.episodes)
        write_bounds(folder, view.bounds)
        write_history(folder, view.history())


def write_bounds(folder: Path, bounds: Bounds | None) -> None:
    """Put action bounds where training reads them: smallest and largest action in ``meta/stats.json``."""
    if bounds is None:
        return
    path = folder / "meta/stats.json"
    stats = json.loads(path.read_text())
    stats["action"] |= {"min": bounds.low.tolist(), "max": bounds.high.tolist()}
    path.write_text(json.dumps(stats, indent=4) + "\n")


def _refuse_cut_videos(source: Source) -> None:
    """Look at the last picture of every video file: what ends too early must not be copied as if it were whole."""
    last = {(key, source.video_path(i, key)): i for key in source.meta.video_keys for i in source.episodes}
    for (key, _), index in last.items():
        if key not in source.cameras:  # depth
            continue
        episode = source.episode(index)
        for _ in source.camera_frames(episode, np.array([len(episode) - 1]), {key: source.cameras[key]}):
            pass


def _copy_rest(source: Path, folder: Path, bar: Progress) -> None:
    files = [p for p in sorted(source.rglob("*")) if p.is_file() and not p.name.startswith(".")]
    files = [p for p in files if not any(p.relative_to(source).is_relative_to(name) for name in ANEW)]
    for path in bar.track(files, description="Copying files"):
        copy = folder / path.relative_to(source)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, copy)


def _write_numbers(
    view: View, source: Source, folder: Path, bar: Progress, task_numbers: dict[str, int]
) -> tuple[dict[int, Stats], Places]:
    """The data files, in the source's own partition where that is in order.

    Returns:
        each episode's statistics of the numbers, and where it lies: columns of ``meta/episodes``.
    """
    features = {**source.meta.features, **all_features(view)}
    schema = get_hf_features_from_features(features)
    numbers = {k: f for k, f in all_features(view).items() if f["dtype"] not in NOT_NUMBERS}
    stats: dict[int, Stats] = {}
    places: Places = {}
    written = 0
    line = bar.add_task("Writing episodes", total=len(view.episodes))
    for file, (path, episodes) in enumerate(_partition(source)):
        columns: dict[str, list[Any]] = {k: [] for k in numbers}
        times: list[float] = []
        chunk, number = divmod(file, source.meta.chunks_size)
        target = path if source.in_order else Path(source.meta.data_path.format(chunk_index=chunk, file_index=number))
        for index in episodes:
            times.extend(view.episode(index).times)
            own = traced_columns(view, index)
            flat = {k: v.reshape(len(v)) if f["shape"] == (1,) and f["dtype"] != "string" else v
                    for (k, f), v in ((item, own[item[0]]) for item in numbers.items())}  # fmt: skip
            stats[index] = compute_episode_stats(flat, numbers)
            for key, values in flat.items():
                columns[key].extend(values)
            stop = written + len(times)
            places[index] = {"dataset_from_index": stop - len(view.episode(index)), "dataset_to_index": stop}
            if not source.in_order:
                places[index] |= {"data/chunk_index": chunk, "data/file_index": number}
            bar.advance(line)
        fresh = datasets.Dataset.from_dict(columns, features=datasets.Features({k: schema[k] for k in numbers}))
        table, old = fresh.with_format("arrow")[:], pa.concat_tables([source.table(index) for index in episodes])
        new = {k: table[k] for k in numbers} | {
            "timestamp": pa.array(times, pa.float32()),
            "index": pa.array(range(written, written + len(times)), pa.int64()),
            "task_index": pa.array([task_numbers[t] for i in episodes for t in view.episode(i).tasks], pa.int64()),
        }
        arrays = [new[k] if k in new else old[k] for k in schema]
        written += len(times)
        (folder / target).parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table(arrays, schema=schema.arrow_schema), folder / target, compression="snappy")
    return stats, places


def _partition(source: Source) -> Iterator[tuple[Path, list[int]]]:
    """Data files with their episodes, in order; a file whose episodes lie apart comes several times."""
    for path, episodes in itertools.groupby(source.episodes, lambda i: Path(source.meta.get_data_file_path(i))):
        yield path, list(episodes)


def _task_numbers(view: View, source: Source) -> dict[str, int]:
    """Each task with its number, from 0: LeRobot takes the one in that place of the table. The source's order stays."""
    known = [source.tasks[number] for number in sorted(source.tasks)]
    used = dict.fromkeys(task for index in view.episodes for task in view.episode(index).tasks)
    kept = known if used.keys() <= set(known) else [task for task in known if task in used]
    return {task: number for number, task in enumerate(dict.fromkeys([*kept, *used]))}


def _write_episodes(view: View, source: Source, folder: Path, stats: dict[int, Stats], places: Places) -> None:
    """The episodes' metadata with the new statistics and places; all other columns stay."""
    for path in sorted((source.root / "meta/episodes").rglob("*.parquet")):
        table = pq.read_table(path)
        numbers = table["episode_index"].to_pylist()
        new = {f"stats/{key}/{name}": [np.asarray(stats[i][key][name]).tolist() for i in numbers]
               for key, kinds in stats[numbers[0]].items() for name in kinds}  # fmt: skip
        new |= {name: [places[i][name] for i in numbers] for name in places[numbers[0]]}
        new["tasks"] = [list(dict.fromkeys(view.episode(i).tasks)) for i in numbers]
        for name, values in new.items():
            if name in table.column_names:
                table = table.set_column(table.column_names.index(name), name, pa.array(values))
            else:
                table = table.append_column(name, pa.array(values))
        target = folder / path.relative_to(source.root)
        target.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, target)


def _from_episodes(source: Source) -> Stats:
    """Statistics of the whole from those that LeRobot keeps of each episode, where ``meta/stats.json`` is lost."""
    each: dict[int, Stats] = {index: {} for index in source.episodes}
    for path in sorted((source.root / "meta/episodes").rglob("*.parquet")):
        table = pq.read_table(path)
        for name in table.column_names:
            if name.startswith("stats/"):
                key, _, kind = name.removeprefix("stats/").rpartition("/")
                for index, value in zip(table["episode_index"].to_pylist(), table[name].to_pylist(), strict=True):
                    each.setdefault(index, {}).setdefault(key, {})[kind] = np.asarray(value)
    whole: Stats = aggregate_stats(list(each.values())) if all(each.values()) else {}
    return whole


def _plain(features: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    return {k: {**f, "shape": list(f["shape"])} for k, f in features.items()}
