"""DrQv2Policy: the paper's actor-critic baselines as a LeRobot policy."""

from .actor_critic import DrQv2Model
from .base_policy import RLPolicy
from .configuration_drqv2 import DrQv2Config

__all__ = ["DrQv2Policy"]


class DrQv2Policy(RLPolicy):
    """DrQ-v2 and DrQ-v2+, as `preset` says."""

    config_class = DrQv2Config
    name = "drqv2"
    config: DrQv2Config
    model: DrQv2Model
    model_class = DrQv2Model
