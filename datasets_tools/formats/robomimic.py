"""robomimic HDF5 files: ``data/demo_N`` with ``actions``, ``obs/…``, ``rewards``, ``dones``."""

import contextlib
import json
import re
from collections.abc import Iterator
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

# robomimic's own choice of proprioception, for each arm in turn; objects go to the environment's state.
STATE_ENDINGS = ("eef_pos", "eef_quat", "gripper_qpos")
OBJECT, ENVIRONMENT_STATE = "object", "observation.environment_state"


@contextlib.contextmanager
def open_reader(request: Request) -> Iterator[Reader]:
    """Open one HDF5 file.

    Raises:
        ConfigError: h5py is missing, an unknown key, or no frame rate.
        DataError: not HDF5, cut short, or without demonstrations or observations.
    """
    with open_hdf5(request.input) as file:
        yield _Robomimic(file, request)


class _Robomimic:
    def __init__(self, file: Any, request: Request) -> None:
        self._request = request
        path = str(request.input)
        if "data" not in file:
            raise lacks(path, "data", file.keys())
        self._data = file["data"]
        self.episodes = in_natural_order(name for name in self._data if re.fullmatch(r"demo_?\d+", name))
        if not self.episodes:
            raise lacks(f"{path}, data", "demo_0", self._data.keys())
        with reading(f"{path}, {self.episodes[0]}"):
            observations = self._data[self.episodes[0]].get("obs")
            shapes = {key: len(array.shape) for key, array in observations.items()} if observations is not None else {}
        if not shapes:
            raise DataError(
                f"{path}: {self.episodes[0]} has no observations (obs); extract them first with robomimic's"
                " dataset_states_to_obs.py."
            )
        pictures = [key for key, ndim in shapes.items() if ndim == 4 and key.endswith("_image")]
        others = [key for key, ndim in shapes.items() if ndim == 4 and key not in pictures]
        with reading(path):
            seen = {name: arrays_in(self._data[name]) for name in self.episodes}
            first = seen[self.episodes[0]]
        self._actions = choose("array in --action_keys", request.action_keys, first) or ["actions"]
        numbers = [key for key, ndim in shapes.items() if ndim < 4]
        self._cameras = camera_columns(pictures, request, others)
        self._state = choose("key in --state_keys", request.state_keys, numbers) or _default_state(path, numbers)
        self._object = OBJECT in numbers and OBJECT not in self._state
        used = {f"obs/{key}" for key in (*self._cameras, *self._state, *([OBJECT] if self._object else []))}
        rewards = {"rewards", "dones", "success"} if request.rewards else set()
        self.notes = left_out(seen, {*used, *self._actions, *rewards})
        if beside := sorted(key for key in file if key != "data"):
            self.notes.append(f"Left out of the file: {', '.join(beside)}.")
        arguments = _env_args(path, self._data)
        self.fps = whole_fps(request, *_frame_rate(arguments))
        robots = arguments.get("env_kwargs", {}).get("robots")
        self.robot_type = "_".join(robots) if isinstance(robots, list) else robots
        self._task = str(_problem(path, self._data) or arguments.get("env_name") or folder_task(request.input)).replace(
            "_", " "
        )

    @contextlib.contextmanager
    def episode(self, name: str) -> Iterator[Episode]:
        where = f"{self._request.input}, {name}"
        with reading(where):
            demo = self._data[name]
            if "obs" not in demo:
                raise lacks(where, "obs", demo.keys())
            names: dict[str, list[str]] = {}
            columns = {}
            columns[STATE], names[STATE] = join({k: array_of(demo, f"obs/{k}", where)[()] for k in self._state})
            if self._object:
                values, labels = join({OBJECT: array_of(demo, f"obs/{OBJECT}", where)[()]})
                columns[ENVIRONMENT_STATE], names[ENVIRONMENT_STATE] = values, labels
            columns[ACTION], names[ACTION] = join_action({k: array_of(demo, k, where)[()] for k in self._actions})
            there = {key: demo[key][()] for key in ("rewards", "dones", "success") if key in demo}
            columns |= reward_columns(there, self._request)[0]
            cameras = {to: Pictures(Rows(array_of(demo, f"obs/{key}", where))) for key, to in self._cameras.items()}
            task = self._request.task or _told(demo) or self._task
        yield Episode(where=where, task=task, columns=columns, names=names, cameras=dict(cameras))


def _default_state(path: str, numbers: list[str]) -> list[str]:
    """Gripper position, orientation and fingers of ``robot0``, ``robot1``, …, in this order."""
    arms = in_natural_order({key.split("_", 1)[0] for key in numbers if re.match(r"robot\d+_", key)})
    chosen = [f"{arm}_{ending}" for arm in arms for ending in STATE_ENDINGS if f"{arm}_{ending}" in numbers]
    if not chosen:
        raise DataError(
            f"{path}: no robot0_eef_pos and the like in obs; choose --state_keys from {', '.join(numbers)}."
        )
    return chosen


def _told(demo: Any) -> str | None:
    """The task as a demonstration itself tells it, in ``ep_meta`` or its own attribute."""
    meta = sentence(demo.attrs.get("ep_meta"))
    if meta is not None:
        found = json.loads(demo.attrs["ep_meta"])
        return sentence(found.get("lang")) or sentence(found.get("language_instruction"))
    return sentence(demo.attrs.get("language_instruction")) or sentence(demo.attrs.get("lang"))


def _problem(path: str, data: Any) -> str | None:
    """The task as ``problem_info`` tells it for the whole file."""
    text = data.attrs.get("problem_info")
    if text is None:
        return None
    with reading(f"{path}, attribute problem_info"):
        return sentence(json.loads(text).get("language_instruction"))


def _env_args(path: str, data: Any) -> dict[str, Any]:
    """The environment as the file describes it; empty where it does not."""
    text = data.attrs.get("env_args")
    if text is None:
        return {}
    with reading(f"{path}, attribute env_args"):
        arguments: dict[str, Any] = json.loads(text)
        arguments["env_kwargs"] = dict(arguments.get("env_kwargs") or {})
    return arguments


def _frame_rate(arguments: dict[str, Any]) -> tuple[Any, str]:
    for place, label in ((arguments, "env_args"), (arguments.get("env_kwargs", {}), "env_args.env_kwargs")):
        for key in ("fps", "control_freq"):
            if place.get(key):
                return place[key], f"{label}.{key}"
    return None, ""
