"""Take the lid off a saucepan by its knob; the saucepan stands anywhere within 38 x 38 cm."""

import numpy as np
from numpy.typing import NDArray

from .grasp import SPEED, grasp
from .task import Goal, Task
from .ur5e import Arm

__all__ = ["TakeLidOffSaucepan"]

Array = NDArray[np.float64]

_CENTRE = np.array([0.48, 0.0])  # m
_HALF_RANGE = 0.19  # m, half of the paper's 38 cm
_RIM = 0.072  # m, height of the saucepan, on which the lid rests
_LIFTED = 0.08  # m above the rim: the lid is off
_KNOB = 0.028  # m above the lid's underside: middle of the knob
_BELOW_KNOB = 0.012  # m below it: where the fingertips close
_HELD = 0.76  # closure; the pads meet the knob at 0.77


class TakeLidOffSaucepan(Task):
    """A saucepan fixed to the table and a loose lid with a knob; success is a lid held 8 cm above the rim."""

    name = "take_lid_off_saucepan"
    description = "Take the lid off the saucepan."
    max_episode_steps = 120
    typical_steps = 24
    state_names = ("knob.x", "knob.y", "knob.z")

    def mjcf(self) -> str:
        """The lid lies on four small spheres in the rim: fewer contacts than a wall has."""
        wall = "\n".join(
            f'<geom type="box" pos="{0.074 * np.cos(a):.4f} {0.074 * np.sin(a):.4f} .036" size=".003 .0152 .036"'
            f' euler="0 0 {a:.4f}" rgba=".80 .16 .12 1" contype="2" conaffinity="0"/>'
            for a in np.arange(16) * np.pi / 8
        )
        rests = "\n".join(
            f'<geom type="sphere" pos="{0.072 * np.cos(a):.4f} {0.072 * np.sin(a):.4f} {_RIM - 0.004}" size=".004"'
            f' group="3" contype="4" conaffinity="0"/>'
            for a in np.pi / 4 + np.arange(4) * np.pi / 2
        )
        return f"""
        <worldbody>
          <body name="saucepan" pos=".48 0 0">
            <geom type="cylinder" pos="0 0 .004" size=".075 .004" rgba=".30 .30 .32 1" contype="0" conaffinity="0"/>
            {wall}
            {rests}
            <geom type="capsule" fromto="0 -.08 .055 0 -.20 .062" size=".011" rgba=".12 .12 .13 1"
              contype="2" conaffinity="0"/>
          </body>
          <body name="lid" pos=".48 0 {_RIM}">
            <freejoint name="lid"/>
            <inertial pos="0 0 .006" mass=".20" diaginertia=".0003 .0003 .0006"/>
            <geom type="cylinder" pos="0 0 .003" size=".080 .003" rgba=".62 .66 .70 1" contype="2" conaffinity="5"/>
            <geom type="cylinder" pos="0 0 .008" size=".055 .003" rgba=".70 .74 .78 1" contype="0" conaffinity="0"
              mass="0"/>
            <geom type="capsule" fromto="0 0 .018 0 0 {2 * _KNOB - 0.018}" size=".016" rgba=".10 .10 .11 1"
              contype="2" conaffinity="1"/>
            <site name="knob" pos="0 0 {_KNOB}" size=".002" rgba="0 0 0 0"/>
          </body>
        </worldbody>"""

    def reset(self, arm: Arm, rng: np.random.Generator) -> None:
        """Saucepan and lid are placed uniformly in the 38 x 38 cm square."""
        place = _CENTRE + rng.uniform(-_HALF_RANGE, _HALF_RANGE, 2)
        arm.model.body("saucepan").pos[:2] = place
        arm.data.joint("lid").qpos[:2] = place

    def state(self, arm: Arm) -> Array:
        """Middle of the lid's knob, (3,) m."""
        return _knob(arm)

    def success(self, arm: Arm) -> bool:
        """The lid is 8 cm above the rim: nothing but a lift brings it there."""
        return bool(_knob(arm)[2] - _KNOB > _RIM + _LIFTED)

    def goal(self, arm: Arm) -> Goal:
        """Down around the knob, close, and up."""
        point = _knob(arm) - np.array([0.0, 0.0, _BELOW_KNOB])
        held = arm.closure > _HELD and float(np.linalg.norm(point - arm.tip)) < 0.03
        if held:
            up = np.array([0.0, 0.0, _RIM + _LIFTED + 0.10 - point[2]])  # beyond, so as not to slow down before it
            return Goal(tip=arm.tip + up, closure=1.0, speed=SPEED, hesitate=1)
        return grasp(arm, point, hover=0.06)


def _knob(arm: Arm) -> Array:
    return np.array(arm.data.site("knob").xpos)
