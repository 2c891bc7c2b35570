"""Videos of an episode, encoded while its pictures come in: as LeRobot does it, but no picture is ever dropped."""

import queue
import tempfile
import threading
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from lerobot.configs import RGBEncoderConfig
from lerobot.datasets.compute_stats import DEFAULT_QUANTILES, auto_downsample_height_width
from lerobot.datasets.video_utils import StreamingVideoEncoder
from numpy.typing import NDArray

from .decoded import Coded, Decoded, Handed

__all__ = ["VideoEncoder"]

AV1_ENCODER = "libsvtav1"  # FFmpeg's name


class VideoEncoder(StreamingVideoEncoder):
    """LeRobot's streaming encoder with threads that wait where its own drop a picture, and that take decoded ones."""

    _episode_active: bool

    def start_episode(self, video_keys: list[str], temp_dir: Path, depth_video_keys: list[str] | None = None) -> None:
        """Start a thread for each camera; raises ValueError for depth, which is never encoded here."""
        if depth_video_keys:
            raise ValueError(f"Expected colour cameras only, found depth: {', '.join(depth_video_keys)}.")
        self.cancel_episode()  # one that was left unfinished
        for key in video_keys:
            path = Path(tempfile.mkdtemp(dir=temp_dir)) / f"{key.replace('/', '_')}_streaming.mp4"
            film = _Film(path, self.fps, self._rgb_encoder, self.queue_maxsize, self._encoder_threads)
            self._threads[key], self._video_paths[key] = film, path
            self._frame_queues[key], self._result_queues[key] = film.pictures, film.outcome
            self._stop_events[key] = film.stopped
            film.start()
        self._episode_active = True

    def feed_frame(self, video_key: str, image: NDArray[Any]) -> None:
        """Hand a picture to its camera's thread and wait while that is busy; raises RuntimeError where it has ended."""
        film = self._threads[video_key]
        picture = image.picture if isinstance(image, Handed) else image
        while film.is_alive():
            try:
                self._frame_queues[video_key].put(picture, timeout=1)
            except queue.Full:
                continue
            return
        raise RuntimeError(f"The encoder of '{video_key}' stopped; is the disk full?")


