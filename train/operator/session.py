"""The session of a person at an arm, as a state machine: no web, no robot, no time in it.

An episode runs from `start` to `success`, `failure` or `discard`, by a person's hand; in between it may be paused, or
driven by the person (`take_over`). When its time is up it waits for its label. Then the person resets the scene, and
the next one may start; meanwhile the arm goes home when asked to, until it is there or paused on its way, or lets
itself be moved by hand (`free`). A fault
leads to FAULTED from everywhere, `stop` to STOPPED, which nothing leaves.
"""

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from lerobot_cqn.errors import CQNError

from ..interfaces import Label

__all__ = ["IN_MOTION", "TRANSITIONS", "Event", "Label", "RefusedError", "Session", "State"]


class State(StrEnum):
    """States of a session."""

    WAITING = "waiting"  # the arm holds, the scene is ready
    RUNNING = "running"  # the policy drives
    PAUSED = "paused"  # the arm holds in the middle of an episode; nothing is recorded
    TEACHING = "teaching"  # a person drives with the leader; recorded as a demonstration
    LABELLING = "labelling"  # the episode is over and nobody has said how it went
    RESETTING = "resetting"  # between episodes: the person sets up the scene, the policy learns
    FAULTED = "faulted"  # the robot cannot be trusted
    STOPPED = "stopped"  # for good


class Event(StrEnum):
    """Events of a session: by a person's hand, and by themselves."""

    START = "start"
    PAUSE = "pause"
    RESUME = "resume"
    SUCCESS = "success"
    FAILURE = "failure"
    DISCARD = "discard"
    TAKE_OVER = "take_over"
    HAND_BACK = "hand_back"
    READY = "ready"
    HOME = "home"
    FREE = "free"
    STOP = "stop"
    TIME_UP = "time_up"
    ABSENT = "absent"
    FAULT = "fault"
    RECOVERED = "recovered"


LABELS: Mapping[Event, Label] = {
    Event.SUCCESS: Label.SUCCESS, Event.FAILURE: Label.FAILURE, Event.DISCARD: Label.DISCARD,
}  # fmt: skip
BY_ITSELF = frozenset({Event.TIME_UP, Event.ABSENT, Event.FAULT, Event.RECOVERED})
# Nobody who does this, or to whom it happens, means that the arm shall hold itself from now on.
KEEPS_FREE = frozenset({Event.READY, Event.FAULT, Event.RECOVERED, *LABELS})
IN_MOTION = frozenset({State.RUNNING, State.TEACHING})  # policy or person drives the arm
IN_EPISODE = IN_MOTION | {State.PAUSED, State.LABELLING}

_ENDS = dict.fromkeys(LABELS, State.RESETTING)
_ALWAYS = {Event.STOP: State.STOPPED, Event.FAULT: State.FAULTED}
TRANSITIONS: Mapping[State, Mapping[Event, State]] = {
    State.WAITING: {
        **_ALWAYS, Event.START: State.RUNNING, Event.HOME: State.WAITING, Event.FREE: State.WAITING,
        Event.PAUSE: State.WAITING, Event.ABSENT: State.WAITING,
    },
    State.RUNNING: {
        **_ALWAYS, **_ENDS, Event.PAUSE: State.PAUSED, Event.ABSENT: State.PAUSED,
        Event.TAKE_OVER: State.TEACHING, Event.TIME_UP: State.LABELLING,
    },
    State.PAUSED: {**_ALWAYS, **_ENDS, Event.RESUME: State.RUNNING, Event.TAKE_OVER: State.TEACHING},
    State.TEACHING: {
        **_ALWAYS, **_ENDS, Event.HAND_BACK: State.RUNNING, Event.PAUSE: State.PAUSED, Event.ABSENT: State.PAUSED,
        Event.TIME_UP: State.LABELLING,
    },
    State.LABELLING: {**_ALWAYS, **_ENDS},
    State.RESETTING: {
        **_ALWAYS, Event.READY: State.WAITING, Event.HOME: State.RESETTING, Event.FREE: State.RESETTING,
        Event.PAUSE: State.RESETTING, Event.ABSENT: State.RESETTING,
    },
    # What was going on is over; where an episode was, a person says how it went (see `Session.apply`).
    State.FAULTED: {**_ALWAYS, Event.RECOVERED: State.RESETTING, Event.FREE: State.FAULTED},
    State.STOPPED: {Event.STOP: State.STOPPED},
}  # fmt: skip


class RefusedError(CQNError, ValueError):
    """An event that has no place in the present state; nothing has changed."""


