"""From a policy's joint differences to an arm's absolute goals and back, in the robot's units.

What was recorded is what robot and environment take: goals, or differences where `cqn-data record` says so. What the
policy learned from is what the dataset's history ends with (`delta_actions`). Where the two differ, two steps around
the policy bring one to the other, in every command of LeRobot: one remembers the joints, the other adds differences to
them, or takes them off goals.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from lerobot.processor import (
    AbsoluteActionsProcessorStep,
    EnvTransition,
    ProcessorStepRegistry,
    RelativeActionsProcessorStep,
    TransitionKey,
)
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from .delta_actions import DeltaJoints, Kind, current_description, parse, recorded_deltas
from .errors import DataError
from .schema import read_history

__all__ = [
    "DeltaToGoalProcessorStep",
    "GoalToDeltaProcessorStep",
    "RememberJointsProcessorStep",
    "action_of",
    "converted_deltas",
    "goal_of",
    "undone_deltas",
]


def goal_of(action: Tensor, state: Tensor, last_goal: Tensor, deltas: DeltaJoints | None) -> Tensor:
    """Absolute goal [..., D] of an action, on its device, in float32 or better.

    Args:
        action: [..., D], differences in the dimensions that `deltas` names, absolute in the others.
        state: measured state [..., P], as the dataset orders it.
        last_goal: goal [..., D] before this one; at the start of an episode the measured joints.
        deltas: which dimensions are differences, and of what; None: none is.
    """
    return _shifted(action, state, last_goal, deltas, 1)


def action_of(goal: Tensor, state: Tensor, last_goal: Tensor, deltas: DeltaJoints | None) -> Tensor:
    """The action [..., D] that asks for a goal [..., D]: how a person's goals become actions; inverse of `goal_of`."""
    return _shifted(goal, state, last_goal, deltas, -1)


def _shifted(value: Tensor, state: Tensor, last_goal: Tensor, deltas: DeltaJoints | None, sign: int) -> Tensor:
    # In bfloat16 a goal of a hundred degrees would be half a degree off.
    shifted = value.to(torch.promote_types(value.dtype, torch.float32), copy=True)
    if deltas is not None:
        joints = list(deltas.action_dims)
        base = last_goal[..., joints] if deltas.kind == "command_steps" else state[..., list(deltas.state_dims)]
        shifted[..., joints] += sign * base.to(shifted)
    return shifted


