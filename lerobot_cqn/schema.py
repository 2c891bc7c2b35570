"""Names and shapes every room agrees on.

Shape legend, used in every comment on shapes:

    B  batch
    V  camera views
    S  stacked frames (history)
    L  levels of the coarse-to-fine discretisation
    D  action dimensions
    N  bins per level
    A  atoms of the value distribution (1 when the critic is scalar)
    P  low-dimensional values of one frame (joints, environment state)
    n  length of the n-step return
"""

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

__all__ = [
    "ACTION",
    "BOUND_PROCESSOR",
    "NEXT_DONE",
    "NEXT_REWARD",
    "NEXT_SUCCESS",
    "Batch",
    "Observation",
]

ACTION = "action"
NEXT_REWARD = "next.reward"
NEXT_DONE = "next.done"
NEXT_SUCCESS = "next.success"
BOUND_PROCESSOR = "cqn_bound_observation_processor"


@dataclass(frozen=True)
class Observation:
    """What the networks see at one time step.

    pixels: one tensor [B, 3*S, H, W] per camera view, uint8 in [0, 255] or float in [0, 1], frames oldest
        first on the channels; empty for state-only policies. Views may differ in H and W.
    low_dim: normalised joints and environment state [B, S*P], oldest first; None for pixels-only policies.
    """

    pixels: tuple[Tensor, ...] = ()
    low_dim: Tensor | None = None

    def to(self, device: torch.device | str) -> Self:
        """Return the same observation on `device`."""
        low_dim = None if self.low_dim is None else self.low_dim.to(device, non_blocking=True)
        return type(self)(tuple(view.to(device, non_blocking=True) for view in self.pixels), low_dim)


@dataclass(frozen=True)
class Batch:
    """n-step transitions.

    action: [B, D] in [-1, 1].
    reward: [B, 1] discounted sum of the rewards inside the n-step window.
    discount: [B, 1] factor of the bootstrap value: gamma**k for a window of k steps, 0 after a termination.
    demo: [B, 1] 1.0 where the sample is a demonstration (or was relabelled as one), else 0.0.
    """

    observation: Observation
    action: Tensor
    reward: Tensor
    discount: Tensor
    next_observation: Observation
    demo: Tensor

    def to(self, device: torch.device | str) -> Self:
        """Return the same batch on `device`."""
        return type(self)(
            self.observation.to(device),
            self.action.to(device, non_blocking=True),
            self.reward.to(device, non_blocking=True),
            self.discount.to(device, non_blocking=True),
            self.next_observation.to(device),
            self.demo.to(device, non_blocking=True),
        )
