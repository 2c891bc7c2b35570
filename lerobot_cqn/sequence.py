"""CQN-AS (Seo and Abbeel 2024): CQN's critic over the next T actions, and how sequences become one action a step."""

from collections import deque
from typing import Any

import torch
from torch import Tensor

from .critic import CQNModel
from .schema import Observation
from .settings import CQNASSettings

__all__ = ["CQNASModel", "OpenLoop", "TemporalEnsemble", "filled"]


class CQNASModel(CQNModel):
    """CQN's model with T*D entries in place of D dimensions; target and losses are CQN's on these."""

    settings: CQNASSettings

    def shape_of_sequences(self) -> dict[str, Any]:
        """A GRU along T steps, and what else the network has that CQN's has not."""
        s = self.settings
        return {
            "sequence": s.action_sequence, "gru_layers": s.gru_layers, "pixel_layers": s.pixel_projection_layers,
            "project_low_dim": s.project_state, "dueling": s.dueling,
        }  # fmt: skip

    @torch.no_grad()
    def act(self, observation: Observation, explore: bool = False) -> tuple[Tensor, Tensor]:
        """Greedy sequence [B, T*D] in [-1, 1] and its mean Q [B]; noise is added to the one action of a step, later."""
        return self.choose(observation, explore)

    def executable(self, action: Tensor) -> Tensor:
        """Any action: the mean of several sequences is on no grid."""
        return action

    def steps(self, sequence: Tensor) -> Tensor:
        """Sequence [B, T*D] as the actions of its steps, [B, T, D]."""
        return sequence.view(len(sequence), self.settings.action_sequence, -1)


class TemporalEnsemble:
    """One action a step: the weighted mean of what the last T sequences say about it (Zhao et al. 2023).

    Weights are exp(-gain * i), i = 0 for the oldest sequence that reaches the step. A new sequence is due in each step.
    """

    def __init__(self, steps: int, gain: float) -> None:
        self.gain = gain
        self._sequences: deque[Tensor] = deque(maxlen=steps)
        self.due = True

    def reset(self) -> None:
        """Forget all sequences."""
        self._sequences.clear()

    def plan(self, sequence: Tensor) -> None:
        """A sequence [B, T, D] that begins in this step."""
        self._sequences.append(sequence)

    def step(self) -> Tensor:
        """Action [B, D] of this step; the next one begins."""
        ages = range(len(self._sequences) - 1, -1, -1)
        said = torch.stack([sequence[:, age] for age, sequence in zip(ages, self._sequences, strict=True)])
        weights: Tensor = torch.exp(-self.gain * torch.arange(len(said), device=said.device, dtype=said.dtype))
        action: Tensor = torch.tensordot(weights / weights.sum(), said, dims=1)
        return action


class OpenLoop:
    """One action a step: each sequence is played to its end before another one is due."""

    def __init__(self) -> None:
        self._actions: deque[Tensor] = deque()

    @property
    def due(self) -> bool:
        """Whether the last sequence is at its end."""
        return not self._actions

    def reset(self) -> None:
        """Forget what is left of the sequence."""
        self._actions.clear()

    def plan(self, sequence: Tensor) -> None:
        """A sequence [B, T, D] that begins in this step."""
        self._actions.extend(sequence.unbind(1))

    def step(self) -> Tensor:
        """Action [B, D] of this step; the next one begins."""
        return self._actions.popleft()


def filled(actions: Tensor, inside: Tensor, fill: str, cut: Tensor | None = None) -> tuple[Tensor, Tensor | None]:
    """Sequences whose steps beyond the end are filled, and which of their numbers count (`Batch.real`).

    Args:
        actions: [B, T, D]; steps beyond the end hold the last action before it.
        inside: bool [B, T], False beyond the end of the episode, or of what a sequence may cover.
        fill: "zeros", "last" or "mask", as `CQNASSettings.sequence_fill`.
        cut: bool [B, 1], where the episode went on beyond: what fills these sequences never counts. None: nowhere.

    Returns:
        action [B, T*D] and real [B, T*D] in {0, 1}, None where all numbers count.
    """
    if fill == "zeros":
        actions = actions * inside[..., None]
    counts = inside
    if fill != "mask":
        counts = torch.ones_like(inside) if cut is None else inside | ~cut
    real = None if counts.all() else counts[..., None].expand_as(actions).flatten(1).to(actions)
    return actions.flatten(1), real
