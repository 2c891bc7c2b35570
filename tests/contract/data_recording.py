"""A small recording with a camera whose pictures tell their step and episode, and ways to look at results."""

import json

import numpy as np
import pandas as pd
from lerobot.configs import RGBEncoderConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from cqn_data.cli import main

FPS, SIDE, LENGTHS = 30, 48, (20, 12, 31)
TOP = "observation.images.top"
NAMES = ["pan.pos", "lift.pos", "gripper.pos"]


def picture(episode, step):
    """Left half shows the step, right half the episode; each in grey levels far apart."""
    image = np.full((SIDE, SIDE, 3), 20 + 7 * step, np.uint8)
    image[:, SIDE // 2 :] = 40 + 80 * episode
    return image


def what(image):
    """Step and episode that a picture, (3, H, W) in [0, 1], shows."""
    left, right = (float(half.mean()) * 255 for half in image.chunk(2, dim=-1))
    return round((left - 20) / 7), round((right - 40) / 80)


def make_recording(root):
    """Absolute commands that lead a moving arm by a little; no reward; every third step stands still."""
    vector = {"dtype": "float32", "shape": (3,), "names": NAMES}
    camera = {"dtype": "video", "shape": (SIDE, SIDE, 3), "names": ["height", "width", "channels"]}
    features = {"observation.state": vector, "action": vector, TOP: camera}
    encoder = RGBEncoderConfig(vcodec="h264", crf=5, g=2)
    dataset = LeRobotDataset.create("local/src", FPS, features, root=root, rgb_encoder=encoder)
    dataset.meta.info.video_files_size_in_mb = 1e-6  # a video file for every episode
    rng = np.random.default_rng(0)
    for episode, length in enumerate(LENGTHS):
        state = rng.normal(size=3).astype(np.float32)
        for step in range(length):
            move = np.zeros(3) if step % 3 == 2 else rng.uniform(0.05, 0.2, 3) * [1, -1, 0]
            command = (state + move * 1.3).astype(np.float32)
            command[2] = state[2] = float(step > length // 2)
            dataset.add_frame(
                {"observation.state": state.copy(), "action": command, TOP: picture(episode, step), "task": "go"}
            )
            state = (state + move).astype(np.float32)
        dataset.save_episode(parallel_encoding=False)
    dataset.finalize()
    return root


def run(operation, source, target, *options, code=0, recipe=()):
    names = ["--repo_id=local/src", f"--root={source}", "--new_repo_id=local/dst", f"--new_root={target}"]
    assert main([operation, *recipe, *names, *options]) == code
    return LeRobotDataset("local/dst", target) if code == 0 and "--dry_run" not in options else None


def column(root, key):
    files = sorted((root / "data").glob("*/*.parquet"))
    table = pd.concat([pd.read_parquet(f) for f in files])
    return np.stack(table[key]) if len(table) else np.zeros(0)


def history(root):
    return json.loads((root / "meta/cqn_history.json").read_text())["operations"]


def videos(root):
    return {str(p.relative_to(root)): p.read_bytes() for p in (root / "videos").rglob("*.mp4")}


def last_line(capsys):
    lines = capsys.readouterr().err.strip().splitlines()
    assert "Traceback" not in "".join(lines)
    return lines[-1]


RECIPE = """
steps:
  - filter: {threshold: 0.01}
  - delta: {}
  - resize: {size: [32, 32]}
  - label: {all: true}
  - bounds: {}
"""