@dataclass
class Session:
    """State, episodes and their labels; safe to use from several threads.

    Attributes:
        state: what is going on.
        episode: number of the episode that runs or ran last, from 0; evaluations count down from -1.
        evaluating: whether the next episode is an evaluation, which the policy must do alone.
        labels: of the finished episodes, by number.
        fault: what the robot said last, "" while all is well.
        busy: what the learner is at, "" while it is ready; no episode starts meanwhile. The end of an episode sets it.
        breaks: how often an episode was paused or broken off by a fault, in all.
        homing: whether the arm is on its way home.
        leader: whether there is a leader arm to take over with; can_free: whether the arm can be moved by hand.
        free: whether it is to be moved by hand now; a fault, READY or a label do not end that, all else does.
        on_change: called after each change, with the lock held: must be quick and must not raise.
    """

    on_change: Callable[["Session"], None] = lambda _: None
    state: State = State.WAITING
    episode: int = -1
    labels: dict[int, Label] = field(default_factory=dict)
    fault: str = ""
    busy: str = ""
    breaks: int = 0
    homing: bool = False
    leader: bool = True
    can_free: bool = True
    free: bool = False
    evaluating: bool = False
    _next: int = 0
    _evaluations: int = 0
    _home: bool = False
    _drove: bool = False
    _unlabelled: bool = False
    _corrected: dict[int, Label] = field(default_factory=dict)
    _lock: threading.RLock = field(default_factory=threading.RLock, repr=False)

    def apply(self, event: Event, detail: str = "") -> State:
        """Apply an event; returns the new state. Raises RefusedError where it has no place.

        detail: of a fault, for people.
        """
        with self._lock:
            if event not in TRANSITIONS[self.state]:
                raise RefusedError(
                    f"'{event}' has no place while {self.state}: expected one of {', '.join(self.allowed())}."
                )
            if obstacle := self._obstacle(event):
                raise RefusedError(obstacle)
            before, after = self.state, TRANSITIONS[self.state][event]
            if event is Event.START:
                self._count()
            self.free = not self.free if event is Event.FREE else self.free and event in KEEPS_FREE
            self._home = event is Event.HOME or (self._home and event is Event.READY)
            self.homing = self.homing and event in (Event.READY, Event.HOME)
            if event in LABELS:
                self.labels[self.episode] = LABELS[event]
                self._unlabelled, self.busy = False, "storing the episode"
            if event is Event.FAULT:
                self.fault = detail or self.fault
                self._unlabelled = self._unlabelled or before in IN_EPISODE
            if event is Event.RECOVERED:
                self.fault = ""
                after = State.LABELLING if self._unlabelled else after
            if event is Event.RESUME and self._drove:
                after = State.TEACHING  # whoever held the leader goes on
            self._drove = after is State.TEACHING or (self._drove and after is State.PAUSED)
            self.breaks += after in (State.PAUSED, State.FAULTED) and before is not after
            self.state = after
            self.on_change(self)
            return after

    def correct(self, episode: int, label: Label) -> None:
        """Say otherwise how a finished episode went. Raises RefusedError for one that has no label yet."""
        with self._lock:
            if episode < 0:
                raise RefusedError(
                    "Evaluations are not learned from: only labels of episodes of the run can be corrected."
                )
            if episode not in self.labels:
                known = f"0 to {max(self.labels)}" if self.labels else "none yet"
                raise RefusedError(f"Episode {episode} has no label to change: finished episodes are {known}.")
            if self.labels[episode] is not label:
                self.labels[episode] = label
                self._corrected[episode] = label
                self.on_change(self)

    @property
    def moving(self) -> bool:
        """Whether the arm moves: in an episode, or on its way home."""
        with self._lock:
            return self.state in IN_MOTION or self.homing

    def take_corrected(self) -> dict[int, Label]:
        """Labels that were changed since the last call, for whoever learns from them."""
        with self._lock:
            taken, self._corrected = self._corrected, {}
            return taken

    def expect(self, number: int | None) -> None:
        """Say which episode of the run starts next; None: evaluations, which have numbers of their own."""
        with self._lock:
            self.evaluating = number is None
            self._next = self._next if number is None else number
            self.on_change(self)

    def _count(self) -> None:
        if self.evaluating:
            self._evaluations += 1
            self.episode = -self._evaluations
        else:
            self.episode, self._next = self._next, self._next + 1
            self.labels.pop(self.episode, None)  # of a try that was interrupted

    def learning(self, doing: str) -> None:
        """Say what the learner is at, "" when it is done: no episode starts meanwhile."""
        with self._lock:
            self.busy = doing
            self.on_change(self)

    def note_free(self) -> None:
        """Say that the arm is still in somebody's hand, whatever was asked for: it could not be held."""
        with self._lock:
            self.free = True
            self.on_change(self)

    def note_homing(self, on: bool) -> None:
        """Say whether the arm is on its way home, for those who stand beside it."""
        with self._lock:
            self.homing = on
            self.on_change(self)

    def take_home(self) -> bool:
        """Whether the arm is to go home, for whoever moves it; asked once."""
        with self._lock:
            asked, self._home = self._home, False
            return asked

    def allowed(self) -> list[Event]:
        """Events that a person may cause now."""
        with self._lock:
            events = TRANSITIONS[self.state]
            return [event for event in events if event not in BY_ITSELF and not self._obstacle(event)]

    def _obstacle(self, event: Event) -> str:
        """Reason, for people, against an event that the state allows; "" where there is none."""
        if event is Event.START and self.busy:
            return f"An episode cannot start while the learner is busy ({self.busy}): wait for it."
        if event in (Event.PAUSE, Event.ABSENT) and not self.moving:
            return f"'{event}' has no place while {self.state}: nothing moves."
        if event is Event.TAKE_OVER and self.evaluating:
            return "An evaluation is on: the policy must do it alone; discard it, or wait."
        if event is Event.TAKE_OVER and not self.leader:
            return "There is no leader arm to take over with: start the run with --teleop.type=..."
        if event is Event.FREE and not self.can_free:
            return "This robot cannot be moved by hand: it has no motor bus that lets go."
        return ""

    def snapshot(self) -> dict[str, Any]:
        """All of it as plain values, for a page or a log."""
        with self._lock:
            return {
                "state": str(self.state), "episode": self.episode, "fault": self.fault, "busy": self.busy,
                "evaluating": self.evaluating, "free": self.free, "homing": self.homing,
                "allowed": [str(event) for event in self.allowed()],
                "labels": {str(number): str(label) for number, label in self.labels.items()},
            }  # fmt: skip
