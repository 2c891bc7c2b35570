"""Mistakes on a command line in one line each, which draccus raises in many kinds and argparse prints as pages."""

import contextlib
import io
import re
from collections.abc import Callable, Iterable, Iterator
from difflib import get_close_matches

from lerobot_cqn.errors import ConfigError, CQNError, one_of

__all__ = ["one_line"]


@contextlib.contextmanager
def one_line(options: Callable[[], Iterable[str]], *, group: str = "", prefix: str = "") -> Iterator[None]:
    """Raise what goes wrong while options are read as one line.

    Args:
        options: gives the names there are, as ``--name``; asked for where one is unknown.
        group: "policy." where ``--name`` was given as ``--policy.name``.
        prefix: put before what is said of a value.

    Raises:
        CQNError: of a check that the options have of their own.
        ConfigError: an option that is unknown or lacks its value, or a value of another type.
    """
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            yield
    except CQNError:
        raise
    except SystemExit as error:
        raise ConfigError(_option_error(complaint.getvalue(), options, group)) from error
    except Exception as error:  # draccus raises many kinds
        cause = _user_cause(error)
        if isinstance(cause, CQNError):
            raise cause from None
        raise ConfigError(prefix + (" ".join(str(cause).split()) or type(cause).__name__)) from error


def _user_cause(error: BaseException) -> BaseException:
    """The error that a person can act on: a config's own check if there was one, else the field that did not parse."""
    from draccus.utils import DecodingError, ParsingError

    chain: list[BaseException] = []
    cause: BaseException | None = error
    while cause is not None and cause not in chain:
        chain.append(cause)
        cause = cause.__cause__ or cause.__context__
    ours = [e for e in chain if isinstance(e, CQNError)]
    parsing = [e for e in chain if isinstance(e, DecodingError | ParsingError)]
    wrapped = parsing and str(parsing[-1]).startswith("Couldn't instantiate")  # a check of LeRobot's own
    return (ours or ([] if wrapped else parsing[-1:]) or chain[-1:])[0]


def _option_error(complaint: str, options: Callable[[], Iterable[str]], group: str) -> str:
    """The last line of argparse's pages, with the nearest option or choice."""
    text = (complaint.strip().splitlines() or ["unreadable options"])[-1].partition("error: ")[2]
    choice = re.search(r"argument (\S+): invalid choice: '(.*?)' \(choose from (.*)\)", text)
    if choice:
        return one_of(f"value of {choice[1]}", choice[2], re.findall(r"[\w.-]+", choice[3]))
    unknown = re.search(r"unrecognized arguments: (\S+)", text)
    if unknown is None:
        return f"{text} (--help lists all options)"
    name = unknown[1].partition("=")[0].replace("--", f"--{group}", 1)
    near = get_close_matches(name, options(), n=1)
    hint = f" Did you mean '{near[0]}'?" if near else ""
    return f"Unknown option '{name}': expected --name=value with a name that --help lists.{hint}"
