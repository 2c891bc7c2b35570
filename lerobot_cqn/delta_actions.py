"""Delta joint actions as a dataset's history describes them: which dimensions are differences, and of what.

The history has names, ``{"kind": …, "action": names, "state": names}``, which outlive a change of the columns; code has
numbers of dimensions. Light, so that commands can check options without loading PyTorch.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from .errors import DataError, one_of
from .schema import ACTION, HISTORY, STATE, dimension_names

__all__ = [
    "KINDS",
    "DeltaJoints",
    "Kind",
    "current_description",
    "description",
    "origin_of",
    "parse",
    "recorded_deltas",
]

Kind = Literal["command", "command_steps", "state"]
KINDS: tuple[str, ...] = get_args(Kind)

type Features = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class DeltaJoints:
    """Action dimensions (J,) that are differences, and the state dimensions (J,) of the same joints.

    kind: of a goal from the measured joints ("command", and "state", which is driven in the same way), or from the goal
        before ("command_steps").
    Raises DataError for an unknown kind, or where the two differ in number.
    """

    kind: Kind
    action_dims: tuple[int, ...]
    state_dims: tuple[int, ...]

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise DataError(one_of("kind of delta action", str(self.kind), KINDS))
        if len(self.action_dims) != len(self.state_dims):
            raise DataError(
                f"Delta actions: expected a state for each joint, found {len(self.action_dims)} action and "
                f"{len(self.state_dims)} state dimensions; write the dataset anew with `cqn-data delta`."
            )


def description(deltas: DeltaJoints, features: Features) -> dict[str, Any]:
    """Deltas by the names of their dimensions, as the history keeps them; inverse of `parse`.

    features: LeRobot's. Where there is no action yet, its dimensions are those of the state.
    """
    states = dimension_names(features[STATE])
    actions = dimension_names(features.get(ACTION, features[STATE]))
    return {
        "kind": deltas.kind,
        "action": [actions[i] for i in deltas.action_dims],
        "state": [states[i] for i in deltas.state_dims],
    }


def current_description(history: Sequence[Mapping[str, Any]]) -> Any:
    """The newest description of the actions in a history; None where they are absolute, or nothing is said of them."""
    return next((entry["deltas"] for entry in reversed(history) if "deltas" in entry), None) or None


def origin_of(history: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """The entry of a history that says how the actions came about, through merges; None where none does."""
    for entry in history:
        if entry.get("operation") in ("record", "convert"):
            return entry
        if entry.get("operation") == "merge":
            return origin_of(entry["sources"][0]["history"])
    return None


def recorded_deltas(history: Sequence[Mapping[str, Any]]) -> Any:
    """Description of the differences that were recorded, and that the environment takes; None: goals, or not known."""
    origin = origin_of(history)
    return origin.get("deltas") or None if origin is not None and origin["operation"] == "record" else None


def parse(described: Any, features: Features, root: Path) -> DeltaJoints:
    """Deltas from their description in the history of the dataset at `root`, which has these LeRobot features.

    Raises DataError for an unknown kind, or names of dimensions which the features do not have.
    """
    try:
        actions, states = (dimension_names(features[key]) for key in (ACTION, STATE))
        return DeltaJoints(
            described["kind"],
            tuple(actions.index(name) for name in described["action"]),
            tuple(states.index(name) for name in described["state"]),
        )
    except (KeyError, ValueError, TypeError) as error:
        raise DataError(
            f"{root / HISTORY} does not fit the features ({error!r}): expected names of action and state dimensions; "
            "write the dataset anew with `cqn-data delta`."
        ) from error
