"""Lean off-screen rendering: renderers are made on first use, and closed without noise."""

import atexit
import weakref
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .simulator import load_mujoco

__all__ = ["RENDER_SIZE", "Cameras", "make_lean"]

RENDER_SIZE = (360, 480)  # height, width of an environment's `render()`


def make_lean(model: Any, image_size: int) -> None:
    """Set a MuJoCo model up for `Cameras` to draw it fast; call it before the first picture.

    Args:
        model: `mujoco.MjModel`; only its rendering settings change.
        image_size: height and width of the largest observed picture, pixels.
    """
    quality, screen = model.vis.quality, model.vis.global_
    # A renderer takes these over when it is made; in software each costs more than the picture itself.
    quality.offsamples, quality.shadowsize = 0, 0
    quality.numslices, quality.numstacks, quality.numquads = 14, 7, 2
    screen.offwidth, screen.offheight = max(image_size, RENDER_SIZE[1]), max(image_size, RENDER_SIZE[0])


class Cameras:
    """Pictures by named cameras of one model; no graphics context is opened before the first picture."""

    def __init__(self, model: Any) -> None:
        self._model = model
        self._renderers: dict[tuple[int, int], Any] = {}
        weakref.finalize(self, _close, self._renderers).atexit = False

    @property
    def opened(self) -> bool:
        """Whether a graphics context exists."""
        return bool(self._renderers)

    def picture(self, data: Any, camera: str, height: int, width: int, oversample: int = 1) -> NDArray[np.uint8]:
        """RGB picture (height, width, 3); `oversample` > 1 averages that many pixels a side."""
        renderer = self._renderer(height * oversample, width * oversample)
        renderer.update_scene(data, camera=camera)
        picture: NDArray[np.uint8] = renderer.render()
        if oversample == 1:
            return picture
        blocks = picture.reshape(height, oversample, width, oversample, 3)
        # Summing slices is several times faster than mean() over two axes.
        total = sum(blocks[:, i, :, j].astype(np.uint16) for i in range(oversample) for j in range(oversample))
        averaged: NDArray[np.uint8] = (total // oversample**2).astype(np.uint8)  # type: ignore[union-attr]
        return averaged

    def close(self) -> None:
        """Release the graphics contexts; the next picture opens new ones."""
        _close(self._renderers)

    def _renderer(self, height: int, width: int) -> Any:
        key = (height, width)
        if key not in self._renderers:
            mujoco = load_mujoco()
            renderer = mujoco.Renderer(self._model, height, width)
            if not self._renderers:
                # Registered after the graphics library's own: what is registered last is called first.
                atexit.register(_close, self._renderers)
            flags = mujoco.mjtRndFlag
            # Each costs a pass in software rendering and shows nothing here.
            for flag in (flags.mjRND_SHADOW, flags.mjRND_REFLECTION, flags.mjRND_SKYBOX, flags.mjRND_HAZE):
                renderer.scene.flags[flag] = False
            self._renderers[key] = renderer
        return self._renderers[key]


def _close(renderers: dict[tuple[int, int], Any]) -> None:
    while renderers:
        renderers.popitem()[1].close()
