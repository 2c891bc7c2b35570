"""CQNASConfig: CQN over action sequences (`--policy.type=cqn_as`)."""

from dataclasses import dataclass
from functools import cached_property

from lerobot.configs.policies import PreTrainedConfig

from .base_config import given_fields
from .configuration_cqn import CQNConfig
from .settings import CQN_AS_PRESETS, CQNASSettings, resolve

__all__ = ["CQNASConfig"]


@PreTrainedConfig.register_subclass("cqn_as")
@dataclass
class CQNASConfig(CQNConfig):
    """CQN-AS (Seo and Abbeel 2024): CQN whose critic values each of the next T actions.

    `preset` is one of the authors' configurations (cqn_as_rlbench, cqn_as_bigym, cqn_as_humanoid) or one of ours
    (laptop_state, laptop_pixels: CQN's of these names, with sequences); every field left at None takes the preset's
    value, every field given replaces it. Read the result from `settings`.
    Meaning, range and source of each number: `lerobot_cqn/settings.py`.

    Raises ConfigError for an unknown preset or a value out of range.
    """

    preset: str = "cqn_as_rlbench"

    # Sequence
    action_sequence: int | None = None
    sequence_fill: str | None = None
    # Networks
    gru_layers: int | None = None
    pixel_projection_layers: int | None = None
    dueling: bool | None = None
    project_state: bool | None = None
    # Acting
    temporal_ensemble: bool | None = None
    ensemble_gain: float | None = None

    @cached_property
    def settings(self) -> CQNASSettings:
        """The preset with this config's fields on top."""
        return resolve(CQNASSettings, CQN_AS_PRESETS, self.preset, given_fields(self))

    @property
    def action_delta_indices(self) -> list[int]:
        """The actions of the sequence."""
        return list(range(self.settings.action_sequence))
