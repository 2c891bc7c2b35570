"""The simulated world that a robot and a leader in one process share: it runs by a clock of its own."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import ConfigError, one_of

from ..clock import Clock
from ..envs.cameras import Cameras
from ..envs.sim_env import box_with_gripper
from ..envs.ur5e_station.station import MAX_JOINT_SPEED
from ..envs.ur5e_station.task import Task
from ..envs.ur5e_station.tasks import TASKS
from ..envs.ur5e_station.ur5e import HOME, TIMESTEP, Arm

__all__ = ["WORLDS", "World", "find_world"]

Array = NDArray[np.float64]

_AT_HOME = 0.05  # rad of every joint
_MOVED = 0.3  # rad of any joint: the arm has left home
_REST_S = 0.3  # seconds at home before the person lays the scene out anew
_BEHIND_S = 0.5  # most real seconds that are caught up at once; a process that slept longer lost the rest

WORLDS: dict[str, "World"] = {}


def find_world(name: str) -> "World":
    """The world of a connected arm. Raises ConfigError where there is none of that name."""
    if name not in WORLDS:
        raise ConfigError(one_of("world", name, WORLDS) + " Connect --robot.type=sim_ur5e in this process first.")
    return WORLDS[name]


class World:
    """Arm, objects and clock. Whoever looks at it first lets the time that has passed happen.

    A person lays the scene out anew whenever the arm, after it was away, rests at home.

    Attributes:
        arm, station_task: of the station; fps: the leader's rate, 1/s of the simulated clock; action_space: deltas of
            a step at that rate, and the gripper.
        now: simulated seconds since the start; scenes: how many have been laid out.
        fastest: highest joint speed so far, rad/s, and lowest, highest: joint angles so far, rad; measured in every
            physics step, to check safety limits against.
    """

    fps = 10

    def __init__(self, task: str, speed: float, ramp_s: float, seed: int, clock: Clock) -> None:
        self.station_task: Task = TASKS[task]()
        self.arm = Arm(self.station_task.mjcf())
        self._cameras = Cameras(self.arm.model)
        self._painter = ThreadPoolExecutor(1, "painter")  # a graphics context belongs to one thread; a robot to all
        self.clock, self.lock = clock, clock.lock()
        self.action_space = box_with_gripper(6, MAX_JOINT_SPEED / self.fps)
        self.speed, self.ramp_s = speed, ramp_s
        self.now, self.scenes = 0.0, 0
        self._stuck: tuple[int, float] | None = None
        self.fastest = 0.0
        self._rng = np.random.default_rng(seed)
        self._looked = clock.now
        self._left, self._rested = False, 0.0
        self._succeeded = False
        self.arm.place(np.array(HOME), self.station_task.start_closure)
        self.lowest, self.highest = np.array(HOME), np.array(HOME)
        self._start = self._reference = self._goal = np.array(HOME)
        self._closure, self._since = self.station_task.start_closure, 0.0
        self.lay_out()

    @property
    def success(self) -> bool:
        """Whether the task has been done in this scene."""
        return self._succeeded

    @property
    def away(self) -> bool:
        """Whether the arm has left home in this scene."""
        return self._left

    def picture(self, camera: str, height: int, width: int) -> NDArray[np.uint8]:
        """RGB picture (height, width, 3) of a camera; may be asked for from any thread that has the lock."""
        return self._painter.submit(self._cameras.picture, self.arm.data, camera, height, width).result()

    def tip_at(self, joints: Array) -> Array:
        """Position of the tip, (3,) m, with the arm at joints (6,) rad."""
        with self.lock:
            return self.arm.tip_at(joints)

    def open(self) -> None:
        """Draw again, after `close`."""
        self._painter = ThreadPoolExecutor(1, "painter")

    def close(self) -> None:
        """Free the graphics; the arm stays as it is."""
        self._painter.submit(self._cameras.close).result()
        self._painter.shutdown()

    def lay_out(self) -> None:
        """A new scene; the arm stays where it is."""
        with self.lock:
            joints, closure = self.arm.joints, self.arm.closure
            self.arm.place(joints, closure)
            self.station_task.reset(self.arm, self._rng)
            self.arm.forward()
            self._start = self._reference = self._goal = joints
            self._closure = closure
            self._left, self._rested, self._succeeded = False, 0.0, False
            self.scenes += 1

    def command(self, joints: Array, closure: float) -> None:
        """Lead the joints (6,) rad to a goal within `ramp_s`, and the gripper, 0 (open) to 1 (closed)."""
        with self.lock:
            self.catch_up()
            self._start = self._reference
            self._goal = self.arm.leashed(joints)
            self._closure, self._since = float(np.clip(closure, 0.0, 1.0)), 0.0

    def jam(self, joint: int | None) -> None:
        """Keep a joint where it is from now on, whatever it is told; None lets go."""
        if joint is None or self._stuck is None or self._stuck[0] != joint:
            self._stuck = None if joint is None else (joint, float(self.arm.joints[joint]))

    def catch_up(self) -> None:
        """Simulate the time since the last look."""
        with self.lock:
            real = self.clock.now
            passed = min(real - self._looked, _BEHIND_S) * self.speed
            steps = int(passed / TIMESTEP)
            # What is less than a physics step is left for the next look.
            self._looked = real - (passed - steps * TIMESTEP) / self.speed
            for _ in range(steps):
                self._step()

    def _step(self) -> None:
        self._since += TIMESTEP
        share = min(1.0, self._since / self.ramp_s)
        before = self._reference
        self._reference = self._start + (self._goal - self._start) * share
        wanted = self._reference
        if self._stuck is not None:
            joint, angle = self._stuck
            before, wanted = before.copy(), wanted.copy()
            before[joint] = wanted[joint] = angle
        self.arm.drive(before, wanted, self._closure, 1)
        self.now += TIMESTEP
        joints = self.arm.joints
        self.fastest = max(self.fastest, float(np.abs(self.arm.joint_speeds).max()))
        self.lowest, self.highest = np.minimum(self.lowest, joints), np.maximum(self.highest, joints)
        self._succeeded = self._succeeded or self.station_task.success(self.arm)
        away = float(np.abs(joints - HOME).max())
        self._left = self._left or away > _MOVED
        self._rested = self._rested + TIMESTEP if away < _AT_HOME else 0.0
        if self._left and self._rested >= _REST_S:
            self.lay_out()

    def until(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Let time pass until a condition holds; whether it did within so many seconds of the clock."""
        deadline = self.clock.now + seconds
        while not condition():
            if self.clock.now > deadline:
                return False
            self.clock.sleep(0.005)
            self.catch_up()
        return True
