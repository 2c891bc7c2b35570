"""Stand a lying wine glass up by its stem; it lies anywhere within 15 x 30 cm."""

import numpy as np
from numpy.typing import NDArray

from .grasp import SPEED, grasp
from .task import Goal, Task
from .ur5e import Arm

__all__ = ["FlipCup"]

Array = NDArray[np.float64]

_CENTRE = np.array([0.37, 0.0])  # m, of the place to grasp
_HALF_RANGE = np.array([0.075, 0.15])  # m, half of the paper's 15 x 30 cm
_GRIP = 0.055  # m along the axis from the foot: where the stem is grasped
_FOOT = 0.036  # m, radius of the foot
_LYING = 0.0336  # m, height of the axis while the glass lies on its foot and its brim
_PAST = 0.020  # m that the fingertips reach past the stem
_LEAN = -np.pi / 6  # rad, pitch of the grasp: 60 degrees when the glass stands, which keeps the wrist off the table
_HELD = 0.885  # closure; the pads meet the stem at 0.90
_CLEAR = 0.030  # m above the table: the foot while it turns
_UPRIGHT = np.cos(np.radians(6.0))  # of the axis: it stands when let go
_STANDING = 0.005  # m, height of the foot's middle


class FlipCup(Task):
    """A plastic wine glass on its side; success is a glass that stands on its foot."""

    name = "flip_cup"
    description = "Grasp the wine glass by its stem and stand it upright."
    max_episode_steps = 250
    typical_steps = 48
    natural_pauses = 2  # before grasping, before setting down
    state_names = ("stem.x", "stem.y", "stem.z", "axis.x", "axis.y", "axis.z")

    def mjcf(self) -> str:
        """Foot and brim meet the table with a ring of unseen small spheres: few contacts, and it does not roll."""
        ring = "\n".join(
            f'<geom type="sphere" pos="{radius * np.cos(a):.4f} {radius * np.sin(a):.4f} {z}" size=".004"'
            f' mass="0" group="3" contype="0" conaffinity="1"/>'
            for radius, z in ((_FOOT - 0.004, 0.004), (_FOOT - 0.006, 0.161))
            for a in np.arange(8) * np.pi / 4 + np.pi / 8
        )
        return f"""
        <worldbody>
          <body name="glass" pos=".42 0 {_LYING}" euler="0 -1.5708 0">
            <freejoint name="glass"/>
            <inertial pos="0 0 .085" mass=".06" diaginertia=".00018 .00018 .00005"/>
            {ring}
            <geom type="cylinder" pos="0 0 .003" size="{_FOOT} .003" rgba=".25 .62 .90 1" contype="0"
              conaffinity="0"/>
            <geom type="capsule" fromto="0 0 .008 0 0 .096" size=".007" rgba=".30 .68 .95 1" contype="2"
              conaffinity="0"/>
            <geom type="capsule" fromto="0 0 .112 0 0 .135" size=".028" group="3" contype="2" conaffinity="0"/>
            <geom type="cylinder" fromto="0 0 .100 0 0 .165" size=".034" rgba=".36 .72 .98 1" contype="0"
              conaffinity="0"/>
            <geom type="cylinder" fromto="0 0 .165 0 0 .1655" size=".030" rgba=".08 .22 .42 1" contype="0"
              conaffinity="0"/>
            <site name="stem" pos="0 0 {_GRIP}" size=".002" rgba="0 0 0 0"/>
          </body>
        </worldbody>"""

    def reset(self, arm: Arm, rng: np.random.Generator) -> None:
        """The glass lies with its brim towards the arm; its stem is uniformly in a rectangle of 15 x 30 cm."""
        place = _CENTRE + rng.uniform(-_HALF_RANGE, _HALF_RANGE)
        arm.data.joint("glass").qpos[:2] = place + np.array([_GRIP, 0.0])

    def state(self, arm: Arm) -> Array:
        """Place to grasp on the stem, (3,) m, and direction from foot to brim, (3,) of length 1."""
        return np.concatenate([_stem(arm), _axis(arm)])

    def success(self, arm: Arm) -> bool:
        """The axis is within 6 degrees of upright and the foot is on the table."""
        foot = _stem(arm)[2] - _GRIP * _axis(arm)[2]
        return bool(_axis(arm)[2] > _UPRIGHT and foot < _STANDING)

    def goal(self, arm: Arm) -> Goal:
        """Grasp the stem from above, turn in the air by what the glass lacks, and set it down."""
        stem, axis, pointing = _stem(arm), _axis(arm), arm.tip_rotation[:, 2]
        if not (arm.closure > _HELD and float(np.linalg.norm(stem + _PAST * pointing - arm.tip)) < 0.03):
            reach = _PAST * np.array([-np.sin(_LEAN), 0.0, -np.cos(_LEAN)])
            return grasp(arm, stem + reach, hover=0.08, pitch=_LEAN)
        tilt = float(np.arctan2(-axis[0], axis[2]))
        pitch = float(np.arctan2(-pointing[0], -pointing[2]))
        # The foot's rim is the lowest point while the glass turns.
        lowest = float(stem[2]) - _GRIP * np.cos(tilt) - _FOOT * abs(np.sin(tilt))
        upright = abs(tilt) < 0.06
        rise = (-0.03 if upright else _CLEAR) - lowest
        free = float(np.clip(lowest / 0.015, 0.0, 1.0))
        return Goal(
            tip=arm.tip + np.array([0.0, 0.0, rise]),
            closure=1.0,
            speed=0.12 if upright else SPEED,
            pitch=pitch + tilt * (1.0 if upright else free),
            hesitate=2 if upright else 1,
        )


def _stem(arm: Arm) -> Array:
    return np.array(arm.data.site("stem").xpos)


def _axis(arm: Arm) -> Array:
    return np.array(arm.data.site("stem").xmat[[2, 5, 8]])
