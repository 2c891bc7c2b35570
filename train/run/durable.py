"""Files that outlive a power cut, and room for them: what is written reaches the disk, and fits on it."""

import os
import shutil
from pathlib import Path

from lerobot_cqn.errors import OutputError

__all__ = ["check_room", "flush", "flush_tree"]

MIB = 2**20
ROOM_MIB = 64  # that must be free besides two more checkpoints


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
