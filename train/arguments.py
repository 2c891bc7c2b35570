"""The command line of `cqn-train`: from arguments to settings, and from a mistake to one line about it."""

import json
import logging
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import draccus
import yaml
from huggingface_hub.errors import HfHubHTTPError, HFValidationError
from lerobot.configs import parser
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.robots.config import RobotConfig
from lerobot.teleoperators.config import TeleoperatorConfig

from cqn_data.terminal.mistakes import one_line
from cqn_data.terminal.options import with_plugins
from lerobot_cqn import configuration_cqn, configuration_cqn_as, configuration_drqv2, processors  # noqa: F401  # registers our policies
from lerobot_cqn.errors import ConfigError

from .arm.devices import register_devices
from .config import DatasetSettings, EvalSettings, PageSettings, RaySettings, ReplaySettings, RunConfig, WandBSettings
from .robot.settings import ArmSettings
from .run.checkpoint import last_checkpoint

__all__ = ["introduction", "parse"]

logger = logging.getLogger(__name__)

EXAMPLES = """\
Train a Coarse-to-fine Q-Network from demonstrations, then online.

  demonstrations, then online in the simulated station:
    cqn-train --policy.type=cqn --policy.preset=laptop_state --env.type=ur5e_station --env.task=click_button \\
      --dataset.repo_id=local/click --dataset.root=data/click --offline_updates=2000 --steps=5000 \\
      --output_dir=outputs/click

  continue after Ctrl-C or a crash:          cqn-train --resume=true --output_dir=outputs/click
  start from a trained policy:               cqn-train --policy.path=outputs/click/checkpoints/last/pretrained_model ...
  imitation only (the paper's CBC):          cqn-train --policy.rl_loss_scale=0 --steps=0 --offline_updates=5000 ...
  with action sequences (CQN-AS):            cqn-train --policy.type=cqn_as --policy.preset=laptop_state ...
  correct a policy one already has:          cqn-train --policy.base_path=outputs/act/.../pretrained_model ...
  the paper's actor-critic baseline:         cqn-train --policy.type=drqv2 --policy.preset=drqv2_plus ...
  without demonstrations:                    cqn-train --policy.preset=paper_dmc_state --env.type=dmc ...
  on an arm, with a person at a web page:    cqn-train --robot.type=so101_follower --robot.port=... \\
                                               --teleop.type=so101_leader --teleop.port=... --dataset.repo_id=... \\
                                               --policy.preset=paper_real_world --online_minutes=10 ...
  evaluate with LeRobot:                     lerobot-eval --policy.path=.../pretrained_model --env.type=ur5e_station

Presets (--policy.preset=NAME; every number can be replaced, docs/configuration.md has them):
"""

PRESETS: dict[str, dict[str, str]] = {
    "cqn": {
        "paper_rlbench": "table 2 of the paper, RLBench: four cameras, an update a step (default)",
        "paper_real_world": "table 2, real arm: 50 updates between episodes, stronger augmentation",
        "paper_dmc_state": "the appendix on DeepMind Control, state, no demonstrations",
        "paper_dmc_pixels": "the same, one camera",
        "reference_rlbench": "the authors' implementation where it differs from the paper",
        "reference_dmc_state": "the authors' code for DeepMind Control, state: scalar values, uniform actions first",
        "reference_dmc_pixels": "the same, one camera",
        "laptop_state": "ours: joints and object poses, small network, minutes on one core",
        "laptop_pixels": "ours: two small cameras, a laptop or one GPU",
        "practice_state": "ours: laptop_state with history and more weight on RL, for long practice",
    },
    "cqn_as": {
        "cqn_as_rlbench": "CQN over action sequences, the authors' configuration for RLBench (default)",
        "cqn_as_bigym": "the same for BiGym: sixteen actions, human demonstrations",
        "cqn_as_humanoid": "the same for HumanoidBench: state, dense rewards, no demonstrations",
        "laptop_state": "ours: CQN's laptop_state with sequences",
        "laptop_pixels": "ours: CQN's laptop_pixels with sequences",
    },
    "drqv2": {
        "drqv2_plus": "the paper's DrQ-v2+: distributional critic, learns from demonstrations (default)",
        "drqv2": "DrQ-v2 as published; demonstrations are experience like any other",
        "drqv2_plus_real_world": "DrQ-v2+ in the paper's setting of a real arm",
        "drqv2_real_world": "DrQ-v2 in the paper's setting of a real arm",
        "laptop_state": "ours: DrQ-v2+ at the sizes of CQN's laptop_state",
        "laptop_pixels": "ours: DrQ-v2+ at the sizes of CQN's laptop_pixels",
    },
}
CHANGED_ON_RESUME = ("device", "push_to_hub", "repo_id", "private", "license", "tags")  # of the policy
KEPT_ON_RESUME = ("dataset.episodes", "action_bounds")
LAST = (
    "Add --env.type=..., --robot.type=... or --policy.type=cqn before --help to see their options; --debug shows "
    "tracebacks.\n"
)


def introduction() -> str:
    """Beginning of `--help`: examples, and the presets by name."""
    lines = [
        f"  --policy.type={policy:<6} {name:<22} {what}"
        for policy, names in PRESETS.items()
        for name, what in names.items()
    ]
    return "\n".join([EXAMPLES.rstrip(), *lines, "", LAST])


