"""Writes docs/configuration.md from the code: `python docs/reference.py`; `--check` fails where it is out of date."""

import ast
import dataclasses
import inspect
import io
import re
import sys
import textwrap
import tokenize
import types
import typing
from collections.abc import Iterable, Sequence
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any

from lerobot.envs.configs import EnvConfig

from cqn_data.operations.job import Job
from cqn_data.operations.registry import OPERATIONS, STEPS, module_of
from cqn_train import config as run
from cqn_train import envs as _envs  # noqa: F401  # registers the environments
from cqn_train.bench import cli as bench
from cqn_train.robot.settings import ArmSettings
from cqn_train.sim_arm import FAULTS, SimLeaderConfig, SimUR5eConfig
from lerobot_cqn.base_config import RLConfig
from lerobot_cqn.configuration_cqn import CQNConfig
from lerobot_cqn.configuration_cqn_as import CQNASConfig
from lerobot_cqn.configuration_drqv2 import DrQv2Config
from lerobot_cqn.settings import (
    CQN_AS_PRESETS,
    DRQV2_PRESETS,
    PRESETS,
    CommonSettings,
    CQNASSettings,
    CQNSettings,
    DrQv2Settings,
)

TARGET = Path(__file__).with_name("configuration.md")

INTRODUCTION = """\
# Configuration reference

<!-- Made from the code by docs/reference.py (`make docs`): change the comments in the code, not this file. -->

Every option of `cqn-train`, `cqn-data` and `cqn-bench`, with its type, its default and what stands beside it in the
code. The same in a terminal: `cqn-train --policy.type=cqn --env.type=ur5e_station --help`, `cqn-data filter --help`.

- Options are written `--name=value`. Lists are written `'[a, b]'`, tables `'{a: 1, b: 2}'`, nothing `null`.
- A default of `None` means: left open. The last column, or the preset, says what is taken instead.
- `cqn-train` reads settings from a file with `--config_path=FILE` (YAML or JSON, the same names nested); options given
  beside it win. Every checkpoint holds the settings of its run: `pretrained_model/train_config.json`.
- `--debug` shows where in the code an error came from.
"""

# LeRobot's fields, beside which its code says nothing, or something else than what holds here.
OTHERWISE = {
    "preset": "column of numbers that fields left open take; the tables below have them",
    "n_obs_steps": "unused: `frame_stack` says how many frames are seen",
    "input_features": "follow from the dataset or the environment",
    "output_features": "follow from the dataset or the environment",
    "device": "`cpu`, `cuda`, `mps`; None: the best one there is",
    "use_amp": "unused: `bf16` is the option for half precision",
    "use_peft": "unused",
    "push_to_hub": "push the trained policy to the Hub as `repo_id`",
    "repo_id": "name on the Hub, as user/name",
    "private": "make the repository on the Hub private",
    "tags": "tags on the Hub",
    "license": "licence named on the Hub",
    "pretrained_path": "set by `--policy.path=FOLDER_OR_HUB_NAME`: continue from a trained policy",
    "pretrained_revision": "branch, tag or commit of the policy on the Hub",
    "normalization_mapping": "how each kind of feature is scaled; `MIN_MAX` makes the action bounds those of the data",
    "id": "tells arms of the same type apart",
    "calibration_dir": "where LeRobot keeps the calibration",
    "fps": "control steps a second",
    "task": "name of the task",
    "max_parallel_tasks": "LeRobot's, for several tasks at once; unused here",
    "disable_env_checker": "leave out gymnasium's checks of an environment",
}


# -- fields and what stands beside them ------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Row:
    """One option. text: what stands beside it in the code, "" where nothing does."""

    name: str
    type: str
    default: str
    text: str


def rows(config: type, skip: Sequence[str] = ()) -> list[Row]:
    """The fields of a dataclass that a user may set one by one."""
    found = []
    for field in dataclasses.fields(config):
        if field.name in skip or not field.init:
            continue
        found.append(Row(field.name.rstrip("_"), type_text(field.type), default_text(field), meaning(config, field)))
    return found


def meaning(config: type, field: "dataclasses.Field[Any]") -> str:
    """What stands beside a field in the code, where that is more than a letter."""
    text = field.metadata.get("help") or comment(config, field.name)
    return text if len(text) > 1 else OTHERWISE.get(field.name, text)


def comment(config: type, name: str) -> str:
    """The comment beside a field or the line about it in the docstring, of the nearest class that has one."""
    for owner in config.__mro__:
        if dataclasses.is_dataclass(owner) and not owner.__module__.startswith("lerobot."):
            text = _beside(owner).get(name) or _attributes(owner).get(name, "")
            if text:
                return text
    return ""


