"""Settings of a run (`cqn-train --help`)."""

from dataclasses import dataclass, field, fields, replace
from operator import attrgetter
from pathlib import Path

from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig

from lerobot_cqn.base_config import RLConfig
from lerobot_cqn.errors import ConfigError, one_of

__all__ = ["DatasetSettings", "EvalSettings", "Recipe", "ReplaySettings", "RunConfig", "WandBSettings"]


@dataclass(frozen=True)
class Recipe:
    """How a run learns, where the paper gives each method numbers of its own; the defaults are CQN's on RLBench."""

    updates_per_step: int = 1  # after each control step
    updates_per_episode: int = 0  # between episodes
    batch_size: int = 256  # from everything seen
    demo_batch_size: int = 256  # from demonstrations and successes, on top
    relabel: bool = True  # successful online episodes become demonstrations
    action_bounds: str = "data"  # action -1..1 is the demonstrations' range, or that of the "environment"


# Of each policy preset (table 2 and the last table of the appendix); presets that are not here use the defaults.
_RECIPES: dict[str, Recipe] = {
    "paper_real_world": Recipe(updates_per_step=0, updates_per_episode=50),
    "paper_dmc_state": Recipe(batch_size=512, demo_batch_size=0, action_bounds="environment"),
    "paper_dmc_pixels": Recipe(demo_batch_size=0, action_bounds="environment"),
    "laptop_state": Recipe(batch_size=64, demo_batch_size=64),
    "laptop_pixels": Recipe(updates_per_step=0, updates_per_episode=25, batch_size=64, demo_batch_size=64),
    "drqv2": Recipe(batch_size=512, demo_batch_size=0, relabel=False, action_bounds="environment"),
}


_LEAST: dict[str, int] = {
    "steps": 0, "offline_updates": 0, "save_freq": 1, "log_freq": 1, "threads": 0, "seed": 0, "updates_per_step": 0,
    "updates_per_episode": 0, "batch_size": 0, "demo_batch_size": 0, "eval.n_episodes": 1, "eval.final_n_episodes": 1,
    "eval.batch_size": 1, "eval.videos": 0,
}  # fmt: skip


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
    batch_size: int = 1  # episodes at a time, for one batch of actions
    use_async_envs: bool = False  # each in a process of its own: worth it with cameras and several cores
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
    """Train a policy: `offline_updates` on the demonstrations, then `steps` control steps online.

    Update schedule, batch sizes, relabelling and action bounds left at None follow the policy's preset
    (docs/algorithm.md).
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
    relabel: bool | None = None  # successful online episodes become demonstrations; None: the preset's
    action_bounds: str | None = None  # -1..1 is the range of the "data" or of the "environment"; None: the preset's
    save_freq: int = 5000  # environment steps between checkpoints; the end and an interrupt always save
    log_freq: int = 50  # updates between rows of updates.csv
    threads: int = 0  # torch threads; 0 leaves torch's choice
    replay: ReplaySettings = field(default_factory=ReplaySettings)
    eval: EvalSettings = field(default_factory=EvalSettings)
    tensorboard: bool = False  # the tables as TensorBoard events in output_dir/tensorboard, too
    wandb: WandBSettings = field(default_factory=WandBSettings)

    def validate(self) -> None:
        """Check what can be checked before work starts. Raises ConfigError."""
        if self.policy is None:
            raise ConfigError("No policy: give --policy.type=cqn, or --policy.path=CHECKPOINT to continue from one.")
        if not isinstance(self.policy, RLConfig):
            raise ConfigError(
                f"cqn-train trains --policy.type=cqn or drqv2, got '{self.policy.type}': use lerobot-train for that."
            )
        if self.output_dir is None:
            raise ConfigError("No output directory: give --output_dir=DIR.")
        if self.env is None:
            raise ConfigError(
                "No environment: give --env.type=..., for example --env.type=ur5e_station (lerobot-train needs none)."
            )
        recipe = self.recipe
        learns_from_data = recipe.demo_batch_size > 0 or self.offline_updates > 0
        if not self.dataset.repo_id and (learns_from_data or (recipe.action_bounds == "data" and not self.continues)):
            raise ConfigError(
                "No demonstrations: give --dataset.repo_id=... (and --dataset.root=DIR when it is local), or train "
                "without: --demo_batch_size=0 --action_bounds=environment --offline_updates=0."
            )
        for name, least in _LEAST.items():
            value = attrgetter(name)(recipe if hasattr(recipe, name) else self)
            if value < least:
                raise ConfigError(f"`{name}` must be at least {least}, got {value}.")
        if not 0 < self.replay.capacity_gib < float("inf"):
            raise ConfigError(f"`replay.capacity_gib` must be positive and finite, got {self.replay.capacity_gib}.")
        if self.replay.sampling not in (valid := ("episodes", "steps")):
            raise ConfigError(one_of("replay.sampling", self.replay.sampling, valid))
        if recipe.action_bounds not in (valid := ("data", "environment")):
            raise ConfigError(one_of("action_bounds", recipe.action_bounds, valid))

    @property
    def continues(self) -> bool:
        """Whether the policy exists already: it brings its features and action bounds."""
        return self.resume or (self.policy is not None and self.policy.pretrained_path is not None)

    @property
    def recipe(self) -> Recipe:
        """The preset's, with what was given on top."""
        preset = self.policy.preset if isinstance(self.policy, RLConfig) else ""
        given = {field.name: getattr(self, field.name) for field in fields(Recipe)}
        return replace(_RECIPES.get(preset, Recipe()), **{k: v for k, v in given.items() if v is not None})
