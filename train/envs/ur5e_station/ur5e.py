"""A UR5e with a parallel gripper on a table: its MJCF and the handle through which tasks see it.

Kinematics are the published Denavit-Hartenberg parameters (metres): d1 .1625, a2 -.425, a3 -.3922, d4 .1333,
d5 .0997, d6 .0996, and the published link masses. Links are capsules and cylinders, no meshes. The base
stands at the world's origin and the arm faces +x; the table top is the plane z = 0.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..simulator import load_mujoco

__all__ = [
    "GRIPPER_TRAVEL",
    "HOME",
    "JOINTS",
    "LEAD_S",
    "STATE_NAMES",
    "TIMESTEP",
    "Arm",
    "station_mjcf",
]

Array = NDArray[np.float64]

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
STATE_NAMES = (*(f"{name}.pos" for name in JOINTS), "gripper.pos")
TIMESTEP = 0.004  # s, physics
_LEASH = 0.25  # rad, how far a command may run ahead of the measured joint
GRIPPER_TRAVEL = 0.07  # m, each finger
LEAD_S = 0.04  # s: actuator damping over stiffness; the command leads by this times its velocity
# The closed fingertips 0.38 m above the table's (0.48, 0), tool down, fingers opening along y (rad).
HOME = (-0.2814, -1.608, 1.3306, -1.2934, -1.5708, 1.2894)

# Contacts: the table and objects offer, the arm and gripper accept; so the arm never meets itself.
_TABLE = 'contype="1" conaffinity="0"'
_ARM = 'contype="0" conaffinity="3"'
_SEEN = 'contype="0" conaffinity="0" mass="0"'

_HEAD = f"""
<mujoco model="ur5e_station">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="{TIMESTEP}" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <statistic center=".4 0 .2" extent="1.5"/>
  <visual>
    <quality offsamples="0" shadowsize="0" numslices="16" numstacks="8" numquads="1"/>
    <global offwidth="1280" offheight="1280"/>
    <map znear="0.01" zfar="60"/>
    <headlight ambient=".40 .40 .40" diffuse=".25 .25 .25" specular="0 0 0"/>
  </visual>
  <asset>
    <material name="link" rgba=".80 .81 .83 1" specular=".3" shininess=".4"/>
    <material name="cap" rgba=".33 .58 .76 1" specular=".3" shininess=".4"/>
    <material name="joint" rgba=".27 .28 .30 1" specular=".2" shininess=".3"/>
    <material name="gripper" rgba=".15 .15 .17 1" specular=".3" shininess=".4"/>
    <material name="pad" rgba=".38 .39 .42 1" specular="0" shininess="0"/>
    <material name="table" rgba=".86 .82 .76 1" specular="0" shininess="0"/>
    <material name="mat" rgba=".78 .75 .70 1" specular="0" shininess="0"/>
    <material name="floor" rgba=".56 .60 .64 1" specular="0" shininess="0"/>
    <material name="leg" rgba=".42 .42 .44 1" specular="0" shininess="0"/>
  </asset>
  <worldbody>
    <light pos=".4 -1.2 2.2" dir="0 .5 -1" directional="true" castshadow="false" diffuse=".38 .38 .37"/>
    <light pos="1.6 1.0 2.0" dir="-.7 -.4 -.8" directional="true" castshadow="false" diffuse=".22 .22 .24"/>
    <geom name="floor" type="plane" pos="0 0 -.75" size="40 40 1" material="floor" {_SEEN}/>
    <geom name="table" type="box" pos=".42 0 -.02" size=".68 .62 .02" material="table" {_TABLE}/>
    <geom type="plane" pos=".48 0 .001" size=".25 .25 1" material="mat" {_SEEN}/>
    <geom type="box" pos="-.2 -.56 -.395" size=".03 .03 .355" material="leg" {_SEEN}/>
    <geom type="box" pos="-.2 .56 -.395" size=".03 .03 .355" material="leg" {_SEEN}/>
    <geom type="box" pos="1.04 -.56 -.395" size=".03 .03 .355" material="leg" {_SEEN}/>
    <geom type="box" pos="1.04 .56 -.395" size=".03 .03 .355" material="leg" {_SEEN}/>
    <camera name="left_shoulder" pos="{{left}}" xyaxes="{{left_axes}}" fovy="48"/>
    <camera name="right_shoulder" pos="{{right}}" xyaxes="{{right_axes}}" fovy="48"/>
    <camera name="overview" pos="{{overview}}" xyaxes="{{overview_axes}}" fovy="40"/>
