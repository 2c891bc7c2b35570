"""Protocols and records in which the loop meets environments and arms, and the only place where it does."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Protocol

import torch
from numpy.typing import NDArray

__all__ = [
    "PAGE_TOKEN",
    "Environment",
    "Frame",
    "Interrupted",
    "Label",
    "Monitor",
    "Nobody",
    "Outcome",
    "Outcomes",
    "Person",
    "Scenes",
]

Frame = dict[str, Any]
# The variable that holds the token of the operator's page: one in an option would be saved with the run.
PAGE_TOKEN = "CQN_PAGE_TOKEN"  # noqa: S105  # the variable's name


class Interrupted(Exception):  # noqa: N818  # a request, not an error
    """The person asked to stop; the trainer is in a state that can be saved."""


class Label(StrEnum):
    """Judgement of an episode by a person."""

    SUCCESS = "success"
    FAILURE = "failure"
    DISCARD = "discard"  # neither: not to be learned from


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Outcome of one control step.

    frame: the new observation under LeRobot's names, one batch dimension of 1.
    terminated: a real end (success); truncated: out of time, the value of the last observation still counts.
    sent: command [1, D] in the environment's units that was carried out; None: the one that was asked for.
    taught: a person chose it. skipped: the step came to nothing (a pause, a fault): `frame` takes the place of the one
    before, and an end is that of the step before. discarded: the episode has ended and is not to be learned from.
    """

    frame: Frame
    reward: float
    terminated: bool
    truncated: bool
    success: bool
    sent: torch.Tensor | None = None
    taught: bool = False
    skipped: bool = False
    discarded: bool = False

    @property
    def ended(self) -> bool:
        """Whether the episode is over."""
        return self.terminated or self.truncated or self.discarded


class Environment(Protocol):
    """Something that can be acted in."""

    @property
    def max_steps(self) -> int:
        """Control steps before an episode is cut off."""
        ...

    @property
    def fps(self) -> int:
        """Control steps a second."""
        ...

    @property
    def waited_s(self) -> float:
        """Seconds so far in which a person was waited for."""
        ...

    def open(self) -> None:
        """Get ready; called once, before the first episode."""
        ...

    def reset(self, seed: int) -> Frame:
        """Start an episode that `seed` determines. Raises Interrupted when the person wants no more."""
        ...

    def step(self, action: torch.Tensor) -> Outcome:
        """Apply an action [1, D] in the environment's own units."""
        ...

    def render(self) -> NDArray[Any]:
        """Picture for a person, uint8 [H, W, 3]."""
        ...

    def close(self) -> None:
        """Free the simulator."""
        ...


class Person(Protocol):
    """The person who judges episodes and may change their mind, as the loop sees them."""

    def expect(self, number: int | None) -> None:
        """Say which episode of the run starts next; None: evaluations."""
        ...

    def learning(self, doing: str) -> None:
        """Say what the learner is at; no episode can start until the environment is asked for one."""
        ...

    def take_corrected(self) -> Mapping[int, Label]:
        """Labels of finished episodes, by number, that were changed since the last call."""
        ...


class Monitor(Protocol):
    """Display of progress for a person."""

    def phase(self, name: str, total: int, done: int) -> None:
        """A phase of `total` units begins, `done` of them already behind."""
        ...

    def advance(self, done: int, note: str) -> None:
        """Progress within the phase."""
        ...

    def message(self, text: str) -> None:
        """A line that stays."""
        ...


class Nobody:
    """The person of an environment that judges for itself."""

    def expect(self, number: int | None) -> None:
        """Nothing: there is nobody to tell."""

    def learning(self, doing: str) -> None:
        """Nothing: there is nobody to tell."""

    def take_corrected(self) -> dict[int, Label]:
        """Nothing."""
        return {}


@dataclass(frozen=True, kw_only=True)
class Outcomes:
    """Outcome of one control step in K scenes; `frame` has K rows, the arrays are [K]. skipped: as in `Outcome`."""

    frame: Frame
    reward: NDArray[Any]
    ended: NDArray[Any]
    success: NDArray[Any]
    skipped: bool = False


class Scenes(Protocol):
    """K environments that step together, for evaluation."""

    @property
    def count(self) -> int:
        """K."""
        ...

    @property
    def max_steps(self) -> int:
        """Control steps before an episode is cut off."""
        ...

    def reset(self, seeds: Sequence[int]) -> Frame:
        """Start an episode in each, as its seed says; rows [K, ...]."""
        ...

    def step(self, action: torch.Tensor) -> Outcomes:
        """Apply actions [K, D] in the environment's own units; what comes after an episode's end does not count."""
        ...

    def render(self) -> Sequence[NDArray[Any]]:
        """K pictures for a person, uint8 [H, W, 3]."""
        ...

    def close(self) -> None:
        """Free the simulators."""
        ...
