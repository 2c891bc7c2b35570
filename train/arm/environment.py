"""Episodes on a real arm with a person: what the session says becomes steps of the loop."""

import contextlib
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from ..clock import REAL, Clock
from ..interfaces import Frame, Interrupted, Label, Outcome
from ..operator.session import IN_MOTION, Event, RefusedError, Session, State
from ..robot.arm import Arm
from ..robot.guard import HeldError, StoppedError
from ..robot.pace import Pace
from ..robot.readings import Reading, RobotFault
from .attendant import Attendant, Shown

__all__ = ["ArmEnvironment", "Display"]

LOOK_S = 0.05  # how often a waiting thread looks whether it should stop


class Display(Shown, Protocol):
    """Display of an arm's run for its person."""

    def health(self, **values: float | str) -> None:
        """Numbers and words on the robot's health."""
        ...

    def begin_episode(self, number: int) -> None:
        """An episode begins."""
        ...

    def end_episode(self, number: int, steps: int, seconds: float) -> None:
        """The episode is over."""
        ...


class ArmEnvironment:
    """The `Environment` of an arm: success and failure are what the person says.

    Only this class drives the arm, and only while the session is RUNNING or TEACHING; in between an attendant in a
    thread of its own holds it, brings it home, shows its cameras, and takes it up again after a fault.

    A step that a pause or a fault came into counts as skipped: its frame is read anew when things go on. When time is
    up, success and a discarded episode are what the person says, and failure means: not yet.
    """

    def __init__(
        self,
        arm: Arm,
        session: Session,
        display: Display,
        should_stop: Callable[[], bool] = lambda: False,
        clock: Clock = REAL,
    ) -> None:
        self.arm, self.session, self.display, self._clock = arm, session, display, clock
        self._should_stop = should_stop
        self._attendant = Attendant(arm, session, display, clock, should_stop)
        self._pace = Pace(arm.fps, clock)
        self._steps, self._began = 0, 0.0
        self._frame: Frame = {}
        self._pictures: Mapping[str, NDArray[np.uint8]] = {}
        self._waited_s = 0.0
        session.learning("starting")

    def open(self) -> None:
        """Connect; the arm is held from now on. Raises RobotFault when it does not answer."""
        self.arm.connect()
        self._look()
        self._attendant.start()

    @property
    def max_steps(self) -> int:
        """Control steps before an episode is cut off."""
        return max(1, round(self.arm.settings.episode_s * self.arm.fps))

    @property
    def fps(self) -> int:
        """Control steps a second."""
        return self.arm.fps

    @property
    def waited_s(self) -> float:
        """Seconds so far in which a person was waited for: starts, pauses, labels, repairs."""
        return self._waited_s

    def reset(self, seed: int) -> Frame:
        """Wait for the person's start, then read the arm. Raises Interrupted after a stop."""
        del seed  # a person lays out the scene
        before = self._episode()
        self.session.learning("")
        # An episode may be over, or paused, before this thread has seen that it began.
        self._wait(lambda: self.session.state in IN_MOTION or self._episode() != before)
        self.arm.let_go()
        self._steps, self._began = 0, self._clock.now
        self.display.begin_episode(self.session.episode)
        try:
            self.arm.guard.engage()  # where it was let go to be moved by hand
            self._look()
        except RobotFault as error:  # the episode ends with the first step, which does not happen
            self._attendant.fault(error)
        self._pace.start()
        return self._frame

    def step(self, action: torch.Tensor) -> Outcome:
        """Send the goal [1, D], or the leader's while a person drives, and read the arm one period later."""
        teaching, breaks = self.session.state is State.TEACHING, self.session.breaks
        try:
            if not teaching:
                self.arm.let_go()
            wanted = self.arm.follow() if teaching else action[0].double().cpu().numpy()
            sent = self.arm.guard.send(wanted, lambda: self.session.state in IN_MOTION)
            self._pace.wait()
            frame = self._look()
        except (HeldError, StoppedError):
            return self._break()
        except RobotFault as error:
            self._attendant.fault(error)
            return self._break()
        if self.session.breaks != breaks:  # paused meanwhile, even if it is driven again
            return self._break()
        self._steps += 1
        goal = torch.from_numpy(sent)[None]
        timed_out = self._steps >= self.max_steps and self._label() is None
        if timed_out:
            self._time_up()
        label = self._label()
        if label is None:
            return Outcome(
                frame=frame, reward=0.0, terminated=False, truncated=False, success=False, sent=goal, taught=teaching
            )
        return self._ended(frame, label, out_of_time=timed_out, sent=goal, taught=teaching)

    def render(self) -> NDArray[Any]:
        """The cameras beside one another, uint8 [H, W, 3]."""
        pictures = list(self._pictures.values())
        if not pictures:
            return np.zeros((2, 2, 3), np.uint8)
        height = min(picture.shape[0] for picture in pictures)
        return np.concatenate([picture[:height] for picture in pictures], axis=1)

    def close(self) -> None:
        """Leave the arm as configured, and disconnect."""
        self._attendant.close()
        self.arm.close()

    # -- what a person or a fault does to an episode ------------------------------------------------------------

    def _look(self) -> Frame:
        reading: Reading = self.arm.guard.read()
        self._pictures = reading.pictures
        self._frame = self.arm.frame(reading)
        self.display.show(reading.pictures)
        self.display.health(**self._pace.statistics(), limited=self._limited() or "no goal")
        return self._frame

    def summary(self) -> str:
        """Rate that was kept, and counts of goals that a limit changed, in one line; "" before anything moved."""
        kept = self._pace.statistics()
        if not kept:
            return ""
        return (
            f"Control: {kept['rate_hz']:.1f} Hz of {self.fps}, jitter {kept['jitter_ms']:.1f} ms, longest period "
            f"{kept['worst_ms']:.0f} ms, {kept['late']:.0f} ticks late. Limits changed goals: "
            f"{self._limited() or 'never'}."
        )

    def _limited(self) -> str:
        """Counts of goals that each limit changed; "" where none did."""
        return ", ".join(f"{name} {count}" for name, count in self.arm.guard.interventions.items())

    def _label(self) -> Label | None:
        """Label that the person gave the present episode; None so far."""
        return self.session.labels.get(self.session.episode)

    def _episode(self) -> tuple[int, bool]:
        """Number of the present or last episode, and whether it has its label."""
        number = self.session.episode
        return number, number in self.session.labels

    def _break(self) -> Outcome:
        """After a pause or a fault: the episode goes on with a new frame, or it has ended with the step before."""
        while True:
            self._wait(lambda: self.session.state in IN_MOTION or self._label() is not None)
            label = self._label()
            if label is not None:
                return self._ended(self._frame, label, out_of_time=False, skipped=True)
            self.arm.let_go()
            try:
                frame = self._look()
            except RobotFault as error:
                self._attendant.fault(error)
                continue
            self._pace.start()
            return Outcome(frame=frame, reward=0.0, terminated=False, truncated=False, success=False, skipped=True)

    def _ended(self, frame: Frame, label: Label, *, out_of_time: bool, **more: Any) -> Outcome:
        self.display.end_episode(self.session.episode, self._steps, self._clock.now - self._began)
        success, discarded = label is Label.SUCCESS, label is Label.DISCARD
        # A person's "failure" ends the task; out of time, the value of what was reached still counts.
        terminated = success or (label is Label.FAILURE and not out_of_time)
        if self.arm.settings.go_home and self.arm.home is not None:
            self._attendant.go_home()
        return Outcome(
            frame=frame,
            reward=float(success),
            terminated=terminated,
            truncated=not terminated,
            success=success,
            discarded=discarded,
            **more,
        )

    def _time_up(self) -> None:
        while self._label() is None:
            with contextlib.suppress(RefusedError):  # paused, labelled or stopped at this very moment
                self.session.apply(Event.TIME_UP)
            self._wait(lambda: self._label() is not None or self.session.state in IN_MOTION)

    def _wait(self, ready: Callable[[], bool]) -> None:
        """Wait until something is so. Raises Interrupted after a stop of the person or of the process."""
        began, changed = self._clock.now, self._attendant.changed
        try:
            while True:
                changed.clear()  # before looking: what changes from now on is seen at once
                if ready():
                    return
                if self._should_stop() or self.session.state is State.STOPPED:
                    raise Interrupted
                self._clock.wait(changed, LOOK_S)
        finally:
            self._waited_s += self._clock.now - began
