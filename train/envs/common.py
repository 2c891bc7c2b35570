"""What the environments share: lean pictures of other people's models, checked actions, observation spaces."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import DataError

__all__ = ["RENDER_SIZE", "checked_action", "dict_space", "make_lean"]

RENDER_SIZE = (360, 480)  # height, width of `render()`


def make_lean(model: Any, image_size: int) -> None:
    """Set a MuJoCo model up for `cameras.Cameras` to draw it fast; call it before the first picture.

    Args:
        model: `mujoco.MjModel`; only its rendering settings change.
        image_size: height and width of the largest observed picture, pixels.
    """
    quality, screen = model.vis.quality, model.vis.global_
    # A renderer takes these over when it is made; in software each costs more than the picture itself.
    quality.offsamples, quality.shadowsize = 0, 0
    quality.numslices, quality.numstacks, quality.numquads = 14, 7, 2
    screen.offwidth, screen.offheight = max(image_size, RENDER_SIZE[1]), max(image_size, RENDER_SIZE[0])


def checked_action(action: Any, space: gym.spaces.Box, names: Sequence[str]) -> NDArray[np.float64]:
    """An action as float64, (len(names),), clipped to `space`.

    Raises:
        DataError: another shape, or a number that is not finite.
    """
    values = np.asarray(action, dtype=np.float64)
    if values.shape != (len(names),):
        raise DataError(f"Action has shape {values.shape}: expected ({len(names)},), {', '.join(names)}.")
    if not np.isfinite(values).all():
        bad = names[int(np.flatnonzero(~np.isfinite(values))[0])]
        raise DataError(f"Action is not finite at '{bad}': expected {len(names)} finite numbers.")
    clipped: NDArray[np.float64] = np.clip(values, space.low, space.high)
    return clipped


def dict_space(agent_pos: int, environment_state: int, cameras: Sequence[str], image_size: int) -> gym.spaces.Dict:
    """Observation space of vectors of so many numbers, without those of size 0, and one picture a camera."""
    spaces: dict[str, gym.Space[Any]] = {}
    for name, size in (("agent_pos", agent_pos), ("environment_state", environment_state)):
        if size:
            spaces[name] = gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
    if cameras:
        image = gym.spaces.Box(0, 255, (image_size, image_size, 3), np.uint8)
        spaces["pixels"] = gym.spaces.Dict(dict.fromkeys(cameras, image))
    return gym.spaces.Dict(spaces)
