"""Interface of a format to the converter: a reader of named episodes, with numbers at once and pictures one by one.

T is the number of steps of one episode, H and W the pixels of a picture.
"""

import contextlib
import importlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import ConfigError, CQNError, DataError, one_of
from lerobot_cqn.schema import ACTION, NEXT_DONE, NEXT_REWARD, NEXT_SUCCESS, STATE

__all__ = [
    "STATE",
    "Episode",
    "Pictures",
    "Reader",
    "Request",
    "camera_columns",
    "choose",
    "dimension_names",
    "folder_task",
    "in_natural_order",
    "join",
    "join_action",
    "lacks",
    "need",
    "number_column",
    "reading",
    "reward_columns",
    "sentence",
    "storable",
    "whole_fps",
]

NO_PICTURES = ("none",)
REWARD_NAMES = {
    NEXT_REWARD: (NEXT_REWARD, "reward", "rewards"),
    NEXT_DONE: (NEXT_DONE, "done", "dones"),
    NEXT_SUCCESS: (NEXT_SUCCESS, "success", "is_success"),
}


@dataclass(frozen=True)
class Request:
    """Request of the user to a format; empty tuples and None leave the choice to it.

    Attributes:
        input: existing file or folder.
        fps: frames per second, instead of what the input says.
        task: sentence for every episode, instead of what the input says.
        image_keys: cameras by their name in the input; ``("none",)`` takes none.
        state_keys: what makes up ``observation.state``, in this order, by name in the input.
        action_keys: what makes up ``action``, likewise.
        rewards: whether reward columns are taken over.
    """

    input: Path
    fps: int | None = None
    task: str | None = None
    image_keys: tuple[str, ...] = ()
    state_keys: tuple[str, ...] = ()
    action_keys: tuple[str, ...] = ()
    rewards: bool = True


@dataclass
class Episode:
    """One episode as it will be written.

    Attributes:
        where: file and episode, for messages.
        task: sentence of all its steps.
        columns: LeRobot name -> (T, ...) numbers in the dtype to write; ``action`` is among them.
        names: LeRobot name -> names of the dimensions, where they are known.
        cameras: LeRobot name -> T pictures, each (H, W, 3) uint8, read when asked for.
        facts: counts for the history, summed over episodes in the report.
    """

    where: str
    task: str
    columns: dict[str, NDArray[Any]]
    names: dict[str, list[str]] = field(default_factory=dict)
    cameras: dict[str, "Sequence[NDArray[np.uint8]] | Pictures"] = field(default_factory=dict)
    facts: dict[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.columns[ACTION])

    def check(self) -> None:
        """Raise DataError when the episode is empty, its columns differ in length, or a number is not finite."""
        steps = len(self)
        if steps == 0:
            raise DataError(f"{self.where} holds no steps; leave it out.")
        for key, values in [*self.columns.items(), *self.cameras.items()]:
            if len(values) != steps:
                raise DataError(
                    f"{self.where}: expected {steps} rows of '{key}', as of the action, found {len(values)}."
                )
        for key, column in self.columns.items():
            if not np.issubdtype(column.dtype, np.floating):
                continue
            bad = ~np.isfinite(column.reshape(steps, -1)).all(axis=1)
            if bad.any():
                frame = int(np.flatnonzero(bad)[0])
                raise DataError(f"{self.where}, frame {frame}: '{key}' is not finite; mend or leave out this episode.")

    def pictures(self, step: int) -> dict[str, NDArray[np.uint8]]:
        """One picture of every camera, (H, W, 3) uint8; raises DataError naming the frame when it cannot be read."""
        with reading(f"{self.where}, frame {step}"):
            return {key: camera[step] for key, camera in self.cameras.items()}

    def frames(self) -> Iterator[dict[str, NDArray[Any]]]:
        """The steps in order: every column's row and every camera's picture."""
        for step in range(len(self)):
            yield {key: values[step] for key, values in self.columns.items()} | self.pictures(step)


class Reader(Protocol):
    """An opened input.

    Attributes:
        fps: frames per second, and a few words on where that number comes from.
        robot_type: as the input names it.
        episodes: names of the episodes in the order they are written.
        notes: what is left out or taken in an unexpected way, a sentence each.
    """

    fps: tuple[int, str]
    robot_type: str | None
    episodes: list[str]
    notes: list[str]

    def episode(self, name: str) -> AbstractContextManager[Episode]:
        """Open one episode; its pictures can be read until the block ends. Raises DataError when it is damaged."""


