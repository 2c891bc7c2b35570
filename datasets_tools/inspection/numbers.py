"""Measures of ``cqn-data inspect`` on states, actions and rewards. Episodes stream by; only sums are kept.

Shapes: T time steps of one episode, E episodes, S state dimensions, A action dimensions, J joints that have both.
"""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import DataError
from lerobot_cqn.schema import ACTION, NEXT_REWARD, NEXT_SUCCESS, STATE, dimension_names

from ..decisions.angles import full_turn, turned
from ..decisions.joints import gripper_dims, rate_dims
from ..decisions.pause_threshold import Motion, Suggestion
from ..decisions.pauses import DRIVES, drives, pause_runs
from ..decisions.rewards import demonstration_end
from ..disk.columns import refuse_infinite
from ..disk.source import Source
from ..views.episode import Episode
from .action_lag import Follow

__all__ = ["DRAWN", "Dimension", "EpisodeNumbers", "Jump", "Numbers", "measure"]

FAR, LARGE = 8.0, 0.1  # a jump is so many times the change that one in twenty exceeds, and so much of the range
MAX_JUMPS = 20
DRAWN = 40  # episodes whose pauses are drawn
RANGE_BINS = 400
OPEN, SHUT = 0.35, 0.65  # of a gripper's range; in between it keeps what it was

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Jump:
    """One value more than ``limit`` from its neighbour; ``back`` when the next one has returned, as misreadings do."""

    episode: int
    frame: int
    column: str
    name: str
    change: float
    limit: float
    back: bool


@dataclass
class EpisodeNumbers:
    """One episode.

    Attributes:
        index, steps: its number and length T.
        jitter: largest deviation of a time step from 1 / fps, as a share of it.
        digest: of states and actions.
        still: share of steps that move less than the suggested threshold, [0, 1].
        still_start, still_end: lengths of the pauses at its two ends, steps.
        runs: (first step, length) of the pauses; of the first episodes only.
        gripper_events: how often the gripper opens or closes; None without a gripper.
        first_reward: frame of the first positive reward; None where there is none.
        end: last frame of the demonstration, as cqn-train takes it.
        dense: share of the frames up to there with a reward other than 0, [0, 1].
        success: whether it succeeded; None where the dataset does not say.
    """

    index: int
    steps: int
    jitter: float
    digest: str
    first_reward: int | None = None
    end: int | None = None
    dense: float = 0.0
    success: bool | None = None
    still: float = 0.0
    still_start: int = 0
    still_end: int = 0
    runs: tuple[tuple[int, int], ...] = ()
    gripper_events: int | None = None


@dataclass
class Dimension:
    """One dimension of state or action: range, and the range without the outer percent on either side.

    Attributes:
        gripper, rate: whether its name says that it is a gripper, or a velocity.
        turned: (episode, frame) of the first change by nearly a full turn, which angles that wrap have; None without.
    """

    column: str
    name: str
    gripper: bool
    rate: bool = False
    low: float = np.inf
    high: float = -np.inf
    inner_low: float = 0.0
    inner_high: float = 0.0
    turned: tuple[int, int] | None = None
    histogram: NDArray[np.int64] = field(default_factory=lambda: np.zeros(RANGE_BINS, np.int64), repr=False)

    @property
    def constant(self) -> bool:
        """Never changes, in any episode."""
        return not self.high > self.low


@dataclass
class Numbers:
    """Everything measured; episodes that cannot be read are in ``bad`` with the reason.

    ``rewarded`` and ``judged``: whether there is a column of rewards, of successes; ``infinite``: the first episode and
    frame of columns that training does not read and that are not finite.
    """

    episodes: list[EpisodeNumbers] = field(default_factory=list)
    bad: dict[int, str] = field(default_factory=dict)
    dimensions: list[Dimension] = field(default_factory=list)
    threshold: Suggestion | None = None
    jumps: list[Jump] = field(default_factory=list)
    jump_count: int = 0
    tasks: dict[str, int] = field(default_factory=dict)
    rewarded: bool = False
    judged: bool = False
    follow: Follow | None = None
    infinite: dict[str, tuple[int, int]] = field(default_factory=dict)

    @property
    def steps(self) -> int:
        """Of all episodes that can be read."""
        return sum(e.steps for e in self.episodes)

    def of(self, column: str) -> list[Dimension]:
        """Dimensions of the state or the action, in order."""
        return [d for d in self.dimensions if d.column == column]


