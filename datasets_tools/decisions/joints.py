"""Dimensions of a state and an action: joints, grippers, rates; which belong together. Names in, numbers out."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from lerobot_cqn.errors import DataError
from lerobot_cqn.schema import ACTION, STATE, dimension_names, has_names

__all__ = ["Matched", "gripper_dims", "match_joints", "no_positions", "rate_dims"]

RATES = frozenset({"vel", "velocity", "velocities", "speed"})
NO_POSITIONS = RATES | {"delta", "torque", "effort", "force", "current"}


@dataclass(frozen=True)
class Matched:
    """Action dimensions that are joints and the state dimensions of the same joints.

    Attributes:
        action_dims, state_dims: (J,) numbers of dimensions, grippers and what is no position left out.
        by: "name", or "place" where the recording does not name them alike and they are taken to have one order.
        no_positions: names of the action dimensions left out since they are rates or differences.
    """

    action_dims: tuple[int, ...]
    state_dims: tuple[int, ...]
    by: Literal["name", "place"]
    no_positions: tuple[str, ...] = ()

    def remark(self) -> str:
        """A sentence for people where something was taken for granted; "" where nothing was."""
        said = []
        if self.by == "place" and self.action_dims:
            said.append(
                "State and action do not name their dimensions alike: they are matched by their place, the first with"
                " the first."
            )
        if self.no_positions:
            said.append(
                f"Left as they are, since their names say that they are no positions: {_few(self.no_positions)}."
            )
        return " ".join(said)


def gripper_dims(names: Sequence[str], chosen: Sequence[str] = ()) -> tuple[int, ...]:
    """Dimensions of the gripper: those ``chosen`` by name, else those with "gripper" in their name."""
    return tuple(i for i, n in enumerate(names) if (n in chosen if chosen else "gripper" in n.lower()))


def rate_dims(names: Sequence[str]) -> tuple[int, ...]:
    """Dimensions whose name says that they are velocities, such as ``x.vel``: constant while something moves."""
    return tuple(i for i, n in enumerate(names) if RATES & _words(n))


def no_positions(names: Sequence[str]) -> tuple[int, ...]:
    """Dimensions whose name says that they are no positions: velocities, forces, differences such as ``delta_x``."""
    return tuple(i for i, n in enumerate(names) if NO_POSITIONS & _words(n))


def match_joints(features: Mapping[str, Mapping[str, Any]], keep_absolute: Sequence[str] = ()) -> Matched:
    """Joints of the action with those of the state.

    By name where all names of the action's joints are names of the state; by place where both have the same number of
    dimensions and their names do not say otherwise. Left out are dimensions named in ``keep_absolute``, by default the
    gripper's, and those whose names say that they are no positions.

    Raises:
        DataError: neither names nor places fit.
    """
    for key in (STATE, ACTION):
        if key not in features:
            raise DataError(f"Expected a feature '{key}', found {', '.join(features)}.")
    states, actions = (dimension_names(features[k]) for k in (STATE, ACTION))
    others = no_positions(actions)
    left_out = {*gripper_dims(actions, keep_absolute), *others}
    joints = tuple(i for i in range(len(actions)) if i not in left_out)
    told = tuple(actions[i] for i in others)
    named = has_names(features[STATE]) and has_names(features[ACTION])
    if not joints or (named and all(actions[i] in states for i in joints)):
        return Matched(joints, tuple(states.index(actions[i]) for i in joints), "name", told)
    crossed = named and any(actions[i] in states for i in joints)
    if len(states) == len(actions) and not crossed:
        return Matched(joints, joints, "place", told)
    raise DataError(
        f"Cannot tell which state belongs to which action: {len(actions)} actions ({_few(actions)}),"
        f" {len(states)} states ({_few(states)}); expected the same names in both; correct 'names' in meta/info.json."
    )


def _words(name: str) -> set[str]:
    return set(re.split(r"[^a-z]+", name.lower()))


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:8]) + (", …" if len(names) > 8 else "")
