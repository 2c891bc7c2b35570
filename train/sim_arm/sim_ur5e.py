"""The simulated UR5e as a LeRobot robot, with the faults that real ones have."""

from typing import Any

import numpy as np
from lerobot.robots.robot import Robot
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from numpy.typing import NDArray

from lerobot_cqn.errors import ConfigError

from ..clock import REAL, Clock
from ..envs.ur5e_station.tasks import TASKS
from ..envs.ur5e_station.ur5e import STATE_NAMES
from .config_sim_ur5e import SimUR5eConfig
from .person import SimPerson
from .world import WORLDS, World

__all__ = ["SimUR5e", "from_robot_units", "to_robot_units"]

GRIPPER_SCALE = 100.0  # 0 (open) to 100 (closed)


def to_robot_units(joints: NDArray[np.float64], closure: float) -> dict[str, float]:
    """Joints (6,) rad and closure 0..1 as the robot speaks: degrees, and 0..100."""
    values = [*np.degrees(joints), GRIPPER_SCALE * closure]
    return {name: float(value) for name, value in zip(STATE_NAMES, values, strict=True)}


def from_robot_units(values: dict[str, Any]) -> tuple[NDArray[np.float64], float]:
    """The other way round. Raises KeyError for a joint that is not named."""
    numbers = np.array([float(values[name]) for name in STATE_NAMES])
    return np.radians(numbers[:6]), float(numbers[6] / GRIPPER_SCALE)


class SimUR5e(Robot):
    """The arm of the simulated station: absolute joint goals in degrees, four cameras, time that does not wait.

    Attributes:
        clock: by which its world runs once it is connected.
    """

    config_class = SimUR5eConfig
    clock: Clock = REAL
    name = "sim_ur5e"

    def __init__(self, config: SimUR5eConfig) -> None:
        super().__init__(config)
        self.config = config
        self.cameras = dict.fromkeys(config.camera_names)  # lerobot-record counts them
        self._world: World | None = None
        self._left: World | None = None  # that it stood in when it was disconnected
        self._person: SimPerson | None = None
        self._last: dict[str, Any] = {}
        self._rng = np.random.default_rng(config.seed)

    @property
    def world(self) -> World:
        """The world that this arm stands in. Raises DeviceNotConnectedError before `connect`."""
        if self._world is None:
            raise DeviceNotConnectedError(f"{self} is not connected: call connect() first.")
        return self._world

    @property
    def observation_features(self) -> dict[str, Any]:
        """Seven joints, with `state` the objects as well, and the cameras."""
        names = [*STATE_NAMES, *(self._object_names() if self.config.state else ())]
        shape = (self.config.image_height, self.config.image_width, 3)
        return dict.fromkeys(names, float) | dict.fromkeys(self.config.camera_names, shape)

    @property
    def action_features(self) -> dict[str, type]:
        """Seven absolute goals."""
        return dict.fromkeys(STATE_NAMES, float)

    @property
    def is_connected(self) -> bool:
        """Whether it can be read and moved."""
        return self._world is not None

    @property
    def is_calibrated(self) -> bool:
        """Nothing: there is nothing to calibrate."""
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Start the world, or find the arm as it was left.

        Raises DeviceAlreadyConnectedError the second time, ConfigError for a name that is taken, and what faults raise.
        """
        del calibrate
        if self.is_connected:
            raise DeviceAlreadyConnectedError(f"{self} is connected already.")
        c = self.config
        if c.world in WORLDS:
            raise ConfigError(f"There is an arm in the world '{c.world}' already: give another --robot.world.")
        if self._left is not None:  # its motors hold while nobody is connected
            self._left.catch_up()
            if any(fault.kind == "disconnect" and fault.active(self._left.now) for fault in c.faults):
                raise ConnectionError(f"{self}: injected fault 'disconnect'.")
            self._left.open()
        world = self._left or World(c.task, c.speed, c.ramp_s, c.seed, self.clock)
        self._world, self._left = world, None
        WORLDS[c.world] = world
        if c.person:
            self._person = SimPerson(self._world, c.person, c.person_takes_over_s, c.person_helps_episodes)
            self._person.start()

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do."""

    def get_observation(self) -> dict[str, Any]:
        """Joints in degrees, gripper 0..100, pictures uint8 [H, W, 3]. Raises what faults raise."""
        world = self.world
        with world.lock:
            world.catch_up()
            self._fail("disconnect", "error")
            for fault in self._on("delay"):
                world.clock.sleep(fault.amount)
                world.catch_up()
            joints = to_robot_units(world.arm.joints, world.arm.closure)
            if self.config.state:
                state = world.station_task.state(world.arm)
                joints |= {n: float(v) for n, v in zip(self._object_names(), state, strict=True)}
            if self._on("frozen_joints"):
                joints = {name: self._last.get(name, value) for name, value in joints.items()}
            if self._on("nan"):
                joints[STATE_NAMES[0]] = float("nan")
            pictures = self._pictures(world)
        self._last = {**joints, **pictures}
        return dict(self._last)

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Lead the joints to absolute goals in degrees; returns what is sent. Raises what faults raise."""
        world = self.world
        with world.lock:
            world.catch_up()
            self._fail("disconnect", "send_error")
            stuck = self._on("stuck_joint")
            world.jam(int(stuck[0].amount) if stuck else None)
            joints, closure = from_robot_units(action)
            world.command(joints, closure)
        return to_robot_units(joints, closure)

    def disconnect(self) -> None:
        """End the world. Raises DeviceNotConnectedError the second time."""
        if self._person is not None:
            self._person.close()
        self.world.close()
        WORLDS.pop(self.config.world, None)
        self._world, self._left = None, self._world

    def _object_names(self) -> tuple[str, ...]:
        # lerobot-rollout hands on what is called a position or a speed, and nothing else.
        return tuple(f"object.{name}.pos" for name in TASKS[self.config.task].state_names)

    def _pictures(self, world: World) -> dict[str, NDArray[np.uint8]]:
        frozen = bool(self._on("frozen_camera"))
        height, width = self.config.image_height, self.config.image_width
        return {
            name: self._last[name] if frozen and name in self._last
            else self._noisy(world.picture(name, height, width))
            for name in self.config.camera_names
        }  # fmt: skip

    def _noisy(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The lowest bit of one value in a hundred is chance, as in real sensors: no two pictures are the same."""
        values = picture.reshape(-1)
        values[self._rng.integers(0, len(values), max(8, len(values) // 100))] ^= 1
        return picture

    def tip_position(self, joints: dict[str, float]) -> NDArray[np.float64]:
        """Position of the tip at joints in degrees, (3,) m, whatever the arm does now."""
        angles, _ = from_robot_units(joints)
        return self.world.tip_at(angles)

    def _on(self, kind: str) -> list[Any]:
        return [fault for fault in self.config.faults if fault.kind == kind and fault.active(self.world.now)]

    def _fail(self, *kinds: str) -> None:
        for kind in kinds:
            if self._on(kind):
                raise (RuntimeError if kind == "error" else ConnectionError)(f"{self}: injected fault '{kind}'.")