def measure(source: Source, advance: Callable[[], None] = lambda: None) -> Numbers:
    """Look at all episodes twice: for ranges and the threshold, then for what needs these.

    Args:
        source: an opened dataset.
        advance: called after each episode of each round.
    """
    numbers = Numbers(rewarded=NEXT_REWARD in source.features, judged=NEXT_SUCCESS in source.features)
    for column in (STATE, ACTION):
        if column in source.features:
            names = dimension_names(source.features[column])
            grippers, rates = gripper_dims(names), rate_dims(names)
            numbers.dimensions += [Dimension(column, n, i in grippers, i in rates) for i, n in enumerate(names)]
    joints = [i for i, d in enumerate(numbers.of(STATE)) if not d.gripper and not d.rate]
    motion, commanded, numbers.follow = Motion(), Motion(), Follow.of(source)
    for episode in _readable(source, numbers, advance):
        _first_look(source, episode, numbers)
        if STATE in episode.columns and joints:
            motion.add(_vectors(episode, STATE)[:, joints])
        if ACTION in episode.columns:
            commanded.add(_vectors(episode, ACTION))
    if STATE in source.features and joints:
        numbers.threshold = motion.suggest()
    limits = {STATE: _far(numbers.of(STATE), joints, motion)}
    if numbers.follow is not None and numbers.follow.kind() == "absolute":
        limits[ACTION] = _far(numbers.of(ACTION), range(len(numbers.of(ACTION))), commanded)
    for summary in numbers.episodes:
        _second_look(source.episode(summary.index), summary, numbers, joints, limits)
        advance()
    numbers.jumps = sorted(numbers.jumps, key=lambda j: -abs(j.change) / j.limit)[:MAX_JUMPS]
    for dimension in numbers.dimensions:
        _inner_range(dimension)
    return numbers


def _readable(source: Source, numbers: Numbers, advance: Callable[[], None]) -> Iterator[Episode]:
    for index in source.episodes:
        try:
            episode = source.episode(index)
            refuse_infinite(episode)
        except DataError as error:
            numbers.bad[index] = str(error)
        else:
            yield episode
        advance()


def _vectors(episode: Episode, column: str) -> Array:
    """(T, D) of one column."""
    return np.asarray(episode.columns[column], np.float64).reshape(len(episode), -1)


def _first_look(source: Source, episode: Episode, numbers: Numbers) -> None:
    for column in (STATE, ACTION):
        if column in episode.columns:
            values = _vectors(episode, column)
            for dimension, low, high in zip(numbers.of(column), values.min(axis=0), values.max(axis=0), strict=True):
                dimension.low, dimension.high = min(dimension.low, float(low)), max(dimension.high, float(high))
    if numbers.follow is not None:
        numbers.follow.add(episode.index, _vectors(episode, ACTION), _vectors(episode, STATE))
    for task in episode.tasks:
        numbers.tasks[task] = numbers.tasks.get(task, 0) + 1
    for key, values in episode.columns.items():
        if key not in numbers.infinite and np.issubdtype(np.asarray(values).dtype, np.floating):
            bad = np.flatnonzero(~np.isfinite(_vectors(episode, key)).all(axis=1))
            if len(bad):
                numbers.infinite[key] = (episode.index, int(bad[0]))
    uneven = np.abs(np.diff(source.recorded_times(episode.index)) * source.fps - 1)
    summary = EpisodeNumbers(episode.index, len(episode), float(uneven.max(initial=0.0)), _digest(episode))
    if NEXT_REWARD in episode.columns:
        paid = np.flatnonzero(_vectors(episode, NEXT_REWARD)[:, 0] > 0)
        summary.first_reward = int(paid[0]) if len(paid) else None
        summary.success = bool(len(paid))
    if NEXT_SUCCESS in episode.columns:
        summary.success = bool(np.asarray(episode.columns[NEXT_SUCCESS], bool).any())
    summary.end, _ = demonstration_end(episode.columns, len(episode))
    if NEXT_REWARD in episode.columns:
        summary.dense = float((_vectors(episode, NEXT_REWARD)[: summary.end + 1, 0] != 0).mean())
    numbers.episodes.append(summary)


def _second_look(
    episode: Episode, summary: EpisodeNumbers, numbers: Numbers, joints: list[int], limits: dict[str, Array]
) -> None:
    for column in (STATE, ACTION):
        if column not in episode.columns:
            continue
        values = _vectors(episode, column)
        for position, dimension in enumerate(numbers.of(column)):
            if not dimension.constant:
                dimension.histogram += np.histogram(values[:, position], RANGE_BINS, (dimension.low, dimension.high))[0]
        _find_turns(episode.index, values, numbers.of(column))
        if column in limits:
            _find_jumps(episode.index, values, column, numbers, limits[column])
    if numbers.threshold is not None and len(episode) > 1 and joints:
        moves = np.abs(np.diff(_vectors(episode, STATE)[:, joints], axis=0)).max(axis=1)
        goes = (moves >= numbers.threshold.threshold) | _drives(episode, numbers)[:-1]
        moving = np.flatnonzero(goes)
        summary.still = 1 - len(moving) / len(moves)
        if summary in numbers.episodes[:DRAWN]:
            summary.runs = pause_runs(goes)
        summary.still_start = int(moving[0]) if len(moving) else len(moves)
        summary.still_end = len(moves) - 1 - int(moving[-1]) if len(moving) else 0
    summary.gripper_events = _gripper_events(episode, numbers)


