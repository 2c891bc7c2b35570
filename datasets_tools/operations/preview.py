"""Show what a filter leaves out: a short video with the dropped frames in red, or curves of the joints."""

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import ConfigError
from lerobot_cqn.schema import STATE, dimension_names

from ..decisions.pauses import Rule
from ..views.episode import Camera, Episode
from ..views.view import View

__all__ = ["write_preview"]

SECONDS = 60  # of video at most
HEIGHT, STRIP = 240, 28  # pixels: of each camera, and of the line of text above
EPISODES = 6  # curves at most
RED = np.array([214, 40, 40], np.float64)


def write_preview(path: str, before: View, after: View, rule: Rule) -> str:
    """Write ``path``, a .mp4 or a .png file, in one piece; returns what it does not show, in brackets, or "".

    Args:
        path: file that does not exist.
        before: the view that was filtered.
        after: the view without its pauses.
        rule: names the joints to draw.

    Raises:
        ConfigError: a video of a dataset without cameras, or matplotlib is missing for curves.
        DataError: a picture cannot be read.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(f".{target.stem}.part{target.suffix}")
    try:
        (_write_video if path.endswith(".mp4") else _draw_curves)(part, before, after, rule)
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)
    if path.endswith(".png"):
        return f" (the first {EPISODES} of {len(before.episodes)} episodes)" * (len(before.episodes) > EPISODES)
    seconds = sum(len(before.episode(i)) for i in before.episodes) / before.fps
    return f" (the first {SECONDS} of {seconds:.0f} s)" * (seconds > SECONDS)


def _kept(before: Episode, after: View) -> NDArray[np.bool_]:
    if before.index not in after.episodes:
        return np.zeros(len(before), dtype=bool)
    return np.isin(before.frames, after.episode(before.index).frames)


def _write_video(path: Path, before: View, after: View, rule: Rule) -> None:
    import av

    if not before.cameras:
        raise ConfigError("The dataset has no camera to film; take --preview=FILE.png for curves of the joints.")
    left = round(SECONDS * before.fps)
    with av.open(str(path), "w") as container:
        stream: Any = None
        for index in before.episodes:
            for picture in _marked(before, after, index):
                if stream is None:
                    rate = Fraction(before.fps).limit_denominator(1001)
                    stream = container.add_stream("libx264", rate=rate, options={"crf": "23"})
                    stream.height, stream.width = picture.shape[:2]
                    stream.pix_fmt = "yuv420p"
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
                left -= 1
                if left == 0:
                    break
            if left == 0:
                break
        container.mux(stream.encode())


def _marked(before: View, after: View, index: int) -> Iterator[NDArray[np.uint8]]:
    """(H, W, 3) frames of an episode: cameras side by side under a line of text, red where dropped."""
    import cv2

    from ..disk.pictures import picture_size, shaped

    episode = before.episode(index)
    kept = _kept(episode, after)
    sizes = {k: picture_size(before.features[k]) for k in before.cameras}
    shapes = {k: Camera(size=(HEIGHT, max(2, round(w * HEIGHT / h / 2) * 2))) for k, (h, w) in sizes.items()}
    for row, pictures in enumerate(before.camera_frames(episode, np.arange(len(episode)))):
        view = np.concatenate([shaped(pictures[k], shapes[k]) for k in pictures], axis=1)
        strip = np.full((STRIP, view.shape[1], 3), 24 if kept[row] else RED, dtype=np.uint8)
        if not kept[row]:
            view = (0.65 * view + 0.35 * RED).astype(np.uint8)
        text = f"episode {index}  step {row}/{len(episode)}  {'' if kept[row] else 'DROPPED'}"
        cv2.putText(strip, text, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
        yield np.concatenate([strip, view])


def _draw_curves(path: Path, before: View, after: View, rule: Rule) -> None:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ConfigError("Curves need matplotlib: pip install 'lerobot_policy_cqn[report]'.") from error
    names = dimension_names(before.features[STATE])
    shown = list(before.episodes)[:EPISODES]
    figure = Figure(figsize=(11, 1.2 + 1.9 * len(shown)), layout="constrained")
    axes = figure.subplots(len(shown), 1, squeeze=False)[:, 0]
    for axis, index in zip(axes, shown, strict=True):
        episode = before.episode(index)
        kept, state = _kept(episode, after), episode.columns[STATE]
        steps = np.arange(len(episode))
        axis.fill_between(steps, 0, 1, where=~kept, step="mid", transform=axis.get_xaxis_transform(),
                          color=RED / 255, alpha=0.22, linewidth=0)  # fmt: skip
        for dim in [*rule.joints, *rule.gripper_state]:
            low, high = state[:, dim].min(), state[:, dim].max()
            curve = (state[:, dim] - low) / (high - low) if high > low else np.full(len(steps), 0.5)
            hand = dim in rule.gripper_state
            axis.plot(steps, curve, linewidth=2.2 if hand else 1.1, color="black" if hand else None, label=names[dim])
        axis.set(xlim=(0, max(1, len(steps) - 1)), yticks=[], ylabel=f"episode {index}")
        axis.set_title(f"{(~kept).sum()} of {len(kept)} steps dropped", fontsize=9, loc="right", color=RED / 255)
    axes[-1].set_xlabel("step (red: dropped; every joint over its own range, gripper in black)")
    if len(names) <= 10:
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=5, fontsize=8)
    figure.savefig(path, format="png", dpi=110)
