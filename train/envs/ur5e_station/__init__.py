"""The UR5e station: four tasks in simulation, registered for LeRobot (no simulator is imported here)."""
