"""LeRobot arms for online training: limits that every command passes, and an environment over any `Robot`."""
