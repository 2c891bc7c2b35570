"""Judgements of ``cqn-data inspect`` on ``meta/stats.json``: whether it is there and is of this data."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from lerobot_cqn.scaling_check import ENDS, MOST_CUT, REMEDY, cut_share, rows_of
from lerobot_cqn.schema import ACTION, STATE

from ..disk.source import Source
from .finding import Finding, names_text
from .numbers import Numbers

__all__ = ["statistics"]

WHERE = "meta/stats.json"
ADVICE = REMEDY[0].upper() + REMEDY[1:] + "."
SLACK, MOMENTS = 1e-3, 0.02  # of the range


def statistics(source: Source, numbers: Numbers) -> Iterator[Finding]:
    """Missing statistics, and those that are not of the states and actions that were read."""
    stats: Mapping[str, Any] = source.meta.stats or {}
    lacking = [k for k in (STATE, ACTION) if k in source.features and not set(ENDS) <= set(stats.get(k) or {})]
    if lacking:
        text = f"There is no smallest and largest {' and '.join(lacking)}, which scale them to [-1, 1] in training."
        yield Finding("error", "no_statistics", WHERE, text, ADVICE)
    try:
        bounded = source.bounds is not None
    except Exception:  # a damaged history is not what is judged here
        bounded = False
    for key in (STATE, ACTION):
        if numbers.episodes and key in source.features and key not in lacking:
            yield from _of_this_data(source, numbers, key, stats[key], bounded=bounded and key == ACTION)
            yield from _moments(source, numbers, key, stats[key])
    named, kept = int(source.meta.info.total_tasks), len(source.tasks)
    if named != kept:
        text = f"meta/info.json counts {named} tasks, meta/tasks.parquet has {kept}."
        yield Finding(
            "warning", "task_count", "meta/tasks.parquet", text, "Any operation of cqn-data writes both anew."
        )


def _moments(source: Source, numbers: Numbers, key: str, stats: Mapping[str, Any]) -> Iterator[Finding]:
    """Mean and standard deviation, which CQN does not use and other policies do."""
    dimensions = numbers.of(key)
    if numbers.bad or any(len(np.reshape(stats.get(name, ()), -1)) != len(dimensions) for name in ("mean", "std")):
        return
    count, total, squares = 0, np.zeros(len(dimensions)), np.zeros(len(dimensions))
    origin = np.array([d.low for d in dimensions])
    for rows in rows_of(source.root, key):
        count, total, squares = (
            count + len(rows), total + (rows - origin).sum(axis=0), squares + ((rows - origin) ** 2).sum(axis=0)
        )  # fmt: skip
    mean = total / max(count, 1)
    std = np.sqrt(np.maximum(squares / max(count, 1) - mean**2, 0))
    given_mean, given_std = (np.asarray(stats[name], np.float64).reshape(-1) for name in ("mean", "std"))
    spans = np.array([d.high - d.low for d in dimensions])
    off = (np.abs(given_mean - mean - origin) > MOMENTS * spans + 1e-6) | (
        np.abs(given_std - std) > MOMENTS * spans + 1e-6
    )
    if off.any():
        names = names_text([d for d, o in zip(dimensions, off, strict=True) if o])
        text = f"Mean and standard deviation of {key} are not of this data: {names}. CQN does not use them."
        yield Finding("warning", "stale_moments", WHERE, text, f"For other policies: {ADVICE[0].lower()}{ADVICE[1:]}")


def _of_this_data(
    source: Source, numbers: Numbers, key: str, stats: Mapping[str, Any], *, bounded: bool
) -> Iterator[Finding]:
    dimensions = numbers.of(key)
    low, high = (np.asarray(stats[end], np.float64).reshape(-1) for end in ENDS)
    if not len(low) == len(high) == len(dimensions):
        text = f"It has {min(len(low), len(high))} values of {key}, which has {len(dimensions)} dimensions."
        yield Finding("error", "stale_statistics", WHERE, text, ADVICE)
        return
    if bounded:
        return
    share = cut_share(rows_of(source.root, key), low, high)
    found = np.array([[d.low, d.high] for d in dimensions])
    off = np.abs(np.stack([low, high], axis=1) - found).max(axis=1) > SLACK * np.ptp(found, axis=1) + 1e-6
    if not numbers.bad and off.any():
        worst = int(np.argmax(np.where(off, share, -1)))
        text = (
            f"It is not of this data: {names_text([d for d, o in zip(dimensions, off, strict=True) if o])} of {key};"
            f" '{dimensions[worst].name}' is {found[worst, 0]:.4g} to {found[worst, 1]:.4g}, by the file"
            f" {low[worst]:.4g} to {high[worst]:.4g}, outside of which {share[worst]:.0%} of the values lie."
        )
        level = "error" if share[worst] > MOST_CUT else "warning"
        yield Finding(level, "stale_statistics", WHERE, text, ADVICE)  # type: ignore[arg-type]
