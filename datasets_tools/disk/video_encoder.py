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
from lerobot.datasets.compute_stats import RunningQuantileStats, auto_downsample_height_width
from lerobot.datasets.video_utils import StreamingVideoEncoder
from numpy.typing import NDArray

from .decoded import Decoded, Handed

__all__ = ["VideoEncoder"]


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
        self._stats, self._measured, self._count = RunningQuantileStats(), 0, 0

    def run(self) -> None:
        """Encode until the end of the episode, or until told to stop."""
        try:
            with av.open(str(self._path), "w") as container:
                self._encode(container)
            self.outcome.put(("ok", self._statistics()))
        except Exception as error:  # whatever happens here is passed on to who waits for the outcome
            self.outcome.put(("error", str(error)))

    def _encode(self, container: Any) -> None:
        stream = None
        while (picture := self._next()) is not None:
            frame = self._frame(picture)
            if stream is None:
                options = self._settings.get_codec_options(self._threads, as_strings=True)
                stream = container.add_stream(self._settings.vcodec, self._rate, options=options)
                stream.pix_fmt, stream.width, stream.height = self._settings.pix_fmt, frame.width, frame.height
                stream.time_base = 1 / self._rate
                if self._settings.vcodec in ("h264", "hevc"):
                    stream.codec_context.max_b_frames = 0  # LeRobot cannot join a video of one picture that has a delay
                if isinstance(picture, Decoded):
                    picture.colours.put(stream.codec_context, picture.frame.format.name)
            frame.pts, frame.time_base = self._count, 1 / self._rate
            container.mux(stream.encode(frame))
            self._count += 1
            self._measure(picture)
        if stream is not None:
            container.mux(stream.encode())

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
        image = picture.rgb() if isinstance(picture, Decoded) else picture
        small = auto_downsample_height_width(image.transpose(2, 0, 1))
        self._stats.update(small.transpose(1, 2, 0).reshape(-1, 3))
        self._measured += 1

    def _statistics(self) -> dict[str, Any] | None:
        """LeRobot's statistics; the count is that of all pictures, so that episodes weigh by their length."""
        if not self._measured:
            return None
        stats: dict[str, Any] = self._stats.get_statistics()
        return stats | {"count": stats["count"] * self._count // self._measured}
