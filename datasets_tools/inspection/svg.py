"""Drawings of the inspection page: inline SVG that takes its colours from the page and fits a phone."""

import html
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..decisions.pause_threshold import Suggestion
from .numbers import DRAWN, EpisodeNumbers

__all__ = ["pauses", "spark", "still_share", "threshold_histogram"]

WIDTH = 360  # of the drawings, in which the text is 11 high
SPARKS = 40


def threshold_histogram(found: Suggestion) -> str:
    """Motion of all steps over its logarithm: pauses, motion, the cut between and the thresholds beside it."""
    top, bottom, left, right = 34, 150, 34, WIDTH - 8
    slower = int(found.counts[0]) if len(found.counts) > 1 else 0
    counts = found.counts[1:] if len(found.counts) > 1 else found.counts
    edges = found.edges[1:] if len(found.counts) > 1 else found.edges
    marks = [np.log10(a.threshold) for a in found.alternatives]
    low, high = min(edges[0], *marks), max(edges[-1], *marks)
    low, high = low - 0.05 * (high - low) - 0.05, high + 0.05 * (high - low)
    tallest = max(int(counts.max(initial=0)), 1)
    at_cut = np.log10(found.threshold)

    def x(value: float) -> float:
        return float(left + (value - low) / (high - low) * (right - left))

    parts = []
    for count, start, stop in zip(counts, edges[:-1], edges[1:], strict=True):
        if count:
            size = (bottom - top) * count / tallest
            kind = "still" if (start + stop) / 2 < at_cut else "move"
            parts.append(_box(x(start), bottom - size, x(stop) - x(start), size, kind))
    share = slower / max(1, found.steps)
    if share >= 0.005:
        size = (bottom - top) * min(1.0, slower / tallest)
        parts.append(_box(6, bottom - size, 12, size, "still"))
        parts.append(_text(6, bottom - size - 5, f"{share:.0%} {'at 0' if found.unmoved else 'below'}", "start"))
    for decade in range(int(np.ceil(low)), int(np.floor(high)) + 1):
        parts.append(_line(x(decade), bottom, x(decade), bottom + 4, "axis"))
        parts.append(_text(x(decade), bottom + 15, f"{10.0**decade:g}"))
    parts.append(_line(6, bottom, right, bottom, "axis"))
    parts.append(_line(x(at_cut), top - 8, x(at_cut), bottom, "cut"))
    side = "end" if at_cut > (low + high) / 2 else "start"
    parts.append(_text(x(at_cut), top - 12, f"threshold {found.threshold:g}", side, "strong"))
    parts.append(_text((left + right) / 2, bottom + 29, "largest joint change within a step (logarithmic)"))
    name = f"Histogram of the motion of {found.steps} steps with the threshold {found.threshold:g}"
    return _svg(WIDTH, bottom + 34, parts, name)


def pauses(episodes: Sequence[EpisodeNumbers]) -> str:
    """One bar for each of the first episodes, along its steps; pauses are pale."""
    shown = list(episodes[:DRAWN])
    longest = max([1, *(e.steps - 1 for e in shown)])  # the last step leads nowhere
    row = 16 if len(shown) <= 12 else 9
    left, right = 34, WIDTH - 8
    scale = (right - left) / longest
    parts = []
    for position, episode in enumerate(shown):
        y = position * row
        parts.append(_box(left, y, (episode.steps - 1) * scale, row - 3, "move"))
        parts += [_box(left + s * scale, y, n * scale, row - 3, "still") for s, n in episode.runs]
        if row > 9 or position % 5 == 0:
            parts.append(_text(left - 5, y + (10 if row > 9 else 8), str(episode.index), "end"))
    bottom = len(shown) * row + 4
    parts.append(_line(left, bottom, right, bottom, "axis"))
    step = 10 ** int(np.floor(np.log10(max(longest, 2) / 2)))
    step *= 2 if longest / step > 8 else 1
    for mark in range(0, longest + 1, step):
        parts.append(_line(left + mark * scale, bottom, left + mark * scale, bottom + 4, "axis"))
        parts.append(
            _text(left + mark * scale, bottom + 15, str(mark), "end" if mark * scale > right - 60 else "middle")
        )
    parts.append(_text((left + right) / 2, bottom + 29, "time step of the episode"))
    return _svg(WIDTH, bottom + 34, parts, f"Where the first {len(shown)} episodes stand still")


def still_share(share: float) -> str:
    """A share in [0, 1] as a bar, for a table."""
    parts = [_box(0, 0, 60, 10, "track"), _box(0, 0, 60 * share, 10, "still")]
    return _svg(60, 10, parts, f"{share:.0%}", "inline")


def spark(histogram: NDArray[np.int64]) -> str:
    """Small histogram of one dimension, for a table."""
    counts = histogram.reshape(SPARKS, -1).sum(axis=1)
    tallest = max(int(counts.max()), 1)
    # The root keeps rare values in sight.
    sizes = 18 * np.sqrt(counts / tallest)
    width = 100 / SPARKS
    parts = [_box(i * width, 18 - s, width, s, "move") for i, s in enumerate(sizes) if s > 0]
    return _svg(100, 18, parts, "distribution", "inline")


def _svg(width: float, height: float, parts: Sequence[str], name: str, kind: str = "plot") -> str:
    label = html.escape(name, quote=True)
    body = "".join(parts)
    return f'<svg class="{kind}" viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{label}">{body}</svg>'


def _box(x: float, y: float, width: float, height: float, kind: str) -> str:
    # A bin must not vanish between two pixels.
    return (
        f'<rect class="{kind}" x="{x:.2f}" y="{y:.2f}" width="{max(width, 0.4):.2f}" height="{max(height, 0.4):.2f}"/>'
    )


def _line(x1: float, y1: float, x2: float, y2: float, kind: str) -> str:
    return f'<line class="{kind}" x1="{x1:.2f}" y1="{y1:.2f}" x2="{x2:.2f}" y2="{y2:.2f}"/>'


def _text(x: float, y: float, text: str, anchor: str = "middle", kind: str = "") -> str:
    return f'<text class="{kind}" x="{x:.2f}" y="{y:.2f}" text-anchor="{anchor}">{html.escape(text)}</text>'
