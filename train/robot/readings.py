"""Which readings of a robot are believed: what is in them, and where its joints can be. No device and no time in it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from lerobot.robots.robot import Robot
from numpy.typing import NDArray

from lerobot_cqn.errors import CQNError

from .limits import Limits

__all__ = [
    "Agreement",
    "Contents",
    "LateReadingError",
    "LostError",
    "Reading",
    "RobotFault",
    "Whereabouts",
    "WrongReadingError",
]

Array = NDArray[np.float64]
Pictures = Mapping[str, NDArray[np.uint8]]
START_STEPS = 5  # and no less than the joint's whole range: how far outside of it an arm may be found at the start
AGREEING = 3  # readings in a row that say the same: where nothing is known yet, one alone proves nothing


class RobotFault(CQNError, RuntimeError):  # noqa: N818  # what people call it
    """The robot cannot be read or moved, or what it says cannot be true; the arm is held where that is possible."""

    def __init__(self, text: str) -> None:
        super().__init__(" ".join(text.split()))  # drivers' errors have many lines


class LostError(RobotFault):
    """The driver says that the robot cannot be read: it is gone, or a part of it."""


class LateReadingError(RobotFault):
    """A reading that took too long to be where the arm is now."""


class WrongReadingError(RobotFault):
    """A reading that arrived and cannot be true; the next one may be."""


@dataclass(frozen=True, kw_only=True)
class Reading:
    """One observation: joints [D] in the robot's units, pictures by name, everything the robot gave, and when.

    at: seconds of the clock when it was asked for: what it says may be as old as that.
    """

    joints: Array
    pictures: Pictures
    raw: Mapping[str, Any]
    at: float


class Contents:
    """What a robot's reading must hold: its joints, its other numbers, and pictures of the shapes it promises."""

    def __init__(self, robot: Robot) -> None:
        features = robot.observation_features
        self._joints = tuple(robot.action_features)
        others = (name for name, kind in features.items() if kind is float and name not in self._joints)
        self._numbers = (*self._joints, *others)
        self._shapes = {name: kind for name, kind in features.items() if isinstance(kind, tuple)}

    def take(self, raw: Mapping[str, Any], at: float) -> Reading:
        """The reading in what the driver returned. Raises WrongReadingError for what is missing or cannot be true."""
        for name in (*self._numbers, *self._shapes):
            if name not in raw:
                raise WrongReadingError(f"The robot cannot be read: it gives no '{name}'. Check cables and power.")
        for name in self._numbers:
            _check_number(name, raw[name], "joint" if name in self._joints else "value")
        pictures = {name: _picture(name, raw[name], shape) for name, shape in self._shapes.items()}
        return Reading(joints=np.array([float(raw[name]) for name in self._joints]), pictures=pictures, raw=raw, at=at)


def _check_number(name: str, value: Any, what: str) -> None:
    try:
        finite = bool(np.isfinite(float(value)))
    except (TypeError, ValueError, OverflowError):
        finite = False
    if not finite:
        raise WrongReadingError(
            f"The {what} '{name}' reads {str(value)[:40]}: expected a finite number; check its sensor."
        )


def _picture(name: str, value: Any, shape: tuple[int | None, ...]) -> NDArray[np.uint8]:
    """A camera's picture of the shape that is promised; None in it is any size."""
    found = np.asarray(value)
    fits = found.ndim == len(shape) and all(want in (None, size) for want, size in zip(shape, found.shape, strict=True))
    if not fits or found.dtype != np.uint8:
        raise WrongReadingError(
            f"The camera '{name}' gives {found.dtype} {found.shape}: expected uint8 {shape}, as in the demonstrations; "
            "check its settings."
        )
    return found


