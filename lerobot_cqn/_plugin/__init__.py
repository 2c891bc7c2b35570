"""What LeRobot's plugin discovery imports (as `lerobot_policy_cqn`): registrations only, nothing heavy."""

import cqn_train.envs
import cqn_train.sim_arm
import lerobot_cqn

__all__ = ["cqn_train", "lerobot_cqn"]
