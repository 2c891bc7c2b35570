"""Time for the arm and those beside it: the real clock, and the interface by which a test drives one of its own."""

import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Protocol

from lerobot.utils.robot_utils import precise_sleep

__all__ = ["REAL", "Clock", "RealClock"]


class Clock(Protocol):
    """Seconds, and all ways to let some pass; whoever lives by a clock waits by nothing else."""

    @property
    def now(self) -> float:
        """Seconds since some moment; they never go back."""
        ...

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        ...

    def wait(self, event: threading.Event, seconds: float) -> bool:
        """Let time pass until an event is set, at most so long; whether it is set."""
        ...

    def lock(self) -> AbstractContextManager[object]:
        """A re-entrant lock under which time may pass."""
        ...

    def thread(self, run: Callable[[], object], name: str) -> threading.Thread:
        """A daemon that lives by this clock; not started yet."""
        ...


class RealClock:
    """The clock of the machine."""

    @property
    def now(self) -> float:
        """Seconds since the machine started, or thereabouts."""
        return time.perf_counter()

    def sleep(self, seconds: float) -> None:
        """Let time pass; short spans precisely, also where the system's own sleep is coarse."""
        precise_sleep(seconds)

    def wait(self, event: threading.Event, seconds: float) -> bool:
        """Let time pass until an event is set, at most so long; whether it is set."""
        return event.wait(seconds)

    def lock(self) -> AbstractContextManager[object]:
        """A re-entrant lock."""
        return threading.RLock()

    def thread(self, run: Callable[[], object], name: str) -> threading.Thread:
        """A daemon; not started yet."""
        return threading.Thread(target=run, name=name, daemon=True)


REAL = RealClock()
