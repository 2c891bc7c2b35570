"""A robot of which a part is gone: taken up again as LeRobot's own followers have to be, whatever their driver says."""

from typing import Any

import numpy as np
import pytest
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected

from cqn_train.robot.guard import Guard, GuardSettings
from cqn_train.robot.limits import Limits
from cqn_train.robot.readings import RobotFault

from ..driven_clock import DrivenClock
from .test_robot_readings import FPS, STEP, D, Liar, drive


class Part:
    """A bus or a camera: plugged in or not, open or not; its driver may not notice that it was pulled out."""

    def __init__(self) -> None:
        self.plugged, self.is_connected, self.stale = True, False, False
        self.opened = 0

    def connect(self) -> None:
        if self.is_connected:
            raise RuntimeError("open already")
        if not self.plugged:
            raise ConnectionError("no such device")
        self.is_connected, self.stale = True, False
        self.opened += 1

    def disconnect(self) -> None:
        if not self.is_connected:
            raise RuntimeError("not open")
        self.is_connected = False

    def pull(self, *, noticed: bool) -> None:
        self.plugged, self.stale = False, True
        self.is_connected = self.is_connected and not noticed

    def use(self) -> None:
        if self.stale or not self.is_connected:
            raise ConnectionError("does not answer")


class Bus(Part):
    """Lets the motors go as it is closed, unless told otherwise."""

    def __init__(self, robot: "Follower") -> None:
        super().__init__()
        self.robot = robot

    def disconnect(self, disable_torque: bool = True) -> None:
        super().disconnect()
        self.robot.dropped += disable_torque

    def disable_torque(self) -> None:
        self.robot.disable_torque()

    def enable_torque(self) -> None:
        self.robot.enable_torque()


class Follower(Liar):
    """Put together as LeRobot's SO-101 is: all or nothing, and its driver refuses to connect what is half open."""

    def __init__(self, clock: DrivenClock) -> None:
        self.bus_ = Bus(self)
        self.cameras = {"eye": Part(), "wrist": Part()}
        self.dropped = 0
        super().__init__(clock, 0.001)
        self.bus: Any = self.bus_

    @property
    def is_connected(self) -> bool:  # type: ignore[override]
        return self.bus_.is_connected and all(camera.is_connected for camera in self.cameras.values())

    @is_connected.setter
    def is_connected(self, _: bool) -> None: ...

    @check_if_already_connected
    def connect(self) -> None:
        self.bus_.connect()
        for camera in self.cameras.values():
            camera.connect()
        self.torque, self._fresh = True, True

    @check_if_not_connected
    def disconnect(self) -> None:
        self.bus_.disconnect(True)
        for camera in self.cameras.values():
            camera.disconnect()

    def get_observation(self) -> dict[str, Any]:
        for part in (self.bus_, *self.cameras.values()):
            part.use()
        return super().get_observation()


def follower() -> tuple[Guard, Follower, DrivenClock]:
    clock = DrivenClock(0.0)
    robot = Follower(clock)
    limits = Limits(
        low=np.full(D, -90.0), high=np.full(D, 90.0), max_step=np.full(D, STEP), max_speed=np.full(D, STEP * FPS)
    )
    guard = Guard(robot, limits, GuardSettings(), clock)  # type: ignore[arg-type]
    robot.connect()
    guard.read()
    drive(guard, clock, [4, 8])
    return guard, robot, clock


@pytest.mark.parametrize("noticed", [True, False])
@pytest.mark.parametrize("parts", [["bus"], ["eye"], ["wrist"], ["bus", "eye", "wrist"]])
def test_what_was_pulled_out_is_found_again(parts: list[str], noticed: bool) -> None:
    guard, robot, clock = follower()
    pulled = [robot.bus_ if name == "bus" else robot.cameras[name] for name in parts]
    for part in pulled:
        part.pull(noticed=noticed)
    with pytest.raises(RobotFault, match="cannot be read"):
        guard.read()
    for _ in range(5):
        with pytest.raises(RobotFault, match="cannot be"):
            guard.recover()
    for part in pulled:
        part.plugged = True
    if "bus" in parts:
        robot.joints = robot.joints - 3.0  # it sank
    guard.recover()
    assert robot.is_connected
    assert robot.sent[-1].goal == pytest.approx(robot.joints)
    assert robot.dropped == 0  # its motors were never let go on the way
    drive(guard, clock, [8, 8])


def test_one_camera_is_connected_without_touching_the_motors() -> None:
    guard, robot, _ = follower()
    robot.cameras["eye"].pull(noticed=True)
    with pytest.raises(RobotFault, match="camera cannot be connected: no such device"):
        guard.recover()
    robot.cameras["eye"].plugged = True
    guard.recover()
    assert (robot.bus_.opened, robot.cameras["eye"].opened, robot.cameras["wrist"].opened) == (1, 2, 1)


def test_one_failed_reading_connects_nothing_anew() -> None:
    guard, robot, _ = follower()
    robot.bus_.stale = True
    with pytest.raises(RobotFault, match="cannot be read"):
        guard.read()
    robot.bus_.stale = False
    guard.recover()
    assert robot.bus_.opened == 1


def test_an_arm_in_somebodys_hand_stays_released() -> None:
    """Also where connecting it anew switches the motors on, as drivers do."""
    guard, robot, _ = follower()
    guard.release()
    sent = len(robot.sent)
    robot.bus_.pull(noticed=False)
    for _ in range(3):
        with pytest.raises(RobotFault, match="cannot be"):
            guard.recover()
    robot.bus_.plugged = True
    robot.joints = np.array([30.0, -40.0, 5.0])
    guard.recover()
    assert guard.released
    assert not robot.torque
    assert len(robot.sent) == sent
    guard.engage()
    assert robot.sent[-1].goal == pytest.approx(robot.joints)
    assert robot.torque
