"""A film of the virtual table, taken while something happens there."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from ..virtual_so101.table import Table

__all__ = ["Film"]

FPS = 8  # of the real clock
MOVES = 0.05  # mean difference of two pictures, of 255, beyond which something moves; what stands still is cut
SIZE = (240, 320)  # height, width in pixels


class Film:
    """Pictures by the camera that sees both arms.

    Attributes:
        frames: (240, 320, 3) uint8 each, `FPS` a second.
    """

    def __init__(self, table: Table) -> None:
        self._table = table
        table.picture("side", *SIZE)  # the first one takes long, in which no motor would answer
        self.frames: list[NDArray[np.uint8]] = []

    @contextmanager
    def rolling(self) -> Iterator[None]:
        """Take pictures until the end of the block."""
        cut = threading.Event()
        camera = threading.Thread(target=self._roll, args=(cut,), name="film", daemon=True)
        camera.start()
        try:
            yield
        finally:
            cut.set()
            camera.join()

    def _roll(self, cut: threading.Event) -> None:
        while not cut.wait(1 / FPS):
            picture = self._table.picture("side", *SIZE)
            if not self.frames or np.abs(picture.astype(int) - self.frames[-1]).mean() > MOVES:
                self.frames.append(picture)
