"""The session of a person at an arm, as a state machine: no web, no robot, no time in it.

An episode runs from `start` to `success`, `failure` or `discard`, by a person's hand; in between it may be paused, or
driven by the person (`take_over`). When its time is up it waits for its label. Then the person resets the scene, and
the next one may start. A fault leads to FAULTED from everywhere, `stop` to STOPPED, which nothing leaves.
"""

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from lerobot_cqn.errors import CQNError

__all__ = ["TRANSITIONS", "Event", "Label", "RefusedError", "Session", "State"]


class State(StrEnum):
    """What is going on."""

    WAITING = "waiting"  # the arm holds, the scene is ready
    RUNNING = "running"  # the policy drives
    PAUSED = "paused"  # the arm holds in the middle of an episode; nothing is recorded
    TEACHING = "teaching"  # a person drives with the leader; recorded as a demonstration
    LABELLING = "labelling"  # the episode is over and nobody has said how it went
    RESETTING = "resetting"  # between episodes: the person sets up the scene, the policy learns
    FAULTED = "faulted"  # the robot cannot be trusted
    STOPPED = "stopped"  # for good


class Event(StrEnum):
    """What can happen: by a person's hand, and by itself."""

    START = "start"
    PAUSE = "pause"
    RESUME = "resume"
    SUCCESS = "success"
    FAILURE = "failure"
    DISCARD = "discard"
    TAKE_OVER = "take_over"
    HAND_BACK = "hand_back"
    READY = "ready"
    STOP = "stop"
    TIME_UP = "time_up"
    ABSENT = "absent"
    FAULT = "fault"
    RECOVERED = "recovered"


class Label(StrEnum):
    """How an episode went."""

    SUCCESS = "success"
    FAILURE = "failure"
    DISCARD = "discard"  # neither: not to be learned from


LABELS: Mapping[Event, Label] = {
    Event.SUCCESS: Label.SUCCESS, Event.FAILURE: Label.FAILURE, Event.DISCARD: Label.DISCARD,
}  # fmt: skip
BY_ITSELF = frozenset({Event.TIME_UP, Event.ABSENT, Event.FAULT, Event.RECOVERED})
IN_EPISODE = frozenset({State.RUNNING, State.PAUSED, State.TEACHING, State.LABELLING})

_ENDS = dict.fromkeys(LABELS, State.RESETTING)
_ALWAYS = {Event.STOP: State.STOPPED, Event.FAULT: State.FAULTED}
TRANSITIONS: Mapping[State, Mapping[Event, State]] = {
    State.WAITING: {**_ALWAYS, Event.START: State.RUNNING},
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
    State.RESETTING: {**_ALWAYS, Event.READY: State.WAITING},
    # What was going on is over; where an episode was, a person says how it went (see `Session.apply`).
    State.FAULTED: {Event.STOP: State.STOPPED, Event.FAULT: State.FAULTED, Event.RECOVERED: State.RESETTING},
    State.STOPPED: {Event.STOP: State.STOPPED},
}  # fmt: skip


class RefusedError(CQNError, ValueError):
    """An event that has no place in the present state; nothing has changed."""


@dataclass
class Session:
    """State, episodes and their labels; safe to use from several threads.

    Attributes:
        state: what is going on.
        episode: number of the episode that runs or ran last; -1 before the first.
        labels: of the finished episodes, by number.
        fault: what the robot said last, "" while all is well.
        on_change: called after each change, with the lock held: must be quick and must not raise.
    """

    on_change: Callable[["Session"], None] = lambda _: None
    state: State = State.WAITING
    episode: int = -1
    labels: dict[int, Label] = field(default_factory=dict)
    fault: str = ""
    _unlabelled: bool = False
    _relabelled: dict[int, Label] = field(default_factory=dict)
    _lock: threading.RLock = field(default_factory=threading.RLock, repr=False)

    def apply(self, event: Event, detail: str = "") -> State:
        """Let an event happen; returns the new state. Raises RefusedError where it has no place.

        detail: of a fault, for people.
        """
        with self._lock:
            if event not in TRANSITIONS[self.state]:
                raise RefusedError(
                    f"'{event}' has no place while {self.state}: expected one of {', '.join(self.allowed())}."
                )
            before, after = self.state, TRANSITIONS[self.state][event]
            if event is Event.START:
                self.episode += 1
            if event in LABELS:
                self.labels[self.episode] = LABELS[event]
                self._unlabelled = False
            if event is Event.FAULT:
                self.fault = detail or self.fault
                self._unlabelled = self._unlabelled or before in IN_EPISODE
            if event is Event.RECOVERED:
                self.fault = ""
                after = State.LABELLING if self._unlabelled else after
            self.state = after
            self.on_change(self)
            return after

    def relabel(self, episode: int, label: Label) -> None:
        """Say otherwise how a finished episode went. Raises RefusedError for one that has no label yet."""
        with self._lock:
            if episode not in self.labels:
                known = f"0 to {max(self.labels)}" if self.labels else "none yet"
                raise RefusedError(f"Episode {episode} has no label to change: finished episodes are {known}.")
            if self.labels[episode] is not label:
                self.labels[episode] = label
                self._relabelled[episode] = label
                self.on_change(self)

    def take_relabelled(self) -> dict[int, Label]:
        """Labels that were changed since the last call, for whoever learns from them."""
        with self._lock:
            taken, self._relabelled = self._relabelled, {}
            return taken

    def allowed(self) -> list[Event]:
        """What a person may do now."""
        with self._lock:
            return [event for event in TRANSITIONS[self.state] if event not in BY_ITSELF]

    def snapshot(self) -> dict[str, Any]:
        """All of it as plain values, for a page or a log."""
        with self._lock:
            return {
                "state": str(self.state), "episode": self.episode, "fault": self.fault,
                "allowed": [str(event) for event in self.allowed()],
                "labels": {str(number): str(label) for number, label in self.labels.items()},
            }  # fmt: skip
