"""Registrations for LeRobot, whose plugin discovery imports this as `lerobot_policy_cqn`; no simulator is loaded.

The processors are among them: LeRobot imports a policy's when it makes new ones, not when it loads saved ones.
"""

import cqn_train.envs
import cqn_train.sim_arm
import lerobot_cqn.configuration_cqn
import lerobot_cqn.configuration_cqn_as
import lerobot_cqn.configuration_drqv2
import lerobot_cqn.processors

__all__ = ["cqn_train", "lerobot_cqn"]