class _Film(threading.Thread):
    """The video of one camera in one episode; its statistics, or an error, come out at the end as ``outcome``."""

    def __init__(self, path: Path, fps: float, settings: RGBEncoderConfig, waiting: int, threads: int | None) -> None:
        super().__init__(daemon=True)
        self.pictures: queue.Queue[Decoded | NDArray[Any] | None] = queue.Queue(maxsize=waiting)
        self.outcome: queue.Queue[tuple[str, Any]] = queue.Queue(maxsize=1)
        self.stopped = threading.Event()
        self._path, self._settings, self._threads = path, settings, threads
        self._rate = Fraction(fps).limit_denominator(1001)
        self._levels, self._measured, self._count = _Levels(), 0, 0

    def run(self) -> None:
        """Encode until the end of the episode, or until told to stop."""
        try:
            with av.open(str(self._path), "w") as container:
                self._encode(container)
            self.outcome.put(("ok", self._statistics()))
        except Exception as error:  # whatever happens here is passed on to who waits for the outcome
            self.outcome.put(("error", str(error)))

    def _encode(self, container: Any) -> None:
        stream = encoder = None
        while (picture := self._next()) is not None:
            if stream is None:
                options = self._settings.get_codec_options(self._threads, as_strings=True)
                stream = container.add_stream(self._settings.vcodec, self._rate, options=options)
                stream.time_base = 1 / self._rate
                self._set_up(stream.codec_context, picture)
                unused = [stream.codec_context]
            if coded := self._coded(picture):
                self._finish(container, stream, encoder)
                encoder = None
                self._put(container, stream, [_packet(coded, self._count)])
            else:
                encoder = encoder or (unused.pop() if unused else self._another(picture))
                frame = self._frame(picture)
                frame.pts, frame.time_base = self._count, 1 / self._rate
                self._put(container, stream, encoder.encode(frame))
            self._count += 1
            self._measure(picture)
        self._finish(container, stream, encoder)

    def _coded(self, picture: Decoded | NDArray[Any]) -> Coded | None:
        """Bytes of a picture that can stand in this film as they are."""
        if not isinstance(picture, Decoded) or self._settings.vcodec != AV1_ENCODER:
            return None
        return picture.coded if picture.frame.format.name == self._settings.pix_fmt else None

    def _set_up(self, encoder: Any, picture: Decoded | NDArray[Any]) -> None:
        """Size, format and colours of an encoder's pictures."""
        encoder.height, encoder.width = picture.size if isinstance(picture, Decoded) else picture.shape[:2]
        encoder.pix_fmt, encoder.time_base = self._settings.pix_fmt, 1 / self._rate
        if self._settings.vcodec in ("h264", "hevc"):
            encoder.max_b_frames = 0  # LeRobot cannot join a video of one picture that has a delay
        if isinstance(picture, Decoded):
            picture.colours.put(encoder, picture.frame.format.name)

    def _another(self, picture: Decoded | NDArray[Any]) -> Any:
        """An encoder for pictures behind copied ones; it begins with a key frame."""
        encoder = av.CodecContext.create(self._settings.vcodec, "w")
        encoder.options = self._settings.get_codec_options(self._threads, as_strings=True)
        encoder.framerate = self._rate
        self._set_up(encoder, picture)
        return encoder

    def _finish(self, container: Any, stream: Any, encoder: Any) -> None:
        """Write what an encoder, if there is one, still holds."""
        if encoder is not None:
            self._put(container, stream, encoder.encode())

    def _put(self, container: Any, stream: Any, packets: list[Any]) -> None:
        for packet in packets:
            packet.stream, packet.time_base = stream, 1 / self._rate
            container.mux(packet)

    def _next(self) -> Decoded | NDArray[Any] | None:
        while not self.stopped.is_set():
            try:
                return self.pictures.get(timeout=1)
            except queue.Empty:
                continue
        return None

    def _frame(self, picture: Decoded | NDArray[Any]) -> av.VideoFrame:
        if not isinstance(picture, Decoded):
            return av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
        frame = picture.frame.reformat(format=self._settings.pix_fmt)
        frame.pict_type = av.video.frame.PictureType.I if picture.key else av.video.frame.PictureType.NONE
        return frame

    def _measure(self, picture: Decoded | NDArray[Any]) -> None:
        if isinstance(picture, Decoded) and not picture.measured:
            return
        self._levels.add(picture.rgb() if isinstance(picture, Decoded) else picture)
        self._measured += 1

    def _statistics(self) -> dict[str, Any] | None:
        """LeRobot's statistics; the count is that of all pictures, so that episodes weigh by their length."""
        if not self._measured:
            return None
        stats = self._levels.statistics()
        return stats | {"count": stats["count"] * self._count // self._measured}


class _Levels:
    """Counts of the 256 levels of each colour, and LeRobot's statistics of them: exact where its own are estimates."""

    def __init__(self) -> None:
        self._counts = np.zeros((3, 256), np.int64)

    def add(self, picture: NDArray[np.uint8]) -> None:
        """Count a picture (H, W, 3), or what LeRobot looks at of a large one."""
        for number, colour in enumerate(auto_downsample_height_width(picture.transpose(2, 0, 1))):
            self._counts[number] += np.bincount(colour.ravel(), minlength=256)

    def statistics(self) -> dict[str, NDArray[Any]]:
        """LeRobot's statistics (3,) of what was counted, in levels."""
        levels, count = np.arange(256.0), self._counts[0].sum()
        shares, below = self._counts / count, self._counts.cumsum(axis=1)
        mean = shares @ levels
        found = [np.flatnonzero(counts) for counts in self._counts]
        ends = {
            "min": np.array([each[0] for each in found], float),
            "max": np.array([each[-1] for each in found], float),
        }
        quantiles = {
            f"q{int(q * 100):02d}": np.array([np.searchsorted(each, q * count) for each in below], float)
            for q in DEFAULT_QUANTILES
        }
        spread = np.sqrt(np.maximum(shares @ levels**2 - mean**2, 0.0))
        return {**ends, "mean": mean, "std": spread, "count": np.array([count]), **quantiles}


def _packet(coded: Coded, number: int) -> av.Packet:
    """The packet of a picture that is copied."""
    packet = av.Packet(coded.data)
    packet.pts = packet.dts = number
    packet.duration, packet.is_keyframe = 1, coded.key
    return packet
