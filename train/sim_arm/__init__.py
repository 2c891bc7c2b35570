"""A simulated arm with a leader behind LeRobot's `Robot` and `Teleoperator`; no simulator is imported here.

`--robot.type=sim_ur5e --teleop.type=sim_leader` work with lerobot-record, -teleoperate, -rollout and `cqn-train`.
"""

from .config_sim_leader import SimLeaderConfig
from .config_sim_ur5e import FAULTS, Fault, SimUR5eConfig

__all__ = ["FAULTS", "Fault", "SimLeaderConfig", "SimUR5eConfig"]
