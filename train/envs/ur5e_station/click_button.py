"""Click a button with the closed gripper; the button stands anywhere within 38 x 38 cm."""

import numpy as np
from numpy.typing import NDArray

from .task import Goal, Task
from .ur5e import Arm

__all__ = ["ClickButton"]

Array = NDArray[np.float64]

_CENTRE = np.array([0.48, 0.0])  # m
_HALF_RANGE = 0.19  # m, half of the paper's 38 cm
_TRAVEL = 0.018  # m, of the plunger
_PRESSED = 0.010  # m, counts as a click
_AT_BUTTON = 0.045  # m from the plunger's top to the fingertips, at most, when it is they that push
_HOVER = 0.09  # m above the plunger: where an operator lines up
_ALIGNED = 0.010  # m beside the axis: close enough to go down


class ClickButton(Task):
    """A red plunger on a spring in a yellow box; success is a plunger pushed 1 cm down."""

    name = "click_button"
    description = "Press the red button with the closed gripper."
    max_episode_steps = 100
    typical_steps = 28
    state_names = ("button.x", "button.y", "button.z")

    def mjcf(self) -> str:
        """A box fixed to the table and a plunger on a sprung slide joint."""
        return f"""
        <worldbody>
          <body name="button" pos=".48 0 0">
            <geom type="box" pos="0 0 .019" size=".046 .046 .019" rgba=".95 .80 .10 1"
              contype="2" conaffinity="0"/>
            <geom type="cylinder" fromto="0 0 .038 0 0 .041" size=".036" rgba=".20 .20 .20 1"
              contype="0" conaffinity="0"/>
            <body name="plunger" pos="0 0 .038" gravcomp="1">
              <joint name="plunger" type="slide" axis="0 0 -1" range="0 {_TRAVEL}" stiffness="350"
                springref="-.004" damping="6" armature=".02"/>
              <geom type="cylinder" fromto="0 0 -.006 0 0 .026" size=".029" mass=".04"
                rgba=".88 .07 .08 1" contype="2" conaffinity="0"/>
              <site name="button" pos="0 0 .026" size=".002" rgba="0 0 0 0"/>
            </body>
          </body>
        </worldbody>"""

    def reset(self, arm: Arm, rng: np.random.Generator) -> None:
        """The box is placed uniformly in the 38 x 38 cm square."""
        arm.model.body("button").pos[:2] = _CENTRE + rng.uniform(-_HALF_RANGE, _HALF_RANGE, 2)

    def state(self, arm: Arm) -> Array:
        """Top of the plunger, (3,) m; the policy has to find the way there from its joints."""
        return _top(arm)

    def success(self, arm: Arm) -> bool:
        """The plunger is 1 cm down, and it is the closed fingertips that push it."""
        pressed = bool(arm.data.joint("plunger").qpos[0] >= _PRESSED)
        # A forearm swept over the table can hit the button too; that is not the task.
        return pressed and arm.closure > 0.5 and float(np.linalg.norm(_top(arm) - arm.tip)) < _AT_BUTTON

    def goal(self, arm: Arm) -> Goal:
        """Towards a point above the button that sinks as the tip lines up: one smooth funnel, no phases."""
        button, tip = _top(arm), arm.tip
        aside = float(np.linalg.norm(button[:2] - tip[:2]))
        above = float(tip[2] - button[2])
        height = float(np.clip(4.0 * (aside - _ALIGNED), 0.0, 1.0)) * _HOVER
        ready = aside < _ALIGNED and arm.closure > 0.9
        if ready:
            height = -0.03  # below the plunger's end, so the approach never slows down before the click
        elif aside < _ALIGNED:
            height = _HOVER / 2  # closing the fingers comes first
        near = float(np.clip(above / 0.06, 0.0, 1.0)) if ready else 1.0
        return Goal(
            tip=np.array([button[0], button[1], button[2] + height]),
            # The fingers close on the way in; far away they stay open.
            closure=1.0 if aside < 0.12 else 0.0,
            speed=0.08 + 0.07 * near,
            hesitate=int(aside < 0.03),
        )


def _top(arm: Arm) -> Array:
    return np.array(arm.data.site("button").xpos)
