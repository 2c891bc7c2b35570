"""Ranges of numbers, kept beside them: a field of a settings record says what it allows, one function checks all."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

from .errors import ConfigError

__all__ = ["Range", "check_ranges", "number"]


@dataclass(frozen=True, kw_only=True)
class Range:
    """Allowed values of a number: from `least` or strictly above `above`, up to `most`; None: no such bound.

    unit: for a person, e.g. "seconds".
    """

    least: float | None = None
    above: float | None = None
    most: float | None = None
    unit: str = ""

    def holds(self, value: float) -> bool:
        """Whether the value lies in the range; NaN lies in none."""
        return (
            (self.least is None or value >= self.least)
            and (self.above is None or value > self.above)
            and (self.most is None or value <= self.most)
        )

    def __str__(self) -> str:
        """Words for a person: "at least 1", "in (0, 1]", "0 to 5 seconds"."""
        return f"{self._bounds()} {self.unit}".rstrip()

    def _bounds(self) -> str:
        if self.above is not None:
            return f"in ({self.above:g}, {self.most:g}]" if self.most is not None else "positive"
        if self.least is None:
            return f"at most {self.most:g}"
        return f"{self.least:g} to {self.most:g}" if self.most is not None else f"at least {self.least:g}"


def number(default: Any, **bounds: Any) -> Any:
    """Dataclass field with a default and a range, which `check_ranges` keeps; bounds: the fields of `Range`."""
    return dataclasses.field(default=default, metadata={"range": Range(**bounds)})


def check_ranges(settings: Any, prefix: str = "") -> None:
    """Check every number of a settings record that has a range; None passes.

    prefix: of the names in messages, e.g. "eval.".
    Raises ConfigError naming the field, what is allowed and the value found; no number may be infinite.
    """
    for field in dataclasses.fields(settings):
        allowed, value = field.metadata.get("range"), getattr(settings, field.name)
        if allowed is None or value is None:
            continue
        if math.isinf(value):
            raise ConfigError(f"`{prefix}{field.name}` must be finite, got {value}.")
        if not allowed.holds(value):
            raise ConfigError(f"`{prefix}{field.name}` must be {allowed}, got {value}.")
