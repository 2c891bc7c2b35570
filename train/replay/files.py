"""Arrays on disk that survive a kill, and the list of the episodes in them.

A replay's folder holds one file of raw numbers an array, memory-mapped, so that the operating system keeps what was
written when the process dies; and `episodes.jsonl`: for every episode a line that says where it will be, before its
rows are written, and one that it is complete, afterwards. What an announced but unfinished episode had begun to
overwrite is taken for lost.
"""

import json
import math
import os
from collections.abc import Collection, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lerobot_cqn.errors import DataError, OutputError

__all__ = ["Journal", "Place", "Rows", "earlier_layout", "reserve_all"]


@dataclass(frozen=True, kw_only=True)
class Place:
    """Place of an episode of T steps in the rows, with what it is.

    start: first of its T + 1 rows; number: how many episodes the run had before it; note: what the run wants to know of
    it after a kill (its row of episodes.csv); taught: the steps (first, one past the last) that a person drove;
    borders: steps before which a pause lay.
    """

    start: int
    length: int
    terminated: bool
    success: bool
    demo: bool
    number: int = -1
    note: dict[str, Any] = field(default_factory=dict)
    taught: tuple[tuple[int, int], ...] = ()
    borders: tuple[int, ...] = ()

    @property
    def stop(self) -> int:
        """One past its last row."""
        return self.start + self.length + 1


def _place(entry: dict[str, Any]) -> Place:
    taught = tuple((first, last) for first, last in entry.get("taught", ()))
    return Place(**{**entry, "taught": taught, "borders": tuple(entry.get("borders", ()))})


class Rows:
    """An array [rows, ...] of which more rows can be had: a file mapped to memory, or memory where there is no file."""

    def __init__(self, path: Path | None, shape: tuple[int, ...], dtype: Any) -> None:
        self.path, self.shape, self.dtype = path, shape, np.dtype(dtype)
        self._data: NDArray[Any] = np.empty((0, *shape), self.dtype)
        self._view = torch.from_numpy(self._data)

    @property
    def row_bytes(self) -> int:
        """Bytes of a row."""
        return math.prod(self.shape) * int(self.dtype.itemsize)

    def reserve(self, rows: int) -> None:
        """Have at least this many rows; what is in them stays. Raises OSError when the disk cannot hold them."""
        if rows <= len(self._data):
            return
        if self.path is None or self.row_bytes == 0:
            grown = np.zeros((rows, *self.shape), self.dtype)
            grown[: len(self._data)] = self._data
            self._data = grown
        else:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("ab") as file:
                held, wanted = file.tell(), rows * self.row_bytes
                # For real: on a full disk a hole in the file would end the process when it is written to.
                if wanted > held:
                    os.posix_fallocate(file.fileno(), held, wanted - held)
            self._data = np.memmap(self.path, self.dtype, "r+", shape=(rows, *self.shape))
        self._view = torch.from_numpy(self._data)

    def flush(self) -> None:
        """Let what was written reach the disk."""
        if self.path is not None and self.path.is_file():
            number = os.open(self.path, os.O_RDONLY)
            try:
                os.fsync(number)
            finally:
                os.close(number)

    def write(self, start: int, values: NDArray[Any]) -> None:
        """Put rows from `start` on; they must be reserved."""
        self._data[start : start + len(values)] = values

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Rows `start` to `stop`, as they lie."""
        return self._data[start:stop]

    def take(self, rows: NDArray[np.int64], out: torch.Tensor | None = None) -> torch.Tensor:
        """Copy of the rows [...] as a tensor [..., *shape]; torch copies with several threads.

        out: a tensor of an earlier call to put it into, whatever its size: fresh memory costs more than the copy.
        """
        index = torch.from_numpy(np.ascontiguousarray(rows.reshape(-1)))
        if out is None or out.numel() != rows.size * math.prod(self.shape):
            return self._view.index_select(0, index).view(*rows.shape, *self.shape)
        torch.index_select(self._view, 0, index, out=out.view(rows.size, *self.shape))
        return out.view(*rows.shape, *self.shape)


def earlier_layout(folder: Path) -> tuple[dict[str, Any] | None, dict[str, Rows]]:
    """Layout that an earlier process wrote into a replay's folder, and its arrays; None and no arrays without one."""
    layout = folder / "layout.json"
    if not layout.is_file():
        return None, {}
    written = json.loads(layout.read_text())
    shapes = written["shapes"].items()
    return written, {name: Rows(folder / f"{name}.bin", tuple(shape), dtype) for name, (*shape, dtype) in shapes}


def reserve_all(arrays: Collection[Rows], wanted: int, needed: int) -> int:
    """Room for `wanted` rows in each array, or for `needed` where the disk has no more; returns for how many.

    Raises OutputError where it has not even that.
    """
    for count in dict.fromkeys((wanted, needed)):
        try:
            for rows in arrays:
                rows.reserve(count)
        except OSError as error:
            full = error
            continue
        return count
    size = needed * sum(rows.row_bytes for rows in arrays) // 2**20 + 1
    raise OutputError(
        f"The replay needs {size} MiB on the disk and cannot have them: {full.strerror}. Free some and resume, or give "
        "a smaller --replay.capacity_gib to a new run."
    ) from full


class Journal:
    """`episodes.jsonl`: what is in the rows, in the order it came."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def announce(self, start: int, stop: int) -> None:
        """Rows `start` to `stop` are about to be overwritten."""
        self._append({"writing": [start, stop]})

    def complete(self, place: Place) -> None:
        """The announced rows hold this episode, or one that is there is now described so."""
        self._append({"episode": asdict(place)})

    def repair(self) -> None:
        """Forget a last line that a kill cut off."""
        if self.path.is_file():
            text = self.path.read_bytes()
            with self.path.open("r+b") as file:
                file.truncate(text.rfind(b"\n") + 1)

    def entries(self, *, skip_damaged: bool = False) -> Iterator[tuple[tuple[int, int], Place | None]]:
        """Rows that were overwritten, with the episode in them, or None where it was never completed.

        Raises DataError when a line is damaged and not to be skipped; see `repair` for the last one.
        """
        announced: tuple[int, int] | None = None
        lines = self.path.read_text().splitlines() if self.path.is_file() else []
        for number, line in enumerate(lines, start=1):
            try:
                entry = json.loads(line)
                place = _place(entry["episode"]) if "episode" in entry else None
                rows = (place.start, place.stop) if place else (int(entry["writing"][0]), int(entry["writing"][1]))
            except (ValueError, KeyError, TypeError, IndexError) as error:
                if skip_damaged:
                    continue
                raise DataError(
                    f"{self.path}, line {number} is damaged: go on with the episodes of the other lines by "
                    "--replay.accept_loss=true, or start a new run."
                ) from error
            if announced is not None and announced != rows:
                yield announced, None
            announced = rows if place is None else None
            if place is not None:
                yield rows, place
        if announced is not None:
            yield announced, None

    def _append(self, entry: dict[str, Any]) -> None:
        with self.path.open("a") as file:
            file.write(json.dumps(entry) + "\n")
            file.flush()
            os.fsync(file.fileno())
