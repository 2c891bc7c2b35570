"""LeRobot-style flags for one operation: ``--name=value`` into a dataclass, and a help page from the same."""

import dataclasses
import textwrap
from collections.abc import Sequence
from typing import Any

from lerobot_cqn.errors import ConfigError, one_of

from .mistakes import one_line

__all__ = ["REVISION", "ROOT", "help_page", "option", "parse", "parse_all", "parse_choice", "with_plugins"]


ROOT = "Its folder; by default LeRobot's home and the repo_id, and where it is not there, the Hub."
REVISION = "Branch, tag or commit on the Hub; by default the newest of this format."


def option(default: Any = dataclasses.MISSING, *, help: str) -> Any:
    """Dataclass field with a default and the sentence shown by ``--help``; required without a default."""
    return dataclasses.field(default=default, metadata={"help": help})


def parse[Config](config_class: type[Config], args: Sequence[str]) -> Config:
    """One dataclass from flags; errors as in :func:`parse_all`."""
    config: Config = parse_all((config_class,), args)[0]
    return config


def parse_all(config_classes: Sequence[type], args: Sequence[str]) -> tuple[Any, ...]:
    """Dataclasses from flags that share one command line.

    Args:
        config_classes: dataclasses whose fields are made by :func:`option`; no name occurs twice.
        args: e.g. ``["--threshold=0.01", "--dry_run"]``; a flag without a value means true for booleans.

    Returns:
        one instance of each class.

    Raises:
        ConfigError: unknown flag (with the nearest one), missing required flag, or a value of another type.
    """
    owners = {f.name: (c, f) for c in config_classes for f in dataclasses.fields(c)}
    given: list[str] = []
    flags: dict[type, list[str]] = {c: [] for c in config_classes}
    latest: type | None = None  # class of a flag whose value is the next argument
    for position, arg in enumerate(args):
        name, equals, _ = arg.partition("=")
        if not name.startswith("--"):
            if latest is None:
                raise ConfigError(f"Unexpected '{arg}': options are written --name=value.")
            flags[latest].append(arg)
            latest = None
            continue
        name = name[2:].partition(".")[0]
        if name not in owners:
            raise ConfigError(one_of("option", f"--{name}", [f"--{f}" for f in owners]))
        owner, field = owners[name]
        following = args[position + 1] if position + 1 < len(args) else "--"
        bare = not equals and following.startswith("--")
        if bare and field.type not in (bool, "bool"):
            raise ConfigError(f"Option --{name} needs a value: --{name}=VALUE.")
        flags[owner].append(f"--{name}=true" if bare else arg)
        latest = None if equals or bare else owner
        given.append(name)
    missing = [n for n, (_, f) in owners.items() if _required(f) and n not in given]
    if missing:
        raise ConfigError(f"Missing {', '.join(f'--{n}=…' for n in missing)}; --help shows an example.")
    import draccus

    with one_line(lambda: [f"--{f}" for f in owners], prefix="Bad option value: "):
        parsed = tuple(draccus.parse(c, args=flags[c]) for c in config_classes)
    for name, (owner, _) in owners.items():
        value = getattr(parsed[config_classes.index(owner)], name)
        if isinstance(value, dict) and None in value.values():
            raise ConfigError(f"Option --{name}: expected '{{name: value}}' with a space after each colon.")
    return parsed


def parse_choice(group: str, registry: Any, args: Sequence[str]) -> Any:
    """The dataclass that LeRobot knows as NAME, from ``--GROUP.type=NAME --GROUP.OPTION=VALUE …``.

    Args:
        group: e.g. "env".
        registry: the base class of the choices, e.g. LeRobot's ``EnvConfig``.
        args: options of the group only.

    Raises:
        ConfigError: no type or an unknown one; otherwise as in :func:`parse_all`, with the type named.
    """
    settings = [a.replace(f"--{group}.", "--", 1).partition("=") for a in args]
    kinds = [value for name, _, value in settings if name == "--type"]
    known = registry.get_known_choices()
    if not kinds or not kinds[-1]:
        raise ConfigError(f"Missing --{group}.type=NAME; known: {', '.join(known)}.")
    kind = kinds[-1]
    if kind not in known:
        raise ConfigError(one_of(f"--{group}.type", kind, known))
    try:
        return parse(known[kind], ["".join(setting) for setting in settings if setting[0] != "--type"])
    except ConfigError as error:
        raise ConfigError(f"--{group}.type={kind}: {error}") from error


def with_plugins(args: Sequence[str]) -> list[str]:
    """The arguments without ``--env.discover_packages_path=PACKAGE``, whose packages have registered what they hold.

    Raises:
        ConfigError: a package that cannot be imported.
    """
    from lerobot.configs import parser

    rest = list(args)
    for flag, package in parser.parse_plugin_args(parser.PLUGIN_DISCOVERY_SUFFIX, rest).items():
        try:
            parser.load_plugin(package)
        except Exception as error:  # whatever its code raises; AttributeError: LeRobot takes packages only
            why = "it is a module, expected a package (a folder)" if isinstance(error, AttributeError) else str(error)
            raise ConfigError(f"--{flag}={package} cannot be loaded: {' '.join(why.split())[:300]}.") from error
        rest = parser.filter_arg(flag, rest)
    return rest


def help_page(command: str, summary: str, config: type | tuple[type, ...], example: str, extra: str = "") -> str:
    """Help text of a command: what it does, an example that can be pasted, every flag with its default."""
    lines = [f"{command}: {summary}", "", "Example:", textwrap.indent(example.strip("\n"), "  "), ""]
    lines.append("Options:")
    for field in (f for c in (config if isinstance(config, tuple) else (config,)) for f in dataclasses.fields(c)):
        text = field.metadata.get("help", "")
        default = _default(field)
        suffix = "(required)" if _required(field) else "" if default in (None, "") else f"(default {default})"
        lines.append(f"  --{field.name}")
        lines += textwrap.wrap(f"{text} {suffix}".strip(), 92, initial_indent=" " * 6, subsequent_indent=" " * 6)
    lines += ["  --debug", "      Show the full traceback and the libraries' logs.", "  --help"]
    return "\n".join([*lines, *(["", extra.strip("\n")] if extra else [])])


def _required(field: Any) -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _default(field: Any) -> Any:
    if field.default is dataclasses.MISSING:
        return None
    return str(field.default).lower() if isinstance(field.default, bool) else field.default
