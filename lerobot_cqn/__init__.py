"""Coarse-to-fine Q-Network (Seo, Uruç, James 2024) as a LeRobot policy.

Importing this package registers `--policy.type=cqn` with LeRobot.
"""

from .configuration_cqn import CQNConfig
from .errors import ConfigError, CQNError, DataError, OutputExistsError
from .settings import PRESETS, CQNSettings

__all__ = ["PRESETS", "CQNConfig", "CQNError", "CQNSettings", "ConfigError", "DataError", "OutputExistsError"]
