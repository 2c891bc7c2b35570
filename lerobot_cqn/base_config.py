"""Base of the configurations of all methods here: fields, LeRobot's questions, saving."""

import json
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import draccus
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.optim.optimizers import AdamWConfig
from lerobot.optim.schedulers import LRSchedulerConfig
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE

from .errors import ConfigError
from .schema import BASE_ACTION
from .settings import CommonSettings

__all__ = ["RLConfig", "given_fields"]


@dataclass
class RLConfig(PreTrainedConfig):
    """Base of the policies' configurations; every field left at None takes the preset's value.

    Read the result from `settings`. Raises ConfigError for an unknown preset or a value out of range.
    """

    preset: str = ""
    # policy to correct: its `pretrained_model` folder, or its name on the Hub, with a branch, tag or commit
    base_path: str | None = None
    base_revision: str | None = None

    # Observation
    frame_stack: int | None = None
    shift_pixels: int | None = None
    brightness: float | None = None
    contrast: float | None = None
    state_bound: float | None = None
    # Action
    action_margin: float | None = None
    bound_margin: float | None = None
    # Networks
    encoder_channels: tuple[int, ...] | None = None
    encoder_strides: tuple[int, ...] | None = None
    encoder_kernel: int | None = None
    encoder_padding: int | None = None
    encoder_norm: str | None = None
    feature_dim: int | None = None
    hidden_dim: int | None = None
    # Value distribution
    distributional: bool | None = None
    atoms: int | None = None
    v_min: float | None = None
    v_max: float | None = None
    # Losses
    rl_loss_scale: float | None = None
    bc_loss_scale: float | None = None
    discount: float | None = None
    n_step: int | None = None
    # Optimisation
    lr: float | None = None
    weight_decay: float | None = None
    tau: float | None = None
    target_interval: int | None = None
    # Acting
    exploration_noise: float | None = None
    # Speed
    channels_last: bool | None = None
    bf16: bool | None = None

    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,  # the network scales pixels itself
            "STATE": NormalizationMode.MIN_MAX,
            "ENV": NormalizationMode.MIN_MAX,
            "ACTION": NormalizationMode.MIN_MAX,  # the paper's data-driven action bounds
        }
    )
    # LeRobot's default would push every run; we push on request only.
    push_to_hub: bool = False

    def __post_init__(self) -> None:
        """Let LeRobot choose the device, then check every number; a base's folder is named as it is from anywhere."""
        super().__post_init__()
        if self.base_path is not None and Path(self.base_path).exists():
            self.base_path = str(Path(self.base_path).resolve())
        _ = self.settings

    @cached_property
    def settings(self) -> CommonSettings:
        """The preset with this config's fields on top."""
        raise NotImplementedError

    def refuse_local_base(self) -> None:
        """Make sure that others can have the base too. Raises ConfigError where it is a folder of this machine."""
        if self.base_path is not None and Path(self.base_path).exists():
            raise ConfigError(
                f"Others have no {self.base_path}: push the base policy first, and give its name on the Hub as "
                "--policy.base_path."
            )

    # -- what LeRobot asks a policy config -------------------------------------------------------------------

    @property
    def observation_delta_indices(self) -> list[int]:
        """Frames of the current stack and, when RL is on, of the stack n steps later."""
        s = self.settings
        now = set(range(1 - s.frame_stack, 1))
        if s.rl_loss_scale == 0:
            return sorted(now)
        if s.frame_stack > 2:  # where an episode ends inside the window, the later stack reaches back between them
            return list(range(1 - s.frame_stack, s.n_step + 1))
        return sorted(now | {index + s.n_step for index in now})

    @property
    def action_delta_indices(self) -> list[int]:
        """The action of the current step only."""
        return [0]

    @property
    def reward_delta_indices(self) -> list[int]:
        """The rewards of the n-step window."""
        return list(range(self.settings.n_step))

    def get_optimizer_preset(self) -> AdamWConfig:
        """AdamW; no gradient clipping, as in the paper."""
        s = self.settings
        return AdamWConfig(lr=s.lr, weight_decay=s.weight_decay, betas=(0.9, 0.999), grad_clip_norm=0.0)

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        """The paper uses a constant learning rate."""
        return None

    @property
    def low_dim_features(self) -> dict[str, PolicyFeature]:
        """Robot and environment state, and the base's action, in the order the network sees them."""
        known = self.input_features or {}
        return {key: known[key] for key in (OBS_STATE, OBS_ENV_STATE, BASE_ACTION) if key in known}

    def validate_features(self) -> None:
        """Check that there is something to see and something to do.

        Raises ConfigError when there is no observation, no action vector, or an image is not channels-first.
        """
        if not self.image_features and not self.low_dim_features:
            raise ConfigError(
                f"Nothing to observe: expected cameras (observation.images.*), {OBS_STATE} or {OBS_ENV_STATE}, "
                f"found {sorted(self.input_features or {})}."
            )
        action = self.action_feature
        if action is None or action.type is not FeatureType.ACTION or len(action.shape) != 1:
            found = None if action is None else action.shape
            raise ConfigError(f"Expected one action vector under 'action', found {found}.")
        for key, feature in self.image_features.items():
            if len(feature.shape) != 3 or feature.shape[0] not in (1, 3):
                raise ConfigError(f"Expected images of shape (3, height, width), found {feature.shape} for '{key}'.")

    def _save_pretrained(self, save_directory: Path) -> None:
        """Save with every number written out, so that later changes of a preset do not change a checkpoint."""
        super()._save_pretrained(save_directory)
        path = save_directory / "config.json"
        saved: dict[str, Any] = json.loads(path.read_text())
        saved.update(draccus.encode(asdict(self.settings)))
        saved.update(push_to_hub=False, repo_id=None)  # whoever continues from it must not push over its owner's
        path.write_text(json.dumps(saved, indent=4))


def given_fields(config: RLConfig) -> dict[str, Any]:
    """Fields of a config that are not None by name, nested features not copied."""
    return {f.name: value for f in fields(config) if (value := getattr(config, f.name)) is not None}
