"""README.md of a repository on the Hub: front matter, a part that a tool writes, and what a person wrote around it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import yaml

from lerobot_cqn.errors import DataError

__all__ = ["Readme", "union"]


@dataclass(frozen=True)
class Readme:
    """A card in its parts.

    Attributes:
        front: names and values of the front matter.
        before, after: a person's text above and below the tool's part; all of it is above where there is none yet.
        tool: whose part it is, named in the marks around it.
    """

    front: Mapping[str, Any]
    before: str
    after: str
    tool: str

    @classmethod
    def read(cls, card: str, tool: str) -> "Readme":
        """Take a card apart; raises DataError when the front matter is not YAML."""
        front, text = _front_matter(card)
        before, found, rest = text.partition(start_mark(tool))
        _, ended, after = rest.partition(end_mark(tool))
        return cls(front, before, after.strip("\n"), tool) if found and ended else cls(front, text, "", tool)

    @property
    def own_text(self) -> str:
        """Text that a person wrote."""
        return f"{self.before.strip()}\n{self.after.strip()}".strip()

    def with_part(self, front: Mapping[str, Any], part: str, title: str) -> str:
        """The card with the tool's part written anew; title: of a card in which nobody has written yet."""
        head = yaml.safe_dump(dict(front), sort_keys=False, allow_unicode=True, width=1000)
        start = self.before.strip("\n") or f"# {title}"
        parts = [start, start_mark(self.tool), part, end_mark(self.tool), *([self.after] if self.after else [])]
        return f"---\n{head}---\n\n" + "\n\n".join(parts) + "\n"


def start_mark(tool: str) -> str:
    """The line above a tool's part."""
    return f"<!-- {tool}: start. Each push writes the text down to the end mark anew. -->"


def end_mark(tool: str) -> str:
    """The line below it."""
    return f"<!-- {tool}: end -->"


def union(there: Any, more: Sequence[str]) -> list[str]:
    """A list of the front matter, or the one text that stands in its place, and what is to be in it."""
    old = [there] if isinstance(there, str) else [str(v) for v in there or []]
    return list(dict.fromkeys([*old, *more]))


def _front_matter(card: str) -> tuple[dict[str, Any], str]:
    lines = card.removeprefix("\ufeff").splitlines()
    if not lines or lines[0].rstrip() != "---":
        return {}, "\n".join(lines)
    ends = [i for i, line in enumerate(lines) if i and line.rstrip() == "---"]
    try:
        front = yaml.safe_load("\n".join(lines[1 : ends[0]])) if ends else None
    except yaml.YAMLError as error:
        raise DataError(f"The front matter of README.md is not YAML: {' '.join(str(error).split())[:200]}") from error
    if not ends or not isinstance(front, dict | None):
        raise DataError("The front matter of README.md, between two lines ---, must be YAML of names and values.")
    return dict(front or {}), "\n".join(lines[ends[0] + 1 :])
