"""Names of an SO-101's joints, and angles of the published model for steps of the motors that turn them."""

import math

import numpy as np

from .servo import TURN, Servo

__all__ = ["JOINTS", "REST", "SPANS", "angle_of", "shaft_of"]

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
# Steps that each joint can turn in all, of the published model's limits (SO-ARM100, so101_new_calib); the roll is free.
SPANS = dict(zip(JOINTS, (2502, 2275, 2204, 2161, 4095, 1252), strict=True))
MIDDLES = (0.0, 0.0, 0.0, 0.0, 0.0487, 0.7854)  # rad, of the model's limits
REST = np.array([0.0, -1.2, 1.2, 0.9, 0.0, 0.2])  # rad: home, above the table and out of the way


def angle_of(number: int, servo: Servo, shaft: float | None = None) -> float:
    """Angle of a joint in rad; shaft: in steps, None: where it is."""
    middle = (servo.ends[0] + servo.ends[1]) / 2
    return MIDDLES[number] + ((servo.shaft if shaft is None else shaft) - middle) * 2 * math.pi / TURN


def shaft_of(number: int, servo: Servo, angle: float) -> float:
    """Steps of the shaft of a joint at an angle in rad."""
    return (servo.ends[0] + servo.ends[1]) / 2 + (angle - MIDDLES[number]) * TURN / (2 * math.pi)