"""

_ARM_TREE = f"""
    <body name="base" quat="0 0 0 1" gravcomp="1">
      <geom type="cylinder" fromto="0 0 0 0 0 .045" size=".078" material="joint" {_SEEN}/>
      <geom type="cylinder" fromto="0 0 .045 0 0 .10" size=".066" material="link" {_SEEN}/>
      <body name="shoulder" gravcomp="1">
        <inertial pos="0 -.02 .14" mass="3.761" diaginertia=".0103 .0103 .0067"/>
        <joint name="shoulder_pan" axis="0 0 1" class="big" range="-6.2832 6.2832"/>
        <geom type="capsule" fromto="0 0 .11 0 0 .1625" size=".062" material="link" {_SEEN}/>
        <geom type="cylinder" fromto="0 0 .1625 0 .079 .1625" size=".058" material="cap" {_SEEN}/>
        <body name="upper_arm" pos="0 0 .1625" quat=".70710678 .70710678 0 0" gravcomp="1">
          <inertial pos="-.2125 0 .11336" mass="8.058" diaginertia=".0151 .1339 .1339"/>
          <joint name="shoulder_lift" axis="0 0 1" class="big" range="-6.2832 6.2832"/>
          <geom type="cylinder" fromto="0 0 .06 0 0 .138" size=".060" material="joint" {_SEEN}/>
          <geom type="cylinder" fromto="0 0 .138 0 0 .200" size=".060" material="cap" {_SEEN}/>
          <geom type="capsule" fromto="0 0 .138 -.425 0 .138" size=".052" material="link" {_ARM}/>
          <geom type="cylinder" fromto="-.425 0 .138 -.425 0 .192" size=".054" material="cap" {_SEEN}/>
          <body name="forearm" pos="-.425 0 0" gravcomp="1">
            <inertial pos="-.15 0 .0265" mass="2.846" diaginertia=".0041 .0312 .0312"/>
            <joint name="elbow" axis="0 0 1" class="big" range="-3.1416 3.1416"/>
            <geom type="cylinder" fromto="0 0 .007 0 0 .10" size=".052" material="joint" {_SEEN}/>
            <geom type="cylinder" fromto="0 0 -.050 0 0 .007" size=".054" material="cap" {_SEEN}/>
            <geom type="capsule" fromto="0 0 .007 -.3922 0 .007" size=".043" material="link" {_ARM}/>
            <body name="wrist_1" pos="-.3922 0 0" gravcomp="1">
              <inertial pos="0 0 .11" mass="1.37" diaginertia=".0027 .0027 .0023"/>
              <joint name="wrist_1" axis="0 0 1" class="small" range="-6.2832 6.2832"/>
              <geom type="cylinder" fromto="0 0 -.042 0 0 .007" size=".043" material="cap" {_SEEN}/>
              <geom type="capsule" fromto="0 0 .05 0 0 .1333" size=".040" material="link" {_ARM}/>
              <geom type="cylinder" fromto="0 0 .04 0 0 .075" size=".042" material="joint" {_SEEN}/>
              <geom type="cylinder" fromto="0 0 .1333 0 0 .178" size=".041" material="cap" {_SEEN}/>
              <body name="wrist_2" pos="0 0 .1333" quat=".70710678 .70710678 0 0" gravcomp="1">
                <inertial pos="0 0 .085" mass="1.3" diaginertia=".0025 .0025 .0021"/>
                <joint name="wrist_2" axis="0 0 1" class="small" range="-6.2832 6.2832"/>
                <geom type="cylinder" fromto="0 0 .035 0 0 .060" size=".042" material="joint" {_SEEN}/>
                <geom type="capsule" fromto="0 0 .05 0 0 .0997" size=".040" material="link" {_ARM}/>
                <geom type="cylinder" fromto="0 0 .0997 0 0 .142" size=".041" material="cap" {_SEEN}/>
                <body name="wrist_3" pos="0 0 .0997" quat=".70710678 -.70710678 0 0" gravcomp="1">
                  <inertial pos="0 0 .08" mass=".365" diaginertia=".0004 .0004 .0003"/>
                  <joint name="wrist_3" axis="0 0 1" class="small" range="-6.2832 6.2832"/>
                  <geom type="cylinder" fromto="0 0 .035 0 0 .0996" size=".038" material="link" {_SEEN}/>
                  <body name="gripper" pos="0 0 .0996" gravcomp="1">
                    <inertial pos="0 0 .05" mass=".75" diaginertia=".0012 .0012 .0008"/>
                    <geom type="cylinder" fromto="0 0 0 0 0 .022" size=".040" material="joint" {_SEEN}/>
                    <geom type="capsule" fromto="0 0 .02 0 0 .065" size=".036" material="gripper" {_ARM}/>
                    <geom type="box" pos="0 0 .085" size=".022 .050 .014" material="gripper" {_SEEN}/>
                    <site name="tip" pos="0 0 .215" size=".004" rgba="0 0 0 0"/>
                    <camera name="upper_wrist" pos="-.085 0 .035" xyaxes="{{upper_axes}}" fovy="72"/>
                    <camera name="lower_wrist" pos=".085 0 .035" xyaxes="{{lower_axes}}" fovy="72"/>
                    {{fingers}}
                  </body>
                </body>
              </body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
