"""A folder of NumPy archives, one episode each, whose arrays are called as LeRobot calls its columns."""

import contextlib
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lerobot_cqn.errors import DataError
from lerobot_cqn.schema import ACTION

from .common import (
    STATE,
    Episode,
    Pictures,
    Reader,
    Request,
    camera_columns,
    choose,
    folder_task,
    in_natural_order,
    join,
    lacks,
    number_column,
    reading,
    reward_columns,
    storable,
    whole_fps,
)
from .disk_arrays import NpyRows

__all__ = ["open_reader"]

LEROBOT_WRITES = ("timestamp", "frame_index", "episode_index", "index", "task_index")
SINGLE = ("fps", "task")
IMAGE = "observation.image"  # LeRobot's name for a single camera; several are observation.images.NAME


@contextlib.contextmanager
def open_reader(request: Request) -> Iterator[Reader]:
    """Open one ``.npz`` file or a folder of them; keys are chosen by what the first readable one holds.

    Raises:
        ConfigError: an unknown key or no ``fps``.
        DataError: no archive, or none of them can be read.
    """
    yield _Npz(request)


class _Npz:
    robot_type: str | None = None

    def __init__(self, request: Request) -> None:
        self._request = request
        files = list(request.input.glob("*.npz")) if request.input.is_dir() else [request.input]
        self._files = {path.name: path for path in files}
        self.episodes = in_natural_order(self._files)
        if not files:
            raise DataError(f"{request.input}: expected files *.npz, found none.")
        arrays, fps = self._look()
        pictures = [key for key, array in arrays.items() if _is_picture(key, array)]
        own = (*pictures, *LEROBOT_WRITES, *SINGLE, ACTION)
        numbers = [key for key, array in arrays.items() if key not in own and storable(array)]
        for key in (ACTION, *([] if request.state_keys else [STATE])):
            if key not in arrays:
                raise lacks(str(request.input), key, arrays, "Another column makes the state with --state_keys.")
        self._cameras = _camera_names(pictures, request)
        self._state = choose("key in --state_keys", request.state_keys, numbers) or [STATE]
        steps = len(arrays[ACTION])
        self._others = [k for k in numbers if k not in self._state and len(arrays[k]) == steps]
        used = (*self._cameras, *self._state, *self._others, *LEROBOT_WRITES, *SINGLE, ACTION)
        unused = [key for key in arrays if key not in used]
        self.notes = [f"Left out: {', '.join(unused)}."] if unused else []
        self.fps = whole_fps(request, fps, "the array fps")

    def _look(self) -> tuple[dict[str, NpyRows], Any]:
        """Arrays of the first archive that can be read, and its number ``fps``."""
        first: DataError | None = None
        for name in self.episodes:
            try:
                with _open(self._files[name]) as arrays, reading(str(self._files[name])):
                    fps = float(arrays["fps"].everything()) if "fps" in arrays else None
                    return arrays, fps
            except DataError as error:
                first = first or error
        raise first or DataError(f"{self._request.input} holds no episode.")

    @contextlib.contextmanager
    def episode(self, name: str) -> Iterator[Episode]:
        path = self._files[name]
        where = str(path)
        with _open(path) as arrays:
            for key in (ACTION, *self._state, *self._cameras, *self._others):
                if key not in arrays:
                    raise lacks(where, key, arrays, "All episodes need the same arrays.")
            with reading(where):
                columns: dict[str, Any] = {}
                names: dict[str, list[str]] = {}
                columns[STATE], names[STATE] = join({key: arrays[key].everything() for key in self._state})
                columns[ACTION], names[ACTION] = join({ACTION: arrays[ACTION].everything()})
                if self._state == [STATE]:
                    del names[STATE]  # nothing that the numbers would not say
                others = {key: arrays[key].everything() for key in self._others}
                rewards, taken = reward_columns(others, self._request)
                kept = {key: number_column(v) for key, v in others.items() if key not in taken}
                columns |= rewards | {key.replace("/", "_"): values for key, values in kept.items()}
                task = self._request.task
                if task is None:
                    task = str(arrays["task"].everything()) if "task" in arrays else folder_task(self._request.input)
            cameras = {target: Pictures(arrays[key]) for key, target in self._cameras.items()}
            yield Episode(where=where, task=task, columns=columns, names=names, cameras=dict(cameras))


def _is_picture(key: str, array: NpyRows) -> bool:
    """Named as LeRobot names cameras, or four axes with 1, 3 or 4 colour channels, last or second."""
    if key == IMAGE or key.startswith(f"{IMAGE}s."):
        return True
    return len(array.shape) == 4 and (array.shape[3] in (1, 3, 4) or array.shape[1] in (1, 3, 4))


def _camera_names(keys: list[str], request: Request) -> dict[str, str]:
    """LeRobot's own names stay as they are."""
    chosen = camera_columns(keys, request)
    return {key: key if key.startswith(IMAGE) else target for key, target in chosen.items()}


@contextlib.contextmanager
def _open(path: Path) -> Iterator[dict[str, NpyRows]]:
    """The arrays of an archive, none of them read yet."""
    if not path.is_file():
        raise DataError(f"Expected an .npz file or a folder of them, found nothing at {path}.")
    with reading(str(path)):
        archive = zipfile.ZipFile(path)
    with archive:
        with reading(str(path)):
            members = [name for name in archive.namelist() if name.endswith(".npy")]
            arrays = {name.removesuffix(".npy"): NpyRows(archive, name) for name in members}
        try:
            yield arrays
        finally:
            for array in arrays.values():
                array.close()
