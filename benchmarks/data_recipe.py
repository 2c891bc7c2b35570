"""Speed and memory of `cqn-data run paper_real_world` on a 4-camera 480x640 recording, against the plain way.

The plain way reads `LeRobotDataset[i]` frame by frame, scales, and writes with LeRobot's default writer (PNG files,
then a video); it is given the steps that stay, so that both do the same work. Peak memory is that of a process of its
own.

    python -m benchmarks.data_recipe --frames=600 --csv=benchmarks/results/data_recipe.csv
"""

import argparse
import json
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from cqn_data.disk.pictures import shaped, video_pictures
from cqn_data.views.episode import Camera

from .results_table import append

CAMERAS = [f"observation.images.{name}" for name in ("front", "left", "right", "wrist")]
JOINTS, FPS = 7, 30
SMALL = (84, 84)


def record(root: Path, frames: int, episodes: int) -> None:
    """A recording with moving, textured pictures, pauses and absolute actions, in LeRobot's default codec."""
    vector = {"dtype": "float32", "shape": (JOINTS,), "names": [f"joint_{i}.pos" for i in range(JOINTS)]}
    image = {"dtype": "video", "shape": (480, 640, 3), "names": ["height", "width", "channels"]}
    features = {"observation.state": vector, "action": vector, **dict.fromkeys(CAMERAS, image)}
    dataset = LeRobotDataset.create("bench/source", FPS, features, root=root, robot_type="bench")
    rng = np.random.default_rng(0)
    scene = cv2.resize(rng.integers(0, 256, (60, 80, 3), np.uint8), (1280, 960), interpolation=cv2.INTER_CUBIC)
    for _ in range(episodes):
        position = np.zeros(JOINTS)
        for step in range(frames // episodes):
            moving = step % 60 < 36
            target = position + moving * 0.02 * np.sin(np.arange(JOINTS) + step / 10)
            offset = int(abs(position[0]) * 800) % 400
            pictures = {k: scene[i * 60 : i * 60 + 480, offset : offset + 640] for i, k in enumerate(CAMERAS)}
            noisy = {k: cv2.add(p, rng.integers(0, 6, p.shape, np.uint8)) for k, p in pictures.items()}
            vectors = {"observation.state": position.astype(np.float32), "action": target.astype(np.float32)}
            dataset.add_frame({**vectors, **noisy, "task": "bench"})
            position = target
        dataset.save_episode(parallel_encoding=False)
    dataset.finalize()


def tool(source: Path, target: Path) -> tuple[float, float]:
    """Wall seconds and peak MiB of the command."""
    code = "import sys; from cqn_data.cli import main; sys.exit(main(sys.argv[1:]))"
    arguments = ["run", "paper_real_world", "--repo_id=bench/source", f"--root={source}", f"--new_root={target}"]
    before = time.perf_counter()
    subprocess.run([sys.executable, "-c", code, *arguments], check=True, capture_output=True)
    return time.perf_counter() - before, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024


def plain(source: Path, target: Path, kept: list[int]) -> float:
    """Wall seconds of the plain way over the rows that stay, without its imports."""
    before = time.perf_counter()
    dataset = LeRobotDataset("bench/source", root=source)
    features = {k: dataset.meta.features[k] for k in ("observation.state", "action")}
    features |= {k: {**dataset.meta.features[k], "shape": (*SMALL, 3), "info": None} for k in CAMERAS}
    new = LeRobotDataset.create("bench/plain", FPS, features, root=target, robot_type="bench")
    last = None
    for row in kept:
        item = dataset[row]
        if last is not None and int(item["episode_index"]) != last:
            new.save_episode(parallel_encoding=False)
        last = int(item["episode_index"])
        frame: dict[str, Any] = {k: item[k].numpy() for k in ("observation.state", "action")}
        frame["action"] = frame["action"] - frame["observation.state"]
        for key in CAMERAS:
            picture = (item[key].permute(1, 2, 0) * 255).to(torch.uint8).numpy()
            frame[key] = cv2.resize(picture, SMALL, interpolation=cv2.INTER_AREA)
        new.add_frame({**frame, "task": "bench"})
    new.save_episode(parallel_encoding=False)
    new.finalize()
    return time.perf_counter() - before


def parts(source: Path) -> dict[str, float]:
    """Milliseconds a step (four pictures) that decoding and scaling take by themselves."""
    path = next((source / "videos" / CAMERAS[0]).rglob("*.mp4"))
    count = 120
    times, frames = np.arange(count) / FPS, np.arange(count)

    def clock(work: Callable[[], Any]) -> float:
        before = time.perf_counter()
        work()
        return (time.perf_counter() - before) / count * len(CAMERAS) * 1e3

    pictures: list[Any] = []
    decode = clock(lambda: pictures.extend(video_pictures(path, times, FPS, 0, frames)))
    resize = clock(lambda: [shaped(p, Camera(size=SMALL)) for p in pictures])
    return {"decode_ms": round(decode, 2), "resize_ms": round(resize, 2)}


def main() -> None:
    """Measure once and print, or append to a CSV file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=600, help="steps of the recording")
    parser.add_argument("--episodes", type=int, default=4)
    parser.add_argument("--source", type=Path, help="use this recording, as made by an earlier --keep")
    parser.add_argument("--keep", type=Path, help="keep the recording here")
    parser.add_argument("--csv", type=Path, help="append the result to this file")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        source = options.source or options.keep or folder / "source"
        if not source.exists():
            record(source, options.frames, options.episodes)
        seconds, mebibytes = tool(source, folder / "tool")
        result = LeRobotDataset("bench/tool", root=folder / "tool")
        starts = [int(e["dataset_from_index"]) for e in LeRobotDataset("bench/source", root=source).meta.episodes]
        columns = result.hf_dataset.with_format("numpy")
        pairs = zip(columns["source.episode_index"], columns["source.frame_index"], strict=True)
        kept = [starts[int(e)] + int(f) for e, f in pairs]
        history = json.loads((folder / "tool/meta/cqn_history.json").read_text())["operations"][0]["total"]
        slow = plain(source, folder / "plain", kept)
        row = {
            "machine": f"{platform.machine()}, {torch.get_num_threads()} threads",
            "steps": history["steps"],
            "kept": history["kept"],
            "tool_s": round(seconds, 1),
            "plain_s": round(slow, 1),
            "steps_per_s": round(history["steps"] / seconds, 1),
            "pictures_per_s": round(history["kept"] * len(CAMERAS) / seconds, 1),
            "ratio": round(slow / seconds, 2),
            "peak_mib": round(mebibytes),
            **parts(source),
        }
    print(json.dumps(row, indent=2))
    append(options.csv, [row])


if __name__ == "__main__":
    main()
