"""One episode as it happens, on its way into the replay."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..agent import Agent
from ..interfaces import Frame
from .episode import Episode, spans

__all__ = ["Recorder"]


@dataclass
class Recorder:
    """Collects one episode for the replay, in the policy's normalised units."""

    agent: Agent
    low_dim: list[NDArray[Any]] = field(default_factory=list)
    pixels: list[list[NDArray[Any]]] = field(default_factory=list)
    action: list[NDArray[Any]] = field(default_factory=list)
    reward: list[float] = field(default_factory=list)
    taught: list[bool] = field(default_factory=list)
    borders: set[int] = field(default_factory=set)

    def __len__(self) -> int:
        """Steps so far."""
        return len(self.action)

    def observe(self, prepared: Frame, given: Frame) -> None:
        """Keep a frame; given: as the environment gave it, before it was prepared."""
        low_dim = self.agent.low_dim(prepared)
        if low_dim is not None:
            self.low_dim.append(low_dim)
        self.pixels.append(self.agent.pixels(prepared, given))

    def retake(self, prepared: Frame, given: Frame, reward: float) -> None:
        """Keep a frame in place of the last one, and a reward for the step that led to it: a pause lies before it."""
        self.borders.add(len(self))
        if self.low_dim:
            self.low_dim.pop()
        self.pixels.pop()
        self.observe(prepared, given)
        if self.reward:
            self.reward[-1] += reward

    def step(self, action: torch.Tensor, reward: float, *, taught: bool = False) -> None:
        """Keep what was done [1, D], what it earned, and whether a person did it."""
        self.action.append(action[0].cpu().numpy())
        self.reward.append(reward)
        self.taught.append(taught)

    def episode(self, *, terminated: bool, success: bool) -> Episode:
        """The finished episode."""
        return Episode(
            low_dim=np.concatenate(self.low_dim).astype(np.float32) if self.low_dim else None,
            pixels=tuple(np.concatenate(view) for view in zip(*self.pixels, strict=True)) if self.pixels[0] else (),
            action=np.stack(self.action).astype(np.float32),
            reward=np.asarray(self.reward, dtype=np.float32),
            terminated=terminated,
            success=success,
            taught=spans(self.taught),
            borders=tuple(sorted(self.borders - {0, len(self)})),
        )
