"""CQNConfig: what LeRobot parses, saves and hands to the policy (`--policy.type=cqn`)."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from lerobot.configs.policies import PreTrainedConfig

from .base_config import RLConfig, given_fields
from .settings import PRESETS, CQNSettings, resolve

__all__ = ["CQNConfig"]


@PreTrainedConfig.register_subclass("cqn")
@dataclass
class CQNConfig(RLConfig):
    """Coarse-to-fine Q-Network (Seo, Uruç, James 2024).

    `preset` names a column of published numbers (paper_rlbench, paper_real_world, paper_dmc_state,
    paper_dmc_pixels), the authors' code (reference_rlbench, reference_dmc_state, reference_dmc_pixels) or one of ours
    (laptop_state, laptop_pixels, practice_state); every field left at None takes the preset's value, every field given
    replaces it. Read the result from `settings`.
    Meaning, range and source of each number: `lerobot_cqn/settings.py`.

    Raises ConfigError for an unknown preset or a value out of range.
    """

    preset: str = "paper_rlbench"

    # Discretisation
    levels: int | None = None
    bins: int | None = None
    # Losses
    bc_dominance: bool | None = None
    bc_margin: float | None = None
    centralized_target: bool | None = None
    centralized_critic: bool | None = None
    next_action_from: str | None = None
    # Correction of another policy
    correction_range: float | None = None
    correction_gripper: float | None = None
    flat_bin: str | None = None
    # Acting
    act_with: str | None = None
    random_bin_below: float | None = None

    @cached_property
    def settings(self) -> CQNSettings:
        """The preset with this config's fields on top."""
        return resolve(CQNSettings, PRESETS, self.preset, self.correcting() | given_fields(self))

    def correcting(self) -> dict[str, Any]:
        """Settings that follow from correcting another policy: it begins as that policy, and so without random bins."""
        return {} if self.base_path is None else {"flat_bin": "middle", "random_bin_below": 0.0}
