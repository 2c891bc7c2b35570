"""Zarr replay buffers of diffusion_policy: all episodes end to end in ``data/*``, cut at ``meta/episode_ends``."""

import contextlib
import re
import zipfile
from collections.abc import Iterator
from typing import Any

import numpy as np

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
    join,
    join_action,
    lacks,
    need,
    number_column,
    reading,
    reward_columns,
    storable,
    whole_fps,
)
from .disk_arrays import Rows, array_of
from .leftovers import left_out

__all__ = ["open_reader"]

ENDS = "episode_ends"
BUFFER = "replay_buffer.zarr"
STATE_NAMES = ("state", "agent_pos", "robot_joint", "robot_eef_pose")
UMI_PARTS = ("eef_pos", "eef_rot_axis_angle", "gripper_width")
CLOCK = ("timestamp",)  # LeRobot writes its own


@contextlib.contextmanager
def open_reader(request: Request) -> Iterator[Reader]:
    """Open a ``.zarr`` folder, a folder that holds ``replay_buffer.zarr``, or a ``.zarr.zip`` file.

    Raises:
        ConfigError: zarr is missing, an unknown key, or no ``fps``.
        DataError: no replay buffer, or its arrays do not fit its episode ends.
    """
    zarr = need("zarr")
    path = request.input
    if path.is_dir() and (path / BUFFER).is_dir():
        path /= BUFFER
    where = str(path)
    if path.is_file():
        if not zipfile.is_zipfile(path):
            raise DataError(f"{path}: expected a .zarr folder or a complete .zarr.zip file.")
        with reading(where):
            store = zarr.storage.ZipStore(where, mode="r")
    else:
        store = where
    try:
        with reading(where):
            root = zarr.open_group(store, mode="r")
        reader = _ReplayBuffer(root, where, request)
        if (path.parent / "videos").is_dir():
            reader.notes.append(f"{path.parent / 'videos'} is not read: only pictures in the buffer become cameras.")
        yield reader
    finally:
        if store is not where:
            store.close()


