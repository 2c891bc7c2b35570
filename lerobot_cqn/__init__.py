"""Coarse-to-fine Q-Network (Seo, Uruç, James 2024) as a LeRobot policy.

Importing this package registers `--policy.type=cqn` and its baseline `--policy.type=drqv2` with LeRobot, and the
processor step that their checkpoints name: LeRobot imports a policy's processors only when it makes new ones, not when
it loads saved ones.
"""

from .configuration_cqn import CQNConfig
from .configuration_drqv2 import DrQv2Config
from .errors import ConfigError, CQNError, DataError, OutputError, OutputExistsError
from .processors import BoundObservationProcessorStep
from .settings import DRQV2_PRESETS, PRESETS, CQNSettings, DrQv2Settings

__all__ = [
    "DRQV2_PRESETS",
    "PRESETS",
    "BoundObservationProcessorStep",
    "CQNConfig",
    "CQNError",
    "CQNSettings",
    "ConfigError",
    "DataError",
    "DrQv2Config",
    "DrQv2Settings",
    "OutputError",
    "OutputExistsError",
]