"""

_TAIL = f"""
  <default>
    <default class="big"><joint armature=".2" damping="2"/></default>
    <default class="small"><joint armature=".1" damping="1"/></default>
    <default class="finger"><joint type="slide" range="0 {GRIPPER_TRAVEL}" damping="12" armature=".05"/></default>
  </default>
  <equality>
    <joint joint1="left_finger" joint2="right_finger" polycoef="0 1 0 0 0"/>
  </equality>
  <actuator>
    {{actuators}}
    <position name="gripper" joint="left_finger" kp="700" forcerange="-40 40"
      ctrlrange="0 {GRIPPER_TRAVEL}"/>
  </actuator>
"""

_STIFFNESS = (4000.0, 4000.0, 3000.0, 700.0, 700.0, 700.0)  # N m / rad
_TORQUE = (150.0, 150.0, 150.0, 28.0, 28.0, 28.0)  # N m, the published limits


def _finger(name: str, side: int) -> str:
    """One finger; its slide is 0 when open and GRIPPER_TRAVEL when the pads meet."""
    y = side * GRIPPER_TRAVEL
    return f"""
      <body name="{name}" pos="0 {y} .09" gravcomp="1">
        <inertial pos="0 0 .07" mass=".12" diaginertia=".0002 .0002 .0001"/>
        <joint name="{name}" axis="0 {-side} 0" class="finger"/>
        <geom type="capsule" fromto="0 {side * -0.018} .005 0 {side * 0.012} .075" size=".010"
          material="gripper" {_SEEN}/>
        <geom type="box" pos="0 {side * 0.010} .096" size=".0125 .006 .028" material="gripper" {_SEEN}/>
        <geom name="{name}_pad" type="box" pos="0 {side * 0.006} .0975" size=".0125 .006 .0275"
          material="pad" contype="0" conaffinity="3" mass="0" friction="1.2 .02 .001" condim="4"
          priority="1" solref=".008 1"/>
      </body>"""


def _look(position: Array, target: Array, right: Array | None = None) -> str:
    """`xyaxes` of a camera at `position` looking at `target`; level with the table unless `right` is given."""
    forward = (target - position) / np.linalg.norm(target - position)
    x = np.cross(forward, [0.0, 0.0, 1.0]) if right is None else right
    x = x / np.linalg.norm(x)
    return " ".join(f"{value:.5f}" for value in (*x, *np.cross(x, forward)))


def station_mjcf(task_xml: str) -> str:
    """The whole scene: arm, gripper, table, cameras and `task_xml` (top-level MJCF sections of a task)."""
    left, right = np.array([0.02, 0.60, 0.72]), np.array([0.02, -0.60, 0.72])
    overview = np.array([1.55, -1.05, 0.95])
    centre = np.array([0.50, 0.0, 0.08])
    head = _HEAD.format(
        left=" ".join(map(str, left)),
        left_axes=_look(left, centre),
        right=" ".join(map(str, right)),
        right_axes=_look(right, centre),
        overview=" ".join(map(str, overview)),
        overview_axes=_look(overview, np.array([0.30, 0.0, 0.22])),
    )
    # Wrist cameras look past the fingertips; image left and right are the two fingers.
    arm = _ARM_TREE.format(
        upper_axes=_look(np.array([-0.085, 0, 0.035]), np.array([0.0, 0, 0.26]), np.array([0.0, 1.0, 0])),
        lower_axes=_look(np.array([0.085, 0, 0.035]), np.array([0.0, 0, 0.26]), np.array([0.0, 1.0, 0])),
        fingers=_finger("left_finger", 1) + _finger("right_finger", -1),
    )
    actuators = "\n".join(
        f'<position name="{name}" joint="{name}" kp="{kp}" kv="{kp * LEAD_S}" forcerange="{-limit} {limit}"/>'
        for name, kp, limit in zip(JOINTS, _STIFFNESS, _TORQUE, strict=True)
    )
    return head + arm + _TAIL.format(actuators=actuators) + task_xml + "\n</mujoco>"


class Arm:
    """The simulated arm with everything around it: what tasks and the scripted teleoperator look at.

    Attributes:
        model, data: MuJoCo's model and data.
    """

    def __init__(self, task_xml: str) -> None:
        self._mujoco = load_mujoco()
        self.model: Any = self._mujoco.MjModel.from_xml_string(station_mjcf(task_xml))
        self.data: Any = self._mujoco.MjData(self.model)
        joints = [self.model.joint(name) for name in JOINTS]
        self._qpos = np.array([joint.qposadr[0] for joint in joints])
        self._dofs = np.array([joint.dofadr[0] for joint in joints])
        self._limits = np.array([joint.range for joint in joints])
        self._finger = int(self.model.joint("left_finger").qposadr[0])
        self._other_finger = int(self.model.joint("right_finger").qposadr[0])
        self._tip = int(self.model.site("tip").id)
        self._reach = self._limits[:, 0], self._limits[:, 1]

    @property
    def joints(self) -> Array:
        """Measured joint angles, (6,) rad."""
        return np.array(self.data.qpos[self._qpos])

    @property
    def joint_speeds(self) -> Array:
        """Measured joint speeds, (6,) rad/s."""
        return np.array(self.data.qvel[self._dofs])

    @property
    def closure(self) -> float:
        """Measured gripper, 0 (open) to 1 (closed)."""
        return float(np.clip(self.data.qpos[self._finger] / GRIPPER_TRAVEL, 0.0, 1.0))

    @property
    def tip(self) -> Array:
        """Point between the closed fingertips, (3,) m in the world."""
        return np.array(self.data.site_xpos[self._tip])

    def tip_at(self, joints: Array) -> Array:
        """Position that the tip would have at other joint angles (6,) rad, m."""
        elsewhere = self._mujoco.MjData(self.model)
        elsewhere.qpos[:] = self.data.qpos
        elsewhere.qpos[self._qpos] = joints
        self._mujoco.mj_kinematics(self.model, elsewhere)
        return np.array(elsewhere.site_xpos[self._tip])

    @property
    def tip_rotation(self) -> Array:
        """Tool frame in the world, (3, 3); z points out of the gripper, y from finger to finger."""
        return np.array(self.data.site_xmat[self._tip]).reshape(3, 3)

    def jacobian(self) -> Array:
        """Of the tip's linear and angular velocity by the six joints, (6, 6)."""
        linear, angular = np.zeros((3, self.model.nv)), np.zeros((3, self.model.nv))
        self._mujoco.mj_jacSite(self.model, self.data, linear, angular, self._tip)
        return np.vstack([linear, angular])[:, self._dofs]

    def leashed(self, joints: Array) -> Array:
        """The nearest joints (6,) rad within the limits and within reach of the measured ones."""
        measured = self.joints
        return np.clip(np.clip(joints, measured - _LEASH, measured + _LEASH), *self._reach)

    def place(self, joints: Array, closure: float) -> None:
        """Start of an episode: everything at rest, the arm at `joints` (6,) rad, the gripper at `closure`."""
        self._mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[self._qpos] = joints
        self.data.qpos[[self._finger, self._other_finger]] = closure * GRIPPER_TRAVEL
        self.data.ctrl[:6] = joints
        self.data.ctrl[6] = closure * GRIPPER_TRAVEL

    def forward(self) -> None:
        """Recompute positions after something was placed by hand."""
        self._mujoco.mj_forward(self.model, self.data)

    def drive(self, start: Array, end: Array, closure: float, substeps: int) -> None:
        """Physics for one control step: the joint reference ramps from `start` to `end`, (6,) rad each."""
        lead = (end - start) * (LEAD_S / (substeps * TIMESTEP))
        self.data.ctrl[6] = closure * GRIPPER_TRAVEL
        for step in range(1, substeps + 1):
            # Without the lead the damping would act against the motion asked for, and the arm would lag.
            self.data.ctrl[:6] = start + (end - start) * (step / substeps) + lead
            self._mujoco.mj_step(self.model, self.data)
        self.data.ctrl[:6] = end
        # mj_step leaves positions of the step before; observations need those of now.
        self._mujoco.mj_kinematics(self.model, self.data)
        self._mujoco.mj_comPos(self.model, self.data)