class Whereabouts:
    """Where each joint [D] can be: between the reading that was believed last and the goals that were sent since.

    An arm that drives itself is nowhere else, however long ago that was, but for `slack`: what it overshoots, sags, or
    is pushed by hand between two readings.

    Attributes:
        slack: [D], a step; for a joint that hardly moved in the demonstrations the median of all steps.
        sure: the reading that was believed last, no farther than the joints can have driven themselves; None at first.
    """

    def __init__(self, names: tuple[str, ...], limits: Limits) -> None:
        self._names, self._limits = names, limits
        self.slack: Array = np.maximum(limits.max_step, np.median(limits.max_step))
        self.sure: Array | None = None
        self._low: Array = np.zeros(len(names))
        self._high: Array = self._low
        self._last: Array = self._low

    def begin(self, joints: Array) -> None:
        """The arm is here, whatever was believed before."""
        self.sure = self._last = self._low = self._high = joints

    def sent(self, goal: Array) -> None:
        """A goal is on its way: the joints may be anywhere up to it."""
        self._low, self._high = np.minimum(self._low, goal), np.maximum(self._high, goal)

    def check(self, joints: Array) -> None:
        """Raises WrongReadingError for joints farther from where they were than they can move."""
        far = np.flatnonzero((joints < self._low - self.slack) | (joints > self._high + self.slack))
        if len(far):
            i = int(far[0])
            raise WrongReadingError(
                f"The joint '{self._names[i]}' reads {joints[i]:g} and read {self._last[i]:g} just before: farther "
                "than it can move. Its sensor is wrong, or the arm was knocked."
            )

    def believe(self, joints: Array, goal: Array) -> None:
        """Take up a reading that `check` let pass; goal: the one that the arm has."""
        self.sure = np.clip(joints, self._low, self._high)
        self._last = joints
        self._low, self._high = np.minimum(joints, goal), np.maximum(joints, goal)

    def check_start(self, joints: Array) -> None:
        """Raises RobotFault for an arm so far outside the demonstrated range that it may speak in other units."""
        low, high = self._limits.low, self._limits.high
        room = np.maximum(high - low, START_STEPS * self.slack)
        far = np.flatnonzero((joints < low - room) | (joints > high + room))
        if len(far):
            i = int(far[0])
            raise RobotFault(
                f"The joint '{self._names[i]}' reads {joints[i]:g}, far outside its range of {low[i]:g} to {high[i]:g} "
                f"(all joints read {joints.min():g} to {joints.max():g}, their ranges are {low.min():g} to "
                f"{high.max():g}): use the units and the calibration of the demonstrations, or bring the arm near to "
                "where they start."
            )

    def check_inside(self, joints: Array, goal: Array) -> None:
        """Raises RobotFault for joints beyond the limits, or beyond `goal` where that is farther out."""
        low, high = np.minimum(self._limits.low, goal), np.maximum(self._limits.high, goal)
        far = np.flatnonzero((joints < low - self.slack) | (joints > high + self.slack))
        if len(far):
            i = int(far[0])
            raise RobotFault(
                f"The joint '{self._names[i]}' is at {joints[i]:g}, its limits are {self._limits.low[i]:g} to "
                f"{self._limits.high[i]:g}: bring it back by hand, with the motors off, before it is held again."
            )


class Agreement:
    """Readings in a row that agree: what is asked where nothing tells yet where the arm can be."""

    def __init__(self, names: tuple[str, ...], tolerance: Array) -> None:
        self._names, self._tolerance = names, tolerance
        self._readings: list[Reading] = []
        self.doubt = "no reading arrived"

    def add(self, reading: Reading) -> Reading | None:
        """The reading, with the medians of those that agree as its joints, once AGREEING do; None until then."""
        self._readings = [other for other in self._readings if self._agree(other, reading)] + [reading]
        if len(self._readings) < AGREEING:
            return None
        return replace(reading, joints=np.median([one.joints for one in self._readings], axis=0))

    def _agree(self, one: Reading, other: Reading) -> bool:
        apart = np.abs(one.joints - other.joints)
        if (apart <= self._tolerance).all():
            return True
        i = int(np.argmax(apart / self._tolerance))
        self.doubt = f"'{self._names[i]}' read {one.joints[i]:g}, then {other.joints[i]:g}"
        return False