def parse(arguments: Sequence[str]) -> RunConfig:
    """Run settings from the command line. Raises ConfigError for anything that does not parse."""
    arguments = ["--operator_page=true" if a == "--operator_page" else a for a in with_plugins(arguments)]
    if any(a.startswith(("--robot.", "--teleop.", "--resume")) for a in arguments):
        register_devices()
    config_file: str | None = None
    if _flag(arguments, "resume"):
        output_dir = parser.parse_arg("output_dir", arguments)
        if output_dir is None:
            raise ConfigError("--resume needs the run's folder: give --output_dir=DIR.")
        config_file = str(last_checkpoint(Path(output_dir), logger.warning) / "pretrained_model" / "train_config.json")
        _refuse_without_effect(arguments, config_file)
    config_file = parser.parse_arg("config_path", arguments) or config_file
    arguments = parser.filter_arg("config_path", arguments)
    path = parser.parse_arg("policy.path", arguments)
    overrides = [a.replace("--policy.", "--", 1) for a in arguments if a.startswith("--policy.")]
    if path is not None:
        arguments = [a for a in arguments if not a.startswith("--policy.")]
        overrides = [a for a in overrides if not a.startswith("--path")]
    for kind in ("policy", "env", "robot", "teleop"):
        settings = [a for a in arguments if a.startswith(f"--{kind}.")]
        if settings and config_file is None and parser.parse_arg(f"{kind}.type", arguments) is None:
            raise ConfigError(f"{settings[0]} needs to know of which {kind}: give --{kind}.type=... as well.")
    with one_line(lambda: _options(arguments)):
        config: RunConfig = draccus.parse(RunConfig, config_path=config_file, args=arguments)
    if path is not None:
        with one_line(lambda: _options(arguments), group="policy."):
            config.policy = _pretrained_config(path, overrides)
    wanted = parser.parse_arg("device", overrides)
    if wanted and config.policy and config.policy.device != wanted:
        logger.warning("The device '%s' is not available: using '%s'.", wanted, config.policy.device)
    return config


def _refuse_without_effect(arguments: Sequence[str], config_file: str) -> None:
    """Refuse options that a resumed run would take no notice of. Raises ConfigError naming the first one.

    What a run has learned from stays as it was: its policy, its demonstrations, what -1..1 is.
    """
    recorded = json.loads(Path(config_file).read_text(encoding="utf-8"))
    for argument in arguments:
        name, _, given = argument.removeprefix("--").partition("=")
        kept = name.startswith("policy.") and name.removeprefix("policy.") not in CHANGED_ON_RESUME
        if not (kept or name in KEPT_ON_RESUME):
            continue
        group, _, field = name.rpartition(".")
        value = (recorded.get(group) or {}).get(field) if group else recorded.get(field)
        if yaml.safe_load(given) != value and given != str(value):
            raise ConfigError(
                f"--{name}={given} has no effect on --resume: the run goes on with {value}. Leave it out, or begin a "
                "new run from this policy with --policy.path=…/pretrained_model."
            )


def _pretrained_config(path: str, overrides: list[str]) -> PreTrainedConfig:
    """Config of a trained policy, from a folder or the Hub, with the command line's values on top."""
    if Path(path).exists() and not (Path(path) / "config.json").is_file():
        raise ConfigError(f"No policy in {path}: expected config.json; give the `pretrained_model` folder.")
    try:
        policy: PreTrainedConfig = PreTrainedConfig.from_pretrained(path, cli_overrides=overrides)
    except (OSError, HfHubHTTPError, HFValidationError) as error:  # no such folder, and the Hub knows nothing of it
        raise ConfigError(
            f"No policy at {path}: expected a `pretrained_model` folder (or user/name on the Hub, which could not be "
            "reached or has no such policy); check --policy.path."
        ) from error
    if any(override.startswith("--preset") for override in overrides):
        raise ConfigError("A trained policy keeps its numbers: leave out --policy.preset, or give single fields.")
    policy.pretrained_path = Path(path)
    return policy


def _flag(arguments: Sequence[str], name: str) -> bool:
    value: Any = parser.parse_arg(name, list(arguments))
    return str(value).lower() in ("true", "1", "yes")


def _options(arguments: Sequence[str]) -> list[str]:
    """Every option there is for the chosen environment."""
    groups: dict[str, type] = {
        "": RunConfig, "dataset.": DatasetSettings, "eval.": EvalSettings, "wandb.": WandBSettings,
        "replay.": ReplaySettings, "arm.": ArmSettings, "page.": PageSettings, "ray.": RaySettings,
    }  # fmt: skip
    policy = parser.parse_arg("policy.type", list(arguments)) or "cqn"
    if policy in PreTrainedConfig.get_known_choices():
        groups["policy."] = PreTrainedConfig.get_choice_class(policy)
    for kind, choices in (("env", EnvConfig), ("robot", RobotConfig), ("teleop", TeleoperatorConfig)):
        chosen = parser.parse_arg(f"{kind}.type", list(arguments))
        if chosen in choices.get_known_choices():
            groups[f"{kind}."] = choices.get_choice_class(chosen)
    names = [f"--{group}{field.name}" for group, config in groups.items() for field in fields(config)]
    return [*names, "--policy.type", "--policy.path", "--env.type", "--robot.type", "--teleop.type"]