@cache
def _beside(owner: type) -> dict[str, str]:
    """Comments of a class by field: on its lines, or above it where they go on a sentence (no capital: no heading)."""
    source = textwrap.dedent(inspect.getsource(owner))
    comments: dict[int, tuple[str, bool]] = {}  # line -> text, and whether it stands alone there
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and not token.string.startswith(("# type:", "# fmt:", "# noqa")):
            comments[token.start[0]] = (token.string.lstrip("# ").strip(), token.line.lstrip().startswith("#"))
    body = next(node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ClassDef)).body
    found = {}
    for node in body:
        if not (isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)):
            continue
        lines = range(node.lineno, (node.end_lineno or node.lineno) + 1)
        inside = [comments[line][0] for line in lines if line in comments]
        above = comments.get(node.lineno - 1, ("", False))
        if not inside and above[1] and above[0][:1].islower():
            inside = [above[0]]
        if len(inside) == 1:  # several are about the parts of a table
            found[node.target.id] = inside[0]
    return found


@cache
def _attributes(owner: type) -> dict[str, str]:
    """Entries of the section "Attributes:" of a class's docstring."""
    section = inspect.getdoc(owner) or ""
    block = re.search(r"^Attributes:\n((?:[ ].*\n?|\n)+)", section, re.MULTILINE)
    entries = re.findall(r"^(\w+): (.*(?:\n +.*)*)", textwrap.dedent(block[1]), re.MULTILINE) if block else []
    return {name: " ".join(text.split()).rstrip(".") for name, text in entries}


def type_text(kind: Any) -> str:
    """A type as a person would say it."""
    if isinstance(kind, str):
        return kind
    if isinstance(kind, types.UnionType) or typing.get_origin(kind) is typing.Union:
        return " or ".join(type_text(part) for part in typing.get_args(kind) if part is not type(None))
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin is not None:
        shown = ", ".join("..." if part is Ellipsis else type_text(part) for part in inner)
        return f"{origin.__name__}[{shown}]"
    return "path" if kind is Path else str(getattr(kind, "__name__", kind))


def default_text(field: "dataclasses.Field[Any]") -> str:
    """A default as it is written on the command line."""
    if field.default is not dataclasses.MISSING:
        return value_text(field.default)
    if field.default_factory is not dataclasses.MISSING:
        return value_text(field.default_factory())
    return "*required*"


def value_text(value: Any) -> str:
    """A value as it is written on the command line, in code marks."""
    return f"`{_plain(value)}`" if value != "" else "–"


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {_plain(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_plain, value)) + "]"
    return str(value)


# -- Markdown ----------------------------------------------------------------------------------------------------


def table(head: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *body]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def options(entries: Sequence[Row], prefix: str = "") -> str:
    """A table of options."""
    return table(
        ["option", "type", "default", "meaning"],
        [[f"`--{prefix}{row.name}`", row.type, row.default, row.text] for row in entries],
    )


def first_sentence(owner: type) -> str:
    """The first paragraph of a docstring, without the code's quotes."""
    return " ".join((inspect.getdoc(owner) or "").partition("\n\n")[0].split())


def presets(kind: type[CommonSettings], columns: dict[str, dict[str, Any]]) -> str:
    """Every number of a method in every preset; bold where it is not the first preset's."""
    made = {name: kind(**values) for name, values in columns.items()}
    first = next(iter(made.values()))
    body = []
    for field in dataclasses.fields(kind):
        standard = getattr(first, field.name)
        cells = []
        for settings in made.values():
            value = getattr(settings, field.name)
            cells.append(_plain(value) if value == standard else f"**{_plain(value)}**")
        body.append([f"`{field.name}`", *cells])
    return table(["`--policy.`", *(f"`{name}`" for name in made)], body)


def meanings(kind: type[CommonSettings]) -> str:
    """What each number of a method is."""
    return table(
        ["option", "type", "meaning"],
        [[f"`--policy.{f.name}`", type_text(f.type), meaning(kind, f)] for f in dataclasses.fields(kind)],
    )


def recipes(kind: type[RLConfig], names: Iterable[str]) -> str:
    """What a run takes from each preset where it is told nothing else."""
    made = {name: run.RunConfig(policy=kind(preset=name, device="cpu")).recipe for name in names}
    body = [
        [f"`--{field.name}`", *(_plain(getattr(recipe, field.name)) for recipe in made.values())]
        for field in dataclasses.fields(run.Recipe)
    ]
    return table(["option", *(f"`{name}`" for name in made)], body)


# -- the page ----------------------------------------------------------------------------------------------------


def training() -> list[str]:
    """Sections on `cqn-train`."""
    groups = {
        "dataset": run.DatasetSettings, "eval": run.EvalSettings, "replay": run.ReplaySettings, "arm": ArmSettings,
        "page": run.PageSettings, "wandb": run.WandBSettings,
    }  # fmt: skip
    choices = ["policy", "env", "robot", "teleop"]
    parts = [
        "## `cqn-train`",
        "One of `--env.type` and `--robot.type`, `--policy.type` (or `--policy.path`, or `--resume=true`) and "
        "`--output_dir` must be given; training without `--dataset.repo_id` is under [DeepMind "
        "Control](environments.md#deepmind-control).",
        options(rows(run.RunConfig, [*choices, *groups])),
        "`--policy.type`, `--env.type`, `--robot.type` and `--teleop.type` choose one of the tables below, or of "
        "LeRobot's own robots and teleoperators, whose options LeRobot documents.",
    ]
    for name, kind in groups.items():
        parts += [f"### `--{name}.*`", first_sentence(kind), options(rows(kind), f"{name}.")]
    return parts


