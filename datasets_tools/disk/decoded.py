"""Pictures of a video as they were stored: cut, scaled and encoded again without a way through RGB, which costs colour.

Shapes: H, W pixels of a picture.
"""

import threading
from dataclasses import dataclass
from typing import Any

import av
import numpy as np
from av.video.reformatter import VideoReformatter
from numpy.typing import NDArray

from ..views.episode import Camera

__all__ = ["Coded", "Colours", "Decoded", "Handed"]

# Formats of 8 bits that can be cut plane by plane, and the one of each without halved colour planes.
PLANAR = {
    "yuv420p": "yuv444p", "yuv422p": "yuv444p", "yuv444p": "yuv444p",
    "yuvj420p": "yuvj444p", "yuvj422p": "yuvj444p", "yuvj444p": "yuvj444p",
}  # fmt: skip
LIMITED, FULL = 1, 2  # FFmpeg's numbers of the colour ranges


@dataclass(frozen=True)
class Colours:
    """Meaning of a video's numbers, as FFmpeg counts it: range, matrix, primaries and transfer; 0 or 2 where unsaid."""

    range: int
    matrix: int
    primaries: int
    transfer: int

    @classmethod
    def of(cls, context: Any) -> "Colours":
        """Those of a stream's codec context."""
        return cls(
            int(context.color_range), int(context.colorspace), int(context.color_primaries), int(context.color_trc)
        )

    def put(self, context: Any, form: str) -> None:
        """Make them those of a codec context before it opens, for pictures that come in the pixel format ``form``."""
        full = context.pix_fmt.startswith("yuvj")  # FFmpeg's old names for the full range
        changed = full != form.startswith("yuvj")
        context.color_range = (FULL if full else LIMITED) if changed else self.range
        context.colorspace, context.color_primaries, context.color_trc = self.matrix, self.primaries, self.transfer


@dataclass(frozen=True)
class Coded:
    """A picture's bytes in its file, complete behind those of the picture before it, or by themselves where ``key``."""

    data: bytes
    key: bool


@dataclass(frozen=True)
class Decoded:
    """One picture of a video.

    Attributes:
        frame: as the decoder gave it, or scaled.
        colours: what its numbers mean.
        key: it must not be predicted from the picture before it. An encoder skips what differs little from its
            prediction, so that slow motion stands still and then jumps; only a picture that was predicted from the same
            neighbour, in the same size and quality, keeps its motion when it is predicted again.
        measured: it counts in the statistics.
        coded: its bytes, where they may follow those of the picture that was handed on before it: they need not be
            encoded again.
    """

    frame: av.VideoFrame
    colours: Colours
    key: bool = True
    measured: bool = True
    coded: Coded | None = None

    @property
    def size(self) -> tuple[int, int]:
        """H and W."""
        return self.frame.height, self.frame.width

    def rgb(self) -> NDArray[np.uint8]:
        """(H, W, 3) uint8, as LeRobot decodes it."""
        return np.asarray(_SCALERS.colour.reformat(self.frame, format="rgb24").to_ndarray(), np.uint8)

    def shaped(self, camera: Camera) -> "Decoded":
        """Cut out and scaled in its own numbers; the area filter when shrinking, linear when growing."""
        if camera.crop is None and camera.size in (None, self.size):
            return self
        frame = self.frame if self.frame.format.name in PLANAR else self.frame.reformat(format="yuv444p")
        name, part = frame.format.name, frame if camera.crop is None else _cut(frame, *camera.crop)
        rows, columns = camera.size or (part.height, part.width)
        shrinks = rows <= part.height and columns <= part.width
        target = _SCALERS.size.reformat(part, columns, rows, name, interpolation="AREA" if shrinks else "BILINEAR")
        target.colorspace, target.color_range = frame.colorspace, frame.color_range
        return Decoded(target, self.colours, measured=self.measured)


class Handed(np.ndarray[Any, np.dtype[np.uint8]]):
    """(H, W, 3) zeros without memory of their own: LeRobot's writer checks them and hands them on to the encoder."""

    picture: Decoded

    @classmethod
    def of(cls, picture: Decoded) -> "Handed":
        """Zeros with a picture behind them, which the encoder takes."""
        handed = np.broadcast_to(np.uint8(0), (*picture.size, 3)).view(cls)
        handed.picture = picture
        return handed


def _cut(frame: av.VideoFrame, top: int, left: int, height: int, width: int) -> av.VideoFrame:
    """A part of a picture; where it begins between two colours, each pixel has one of its own."""
    halves = [_halves(frame, plane) for plane in frame.planes]
    if any(n % h or m % v for h, v in halves for n, m in ((left, top), (width, height))):
        frame = frame.reformat(format=PLANAR[frame.format.name])
    part = av.VideoFrame(width, height, frame.format.name)
    for source, made in zip(frame.planes, part.planes, strict=True):
        across, down = _halves(frame, source)
        _pixels(made)[:] = _pixels(source)[
            top // down : (top + height) // down, left // across : (left + width) // across
        ]
    part.colorspace, part.color_range = frame.colorspace, frame.color_range
    return part


class _Scalers(threading.local):
    """FFmpeg's scalers, one set a thread: each keeps what it made ready for pictures like the last one."""

    def __init__(self) -> None:
        self.size, self.colour = VideoReformatter(), VideoReformatter()


_SCALERS = _Scalers()


def _halves(frame: av.VideoFrame, plane: Any) -> tuple[int, int]:
    """How many pixels of the picture one of a plane stands for, across and down: 1 or 2."""
    return -(-frame.width // plane.width), -(-frame.height // plane.height)


def _pixels(plane: Any) -> NDArray[np.uint8]:
    """(rows, columns) a plane's memory without the padding of its lines."""
    lines: NDArray[np.uint8] = np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)
    return lines[:, : plane.width]
