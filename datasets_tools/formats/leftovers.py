"""What an input holds and a conversion does not take: named, never left out unsaid."""

from collections.abc import Collection, Mapping
from typing import Any

__all__ = ["arrays_in", "left_out"]

MANY = 4  # arrays of one group, from which on they are counted and no longer listed


def arrays_in(group: Any) -> list[str]:
    """Paths of all arrays below an HDF5 group, in the file's order."""
    found: list[str] = []

    def visit(name: str, item: Any) -> None:
        if hasattr(item, "shape"):
            found.append(name)

    group.visititems(visit)
    return found


def left_out(seen: Mapping[str, Collection[str]], taken: Collection[str]) -> list[str]:
    """Sentences on what is not taken.

    Args:
        seen: paths of the arrays by episode.
        taken: paths that are converted.

    Returns:
        one sentence for what every episode has, one for what only some have; none where all is taken.
    """
    counts: dict[str, int] = {}
    for paths in seen.values():
        for path in paths:
            if path not in taken:
                counts[path] = counts.get(path, 0) + 1
    everywhere = [path for path, count in counts.items() if count == len(seen)]
    rare = [f"{path} ({count} of {len(seen)} episodes)" for path, count in counts.items() if count < len(seen)]
    said = [f"Left out: {', '.join(_grouped(everywhere))}."] if everywhere else []
    return [*said, f"Left out, and only in some episodes: {', '.join(rare)}."] if rare else said


def _grouped(paths: Collection[str]) -> list[str]:
    groups: dict[str, list[str]] = {}
    for path in paths:
        groups.setdefault(path.rpartition("/")[0], []).append(path)
    shown: list[str] = []
    for group, members in groups.items():
        if group in ("", "obs", "observations", "observations/images", "data") or len(members) <= MANY:
            shown += members
        else:
            shown.append(f"{group} ({len(members)} arrays)")
    return shown
