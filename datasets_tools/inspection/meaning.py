"""Judgements of ``cqn-data inspect`` on what columns mean: which state is of which action, velocities, angles."""

from collections.abc import Iterator, Sequence

from lerobot_cqn.schema import ACTION

from .finding import Finding, names_text
from .numbers import Dimension, Numbers

__all__ = ["meaning"]


def meaning(numbers: Numbers) -> Iterator[Finding]:
    """Findings on what the dimensions of states and actions mean, by their names and by how they change."""
    yield from _names_of_joints(numbers)
    yield from _angles(numbers)
    for key, (episode, frame) in numbers.infinite.items():
        text = f"'{key}' is not finite, the first time in episode {episode}, frame {frame}; training does not read it."
        advice = "Fine; or take it out: lerobot-edit-dataset --operation.type=remove_feature."
        yield Finding("note", "infinite_column", key, text, advice)


def _names_of_joints(numbers: Numbers) -> Iterator[Finding]:
    if numbers.follow is not None and numbers.follow.remark:
        advice = "Right if both have one order; else correct 'names' in meta/info.json."
        yield Finding("note", "matching", ACTION, numbers.follow.remark, advice)
    rates = [d for d in numbers.dimensions if d.rate]
    if rates:
        text = f"Velocities by their names: {names_text(rates)}; a step at which one is not near 0 is no pause."
        yield Finding("note", "velocities", _column_of(rates), text)


def _angles(numbers: Numbers) -> Iterator[Finding]:
    wraps = [(d, *d.turned) for d in numbers.dimensions if d.turned is not None and not d.gripper]
    if wraps:
        first, episode, frame = wraps[0]
        listed = names_text([d for d, *_ in wraps])
        place = f"the first of '{first.name}' in episode {episode}, frame {frame}"
        text = f"Changes by nearly a full turn: {listed}; {place}."
        advice = "Angles that wrap: unwrap them where they are recorded, or keep them absolute in cqn-data delta."
        yield Finding("warning", "wraps", _column_of([d for d, *_ in wraps]), text, advice)


def _column_of(dimensions: Sequence[Dimension]) -> str:
    return ", ".join(dict.fromkeys(d.column for d in dimensions))
