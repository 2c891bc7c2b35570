"""All that the operator's page shows, put together as plain values: no web in it, and it never holds up the loop."""

import contextlib
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..clock import REAL, Clock
from .films import Films, Picture, is_picture, to_jpeg
from .session import IN_EPISODE, IN_MOTION, Label, Session, State

__all__ = ["Board"]

RECENT = 5  # episodes in the running mean of the learning curve, as in the paper's figures
MAX_LINES = 200
MAX_EPISODES = 2000  # on the curve; the page is sent all of them each time
MAX_LISTED = 100  # finished episodes
MAX_TEXT = 500  # characters of a line


@dataclass(frozen=True)
class _Phase:
    """Progress of a phase: units done of `total`, `before` of them when it began."""

    name: str
    total: float
    before: float
    began: float
    done: float
    note: str = ""


class Board:
    """Everything that the page shows; safe to use from several threads.

    The methods for the training thread copy what they are given and return at once; what they cannot show they leave
    out, without an error. Episodes have the session's numbers everywhere, also in the rows given to `log`.

    film_hz: pictures a second in an episode's film. kept_films: finished episodes whose film is kept.
    """

    def __init__(self, session: Session, *, film_hz: float = 5.0, kept_films: int = 5, clock: Clock = REAL) -> None:
        self.session = session
        self._films = Films(film_hz, kept_films)
        self._clock = clock
        self._lock = threading.Lock()
        self._pictures: dict[str, Picture] = {}
        self._shown: dict[str, float] = {}
        self._jpegs: dict[str, tuple[Picture, bytes]] = {}
        self._refused: set[str] = set()
        self._health: dict[str, float | str | None] = {}
        self._lines: deque[tuple[float, str]] = deque(maxlen=MAX_LINES)
        self._phase: _Phase | None = None
        self._rows: dict[int, dict[str, float | None]] = {}
        self._evaluations: deque[dict[str, float | None]] = deque(maxlen=MAX_EPISODES)
        self._learner: dict[str, float | None] = {}
        self._ended: dict[int, tuple[int | None, float | None]] = {}
        self._episode: tuple[int, float, float | None] | None = None  # number, began, seconds once it has ended
        self._began = clock.now
        # Written with the session's lock held, so without one of our own: each is replaced as a whole.
        self._since = (session.state, self._began)
        self._busy_since = (getattr(session, "busy", ""), self._began)
        self._listeners: tuple[Callable[[], None], ...] = ()
        self._before = session.on_change
        session.on_change = self._changed

    # --- For the training thread.

    def show(self, pictures: Mapping[str, NDArray[np.uint8]]) -> None:
        """The latest picture of each camera, RGB uint8 [H, W, 3]; kept for the episode's film, too, while it runs."""
        good: dict[str, Picture] = {}
        for name, picture in pictures.items():
            if is_picture(picture):
                good[str(name)] = picture.copy()
            elif str(name) not in self._refused:
                self._refused.add(str(name))
                found = f"{getattr(picture, 'dtype', type(picture).__name__)} {getattr(picture, 'shape', '')}".strip()
                self.message(f"Camera {name} is not shown: expected uint8 [H, W, 3], found {found}.")
        now = self._clock.now
        with self._lock:
            self._pictures.update(good)
            self._shown.update(dict.fromkeys(good, now))
        if self.session.state in IN_MOTION:
            self._films.add(good, now)

    def begin_episode(self, number: int) -> None:
        """An episode begins: its time runs, and a film of it is made."""
        with self._lock:
            self._episode = (int(number), self._clock.now, None)
        self._films.begin(int(number))

    def end_episode(self, number: int, steps: int, seconds: float) -> None:
        """An episode is over after so many control steps and seconds of movement."""
        self._films.end()
        count, length = _plain(steps), _plain(seconds)
        with self._lock:
            began = self._episode[1] if self._episode else self._clock.now
            self._episode = (int(number), began, length if isinstance(length, int | float) else None)
            self._ended.pop(int(number), None)  # the order is that of their ends
            self._ended[int(number)] = (
                int(count) if isinstance(count, int | float) else None,
                float(length) if isinstance(length, int | float) else None,
            )
            _keep_last(self._ended, MAX_EPISODES)

    def health(self, **values: float | str) -> None:
        """Note the robot's state by name; names that are not given stay as they are."""
        with self._lock:
            self._health |= {name: _plain(value) for name, value in values.items()}

    def phase(self, name: str, total: int, done: int) -> None:
        """A phase of `total` units begins, `done` of them already behind."""
        units = _number(done)
        with self._lock:
            self._phase = _Phase(str(name), _number(total), units, self._clock.now, units)

    def advance(self, done: int, note: str) -> None:
        """Progress within the phase."""
        with self._lock:
            if (was := self._phase) is not None:
                units = _number(done)
                self._phase = _Phase(was.name, was.total, was.before, was.began, units, str(note)[:MAX_TEXT])

    def message(self, text: str) -> None:
        """A line for the log."""
        with self._lock:
            self._lines.append((time.time(), str(text)[:MAX_TEXT]))

    def log(self, numbers: Mapping[str, float]) -> None:
        """A row of a table, as `{"<table>/<column>": value}`: episodes and evaluations go into the learning curve."""
        tables: dict[str, dict[str, float | None]] = {}
        for name, value in numbers.items():
            table, _, column = str(name).partition("/")
            plain = _plain(value)
            tables.setdefault(table, {})[column] = None if isinstance(plain, str) else plain
        with self._lock:
            if (row := tables.get("episodes")) and (number := row.get("episode")) is not None:
                self._rows[int(number)] = row
                _keep_last(self._rows, MAX_EPISODES)
            if row := tables.get("evaluations"):
                self._evaluations.append(row)
            for row in tables.values():
                known = ("updates", "env_steps", "loss", "mean_q", "demonstrations")
                self._learner |= {name: value for name, value in row.items() if name in known}

    # --- For whoever shows it.

    def listen(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Call this after each change of the session, from whichever thread changed it; returns how to end that.

        listener: quick; what it raises is ignored.
        """
        self._listeners = (*self._listeners, listener)

        def forget() -> None:
            self._listeners = tuple(other for other in self._listeners if other is not listener)

        return forget

    def jpeg(self, camera: str) -> bytes | None:
        """The latest picture of a camera as JPEG; None where there is none. Encoded once, however many look."""
        with self._lock:
            picture, known = self._pictures.get(camera), self._jpegs.get(camera)
        if picture is None:
            return None
        if known is not None and known[0] is picture:
            return known[1]
        data = to_jpeg(picture)
        with self._lock:
            self._jpegs[camera] = (picture, data)
        return data

    def film_times(self, episode: int, camera: str) -> list[float] | None:
        """Seconds since its beginning of each picture in an episode's film; None where there is no film."""
        return self._films.times(episode, camera)

    def film_jpeg(self, episode: int, camera: str, index: int) -> bytes | None:
        """One picture of an episode's film as JPEG; None where there is none."""
        picture = self._films.picture(episode, camera, index)
        return None if picture is None else to_jpeg(picture)

    def snapshot(self) -> dict[str, Any]:
        """Snapshot as plain JSON values, times in seconds; what is not a finite number is None."""
        session = self.session.snapshot()  # before our own lock: one is never asked for while the other is held
        films, now = self._films.cameras(), self._clock.now
        with self._lock:
            shown, health, phase = dict(self._shown), dict(self._health), self._phase
            lines, rows, evaluations = list(self._lines), dict(self._rows), list(self._evaluations)
            learner, ended, episode = dict(self._learner), dict(self._ended), self._episode
        return {
            "session": session,
            "timers": {
                "state_s": round(now - self._since[1], 2),
                "busy_s": round(now - self._busy_since[1], 2) if session.get("busy") else None,
                "episode_s": _episode_seconds(episode, session["state"], now),
                "run_s": round(now - self._began, 2),
            },
            "progress": _progress(phase, now),
            "learner": learner,
            "health": health,
            "curve": _curve(rows, evaluations, session["labels"]),
            "log": [{"time": round(when, 2), "text": text} for when, text in lines],
            "cameras": sorted(shown),
            "camera_age_s": {name: round(now - when, 2) for name, when in shown.items()},
            "finished": _finished(session, ended, films),
        }

    def _changed(self, session: Session) -> None:
        now, busy = self._clock.now, getattr(session, "busy", "")
        if session.state is not self._since[0]:
            self._since = (session.state, now)
        if busy != self._busy_since[0]:
            self._busy_since = (busy, now)
        with contextlib.suppress(Exception):  # the session must go on whatever a listener does
            self._before(session)
        for listener in self._listeners:
            with contextlib.suppress(Exception):
                listener()


def _plain(value: object) -> float | str | None:
    """A finite number, a text, or None for a number that is not finite."""
    if isinstance(value, bool | int | str):
        return value[:MAX_TEXT] if isinstance(value, str) else int(value) if abs(value) < 2**53 else None
    try:
        number = float(value)  # type: ignore[arg-type]
    except Exception:  # whatever it is, it must not hold up the loop
        return type(value).__name__
    return number if math.isfinite(number) else None


def _number(value: object) -> float:
    plain = _plain(value)
    return plain if isinstance(plain, int | float) else 0


def _keep_last(table: dict[int, Any], count: int) -> None:
    for number in list(table)[: max(0, len(table) - count)]:
        del table[number]


def _episode_seconds(episode: tuple[int, float, float | None] | None, state: str, now: float) -> float | None:
    if episode is None:
        return None
    _, began, seconds = episode
    if seconds is not None:
        return round(seconds, 2)
    return round(now - began, 2) if state in IN_EPISODE else None


def _progress(phase: _Phase | None, now: float) -> dict[str, Any] | None:
    if phase is None:
        return None
    elapsed, behind = now - phase.began, phase.done - phase.before
    left = phase.total - phase.done
    eta = left * elapsed / behind if behind > 0 and left >= 0 and elapsed > 0 else None
    return {
        "name": phase.name, "total": phase.total, "done": phase.done, "note": phase.note,
        "elapsed_s": round(elapsed, 2), "eta_s": None if eta is None else round(eta, 1),
    }  # fmt: skip


def _curve(
    rows: Mapping[int, Mapping[str, float | None]],
    evaluations: list[dict[str, float | None]],
    labels: Mapping[str, str],
) -> dict[str, Any]:
    """Episodes as [number, success, mean of the last RECENT]; a label beats the row, discarded ones are out."""
    judged: dict[int, bool] = {}
    for number in sorted({*rows, *(int(name) for name in labels)}):
        label = labels.get(str(number))
        if number >= 0 and label != Label.DISCARD:  # evaluations have numbers below 0, and rows of their own
            judged[number] = label == Label.SUCCESS if label else bool(rows[number].get("success"))
    recent: deque[bool] = deque(maxlen=RECENT)
    points = []
    for number, success in judged.items():
        recent.append(success)
        points.append([number, int(success), round(sum(recent) / len(recent), 4)])
    names = ("episodes", "success_rate", "ci_low", "ci_high", "n")
    return {
        "recent": RECENT,
        "episodes": points[-MAX_EPISODES:],
        "evaluations": [{name: row.get(name) for name in names} for row in evaluations],
    }


def _finished(
    session: Mapping[str, Any],
    ended: Mapping[int, tuple[int | None, float | None]],
    films: Mapping[int, list[str]],
) -> list[dict[str, Any]]:
    """Episodes in the order of their ends; evaluations have negative numbers. The last may still lack its label."""
    labels = session["labels"]
    numbers = list(dict.fromkeys([*ended, *(int(name) for name in labels)]))
    if session["state"] == State.LABELLING and session["episode"] not in numbers:
        numbers.append(session["episode"])
    return [
        {
            "episode": number, "label": labels.get(str(number)), "steps": ended.get(number, (None, None))[0],
            "seconds": ended.get(number, (None, None))[1], "film": number in films, "cameras": films.get(number, []),
            "evaluation": number < 0,
        }
        for number in numbers[-MAX_LISTED:]
    ]  # fmt: skip
