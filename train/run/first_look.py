"""First look at a run for a person: a batch as a picture, warnings about the data, films of evaluations."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.utils.io_utils import write_video
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from cqn_data.decisions.pause_threshold import suggest
from lerobot_cqn.schema import Batch, Observation

from ..replay.episode import Episode

__all__ = ["draw_batch", "save_batch", "warnings_about", "write_films"]

SHOWN = 8  # samples in the picture
TILE, BAR, TEXT = 112, 14, 210  # pixels
AT_BOUND = 0.999
TOO_MANY = 0.2  # share of the steps
INK, PAPER, GRID, UP, DOWN = (24, 26, 31), (255, 255, 255), (228, 230, 235), (46, 111, 182), (196, 92, 38)


def warnings_about(
    episodes: Sequence[Episode], free: NDArray[Any] | None = None, joints: int | None = None
) -> list[str]:
    """Sentences about demonstrations from which learning is hard; empty when nothing looks wrong.

    Args:
        episodes: in normalised units, as the replay takes them.
        free: action dimensions [D] whose bounds could be wider; None: all. Where the environment ends, nothing is lost.
        joints: how many of the state's values, from the first on, are joints; None: all. Objects leap or lie still.
    """
    if not episodes:
        return []
    found = []
    if not any(episode.success for episode in episodes):
        found.append("No demonstration ends in success, so there is nothing to imitate: label them (cqn-data label).")
    actions = np.concatenate([episode.action for episode in episodes])
    varied = np.ptp(actions, axis=0) > 0
    moving = varied & ~np.isin(np.round(np.abs(actions), 3), (0.0, 1.0)).all(axis=0)  # a gripper is open or shut
    at_bound = (np.abs(actions) >= AT_BOUND).mean(axis=0) * moving * (True if free is None else free)
    if (at_bound > TOO_MANY).any():
        which = ", ".join(f"{i} ({at_bound[i]:.0%})" for i in np.flatnonzero(at_bound > TOO_MANY))
        found.append(
            f"Action dimensions at their bounds in many steps: {which}; the bounds may be too narrow (cqn-data bounds)."
        )
    states = [episode.low_dim[:, :joints] for episode in episodes if episode.low_dim is not None]
    if states and states[0].shape[1] and (pauses := suggest(states)).clear and pauses.share > TOO_MANY:
        found.append(
            f"{pauses.share:.0%} of the demonstrated steps stand still; a policy that imitates them stays where it is"
            " (cqn-data filter --auto)."
        )
    return found


def draw_batch(batch: Batch, path: Path) -> None:
    """Picture of samples: what the policy sees, what was done, what it is taken to be worth.

    Args:
        batch: as the learner gets it; the newest frame of each view is shown, then that n steps later. Of a large one
            the samples with a reward come first, two at most.
        path: .png file to write.
    """
    chosen = _chosen(batch.reward.flatten().cpu().numpy())
    count = len(chosen)
    batch = _rows(batch, chosen)
    views = [
        v[:, -3:] for pair in zip(batch.observation.pixels, batch.next_observation.pixels, strict=True) for v in pair
    ]
    numbers = [(batch.action, "action")]
    if batch.observation.low_dim is not None:
        numbers.append((batch.observation.low_dim, "state"))
    bars = [min(values.shape[1], 40) * BAR + 24 for values, _ in numbers]
    width, height = TEXT + len(views) * (TILE + 6) + sum(bars) + 12, 28 + count * (TILE + 8)
    image = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(image)
    heads = [
        (8, "sample"),
        *((TEXT + i * (TILE + 6), f"view {i // 2}{', n steps on' if i % 2 else ''}") for i in range(len(views))),
    ]
    left = TEXT + len(views) * (TILE + 6)
    for (_, name), size in zip(numbers, bars, strict=True):
        heads.append((left + 6, f"{name}, -1 to 1"))
        left += size
    for x, text in heads:
        draw.text((x, 8), text, INK)
    for row in range(count):
        top = 28 + row * (TILE + 8)
        kind = "demonstration" if float(batch.demo[row]) else "own experience"
        worth = f"reward {float(batch.reward[row]):.3g}\ndiscount {float(batch.discount[row]):.3g}"
        draw.multiline_text((8, top + 8), f"{row}: {kind}\n{worth}", INK, spacing=5)
        for column, view in enumerate(views):
            picture = view[row].permute(1, 2, 0).cpu().numpy().astype(np.uint8)
            tile = Image.fromarray(picture).resize((TILE, TILE), Image.Resampling.NEAREST)
            image.paste(tile, (TEXT + column * (TILE + 6), top))
        left = TEXT + len(views) * (TILE + 6)
        for (values, _), size in zip(numbers, bars, strict=True):
            _bars(draw, values[row].cpu().numpy()[-40:], left + 6, top)
            left += size
    image.save(path)


def _chosen(reward: NDArray[Any]) -> NDArray[Any]:
    """Numbers of the samples to show: up to two with a reward, then the others from both ends of the batch in turn."""
    rewarded = np.flatnonzero(reward > 0)[:2]
    others = np.setdiff1d(np.arange(len(reward)), rewarded)
    fanned = np.stack([others[: len(others) // 2], others[::-1][: len(others) // 2]], axis=1).ravel()
    rest = fanned if len(reward) > SHOWN else others
    chosen: NDArray[Any] = np.concatenate([rewarded, rest])[:SHOWN]
    return chosen


def _rows(batch: Batch, chosen: NDArray[Any]) -> Batch:
    index = torch.from_numpy(chosen)

    def observation(o: Observation) -> Observation:
        return Observation(tuple(v[index] for v in o.pixels), None if o.low_dim is None else o.low_dim[index])

    return Batch(
        observation=observation(batch.observation),
        action=batch.action[index],
        reward=batch.reward[index],
        discount=batch.discount[index],
        next_observation=observation(batch.next_observation),
        demo=batch.demo[index],
    )


def _bars(draw: ImageDraw.ImageDraw, values: NDArray[Any], left: int, top: int) -> None:
    """Bars up and down from the middle of a tile; 1 fills half of it."""
    middle = top + TILE // 2
    draw.line((left, middle, left + len(values) * BAR, middle), GRID)
    for index, value in enumerate(np.clip(values, -1.2, 1.2)):
        x, end = left + index * BAR + 2, middle - float(value) * (TILE // 2 - 8)
        draw.rectangle((x, min(middle, end), x + BAR - 4, max(middle, end)), UP if value >= 0 else DOWN)


def save_batch(batch: Batch, path: Path) -> None:
    """Keep a batch for a look at what went wrong: `torch.load(path)` gives its tensors by name."""
    torch.save(asdict(batch), path)


def write_films(
    films: Sequence[Sequence[NDArray[Any]]], labels: Sequence[str], folder: Path, stem: str, fps: int
) -> None:
    """Evaluation episodes as `folder/stem_<number>_<label>.mp4`; pictures uint8 [H, W, 3]."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, (frames, label) in enumerate(zip(films, labels, strict=False)):
        write_video(folder / f"{stem}_{number}_{label}.mp4", list(frames), fps)
