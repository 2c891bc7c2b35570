"""A policy with its processors: frames of an environment in, commands out."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.processor import (
    NormalizerProcessorStep,
    PolicyProcessorPipeline,
    TransitionKey,
    UnnormalizerProcessorStep,
    create_transition,
)
from numpy.typing import NDArray

from lerobot_cqn.base_policy import RLPolicy
from lerobot_cqn.correction import AddBaseActionProcessorStep, Base, base_of
from lerobot_cqn.delta_actions import DeltaJoints
from lerobot_cqn.errors import DataError
from lerobot_cqn.joint_goals import DeltaToGoalProcessorStep

from .interfaces import Frame, Outcome

__all__ = ["Agent"]


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

    def reset(self) -> None:
        """Forget the episode before: frames, and joints that commands are differences from."""
        self.policy.reset()
        self.preprocessor.reset()
        self.postprocessor.reset()

    def retake(self, *, first: bool) -> None:
        """Forget the newest frame, which another one takes the place of; first: of the episode."""
        if first:
            self.policy.reset()
        else:
            self.policy.forget_newest()

    def carried_out(self, action: torch.Tensor, outcome: Outcome) -> torch.Tensor:
        """The normalised action [1, D] that was carried out in a step for which `action` was chosen.

        What limits changed of the policy's action belongs to the world; a person's command is an action of its own.
        """
        if outcome.sent is None:
            for step in self._goal_steps if outcome.skipped else ():
                step.sent(None)
            return action
        wanted = outcome.sent
        for step in self._goal_steps:
            wanted = step.action_of(outcome.sent)
            step.sent(outcome.sent)
        if not outcome.taught:
            return action
        self.policy.forget_plan()  # made for a course that the person left
        (normaliser,) = (s for s in self.preprocessor.steps if isinstance(s, NormalizerProcessorStep))
        scaled: torch.Tensor = normaliser(create_transition(action=wanted.float()))[TransitionKey.ACTION]
        return scaled.clamp(-1.0, 1.0).to(action)

    @property
    def deltas(self) -> DeltaJoints | None:
        """Differences among the policy's actions that the postprocessor turns into goals; None: none."""
        return next((step.deltas for step in self._goal_steps if isinstance(step, DeltaToGoalProcessorStep)), None)

    @property
    def base(self) -> Base | None:
        """The policy that this one corrects; None: none."""
        config = self.policy.config
        return None if config.base_path is None else base_of(config.base_path, config.base_revision)

    @property
    def _goal_steps(self) -> list[DeltaToGoalProcessorStep | AddBaseActionProcessorStep]:
        kinds = (DeltaToGoalProcessorStep, AddBaseActionProcessorStep)
        return [step for step in self.postprocessor.steps if isinstance(step, kinds)]

    def act(self, prepared: Frame, *, explore: bool, at_random: bool = False) -> tuple[torch.Tensor, NDArray[Any]]:
        """Normalised actions [K, D] in [-1, 1] for K rows, and the mean Q [K] of what the policy would do.

        at_random: uniform actions instead of its own.
        """
        action, q = self.policy.act(prepared, explore=explore)
        if at_random:
            action = self.policy.model.executable(2 * torch.rand_like(action) - 1)
        return action, q.float().cpu().numpy()

    def low_dim(self, prepared: Frame) -> NDArray[Any] | None:
        """Normalised state of prepared frames: [K, P], None for pixels-only policies."""
        if not self.policy.low_dim_keys:
            return None
        return torch.cat([prepared[key] for key in self.policy.low_dim_keys], dim=-1).float().cpu().numpy()

    def ranges(self, key: str) -> NDArray[Any] | None:
        """`min` and `max` [2, K] of a feature in the statistics that the policy scales by; None where it has none."""
        for step in self.postprocessor.steps:  # the preprocessor's give a constant joint a range of two units
            if isinstance(step, UnnormalizerProcessorStep) and "min" in (entry := (step.stats or {}).get(key, {})):
                return np.stack([np.asarray(entry[name], dtype=np.float64).reshape(-1) for name in ("min", "max")])
        return None

    def inside(self, bounds: Mapping[str, NDArray[Any]] | None) -> NDArray[Any]:
        """Flags [D] of action dimensions that end before the environment's bounds (`min`, `max`): more is possible."""
        if bounds is None:
            return np.ones(self.policy.action_dims, dtype=bool)
        (scale,) = (step for step in self.postprocessor.steps if isinstance(step, UnnormalizerProcessorStep))
        ends = [torch.full((1, self.policy.action_dims), end) for end in (-1.0, 1.0)]
        extremes = [scale(create_transition(action=end))[TransitionKey.ACTION][0].cpu().numpy() for end in ends]
        near = 0.01 * (bounds["max"] - bounds["min"])
        room: NDArray[Any] = (extremes[0] > bounds["min"] + near) | (extremes[1] < bounds["max"] - near)
        return room

    def pixels(self, prepared: Frame, given: Frame | None = None) -> list[NDArray[Any]]:
        """Images of a prepared frame as the replay stores them: per view uint8 [K, 3, H, W].

        given: the frame before it was prepared, whose images need not come back from the policy's device; those of
        another size than the policy's were scaled on the way.
        """
        missing = [key for key in self.policy.view_keys if key not in prepared]
        if missing:
            found = sorted(key for key in prepared if key.startswith("observation.image"))
            raise DataError(f"The policy needs the camera '{missing[0]}', the observation has {found or 'none'}.")
        views = []
        for key in self.policy.view_keys:
            pixels, own = prepared[key], (given or {}).get(key)
            if own is not None and own.dtype == torch.uint8 and own.shape == pixels.shape:
                pixels = own
            views.append(_to_uint8(pixels))
        return views


def _to_uint8(pixels: torch.Tensor) -> NDArray[Any]:
    if pixels.dtype == torch.uint8:
        return pixels.cpu().numpy()
    # LeRobot divides by 255; rounding undoes it exactly.
    return (pixels * 255).round().to(torch.uint8).cpu().numpy()
