"""DrQv2Config: the paper's actor-critic baselines (`--policy.type=drqv2`)."""

from dataclasses import dataclass
from functools import cached_property

from lerobot.configs.policies import PreTrainedConfig

from .base_config import RLConfig, given_fields
from .settings import DRQV2_PRESETS, DrQv2Settings, resolve

__all__ = ["DrQv2Config"]


@PreTrainedConfig.register_subclass("drqv2")
@dataclass
class DrQv2Config(RLConfig):
    """DrQ-v2 (Yarats et al. 2022) and DrQ-v2+, the baselines that the paper compares CQN with.

    `preset` is drqv2_plus (distributional critic and the paper's recipes for demonstrations) or drqv2, either with
    _real_world after it for the paper's real arm, or one of ours (laptop_state, laptop_pixels: DrQ-v2+ at the sizes of
    CQN's presets of these names); every field left at None takes the preset's value, every field given replaces it.
    Read the result from `settings`.
    Meaning, range and source of each number: `lerobot_cqn/settings.py`.

    Raises ConfigError for an unknown preset or a value out of range.
    """

    preset: str = "drqv2_plus"
    noise_clip: float | None = None
    bc_sum: bool | None = None
    two_hot_target: bool | None = None

    @cached_property
    def settings(self) -> DrQv2Settings:
        """The preset with this config's fields on top."""
        return resolve(DrQv2Settings, DRQV2_PRESETS, self.preset, given_fields(self))
