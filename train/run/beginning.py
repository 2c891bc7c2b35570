"""A run before its first checkpoint: nothing is learned yet, so the same command may begin it again."""

import contextlib
import fcntl
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from lerobot_cqn.errors import OutputExistsError

from .metrics import COLUMNS

__all__ = ["BEGUN", "PAGE", "RUN_ID", "beginning", "forget_beginning"]

BEGUN = ".begun"  # in the run's folder, locked by the process that begins it
RUN_ID = "run_id"  # of a run with collectors: which of the episodes on their disks are its own
PAGE = "page"  # certificate and address of the operator's page, made before anything else
MADE = (
    "replay",
    "checkpoints",
    PAGE,
    "tensorboard",
    "first_batch.png",
    RUN_ID,
    *(f"{table}.csv" for table in COLUMNS),
    BEGUN,
)


@contextlib.contextmanager
def beginning(marker: Path) -> Iterator[None]:
    """Mark a new run's folder while the block runs; the first checkpoint removes the mark."""
    marker.parent.mkdir(parents=True, exist_ok=True)
    number = os.open(marker, os.O_CREAT | os.O_RDWR)
    try:
        fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(number)


def forget_beginning(output_dir: Path) -> None:
    """Remove what a run left that ended before its first checkpoint (killed, or its arm did not answer).

    Raises OutputExistsError where a process is still at it.
    """
    marker = output_dir / BEGUN
    if not marker.is_file() or (output_dir / "checkpoints" / "last").exists():
        return
    number = os.open(marker, os.O_RDWR)
    try:
        fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        raise OutputExistsError(
            f"Another process is beginning a run in {output_dir}: wait for it, or give another --output_dir."
        ) from error
    finally:
        os.close(number)
    for name in MADE:
        path = output_dir / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
