"""Replay buffer: whole episodes, stored once; histories and n-step windows are put together when sampled."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lerobot_cqn.errors import DataError
from lerobot_cqn.schema import Batch, Observation

__all__ = ["Episode", "Replay"]


@dataclass(frozen=True)
class Episode:
    """One episode of T steps and T + 1 observations.

    low_dim: float32 [T + 1, P], normalised (None without state); pixels: per view uint8 [T + 1, 3, H, W];
    action: float32 [T, D] in [-1, 1]; reward: float32 [T].
    terminated: the last step really ended the task (success); otherwise time ran out and the last
    observation's value still counts.
    """

    low_dim: NDArray[Any] | None
    pixels: tuple[NDArray[Any], ...]
    action: NDArray[Any]
    reward: NDArray[Any]
    terminated: bool
    success: bool

    def __len__(self) -> int:
        """Steps, T."""
        return len(self.action)


class _Rows:
    """A growing array; doubling keeps appending cheap."""

    def __init__(self) -> None:
        self._data: NDArray[Any] | None = None
        self.size = 0

    def check(self, rows: NDArray[Any]) -> None:
        if self._data is not None and rows.shape[1:] != self._data.shape[1:]:
            raise DataError(f"Rows of shape {rows.shape[1:]} do not fit a replay of {self._data.shape[1:]}.")

    def append(self, rows: NDArray[Any]) -> None:
        if self._data is None:
            self._data = np.empty((max(1024, len(rows)), *rows.shape[1:]), rows.dtype)
        if self.size + len(rows) > len(self._data):
            grown = np.empty((max(2 * len(self._data), self.size + len(rows)), *rows.shape[1:]), rows.dtype)
            grown[: self.size] = self._data[: self.size]
            self._data = grown
        self._data[self.size : self.size + len(rows)] = rows
        self.size += len(rows)

    def __getitem__(self, index: Any) -> NDArray[Any]:
        assert self._data is not None  # noqa: S101
        rows: NDArray[Any] = self._data[: self.size][index]
        return rows


class Replay:
    """Everything seen, with the demonstrations (and relabelled successes) flagged.

    Both stores of the paper are views of one: a sample comes from all episodes or from the flagged ones,
    uniform over episodes and then over the steps of that episode.
    """

    def __init__(self, frame_stack: int, n_step: int, discount: float) -> None:
        self.frame_stack, self.n_step, self.discount = frame_stack, n_step, discount
        self._low_dim = _Rows()
        self._pixels: tuple[_Rows, ...] = ()
        self._action, self._reward = _Rows(), _Rows()
        self._start: list[int] = []
        self._length: list[int] = []
        self._terminated: list[bool] = []
        self._success: list[bool] = []
        self._demo: list[bool] = []

    @property
    def episodes(self) -> int:
        """Episodes stored."""
        return len(self._start)

    @property
    def demonstrations(self) -> int:
        """Episodes flagged as demonstrations."""
        return sum(self._demo)

    @property
    def steps(self) -> int:
        """Time steps stored."""
        return sum(self._length)

    def add(self, episode: Episode, *, demo: bool) -> None:
        """Store an episode. Raises DataError when it is empty, not finite, or of another shape."""
        if not len(episode):
            raise DataError("An episode needs at least one step, got none.")
        low_dim = episode.low_dim if episode.low_dim is not None else np.zeros((len(episode) + 1, 0), np.float32)
        for name, values in (("state", low_dim), ("action", episode.action), ("reward", episode.reward)):
            if not np.isfinite(values).all():
                raise DataError(f"Episode {self.episodes} holds NaN or infinite values in its {name}.")
        if not self._pixels:
            self._pixels = tuple(_Rows() for _ in episode.pixels)
        # All shapes before the first row is written: a refused episode must leave nothing behind.
        for rows, new in zip(
            (self._low_dim, self._action, self._reward, *self._pixels),
            (low_dim, episode.action, episode.reward, *episode.pixels),
            strict=True,
        ):
            rows.check(new)
        self._start.append(self._action.size)
        # A row of its own for the last observation keeps one index for all arrays.
        self._action.append(np.concatenate([episode.action, np.zeros_like(episode.action[:1])]))
        self._reward.append(np.concatenate([episode.reward, np.zeros_like(episode.reward[:1])]))
        self._low_dim.append(low_dim.astype(np.float32))
        for rows, view in zip(self._pixels, episode.pixels, strict=True):
            rows.append(view)
        self._length.append(len(episode))
        self._terminated.append(episode.terminated)
        self._success.append(episode.success)
        self._demo.append(demo)

    def sample(self, count: int, demo_count: int, rng: np.random.Generator) -> Batch:
        """`count` transitions from everything followed by `demo_count` from the demonstrations.

        Raises DataError when a store that is asked for is empty.
        """
        everything, demos = np.arange(self.episodes), np.flatnonzero(self._demo)
        if (count and not len(everything)) or (demo_count and not len(demos)):
            raise DataError(
                f"Cannot sample {count} + {demo_count}: the replay holds {len(everything)} episodes, of which "
                f"{len(demos)} are demonstrations; give a dataset or set the batch size of the empty store to 0."
            )
        parts = [rng.choice(ids, size) for ids, size in ((everything, count), (demos, demo_count)) if size]
        episode = np.concatenate(parts)
        length = np.asarray(self._length)[episode]
        step = rng.integers(0, length)
        return self._assemble(episode, step)

    def _assemble(self, episode: NDArray[Any], step: NDArray[Any]) -> Batch:
        """Transitions at the given steps [B] of the given episodes [B]."""
        start, length = np.asarray(self._start)[episode], np.asarray(self._length)[episode]
        window = np.minimum(self.n_step, length - step)  # never past the end of the episode
        offsets = np.arange(self.n_step)
        inside = offsets < window[:, None]
        rewards = self._reward[(start + step)[:, None] + np.where(inside, offsets, 0)] * inside
        reward = (rewards * self.discount**offsets).sum(-1, keepdims=True)
        ended = (step + window == length) & np.asarray(self._terminated)[episode]
        discount = np.where(ended, 0.0, self.discount**window)[:, None]
        demo = np.asarray(self._demo)[episode][:, None]
        return Batch(
            self._observation(start, step),
            torch.from_numpy(self._action[start + step]),
            torch.from_numpy(reward.astype(np.float32)),
            torch.from_numpy(discount.astype(np.float32)),
            self._observation(start, step + window),
            torch.from_numpy(demo.astype(np.float32)),
        )

    def _observation(self, start: NDArray[Any], step: NDArray[Any]) -> Observation:
        """Stacked history that ends at `step`; before the first frame, the first frame is repeated."""
        back = np.arange(self.frame_stack - 1, -1, -1)
        rows = start[:, None] + np.maximum(step[:, None] - back, 0)  # [B, S]
        low_dim = self._low_dim[rows]  # [B, S, P]
        views = tuple(torch.from_numpy(view[rows]).flatten(1, 2) for view in self._pixels)
        return Observation(views, torch.from_numpy(low_dim).flatten(1) if low_dim.shape[-1] else None)

    # -- to disk and back ------------------------------------------------------------------------------------

    def save(self, path: Path, first_episode: int = 0) -> None:
        """Write the episodes from `first_episode` on (the demonstrations come from their dataset again)."""
        first_row = self._start[first_episode] if first_episode < self.episodes else self._action.size
        arrays: dict[str, Any] = {
            "length": np.asarray(self._length[first_episode:], dtype=np.int64),
            "terminated": np.asarray(self._terminated[first_episode:], dtype=bool),
            "success": np.asarray(self._success[first_episode:], dtype=bool),
            "demo": np.asarray(self._demo[first_episode:], dtype=bool),
        }
        if len(arrays["length"]):
            arrays |= {"action": self._action[first_row:], "reward": self._reward[first_row:]}
            arrays |= {"low_dim": self._low_dim[first_row:]}
            arrays |= {f"view_{i}": rows[first_row:] for i, rows in enumerate(self._pixels)}
        np.savez(path, **arrays)

    def load(self, path: Path) -> None:
        """Add the episodes that `save` wrote."""
        with np.load(path, allow_pickle=False) as stored:
            arrays = dict(stored)
        views = [arrays[f"view_{i}"] for i in range(sum(name.startswith("view_") for name in arrays))]
        row = 0
        for index, length in enumerate(arrays["length"]):
            rows, steps = slice(row, row + length + 1), slice(row, row + length)
            low_dim = arrays["low_dim"][rows]
            episode = Episode(
                low_dim if low_dim.shape[1] else None,
                tuple(view[rows] for view in views),
                arrays["action"][steps],
                arrays["reward"][steps],
                bool(arrays["terminated"][index]),
                bool(arrays["success"][index]),
            )
            self.add(episode, demo=bool(arrays["demo"][index]))
            row += length + 1
