"""Readings of another shape or in other units than the demonstrations: faults of one line, and no goal."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from cqn_train.robot.readings import RobotFault

from .test_robot_readings import drive, made


@pytest.mark.parametrize(
    ("start", "joint"), [([0.0, 0.0, 200.0], "c.pos"), ([-1.7, 3.1, 0.2], None), ([60.0, 0.0, 0.0], None)]
)
def test_an_arm_far_outside_its_range_is_not_started(start: list[float], joint: str | None) -> None:
    """Other units, another calibration: said before anything is sent, with both ranges."""
    guard, robot, _ = made()
    robot.joints = robot.goal = np.array(start)
    if joint is None:
        guard.open()
        guard.close()
    else:
        with pytest.raises(
            RobotFault, match=rf"'{joint}' reads 200, far outside its range of -40 to 40 .*read 0 to 200"
        ):
            guard.open()
        assert robot.sent == []


def test_radians_where_the_demonstrations_are_degrees() -> None:
    """A folded arm is never near zero in all joints: the ranges of the others tell."""
    guard, robot, _ = made(low=[-110.0, 60.0, -20.0], high=[-70.0, 120.0, 20.0])
    robot.joints = robot.goal = np.radians([-90.0, 90.0, 0.0])
    with pytest.raises(RobotFault, match=r"'a.pos' reads -1.5708, far outside its range of -110 to -70.*units"):
        guard.open()
    assert robot.sent == []


CONTENTS: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "no joint": (lambda raw: raw.pop("b.pos"), "gives no 'b.pos'"),
    "no value": (lambda raw: raw.pop("force"), "gives no 'force'"),
    "value NaN": (lambda raw: raw.update(force=np.nan), "value 'force' reads nan"),
    "value None": (lambda raw: raw.update(force=None), "value 'force' reads None"),
    "joint text": (lambda raw: raw.update({"a.pos": "x"}), "joint 'a.pos' reads x"),
    "joint huge": (lambda raw: raw.update({"a.pos": 10**400}), "joint 'a.pos' reads 1000"),
    "no picture": (lambda raw: raw.pop("eye"), "gives no 'eye'"),
    "picture None": (lambda raw: raw.update(eye=None), "camera 'eye' gives object"),
    "grey": (lambda raw: raw.update(eye=raw["eye"][..., 0]), r"uint8 \(4, 4\): expected uint8 \(4, 4, 3\)"),
    "resized": (lambda raw: raw.update(eye=np.zeros((8, 8, 3), np.uint8)), r"uint8 \(8, 8, 3\)"),
    "float": (lambda raw: raw.update(eye=raw["eye"] / 255.0), r"float64 \(4, 4, 3\)"),
}  # fmt: skip


@pytest.mark.parametrize("name", CONTENTS)
def test_readings_of_another_shape_are_faults(name: str) -> None:
    spoil, said = CONTENTS[name]
    guard, robot, clock = made()
    robot.connect()
    guard.read()
    drive(guard, clock, [4])
    robot.lie = lambda _, raw: spoil(raw)
    with pytest.raises(RobotFault, match=said) as raised:
        guard.read()
    assert "\n" not in str(raised.value)
    robot.lie = lambda _, __: None
    guard.recover()
    drive(guard, clock, [8])
