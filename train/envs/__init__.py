"""Simulated environments, registered for LeRobot (no simulator is imported here)."""

from .registration import UR5eStationEnv

__all__ = ["UR5eStationEnv"]
