"""ALOHA recordings as ACT reads them: one ``episode_N.hdf5`` each, with ``observations/qpos`` and ``action``."""

import contextlib
import re
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
    join_action,
    lacks,
    reading,
    reward_columns,
    sentence,
    whole_fps,
)
from .disk_arrays import Rows, array_of, open_hdf5
from .leftovers import arrays_in, left_out

__all__ = ["open_reader"]

ALOHA_FPS = 50
ARM = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate", "gripper")
JOINTS = [f"{side}_{joint}" for side in ("left", "right") for joint in ARM]
OWN_COLUMN = {"qvel": "observation.velocity", "effort": "observation.effort"}
BASE = "base_action"
IMAGES, LANGUAGE = "observations/images/", "language_raw"
COUNTS = "compress_len"  # how long each JPEG is; its own end tells
REWARDS = ("reward", "rewards", "success")


@contextlib.contextmanager
def open_reader(request: Request) -> Iterator[Reader]:
    """Open one episode or a folder of them; keys are chosen by what the first readable one holds.

    Raises:
        ConfigError: h5py is missing or an unknown key.
        DataError: no episode, or none of them can be read.
    """
    yield _Aloha(request)


class _Aloha:
    def __init__(self, request: Request) -> None:
        self._request = request
        files = [request.input]
        if request.input.is_dir():
            files = [p for p in request.input.iterdir() if _is_episode(p)]
        self._files = {path.name: path for path in files}
        self.episodes = in_natural_order(self._files)
        if not files:
            raise DataError(f"{request.input}: expected episode_0.hdf5, episode_1.hdf5, …, found none.")
        seen = self._look()
        first = next(iter(seen.values()))
        observations = [k.removeprefix("observations/") for k in first if re.fullmatch(r"observations/[^/]+", k)]
        pictures = [k.removeprefix(IMAGES) for k in first if k.startswith(IMAGES)]
        depth = [key for key in pictures if key.endswith("_depth")]
        self._cameras = camera_columns([key for key in pictures if key not in depth], request)
        self._state = choose("key in --state_keys", request.state_keys, observations) or ["qpos"]
        self._others = {k: v for k, v in OWN_COLUMN.items() if k in observations and k not in self._state}
        self._actions = choose("array in --action_keys", request.action_keys, first) or [ACTION]
        self._based = BASE in first and BASE not in self._actions
        taken = {f"observations/{k}" for k in (*self._state, *self._others)} | {IMAGES + k for k in self._cameras}
        taken |= {*self._actions, BASE, COUNTS, *(() if request.task else (LANGUAGE,))}
        self.notes = left_out(seen, taken | (set(REWARDS) if request.rewards else set()))
        if request.input.is_dir() and (beside := sorted(p.name for p in request.input.iterdir() if p not in files)):
            self.notes.append(f"Left out of the folder: {', '.join(beside)}.")
        if self._based:
            self.notes.append(f"The motion of the base stays a column of its own, '{BASE}'; the action is the arms'.")
        self.fps = whole_fps(request, ALOHA_FPS, "ALOHA's control rate")
        self.robot_type: str | None = "aloha"
        self._task = folder_task(request.input if request.input.is_dir() else request.input.parent)

    def _look(self) -> dict[str, list[str]]:
        """Arrays of the episodes that can be read, by the episode's name."""
        seen: dict[str, list[str]] = {}
        first: DataError | None = None
        for name in self.episodes:
            path = self._files[name]
            try:
                with open_hdf5(path) as file, reading(str(path)):
                    if "observations" not in file:
                        raise lacks(str(path), "observations", file.keys())
                    seen[name] = arrays_in(file)
            except DataError as error:
                first = first or error
        if not seen:
            raise first or DataError(f"{self._request.input} holds no episode.")
        return seen

    @contextlib.contextmanager
    def episode(self, name: str) -> Iterator[Episode]:
        path = self._files[name]
        where = str(path)
        with open_hdf5(path) as file:
            with reading(where):
                columns: dict[str, Any] = {}
                names: dict[str, list[str]] = {}
                keys = {k: array_of(file, f"observations/{k}", where)[()] for k in self._state}
                columns[STATE], names[STATE] = join(keys)
                commands = {key: array_of(file, key, where)[()] for key in self._actions}
                columns[ACTION], names[ACTION] = join_action(commands)
                for key, target in self._others.items():
                    values = array_of(file, f"observations/{key}", where)[()]
                    columns[target], names[target] = join({key: values})
                if self._based:
                    columns[BASE], names[BASE] = join({BASE: array_of(file, BASE, where)[()]})
                there = {key: file[key][()] for key in REWARDS if key in file}
                columns |= reward_columns({k: v for k, v in there.items() if v.ndim}, self._request)[0]
                images = {to: array_of(file, f"observations/images/{key}", where) for key, to in self._cameras.items()}
                said = sentence(file[LANGUAGE][()]) if LANGUAGE in file else None
            arm_keys = (ACTION, *OWN_COLUMN.values(), *([STATE] if self._state == ["qpos"] else []))
            names |= {k: JOINTS for k in arm_keys if k in names and len(names[k]) == len(JOINTS)}
            cameras = {target: Pictures(Rows(array)) for target, array in images.items()}
            task = self._request.task or said or self._task
            yield Episode(where=where, task=task, columns=columns, names=names, cameras=dict(cameras))


def _is_episode(path: Path) -> bool:
    return bool(re.fullmatch(r"episode_?\d+\.(hdf5|h5)", path.name))
