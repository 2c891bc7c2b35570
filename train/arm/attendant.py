"""Attendant of the arm while no episode drives it: a thread that holds, shows, brings home, recovers."""

import contextlib
import threading
from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..clock import REAL, Clock
from ..operator.session import IN_MOTION, Event, RefusedError, Session, State
from ..robot.arm import Arm
from ..robot.guard import HeldError, StoppedError
from ..robot.readings import RobotFault

__all__ = ["Attendant", "Shown"]

BETWEEN = (State.WAITING, State.RESETTING)
LOOK_HZ = 10.0
RETRY_S = 0.5


class Shown(Protocol):
    """What the attendant lets a person see."""

    def show(self, pictures: Mapping[str, NDArray[np.uint8]]) -> None:
        """Pictures [H, W, 3] of the cameras."""
        ...

    def message(self, text: str) -> None:
        """A line that stays."""
        ...


class Attendant:
    """Follows the session in a thread of its own; every change reaches it at once.

    Attributes:
        changed: set whenever the session has changed, for the one who waits for it and clears it.
    """

    def __init__(
        self,
        arm: Arm,
        session: Session,
        display: Shown,
        clock: Clock = REAL,
        should_stop: Callable[[], bool] = lambda: False,
    ) -> None:
        """Nothing runs yet. should_stop: whether the process is to end, which stops the session as a person would."""
        self.arm, self.session, self._display, self._clock = arm, session, display, clock
        self._should_stop = should_stop
        self.changed = threading.Event()
        self._wake = threading.Event()
        self._closing = threading.Event()
        self._homeward = False
        self._before = session.state
        self._thread = clock.thread(self._run, "attendant")
        self._tell = session.on_change
        session.on_change = self._on_change

    def start(self) -> None:
        """Begin; the arm must be connected."""
        self._thread.start()

    def close(self) -> None:
        """End, and leave the arm as it is."""
        self._closing.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(5.0)
        self.session.on_change = self._tell

    def go_home(self) -> None:
        """Bring the arm home as soon as it may move between episodes."""
        self._homeward = True
        self._wake.set()

    def fault(self, error: RobotFault) -> None:
        """Tell the session of a fault; from then on this thread tries to take the arm up again."""
        if self.arm.guard.released:  # it cannot be held, so it is still in somebody's hand
            self.session.note_free()
        with contextlib.suppress(RefusedError):  # stopped already
            self.session.apply(Event.FAULT, str(error))

    def _on_change(self, session: Session) -> None:
        if session.state is State.STOPPED:
            self.arm.guard.refuse()  # at once, whatever the attendant is at
        if session.state in (*IN_MOTION, State.FAULTED):
            self._homeward = False  # after a fault the arm does not set off by itself while it is looked after
        self._wake.set()
        self.changed.set()
        self._tell(session)

    def _run(self) -> None:
        self._before = self.session.state
        while not self._closing.is_set():
            self._clock.wait(self._wake, 1 / LOOK_HZ)
            self._wake.clear()
            self.turn()

    def turn(self) -> None:
        """One look at the session, and what it asks for; raises nothing."""
        if self._should_stop() and self.session.state is not State.STOPPED:
            self.session.apply(Event.STOP)  # also while the loop evaluates, learns or saves
        state = self.session.state
        try:
            self._attend(state, self._before)
        except (HeldError, StoppedError):  # somebody else has taken over
            pass
        except RobotFault as error:
            self.fault(error)
        except Exception as error:  # without this thread nobody would hold the arm
            self.fault(RobotFault(f"Looking after the arm failed: {error!r}"))
        self._before = state

    def _attend(self, state: State, before: State) -> None:
        guard = self.arm.guard
        if state is State.STOPPED:
            guard.stop()
        elif state in IN_MOTION:
            return
        elif state is State.FAULTED:
            if self.session.free and not guard.released:
                guard.release()
            self._recover()
            return
        elif before in IN_MOTION or (state is State.PAUSED and before is not state):
            guard.hold()
        if self.session.free != guard.released and state is not State.STOPPED:
            guard.release() if self.session.free else guard.engage()
        if self.session.take_home():
            self._homeward = self.arm.home is not None
        if state in BETWEEN and self._homeward:
            self._bring_home()
        elif state is not State.STOPPED:
            self._display.show(guard.read().pictures)

    def _bring_home(self) -> None:
        """Steps towards home at the control rate, until it is there or something else comes up."""
        self.session.note_homing(True)
        try:
            self.arm.set_off()
            while self._homeward and self._may_go_home() and not self._closing.is_set():
                self._display.show(self.arm.guard.read().pictures)
                self._homeward = not self.arm.step_home(self._may_go_home)
                if not self._homeward and (short := self.arm.short_of_home()):
                    self._display.message(short)
                self._clock.sleep(1 / self.arm.fps)
            self._homeward = False
            if self.session.state in BETWEEN:
                self.arm.guard.hold()
        finally:
            self.session.note_homing(False)

    def _may_go_home(self) -> bool:
        session = self.session
        return session.state in BETWEEN and session.homing and not session.free and not self._should_stop()

    def _recover(self) -> None:
        try:
            self.arm.guard.recover()
        except RobotFault as error:
            if self.session.fault != str(error):
                self.fault(error)
            self._clock.wait(self._closing, RETRY_S)
            return
        with contextlib.suppress(RefusedError):  # stopped meanwhile
            self.session.apply(Event.RECOVERED)
