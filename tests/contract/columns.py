"""Small recordings of any columns, through LeRobot's own writer, and ways to change what lies on disk."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.configs import RGBEncoderConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset

STATE, ACTION = "observation.state", "action"
TOP = "observation.images.top"
JOINTS = ["pan.pos", "lift.pos", "elbow.pos", "gripper.pos"]


def moving(steps, dims=4, seed=0):
    """(steps, dims) float32 positions that move at every step, in degrees."""
    time = np.arange(steps)[:, None] / 10
    return (10 * np.sin(time * (1 + np.arange(dims)) / 2 + seed)).astype(np.float32)


def grey(steps, side=48, start=20, step=4):
    """(steps, side, side, 3) pictures whose grey level says their number."""
    levels = (start + step * np.arange(steps)).astype(np.uint8)
    return np.broadcast_to(levels[:, None, None, None], (steps, side, side, 3))


def write_columns(root, episodes, names=None, fps=10, tasks=("go",), stills=False, info=None):
    """A dataset `local/src` of the given columns; those with four axes are cameras, depth where they have one channel.

    names: column -> what LeRobot keeps as its names; by default JOINTS for vectors of four.
    """
    features = {}
    for key, values in episodes[0].items():
        if values.ndim == 4:
            axes = ["height", "width", "channels"]
            features[key] = {"dtype": "image" if stills else "video", "shape": values.shape[1:], "names": axes}
            if values.shape[-1] == 1:
                features[key]["info"] = {"is_depth_map": True}
        else:
            own = (names or {}).get(key, JOINTS if key in (STATE, ACTION) and values.shape[1:] == (4,) else None)
            features[key] = {"dtype": str(values.dtype), "shape": values.shape[1:], "names": own}
    videos = any(f["dtype"] == "video" for f in features.values())
    dataset = LeRobotDataset.create(
        "local/src", fps, features, root=root, robot_type="toy", use_videos=videos,
        rgb_encoder=RGBEncoderConfig(vcodec="h264", crf=5) if videos else None,
    )  # fmt: skip
    for number, episode in enumerate(episodes):
        for step in range(len(next(iter(episode.values())))):
            row = {key: np.ascontiguousarray(values[step]) for key, values in episode.items()}
            dataset.add_frame({**row, "task": tasks[number % len(tasks)]})
        dataset.save_episode()
    dataset.finalize()
    if info is not None:
        edit_info(root, info)
    return root


def edit_info(root, change):
    """Change the dictionary of `meta/info.json`."""
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    change(info)
    path.write_text(json.dumps(info))


def edit_rows(root, change):
    """Change the columns of every data file: a function of {name: list} that changes it in place."""
    for path in sorted((root / "data").rglob("*.parquet")):
        edit_table(path, change)


def edit_table(path, change):
    table = pq.read_table(path)
    columns = table.to_pydict()
    change(columns)
    kept = pa.schema([table.schema.field(name) for name in columns], metadata=table.schema.metadata)
    pq.write_table(pa.Table.from_pydict(columns, schema=kept), path)
