"""Open a drawer by its handle and put a teddy into it; the teddy lies anywhere within a circle of 10 cm radius."""

import numpy as np
from numpy.typing import NDArray

from .grasp import SPEED, funnel, grasp
from .task import Goal, Task
from .ur5e import Arm

__all__ = ["OpenDrawerPutTeddy"]

Array = NDArray[np.float64]

_FRONT = np.array([0.64, 0.15])  # m, the middle of the cabinet's front, which faces the arm
_AJAR = 0.02  # m, how far the drawer is open at the start
_TRAVEL = 0.18  # m, of the drawer
_PULLED = 0.17  # m: the operator lets go
_OPEN = 0.16  # m: fully open
_DEPTH = 0.19  # m, outside length of the drawer
_HALF_WIDTH = 0.088  # m, of its inside
_INSIDE = 0.055  # m above the table, well below the drawer's brim at 0.085
_HOOK_DEPTH = 0.030  # m above the table: the fingertips behind the handle, whose bar is at 0.05
_CLEAR = 0.115  # m above the table: fingertips over handle and drawer
_CARRY = 0.04  # m more, on the way to the drawer
_TEDDY_CENTRE = np.array([0.45, -0.19])  # m
_TEDDY_RADIUS = 0.10  # m, as in the paper
_LYING = 0.022  # m, height of the teddy's middle on the table
_PAST = 0.012  # m that the fingertips reach below its middle
_HELD = 0.62  # closure; the pads meet the belly at 0.69


class OpenDrawerPutTeddy(Task):
    """A drawer that stands ajar and a teddy beside it; success is a teddy in the fully open drawer."""

    name = "open_drawer_put_teddy"
    description = "Open the drawer and put the teddy bear into it."
    max_episode_steps = 400
    typical_steps = 80
    natural_pauses = 3  # before hooking the handle, before grasping the teddy, before letting go of it
    state_names = ("drawer.opening", "teddy.x", "teddy.y", "teddy.z")

    def mjcf(self) -> str:
        """Contact bit 8 is between teddy and furniture; the teddy's limbs do not meet the fingers."""
        wood, light, handle = 'rgba=".62 .40 .20 1"', 'rgba=".93 .76 .48 1"', 'rgba=".10 .10 .11 1"'
        brown, beige = 'rgba=".47 .25 .09 1"', 'rgba=".80 .62 .40 1" mass="0" contype="0" conaffinity="0"'
        fixed, limb = 'contype="10" conaffinity="0"', f'contype="0" conaffinity="9" {brown}'
        return f"""
        <worldbody>
          <body name="cabinet" pos="{_FRONT[0]} {_FRONT[1]} 0">
            <geom type="box" pos=".11 0 .098" size=".11 .106 .006" {wood} {fixed}/>
            <geom type="box" pos=".11 .101 .046" size=".11 .005 .046" {wood} {fixed}/>
            <geom type="box" pos=".11 -.101 .046" size=".11 .005 .046" {wood} {fixed}/>
            <geom type="box" pos=".215 0 .046" size=".005 .096 .046" {wood} {fixed}/>
            <body name="drawer" gravcomp="1">
              <joint name="drawer" type="slide" axis="-1 0 0" range="0 {_TRAVEL}" damping="6" frictionloss="2"
                armature=".1"/>
              <geom type="box" pos=".006 0 .046" size=".006 .094 .039" mass=".2" {light} {fixed}/>
              <geom type="box" pos=".10 0 .009" size=".09 .092 .003" mass=".2" {light} {fixed}/>
              <geom type="box" pos=".10 .091 .041" size=".09 .003 .030" mass=".1" {light} {fixed}/>
              <geom type="box" pos=".10 -.091 .041" size=".09 .003 .030" mass=".1" {light} {fixed}/>
              <geom type="box" pos=".187 0 .041" size=".003 .091 .030" mass=".1" {light} {fixed}/>
              <geom type="capsule" fromto="-.06 -.05 .05 -.06 .05 .05" size=".006" mass=".05" {handle} contype="2"
                conaffinity="0"/>
              <geom type="capsule" fromto="-.06 -.05 .05 0 -.05 .05" size=".006" mass=".02" {handle} contype="2"
                conaffinity="0"/>
              <geom type="capsule" fromto="-.06 .05 .05 0 .05 .05" size=".006" mass=".02" {handle} contype="2"
                conaffinity="0"/>
              <site name="hook" pos="-.027 0 {_HOOK_DEPTH}" size=".002" rgba="0 0 0 0"/>
              <site name="inside" pos=".092 0 {_CLEAR}" size=".002" rgba="0 0 0 0"/>
            </body>
          </body>
          <body name="teddy" pos=".45 -.19 {_LYING}">
            <freejoint name="teddy"/>
            <geom type="capsule" fromto="-.018 0 0 .018 0 0" size=".022" mass=".04" {brown} contype="2"
              conaffinity="9"/>
            <geom type="sphere" pos=".050 0 0" size=".021" mass=".015" {limb}/>
            <geom type="sphere" pos=".058 .015 .010" size=".008" mass="0" {limb}/>
            <geom type="sphere" pos=".058 -.015 .010" size=".008" mass="0" {limb}/>
            <geom type="sphere" pos=".052 0 .016" size=".010" {beige}/>
            <geom type="sphere" pos="0 0 .006" size=".0175" {beige}/>
            <geom type="capsule" fromto=".024 .018 -.012 .030 .044 -.012" size=".010" mass=".005" {limb}/>
            <geom type="capsule" fromto=".024 -.018 -.012 .030 -.044 -.012" size=".010" mass=".005" {limb}/>
            <geom type="capsule" fromto="-.026 .012 -.011 -.048 .026 -.011" size=".011" mass=".007" {limb}/>
            <geom type="capsule" fromto="-.026 -.012 -.011 -.048 -.026 -.011" size=".011" mass=".007" {limb}/>
            <site name="teddy" size=".002" rgba="0 0 0 0"/>
          </body>
        </worldbody>"""

    def reset(self, arm: Arm, rng: np.random.Generator) -> None:
        """The teddy is placed uniformly in the circle; the drawer is 2 cm open."""
        angle, radius = rng.uniform(-np.pi, np.pi), _TEDDY_RADIUS * np.sqrt(rng.uniform())
        arm.data.joint("teddy").qpos[:2] = _TEDDY_CENTRE + radius * np.array([np.cos(angle), np.sin(angle)])
        arm.data.joint("drawer").qpos[0] = _AJAR

    def state(self, arm: Arm) -> Array:
        """Opening of the drawer, m, and the teddy's middle, (3,) m."""
        return np.append(_opening(arm), _teddy(arm))

    def success(self, arm: Arm) -> bool:
        """The drawer is open by 16 of its 18 cm, and the teddy is below its brim between its walls."""
        ahead, aside = (_teddy(arm)[:2] - _FRONT) + np.array([_opening(arm), 0.0])
        inside = 0.0 < ahead < _DEPTH and abs(aside) < _HALF_WIDTH and _teddy(arm)[2] < _INSIDE
        return bool(_opening(arm) > _OPEN and inside)

    def goal(self, arm: Arm) -> Goal:
        """Hook the handle with closed fingers and pull; grasp the teddy; carry it over the drawer; let go."""
        tip, teddy = arm.tip, _teddy(arm)
        if _opening(arm) < _PULLED:
            return _pull(arm)
        if arm.closure > _HELD and float(np.linalg.norm(teddy - tip)) < 0.04:
            return _carry(arm)
        hook = np.array(arm.data.site("hook").xpos)
        if arm.closure > 0.5 and float(np.linalg.norm(hook[:2] - tip[:2])) < 0.06 and tip[2] < _CLEAR:
            # Straight out of the handle; only then do the fingers open.
            return Goal(tip=np.append(hook[:2], _CLEAR + 0.05), closure=1.0, speed=SPEED, hesitate=1)
        return grasp(arm, teddy - np.array([0.0, 0.0, _PAST]), hover=0.10, moment=2)


