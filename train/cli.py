"""`cqn-train`: parse, check, put the parts together, run. The only composition root."""

import contextlib
import logging
import shutil
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Self

import draccus
import numpy as np
import torch
from datasets import disable_progress_bars
from lerobot.configs import parser
from lerobot.configs.types import FeatureType
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import env_to_policy_features
from lerobot.policies.factory import get_policy_class, make_policy, make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_STATE
from lerobot.utils.import_utils import register_third_party_plugins

from cqn_data.terminal.console import explain
from lerobot_cqn.base_config import RLConfig
from lerobot_cqn.base_policy import RLPolicy
from lerobot_cqn.errors import ConfigError, CQNError, OutputExistsError
from lerobot_cqn.joint_goals import converted_deltas
from lerobot_cqn.learner import Learner

from . import envs  # noqa: F401  # registers our environments
from .agent import Agent
from .arguments import introduction, parse
from .arm.build import Operated, make_operated, recall, steering
from .arm.devices import register_devices
from .config import RunConfig
from .interfaces import Environment, Interrupted, Scenes
from .loop.gym_env import GymEnvironment, GymScenes, OneScene
from .loop.trainer import Monitor, Nobody, Trainer
from .push.cli import PushConfig, check_account, push
from .replay.buffer import Episode, Replay
from .replay.demonstrations import load_episodes, load_metadata
from .run.checkpoint import Counters, last_checkpoint, restore, save, seed_everything
from .run.first_look import draw_batch, warnings_about
from .run.metrics import Log, Metrics, start_tensorboard, start_wandb
from .run.progress import ConsoleMonitor, Monitors

__all__ = ["main"]


def build(
    config: RunConfig, monitor: ConsoleMonitor, should_stop: Callable[[], bool], stack: contextlib.ExitStack
) -> Trainer:
    """Check everything, then make every part of a run. Raises CQNError before any work is done.

    stack: takes up what must be closed again.
    """
    check(config, monitor.message)
    assert isinstance(config.policy, RLConfig) and config.output_dir is not None  # noqa: S101, PT018  # just checked
    checkpoint = last_checkpoint(config.output_dir) if config.resume else None
    if config.threads:
        torch.set_num_threads(config.threads)
    rng = seed_everything(config.seed)
    gym = GymEnvironment(config.env, config.policy) if config.env is not None else None
    agent = make_agent(config, checkpoint, gym)
    operated = make_operated(config, agent, should_stop, monitor.message) if gym is None else None
    env, scenes = make_scenes(config, agent, gym, operated)
    if operated is not None:  # before anything is written: the port may be taken
        stack.enter_context(steering(config, operated, monitor.message))
    stack.callback(env.close)
    stack.callback(scenes.close)
    s = config.policy.settings
    replay = Replay(
        s.frame_stack, s.n_step, s.discount, folder=config.output_dir / "replay",
        capacity_gib=config.replay.capacity_gib, by_step=config.replay.sampling == "steps",
    )  # fmt: skip
    demonstrations: list[Episode] = []
    with _nothing_left(None if config.resume else config.output_dir):
        if config.dataset.repo_id:
            monitor.phase("load", 1, 0)
            for episode in load_episodes(config.dataset, agent, lambda i, n: monitor.advance(i, f"episode {i}/{n}")):
                replay.add_demonstration(episode)
                demonstrations.append(replace(episode, pixels=()))
        bounds = gym.action_bounds() if gym is not None else None
        state = config.policy.low_dim_features.get(OBS_STATE)
        joints = state.shape[0] if state is not None else 0
        for sentence in warnings_about(demonstrations, free=agent.inside(bounds), joints=joints):
            monitor.message(f"Warning: {sentence}")
        finished = replay.reopen() if checkpoint is not None else []
    config.output_dir.mkdir(parents=True, exist_ok=True)
    if checkpoint is None and replay.episodes:
        picture = config.output_dir / "first_batch.png"
        sizes = (256, 256 if replay.demonstrations else 0)  # enough to have a reward among them
        draw_batch(replay.sample(*sizes, np.random.default_rng(config.seed)), picture)
        monitor.message(f"First batch: {picture}")
    metrics = Metrics(config.output_dir, also_to(config, operated))
    learner, counters = Learner(agent.policy.model), Counters()
    if checkpoint is not None:
        counters, tables = restore(checkpoint, learner, rng)
        metrics.truncate(tables)
        finished = [place for place in finished if place.number >= counters.episodes]
        monitor.message(f"Resuming at step {counters.env_steps}, {counters.updates} updates.")

    def save_checkpoint() -> None:
        assert config.output_dir is not None  # noqa: S101
        save(
            config.output_dir, agent, learner, rng, counters, tables=metrics.sizes(), run_config=draccus.encode(config),
        )  # fmt: skip

    shown: Monitor = monitor
    if operated is not None:
        stack.callback(lambda: monitor.message(operated.env.summary()) if operated.env.summary() else None)
        recall(operated.board, config.output_dir)
        shown = Monitors([monitor, operated.board])
    return Trainer(
        config, agent, learner, env, scenes, replay, metrics, shown, rng, counters, save_checkpoint, should_stop,
        finished_since=finished, person=Nobody() if operated is None else operated.session,
    )  # fmt: skip