class Pictures:
    """T pictures as (H, W, 3) uint8, from rows in any of the ways in which formats store them.

    A row is (H, W, C) or (C, H, W) with C of 1, 3 or 4, (H, W), or the bytes of a JPEG or PNG file, as (K,) uint8 too.
    Numbers are uint8, or floats: the first picture that is not black tells whether they go to 1 or to 255.
    """

    def __init__(self, rows: Any) -> None:
        self._rows = rows
        self._scale: float | None = None

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, step: int) -> NDArray[np.uint8]:
        """Picture of one step; raises ValueError when the row is not a picture."""
        row = self._rows[step]
        if isinstance(row, bytes):
            return decode(row)
        row = np.asarray(row)
        if row.ndim == 1 and row.dtype in (np.uint8, np.int8):
            return decode(row.astype(np.uint8).tobytes())
        if row.ndim == 2:
            row = row[:, :, None]
        if row.ndim != 3:
            raise ValueError(f"expected a picture (height, width, channels), found shape {row.shape}")
        if row.shape[2] not in (1, 3, 4) and row.shape[0] in (1, 3, 4):
            row = np.moveaxis(row, 0, 2)
        if row.shape[2] not in (1, 3, 4):
            raise ValueError(f"expected 1, 3 or 4 colour channels, found shape {row.shape}")
        row = self._as_bytes(row)
        return np.ascontiguousarray(np.repeat(row, 3, axis=2) if row.shape[2] == 1 else row[:, :, :3])

    def _as_bytes(self, row: NDArray[Any]) -> NDArray[np.uint8]:
        if row.dtype == np.uint8:
            return row
        if not np.issubdtype(row.dtype, np.floating):
            raise ValueError(f"expected pictures of uint8 or float numbers, found {row.dtype}")
        low, high = float(row.min()), float(row.max())
        if self._scale is None and high > 0:
            self._scale = 255.0 if high <= 1 else 1.0
        scale = self._scale or 1.0
        if not (low >= 0 and high * scale <= 255):
            raise ValueError(f"expected colours from 0 to {255 / scale:g}, found {low:g} to {high:g}")
        return np.rint(row * scale).astype(np.uint8)


def decode(data: bytes) -> NDArray[np.uint8]:
    """(H, W, 3) picture of a JPEG or PNG file's bytes; zeros after its end do no harm."""
    import io

    from PIL import Image

    with Image.open(io.BytesIO(data)) as image:
        return np.asarray(image.convert("RGB"), dtype=np.uint8)


@contextlib.contextmanager
def reading(where: str) -> Iterator[None]:
    """Turn whatever a library raises on damaged input into one DataError that names ``where``."""
    try:
        yield
    except (CQNError, MemoryError):
        raise
    except Exception as error:  # HDF5, Zarr, zip, PNG and pickle readers each raise their own kinds
        text = " ".join(str(error).split())[:200]
        raise DataError(f"{where} cannot be read: {type(error).__name__}: {text}; mend it or leave it out.") from error


