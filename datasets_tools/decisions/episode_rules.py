"""Rules about episodes, such as ``steps < 20`` or ``observation.state[gripper.pos].last > 0.5``; never code.

Grammar: QUANTITY OPERATOR NUMBER. QUANTITY is ``steps``, ``seconds``, ``return`` (sum of rewards), ``success`` (1 or
0), or COLUMN, COLUMN[NAME] or COLUMN[NUMBER], followed by .first, .last (the default), .min, .max, .mean or .range over
the episode. A column of several dimensions without [NAME] stands for the one with the largest value.
"""

import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lerobot_cqn.errors import ConfigError, one_of
from lerobot_cqn.schema import NEXT_REWARD, NEXT_SUCCESS, dimension_names

__all__ = ["Rule", "parse_rule"]

COMPARE: dict[str, Callable[[float, float], bool]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    ">": operator.gt,
}
OVER: dict[str, Callable[[Any], Any]] = {
    "first": lambda v: v[0],
    "last": lambda v: v[-1],
    "min": lambda v: v.min(axis=0),
    "max": lambda v: v.max(axis=0),
    "mean": lambda v: v.mean(axis=0),
    "range": lambda v: v.max(axis=0) - v.min(axis=0),
}
PLAIN = ("steps", "seconds", "return", "success")
FORM = re.compile(
    r"\s*(?P<column>[^\s<>=!\[\]]+?)(\[(?P<dim>[^\]]+)\])?(\.(?P<over>first|last|min|max|mean|range))?"
    r"\s*(?P<compare><=|>=|==|!=|<|>)\s*(?P<value>[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?)\s*"
)


@dataclass(frozen=True)
class Rule:
    """A parsed rule."""

    text: str
    column: str
    dim: int | None
    over: str
    compare: str
    value: float

    def quantity(self, columns: Mapping[str, Any], steps: int, fps: float) -> float:
        """The number that the rule compares.

        Args:
            columns: name -> array of an episode, ``steps`` rows each.
            steps: of the episode.
            fps: steps a second.
        """
        if self.column == "steps":
            return float(steps)
        if self.column == "seconds":
            return steps / fps
        if self.column == "return":
            return float(np.sum(columns[NEXT_REWARD]))
        if self.column == "success":
            return float(np.any(columns[NEXT_SUCCESS] if NEXT_SUCCESS in columns else columns[NEXT_REWARD] > 0))
        values = np.asarray(columns[self.column], dtype=np.float64).reshape(steps, -1)
        chosen = OVER[self.over](values)
        return float(chosen.max() if self.dim is None else chosen[self.dim])

    def holds(self, columns: Mapping[str, Any], steps: int, fps: float) -> bool:
        """Whether an episode fulfils the rule; arguments as of :meth:`quantity`."""
        return COMPARE[self.compare](self.quantity(columns, steps, fps), self.value)


def parse_rule(text: str, features: Mapping[str, Mapping[str, Any]]) -> Rule:
    """A rule about the episodes of a dataset with these LeRobot features, from its text.

    Raises:
        ConfigError: not a rule, or a column or dimension that the dataset does not have.
    """
    found = FORM.fullmatch(text)
    if found is None:
        raise ConfigError(
            f"Cannot read the rule '{text}': expected e.g. 'steps < 20' or 'observation.state[0].last > 1'."
        )
    column, dim = found["column"], found["dim"]
    numbers = [k for k, f in features.items() if f["dtype"] not in ("string", "image", "video", "language")]
    if column in PLAIN:
        needs = {"return": (NEXT_REWARD,), "success": (NEXT_SUCCESS, NEXT_REWARD)}.get(column)
        if needs and not any(k in features for k in needs):
            raise ConfigError(
                f"The rule '{text}' needs a column '{needs[0]}', which the dataset does not have; label it."
            )
        if dim or found["over"]:
            raise ConfigError(f"The rule '{text}': '{column}' is one number for an episode; write '{column} < …'.")
    elif column not in numbers:
        raise ConfigError(one_of("quantity of a rule", column, [*PLAIN, *numbers]))
    position: int | None = None
    if dim is not None:
        names = dimension_names(features[column])
        if dim not in names and not (dim.isdigit() and int(dim) < len(names)):
            raise ConfigError(one_of(f"dimension of '{column}'", dim, names))
        position = names.index(dim) if dim in names else int(dim)
    return Rule(text.strip(), column, position, found["over"] or "last", found["compare"], float(found["value"]))
