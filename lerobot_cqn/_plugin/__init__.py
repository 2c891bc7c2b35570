"""What LeRobot's plugin discovery imports (as `lerobot_policy_cqn`): registrations only, nothing heavy."""

import cqn_train.envs
import lerobot_cqn

__all__ = ["cqn_train", "lerobot_cqn"]