def _drives(episode: Episode, numbers: Numbers) -> NDArray[np.bool_]:
    """(T,) steps at which a velocity is above what a filter takes for rest."""
    found = np.zeros(len(episode), bool)
    for column in (STATE, ACTION):
        rates = [(i, DRIVES * max(abs(d.low), abs(d.high))) for i, d in enumerate(numbers.of(column)) if d.rate]
        if rates and column in episode.columns:
            dims, limits = zip(*rates, strict=True)
            found |= drives(_vectors(episode, column), dims, limits)
    return found


def _find_turns(index: int, values: Array, dimensions: list[Dimension]) -> None:
    low, high = (np.array([getattr(d, end) for d in dimensions]) for end in ("low", "high"))
    for step, place in np.argwhere(turned(np.diff(values, axis=0), full_turn(low, high))):
        dimension = dimensions[place]
        dimension.turned = dimension.turned or (index, int(step) + 1)


def _far(dimensions: list[Dimension], places: Sequence[int], motion: Motion) -> Array:
    """(D,) change beyond which a step is a jump; infinite for grippers and what never moves."""
    limit = np.full(len(dimensions), np.inf)
    for place, usual in zip(places, motion.brisk_changes(), strict=False):  # none where there was no episode
        dimension = dimensions[place]
        if usual > 0 and not dimension.gripper:
            limit[place] = max(FAR * usual, LARGE * (dimension.high - dimension.low))
    return limit


def _find_jumps(index: int, values: Array, column: str, numbers: Numbers, limit: Array) -> None:
    changes = np.diff(values, axis=0)
    dimensions = numbers.of(column)
    found: list[Jump] = []
    skip: set[tuple[int, int]] = set()
    for step, joint in np.argwhere(np.abs(changes) > limit):
        if (int(step), int(joint)) in skip:
            continue  # the way back from a wrong reading
        change = float(changes[step, joint])
        back = step + 1 < len(changes) and abs(changes[step + 1, joint] + change) < 0.2 * abs(change)
        if back:
            skip.add((int(step) + 1, int(joint)))
        most = float(limit[joint])
        found.append(Jump(index, int(step) + 1, column, dimensions[joint].name, change, most, bool(back)))
    numbers.jump_count += len(found)
    largest = sorted([*numbers.jumps, *found], key=lambda j: -abs(j.change) / j.limit)
    numbers.jumps = largest[:MAX_JUMPS]


def _gripper_events(episode: Episode, numbers: Numbers) -> int | None:
    """Openings and closings, with a dead zone in the middle; from the command where there is one."""
    for column in (ACTION, STATE):
        chosen = [(i, d) for i, d in enumerate(numbers.of(column)) if d.gripper]
        if chosen:
            values = _vectors(episode, column)
            return sum(_crossings(values[:, i], d.low, d.high) for i, d in chosen if not d.constant)
    return None


def _crossings(values: Array, low: float, high: float) -> int:
    place = (values - low) / (high - low)
    sides = np.where(place > SHUT, 1, np.where(place < OPEN, -1, 0))
    decided = sides[sides != 0]
    return int((decided[1:] != decided[:-1]).sum())


def _inner_range(dimension: Dimension) -> None:
    total = int(dimension.histogram.sum())
    dimension.inner_low, dimension.inner_high = dimension.low, dimension.high
    if dimension.constant or total == 0:
        return
    summed = np.cumsum(dimension.histogram) / total
    width = (dimension.high - dimension.low) / RANGE_BINS
    dimension.inner_low = dimension.low + width * int(np.searchsorted(summed, 0.01))
    dimension.inner_high = dimension.low + width * (int(np.searchsorted(summed, 0.99)) + 1)


def _digest(episode: Episode) -> str:
    joined = hashlib.sha256()
    for column in (STATE, ACTION):
        if column in episode.columns:
            values: NDArray[Any] = np.ascontiguousarray(episode.columns[column])
            joined.update(values.tobytes())
    return joined.hexdigest()
