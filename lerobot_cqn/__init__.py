"""Coarse-to-fine Q-Network (Seo, Uruç, James 2024) as a LeRobot policy.

Names that need PyTorch or LeRobot are imported on use, so that commands which need only the errors answer at once. The
policies are registered with LeRobot by `lerobot_policy_cqn`, which its discovery imports, or by importing the modules
of a configuration and of `processors`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .errors import ConfigError, CQNError, DataError, OutputError, OutputExistsError
from .settings import CQN_AS_PRESETS, DRQV2_PRESETS, PRESETS, CQNASSettings, CQNSettings, DrQv2Settings

if TYPE_CHECKING:
    from .configuration_cqn import CQNConfig
    from .configuration_cqn_as import CQNASConfig
    from .configuration_drqv2 import DrQv2Config
    from .processors import BoundObservationProcessorStep

__all__ = [
    "CQN_AS_PRESETS",
    "DRQV2_PRESETS",
    "PRESETS",
    "BoundObservationProcessorStep",
    "CQNASConfig",
    "CQNASSettings",
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

_ON_USE = {
    "BoundObservationProcessorStep": "processors",
    "CQNASConfig": "configuration_cqn_as",
    "CQNConfig": "configuration_cqn",
    "DrQv2Config": "configuration_drqv2",
}


def __getattr__(name: str) -> Any:
    if name not in _ON_USE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_ON_USE[name]}", __name__), name)
