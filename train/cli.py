"""`cqn-train`: parse, check, put the parts together, run. The only composition root."""

import logging
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

import draccus
import torch
from lerobot.configs import parser
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import env_to_policy_features
from lerobot.policies.factory import make_policy, make_pre_post_processors
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_cqn.configuration_cqn import CQNConfig
from lerobot_cqn.errors import ConfigError, CQNError, OutputExistsError
from lerobot_cqn.learner import Learner
from lerobot_cqn.modeling_cqn import CQNPolicy

from . import envs  # noqa: F401  # registers our environments
from .agent import Agent
from .checkpoint import Counters, last_checkpoint, restore, save, seed_everything
from .config import RunConfig
from .console import ConsoleMonitor
from .demonstrations import load_episodes, load_metadata
from .gym_env import GymEnvironment
from .metrics import Metrics, start_wandb
from .online import Interrupted, Trainer
from .replay import Replay

__all__ = ["main"]

EXAMPLES = """\
Train a Coarse-to-fine Q-Network from demonstrations, then online.

  demonstrations, then online in the simulated station:
    cqn-train --policy.type=cqn --policy.preset=laptop_state --env.type=ur5e_station --env.task=click_button \\
      --dataset.repo_id=local/click --dataset.root=data/click --offline_updates=2000 --steps=5000 \\
      --output_dir=outputs/click

  continue after Ctrl-C or a crash:          cqn-train --resume=true --output_dir=outputs/click
  start from a trained policy:               cqn-train --policy.path=outputs/click/checkpoints/last/pretrained_model ...
  imitation only (the paper's CBC):          cqn-train --policy.rl_loss_scale=0 --steps=0 --offline_updates=5000 ...
  evaluate with LeRobot:                     lerobot-eval --policy.path=.../pretrained_model --env.type=ur5e_station

Add --env.type=... or --policy.type=cqn before --help to see their options; --debug shows tracebacks.
"""


def parse(arguments: Sequence[str]) -> RunConfig:
    """Run settings from the command line. Raises ConfigError for anything that does not parse."""
    arguments = list(arguments)
    config_file: str | None = None
    if _flag(arguments, "resume"):
        output_dir = parser.parse_arg("output_dir", arguments)
        if output_dir is None:
            raise ConfigError("--resume needs the run's folder: give --output_dir=DIR.")
        config_file = str(last_checkpoint(Path(output_dir)) / "pretrained_model" / "train_config.json")
    config_file = parser.parse_arg("config_path", arguments) or config_file
    arguments = parser.filter_arg("config_path", arguments)
    path = parser.parse_arg("policy.path", arguments)
    overrides = [a.replace("--policy.", "--", 1) for a in arguments if a.startswith("--policy.")]
    if path is not None:
        arguments = [a for a in arguments if not a.startswith("--policy.")]
        overrides = [a for a in overrides if not a.startswith("--path")]
    try:
        config: RunConfig = draccus.parse(RunConfig, config_path=config_file, args=arguments)
        if path is not None:
            if not (Path(path) / "config.json").is_file() and Path(path).exists():
                raise ConfigError(f"No policy in {path}: expected config.json; give the `pretrained_model` folder.")
            policy = PreTrainedConfig.from_pretrained(path, cli_overrides=overrides)
            policy.pretrained_path = Path(path)
            config.policy = policy
    except CQNError:
        raise
    except Exception as error:  # draccus and huggingface_hub raise many kinds
        cause = _user_cause(error)
        raise ConfigError(cause) from error
    return config


def build(config: RunConfig, monitor: ConsoleMonitor, should_stop: Callable[[], bool]) -> Trainer:
    """Check everything, then make every part of a run. Raises CQNError before any work is done."""
    config.validate()
    assert isinstance(config.policy, CQNConfig)  # noqa: S101  # validate has checked these three
    assert config.env is not None and config.output_dir is not None  # noqa: S101, PT018
    checkpoint = last_checkpoint(config.output_dir) if config.resume else None
    if not config.resume and config.output_dir.exists() and any(config.output_dir.iterdir()):
        raise OutputExistsError(
            f"{config.output_dir} exists and is not empty: give another --output_dir, or --resume=true to continue."
        )
    if config.threads:
        torch.set_num_threads(config.threads)
    rng = seed_everything(config.seed)
    agent = make_agent(config, checkpoint)
    check_fits(config.env, agent.policy)
    s = config.policy.settings
    replay = Replay(s.frame_stack, s.n_step, s.discount)
    if config.dataset.repo_id:
        monitor.phase("load", 1, 0)
        for episode in load_episodes(config.dataset, agent, lambda i, n: monitor.advance(i, f"episode {i}/{n}")):
            replay.add(episode, demo=episode.success)
    demonstrations = replay.episodes
    env = GymEnvironment(config.env, config.policy)
    config.output_dir.mkdir(parents=True, exist_ok=True)
    run_config = draccus.encode(config)
    wandb = None
    if config.wandb.enable:
        wandb = start_wandb(config.wandb.project, config.output_dir.name, run_config, config.wandb.mode)
    metrics = Metrics(config.output_dir, wandb)
    learner, counters = Learner(agent.policy.model), Counters()
    if checkpoint is not None:
        counters, tables = restore(checkpoint, learner, replay, rng)
        metrics.truncate(tables)
        monitor.message(f"Resuming at step {counters.env_steps}, {counters.updates} updates.")

    def save_checkpoint() -> None:
        assert config.output_dir is not None  # noqa: S101
        save(
            config.output_dir, agent, learner, replay, rng, counters,
            first_online=demonstrations, tables=metrics.sizes(), run_config=run_config,
        )  # fmt: skip

    return Trainer(config, agent, learner, env, replay, metrics, monitor, rng, counters, save_checkpoint, should_stop)


