"""Replay buffer: whole episodes, stored once; histories and n-step windows are put together when sampled."""

import json
from collections.abc import Callable, Collection, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lerobot_cqn.errors import ConfigError, DataError
from lerobot_cqn.n_step import n_step_return
from lerobot_cqn.schema import Batch, Observation
from lerobot_cqn.sequence import filled

from .damage import find_damage
from .episode import Episode
from .files import Journal, Place, Rows, earlier_layout, reserve_all
from .table import Table

__all__ = ["Replay"]

GIB = 2**30
BATCHES = 4  # whose pictures are in memory at a time


class Replay:
    """The replay: everything seen, with the demonstrations (and relabelled successes) flagged.

    Both stores of the paper are views of one: a sample comes from all episodes or from the flagged ones. Of an episode
    that is not flagged, the steps that a person drove count as a demonstration all the same. The demonstrations of the
    dataset come first and stay; behind them episodes go round in a ring, the oldest making room once the capacity is
    used up.
    """

    def __init__(
        self,
        frame_stack: int,
        n_step: int,
        discount: float,
        *,
        folder: Path | None = None,
        capacity_gib: float = 16.0,
        by_step: bool = False,
        full_windows: bool = False,
        sequence: int = 1,
        fill: str = "mask",
    ) -> None:
        """An empty replay.

        Args:
            frame_stack: S >= 1 observations of history.
            n_step: n >= 1.
            discount: of a step, (0, 1].
            folder: of its files, which survive a kill; None keeps everything in memory.
            capacity_gib: GiB of all rows together, demonstrations included; > 0.
            by_step: sample uniformly over time steps; else over episodes first, then over their steps.
            full_windows: start no n-step window that the episode's end would shorten, as long as one start is left.
            sequence: T >= 1, actions of a sample.
            fill: what stands for actions beyond an episode's end (`CQNASSettings.sequence_fill`).
        """
        self.frame_stack, self.n_step, self.discount = frame_stack, n_step, discount
        self.folder, self.by_step = folder, by_step
        self.sequence, self.fill = sequence, fill
        self._left_out = n_step - 1 if full_windows else 0  # starts at an episode's end
        self._capacity_bytes = int(capacity_gib * GIB)
        self._rows: dict[str, Rows] = {}
        self._places: list[Place] = []
        self._fixed = 0  # episodes of the dataset
        self._ring = 0  # first row behind them
        self._head = 0  # where the next episode goes
        self._reserved = 0
        self._sampled: Table | None = None
        self._buffers: dict[tuple[int, str], torch.Tensor] = {}
        self._turn = 0
        self._journal: Journal | None = None
        self._skip_damaged = False  # lines of the journal
        if folder is not None:
            self._journal = Journal(folder / "episodes.jsonl")

    @property
    def episodes(self) -> int:
        """Episodes stored."""
        return len(self._places)

    @property
    def places(self) -> Sequence[Place]:
        """Places of all episodes; those of the dataset come first, their `number` is -1."""
        return tuple(self._places)

    def values(self, name: str, place: Place) -> NDArray[Any]:
        """What the T steps of an episode hold: `low_dim` [T, P], `action` [T, D] or `reward` [T]."""
        values: NDArray[Any] = self._rows[name].take(np.arange(place.start, place.stop - 1)).numpy()
        return values

    @property
    def demonstrations(self) -> int:
        """Episodes flagged as demonstrations."""
        return sum(place.demo for place in self._places)

    @property
    def steps(self) -> int:
        """Time steps stored."""
        return sum(place.length for place in self._places)

    @property
    def bytes_per_step(self) -> int:
        """Bytes of a row: one uint8 frame a view, state, action and reward; 0 while it is empty."""
        return sum(rows.row_bytes for rows in self._rows.values())

    @property
    def capacity(self) -> int:
        """Rows that fit; an episode takes one more than it has steps."""
        return self._capacity_bytes // max(1, self.bytes_per_step)

    def add_demonstration(self, episode: Episode) -> None:
        """Store an episode of the dataset, for good. Raises DataError as `add`; ConfigError when it does not fit."""
        if self.episodes > self._fixed:
            raise DataError("Demonstrations of the dataset come before the first episode of the run.")
        arrays = self._checked(episode)
        start, stop = self._ring, self._ring + len(episode) + 1
        if stop > self.capacity:
            raise ConfigError(
                f"The demonstrations need more than --replay.capacity_gib={self._capacity_bytes / GIB:g}: raise it, or"
                " make the pictures smaller (cqn-data resize)."
            )
        self._write(arrays, start, stop)
        ended, success, shown = episode.terminated, episode.success, episode.taught
        demo = success and not shown  # else only some of its steps are to be imitated
        place = Place(start=start, length=len(episode), terminated=ended, success=success, demo=demo, taught=shown)
        self._keep(place)
        self._fixed, self._ring, self._head = self.episodes, stop, stop

    def add(self, episode: Episode, *, demo: bool, number: int = -1, note: dict[str, Any] | None = None) -> None:
        """Store an episode of the run; the oldest ones make room.

        number, note: kept with it on disk, for a resumed run.
        Raises DataError when it is empty, not finite, or of another shape; ConfigError when it can never fit.
        """
        arrays = self._checked(episode)
        start = self._head if self._head + len(episode) + 1 <= self.capacity else self._ring
        place = Place(
            start=start,
            length=len(episode),
            terminated=episode.terminated,
            success=episode.success,
            demo=demo,
            number=number,
            note=note or {},
            taught=episode.taught,
            borders=episode.borders,
        )
        if place.stop > self.capacity:
            raise ConfigError(
                f"An episode of {len(episode)} steps does not fit behind the demonstrations: raise"
                f" --replay.capacity_gib={self._capacity_bytes / GIB:g}."
            )
        if self._journal is not None and self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)
            if not (self.folder / "layout.json").is_file():
                (self.folder / "layout.json").write_text(json.dumps(self._layout()))
            self._journal.announce(place.start, place.stop)
        self._evict(place.start, place.stop)
        self._write(arrays, place.start, place.stop)
        if self._journal is not None:
            for rows in self._rows.values():
                rows.flush()  # before the line that says that they are complete
            self._journal.complete(place)
        self._keep(place)
        self._head = place.stop

    def correct(self, number: int, *, success: bool, demo: bool) -> bool:
        """Say otherwise how an episode of the run went: its last reward becomes 1 or 0, and it ends there either way.

        Returns whether the episode is still here. demo: whether it counts as a demonstration from now on.
        """
        index = self._index(number)
        if index is None:
            return False
        place = self._places[index]
        place = replace(place, terminated=True, success=success, demo=demo, note={**place.note, "corrected": True})
        if self._journal is not None:
            self._journal.complete(place)
        self._label_reward(place)
        self._places[index] = place
        self._sampled = None
        return True

    def forget(self, number: int) -> bool:
        """Never sample an episode of the run again; returns whether it was still here."""
        index = self._index(number)
        if index is None:
            return False
        place = self._places.pop(index)
        if self._journal is not None:
            self._journal.announce(place.start, place.stop)
        self._sampled = None
        return True

    def sample(self, count: int, demo_count: int, rng: np.random.Generator) -> Batch:
        """`count` transitions from everything followed by `demo_count` from the demonstrations.

        Their pictures lie in memory that is used again: a batch is good until three more have been sampled.
        Raises DataError when a store that is asked for is empty.
        """
        return self.transitions(*self._table.draw(count, demo_count, rng, by_step=self.by_step))

    def batches(self, updates: int, count: int, demo_count: int, rng: np.random.Generator) -> Generator[Batch]:
        """`updates` samples, the next one put together while one is in use; errors surface at the next one.

        The same batches as from `sample`, and the same state of `rng` wherever the iteration ends.
        """
        with ThreadPoolExecutor(1) as pool:
            ahead, before = None, rng.bit_generator.state
            try:
                for index in range(updates):
                    batch = ahead.result() if ahead is not None else self.sample(count, demo_count, rng)
                    before, ahead = rng.bit_generator.state, None
                    if index + 1 < updates:
                        drawn = self._table.draw(count, demo_count, rng, by_step=self.by_step)
                        ahead = pool.submit(self.transitions, *drawn)
                    yield batch
            finally:
                if ahead is not None:  # drawn, but not used
                    rng.bit_generator.state = before

    def transitions(self, episode: NDArray[Any], step: NDArray[Any]) -> Batch:
        """Transitions at the given steps [B] of the given episodes [B], indices among `places`."""
        rows = self._table.rows
        start, length = rows["start"][episode], rows["length"][episode]
        window = np.minimum(self.n_step, length - step)  # never past the end of the episode
        ahead = np.minimum(np.arange(self.n_step), window[:, None] - 1)
        rewards = self._rows["reward"].take((start + step)[:, None] + ahead).double()
        ended = (step + window == length) & rows["terminated"][episode]
        reward, discount = n_step_return(
            rewards, torch.from_numpy(window)[:, None], torch.from_numpy(ended)[:, None], self.discount
        )
        action, real = self._actions(episode, step)
        return Batch(
            observation=self._observation(start, step),
            action=action,
            reward=reward.float(),
            discount=discount.float(),
            next_observation=self._observation(start, step + window),
            demo=torch.from_numpy(self._table.shown(episode, step)[:, None].astype(np.float32)),
            real=real,
        )

    def _actions(self, episode: NDArray[Any], step: NDArray[Any]) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Sequences [B, T*D] that begin at `step`, and which of their numbers count (`Batch.real`).

        None goes from one driver to another or over a pause: what would lie beyond is filled and never counts.
        """
        row = self._table.rows["start"][episode] + step
        if self.sequence == 1:
            return self._rows["action"].take(row), None
        steps, cut = self._table.ahead(episode, step)
        offsets = np.arange(self.sequence)
        actions = self._rows["action"].take(row[:, None] + np.minimum(offsets, steps[:, None] - 1))
        inside = torch.from_numpy(offsets < steps[:, None])
        return filled(actions, inside, self.fill, torch.from_numpy(cut[:, None]))

    def _observation(self, start: NDArray[Any], step: NDArray[Any]) -> Observation:
        """Stacked history that ends at `step`; before the first frame, the first frame is repeated."""
        back = np.arange(self.frame_stack - 1, -1, -1)
        rows = start[:, None] + np.maximum(step[:, None] - back, 0)  # [B, S]
        low_dim = self._rows["low_dim"].take(rows)  # [B, S, P]
        views = []
        for name in (name for name in self._rows if name.startswith("view_")):
            buffer = self._turn % (2 * BATCHES), name  # an observation and a next one for each batch
            self._buffers[buffer] = self._rows[name].take(rows, self._buffers.get(buffer))
            views.append(self._buffers[buffer].flatten(1, 2))
        self._turn += 1
        return Observation(tuple(views), low_dim.flatten(1) if low_dim.shape[-1] else None)

    # -- rows and places -------------------------------------------------------------------------------------

    def _checked(self, episode: Episode) -> dict[str, NDArray[Any]]:
        """The arrays of an episode that fits; the first one decides shapes."""
        if not len(episode):
            raise DataError("An episode needs at least one step, got none.")
        arrays = episode.arrays()
        for name, what in (("low_dim", "state"), ("action", "action"), ("reward", "reward")):
            if not np.isfinite(arrays[name]).all():
                raise DataError(f"Episode {self.episodes} holds NaN or infinite values in its {what}.")
        if not self._rows:
            self._rows = {
                name: Rows(self.folder / f"{name}.bin" if self.folder else None, values.shape[1:], values.dtype)
                for name, values in arrays.items()
            }
        for name, values in arrays.items():
            if name not in self._rows or values.shape[1:] != self._rows[name].shape:
                held = self._rows[name].shape if name in self._rows else "none"
                raise DataError(f"Rows of shape {values.shape[1:]} do not fit a replay of {held} ('{name}').")
        return arrays

    def _write(self, arrays: dict[str, NDArray[Any]], start: int, stop: int) -> None:
        if stop > self._reserved:
            wanted = min(self.capacity, max(1024, stop, 2 * self._reserved))
            self._reserved = reserve_all(self._rows.values(), wanted, stop)
        for name, values in arrays.items():
            self._rows[name].write(start, values)

    def _evict(self, start: int, stop: int) -> None:
        """Forget the episodes of the run that lie in these rows."""
        kept = [p for i, p in enumerate(self._places) if i < self._fixed or p.stop <= start or p.start >= stop]
        if len(kept) < len(self._places):
            self._places, self._sampled = kept, None

    def _index(self, number: int) -> int | None:
        """Index of the run's episode of that number among the places; None where it is gone."""
        return next((i for i in range(self._fixed, self.episodes) if self._places[i].number == number), None)

    def _label_reward(self, place: Place) -> None:
        last = place.start + place.length - 1
        self._rows["reward"].write(last, np.array([float(place.success)], np.float32))

    def _keep(self, place: Place) -> None:
        self._places.append(place)
        self._sampled = None

    @property
    def _table(self) -> Table:
        """What is sampled from now."""
        if self._sampled is None:
            self._sampled = Table.of(self._places, self._left_out)
        return self._sampled

    # -- after a kill ----------------------------------------------------------------------------------------

    def _layout(self) -> dict[str, Any]:
        """Layout that must be the same when a run is resumed: rows of the demonstrations, capacity, shapes."""
        shapes = {name: [*rows.shape, str(rows.dtype)] for name, rows in self._rows.items()}
        return {"ring": self._ring, "capacity": self.capacity, "shapes": shapes}

    def examine(
        self, expected: Collection[int], *, accept_loss: bool = False, say: Callable[[str], None] = lambda _: None
    ) -> None:
        """Make sure of an earlier process's files, before anything is written to them.

        expected: numbers of episodes that must be told of. accept_loss: go on without those that are gone; `say` is
        told of them. Raises DataError where episodes are gone and that is not accepted.
        """
        if self.folder is None or self._journal is None:
            return
        self._skip_damaged = accept_loss
        untold = {*expected} - self._take_up_journal()
        damage = find_damage(self._places, earlier_layout(self.folder)[1], untold)
        self._places, self._head = [], 0
        if damage is not None:
            text = f"{self.folder} is damaged: {damage}"
            if not accept_loss:
                raise DataError(f"{text} Go on with those by --replay.accept_loss=true, or start a new run.")
            say(f"Warning: {text}")
            for place in damage.lost:
                self._journal.announce(place.start, place.stop)

    def reopen(self) -> list[Place]:
        """Take up the finished episodes of an earlier process; call once the demonstrations are in.

        Returns all that are still there, oldest first. Raises DataError when the dataset or the settings changed.
        """
        if self.folder is None or self._journal is None:
            raise DataError("This replay has no folder to take episodes up from.")
        written, shaped = earlier_layout(self.folder)
        if self._rows and written is not None and written != self._layout():
            raise DataError(
                f"{self.folder} was laid out for another dataset or --replay.capacity_gib: resume with those that the"
                " run began with, or start a new run."
            )
        self._take_up_journal()
        if not self._rows:  # without demonstrations their shapes come from the layout
            self._rows = shaped
        needed = max((p.stop for p in self._places), default=0)
        self._reserved = reserve_all(self._rows.values(), max(needed, self._reserved), needed)
        for place in self._places[self._fixed :]:
            if "corrected" in place.note:  # a kill may have come between the label and its reward
                self._label_reward(place)
        return self._places[self._fixed :]

    def _take_up_journal(self) -> set[int]:
        """Places of all that the journal says is complete; returns the numbers of all that it tells of."""
        assert self._journal is not None  # noqa: S101  # checked by the callers
        self._journal.repair()
        told = set[int]()
        for (start, stop), place in self._journal.entries(skip_damaged=self._skip_damaged):
            told |= set() if place is None else {place.number}
            corrected = place is not None and "corrected" in place.note
            index = self._index(place.number) if place is not None and corrected else None
            if place is not None and index is not None:
                self._places[index] = place
                continue
            self._evict(start, stop)
            if place is not None:
                self._keep(place)
                self._head = place.stop
        return told