def policies() -> list[str]:
    """Sections on the policies."""
    numbers = {field.name for kind in (CQNASSettings, DrQv2Settings) for field in dataclasses.fields(kind)}
    parts = ["## Policies", "### Common to all", options(rows(RLConfig, sorted(numbers)), "policy.")]
    for name, kind, settings, columns in (
        ("cqn", CQNConfig, CQNSettings, PRESETS),
        ("cqn_as", CQNASConfig, CQNASSettings, CQN_AS_PRESETS),
        ("drqv2", DrQv2Config, DrQv2Settings, DRQV2_PRESETS),
    ):
        parts += [
            f"### Policy {name}",
            f"`--policy.type={name}`. {first_sentence(kind)}",
            "Each number by `--policy.preset`; **bold** where it differs from the first column, which is the default "
            "preset. Every one can be given by itself, as `--policy.n_step=1`. Sources and deviations: "
            "[algorithm.md](algorithm.md) and [baselines.md](baselines.md).",
            presets(settings, columns),
            "What they mean:",
            meanings(settings),
            "What a run takes from the preset where it is not told otherwise:",
            recipes(kind, columns),
        ]
    parts.append(
        "On an arm, `updates_per_step` is 0 and `updates_per_episode` at least 50 unless given: the arm does not move "
        "while the network learns."
    )
    return parts


def worlds() -> list[str]:
    """Sections on environments, and on the simulated arm."""
    parts = ["## Environments", "For `cqn-train`, `cqn-data record`, `lerobot-eval` and `lerobot-train` alike."]
    derived = ["features", "features_map", "max_parallel_tasks", "disable_env_checker"]
    for name, kind in sorted(EnvConfig.get_known_choices().items()):
        if kind.__module__.startswith("cqn_train."):
            text = f"`--env.type={name}`. {first_sentence(kind)}"
            parts += [f"### Environment {name}", text, options(rows(kind, derived), "env.")]
    parts += [
        "## The simulated arm",
        "### Robot sim_ur5e",
        f"`--robot.type=sim_ur5e`. {first_sentence(SimUR5eConfig)}",
        options(rows(SimUR5eConfig), "robot."),
        "Faults, as `--robot.faults='[{kind: frozen_camera, at_s: 5, for_s: 2}]'`:",
        table(["kind", "what happens"], [[f"`{kind}`", text] for kind, text in FAULTS.items()]),
        "### Leader sim_leader",
        f"`--teleop.type=sim_leader`. {first_sentence(SimLeaderConfig)}",
        options(rows(SimLeaderConfig), "teleop."),
    ]
    return parts


def dataset_tools() -> list[str]:
    """Sections on `cqn-data`."""
    steps = ", ".join(f"`{name}`" for name in STEPS)
    parts = [
        "## `cqn-data`",
        "Explained with examples in [datasets.md](datasets.md).",
        "### Where to read and write",
        f"The same for {steps} and `run`.",
        options(rows(Job)),
    ]
    for name, operation in OPERATIONS.items():
        module, summary = module_of(name), operation.summary
        found = [rows(kind) for kind in vars(module).values() if _holds_options(kind, module.__name__)]
        parts += [f"### `cqn-data {name}`", summary[0].upper() + summary[1:] + "."]
        parts += [options(entries) for entries in found]
        if name == "run":
            parts.append("`cqn-data run RECIPE`, and `--STEP.OPTION=VALUE` for a setting of one of its steps.")
    return parts


def _holds_options(kind: Any, module: str) -> bool:
    if not (isinstance(kind, type) and dataclasses.is_dataclass(kind) and kind.__module__ == module):
        return False
    return any(field.metadata.get("help") for field in dataclasses.fields(kind))


def pushing() -> list[str]:
    """Section on `cqn-push`."""
    from cqn_train.push.config import PushConfig

    return ["## `cqn-push`", "Sends a run's policy to the Hugging Face Hub, with a card.", options(rows(PushConfig))]


def comparisons() -> list[str]:
    """Section on `cqn-bench`."""
    return ["## `cqn-bench`", "```text\n" + bench.HELP.strip() + "\n```"]


def page() -> str:
    """The whole page."""
    parts = [INTRODUCTION.rstrip(), *training(), *policies(), *worlds(), *dataset_tools(), *pushing(), *comparisons()]
    return "\n\n".join(parts) + "\n"


def main(arguments: Sequence[str]) -> int:
    """Write the page, or say that it is out of date; returns the exit code."""
    text = page()
    if "--check" not in arguments:
        TARGET.write_text(text, encoding="utf-8")
        return 0
    if not TARGET.is_file() or TARGET.read_text(encoding="utf-8") != text:
        sys.stderr.write(f"{TARGET} is out of date: run python docs/reference.py.\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
