"""Dimensions of a state and an action that are joints, grippers, and one another's. Names in, numbers out."""

from collections.abc import Mapping, Sequence
from typing import Any

from lerobot_cqn.errors import DataError
from lerobot_cqn.schema import ACTION, STATE, dimension_names

__all__ = ["gripper_dims", "match_joints"]


def gripper_dims(names: Sequence[str], chosen: Sequence[str] = ()) -> tuple[int, ...]:
    """Dimensions of the gripper: those ``chosen`` by name, else those with "gripper" in their name."""
    return tuple(i for i, n in enumerate(names) if (n in chosen if chosen else "gripper" in n.lower()))


def match_joints(
    features: Mapping[str, Mapping[str, Any]], keep_absolute: Sequence[str] = ()
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Action dimensions that are joints, (J,), and the (J,) state dimensions of the same joints.

    By name where all names of the action are names of the state, else by position where both have the same size.
    Dimensions named in ``keep_absolute``, by default the gripper's, are left out.

    Raises:
        DataError: neither names nor sizes fit.
    """
    for key in (STATE, ACTION):
        if key not in features:
            raise DataError(f"Expected a feature '{key}', found {', '.join(features)}.")
    states, actions = (dimension_names(features[k]) for k in (STATE, ACTION))
    left_out = gripper_dims(actions, keep_absolute)
    joints = tuple(i for i in range(len(actions)) if i not in left_out)
    if all(actions[i] in states for i in joints) and len(set(states)) == len(states):
        return joints, tuple(states.index(actions[i]) for i in joints)
    if len(states) == len(actions):
        return joints, joints
    raise DataError(
        f"Cannot tell which state belongs to which action: {len(actions)} actions ({', '.join(actions[:8])}, …),"
        f" {len(states)} states ({', '.join(states[:8])}, …); expected the same names or the same number."
    )
