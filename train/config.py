"""Settings of a run (`cqn-train --help`)."""

from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.robots.config import RobotConfig
from lerobot.teleoperators.config import TeleoperatorConfig

from cqn_data.hub.options import check_repo_id
from lerobot_cqn.base_config import RLConfig
from lerobot_cqn.errors import ConfigError, one_of
from lerobot_cqn.ranges import check_ranges, number

from .robot.settings import ArmSettings

__all__ = [
    "DatasetSettings",
    "EvalSettings",
    "PageSettings",
    "RaySettings",
    "Recipe",
    "ReplaySettings",
    "RunConfig",
    "ValidRun",
    "WandBSettings",
]


@dataclass(frozen=True)
class Recipe:
    """Schedule of a run, where the paper gives each method numbers of its own; the defaults are CQN's on RLBench."""

    updates_per_step: int = number(1, least=0, most=1000)  # after control steps
    update_interval: int = number(
        1, least=1, most=1000
    )  # control steps from one to the next after which there are some
    updates_per_episode: int = number(0, least=0, most=100_000)  # between episodes
    batch_size: int = number(256, least=0, most=65_536)  # from everything seen
    demo_batch_size: int = number(256, least=0, most=65_536)  # from demonstrations and successes, on top
    relabel: bool = True  # successful online episodes become demonstrations
    random_steps: int = number(0, least=0)  # first control steps, of uniform actions and without updates
    action_bounds: str = "data"  # action -1..1 is the demonstrations' range, or that of the "environment"

    def updates_of_steps(self, before: int, after: int) -> int:
        """Updates that the control steps numbered `before` + 1 to `after` bring along."""
        first = max(before, min(after, self.random_steps))
        return self.updates_per_step * (after // self.update_interval - first // self.update_interval)

    def updates_of_episode(self, steps: int) -> int:
        """Updates after an episode that ends with control step number `steps`."""
        return self.updates_per_episode if steps > self.random_steps else 0


_REFERENCE_DMC = Recipe(update_interval=2, demo_batch_size=0, random_steps=2000, action_bounds="environment")
# Of each policy preset (table 2 and the last table of the appendix); presets that are not here use the defaults.
_RECIPES: dict[str, Recipe] = {
    "paper_real_world": Recipe(updates_per_step=0, updates_per_episode=50),
    "paper_dmc_state": Recipe(batch_size=512, demo_batch_size=0, action_bounds="environment"),
    "paper_dmc_pixels": Recipe(demo_batch_size=0, action_bounds="environment"),
    "reference_dmc_state": _REFERENCE_DMC,
    "reference_dmc_pixels": _REFERENCE_DMC,
    "laptop_state": Recipe(batch_size=64, demo_batch_size=64),
    "laptop_pixels": Recipe(updates_per_step=0, updates_per_episode=25, batch_size=64, demo_batch_size=64),
    "practice_state": Recipe(updates_per_step=0, updates_per_episode=25, batch_size=64, demo_batch_size=64),
    # CQN-AS (lerobot_cqn/settings.py); on RLBench and BiGym the authors' schedule is CQN's.
    "cqn_as_humanoid": Recipe(
        update_interval=2, batch_size=128, demo_batch_size=0, random_steps=10_000, action_bounds="environment"
    ),
    "drqv2": Recipe(batch_size=512, demo_batch_size=0, relabel=False, action_bounds="environment"),
    "drqv2_plus_real_world": Recipe(updates_per_step=0, updates_per_episode=50),
    "drqv2_real_world": Recipe(
        updates_per_step=0, updates_per_episode=50, batch_size=512, demo_batch_size=0, relabel=False
    ),
}


@dataclass
class DatasetSettings:
    """Demonstrations: a LeRobotDataset v3, on disk under `root` or in LeRobot's cache or on the Hub."""

    repo_id: str = ""  # as user/name; any name for a local folder
    root: str | None = None  # the dataset's folder; None: LeRobot's cache or the Hub
    episodes: list[int] | None = None  # only these episodes


@dataclass
class EvalSettings:
    """Evaluation episodes: deterministic policy, fixed seeds. On a real arm there are none unless asked for."""

    # environment steps between evaluations, 0: none on the way; None: 1000 or a tenth of `steps`, on an arm 0
    freq: int | None = number(None, least=0)
    n_episodes: int = number(20, least=1)  # of each evaluation on the way
    # after the offline phase and at the end; None: 50, on an arm 0
    final_n_episodes: int | None = number(None, least=0)
    batch_size: int = number(1, least=1)  # episodes at a time, for one batch of actions
    use_async_envs: bool = False  # each in a process of its own: worth it with cameras and several cores
    videos: int = number(0, least=0)  # films of the first episodes of each evaluation, in output_dir/videos


@dataclass
class ReplaySettings:
    """The replay, in output_dir/replay on disk, so that a kill loses no finished episode."""

    # of the demonstrations and the run's episodes together; the oldest make room
    capacity_gib: float = number(16.0, above=0)
    accept_loss: bool = False  # go on with --resume where episodes of the replay are damaged or gone
    full_windows: bool = False  # start no n-step window that the episode's end would shorten, as the reference
    sampling: str = "episodes"  # uniform over episodes, then over their steps (the reference's); or over "steps"


@dataclass
class PageSettings:
    """The operator's page of a run on an arm. Its token is new in every run, or that of CQN_PAGE_TOKEN."""

    host: str = "127.0.0.1"  # another one lets other machines reach the page: whoever has the token moves the arm
    port: int = number(8765, least=0, most=65535)  # 0: any free one
    tls: bool = False  # https, by a certificate made in output_dir/page; the browser asks once whether to trust it
    certfile: str | None = None  # https by this certificate (PEM) instead
    keyfile: str | None = None  # its key, without a password
    # seconds without a sign of the operator's page after which the arm is paused
    absent_s: float = number(10.0, least=1, most=3600, unit="seconds")


@dataclass
class RaySettings:
    """Acting in other processes, on this machine or on others, by Ray (docs/scale.md)."""

    # collectors, each with an environment or an arm of its own, beside the process that learns; 0: all in one process
    actors: int = number(0, least=0, most=1024)
    # of a cluster that runs, as HOST:PORT or "auto"; None: one that lives on this machine while the run does
    address: str | None = None
    robot_resource: str = ""  # of the cluster's nodes; each collector takes one, so that it is where its arm is
    # settings of single collectors on top, e.g. [{robot.port: /dev/ttyACM0}, {robot.port: /dev/ttyACM2}]
    each: list[dict[str, Any]] = field(default_factory=list)
    # updates that may still be owed when an episode begins; 0: none, so that it begins with what all before it taught
    max_staleness: int = number(200, least=0)
    device: str = "cpu"  # that collectors choose actions on
    # join a cluster whose ports other machines reach although it asks for no token: whoever reaches them controls it
    open_network: bool = False

    def validate(self, *, beside: int, resumed: bool) -> None:
        """Raises ConfigError for values out of range, or where some have no effect.

        beside: `async_updates`; resumed: the run goes on, perhaps without the collectors that it had.
        """
        check_ranges(self, "ray.")
        if self.actors and beside:
            raise ConfigError("With collectors learning goes on beside acting: leave out --async_updates.")
        if not self.actors and not resumed and self != RaySettings():
            raise ConfigError("--ray.… has no effect without collectors: give --ray.actors=N, or leave it out.")
        if len(self.each) > self.actors:
            raise ConfigError(
                f"--ray.each has {len(self.each)} entries for --ray.actors={self.actors}: expected one a collector, at "
                "most."
            )


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
    seed: int = number(1000, least=0, most=20_000)  # of weights, batches, exploration and training scenes
    steps: int = number(30_000, least=0)  # control steps online, then the episode is finished; 0 trains offline only
    # of acting and learning, waits for a person not counted; None: `steps` alone
    online_minutes: float | None = number(None, above=0)
    offline_updates: int = number(0, least=0)  # updates on the demonstrations before the first step
    updates_per_step: int | None = None  # after control steps; None: the preset's
    # control steps from one to the next after which there are updates; None: the preset's
    update_interval: int | None = None
    updates_per_episode: int | None = None  # between episodes; None: the preset's
    async_updates: int = number(0, least=0)  # at most so many beside an episode; it acts with the policy it began with
    batch_size: int | None = None  # from everything seen; None: the preset's
    demo_batch_size: int | None = None  # from demonstrations and successes, on top; None: the preset's
    relabel: bool | None = None  # successful online episodes become demonstrations; None: the preset's
    random_steps: int | None = None  # first control steps, of uniform actions and without updates; None: the preset's
    action_bounds: str | None = None  # -1..1 is the range of the "data" or of the "environment"; None: the preset's
    # environment steps between checkpoints; the end and an interrupt always save
    save_freq: int = number(5000, least=1)
    log_freq: int = number(50, least=1)  # updates between rows of updates.csv
    threads: int = number(0, least=0, most=256)  # torch threads; 0 leaves torch's choice
    replay: ReplaySettings = field(default_factory=ReplaySettings)
    eval: EvalSettings = field(default_factory=EvalSettings)
    ray: RaySettings = field(default_factory=RaySettings)
    tensorboard: bool = False  # the tables as TensorBoard events in output_dir/tensorboard, too
    wandb: WandBSettings = field(default_factory=WandBSettings)

    def validate(self) -> "ValidRun":
        """The run, once all was checked that can be before work starts. Raises ConfigError."""
        if self.policy is None:
            raise ConfigError("No policy: give --policy.type=cqn, or --policy.path=CHECKPOINT to continue from one.")
        if not isinstance(self.policy, RLConfig):
            raise ConfigError(
                f"cqn-train trains --policy.type=cqn, cqn_as or drqv2, got '{self.policy.type}': use lerobot-train for "
                "that."
            )
        if self.output_dir is None:
            raise ConfigError("No output directory: give --output_dir=DIR.")
        if self.policy.push_to_hub:
            check_repo_id(self.policy.repo_id or "", "--policy.repo_id")
        acts_in = self._validated_world()
        self.ray.validate(beside=self.async_updates, resumed=self.resume)
        if self.policy.base_path is not None:
            self._check_correction(self.policy)
        recipe = self.recipe
        if not recipe.batch_size + recipe.demo_batch_size:
            raise ConfigError("A batch of nothing: give --batch_size or --demo_batch_size above 0.")
        chosen = self.dataset.episodes or []
        if len({*chosen}) < len(chosen) or any(episode < 0 for episode in chosen):
            raise ConfigError(
                f"`dataset.episodes` must be different numbers from 0 on, got {chosen}: each episode counts once."
            )
        learns_from_data = recipe.demo_batch_size > 0 or self.offline_updates > 0
        if not self.dataset.repo_id and (learns_from_data or (recipe.action_bounds == "data" and not self.continues)):
            raise ConfigError(
                "No demonstrations: give --dataset.repo_id=... (and --dataset.root=DIR when it is local), or train "
                "without: --demo_batch_size=0 --action_bounds=environment --offline_updates=0."
            )
        for settings, prefix in ((self, ""), (recipe, ""), (self.eval, "eval."), (self.replay, "replay.")):
            check_ranges(settings, prefix)
        if self.wandb.mode not in (None, *(modes := ("online", "offline", "disabled"))):
            raise ConfigError(one_of("wandb.mode", str(self.wandb.mode), modes))
        if self.replay.sampling not in (valid := ("episodes", "steps")):
            raise ConfigError(one_of("replay.sampling", self.replay.sampling, valid))
        if recipe.action_bounds not in (valid := ("data", "environment")):
            raise ConfigError(one_of("action_bounds", recipe.action_bounds, valid))
        return ValidRun(config=self, policy=self.policy, output_dir=self.output_dir, acts_in=acts_in)

    def _check_correction(self, policy: RLConfig) -> None:
        if self.robot is not None:
            raise ConfigError("On an arm no other policy can be corrected yet: leave out --policy.base_path.")
        if self.recipe.action_bounds != "data":
            raise ConfigError(
                "Corrections are shares of the demonstrated range: give --action_bounds=data and a dataset."
            )
        if policy.push_to_hub:
            policy.refuse_local_base()

    def _validated_world(self) -> EnvConfig | RobotConfig:
        if self.env is not None and self.robot is not None:
            raise ConfigError(
                "Expected either an environment or an arm, got both: leave out --env.type or --robot.type."
            )
        if self.env is not None:
            if self.teleop is not None:
                raise ConfigError("--teleop.type is the leader of an arm: give --robot.type as well, or leave it out.")
            for name, given, usual in (("arm", self.arm, ArmSettings()), ("page", self.page, PageSettings())):
                if given != usual:
                    raise ConfigError(f"--{name}.… has no effect in an environment, only on an arm: leave it out.")
            return self.env
        if self.robot is None:
            raise ConfigError(
                "No environment and no arm: give --env.type=..., for example --env.type=ur5e_station, or "
                "--robot.type=... (lerobot-train needs none)."
            )
        self.arm.validate()
        if self.eval.batch_size > 1 or self.eval.use_async_envs:
            raise ConfigError("There is one arm: leave out --eval.batch_size and --eval.use_async_envs.")
        if self.recipe.updates_per_step:
            raise ConfigError(
                "Updates after each step would make the arm jerk: leave out --updates_per_step, or give "
                "--updates_per_episode, or --async_updates."
            )
        if self.recipe.random_steps:
            raise ConfigError("Uniform actions would throw the arm about: give --random_steps=0, or another preset.")
        check_ranges(self.page, "page.")
        if (self.page.certfile is None) != (self.page.keyfile is None):
            raise ConfigError("--page.certfile and --page.keyfile belong together: give both, or --page.tls=true.")
        return self.robot

    @property
    def eval_freq(self) -> int:
        """Environment steps between evaluations, 0 for none."""
        freq = self.eval.freq
        return freq if freq is not None else 0 if self.robot is not None else max(1000, self.steps // 10)

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


@dataclass(frozen=True, kw_only=True)
class ValidRun:
    """A run whose settings were checked (`RunConfig.validate`), with nothing left open that a run must have.

    config: the settings as given, for the loop and the checkpoint; policy: of a method that this trainer knows;
    acts_in: an environment or an arm.
    """

    config: RunConfig
    policy: RLConfig
    output_dir: Path
    acts_in: EnvConfig | RobotConfig
