"""A fixed control rate, and how well it is kept."""

from collections import deque

import numpy as np

from ..clock import REAL, Clock

__all__ = ["Pace"]


class Pace:
    """Waits for the ticks of a clock, and measures the intervals between them.

    Attributes:
        late: ticks that came more than a tenth of a period too late.
    """

    def __init__(self, fps: float, clock: Clock = REAL) -> None:
        self.period = 1.0 / fps
        self.late = 0
        self._clock = clock
        self._next = self._last = 0.0
        self._intervals: deque[float] = deque(maxlen=1000)

    def start(self) -> None:
        """Begin to count: the first tick comes a period from now. After a break, call it again."""
        self._last = self._clock.now
        self._next = self._last + self.period

    def wait(self) -> None:
        """Wait for the next tick; one that is missed by more than a period is left out, not caught up."""
        left = self._next - self._clock.now
        if left > 0:
            self._clock.sleep(left)
        now = self._clock.now
        self._intervals.append(now - self._last)
        self.late += now - self._next > 0.1 * self.period
        self._last = now
        self._next += self.period
        if self._next <= now:  # a step without time for the arm to move in would be recorded like any other
            self._next = now + self.period

    def statistics(self) -> dict[str, float]:
        """`rate_hz`, `jitter_ms` (standard deviation of the interval), `worst_ms` (longest), `late` (ticks).

        Of the last 1000 ticks; empty before there are two.
        """
        if len(self._intervals) < 2:
            return {}
        taken = np.array(self._intervals)
        return {
            "rate_hz": float(1 / taken.mean()), "jitter_ms": float(1000 * taken.std()),
            "worst_ms": float(1000 * taken.max()), "late": float(self.late),
        }  # fmt: skip
