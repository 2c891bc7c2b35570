"""Which episodes of an earlier process are gone, and why."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from .files import Place, Rows

__all__ = ["Damage", "find_damage"]


@dataclass(frozen=True)
class Damage:
    """Damage of a replay's files; its text is for people.

    lost: places whose rows are not all there; untold: how many episodes no line of the journal tells of; left: how many
    episodes of the run are whole; reasons: what is wrong with which file.
    """

    lost: tuple[Place, ...]
    untold: int
    left: int
    reasons: tuple[str, ...]

    def __str__(self) -> str:
        gone = len(self.lost) + self.untold
        what = ", ".join(self.reasons)
        return f"{what}; {gone} of the run's {gone + self.left} episodes are gone, {self.left} are left."


def find_damage(places: Sequence[Place], rows: Mapping[str, Rows], untold: Collection[int]) -> Damage | None:
    """What is gone of the run's episodes; None where nothing is.

    places: that the journal tells of; rows: the arrays, by name, as they lie on the disk; untold: numbers of episodes
    that the journal must tell of and does not.
    """
    found = {name: array.path.stat().st_size for name, array in rows.items() if array.path and array.path.is_file()}
    lost: list[tuple[Place, str]] = []
    for place in places:
        if not rows:
            lost.append((place, "layout.json is missing"))
        for name, array in rows.items():
            if array.row_bytes and found.get(name, 0) < place.stop * array.row_bytes:
                lost.append((place, f"{name}.bin is {'cut off' if name in found else 'missing'}"))
                break
    if not lost and not untold:
        return None
    reasons = sorted({why for _, why in lost} | ({"episodes.jsonl lacks lines"} if untold else set()))
    return Damage(tuple(place for place, _ in lost), len(untold), len(places) - len(lost), tuple(reasons))