def make_agent(config: RunConfig, checkpoint: Path | None) -> Agent:
    """Policy and processors: new ones from the dataset's statistics, or those of a checkpoint."""
    assert isinstance(config.policy, CQNConfig) and config.env is not None  # noqa: S101, PT018
    pretrained = checkpoint / "pretrained_model" if checkpoint is not None else config.policy.pretrained_path
    if pretrained is not None:
        policy = CQNPolicy.from_pretrained(pretrained, config=config.policy)
        pre, post = make_pre_post_processors(config.policy, pretrained_path=str(pretrained))
    elif config.dataset.repo_id:
        meta = load_metadata(config.dataset)
        policy = make_policy(config.policy, ds_meta=meta)
        pre, post = make_pre_post_processors(config.policy, dataset_stats=meta.stats)
    else:
        raise ConfigError("A new policy needs a dataset for its features and action bounds: give --dataset.repo_id=...")
    policy.train()
    return Agent(policy, pre, post)


def check_fits(env: EnvConfig, policy: CQNPolicy) -> None:
    """Environment and policy must speak of the same things. Raises ConfigError, in one line, where they do not."""
    given, needed = env_to_policy_features(env), policy.config.input_features or {}
    for key, feature in needed.items():
        if key not in given:
            raise ConfigError(
                f"The policy needs '{key}', which the environment does not give (it gives {sorted(given)}): "
                "change --env.obs_type / --env.cameras, or train on a dataset with these features."
            )
        if tuple(given[key].shape) != tuple(feature.shape):
            raise ConfigError(
                f"'{key}' has shape {tuple(given[key].shape)} in the environment, but {tuple(feature.shape)} in the "
                "policy (channels, height, width for cameras): record or resize to one size."
            )
    unseen = [key for key, f in given.items() if f.type is FeatureType.VISUAL and key not in needed]
    if unseen:
        raise ConfigError(f"The policy has not seen the camera '{unseen[0]}': leave it out, or train on it.")
    action = next(f for f in given.values() if f.type is FeatureType.ACTION)
    if action.shape[0] != policy.action_dims:
        raise ConfigError(
            f"The environment's action has {action.shape[0]} dimensions, the policy's (from its dataset) "
            f"{policy.action_dims}: use the environment the demonstrations were recorded in."
        )


class StopRequest:
    """Ctrl-C or SIGTERM once: stop at the next safe point; twice: at once."""

    def __init__(self) -> None:
        self.asked = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

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
    logging.basicConfig(level=logging.DEBUG if debug else logging.ERROR, format="%(message)s")
    logging.getLogger("cqn_train").setLevel(logging.INFO)
    register_third_party_plugins()
    if not arguments or "-h" in arguments or "--help" in arguments:
        print(EXAMPLES)  # noqa: T201
        parser.print_scoped_help(RunConfig, arguments)
        return 0
    trainer: Trainer | None = None
    try:
        config = parse(arguments)
        with ConsoleMonitor() as monitor:
            trainer = build(config, monitor, StopRequest())
            try:
                trainer.run()
            except Interrupted:
                trainer.save()
                monitor.message(f"Stopped. Continue with: cqn-train --resume=true --output_dir={config.output_dir}")
                return 130
            monitor.message(f"Policy: {config.output_dir}/checkpoints/last/pretrained_model")
        return 0
    except CQNError as error:
        if debug:
            traceback.print_exc()
        print(f"cqn-train: {' '.join(str(error).split())}", file=sys.stderr)  # noqa: T201
        return 2
    finally:
        if trainer is not None:
            trainer.env.close()


def _flag(arguments: Sequence[str], name: str) -> bool:
    value: Any = parser.parse_arg(name, list(arguments))
    return str(value).lower() in ("true", "1", "yes")


def _user_cause(error: BaseException) -> str:
    """The message of the deepest cause: draccus wraps what a config's own check said."""
    while error.__cause__ is not None or error.__context__ is not None:
        if isinstance(error, CQNError):
            break
        error = error.__cause__ or error.__context__  # type: ignore[assignment]
    return str(error) or type(error).__name__


if __name__ == "__main__":
    sys.exit(main())
