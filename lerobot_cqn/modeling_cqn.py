"""CQNPolicy: the Coarse-to-fine Q-Network as a LeRobot policy."""

from .base_policy import RLPolicy
from .configuration_cqn import CQNConfig
from .critic import CQNModel

__all__ = ["CQNPolicy"]


class CQNPolicy(RLPolicy):
    """Coarse-to-fine Q-Network: acts with the target critic, on representable actions only."""

    config_class = CQNConfig
    name = "cqn"
    config: CQNConfig
    model: CQNModel
    model_class = CQNModel
