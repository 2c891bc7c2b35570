"""A policy with its processors: frames of an environment in, commands and replay episodes out."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from lerobot.processor import PolicyProcessorPipeline
from numpy.typing import NDArray

from lerobot_cqn.base_policy import RLPolicy
from lerobot_cqn.errors import DataError

from .interfaces import Frame
from .replay import Episode

__all__ = ["Agent", "Recorder"]


@dataclass(frozen=True)
class Agent:
    """The policy and the pipelines that are saved with it."""

    policy: RLPolicy
    preprocessor: PolicyProcessorPipeline[Any, Any]
    postprocessor: PolicyProcessorPipeline[Any, Any]

    def prepare(self, frame: Frame) -> Frame:
        """Normalise and bound one frame; tensors [1, ...] on the policy's device."""
        prepared: Frame = self.preprocessor(dict(frame))
        return prepared

    def act(self, prepared: Frame, *, explore: bool) -> tuple[torch.Tensor, float]:
        """Normalised action [1, D] in [-1, 1] and its mean Q (nan when not exploring)."""
        if explore:
            action, q = self.policy.explore(prepared)
            return action, float(q[0])
        return self.policy.select_action(prepared), float("nan")

    def low_dim(self, prepared: Frame) -> NDArray[Any] | None:
        """Normalised state of prepared frames: [K, P], None for pixels-only policies."""
        if not self.policy.low_dim_keys:
            return None
        return torch.cat([prepared[key] for key in self.policy.low_dim_keys], dim=-1).float().cpu().numpy()

    def inside(self, bounds: Mapping[str, NDArray[Any]] | None) -> NDArray[Any]:
        """Which action dimensions [D] end before the environment's bounds (`min`, `max`) do: more is possible."""
        extremes = [self.postprocessor(torch.full((1, self.policy.action_dims), end))[0].numpy() for end in (-1.0, 1.0)]
        if bounds is None:
            return np.ones(self.policy.action_dims, dtype=bool)
        near = 0.01 * (bounds["max"] - bounds["min"])
        room: NDArray[Any] = (extremes[0] > bounds["min"] + near) | (extremes[1] < bounds["max"] - near)
        return room

    def pixels(self, frame: Frame) -> list[NDArray[Any]]:
        """Images of a frame as the replay stores them: per view uint8 [K, 3, H, W]."""
        missing = [key for key in self.policy.view_keys if key not in frame]
        if missing:
            found = sorted(key for key in frame if key.startswith("observation.image"))
            raise DataError(f"The policy needs the camera '{missing[0]}', the observation has {found or 'none'}.")
        return [_to_uint8(frame[key]) for key in self.policy.view_keys]


@dataclass
class Recorder:
    """Collects one episode for the replay, in the policy's normalised units."""

    agent: Agent
    low_dim: list[NDArray[Any]] = field(default_factory=list)
    pixels: list[list[NDArray[Any]]] = field(default_factory=list)
    action: list[NDArray[Any]] = field(default_factory=list)
    reward: list[float] = field(default_factory=list)

    def observe(self, prepared: Frame) -> None:
        """Keep a prepared frame."""
        low_dim = self.agent.low_dim(prepared)
        if low_dim is not None:
            self.low_dim.append(low_dim)
        self.pixels.append(self.agent.pixels(prepared))

    def step(self, action: torch.Tensor, reward: float) -> None:
        """Keep what was done [1, D] and what it earned."""
        self.action.append(action[0].cpu().numpy())
        self.reward.append(reward)

    def episode(self, *, terminated: bool, success: bool) -> Episode:
        """The finished episode."""
        return Episode(
            np.concatenate(self.low_dim).astype(np.float32) if self.low_dim else None,
            tuple(np.concatenate(view) for view in zip(*self.pixels, strict=True)) if self.pixels[0] else (),
            np.stack(self.action).astype(np.float32),
            np.asarray(self.reward, dtype=np.float32),
            terminated,
            success,
        )


def _to_uint8(pixels: torch.Tensor) -> NDArray[Any]:
    if pixels.dtype == torch.uint8:
        return pixels.cpu().numpy()
    # LeRobot divides by 255; rounding undoes it exactly.
    return (pixels * 255).round().to(torch.uint8).cpu().numpy()
