"""Settings of a run (`cqn-train --help`)."""

from dataclasses import dataclass, field, fields, replace
from operator import attrgetter
from pathlib import Path

from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.robots.config import RobotConfig
from lerobot.teleoperators.config import TeleoperatorConfig

from cqn_data.hub.options import check_repo_id
from lerobot_cqn.base_config import RLConfig
from lerobot_cqn.errors import ConfigError, one_of

from .robot.settings import ArmSettings

__all__ = ["DatasetSettings", "EvalSettings", "PageSettings", "Recipe", "ReplaySettings", "RunConfig", "WandBSettings"]


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
    "updates_per_episode": 0, "batch_size": 0, "demo_batch_size": 0, "eval.n_episodes": 1,
    "eval.batch_size": 1, "eval.videos": 0, "async_updates": 0,
}  # fmt: skip


@dataclass
class DatasetSettings:
    """Demonstrations: a LeRobotDataset v3, on disk under `root` or in LeRobot's cache or on the Hub."""

    repo_id: str = ""  # as user/name; any name for a local folder
    root: str | None = None  # the dataset's folder; None: LeRobot's cache or the Hub
    episodes: list[int] | None = None  # only these episodes


@dataclass
class EvalSettings:
    """Evaluation episodes: deterministic policy, fixed seeds. On a real arm there are none unless asked for."""

    freq: int | None = None  # environment steps between evaluations, 0: none on the way; None: 1000, on an arm 0
    n_episodes: int = 20  # of each evaluation on the way
    final_n_episodes: int | None = None  # after the offline phase and at the end; None: 50, on an arm 0
    batch_size: int = 1  # episodes at a time, for one batch of actions
    use_async_envs: bool = False  # each in a process of its own: worth it with cameras and several cores
    videos: int = 0  # films of the first episodes of each evaluation, in output_dir/videos


@dataclass
class ReplaySettings:
    """Where experience is kept: in output_dir/replay, on disk, so that a kill loses no finished episode."""

    capacity_gib: float = 16.0  # of the demonstrations and the run's episodes together; the oldest make room
    sampling: str = "episodes"  # uniform over episodes, then over their steps (the reference's); or over "steps"


@dataclass
class PageSettings:
    """The operator's page of a run on an arm. Its token is new in every run, or that of CQN_PAGE_TOKEN."""

    host: str = "127.0.0.1"  # another one lets other machines reach the page: whoever has the token moves the arm
    port: int = 8765  # 0: any free one
    absent_s: float = 10.0  # seconds without a sign of the operator's page after which the arm is paused


@dataclass
class WandBSettings:
    """Weights & Biases, off by default."""

    enable: bool = False  # log to Weights & Biases (extra `wandb`)
    project: str = "lerobot"  # its project
    mode: str | None = None  # online, offline or disabled; None: its own default


