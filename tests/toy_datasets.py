"""Tiny LeRobot datasets with known numbers, made through LeRobot's own writer."""

from pathlib import Path
from typing import Any

import numpy as np
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset

CAMERA = "observation.images.wrist"
SIDE = 24  # pixels a side of the camera
STATE_DIMS, ACTION_DIMS = 3, 4
LENGTHS = (7, 2, 5)


def make_dataset(
    root: Path,
    *,
    lengths: tuple[int, ...] = LENGTHS,
    state: bool = True,
    camera: bool = False,
    reward: bool = False,
    failed: tuple[int, ...] = (),
    nan_at: tuple[int, int] | None = None,
    dims: tuple[int, int] = (STATE_DIMS, ACTION_DIMS),
    environment_state: int = 0,
    action: str = "action",
    image_key: str = CAMERA,
) -> Path:
    """Write a dataset `local/toy` to `root` and return `root`.

    reward: with `next.reward`, `next.done`, `next.success`; 1 on the last step of every episode not in `failed`.
    nan_at: episode and frame whose state holds a NaN.
    """
    features: dict[str, Any] = {action: {"dtype": "float32", "shape": (dims[1],), "names": None}}
    if state:
        features["observation.state"] = {"dtype": "float32", "shape": (dims[0],), "names": None}
    if environment_state:
        features["observation.environment_state"] = {"dtype": "float32", "shape": (environment_state,), "names": None}
    if camera:
        names = ["height", "width", "channels"]
        features[image_key] = {"dtype": "video", "shape": (SIDE, SIDE, 3), "names": names}
    if reward:
        features["next.reward"] = {"dtype": "float32", "shape": (1,), "names": None}
        features |= {f"next.{name}": {"dtype": "bool", "shape": (1,), "names": None} for name in ("done", "success")}
    encoder = {"rgb_encoder": RGBEncoderConfig(vcodec="h264")} if camera else {}
    dataset = LeRobotDataset.create("local/toy", fps=10, features=features, root=root, use_videos=camera, **encoder)
    rng = np.random.default_rng(0)
    for episode, length in enumerate(lengths):
        for step in range(length):
            last = step == length - 1
            frame: dict[str, Any] = {action: rng.uniform(-0.1, 0.3, dims[1]).astype(np.float32)}
            if dims[1] > 1:
                frame[action][-1] = 0.25  # a dimension that never moves
            if state:
                frame["observation.state"] = rng.normal(size=dims[0]).astype(np.float32)
                if (episode, step) == nan_at:
                    frame["observation.state"][1] = np.nan
            if environment_state:
                frame["observation.environment_state"] = rng.normal(size=environment_state).astype(np.float32)
            if camera:
                level = np.uint8(20 + 60 * episode + 8 * step)
                frame[image_key] = np.full((SIDE, SIDE, 3), level, np.uint8)
            if reward:
                success = last and episode not in failed
                frame["next.reward"] = np.array([float(success)], np.float32)
                frame["next.done"], frame["next.success"] = np.array([last]), np.array([success])
            dataset.add_frame({**frame, "task": "Press the button."})
        dataset.save_episode()
    dataset.finalize()
    return root
