"""Time that a test drives: it passes where the test, or a thread that lives by it, sleeps or waits, and nowhere else.

Of the threads made by it and the one that sleeps on it first, a single one runs at a time: it hands on when it sleeps,
waits, or ends. Next is who has waited longest for an event that is set, or else who is due first, and time jumps there.
So whatever threads do together happens in the same order every time, on a busy machine as on an idle one.
"""

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from types import TracebackType

from cqn_train.clock import Clock


def until(clock: Clock, ready: Callable[[], object], seconds: float = 10.0) -> None:
    """Let time pass until something is so; fails where it does not become so."""
    end = clock.now + seconds
    while not ready():
        assert clock.now < end, "it did not happen"
        clock.sleep(0.002)


@dataclass(eq=False)
class _Waiting:
    """A thread that stands still until it is due, or its event is set."""

    due: float
    event: threading.Event | None = None
    turn: threading.Event = field(default_factory=threading.Event)
    for_ever: bool = False


class DrivenClock:
    """A `cqn_train.clock.Clock`; a test of one thread may also set `now`."""

    def __init__(self, now: float = 100.0) -> None:
        self.now = now
        self._waiting: list[_Waiting] = []

    def sleep(self, seconds: float) -> None:
        """Let time pass, and others run."""
        assert seconds >= 0
        self._stand_still(_Waiting(self.now + seconds))

    def wait(self, event: threading.Event, seconds: float) -> bool:
        """Let time pass until an event is set, at most so long; whether it is set."""
        if not event.is_set():
            self._stand_still(_Waiting(self.now + seconds, event))
        return event.is_set()

    def lock(self) -> "_Lock":
        """A re-entrant lock under which time may pass."""
        return _Lock(self)

    def thread(self, run: Callable[[], object], name: str) -> threading.Thread:
        """A thread whose turn comes when another one hands on."""
        return _Thread(self, run, name)

    def _stand_still(self, me: _Waiting) -> None:
        self._waiting.append(me)
        self._hand_on()
        me.turn.wait()
        assert not me.for_ever, "every thread waits for another one"

    def _hand_on(self) -> None:
        called = [one for one in self._waiting if one.event is not None and one.event.is_set()]
        one = called[0] if called else min(self._waiting, key=lambda one: one.due)
        one.for_ever = not called and math.isinf(one.due)
        if not called and not one.for_ever:
            self.now = max(self.now, one.due)
        self._waiting.remove(one)
        one.turn.set()


class _Lock:
    """Re-entrant; whoever waits for it lets the others run."""

    def __init__(self, clock: DrivenClock) -> None:
        self._clock, self._owner, self._depth = clock, 0, 0
        self._free = threading.Event()
        self._free.set()

    def __enter__(self) -> None:
        me = threading.get_ident()
        while self._owner not in (0, me):
            self._clock.wait(self._free, math.inf)
        self._free.clear()
        self._owner, self._depth = me, self._depth + 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._depth -= 1
        if not self._depth:
            self._owner = 0
            self._free.set()


class _Thread(threading.Thread):
    """Runs in its turns only."""

    def __init__(self, clock: DrivenClock, run: Callable[[], object], name: str) -> None:
        super().__init__(name=name, daemon=True)
        self._clock, self._work = clock, run
        self._first, self._over = _Waiting(0.0), threading.Event()

    def start(self) -> None:
        self._first.due = self._clock.now
        self._clock._waiting.append(self._first)
        super().start()

    def run(self) -> None:
        self._first.turn.wait()
        try:
            self._work()
        finally:
            self._over.set()
            self._clock._hand_on()

    def join(self, timeout: float | None = None) -> None:
        self._clock.wait(self._over, math.inf if timeout is None else timeout)

    def is_alive(self) -> bool:
        return super().is_alive() and not self._over.is_set()
