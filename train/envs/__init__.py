"""Simulated environments, registered for LeRobot (no simulator is imported here)."""
