"""Files that outlive a power cut, and room for them: what is written reaches the disk, and fits on it."""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Self

from lerobot_cqn.errors import OutputError

__all__ = ["SpareDescriptors", "check_room", "flush", "flush_tree"]

MIB = 2**20
ROOM_MIB = 64  # that must be free besides two more checkpoints
SPARE = 32  # descriptors: a checkpoint or an episode has a few files open at a time


def flush(path: Path) -> None:
    """Let a file, or the names in a folder, reach the disk."""
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


def flush_tree(folder: Path) -> None:
    """Let everything below a folder reach the disk, contents before names."""
    for at, _, names in os.walk(folder, topdown=False):
        for name in names:
            flush(Path(at) / name)
        flush(Path(at))


class SpareDescriptors:
    """Descriptors kept in reserve while it is entered, for what must be saved when a process has no other left."""

    def __init__(self) -> None:
        self._kept: list[int] = []

    def __enter__(self) -> Self:
        self._take()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._give()

    @contextlib.contextmanager
    def given(self) -> Iterator[None]:
        """The reserve is free for the block, and taken back afterwards as far as it is still there."""
        self._give()
        try:
            yield
        finally:
            self._take()

    def _take(self) -> None:
        with contextlib.suppress(OSError):  # as many as there are
            while len(self._kept) < SPARE:
                self._kept.append(os.open(os.devnull, os.O_RDONLY))

    def _give(self) -> None:
        while self._kept:
            os.close(self._kept.pop())


def check_room(output_dir: Path) -> None:
    """Raises OutputError where the disk is too full to go on: two more checkpoints must fit, and something besides."""
    folder = next(parent for parent in (output_dir, *output_dir.absolute().parents) if parent.exists())
    last = output_dir / "checkpoints" / "last"
    size = sum(file.stat().st_size for file in last.rglob("*") if file.is_file()) if last.is_dir() else 0
    needed, free = 2 * size // MIB + ROOM_MIB, shutil.disk_usage(folder).free // MIB
    if free < needed:
        raise OutputError(
            f"The disk of {output_dir} is nearly full: {free} MiB are free, expected {needed} MiB (two checkpoints and "
            f"{ROOM_MIB} MiB); free some, then give the same command again, with --resume=true where the run has begun."
        )
