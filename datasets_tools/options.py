"""LeRobot-style flags for one operation: ``--name=value`` into a dataclass, and a help page from the same."""

import contextlib
import dataclasses
import io
import textwrap
from collections.abc import Sequence
from typing import Any

__all__ = ["help_page", "option", "parse"]


def option(default: Any = dataclasses.MISSING, *, help: str) -> Any:
    """Dataclass field with a default and the sentence shown by ``--help``; required without a default."""
    return dataclasses.field(default=default, metadata={"help": help})


def parse[Config](config_class: type[Config], args: Sequence[str]) -> Config:
    """Read flags into ``config_class``.

    Args:
        config_class: a dataclass whose fields are made by :func:`option`.
        args: e.g. ``["--threshold=0.01", "--dry_run"]``; a flag without a value means true for booleans.

    Raises:
        ConfigError: unknown flag (with the nearest one), missing required flag, or a value of another type.
    """
    import draccus
    from draccus.utils import DecodingError, ParsingError

    from lerobot_cqn.errors import ConfigError, CQNError, one_of

    fields = {f.name: f for f in dataclasses.fields(config_class)}  # type: ignore[arg-type]
    given: list[str] = []
    expanded: list[str] = []
    for position, arg in enumerate(args):
        name, equals, _ = arg.partition("=")
        if not name.startswith("--"):
            if position == 0 or not args[position - 1].startswith("--") or "=" in args[position - 1]:
                raise ConfigError(f"Unexpected '{arg}': options are written --name=value.")
            expanded.append(arg)
            continue
        name = name[2:].partition(".")[0]
        if name not in fields and name != "config_path":
            raise ConfigError(one_of("option", f"--{name}", [f"--{f}" for f in fields]))
        following = args[position + 1] if position + 1 < len(args) else "--"
        if not equals and following.startswith("--"):
            if name not in fields or fields[name].type is not bool:
                raise ConfigError(f"Option --{name} needs a value: --{name}=VALUE.")
            expanded.append(f"--{name}=true")
        else:
            expanded.append(arg)
        given.append(name)
    missing = [n for n, f in fields.items() if _required(f) and n not in given and "config_path" not in given]
    if missing:
        raise ConfigError(f"Missing {', '.join(f'--{n}=…' for n in missing)}; --help shows an example.")
    captured = io.StringIO()
    try:
        with contextlib.redirect_stderr(captured):
            config: Config = draccus.parse(config_class, args=expanded)
    except DecodingError as error:
        raise ConfigError(f"Bad option value: {' '.join(str(error).split())}") from error
    except ParsingError as error:
        cause = error.__cause__ or error.__context__ or error
        if isinstance(cause, CQNError):  # the class checks its own values and says it best
            raise cause from None
        raise ConfigError(f"Bad option value: {' '.join(str(cause).split())}") from error
    except SystemExit as error:
        lines = captured.getvalue().strip().splitlines() or ["unreadable options"]
        raise ConfigError(lines[-1].removeprefix("-: error: ")) from error
    return config


def help_page(name: str, summary: str, config_class: type, example: str, extra: str = "") -> str:
    """Help text of an operation: what it does, an example that can be pasted, every flag with its default."""
    lines = [f"cqn-data {name}: {summary}", "", "Example:", textwrap.indent(example.strip("\n"), "  "), ""]
    lines.append("Options:")
    for field in dataclasses.fields(config_class):
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
