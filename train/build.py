"""The composition root: a checked run becomes a trainer with all its parts. Nothing else puts them together."""

import contextlib
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import torch
from lerobot.envs.configs import EnvConfig
from lerobot.policies.factory import get_policy_class, make_policy, make_pre_post_processors
from lerobot.robots.config import RobotConfig
from lerobot.utils.constants import ACTION, OBS_STATE

from lerobot_cqn.base_config import RLConfig
from lerobot_cqn.delta_actions import origin_of, recorded_deltas
from lerobot_cqn.errors import ConfigError, OutputExistsError
from lerobot_cqn.joint_goals import converted_deltas
from lerobot_cqn.learner import Learner
from lerobot_cqn.schema import read_history
from lerobot_cqn.settings import CQNASSettings

from .agent import Agent
from .arm.build import make_operated, recall, steering
from .clock import REAL, Clock
from .config import EvalSettings, ValidRun
from .interfaces import Monitor, Scenes
from .loop.experience import Experience, Here
from .loop.gym_env import GymEnvironment, GymScenes, OneScene, check_fits
from .loop.trainer import Trainer
from .operator.board import Board
from .push.send import check_account
from .replay.buffer import Replay
from .replay.demonstrations import Demonstrations
from .replay.episode import Episode
from .run.beginning import BEGUN, PAGE, beginning, forget_beginning
from .run.checkpoint import Counters, last_checkpoint, restore, save, seed_everything, stored_episodes
from .run.durable import SpareDescriptors, check_room
from .run.first_look import draw_batch, warnings_about
from .run.metrics import Log, Metrics, start_tensorboard, start_wandb
from .run.progress import Monitors

__all__ = ["MakeWorld", "World", "build", "make_agent", "make_scenes", "trained_agent"]

Bounds = Mapping[str, Any]
MakeWorld = Callable[
    [ValidRun, Path | None, Demonstrations | None, Callable[[str], None], Callable[[], bool], contextlib.ExitStack],
    "World",
]


@dataclass(frozen=True, kw_only=True)
class World:
    """Policy, and where its episodes come from.

    bounds: `min` and `max` [D] of the environment's action, None where it has none; board: what the person is shown.
    """

    agent: Agent
    experience: Experience
    bounds: Bounds | None = None
    board: Board | None = None


def build(
    run: ValidRun,
    monitor: Monitor,
    should_stop: Callable[[], bool],
    stack: contextlib.ExitStack,
    clock: Clock = REAL,
    make_world: "MakeWorld | None" = None,
) -> Trainer:
    """Every part of a run, put together. Raises CQNError before any work is done.

    stack: takes up what must be closed again; clock: by which trainer and arm live; make_world: makes policy and
    source of episodes, None: in this process.
    """
    config = run.config
    check_outside(run, monitor.message)
    checkpoint = last_checkpoint(run.output_dir) if config.resume else None
    if config.threads:
        torch.set_num_threads(config.threads)
    rng = seed_everything(config.seed)
    data = Demonstrations(config.dataset) if config.dataset.repo_id else None
    if make_world is not None:
        world = make_world(run, checkpoint, data, monitor.message, should_stop, stack)
    elif isinstance(run.acts_in, EnvConfig):
        world = make_simulation(run.acts_in, run, checkpoint, data, stack)
    else:
        world = make_arm(run.acts_in, run, checkpoint, data, monitor.message, should_stop, stack, clock)
    agent, replay = world.agent, make_replay(run)
    begun = run.output_dir / BEGUN
    with nothing_left(None if config.resume else run.output_dir):
        if checkpoint is None:
            stack.enter_context(beginning(begun))
        else:
            accepted = config.replay.accept_loss
            replay.examine(stored_episodes(checkpoint), accept_loss=accepted, say=monitor.message)
        load_demonstrations(run, data, world, replay, monitor)
        finished = replay.reopen() if checkpoint is not None else []
    run.output_dir.mkdir(parents=True, exist_ok=True)
    if checkpoint is None and replay.episodes:
        picture = run.output_dir / "first_batch.png"
        sizes = (256, 256 if replay.demonstrations else 0)  # enough to have a reward among them
        draw_batch(replay.sample(*sizes, np.random.default_rng(config.seed)), picture)
        monitor.message(f"First batch: {picture}")
    metrics, spare = Metrics(run.output_dir, also_to(run, world.board)), stack.enter_context(SpareDescriptors())
    learner, counters = Learner(agent.policy.model), Counters()
    if checkpoint is not None:
        counters, tables = restore(checkpoint, learner, rng)
        metrics.truncate(tables)
        held = stored_episodes(checkpoint) or frozenset(range(counters.episodes))  # an older one does not say
        finished = [place for place in finished if place.number not in held]
        monitor.message(f"Resuming at step {counters.env_steps}, {counters.updates} updates.")

    def save_checkpoint() -> None:
        with spare.given():
            save(
                run.output_dir, agent, learner, rng, counters, tables=metrics.sizes(),
                run_config=draccus.encode(config),
                episodes=[place.number for place in replay.places if place.number >= 0],
            )  # fmt: skip
        begun.unlink(missing_ok=True)

    if world.board is not None:
        recall(world.board, run.output_dir)
        monitor = Monitors([monitor, world.board])
    return Trainer(
        config=config, agent=agent, learner=learner, experience=world.experience, replay=replay, metrics=metrics,
        monitor=monitor, rng=rng, counters=counters, save=save_checkpoint, should_stop=should_stop,
        finished_since=finished, spare=spare, clock=clock,
    )  # fmt: skip