@dataclass
class RunConfig:
    """Train a policy: `offline_updates` on the demonstrations, then `steps` control steps online.

    In a simulated environment (`--env.type`), or on an arm (`--robot.type`) with a person who says how episodes went.
    Update schedule, batch sizes, relabelling and action bounds left at None follow the policy's preset
    (docs/algorithm.md); on an arm updates are made between episodes.
    """

    policy: PreTrainedConfig | None = None
    env: EnvConfig | None = None
    robot: RobotConfig | None = None  # an arm instead of an environment
    teleop: TeleoperatorConfig | None = None  # leader arm with the robot's joints, to take over with
    arm: ArmSettings = field(default_factory=ArmSettings)
    operator_page: bool = True  # steer a run on an arm from a web page; false: by keys in the terminal
    page: PageSettings = field(default_factory=PageSettings)
    dataset: DatasetSettings = field(default_factory=DatasetSettings)
    output_dir: Path | None = None  # a new or empty folder for checkpoints and metrics
    resume: bool = False  # continue the run in output_dir from its last checkpoint
    seed: int = 1000  # of weights, batches, exploration and training scenes
    steps: int = 30_000  # control steps online, then the episode is finished; 0 trains offline only
    online_minutes: float | None = None  # of acting and learning, waits for a person not counted; None: `steps` alone
    offline_updates: int = 0  # updates on the demonstrations before the first step
    updates_per_step: int | None = None  # after each control step; None: the preset's
    updates_per_episode: int | None = None  # between episodes; None: the preset's
    async_updates: int = 0  # at most so many beside an episode; it acts with the policy it began with
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
        if self.policy.push_to_hub:
            check_repo_id(self.policy.repo_id or "", "--policy.repo_id")
        self._validate_arm()
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
        for name, value in (("eval.freq", self.eval_freq), ("eval.final_n_episodes", self.final_episodes)):
            if value < 0:
                raise ConfigError(f"`{name}` must be at least 0, got {value}.")
        if not 0 < self.replay.capacity_gib < float("inf"):
            raise ConfigError(f"`replay.capacity_gib` must be positive and finite, got {self.replay.capacity_gib}.")
        if self.replay.sampling not in (valid := ("episodes", "steps")):
            raise ConfigError(one_of("replay.sampling", self.replay.sampling, valid))
        if recipe.action_bounds not in (valid := ("data", "environment")):
            raise ConfigError(one_of("action_bounds", recipe.action_bounds, valid))

    def _validate_arm(self) -> None:
        if self.env is not None and self.robot is not None:
            raise ConfigError(
                "Expected either an environment or an arm, got both: leave out --env.type or --robot.type."
            )
        if self.env is None and self.robot is None:
            raise ConfigError(
                "No environment and no arm: give --env.type=..., for example --env.type=ur5e_station, or "
                "--robot.type=... (lerobot-train needs none)."
            )
        if self.online_minutes is not None and not self.online_minutes > 0:
            raise ConfigError(f"`online_minutes` must be positive, got {self.online_minutes}.")
        if self.robot is None:
            if self.teleop is not None:
                raise ConfigError("--teleop.type is the leader of an arm: give --robot.type as well, or leave it out.")
            return
        self.arm.validate()
        if self.eval.batch_size > 1 or self.eval.use_async_envs:
            raise ConfigError("There is one arm: leave out --eval.batch_size and --eval.use_async_envs.")
        if self.recipe.updates_per_step:
            raise ConfigError(
                "Updates after each step would make the arm jerk: leave out --updates_per_step, or give "
                "--updates_per_episode, or --async_updates."
            )
        if not 0 <= self.page.port <= 65535:
            raise ConfigError(f"`page.port` must be 0 to 65535, got {self.page.port}.")
        if not 1 <= self.page.absent_s <= 3600:
            raise ConfigError(f"`page.absent_s` must be 1 to 3600 seconds, got {self.page.absent_s}.")

    @property
    def eval_freq(self) -> int:
        """Environment steps between evaluations, 0 for none."""
        freq = self.eval.freq
        return freq if freq is not None else 0 if self.robot is not None else 1000

    @property
    def final_episodes(self) -> int:
        """Evaluation episodes after the offline phase and at the end."""
        count = self.eval.final_n_episodes
        return count if count is not None else 0 if self.robot is not None else 50

    @property
    def continues(self) -> bool:
        """Whether the policy exists already: it brings its features and action bounds."""
        return self.resume or (self.policy is not None and self.policy.pretrained_path is not None)

    @property
    def recipe(self) -> Recipe:
        """The preset's, with what was given on top."""
        preset = self.policy.preset if isinstance(self.policy, RLConfig) else ""
        given = {field.name: getattr(self, field.name) for field in fields(Recipe)}
        recipe = _RECIPES.get(preset, Recipe())
        if self.robot is not None:  # the paper's on a real arm: no update while it moves
            recipe = replace(recipe, updates_per_step=0, updates_per_episode=recipe.updates_per_episode or 50)
        return replace(recipe, **{k: v for k, v in given.items() if v is not None})