class _ReplayBuffer:
    robot_type: str | None = None
    _following = False  # the action is the next step's pose

    def __init__(self, root: Any, where: str, request: Request) -> None:
        self._request, self._where = request, where
        with reading(where):
            groups = list(root.keys())
        for group in ("data", "meta"):
            if group not in groups:
                raise lacks(where, group, groups)
        ends = array_of(root, f"meta/{ENDS}", where)
        with reading(where):
            beside = [f"meta/{key}" for key in root["meta"].keys() if key != ENDS]  # noqa: SIM118
            beside += [group for group in groups if group not in ("data", "meta")]
            self._arrays = {key: root[f"data/{key}"] for key in root["data"].keys()}  # noqa: SIM118 (a Zarr group)
            self._arrays = {key: array for key, array in self._arrays.items() if hasattr(array, "shape")}
            self._ends = np.asarray(ends[:], dtype=np.int64)
        self._actions = choose("array in --action_keys", request.action_keys, self._arrays) or self._default_action()
        self._check_ends()
        width = len(str(len(self._ends) - 1))
        self.episodes = [f"episode_{i:0{width}d}" for i in range(len(self._ends))]
        pictures = [key for key, array in self._arrays.items() if len(array.shape) == 4]
        depth = [key for key in pictures if "depth" in key]
        own = (*pictures, *CLOCK, ACTION, *([] if self._following else self._actions))
        numbers = [key for key, array in self._arrays.items() if key not in own and storable(array)]
        self._cameras = camera_columns([key for key in pictures if key not in depth], request, depth)
        chosen = choose("key in --state_keys", request.state_keys, numbers)
        self._state = chosen or _poses(numbers) or _default_state(where, numbers)
        self._others = [key for key in numbers if key not in self._state]
        taken = (*self._cameras, *numbers, *self._actions)
        self.notes = left_out({"": [f"data/{k}" for k in self._arrays] + beside}, {f"data/{key}" for key in taken})
        if self._following:
            self.notes.append(
                f"There is no action: it is the next step's {', '.join(self._actions)}, the last step's its own, as UMI"
                " trains; --action_keys chooses other arrays."
            )
        self.notes += [text for key in self._arrays if (text := self._gaps(key))]
        self.fps = whole_fps(request, root.attrs.get("fps"), "the buffer's attribute fps")
        self._task = request.task or folder_task(request.input)

    def _default_action(self) -> list[str]:
        """The action, or what UMI takes for it: where hand and gripper are next."""
        if ACTION in self._arrays:
            return [ACTION]
        self._following = bool(poses := _poses(list(self._arrays)))
        if not poses:
            hint = "Name the arrays that are the action: --action_keys='[…]'."
            raise lacks(f"{self._where}, data", ACTION, self._arrays, hint)
        return poses

    def _check_ends(self) -> None:
        ends, where = self._ends, f"{self._where}, meta/{ENDS}"
        if not len(ends):
            raise DataError(f"{where} is empty: there are no episodes.")
        if (np.diff(ends, prepend=0) < 0).any():
            raise DataError(f"{where}: expected row numbers that grow, found {ends[:8].tolist()}….")
        for key, array in self._arrays.items():
            if array.shape[0] != ends[-1]:
                raise DataError(
                    f"{self._where}, data/{key}: expected {ends[-1]} rows, where the last episode ends, found"
                    f" {array.shape[0]}; copy the buffer again or mend meta/{ENDS}."
                )

    def _gaps(self, key: str) -> str:
        """Zarr reads absent chunks as its fill value, whether they are lost or were never written."""
        array = self._arrays[key]
        missing = int(array.nchunks) - int(array.nchunks_initialized)
        return f"data/{key}: {missing} of {array.nchunks} chunks are not on disk and read as {array.fill_value}." * (
            missing > 0
        )

    @contextlib.contextmanager
    def episode(self, name: str) -> Iterator[Episode]:
        where = f"{self._where}, {name}"
        index = int(name.rpartition("_")[2])
        start, stop = int(self._ends[index - 1]) if index else 0, int(self._ends[index])
        with reading(where):
            arrays = {key: self._arrays[key][start:stop] for key in (*self._actions, *self._state, *self._others)}
            columns: dict[str, Any] = {}
            names: dict[str, list[str]] = {}
            columns[STATE], names[STATE] = join({key: arrays[key] for key in self._state})
            commands = {key: arrays[key] for key in self._actions}
            if self._following:
                commands = {key: np.concatenate([values[1:], values[-1:]]) for key, values in commands.items()}
            columns[ACTION], names[ACTION] = join_action(commands)
            others = {key: arrays[key] for key in self._others}
            rewards, taken = reward_columns(others, self._request)
            columns |= rewards | {key: number_column(v) for key, v in others.items() if key not in taken}
            cameras = {to: Pictures(Rows(self._arrays[key], start, stop)) for key, to in self._cameras.items()}
        yield Episode(where=where, task=self._task, columns=columns, names=names, cameras=dict(cameras))


def _poses(keys: list[str]) -> list[str]:
    """Pose and gripper of each hand, in UMI's names; empty where a part is missing."""
    hands = sorted({found[1] for key in keys if (found := re.fullmatch(r"(robot\d+)_eef_pos", key))})
    poses = [f"{hand}_{part}" for hand in hands for part in UMI_PARTS]
    return poses if all(key in keys for key in poses) else []


def _default_state(where: str, numbers: list[str]) -> list[str]:
    chosen = [key for key in STATE_NAMES if key in numbers][:1]
    if not chosen:
        found = ", ".join(numbers) or "nothing"
        raise DataError(f"{where}: none of {', '.join(STATE_NAMES)} in data; choose --state_keys from {found}.")
    return chosen
