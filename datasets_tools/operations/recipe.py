"""``cqn-data run``: several operations from a YAML recipe as one pass; frames are decoded once and encoded once."""

import dataclasses
import json
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from lerobot_cqn.errors import ConfigError, one_of

from ..terminal.options import help_page, parse
from .job import Job, Step, run_job
from .registry import STEPS, step_class

__all__ = ["help", "load_recipe", "main"]

EXAMPLE = """
cqn-data run paper_real_world --repo_id=local/pick --root=data/pick --new_repo_id=local/pick_cqn \\
    --new_root=data/pick_cqn
cqn-data run my_recipe.yaml --repo_id=local/pick --root=data/pick --filter.threshold=0.002 --filter.auto=false --dry_run
"""


def help(summary: str) -> str:
    """Help page."""
    shipped = "\n\n".join(f"{name}:\n{_text(path)}" for name, path in _shipped().items())
    notes = (
        f"A recipe is a YAML file with steps, or one of those shipped: {', '.join(_shipped())}.\n"
        "--STEP.OPTION=VALUE changes or adds a setting of a step; cqn-data STEP --help explains its options.\n\n"
        f"{shipped}"
    )
    return help_page("cqn-data run", summary, Job, EXAMPLE, notes)


def main(args: list[str]) -> None:
    """Run from the command line; errors as in :func:`load_recipe` and ``run_job``."""
    if not args or args[0].startswith("--"):
        raise ConfigError(f"Name a recipe first: cqn-data run FILE.yaml --…; shipped: {', '.join(_shipped())}.")
    changes = [
        a for a in args[1:] if a.startswith("--") and a[2:].partition(".")[0] in STEPS and "." in a.partition("=")[0]
    ]
    job = parse(Job, [a for a in args[1:] if a not in changes])
    run_job(job, load_recipe(args[0], changes), name=Path(args[0]).stem)


def load_recipe(name: str, changes: list[str] | None = None) -> list[Step]:
    """Steps of a recipe.

    Args:
        name: a file, or the name of a shipped recipe.
        changes: ``--STEP.OPTION=VALUE`` settings that replace those of the file.

    Raises:
        ConfigError: no such file, not a recipe, or an unknown step or setting.
    """
    import yaml

    path: Any = Path(name) if Path(name).is_file() else _shipped().get(name)
    if path is None:
        raise ConfigError(one_of("recipe", name, _shipped()) + f" No file of this name either: {name}.")
    try:
        content = yaml.safe_load(_text(path))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{name} is not YAML: {' '.join(str(error).split())}") from error
    steps = content.get("steps") if isinstance(content, Mapping) else None
    if not isinstance(steps, list) or not steps or set(content) != {"steps"}:
        raise ConfigError(
            f"{name}: expected one key 'steps' with a list of operations, as in: steps: [filter: {{auto: true}}]."
        )
    settings: list[tuple[str, dict[str, Any]]] = []
    for step in steps:
        pair = {step: {}} if isinstance(step, str) else step
        if not isinstance(pair, Mapping) or len(pair) != 1:
            raise ConfigError(f"{name}: expected steps of the form 'name: {{setting: value}}', found {step!r}.")
        operation, given = next(iter(pair.items()))
        if operation not in STEPS:
            raise ConfigError(one_of("step", str(operation), STEPS))
        if given is not None and not isinstance(given, Mapping):
            raise ConfigError(f"{name}: expected settings of '{operation}' as {{name: value}}, found {given!r}.")
        settings.append((operation, dict(given or {})))
    for change in changes or []:
        flag, equals, value = change[2:].partition("=")
        operation, _, option = flag.partition(".")
        chosen = [s for o, s in settings if o == operation]
        if not chosen:
            raise ConfigError(one_of(f"step of {name}", operation, [o for o, _ in settings]))
        for one in chosen:
            one[option] = yaml.safe_load(value) if equals else True
    return [_step(name, operation, given) for operation, given in settings]


def _step(recipe: str, operation: str, given: dict[str, Any]) -> Step:
    kind = step_class(operation)
    known = [f.name for f in dataclasses.fields(kind)]  # type: ignore[arg-type]
    for option in given:
        if option not in known:
            raise ConfigError(f"{recipe}: " + one_of(f"setting of {operation}", str(option), known))
    flags = [f"--{k}={v if isinstance(v, str) else json.dumps(v)}" for k, v in given.items() if v is not None]
    try:
        return parse(kind, flags)
    except ConfigError as error:
        raise ConfigError(f"{recipe}, step {operation}: {error}") from error


def _shipped() -> dict[str, Any]:
    folder = resources.files(__package__) / "recipes"
    return {f.name.removesuffix(".yaml"): f for f in sorted(folder.iterdir(), key=lambda f: f.name)}


def _text(path: Any) -> str:
    return str(path.read_text(encoding="utf-8"))
