"""Findings of ``cqn-data inspect``, and how episodes, dimensions and pictures are listed in their sentences."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from .numbers import Dimension

__all__ = [
    "LEVELS",
    "NAMED",
    "Finding",
    "Level",
    "advice_to_drop",
    "by_level",
    "count",
    "episodes_text",
    "more",
    "names_text",
    "places_text",
]

Level = Literal["error", "warning", "note"]
LEVELS: tuple[Level, ...] = ("error", "warning", "note")
NAMED = 6  # things listed in a sentence


@dataclass(frozen=True)
class Finding:
    """One thing a person should know.

    Attributes:
        level: error: training fails or learns nothing from this; warning: it suffers; note: good to know.
        code: short name for machines, e.g. `missing_video`.
        where: dataset, column, file or episode it is about.
        text: what was found, one sentence.
        advice: what to do, one sentence; empty where there is nothing to do.
    """

    level: Level
    code: str
    where: str
    text: str
    advice: str = ""


def by_level(finding: Finding) -> int:
    """Rank for sorting, errors first."""
    return LEVELS.index(finding.level)


def count(items: Sequence[object]) -> str:
    return f"{len(items)} episode{'s' if len(items) != 1 else ''}"


def episodes_text(items: Sequence[int]) -> str:
    listed = ", ".join(map(str, items[:NAMED]))
    return f"episode{'s' if len(items) != 1 else ''} {listed}{more(items)}"


def names_text(dimensions: Sequence[Dimension]) -> str:
    unique = list(dict.fromkeys(d.name for d in dimensions))
    return ", ".join(unique[:NAMED]) + more(unique)


def places_text(places: Sequence[tuple[int, int]]) -> str:
    return ", ".join(f"episode {e} frame {f}" for e, f in places[:NAMED]) + more(places)


def more(items: "Sequence[object] | Mapping[int, object]", shown: int = NAMED) -> str:
    return f" and {len(items) - shown} more" if len(items) > shown else ""


def advice_to_drop(items: Sequence[int]) -> str:
    listed = ", ".join(map(str, items[:NAMED])) + (", …" if len(items) > NAMED else "")
    return f"Leave out: cqn-data drop --episodes='[{listed}]'"
