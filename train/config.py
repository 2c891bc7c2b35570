"""Settings of a run (`cqn-train --help`)."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig

from lerobot_cqn.configuration_cqn import CQNConfig
from lerobot_cqn.errors import ConfigError, one_of

__all__ = ["DatasetSettings", "EvalSettings", "ReplaySettings", "RunConfig", "WandBSettings"]

# Update schedule and batches of each policy preset (table 2); presets that are not here use the first.
_SCHEDULES: dict[str, dict[str, int]] = {
    "paper_rlbench": {"updates_per_step": 1, "updates_per_episode": 0, "batch_size": 256, "demo_batch_size": 256},
    "paper_real_world": {"updates_per_step": 0, "updates_per_episode": 50, "batch_size": 256, "demo_batch_size": 256},
    "paper_dmc_state": {"updates_per_step": 1, "updates_per_episode": 0, "batch_size": 512, "demo_batch_size": 0},
    "paper_dmc_pixels": {"updates_per_step": 1, "updates_per_episode": 0, "batch_size": 256, "demo_batch_size": 0},
    "laptop_state": {"updates_per_step": 1, "updates_per_episode": 0, "batch_size": 64, "demo_batch_size": 64},
    "laptop_pixels": {"updates_per_step": 0, "updates_per_episode": 25, "batch_size": 64, "demo_batch_size": 64},
}


@dataclass
class DatasetSettings:
    """Demonstrations: a LeRobotDataset v3, on disk under `root` or in LeRobot's cache or on the Hub."""

    repo_id: str = ""  # as user/name; any name for a local folder
    root: str | None = None  # the dataset's folder; None: LeRobot's cache or the Hub
    episodes: list[int] | None = None  # only these episodes


@dataclass
class EvalSettings:
    """Evaluation episodes: deterministic policy, fixed seeds."""

    freq: int = 1000  # environment steps between evaluations; 0: only after the offline phase and at the end
    n_episodes: int = 20  # of each evaluation on the way
    final_n_episodes: int = 50  # after the offline phase and at the end
    videos: int = 0  # films of the first episodes of each evaluation, in output_dir/videos


@dataclass
class ReplaySettings:
    """Where experience is kept: in output_dir/replay, on disk, so that a kill loses no finished episode."""

    capacity_gib: float = 16.0  # of the demonstrations and the run's episodes together; the oldest make room
    sampling: str = "episodes"  # uniform over episodes, then over their steps (the reference's); or over "steps"


@dataclass
class WandBSettings:
    """Weights & Biases, off by default."""

    enable: bool = False
    project: str = "lerobot"
    mode: str | None = None


@dataclass
class RunConfig:
    """Train CQN: `offline_updates` on the demonstrations, then `steps` control steps online.

    Update schedule and batch sizes left at None follow the policy's preset (docs/algorithm.md).
    """

    policy: PreTrainedConfig | None = None
    env: EnvConfig | None = None
    dataset: DatasetSettings = field(default_factory=DatasetSettings)
    output_dir: Path | None = None  # a new or empty folder for checkpoints and metrics
    resume: bool = False  # continue the run in output_dir from its last checkpoint
    seed: int = 1000  # of weights, batches, exploration and training scenes
    steps: int = 30_000  # control steps online, then the episode is finished; 0 trains offline only
    offline_updates: int = 0  # updates on the demonstrations before the first step
    updates_per_step: int | None = None  # after each control step; None: the preset's
    updates_per_episode: int | None = None  # between episodes; None: the preset's
    batch_size: int | None = None  # from everything seen; None: the preset's
    demo_batch_size: int | None = None  # from demonstrations and successes, on top; None: the preset's
    relabel: bool = True  # successful online episodes become demonstrations
    save_freq: int = 5000  # environment steps between checkpoints; the end and an interrupt always save
    log_freq: int = 50  # updates between rows of updates.csv
    threads: int = 0  # torch threads; 0 leaves torch's choice
    replay: ReplaySettings = field(default_factory=ReplaySettings)
    eval: EvalSettings = field(default_factory=EvalSettings)
    wandb: WandBSettings = field(default_factory=WandBSettings)

    def validate(self) -> None:
        """Check what can be checked before work starts. Raises ConfigError."""
        if self.policy is None:
            raise ConfigError("No policy: give --policy.type=cqn, or --policy.path=CHECKPOINT to continue from one.")
        if not isinstance(self.policy, CQNConfig):
            raise ConfigError(f"cqn-train trains --policy.type=cqn, got '{self.policy.type}'.")
        if self.output_dir is None:
            raise ConfigError("No output directory: give --output_dir=DIR.")
        if self.env is None:
            raise ConfigError("No environment: give --env.type=..., for example --env.type=ur5e_station.")
        if not self.dataset.repo_id and self.schedule["demo_batch_size"] > 0:
            raise ConfigError(
                "No demonstrations: give --dataset.repo_id=... (and --dataset.root=DIR when it is local)."
            )
        low = {"steps": 0, "offline_updates": 0, "save_freq": 1, "log_freq": 1, "threads": 0, "seed": 0}
        for name, least in {**low, **dict.fromkeys(self.schedule, 0)}.items():
            value = self.schedule.get(name, getattr(self, name))
            if value < least:
                raise ConfigError(f"`{name}` must be at least {least}, got {value}.")
        if self.eval.final_n_episodes < 1 or self.eval.n_episodes < 1:
            raise ConfigError("`eval.n_episodes` and `eval.final_n_episodes` must be at least 1.")
        if self.eval.videos < 0:
            raise ConfigError(f"`eval.videos` must be at least 0, got {self.eval.videos}.")
        if not 0 < self.replay.capacity_gib < float("inf"):
            raise ConfigError(f"`replay.capacity_gib` must be positive and finite, got {self.replay.capacity_gib}.")
        if self.replay.sampling not in (valid := ("episodes", "steps")):
            raise ConfigError(one_of("replay.sampling", self.replay.sampling, valid))

    @property
    def schedule(self) -> dict[str, int]:
        """Updates per step and per episode, batch sizes: the preset's, or those given."""
        preset = self.policy.preset if isinstance(self.policy, CQNConfig) else ""
        default = _SCHEDULES.get(preset, _SCHEDULES["paper_rlbench"])
        given: dict[str, Any] = {name: getattr(self, name) for name in default}
        return {name: default[name] if value is None else value for name, value in given.items()}
