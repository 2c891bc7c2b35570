"""Names and shapes every room agrees on.

Shape legend, used in every comment on shapes:

    B  batch
    V  camera views
    S  stacked frames (history)
    L  levels of the coarse-to-fine discretisation
    D  action dimensions
    N  bins per level
    A  atoms of the value distribution (1 when the critic is scalar)
    T  actions of a sequence, of an episode its steps
    P  low-dimensional values of one frame (joints, environment state)
    n  length of the n-step return
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from .errors import DataError

if TYPE_CHECKING:  # names and the history are needed by commands that answer at once
    import torch
    from torch import Tensor

__all__ = [
    "ACTION",
    "BASE_ACTION",
    "BOUND_PROCESSOR",
    "HISTORY",
    "NEXT_DONE",
    "NEXT_REWARD",
    "NEXT_SUCCESS",
    "STATE",
    "Batch",
    "Observation",
    "dimension_names",
    "has_names",
    "opens_and_closes",
    "read_history",
]

ACTION = "action"
STATE = "observation.state"
BASE_ACTION = "observation.base_action"  # what the policy that is corrected would do, [D]
NEXT_REWARD = "next.reward"
NEXT_DONE = "next.done"
NEXT_SUCCESS = "next.success"
BOUND_PROCESSOR = "cqn_bound_observation_processor"
HISTORY = Path("meta") / "cqn_history.json"  # in a dataset's folder: what was done to it


@dataclass(frozen=True)
class Observation:
    """Observation that the networks see at one time step.

    pixels: one tensor [B, 3*S, H, W] per camera view, uint8 in [0, 255] or float in [0, 1], frames oldest
        first on the channels; empty for state-only policies. Views may differ in H and W.
    low_dim: normalised joints and environment state [B, S*P], oldest first; None for pixels-only policies.
    """

    pixels: "tuple[Tensor, ...]" = ()
    low_dim: "Tensor | None" = None

    def to(self, device: "torch.device | str") -> Self:
        """Return the same observation on `device`."""
        low_dim = None if self.low_dim is None else self.low_dim.to(device, non_blocking=True)
        return type(self)(tuple(view.to(device, non_blocking=True) for view in self.pixels), low_dim)


@dataclass(frozen=True, kw_only=True)
class Batch:
    """n-step transitions.

    action: [B, D] in [-1, 1]; of action sequences [B, T*D], step by step.
    reward: [B, 1] discounted sum of the rewards inside the n-step window.
    discount: [B, 1] factor of the bootstrap value: gamma**k for a window of k steps, 0 after a termination.
    demo: [B, 1] 1.0 where the sample is a demonstration (or was relabelled as one), else 0.0.
    real: [B, T*D] 0.0 where a number of the action only fills the sequence and is not learned from, else 1.0; None: all
        count.
    """

    observation: Observation
    action: "Tensor"
    reward: "Tensor"
    discount: "Tensor"
    next_observation: Observation
    demo: "Tensor"
    real: "Tensor | None" = None

    def to(self, device: "torch.device | str") -> Self:
        """Return the same batch on `device`."""
        return type(self)(
            observation=self.observation.to(device),
            action=self.action.to(device, non_blocking=True),
            reward=self.reward.to(device, non_blocking=True),
            discount=self.discount.to(device, non_blocking=True),
            next_observation=self.next_observation.to(device),
            demo=self.demo.to(device, non_blocking=True),
            real=None if self.real is None else self.real.to(device, non_blocking=True),
        )


def read_history(folder: Path) -> list[dict[str, Any]]:
    """Operations in a dataset's ``meta/cqn_history.json``, oldest first; none where there is no such file.

    Raises:
        DataError: the file is damaged.
    """
    path = folder / HISTORY
    if not path.is_file():
        return []
    try:
        operations = json.loads(path.read_text())["operations"]
        return [dict(entry) for entry in operations]
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path} is damaged ({error!r}): mend it, or remove it to lose the history.") from error


def dimension_names(feature: Mapping[str, Any]) -> list[str]:
    """Names of a vector's dimensions, whichever way the recorder nested them; numbers where there are none.

    A name that several dimensions share is followed by their number, as in ``joint#2``.
    """
    names = _names(feature)
    if names is None:
        return [str(i) for i in range(prod(feature["shape"]))]
    return [n if names.count(n) == 1 else f"{n}#{i}" for i, n in enumerate(names)]


def opens_and_closes(name: str) -> bool:
    """Whether a dimension's name says that it is a gripper, jaws or fingers."""
    return any(part in name.lower() for part in ("grip", "jaw", "finger"))


def has_names(feature: Mapping[str, Any]) -> bool:
    """Whether the recorder named each dimension of a vector, no two alike."""
    names = _names(feature)
    return names is not None and len(set(names)) == len(names)


def _names(feature: Mapping[str, Any]) -> list[str] | None:
    """Names as recorded, in the order of the dimensions; None where there is not one for each."""

    def flat(names: Any) -> list[str]:
        if isinstance(names, str):
            return [names]
        if isinstance(names, Mapping):
            if names and all(isinstance(place, int) for place in names.values()):
                return sorted(names, key=lambda name: names[name])  # {"delta_x": 0, …}, as LeRobot's teleoperators
            return flat(list(names.values()))
        return [name for value in names for name in flat(value)] if isinstance(names, Sequence) else []

    names = flat(feature.get("names") or ())
    return names if len(names) == prod(feature["shape"]) else None
