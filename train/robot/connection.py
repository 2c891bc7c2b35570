"""Connecting a robot again after a part of it was gone; LeRobot's drivers only know all or nothing."""

import contextlib
from typing import Any

from lerobot.robots.robot import Robot

from .readings import RobotFault

__all__ = ["connect", "motor_buses", "reconnect", "reconnect_cameras"]


def motor_buses(robot: Robot) -> list[Any]:
    """LeRobot's motor buses of a robot and of the robots that it is made of, such as two arms; may be none."""
    parts = [robot, *(part for part in vars(robot).values() if isinstance(part, Robot))]
    return [bus for part in parts if (bus := getattr(part, "bus", None)) is not None]


def connect(robot: Robot) -> None:
    """Connect a robot that is not. Raises RobotFault where it does not answer."""
    try:
        if not robot.is_connected:
            robot.connect()
    except Exception as error:  # drivers raise many kinds
        raise RobotFault(f"The robot cannot be connected: {error} Check cables, power and --robot.port.") from error


def reconnect_cameras(robot: Robot) -> bool:
    """Connect the cameras that are gone, where the motors are not; whether there was such a camera.

    Raises RobotFault where one does not answer.
    """
    gone = [camera for camera in _cameras(robot) if not camera.is_connected]
    buses = motor_buses(robot)
    if not gone or not buses or not all(map(_connected, buses)):
        return False
    try:
        for camera in gone:
            with contextlib.suppress(Exception):  # what is left of its thread
                camera.disconnect()
            camera.connect()
    except Exception as error:  # drivers raise many kinds
        raise RobotFault(f"A camera cannot be connected: {error} Check its cable.") from error
    return True


def reconnect(robot: Robot) -> None:
    """Disconnect every part and connect, whatever the driver says. Raises RobotFault where it does not answer."""
    _disconnect(robot)
    connect(robot)


def _disconnect(robot: Robot) -> None:
    """Close every part that is open, whatever fails, and leave the motors as they are: a limp arm falls."""
    for bus in motor_buses(robot):
        if _connected(bus):
            with contextlib.suppress(Exception):
                bus.disconnect(disable_torque=False)
        # A transaction that the lost port broke off leaves the SDK's mark that it is still under way: for ever busy.
        port: Any = getattr(bus, "port_handler", None)
        if hasattr(port, "is_using"):
            port.is_using = False
    for camera in _cameras(robot):
        with contextlib.suppress(Exception):
            camera.disconnect()
    with contextlib.suppress(Exception):
        if robot.is_connected:
            robot.disconnect()


def _cameras(robot: Robot) -> list[Any]:
    """Cameras that can be connected one by one, as LeRobot's own robots have them."""
    cameras = getattr(robot, "cameras", None)
    return [one for one in cameras.values() if hasattr(one, "is_connected")] if isinstance(cameras, dict) else []


def _connected(bus: Any) -> bool:
    return bool(getattr(bus, "is_connected", False))
