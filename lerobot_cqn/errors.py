"""Exception family: every message says what was expected, what was found and what to do, in one line."""

from collections.abc import Iterable
from difflib import get_close_matches

__all__ = ["CQNError", "ConfigError", "DataError", "OutputError", "OutputExistsError", "one_of"]


class CQNError(Exception):
    """Base of all errors a user can cause; commands print it as one line and exit with code 2."""


class ConfigError(CQNError):
    """A setting is out of range, unknown, or does not fit the features.

    No ValueError: the parser of LeRobot's commands hides those behind "Couldn't instantiate class".
    """


class DataError(CQNError, ValueError):
    """A dataset or an observation is missing, empty, damaged, or of another shape than declared."""


class OutputError(CQNError, OSError):
    """A result cannot be written: the disk is full, or not ours to write to."""


class OutputExistsError(CQNError, FileExistsError):
    """The place to write to already holds something; nothing is ever overwritten."""


def one_of(what: str, got: str, valid: Iterable[str]) -> str:
    """Message for an unknown name: lists what is valid and suggests the nearest one."""
    options = sorted(valid)
    near = get_close_matches(got, options, n=1)
    hint = f" Did you mean '{near[0]}'?" if near else ""
    return f"Unknown {what} '{got}': expected one of {', '.join(options)}.{hint}"
