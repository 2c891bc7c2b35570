"""RLBench demonstrations as its dataset generator saves them: a pickle of numbers and folders of PNG files each.

The observation after an action holds what was commanded, so the action of step t is read from observation t + 1 and
the last observation, after which nothing is done, gives no step.
"""

import contextlib
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import DataError, one_of
from lerobot_cqn.schema import ACTION

from .common import (
    STATE,
    Episode,
    Reader,
    Request,
    camera_columns,
    decode,
    dimension_names,
    folder_task,
    in_natural_order,
    join,
    whole_fps,
)
from .rlbench_pickle import read_demo, read_descriptions

__all__ = ["open_reader"]

NUMBERS, DESCRIPTIONS = "low_dim_obs.pkl", "variation_descriptions.pkl"
JOINTS, GRIPPER = "joint_positions", "gripper_open"
COMMAND = "joint_position_action"  # in `misc`, where the recording's RLBench wrote it: joints, then gripper
SIMULATED_FPS = 20  # one observation for each simulated step of 0.05 s
PICTURES = re.compile(r".+_(rgb|depth|mask)$")


@contextlib.contextmanager
def open_reader(request: Request) -> Iterator[Reader]:
    """Open one episode, or any folder above: a variation, a task, or several tasks.

    Raises:
        ConfigError: an unknown camera.
        DataError: no episode below the folder.
    """
    yield _RLBench(request)


class _PngFolder(Sequence[NDArray[np.uint8]]):
    """``0.png``, ``1.png``, …, the first ``steps`` of them."""

    def __init__(self, folder: Path, steps: int) -> None:
        self._folder, self._steps = folder, steps

    def __len__(self) -> int:
        return self._steps

    def __getitem__(self, step: Any) -> Any:
        return decode((self._folder / f"{step}.png").read_bytes())


class _RLBench:
    robot_type: str | None = None  # the files do not name the arm

    def __init__(self, request: Request) -> None:
        self._request = request
        folders = _episode_folders(request.input)
        if not folders:
            raise DataError(
                f"{request.input}: expected RLBench episodes (variation0/episodes/episode0/{NUMBERS}), found none."
            )
        self._folders = {_relative(folder, request.input): folder for folder in folders}
        self.episodes = in_natural_order(self._folders)
        self.fps = whole_fps(request, SIMULATED_FPS, "RLBench's simulation step of 0.05 s")
        there = next((p for e in self.episodes if (p := _picture_folders(self._folders[e]))), [])
        colours = [name for name in there if name.endswith("_rgb")]
        self._cameras = camera_columns(colours, request, [n for n in there if n not in colours])
        left_out = [name for name in there if name not in self._cameras]
        self.notes = [f"Left out: {', '.join(left_out)}."] if left_out else []
        coded = [name for name in self._cameras if name not in colours]
        if coded:
            self.notes.append(f"{', '.join(coded)}: numbers coded as colours; only --video=false keeps them exactly.")

    @contextlib.contextmanager
    def episode(self, name: str) -> Iterator[Episode]:
        folder = self._folders[name]
        path = folder / NUMBERS
        observations = read_demo(path)
        steps = len(observations) - 1
        if steps < 1:
            raise DataError(f"{path}: expected at least 2 observations, found {len(observations)}; leave it out.")
        state = {
            key: np.stack([_vector(path, step, o, key) for step, o in enumerate(observations)])
            for key in self._request.state_keys or (JOINTS, GRIPPER)
        }
        values, names = join({key: v[:-1] for key, v in state.items()})
        action, action_names, commanded = _actions(path, observations)
        cameras = {target: _PngFolder(folder / key, steps) for key, target in self._cameras.items()}
        for key in self._cameras:
            _check_pictures(folder / key, len(observations))
        yield Episode(
            where=str(folder),
            task=self._task(folder),
            columns={STATE: values, ACTION: action},
            names={STATE: names, ACTION: action_names},
            cameras=dict(cameras),
            facts={"commanded_actions": commanded, "measured_actions": steps - commanded},
        )

    def _task(self, folder: Path) -> str:
        """First description of the variation, which lies beside the episodes or in the episode; else the task."""
        if self._request.task is not None:
            return self._request.task
        for place in (folder, folder.parent.parent):
            if (place / DESCRIPTIONS).is_file():
                return read_descriptions(place / DESCRIPTIONS)[0]
        above = folder.resolve().parents
        return folder_task(above[2] if len(above) > 2 else folder)


def _actions(path: Path, observations: list[dict[str, Any]]) -> tuple[NDArray[np.float32], list[str], int]:
    """(T, J + 1) absolute joint targets and gripper of the steps, their names, and how many were commanded."""
    joints, gripper, commanded = [], [], 0
    for step, following in enumerate(observations[1:], start=1):
        measured = _vector(path, step, following, JOINTS)
        command = (following.get("misc") or {}).get(COMMAND)
        if command is not None:
            command = np.asarray(command, np.float64).reshape(-1)
            if len(command) not in (len(measured), len(measured) + 1):
                raise DataError(
                    f"{path}, frame {step}: expected {len(measured)} or {len(measured) + 1} numbers in"
                    f" misc['{COMMAND}'], found {len(command)}; leave this episode out."
                )
            commanded += 1
        joints.append(measured if command is None else command[: len(measured)])
        gripper.append(_vector(path, step, following, GRIPPER))
    arm, hand = np.stack(joints), np.stack(gripper)
    values, _ = join({JOINTS: arm, GRIPPER: hand})
    return values, [*dimension_names(JOINTS, arm), *dimension_names(GRIPPER, hand)], commanded


def _vector(path: Path, step: int, observation: dict[str, Any], key: str) -> NDArray[np.float64]:
    """(P,) numbers of one attribute."""
    if observation.get(key) is None:
        there = [k for k, v in observation.items() if v is not None and k != "misc"]
        raise DataError(f"{path}, frame {step}: {one_of('attribute', key, there)}")
    try:
        return np.asarray(observation[key], np.float64).reshape(-1)
    except (TypeError, ValueError) as error:
        raise DataError(
            f"{path}, frame {step}: expected numbers in '{key}', found {observation[key]!r:.40}."
        ) from error


def _check_pictures(folder: Path, observations: int) -> None:
    there = {entry.name for entry in os.scandir(folder)} if folder.is_dir() else set()
    pictures = sum(name.endswith(".png") for name in there)
    if pictures != observations:
        raise DataError(
            f"{folder}: expected {observations} pictures, one an observation in {NUMBERS}, found {pictures}."
        )
    missing = next((i for i in range(observations) if f"{i}.png" not in there), None)
    if missing is not None:
        raise DataError(f"{folder}: expected 0.png to {observations - 1}.png, but {missing}.png is missing.")


def _picture_folders(episode: Path) -> list[str]:
    """Names of the folders that hold pictures."""
    if not episode.is_dir():
        return []
    return sorted(p.name for p in episode.iterdir() if PICTURES.match(p.name) and p.is_dir() and any(p.iterdir()))


def _episode_folders(top: Path) -> list[Path]:
    """Folders with the numbers of an episode, and those called so in which the numbers are missing."""
    found = []
    for folder, below, files in os.walk(top):
        below[:] = sorted(name for name in below if not PICTURES.match(name))
        if NUMBERS in files or re.fullmatch(r"episode\d+", Path(folder).name):
            found.append(Path(folder))
            below.clear()
    return found


def _relative(folder: Path, top: Path) -> str:
    return folder.relative_to(top).as_posix() if folder != top else top.resolve().name
