"""Pictures of the last episodes, kept small and few, for a person who wants to see one again."""

import threading
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

__all__ = ["Films", "Picture", "is_picture", "to_jpeg"]

Picture = NDArray[np.uint8]
FILM_WIDTH = 320  # pixels; a film is looked at beside the live cameras
LIVE_WIDTH = 960
MAX_GAP_S = 1.0  # a longer gap is a pause, which a film leaves out


def is_picture(value: object) -> bool:
    """Whether this is what a camera gives: uint8 [H, W, 3], not empty."""
    return isinstance(value, np.ndarray) and value.dtype == np.uint8 and value.ndim == 3 and (
        value.shape[2] == 3 and value.size > 0
    )  # fmt: skip


def to_jpeg(picture: Picture) -> bytes:
    """JPEG of an RGB picture uint8 [H, W, 3], at most LIVE_WIDTH pixels wide; milliseconds, so not for the loop."""
    import cv2

    height, width = picture.shape[:2]
    if width > LIVE_WIDTH:
        size = (LIVE_WIDTH, max(1, round(height * LIVE_WIDTH / width)))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    done, data = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 80])
    return data.tobytes() if done else b""


@dataclass
class _Film:
    """Pictures [h, w, 3] of each camera with their times in seconds since the film began."""

    period_s: float
    cameras: dict[str, list[tuple[float, Picture]]] = field(default_factory=dict)
    time_s: float = 0.0
    last: float | None = None
    due: float = 0.0
    size: int = 0

    def thin_out(self) -> None:
        """Leave out every other picture, and take half as many from now on."""
        self.cameras = {name: frames[::2] for name, frames in self.cameras.items()}
        self.size = sum(picture.nbytes for frames in self.cameras.values() for _, picture in frames)
        self.period_s *= 2


class Films:
    """Films of the episode that runs and of the `kept` before it; safe to use from several threads.

    A film has at most `hz` pictures a second, FILM_WIDTH pixels wide or little more, and at most `film_bytes` bytes:
    a long one gets fewer pictures a second.
    """

    def __init__(self, hz: float, kept: int, film_bytes: int = 64 * 2**20) -> None:
        self._period_s, self._kept, self._film_bytes = 1.0 / hz, kept, film_bytes
        self._films: dict[int, _Film] = {}
        self._running: int | None = None
        self._lock = threading.Lock()

    def begin(self, number: int) -> None:
        """A film begins; one of the same number is replaced."""
        with self._lock:
            self._films.pop(number, None)
            self._films[number] = _Film(self._period_s)
            self._running = number
            for old in list(self._films)[: max(0, len(self._films) - 1 - self._kept)]:
                del self._films[old]

    def end(self) -> None:
        """The film that runs is complete."""
        with self._lock:
            self._running = None

    def add(self, pictures: dict[str, Picture], now: float) -> None:
        """Keep these where it is time for the next ones. now: seconds on a clock that never goes back."""
        with self._lock:
            film = self._films.get(self._running) if self._running is not None else None
            if film is None or (film.last is not None and now < film.due):
                return
            if film.last is not None:
                film.time_s += now - film.last if now - film.last <= MAX_GAP_S + film.period_s else film.period_s
            on_time = film.last is not None and now - film.due < film.period_s
            film.due = (film.due if on_time else now) + film.period_s
            film.last = now
            for name, picture in pictures.items():
                step = max(1, picture.shape[1] // FILM_WIDTH)
                small = picture[::step, ::step].copy()
                film.cameras.setdefault(name, []).append((film.time_s, small))
                film.size += small.nbytes
            while film.size > self._film_bytes and any(len(frames) > 1 for frames in film.cameras.values()):
                film.thin_out()

    def cameras(self) -> dict[int, list[str]]:
        """Names of the cameras in each film, by number; films without pictures are left out."""
        with self._lock:
            return {number: sorted(film.cameras) for number, film in self._films.items() if film.cameras}

    def times(self, number: int, camera: str) -> list[float] | None:
        """Seconds since the film began of each picture; None where there is no such film."""
        frames = self._frames(number, camera)
        return None if frames is None else [round(time, 3) for time, _ in frames]

    def picture(self, number: int, camera: str, index: int) -> Picture | None:
        """One picture; None where there is none."""
        frames = self._frames(number, camera)
        return frames[index][1] if frames and 0 <= index < len(frames) else None

    def _frames(self, number: int, camera: str) -> list[tuple[float, Picture]] | None:
        with self._lock:
            film = self._films.get(number)
            frames = film.cameras.get(camera) if film else None
            return None if frames is None else list(frames)