def check(config: RunConfig, say: Callable[[str], None]) -> None:
    """What can be checked before anything is made. Raises CQNError; warnings are said."""
    config.validate()
    assert config.policy is not None and config.output_dir is not None  # noqa: S101, PT018  # just validated
    if not config.resume and config.output_dir.exists() and any(config.output_dir.iterdir()):
        raise OutputExistsError(
            f"{config.output_dir} exists and is not empty: give another --output_dir, or --resume=true to continue."
        )
    if config.policy.push_to_hub and (warning := check_account(str(config.policy.repo_id))):
        say(f"Warning: {warning}")


def also_to(config: RunConfig, operated: Operated | None) -> list[Log]:
    """Where metrics go besides their files."""
    assert config.output_dir is not None  # noqa: S101  # validate has checked it
    also: list[Log] = [] if operated is None else [operated.board.log]
    if config.tensorboard:
        also.append(start_tensorboard(config.output_dir / "tensorboard"))
    if config.wandb.enable:
        run_config = draccus.encode(config)
        also.append(start_wandb(config.wandb.project, config.output_dir.name, run_config, config.wandb.mode))
    return also


def make_scenes(
    config: RunConfig, agent: Agent, gym: GymEnvironment | None, operated: Operated | None
) -> tuple[Environment, Scenes]:
    """What is acted in to learn, and to evaluate; an arm is both."""
    assert isinstance(config.policy, RLConfig)  # noqa: S101  # validate has checked it
    if gym is None or config.env is None:
        assert operated is not None  # noqa: S101  # an environment or an arm
        return operated.env, OneScene(operated.env)
    check_fits(config.env, agent.policy, "policy" if config.continues else "dataset")
    if config.eval.batch_size == 1:
        return gym, OneScene(gym)
    return gym, GymScenes(config.env, config.policy, config.eval.batch_size, apart=config.eval.use_async_envs)


@contextlib.contextmanager
def _nothing_left(folder: Path | None) -> Iterator[None]:
    """Remove the new run's folder when its beginning fails, so that the same command can be given again."""
    try:
        yield
    except BaseException:
        if folder is not None:
            shutil.rmtree(folder / "replay", ignore_errors=True)
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise


def make_agent(config: RunConfig, checkpoint: Path | None, env: GymEnvironment | None) -> Agent:
    """Policy and processors: new ones from the dataset's statistics, or those of a checkpoint.

    Without a dataset the features are the environment's and the state stays as it is.
    """
    assert isinstance(config.policy, RLConfig)  # noqa: S101  # validate has checked it
    pretrained = checkpoint / "pretrained_model" if checkpoint is not None else config.policy.pretrained_path
    policy: Any
    if pretrained is not None:
        try:
            policy = get_policy_class(config.policy.type).from_pretrained(pretrained, config=config.policy)
        except RuntimeError as error:  # torch names every tensor that differs
            raise ConfigError(
                f"The weights in {pretrained} do not fit: leave out the --policy.* settings that change the network "
                "(sizes, levels, bins, atoms, frame_stack), or start anew."
            ) from error
        pre, post = make_pre_post_processors(config.policy, pretrained_path=str(pretrained))
    else:
        stats: dict[str, dict[str, Any]] = {}
        meta = None
        if config.dataset.repo_id:
            meta = load_metadata(config.dataset)
            policy = make_policy(config.policy, ds_meta=meta)
            stats = dict(meta.stats or {})
        elif config.env is None:
            raise ConfigError(
                "An arm needs demonstrations, or a policy that was trained on some: give --dataset.repo_id."
            )
        else:
            policy = make_policy(config.policy, env_cfg=config.env)
        if config.recipe.action_bounds == "environment":
            bounds = env.action_bounds() if env is not None else None
            if meta is not None and converted_deltas(meta) is not None:
                raise ConfigError(
                    "The dataset's actions are differences, the environment bounds goals: give --action_bounds=data."
                )
            if bounds is None:
                raise ConfigError("The environment bounds no action: give --action_bounds=data and a dataset.")
            stats[ACTION] = bounds
        pre, post = make_pre_post_processors(config.policy, dataset_stats=stats, dataset_meta=meta)
    policy.train()
    return Agent(policy, pre, post)


