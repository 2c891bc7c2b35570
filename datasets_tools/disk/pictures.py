"""Pictures from video files, one after the other; each file is decoded once. Single pictures, cut out and scaled."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import DataError

from ..views.episode import Camera
from .decoded import Coded, Colours, Decoded

__all__ = ["picture_size", "shaped", "video_pictures"]

AV1_DECODERS = ("libdav1d", "av1", "libaom-av1")  # FFmpeg's names
SEQUENCE_HEADER, TEMPORAL_DELIMITER = 1, 2  # AV1 bitstream specification, 6.2.2

type Picture = NDArray[np.uint8]


def picture_size(feature: dict[str, Any]) -> tuple[int, int]:
    """Height and width of a camera's pictures, whichever axis its channels are."""
    shape, names = feature["shape"], feature.get("names")
    channels_first = names[0] in ("channels", "channel") if isinstance(names, list) else shape[0] in (1, 3)
    height, width = shape[1:] if channels_first else shape[:2]
    return int(height), int(width)


def video_pictures(
    path: Path, times: NDArray[np.float64], fps: float, episode: int, frames: NDArray[np.int64]
) -> Iterator[Decoded]:
    """Yield the pictures nearest to ascending ``times`` from front to back, without going back in the file.

    Args:
        path: video file.
        times: (K,) seconds in the file, not descending.
        fps: frames a second; a picture half a period away or more is another one.
        episode: for error messages.
        frames: (K,) numbers of the frames in the episode, for error messages.

    Yields:
        pictures; ``key`` where it is a key frame, or the one before it in the file is not the one yielded before it.

    Raises:
        DataError: the file cannot be opened, or a frame is damaged or not there.
    """
    position = 0
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            if stream.time_base is None:
                raise ValueError("the video has no time base")
            container.seek(max(0, int((times[0] - 0.5 / fps) / stream.time_base)), stream=stream)
            colours, follows, joined = Colours.of(stream.codec_context), False, False
            for frame, coded in _with_bytes(container, stream):
                if frame.time is None or frame.time < times[position] - 0.5 / fps:
                    follows = joined = False
                    continue
                before, joins = position, coded is not None and (coded.key or joined)
                while position < len(times) and abs(frame.time - times[position]) < 0.5 / fps:
                    first, position = position == before, position + 1
                    key = bool(frame.key_frame) or not follows
                    yield Decoded(frame, colours, key=key, coded=coded if joins and first else None)
                follows, joined = position > before, joins and position == before + 1
                if position == len(times):
                    return
                if frame.time > times[position] + 0.5 / fps:
                    break
        reason = f"no picture at {times[position]:.3f} s"
    except (av.error.FFmpegError, OSError, ValueError, IndexError) as error:
        reason = " ".join(str(error).split())[:160]
    raise DataError(f"Video {path} cannot be read at episode {episode}, frame {int(frames[position])}: {reason}")


def _with_bytes(container: Any, stream: Any) -> Iterator[tuple[Any, Coded | None]]:
    """Decoded pictures with their bytes in the file, which are kept of AV1: there one packet is one picture."""
    if stream.codec_context.name not in AV1_DECODERS:
        yield from ((frame, None) for frame in container.decode(stream))
        return
    coded: dict[int | None, Coded | None] = {}
    for packet in container.demux(stream):
        if packet.size:
            data = bytes(packet)
            # A sequence header in front makes a key frame independent of what the file says of itself.
            whole = not packet.is_keyframe or _kind(data) == SEQUENCE_HEADER
            coded[packet.pts] = Coded(data, packet.is_keyframe) if whole else None
        for frame in packet.decode():
            yield frame, coded.pop(frame.pts, None)


def _kind(data: bytes) -> int:
    """Type of the first unit (OBU) of an AV1 packet, behind a temporal delimiter (AV1 bitstream specification, 5.3)."""
    start = 2 if (data[0] >> 3 & 15) == TEMPORAL_DELIMITER else 0
    return data[start] >> 3 & 15


def shaped(picture: Picture, camera: Camera) -> Picture:
    """Cut out and scale; the area filter when shrinking, linear when growing.

    Args:
        picture: (H, W, 3).
        camera: cut and size.
    """
    if camera.crop is not None:
        top, left, height, width = camera.crop
        picture = picture[top : top + height, left : left + width]
    if camera.size is None or camera.size == picture.shape[:2]:
        return np.ascontiguousarray(picture)
    height, width = camera.size
    shrinks = height <= picture.shape[0] and width <= picture.shape[1]
    scaled = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return np.asarray(scaled, dtype=np.uint8)
