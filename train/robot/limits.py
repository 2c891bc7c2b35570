"""Safety limits as pure functions: from a wanted goal to one that may be sent. Units are the robot's own."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import ConfigError

__all__ = ["Limits", "Verdict", "allowed_goal"]

Array = NDArray[np.float64]
Forward = Callable[[Array], Array]


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits that a goal keeps to; each array is [D], one value a joint in the robot's units.

    low, high: joint limits.
    max_step: largest distance of a goal from the measured joint.
    max_speed: largest change of the goal, units a second.
    box: corners (low, high) of the workspace, m, with `forward`: joints [D] -> tip [3] in m; None: no such check.

    Raises ConfigError when a range is empty, not finite, or a box has no kinematics.
    """

    low: Array
    high: Array
    max_step: Array
    max_speed: Array
    box: tuple[Array, Array] | None = None
    forward: Forward | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if not np.isfinite([self.low, self.high]).all() or (self.low > self.high).any():
            raise ConfigError(f"Joint limits must be finite and low <= high, got {self.low} to {self.high}.")
        if not (self.max_step > 0).all() or not (self.max_speed > 0).all():
            raise ConfigError(f"max_step and max_speed must be positive, got {self.max_step} and {self.max_speed}.")
        if self.box is not None and self.forward is None:
            raise ConfigError("A workspace box needs the arm's kinematics: give them, or leave out the box.")


@dataclass(frozen=True)
class Verdict:
    """A goal [D] that may be sent, and why it differs from the wanted one: names of limits, empty where it does not."""

    goal: Array
    reasons: tuple[str, ...] = ()


def allowed_goal(wanted: Array, measured: Array, last: Array, seconds: float, limits: Limits) -> Verdict:
    """The nearest goal to `wanted` that keeps to all limits.

    Args:
        wanted: goal [D] that is asked for.
        measured: joints [D] as read now, or [N, D], all the places where they may be.
        last: goal [D] that was sent last.
        seconds: since the last goal was sent, > 0.
        limits: what to keep to.

    A goal that is not finite, or whose tip would leave the box, is replaced by the last one: the arm holds. Where the
    last goal was beyond a joint limit, this one is not farther out. The speed limit comes last and holds whatever the
    others say, above all whatever the joints read; a goal is never more than `max_step` from the last one.
    """
    if not np.isfinite(wanted).all():
        return Verdict(last, ("not finite",))
    reasons, goal = [], wanted.astype(np.float64)
    places = np.atleast_2d(measured)
    nearest = places.max(axis=0) - limits.max_step, places.min(axis=0) + limits.max_step
    farthest = np.minimum(limits.max_speed * seconds, limits.max_step)
    steps = (
        ("step", np.minimum(*nearest), np.maximum(*nearest)),
        # An arm that was outside comes in at its speed, in no leap.
        ("joint limit", np.minimum(limits.low, last), np.maximum(limits.high, last)),
        ("speed", last - farthest, last + farthest),
    )
    for name, low, high in steps:
        bounded = np.clip(goal, low, high)
        if (bounded != goal).any():
            reasons.append(name)
        goal = bounded
    if limits.box is not None and limits.forward is not None:
        tip, (low, high) = limits.forward(goal), limits.box
        if (tip < low).any() or (tip > high).any():
            return Verdict(last, (*reasons, "workspace"))
    return Verdict(goal, tuple(reasons))