def need(package: str) -> Any:
    """Import a package of the extra ``convert``; raises ConfigError that names the command to install it."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise ConfigError(
            f"This format needs {package}, which cannot be imported ({error}): "
            "pip install 'lerobot_policy_cqn[convert]'."
        ) from error


def choose(what: str, wanted: Iterable[str], there: Iterable[str]) -> list[str]:
    """``wanted``, once each; raises ConfigError that lists ``there`` and the nearest name when one is not."""
    names = list(there)
    for name in wanted:
        if name not in names:
            found = one_of(what, name, names) if names else f"Unknown {what} '{name}': the input has none."
            raise ConfigError(found)
    return list(dict.fromkeys(wanted))


def lacks(where: str, key: str, there: Iterable[str], hint: str = "") -> DataError:
    """The error for a key that a format must have; lists what is there instead."""
    found = ", ".join(sorted(there)) or "nothing"
    return DataError(f"{where}: expected '{key}', found {found}. {hint or 'Is --from the right format?'}")


def in_natural_order(names: Iterable[str]) -> list[str]:
    """Sorted so that ``episode_10`` comes after ``episode_9``."""
    return sorted(names, key=lambda name: [int(p) if p.isdecimal() else p for p in re.split(r"(\d+)", name)])


def whole_fps(request: Request, found: Any, source: str) -> tuple[int, str]:
    """Frames per second and where they are from.

    Args:
        request: its ``fps`` comes first.
        found: number in the input, or the format's constant; None where there is none.
        source: words for where ``found`` is from.

    Raises:
        ConfigError: nothing says how fast the recording was.
        DataError: the input's number is not a whole positive one, which LeRobot wants.
    """
    if request.fps is not None:
        return request.fps, "--fps" if found is None else f"--fps, instead of {found:g} from {source}"
    if found is None:
        raise ConfigError(f"{request.input} does not say how many frames it has a second; give --fps=N.")
    if not (float(found) > 0 and float(found).is_integer()):
        raise DataError(f"{request.input}: expected a whole number of frames a second, found {found}; give --fps=N.")
    return int(found), source


def dimension_names(key: str, values: NDArray[Any]) -> list[str]:
    """``key`` for one dimension, else ``key.0``, ``key.1``, …; ``values`` is (T, P)."""
    return [key] if values.shape[1] == 1 else [f"{key}.{i}" for i in range(values.shape[1])]


def join(parts: Mapping[str, NDArray[Any]]) -> tuple[NDArray[np.float32], list[str]]:
    """Concatenate (T, …) arrays to one (T, P) float32 array; also the P names."""
    flat = {key: np.asarray(v, np.float32).reshape(len(v), -1) for key, v in parts.items()}
    names = [name for key, values in flat.items() for name in dimension_names(key, values)]
    return np.concatenate(list(flat.values()), axis=1), names


def join_action(parts: Mapping[str, NDArray[Any]]) -> tuple[NDArray[np.float32], list[str]]:
    """As :func:`join`; the dimensions of a single array are ``action.0``, ``action.1``, …, whatever it is called."""
    return join(parts if len(parts) > 1 else {ACTION: next(iter(parts.values()))})


def sentence(value: Any) -> str | None:
    """A task from text, bytes or the first of several; None for anything else, and where there are no words."""
    while isinstance(value, list | tuple | np.ndarray) and len(np.atleast_1d(np.asarray(value, object))):
        value = np.atleast_1d(np.asarray(value, object))[0]
    text = value.decode(errors="replace") if isinstance(value, bytes) else value
    return " ".join(text.replace('"', " ").split()) or None if isinstance(text, str) else None


def storable(array: Any) -> bool:
    """Whether LeRobot can store an array's rows as numbers: no strings, no objects, at most 5 axes."""
    return array.dtype.kind in "bifu" and array.dtype.itemsize <= 8 and 1 <= len(array.shape) <= 5


def number_column(values: Any) -> NDArray[Any]:
    """(T, …) numbers in a dtype LeRobot can store, scalars as (T, 1)."""
    array = np.asarray(values)
    dtype = np.dtype(np.float32) if array.dtype == np.float16 else array.dtype.newbyteorder("=")
    array = array.astype(dtype, copy=False)
    return array[:, None] if array.ndim == 1 else array


def reward_columns(arrays: Mapping[str, Any], request: Request) -> tuple[dict[str, NDArray[Any]], set[str]]:
    """LeRobot's reward columns, (T, 1) each, from the names formats give them.

    Returns:
        the columns (none with ``rewards=False``), and all names of ``arrays`` that hold rewards.
    """
    columns: dict[str, NDArray[Any]] = {}
    taken: set[str] = set()
    for target, names in REWARD_NAMES.items():
        dtype = np.float32 if target == NEXT_REWARD else np.bool_
        for name in names:
            if name in arrays:
                taken.add(name)
                if request.rewards and target not in columns:
                    columns[target] = np.asarray(arrays[name]).astype(dtype).reshape(len(arrays[name]), -1)[:, :1]
    return columns, taken


def camera_columns(keys: Sequence[str], request: Request, extra: Iterable[str] = ()) -> dict[str, str]:
    """Input name -> LeRobot name of the chosen cameras: endings ``_rgb`` and ``_image`` go, unless two then agree.

    Args:
        keys: cameras that are taken by default.
        request: its ``image_keys`` choose among ``keys`` and ``extra``.
        extra: pictures that are taken only when they are named.

    Raises:
        ConfigError: an unknown camera.
    """
    if request.image_keys == NO_PICTURES:
        return {}
    chosen = choose("camera in --image_keys", request.image_keys, [*keys, *extra]) if request.image_keys else keys
    short = {key: re.sub(r"_(rgb|image)$", "", key) or key for key in chosen}
    unique = len(set(short.values())) == len(short)
    return {key: f"observation.images.{(short[key] if unique else key).replace('/', '_')}" for key in chosen}


def folder_task(path: Path) -> str:
    """A sentence from a file's or folder's name, where nothing better is known."""
    return re.sub(r"[_\-.]+", " ", re.sub(r"(\.zarr)?(\.zip|\.hdf5|\.h5)?$", "", path.resolve().name)).strip()
