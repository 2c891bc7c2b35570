"""Coarse-to-fine Q-Network (Seo, Uruç, James 2024) as a LeRobot policy.

Importing this package registers `--policy.type=cqn` with LeRobot, and the processor step that its checkpoints name:
LeRobot imports a policy's processors only when it makes new ones, not when it loads saved ones.
"""

from .configuration_cqn import CQNConfig
from .errors import ConfigError, CQNError, DataError, OutputError, OutputExistsError
from .processor_cqn import BoundObservationProcessorStep
from .settings import PRESETS, CQNSettings

__all__ = [
    "PRESETS",
    "BoundObservationProcessorStep",
    "CQNConfig",
    "CQNError",
    "CQNSettings",
    "ConfigError",
    "DataError",
    "OutputError",
    "OutputExistsError",
]
