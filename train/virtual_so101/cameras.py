"""Cameras over the table, served as LeRobot's own image server serves them: `--robot.cameras` of type zmq."""

import contextlib
import json
import threading
import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import ConfigError

from ..envs.simulator import needed
from .table import Table

__all__ = ["CameraServer"]


class CameraServer:
    """Publishes pictures of a table on this machine while it is entered, at a rate of the real clock.

    Message: JSON with `timestamps` and `images`, by camera, JPEG in base64, as `lerobot.cameras.zmq` reads it.
    """

    def __init__(self, table: Table, cameras: Sequence[str], port: int, size: tuple[int, int], fps: float) -> None:
        """Say what is served.

        cameras: of the table; port: 1 to 65535; size: height and width, pixels; fps: messages a second.

        Raises:
            ConfigError: pyzmq is missing.
        """
        with needed("Cameras of the virtual SO-101 need pyzmq", "virtual"):
            import zmq
        self._zmq, self._table, self._names, self._size = zmq, table, tuple(cameras), size
        self._port, self._period = port, 1.0 / fps
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="camera-server", daemon=True)

    def __enter__(self) -> Self:
        """Raises ConfigError where the port is taken."""
        self._context = self._zmq.Context()
        self._socket = self._context.socket(self._zmq.PUB)
        self._socket.setsockopt(self._zmq.SNDHWM, 2)  # who does not keep up gets the newest
        self._socket.setsockopt(self._zmq.LINGER, 0)
        try:
            self._socket.bind(f"tcp://127.0.0.1:{self._port}")
        except self._zmq.ZMQError as error:
            self._close()
            raise ConfigError(f"Port {self._port} is taken: give another for the cameras.") from error
        for name in self._names:
            self._table.picture(name, *self._size)  # the first ones take long, in which no motor would answer
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._closing.set()
        self._thread.join()
        self._close()

    def _close(self) -> None:
        self._socket.close()
        self._context.term()

    def _run(self) -> None:
        due = time.monotonic()
        while not self._closing.wait(max(due - time.monotonic(), 0.0)):
            due = max(due + self._period, time.monotonic())
            pictures = {name: self._table.picture(name, *self._size) for name in self._names}
            with contextlib.suppress(self._zmq.Again):
                self._socket.send_string(_message(pictures), self._zmq.NOBLOCK)


def _message(pictures: Mapping[str, NDArray[np.uint8]]) -> str:
    from lerobot.cameras.zmq.image_server import encode_image

    now = time.time()
    return json.dumps(
        {"timestamps": dict.fromkeys(pictures, now), "images": {name: encode_image(p) for name, p in pictures.items()}}
    )