def check_outside(run: ValidRun, say: Callable[[str], None]) -> None:
    """Make sure of the output folder and the Hub account, before anything is made. Raises CQNError; says warnings."""
    check_room(run.output_dir)
    if not run.config.resume:
        forget_beginning(run.output_dir)
    made = {path.name for path in run.output_dir.iterdir()} if run.output_dir.is_dir() else set()
    if not run.config.resume and (made - {PAGE} or run.output_dir.is_file()):
        raise OutputExistsError(
            f"{run.output_dir} exists and is not empty: give another --output_dir, or --resume=true to continue."
        )
    if run.policy.push_to_hub and (warning := check_account(str(run.policy.repo_id))):
        say(f"Warning: {warning}")


# -- the world -----------------------------------------------------------------------------------------------


def make_simulation(
    env_config: EnvConfig,
    run: ValidRun,
    checkpoint: Path | None,
    data: Demonstrations | None,
    stack: contextlib.ExitStack,
) -> World:
    """A simulated environment, which judges for itself; several evaluate at a time where that is asked for."""
    evaluation = run.config.eval
    gym = GymEnvironment(env_config, run.policy)
    bounds = gym.action_bounds()
    agent = make_agent(run, checkpoint, data, bounds)
    check_fits(env_config, agent.policy, "policy" if run.config.continues else "dataset")
    stack.callback(gym.close)
    here = Here.alone(gym, make_scenes(env_config, run.policy, gym, evaluation, stack), run.config.recipe.random_steps)
    return World(agent=agent, experience=here, bounds=bounds)


def make_scenes(
    env_config: EnvConfig, policy: RLConfig, gym: GymEnvironment, settings: EvalSettings, stack: contextlib.ExitStack
) -> Scenes:
    """Scenes of evaluations: the training environment, or several beside it that step together."""
    if settings.batch_size == 1:
        return OneScene(gym)
    several = GymScenes(env_config, policy, settings.batch_size, apart=settings.use_async_envs)
    stack.callback(several.close)
    return several


def make_arm(
    robot_config: RobotConfig,
    run: ValidRun,
    checkpoint: Path | None,
    data: Demonstrations | None,
    say: Callable[[str], None],
    should_stop: Callable[[], bool],
    stack: contextlib.ExitStack,
    clock: Clock,
) -> World:
    """An arm with its person at the page or at keys; it is the only scene of evaluations, too."""
    agent = make_agent(run, checkpoint, data, None)
    recorded = data.recorded() if data is not None else None
    operated = make_operated(robot_config, run.config, agent, recorded, should_stop, say, clock)
    stack.enter_context(steering(run.config, operated, say))  # before anything is written: the port may be taken
    stack.callback(operated.env.close)
    stack.callback(lambda: say(operated.env.summary()) if operated.env.summary() else None)
    here = Here(env=operated.env, scenes=OneScene(operated.env), person=operated.session)
    return World(agent=agent, experience=here, board=operated.board)


# -- the policy ----------------------------------------------------------------------------------------------


def make_agent(run: ValidRun, checkpoint: Path | None, data: Demonstrations | None, env_bounds: Bounds | None) -> Agent:
    """Policy and processors: new ones from the dataset's statistics, or those of a checkpoint or trained policy.

    Without a dataset the features are the environment's and the state stays as it is.
    """
    pretrained = checkpoint / "pretrained_model" if checkpoint is not None else run.policy.pretrained_path
    trained = trained_agent(run.policy, Path(pretrained)) if pretrained is not None else None
    agent = trained or new_agent(run, data, env_bounds)
    agent.policy.train()
    return agent


