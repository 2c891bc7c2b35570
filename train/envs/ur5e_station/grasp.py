"""Moves that tasks share: going down on a point from above, and closing the fingers around something."""

import numpy as np
from numpy.typing import NDArray

from .task import Goal
from .ur5e import Arm

__all__ = ["SPEED", "funnel", "grasp"]

Array = NDArray[np.float64]

SPEED = 0.20  # m/s, through free space
_CAREFUL = 0.12  # m/s, next to an object
_ALIGNED = 0.010  # m beside the point: close enough to go down
_REACHED = 0.012  # m above the point: close enough to close the fingers
_CLOSING = 0.25  # of the measured closure: the fingers are on their way
_BEYOND = 0.012  # m below the point: aimed at, so as not to slow down before it
_STEEP = 4.0  # m of height for each m aside


def funnel(aside: float, hover: float) -> float:
    """Height to keep above a point, 0 to `hover` m, while the tip is `aside` m beside it: it sinks as it lines up."""
    return float(np.clip(_STEEP * (aside - _ALIGNED) / hover, 0.0, 1.0)) * hover


def grasp(arm: Arm, point: Array, hover: float, yaw: float = 0.0, pitch: float = 0.0, moment: int = 1) -> Goal:
    """Open the fingers, go down around `point` from above, close; what follows starts when they are closed.

    Args:
        arm: the arm, at any place.
        point: of the fingertips when they close, (3,) m.
        hover: height above `point` that clears the object, m.
        yaw: as in `Goal`.
        pitch: as in `Goal`.
        moment: number of the natural pause before going down.
    """
    tip = arm.tip
    aside = float(np.linalg.norm(point[:2] - tip[:2]))
    above = float(tip[2] - point[2])
    # Fingers that touch push the object or the tip a little; closing goes on all the same.
    slack = 2.0 if arm.closure > _CLOSING else 1.0
    if aside < slack * _ALIGNED and above < slack * _REACHED:
        return Goal(tip=point, closure=1.0, speed=_CAREFUL, yaw=yaw, pitch=pitch, hesitate=moment)
    near = float(np.clip((above + aside) / 0.15, 0.0, 1.0))
    return Goal(
        tip=point + np.array([0.0, 0.0, funnel(aside, hover) - _BEYOND]),
        closure=0.0,
        speed=_CAREFUL + (SPEED - _CAREFUL) * near,
        yaw=yaw,
        pitch=pitch,
        hesitate=moment if aside < 0.03 else moment - 1,
    )