def check_fits(env: EnvConfig, policy: RLPolicy, source: str) -> None:
    """Environment and policy must speak of the same things. Raises ConfigError, in one line, where they do not.

    source: where the policy's features come from, for the message.
    """
    given, needed = env_to_policy_features(env), policy.config.input_features or {}
    for key, feature in needed.items():
        if key not in given:
            raise ConfigError(
                f"The {source} has '{key}', which the environment does not give (it gives {sorted(given)}): "
                "change --env.obs_type / --env.cameras, or train on a dataset with these features."
            )
        if tuple(given[key].shape) != tuple(feature.shape):
            raise ConfigError(
                f"'{key}' has shape {tuple(given[key].shape)} in the environment, but {tuple(feature.shape)} in the "
                f"{source}: "
                + (
                    "set --env.image_size or resize the dataset (cqn-data resize)."
                    if feature.type is FeatureType.VISUAL
                    else "use the environment of the demonstrations."
                )
            )
    unseen = [key for key, f in given.items() if f.type is FeatureType.VISUAL and key not in needed]
    if unseen:
        raise ConfigError(
            f"The {source} has not the environment's camera '{unseen[0]}': leave it out (--env.cameras, or "
            "--env.obs_type=state for none), or use a dataset with it."
        )
    action = next(f for f in given.values() if f.type is FeatureType.ACTION)
    if action.shape[0] != policy.action_dims:
        raise ConfigError(
            f"The environment's action has {action.shape[0]} dimensions, the {source}'s "
            f"{policy.action_dims}: use the environment the demonstrations were recorded in."
        )


class StopRequest:
    """Ctrl-C or SIGTERM once: stop at the next safe point; twice: at once. Use as a context manager."""

    def __init__(self) -> None:
        self.asked = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
        print("\nStopping: saving a checkpoint (once more to stop at once) ...", file=sys.stderr)  # noqa: T201

    def __call__(self) -> bool:
        """Whether to stop."""
        return self.asked


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `cqn-train`; returns 0, 2 for an error of the user's, 130 after an interrupt."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in arguments
    arguments = [a for a in arguments if a != "--debug"]
    set_up_logging(debug)
    register_third_party_plugins()
    if not arguments or "-h" in arguments or "--help" in arguments:
        register_devices()
        print(introduction())  # noqa: T201
        parser.print_scoped_help(RunConfig, arguments)
        return 0
    try:
        return run(parse(arguments))
    except KeyboardInterrupt as error:  # of a push it says what is on the Hub
        print(f"cqn-train: {error or 'stopped at once; the last checkpoint is untouched.'}", file=sys.stderr)  # noqa: T201
        return 130
    except (CQNError, OSError) as error:
        return int(explain("cqn-train", error, debug=debug))


def run(config: RunConfig) -> int:
    """Build and train; 0 when complete, 130 when stopped on request with a checkpoint saved."""
    with ConsoleMonitor() as monitor, StopRequest() as should_stop, contextlib.ExitStack() as stack:
        trainer = build(config, monitor, should_stop, stack)
        try:
            trainer.run()
        except Interrupted:
            trainer.save()
            monitor.message(f"Stopped. Continue with: cqn-train --resume=true --output_dir={config.output_dir}")
            return 130
        monitor.message(f"Policy: {config.output_dir}/checkpoints/last/pretrained_model")
    policy = config.policy
    if policy is not None and policy.push_to_hub:
        push(
            PushConfig(
                run=str(config.output_dir), repo_id=str(policy.repo_id), private=bool(policy.private),
                license=policy.license, tags=list(policy.tags or ()),
            )
        )  # fmt: skip
    return 0


def set_up_logging(debug: bool) -> None:
    """Our notices on stderr, and of the libraries below only errors (all they say with --debug).

    LeRobot warns of missing accelerators and decoders on every start; a person could not find our line in between.
    """
    root, ours = logging.getLogger(), logging.getLogger(__package__)
    root.setLevel(logging.DEBUG if debug else logging.ERROR)
    if debug:
        logging.basicConfig()
    else:
        warnings.simplefilter("ignore")
        disable_progress_bars()
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(message)s"))
    ours.handlers, ours.propagate = [handler], False
    ours.setLevel(logging.INFO)


if __name__ == "__main__":
    sys.exit(main())