@ProcessorStepRegistry.register(name="cqn_remember_joints")
class RememberJointsProcessorStep(RelativeActionsProcessorStep):
    """Remembers the measured state [K, P] of the newest frame, before it is normalised; changes nothing.

    LeRobot knows the two steps by their base classes and connects them after loading; `enabled` stays False, since
    actions are differences already when a policy is trained on them.

    Attributes:
        frames: how many frames have been seen; tells one control step from the next.
    """

    def __init__(self) -> None:
        super().__init__(enabled=False)
        self._last_state: Tensor | None = None
        self.frames = 0

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Keep a copy of the state; a frame without one leaves the last."""
        state = (transition.get(TransitionKey.OBSERVATION) or {}).get(OBS_STATE)
        if state is not None:
            self._last_state = torch.as_tensor(state).detach().clone()
            self.frames += 1
        return transition

    def reset(self) -> None:
        """Forget the state: an episode begins."""
        self._last_state = None

    def get_config(self) -> dict[str, Any]:
        """No settings: the checkpoint keeps only that the step is there."""
        return {}


class _JointsStep(AbsoluteActionsProcessorStep):
    """What both ways have: the joints that a partner remembers, and the goals that were sent.

    For kind "command_steps" it remembers the last goal, which starts from the measured joints. A control step begins
    with a new frame; asking again in the same one gives the same answer. Another action in the same frame would belong
    to a later step, whose joints nobody knows yet: a sequence of differences is driven step by step or not at all.

    Attributes:
        deltas: which dimensions are differences, and of what.
    """

    def __init__(
        self,
        kind: Kind,
        action_dims: Sequence[int],
        state_dims: Sequence[int],
        relative_step: RelativeActionsProcessorStep | None = None,
    ) -> None:
        super().__init__(enabled=True, relative_step=relative_step)
        self.deltas = DeltaJoints(kind, tuple(action_dims), tuple(state_dims))
        self.reset()

    def reset(self) -> None:
        """Forget the last goal: an episode begins."""
        self._frame = -1
        self._before: Tensor | None = None  # the goal that this step's is a difference from
        self._goal: Tensor | None = None  # this step's own
        self._asked: Tensor | None = None  # for this frame

    def sent(self, goal: Tensor | None) -> None:
        """The goal [K, D] that was really sent in this step; None: none was, and the next starts from the joints."""
        self._goal = None if goal is None else goal.detach().clone()

    def action_of(self, goal: Tensor) -> Tensor:
        """The action [K, D] that would have asked for a goal [K, D] in this step, before or after it was sent.

        Raises DataError when no state was seen in this episode.
        """
        state, before = self._remembered(goal)
        return action_of(goal, state, before, self.deltas)

    def get_config(self) -> dict[str, Any]:
        """Settings that are saved with the checkpoint."""
        d = self.deltas
        return {"kind": d.kind, "action_dims": list(d.action_dims), "state_dims": list(d.state_dims)}

    def _remembered(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """State [K, P] of this step, and the goal [K, D] before it."""
        partner = self.relative_step
        state = partner.get_cached_state() if isinstance(partner, RememberJointsProcessorStep) else None
        if not isinstance(partner, RememberJointsProcessorStep) or state is None:
            raise DataError(
                f"The policy's actions are joint differences, and no joints were seen yet: expected '{OBS_STATE}' in "
                "the observation before the first action, found none; run the preprocessor on one that has it."
            )
        if partner.frames != self._frame:
            self._frame, self._before, self._asked = partner.frames, self._goal, None
        if self._before is None:
            self._before = torch.zeros_like(like, dtype=state.dtype, device=state.device)
            self._before[..., list(self.deltas.action_dims)] = state[..., list(self.deltas.state_dims)]
        return state, self._before


@ProcessorStepRegistry.register(name="cqn_delta_to_goal")
class DeltaToGoalProcessorStep(_JointsStep):
    """Turns an action [K, D] into the absolute goal [K, D]."""

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Goal of the action. Raises DataError when no state was seen in this episode."""
        action = transition.get(TransitionKey.ACTION)
        if not isinstance(action, Tensor):
            return transition
        state, before = self._remembered(action)
        if action.ndim > state.ndim or (self._asked is not None and not torch.equal(self._asked, action)):
            raise DataError(
                "A sequence of joint differences cannot be driven from one frame: each is from its own step's joints."
                " Drive step by step (lerobot-rollout with --inference.type=sync, lerobot-eval, cqn-train), or train on"
                " absolute actions."
            )
        self._asked = action.detach().clone()
        self._goal = goal_of(action, state, before, self.deltas)
        changed = transition.copy()
        changed[TransitionKey.ACTION] = self._goal.clone()
        return changed


@ProcessorStepRegistry.register(name="cqn_goal_to_delta")
class GoalToDeltaProcessorStep(_JointsStep):
    """Turns a goal [K, D] into the differences [K, D] that an environment takes."""

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Action that asks for the goal. Raises DataError when no state was seen in this episode."""
        goal = transition.get(TransitionKey.ACTION)
        if not isinstance(goal, Tensor):
            return transition
        changed = transition.copy()
        changed[TransitionKey.ACTION] = self.action_of(goal)
        self._goal = goal.detach().clone()
        return changed


def undone_deltas(dataset_meta: Any) -> DeltaJoints | None:
    """Differences that the environment takes, where `cqn-data delta --to=absolute` made goals of them; else None.

    dataset_meta: as of `converted_deltas`.
    Raises DataError as it does, and where the goals were made differences of another kind.
    """
    if dataset_meta is None:
        return None
    root = Path(dataset_meta.root)
    history = read_history(root)
    recorded, now = recorded_deltas(history), current_description(history)
    if recorded is None or now == recorded:
        return None
    if now is not None:
        raise DataError(
            f"{root}: the environment takes differences of kind '{recorded['kind']}', the dataset now has"
            f" '{now['kind']}', which cannot be driven there: make the actions absolute, or use the first recording."
        )
    return parse(recorded, dataset_meta.features, root)


def converted_deltas(dataset_meta: Any) -> DeltaJoints | None:
    """Deltas that `cqn-data delta` made of absolute actions; None where the robot takes actions as they are.

    dataset_meta: LeRobot's metadata (its folder `root`, and `features`); None: no dataset.
    Raises DataError for a damaged history, or one that names dimensions which the features do not have.
    """
    if dataset_meta is None:
        return None
    root = Path(dataset_meta.root)
    history = read_history(root)
    now = current_description(history)
    # Differences that were recorded are what the environment itself takes.
    return None if now is None or now == recorded_deltas(history) else parse(now, dataset_meta.features, root)