def _pull(arm: Arm) -> Goal:
    hook, tip = np.array(arm.data.site("hook").xpos), arm.tip
    aside = float(np.linalg.norm(hook[:2] - tip[:2]))
    if aside < 0.03 and tip[2] < hook[2] + 0.015:
        return Goal(tip=np.array([tip[0] - 0.2, hook[1], hook[2]]), closure=1.0, speed=0.15, hesitate=1)
    above = np.array([0.0, 0.0, funnel(aside, _CLEAR - hook[2]) - 0.01])
    return Goal(tip=hook + above, closure=1.0, speed=SPEED if aside > 0.03 else 0.15, hesitate=int(aside < 0.03))


def _carry(arm: Arm) -> Goal:
    inside, tip = np.array(arm.data.site("inside").xpos), arm.tip
    aside = float(np.linalg.norm(inside[:2] - tip[:2]))
    if aside < 0.02 and tip[2] < inside[2] + 0.02:
        return Goal(tip=inside, closure=0.0, speed=SPEED, hesitate=3)
    high = inside + np.array([0.0, 0.0, funnel(aside, _CARRY) - 0.01])
    # Up first: sideways as the teddy comes over the drawer's brim.
    sideways = float(np.clip((tip[2] - 0.04) / 0.06, 0.0, 1.0))
    high[:2] = tip[:2] + sideways * (high[:2] - tip[:2])
    return Goal(tip=high, closure=1.0, speed=SPEED, hesitate=3 if aside < 0.04 else 2)


def _opening(arm: Arm) -> float:
    return float(arm.data.joint("drawer").qpos[0])


def _teddy(arm: Arm) -> Array:
    return np.array(arm.data.site("teddy").xpos)
