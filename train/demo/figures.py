"""Pictures of the demos' reports, as PNG bytes."""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ..run.curve import png, pyplot

__all__ = ["animation", "arm_session", "curves", "dropped_steps", "film_strip", "poster"]

COLOURS = {"filtered": "#1f77b4", "unfiltered": "#d95f02"}
KEPT, DROPPED = "#1f77b4", "#d9d9d9"

Rows = Sequence[Mapping[str, str]]


def curves(evaluations: Mapping[str, Rows], labels: Mapping[str, str], expert: float) -> bytes:
    """Success rate over environment steps with its 95 % interval, one line per variant."""
    figure, axes = pyplot().subplots(figsize=(7.2, 3.4))
    for name, rows in evaluations.items():
        steps = [int(row["env_steps"]) for row in rows]
        rate = [float(row["success_rate"]) for row in rows]
        low, high = [float(r["ci_low"]) for r in rows], [float(r["ci_high"]) for r in rows]
        axes.plot(steps, rate, marker="o", markersize=4, color=COLOURS[name], label=labels[name])
        axes.fill_between(steps, low, high, color=COLOURS[name], alpha=0.15, linewidth=0)
    axes.axhline(expert, color="0.5", linestyle=":", linewidth=1, label="scripted expert")
    axes.set(xlabel="environment steps (0 is after offline training)", ylabel="success rate", ylim=(-0.03, 1.04))
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(evaluations) + 1, frameon=False)
    return png(figure)


def arm_session(episodes: Rows, evaluations: Rows) -> bytes:
    """A session on an arm: success of every episode and its running mean of 5 (the paper's measure), the share of each
    that a person drove, and evaluations before and after.
    """
    figure, axes = pyplot().subplots(figsize=(7.2, 3.2))
    success = np.array([float(row["success"]) for row in episodes])
    driven = np.array([int(row["taught"]) / int(row["length"]) for row in episodes])
    number = np.arange(1, len(success) + 1)
    mean = [success[max(0, i - 5) : i].mean() for i in number]
    axes.plot(number, mean, color=COLOURS["filtered"], label="running mean of 5 episodes")
    axes.scatter(number, success, s=14, color=COLOURS["filtered"], label="episode", zorder=3)
    axes.bar(number, driven, color=COLOURS["unfiltered"], alpha=0.6, label="share driven with the leader")
    ends = {"offline": 0, "final": len(success) + 1}
    rows = [row for row in evaluations if row["phase"] in ends]
    place, rate = [ends[row["phase"]] for row in rows], np.array([float(row["success_rate"]) for row in rows])
    spread = [rate - [float(r["ci_low"]) for r in rows], [float(r["ci_high"]) for r in rows] - rate]
    text = f"evaluation, n = {rows[0]['n']}, 95 %" if rows else "evaluation"
    axes.errorbar(place, rate, yerr=spread, fmt="D", color="black", markersize=5, capsize=3, label=text)
    axes.set(xlabel="episodes online", ylabel="success, share of steps", ylim=(-0.05, 1.07))
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, frameon=False, fontsize=8)
    return png(figure)


def dropped_steps(episodes: Sequence[Mapping[str, Any]]) -> bytes:
    """Steps that the filter dropped: one bar per episode along its time steps, pauses in grey."""
    plt = pyplot()
    figure, axes = plt.subplots(figsize=(7.2, 0.11 * len(episodes) + 0.9))
    for row, episode in enumerate(episodes):
        axes.barh(row, episode["steps"], color=KEPT, height=0.72)
        for pause in episode["pauses"]:
            axes.barh(row, pause["length"], left=pause["start"], color=DROPPED, height=0.72)
    axes.invert_yaxis()
    axes.set(xlabel="time step of the recording", ylabel="demonstration")
    handles = [plt.Rectangle((0, 0), 1, 1, color=c) for c in (KEPT, DROPPED)]
    axes.legend(
        handles, ["kept", "dropped: pause"], loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False
    )
    axes.margins(y=0.01)
    return png(figure)


def film_strip(frames: Sequence[NDArray[Any]], count: int = 6, width: int = 220) -> bytes:
    """`count` frames, evenly spaced in time, side by side."""
    picked = [frames[int(i)] for i in np.linspace(0, len(frames) - 1, count)]
    height = round(width * picked[0].shape[0] / picked[0].shape[1])
    small = [np.asarray(Image.fromarray(frame).resize((width, height))) for frame in picked]
    buffer = io.BytesIO()
    Image.fromarray(np.concatenate(small, axis=1)).save(buffer, format="PNG")
    return buffer.getvalue()


def poster(curves_png: bytes, films: Mapping[str, Sequence[NDArray[Any]]], width: int = 1200) -> bytes:
    """One picture for the README: film strips with captions, and the learning curves."""
    plt = pyplot()
    strips = {name: np.asarray(Image.open(io.BytesIO(film_strip(frames, 8, 160)))) for name, frames in films.items()}
    chart = np.asarray(Image.open(io.BytesIO(curves_png)).convert("RGB"))
    heights = [picture.shape[0] / picture.shape[1] + 0.035 for picture in strips.values()]
    ratios = [*heights, 0.75 * chart.shape[0] / chart.shape[1]]
    figure, rows = plt.subplots(len(ratios), 1, figsize=(width / 100, sum(ratios) * width / 100), height_ratios=ratios)
    for axes, (name, picture) in zip(rows, strips.items(), strict=False):
        axes.imshow(picture, aspect="equal")
        axes.set_title(name, loc="left", fontsize=13, pad=5)
    rows[-1].imshow(chart)
    for axes in rows:
        axes.axis("off")
    figure.subplots_adjust(left=0.01, right=0.99, top=0.97, bottom=0.0, hspace=0.16)
    return png(figure)


def animation(frames: Sequence[NDArray[Any]], fps: int, width: int = 320, hold_s: float = 1.2) -> bytes:
    """A looping animation (WebP), the last frame held for a moment."""
    height = round(width * frames[0].shape[0] / frames[0].shape[1])
    pictures = [Image.fromarray(frame).resize((width, height)) for frame in frames]
    durations = [round(1000 / fps)] * (len(pictures) - 1) + [round(1000 * hold_s)]
    buffer = io.BytesIO()
    pictures[0].save(
        buffer, format="WEBP", save_all=True, append_images=pictures[1:], duration=durations, loop=0, quality=70
    )
    return buffer.getvalue()
