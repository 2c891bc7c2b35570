"""Folders of datasets: where they lie, and how a new one appears in one piece. Light: options are checked with it."""

import contextlib
import errno
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from lerobot_cqn.errors import ConfigError, OutputError, OutputExistsError

from ..terminal.console import note

__all__ = ["local_root", "new_folder", "refuse_existing", "refuse_inside"]

CANNOT_WRITE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM)


def local_root(repo_id: str, root: str | None) -> Path:
    """Dataset folder: ``root`` itself, else LeRobot's home with the repository name below it."""
    if root:
        return Path(root).expanduser()
    from lerobot.utils.constants import HF_LEROBOT_HOME

    return Path(HF_LEROBOT_HOME) / repo_id


def refuse_existing(root: Path) -> None:
    """Raise OutputExistsError when there is anything at ``root``."""
    if root.exists() or root.is_symlink():
        raise OutputExistsError(f"{root} exists already and is left as it is; choose another folder.")


def refuse_inside(source: Path, root: Path) -> None:
    """Raise ConfigError when ``root`` lies in the dataset folder ``source``, which must stay as it is."""
    if source.resolve() in root.resolve().parents:
        raise ConfigError(f"{root} lies inside the source {source}; choose a folder outside.")


@contextlib.contextmanager
def new_folder(root: Path) -> Iterator[Path]:
    """A temporary folder beside ``root`` that takes this name when the block ends well.

    Any exception, Ctrl-C included, removes it; what a killed process left is removed by the next one for the same
    place. Nothing is created before the block makes the folder.

    Raises:
        OutputExistsError: something is at ``root`` already, at the start or by the end.
    """
    refuse_existing(root)
    folder = root.parent / f".{root.name}.{os.getpid()}.tmp"
    try:
        root.parent.mkdir(parents=True, exist_ok=True)
        _sweep(root)
        folder.mkdir()  # whether one may write there at all; whoever fills it expects to make it
        folder.rmdir()
    except OSError as error:
        raise OutputError(f"Nothing can be written to {root.parent}: {error}") from error
    try:
        yield folder
        refuse_existing(root)
        os.replace(folder, root)
    except OSError as error:
        if error.errno not in CANNOT_WRITE:
            raise
        raise OutputError(f"{root} could not be written and nothing is left of it: {error}") from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _sweep(root: Path) -> None:
    """Remove the temporary folders of processes that are no more."""
    for left in root.parent.glob(f".{root.name}.*.tmp"):
        number = left.name.removeprefix(f".{root.name}.").removesuffix(".tmp")
        if number.isdigit() and not _alive(int(number)):
            note(f"Removing {left}, which a killed process left behind.")
            shutil.rmtree(left, ignore_errors=True)


def _alive(number: int) -> bool:
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
