"""What the loop needs from the world; environments and arms meet it here, and only here."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from numpy.typing import NDArray

__all__ = ["Environment", "Frame", "Outcome", "Outcomes", "Scenes"]

Frame = dict[str, Any]


@dataclass(frozen=True)
class Outcome:
    """What one control step brought.

    frame: the new observation under LeRobot's names, one batch dimension of 1.
    terminated: a real end (success); truncated: out of time, the value of the last observation still counts.
    """

    frame: Frame
    reward: float
    terminated: bool
    truncated: bool
    success: bool


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

    def reset(self, seed: int) -> Frame:
        """Start an episode that `seed` determines."""
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


@dataclass(frozen=True)
class Outcomes:
    """What one control step brought in K scenes; `frame` has K rows, the arrays are [K]."""

    frame: Frame
    reward: NDArray[Any]
    ended: NDArray[Any]
    success: NDArray[Any]


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
