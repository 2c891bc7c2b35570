"""All numbers of the algorithm in one typed record, and the published columns of them as named presets."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from .errors import ConfigError, one_of
from .ranges import check_ranges, number

__all__ = [
    "CQN_AS_PRESETS",
    "DRQV2_PRESETS",
    "PRESETS",
    "CQNASSettings",
    "CQNSettings",
    "CommonSettings",
    "DrQv2Settings",
    "resolve",
]


@dataclass(frozen=True)
class CommonSettings:
    """Numbers that every method here has: observation, networks, value distribution, losses, optimisation.

    The defaults are the paper's RLBench column (table 2) unless a comment says otherwise.
    Raises ConfigError when a value is out of its range.
    """

    # Observation
    frame_stack: int = number(8, least=1, most=32)  # S; joints and environment state are stacked like the images
    shift_pixels: int = number(4, least=0)  # random shift, 0 is off
    brightness: float = number(0.0, least=0)  # factor drawn from 1 +- this
    contrast: float = number(0.0, least=0)  # likewise, around the picture's mean
    state_bound: float = 2.0  # normalised state is cut here: demonstrations span [-1, 1]
    # Action
    action_margin: float = number(0.0, least=0)  # widens the action bounds by this share of the range, on each side
    bound_margin: float = number(0.0, least=0)  # the same by this share of each bound's own absolute value
    # Networks
    encoder_channels: tuple[int, ...] = (32, 64, 128, 256)  # of each convolution; one encoder a camera
    encoder_strides: tuple[int, ...] = ()  # of each convolution; empty: 2 each
    encoder_kernel: int = number(4, least=1, most=16)  # pixels a side of each convolution
    encoder_padding: int = number(1, least=0, most=8)  # pixels of zeros around what each convolution gets
    encoder_norm: str = "channels"  # layer norm over the channels at each pixel, or over the whole "picture"
    feature_dim: int = number(64, least=1)  # size of the projections of pictures and of numbers, before the trunk
    hidden_dim: int = number(512, least=1)  # width of the trunk
    # Value distribution
    distributional: bool = True  # False: scalar Q and squared error
    atoms: int = number(51, least=2)  # A, atoms of the value distribution
    v_min: float = -1.0  # lowest value that the distribution can hold
    v_max: float = 1.0  # highest value that the distribution can hold
    # Losses
    rl_loss_scale: float = number(0.1, least=0)  # 0 leaves imitation alone
    bc_loss_scale: float = number(1.0, least=0)  # weight of the imitation losses; 0 leaves RL alone
    discount: float = number(0.99, above=0, most=1)  # the authors' implementation; the paper gives no number
    n_step: int = number(3, least=1, most=1000)  # n, steps of reward before the value of what follows
    # Optimisation
    lr: float = number(5e-5, above=0)  # learning rate of AdamW
    weight_decay: float = number(0.1, least=0)  # of AdamW
    tau: float = number(0.02, above=0, most=1)  # share by which the target network follows in each step of its own
    target_interval: int = number(1, least=1)  # updates between steps of the target network
    # Acting
    # standard deviation of the noise on actions in [-1, 1], in training episodes only
    exploration_noise: float = number(0.01, least=0)
    # Speed
    channels_last: bool = True  # memory layout of pictures; the same numbers, faster convolutions
    bf16: bool = False  # networks in bfloat16, losses in float32

    def __post_init__(self) -> None:
        """Check ranges; every message names the field, the value found and what is allowed."""
        check_ranges(self)
        if not self.state_bound >= 1:
            raise ConfigError(
                f"`state_bound` must be at least 1 (demonstrations span [-1, 1]), got {self.state_bound}."
            )
        if not self.v_min < self.v_max:
            raise ConfigError(f"`v_min` must be below `v_max`, got {self.v_min} and {self.v_max}.")
        if not self.encoder_channels or min(self.encoder_channels) < 1:
            raise ConfigError(f"`encoder_channels` must be positive numbers, got {self.encoder_channels}.")
        if self.encoder_strides and (
            len(self.encoder_strides) != len(self.encoder_channels) or min(self.encoder_strides) < 1
        ):
            raise ConfigError(
                f"`encoder_strides` must be a positive number for each of {self.encoder_channels}, or empty, got "
                f"{self.encoder_strides}."
            )
        if self.encoder_norm not in (norms := ("channels", "picture")):
            raise ConfigError(one_of("value of `encoder_norm`", self.encoder_norm, norms))
        if self.rl_loss_scale == 0 and self.bc_loss_scale == 0:
            raise ConfigError("Nothing to learn: `rl_loss_scale` and `bc_loss_scale` are both 0; set one above 0.")

    @property
    def critic_atoms(self) -> int:
        """A: outputs of the critic per bin or action."""
        return self.atoms if self.distributional else 1


@dataclass(frozen=True)
class CQNSettings(CommonSettings):
    """Hyperparameters of CQN. Raises ConfigError when a value is out of its range."""

    # Discretisation
    levels: int = number(3, least=1, most=16)  # L, levels of zooming in
    bins: int = number(5, least=2)  # N, bins of each level
    # Losses; rl_loss_scale=0 gives the paper's CBC baseline, distributional=False also margin-only imitation
    bc_dominance: bool = True  # False: margin only
    bc_margin: float = number(0.01, least=0)  # the authors' implementation; the paper gives no number
    centralized_target: bool = False  # True: every dimension is pulled to the mean over D of the targets (robobase's)
    centralized_critic: bool = False  # True: one value for the whole action, the mean over D (an ablation of the paper)
    next_action_from: str = "online"  # the authors' double-Q style; "target" is equation 2 as written
    # Correction of another policy (`--policy.base_path`), as shares of each action dimension's range
    correction_range: float = number(0.1, above=0, most=1)  # largest correction, to either side
    correction_gripper: float = number(0.0, least=0, most=1)  # the same of a gripper; 0 leaves it to the base
    # bin where all are worth the same: the "first", or the "middle" one, which corrects nothing
    flat_bin: str = "first"
    # Acting
    act_with: str = "target"  # critic that acts: the target or the online one
    # exploring only: a spread of Q under this picks a random bin; 0 is off
    random_bin_below: float = number(1e-4, least=0)

    def __post_init__(self) -> None:
        """Check ranges, and the two choices of a critic."""
        super().__post_init__()
        for name in ("act_with", "next_action_from"):
            if getattr(self, name) not in ("online", "target"):
                raise ConfigError(one_of(f"value of `{name}`", getattr(self, name), ("online", "target")))
        if self.flat_bin not in (bins := ("first", "middle")):
            raise ConfigError(one_of("value of `flat_bin`", self.flat_bin, bins))
        if self.flat_bin == "middle" and self.bins % 2 == 0:
            raise ConfigError(f"`bins` must be odd for `flat_bin=middle`, as corrections need it, got {self.bins}.")


@dataclass(frozen=True)
class CQNASSettings(CQNSettings):
    """Hyperparameters of CQN-AS (Seo and Abbeel 2024); the defaults are the authors' configuration for RLBench.

    Raises ConfigError when a value is out of its range.
    """

    v_min: float = -2.0
    v_max: float = 2.0
    n_step: int = number(1, least=1, most=1000)
    # Sequence
    action_sequence: int = number(4, least=1, most=64)  # T, actions that the critic values at once
    # what stands for actions after the end of an episode: "zeros" or the "last" one, which are learned from like any
    # other, as the authors' code does; "mask" leaves them out of the losses
    sequence_fill: str = "zeros"
    # Networks
    gru_layers: int = number(1, least=1, most=8)  # of the core that goes along the sequence
    pixel_projection_layers: int = number(0, least=0, most=8)  # R, layers of width `hidden_dim` before the projection
    dueling: bool = True  # False: bins are valued by one stream alone
    project_state: bool = True  # False: numbers enter the trunk as they are, without a projection
    # Acting
    temporal_ensemble: bool = True  # mean of what the last T sequences say; False: a sequence is played to its end
    ensemble_gain: float = number(0.01, least=0)  # weights exp(-gain * i), i = 0 for the oldest sequence

    def __post_init__(self) -> None:
        """Check ranges, and the choice of what fills a sequence."""
        super().__post_init__()
        if self.sequence_fill not in (fills := ("zeros", "last", "mask")):
            raise ConfigError(one_of("value of `sequence_fill`", self.sequence_fill, fills))


@dataclass(frozen=True)
class DrQv2Settings(CommonSettings):
    """Hyperparameters of DrQ-v2 and DrQ-v2+; the defaults are DrQ-v2+'s column of the paper's last table.

    Raises ConfigError when a value is out of its range.
    """

    atoms: int = number(101, least=2)
    hidden_dim: int = number(1024, least=1)  # the authors' code; the paper gives no number
    rl_loss_scale: float = number(1.0, least=0)
    bc_sum: bool = True  # imitation sums over dimensions, as the authors' code; False: their mean
    two_hot_target: bool = True  # target of the lower scalar as two atoms, as the authors' code; False: a projection
    lr: float = number(1e-4, above=0)
    tau: float = number(0.01, above=0, most=1)
    noise_clip: float = number(0.3, least=0)  # of the noise on actions inside the losses (Yarats et al. 2022)


_DMC: dict[str, Any] = {
    # Appendix "DeepMind Control Experiments": value bounds, exploration noise; no demonstrations, and so no statistics
    # to scale the state by, which is why it is not cut either.
    "v_min": 0.0, "v_max": 200.0, "exploration_noise": 0.1, "bc_loss_scale": 0.0, "rl_loss_scale": 1.0,
    "state_bound": 1e6,
}  # fmt: skip

PRESETS: dict[str, dict[str, Any]] = {
    "paper_rlbench": {},
    # Table 2, real-world column.
    "paper_real_world": {"frame_stack": 4, "levels": 4, "bins": 3, "brightness": 0.2, "contrast": 0.2},
    "paper_dmc_state": {**_DMC, "frame_stack": 1},
    "paper_dmc_pixels": {**_DMC, "frame_stack": 3},
    # The authors' implementation where it differs from the paper (docs/algorithm.md).
    "reference_rlbench": {"n_step": 1, "v_min": -2.0, "v_max": 2.0, "bound_margin": 0.2},
    # The authors' code for DeepMind Control: Adam without decay, the online critic acts, another encoder; an update in
    # two steps after 2,000 uniform ones (`Recipe`). For states, which it has not: the same with scalar values.
    "reference_dmc_pixels": {
        **_DMC,
        "frame_stack": 3,
        "lr": 1e-4,
        "weight_decay": 0.0,
        "act_with": "online",
        "encoder_channels": (32, 32, 32, 32),
        "encoder_strides": (2, 1, 1, 1),
        "encoder_kernel": 3,
        "encoder_padding": 0,
        "encoder_norm": "picture",
    },
    "reference_dmc_state": {
        **_DMC,
        "frame_stack": 1,
        "lr": 1e-4,
        "weight_decay": 0.0,
        "act_with": "online",
        "distributional": False,
    },
    # Ours: joints and object poses, no camera, a laptop. Small network, one frame, larger steps.
    "laptop_state": {"frame_stack": 1, "hidden_dim": 256, "lr": 3e-4},
    # Ours: two small cameras on a laptop or one GPU.
    "laptop_pixels": {"frame_stack": 2, "encoder_channels": (16, 32, 64, 64), "hidden_dim": 256, "lr": 1e-4},
    # Ours: practice from states. History that is not squeezed, and RL that weighs as much as imitation
    # (docs/algorithm.md, "Practice").
    "practice_state": {"frame_stack": 8, "feature_dim": 256, "hidden_dim": 256, "lr": 3e-4, "rl_loss_scale": 1.0},
}


_LAPTOP: dict[str, Any] = {"v_min": -1.0, "v_max": 1.0, "n_step": 3, "sequence_fill": "mask"}
CQN_AS_PRESETS: dict[str, dict[str, Any]] = {
    # The authors' configurations.
    "cqn_as_rlbench": {"bound_margin": 0.2},
    "cqn_as_bigym": {
        "frame_stack": 4, "action_sequence": 16, "pixel_projection_layers": 2, "bc_margin": 0.1,
        "sequence_fill": "last",
    },
    # State and dense rewards, no demonstrations: scalar values, one stream, a hard copy as the target.
    "cqn_as_humanoid": {
        "frame_stack": 1, "hidden_dim": 1024, "distributional": False, "dueling": False, "project_state": False,
        "bc_loss_scale": 0.0, "rl_loss_scale": 1.0, "n_step": 3, "tau": 1.0, "target_interval": 100,
        "act_with": "online", "sequence_fill": "last", "state_bound": 1e6,
    },
    # Ours: CQN's presets of the same names, with sequences; what lies beyond an episode's end is not learned from.
    "laptop_state": {**PRESETS["laptop_state"], **_LAPTOP},
    "laptop_pixels": {**PRESETS["laptop_pixels"], **_LAPTOP},
}  # fmt: skip

_DRQV2: dict[str, Any] = {"distributional": False, "exploration_noise": 0.2, "weight_decay": 0.0}
_REAL_WORLD: dict[str, Any] = {"frame_stack": 4, "brightness": 0.2, "contrast": 0.2}
_MEANS: dict[str, Any] = {"bc_sum": False, "two_hot_target": False}
DRQV2_PRESETS: dict[str, dict[str, Any]] = {
    # Last table of the paper's appendix, RLBench and the real arm.
    "drqv2_plus": {},
    "drqv2": _DRQV2,
    "drqv2_plus_real_world": _REAL_WORLD,
    "drqv2_real_world": {**_DRQV2, **_REAL_WORLD},
    # Ours: DrQ-v2+ at the sizes and learning rates of CQN's presets of the same names.
    "laptop_state": {"frame_stack": 1, "hidden_dim": 256, "lr": 3e-4, **_MEANS},
    "laptop_pixels": {
        "frame_stack": 2, "encoder_channels": (16, 32, 64, 64), "hidden_dim": 256, "lr": 1e-4, **_MEANS,
    },
}  # fmt: skip


def resolve[S: CommonSettings](
    kind: type[S], presets: Mapping[str, Mapping[str, Any]], preset: str, overrides: Mapping[str, Any]
) -> S:
    """Settings of a preset with the given fields replaced; None leaves the preset's value.

    Raises ConfigError for an unknown preset or a value out of range.
    """
    if preset not in presets:
        raise ConfigError(one_of("preset", preset, presets))
    names = {field.name for field in fields(kind)}
    given = {name: value for name, value in overrides.items() if value is not None and name in names}
    given |= {name: tuple(given[name]) for name in ("encoder_channels", "encoder_strides") if name in given}
    return replace(kind(**presets[preset]), **given)