def trained_agent(config: RLConfig, folder: Path) -> Agent:
    """The policy in a folder. Raises ConfigError where its weights do not fit the settings."""
    try:
        policy: Any = get_policy_class(config.type).from_pretrained(folder, config=config)
    except RuntimeError as error:  # torch names every tensor that differs
        raise ConfigError(
            f"The weights in {folder} do not fit: leave out the --policy.* settings that change the network "
            "(sizes, levels, bins, atoms, frame_stack), or start anew."
        ) from error
    return Agent(policy, *make_pre_post_processors(config, pretrained_path=str(folder)))


def new_agent(run: ValidRun, data: Demonstrations | None, env_bounds: Bounds | None) -> Agent:
    """A policy with new weights, its actions bounded as the recipe says. Raises ConfigError where that cannot be."""
    meta = data.meta if data is not None else None
    if meta is None and not isinstance(run.acts_in, EnvConfig):
        raise ConfigError("An arm needs demonstrations, or a policy that was trained on some: give --dataset.repo_id.")
    source: dict[str, Any] = {"env_cfg": run.acts_in} if meta is None else {"ds_meta": meta}
    policy: Any = make_policy(run.policy, **source)
    # Of the opened dataset: its rows are on this disk from here on.
    stats: dict[str, Any] = {} if data is None else dict(data.dataset.meta.stats or {})
    check_actions(run, meta)
    if run.config.recipe.action_bounds == "environment":
        if meta is not None and converted_deltas(meta) is not None:
            raise ConfigError(
                "The dataset's actions are differences, the environment bounds goals: give --action_bounds=data."
            )
        if env_bounds is None:
            raise ConfigError("The environment bounds no action: give --action_bounds=data and a dataset.")
        stats[ACTION] = env_bounds
    return Agent(policy, *make_pre_post_processors(run.policy, dataset_stats=stats, dataset_meta=meta))


def check_actions(run: ValidRun, meta: Any) -> None:
    """Whether the environment takes what was recorded: goals, or differences, each as far as it is known.

    Raises ConfigError where it does not.
    """
    takes = getattr(run.acts_in, "action_kind", "")
    entries = read_history(Path(meta.root)) if meta is not None else []
    if not takes or origin_of(entries) is None:
        return
    recorded = "goals" if recorded_deltas(entries) is None else "differences"
    if recorded != takes:
        raise ConfigError(
            f"The demonstrations' actions were recorded as {recorded}, and --env.type={run.acts_in.type} takes {takes}:"
            " give the environment that they were recorded in, or demonstrations of this one."
        )


# -- the run's folder ----------------------------------------------------------------------------------------


def make_replay(run: ValidRun) -> Replay:
    """An empty replay in the run's folder."""
    s, replay = run.policy.settings, run.config.replay
    sequences = (s.action_sequence, s.sequence_fill) if isinstance(s, CQNASSettings) else (1, "mask")
    return Replay(
        s.frame_stack, s.n_step, s.discount, folder=run.output_dir / "replay", capacity_gib=replay.capacity_gib,
        by_step=replay.sampling == "steps", full_windows=replay.full_windows, sequence=sequences[0], fill=sequences[1],
    )  # fmt: skip


def load_demonstrations(
    run: ValidRun, data: Demonstrations | None, world: World, replay: Replay, monitor: Monitor
) -> None:
    """Fill the replay with the dataset, and say what about it makes learning hard."""
    shown: list[Episode] = []
    if data is not None:
        monitor.phase("load", 1, 0)
        for episode in data.episodes(world.agent, lambda i, n: monitor.advance(i, f"episode {i}/{n}")):
            replay.add_demonstration(episode)
            shown.append(replace(episode, pixels=()))
    state = run.policy.low_dim_features.get(OBS_STATE)
    joints = state.shape[0] if state is not None else 0
    for sentence in warnings_about(shown, free=world.agent.inside(world.bounds), joints=joints):
        monitor.message(f"Warning: {sentence}")


def also_to(run: ValidRun, board: Board | None) -> list[Log]:
    """Places that metrics go to besides their files."""
    config = run.config
    also: list[Log] = [] if board is None else [board.log]
    if config.tensorboard:
        also.append(start_tensorboard(run.output_dir / "tensorboard"))
    if config.wandb.enable:
        run_config = draccus.encode(config)
        also.append(start_wandb(config.wandb.project, run.output_dir.name, run_config, config.wandb.mode))
    return also


@contextlib.contextmanager
def nothing_left(folder: Path | None) -> Iterator[None]:
    """Remove the new run's folder when its beginning fails, so that the same command can be given again."""
    try:
        yield
    except BaseException:
        if folder is not None:
            shutil.rmtree(folder / "replay", ignore_errors=True)
            (folder / BEGUN).unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise
