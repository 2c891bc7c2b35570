"""Small recordings in the layouts that `cqn-data convert` reads, each written with the format's own library."""

import io
import json
import pickle
import sys
import types
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

SIDE = 32
LENGTHS = (5, 4)
CAMERAS = ("front", "left_shoulder", "right_shoulder", "wrist")


def picture(seed: int, side: int = SIDE) -> np.ndarray:
    """A coloured gradient, different for each seed; smooth, so that video and JPEG stay close to it."""
    y, x = np.mgrid[0:side, 0:side] * (200 // side)
    return np.stack([x + 5 * seed, y, np.full_like(x, 10 * seed)], axis=2).clip(0, 255).astype(np.uint8)


def numbers(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


# --- RLBench


@contextmanager
def rlbench_classes() -> Iterator[tuple[type, type]]:
    """Stand-ins for RLBench's classes, importable by their real names while a pickle is written."""

    class Demo:
        def __init__(self, observations):
            self._observations = observations
            self.random_seed = np.random.get_state()
            self.variation_number = 0

    class Observation:
        def __init__(self, **values):
            self.__dict__.update(values)

    modules = {
        "rlbench": None,
        "rlbench.backend": None,
        "rlbench.demo": Demo,
        "rlbench.backend.observation": Observation,
    }
    for name, kind in modules.items():
        sys.modules[name] = types.ModuleType(name)
        if kind is not None:
            setattr(sys.modules[name], kind.__name__, kind)
            kind.__module__, kind.__qualname__ = name, kind.__name__
    try:
        yield Demo, Observation
    finally:
        for name in modules:
            del sys.modules[name]


def write_rlbench(
    task: Path,
    *,
    lengths: tuple[int, ...] = LENGTHS,
    commanded: bool = True,
    protocol: int = 4,
    old_numpy: bool = False,
    nan_at: tuple[int, int] | None = None,
) -> list[dict[str, np.ndarray]]:
    """A task folder with one variation; returns the numbers of each episode.

    lengths: observations per episode. commanded: with the commanded joints, which the first observation never has.
    """
    variation = task / "variation0"
    expected = []
    for number, length in enumerate(lengths):
        folder = variation / "episodes" / f"episode{number}"
        joints, command = numbers(number, length, 7), numbers(100 + number, length, 8)
        gripper = (np.arange(length) < length // 2).astype(float)
        if nan_at and nan_at[0] == number:
            joints[nan_at[1], 3] = np.nan
        for camera in CAMERAS:
            for kind in ("rgb", "depth", "mask"):
                (folder / f"{camera}_{kind}").mkdir(parents=True)
                for step in range(length):
                    Image.fromarray(picture(number * 10 + step)).save(folder / f"{camera}_{kind}" / f"{step}.png")
        with rlbench_classes() as (Demo, Observation):
            observations = [
                Observation(
                    front_rgb=None, joint_positions=joints[t], joint_velocities=numbers(t, 7),
                    gripper_open=gripper[t], gripper_pose=numbers(t, 7), task_low_dim_state=np.array([1.0]),
                    misc={"variation_index": 0, "front_camera_near": np.float64(0.01)}
                    | ({"joint_position_action": command[t]} if commanded and t > 0 else {}),
                )
                for t in range(length)
            ]  # fmt: skip
            data = pickle.dumps(Demo(observations), protocol=protocol)
        if old_numpy:
            assert b"numpy._core" in data
            data = pickle_with_other_names(data)
        (folder / "low_dim_obs.pkl").write_bytes(data)
        expected.append({"joints": joints, "command": command, "gripper": gripper})
    (variation / "variation_descriptions.pkl").write_bytes(pickle.dumps(["open the top drawer", "grip the handle"]))
    return expected


def pickle_with_other_names(data: bytes) -> bytes:
    """The same pickle (protocol 2) as NumPy 1 would have written it."""
    return data.replace(b"numpy._core.", b"numpy.core.")


# --- HDF5


def write_robomimic(
    path: Path, *, lengths: tuple[int, ...] = LENGTHS, fps: bool = True, images: bool = True
) -> list[dict]:
    import h5py

    expected = []
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        kwargs: dict[str, Any] = {"robots": ["Panda"]} | ({"control_freq": 20} if fps else {})
        data.attrs["env_args"] = json.dumps({"env_name": "Lift", "type": 1, "env_kwargs": kwargs})
        for number, length in enumerate(lengths):
            demo = data.create_group(f"demo_{number}")
            demo.attrs["num_samples"] = length
            values = {
                "robot0_eef_pos": numbers(number, length, 3),
                "robot0_eef_quat": numbers(number + 1, length, 4),
                "robot0_gripper_qpos": numbers(number + 2, length, 2),
                "robot0_joint_pos": numbers(number + 3, length, 7),
                "object": numbers(number + 4, length, 10),
            }
            if images:
                values["agentview_image"] = np.stack([picture(number * 10 + t) for t in range(length)])
            for key, value in values.items():
                demo[f"obs/{key}"] = value
                demo[f"next_obs/{key}"] = value
            values["actions"] = numbers(number + 5, length, 7)
            values["rewards"] = (np.arange(length) == length - 1).astype(float)
            values["dones"] = (np.arange(length) == length - 1).astype(int)
            for key in ("actions", "rewards", "dones"):
                demo[key] = values[key]
            demo["states"] = numbers(number + 6, length, 32)
            expected.append(values)
        file["mask/train"] = np.array([b"demo_0"])
    return expected


def write_aloha(
    folder: Path, *, lengths: tuple[int, ...] = LENGTHS, compress: bool | str = False, base: bool = False
) -> list[dict]:
    import h5py

    folder.mkdir(parents=True)
    expected = []
    for number, length in enumerate(lengths):
        values = {key: numbers(number + i, length, 14) for i, key in enumerate(("qpos", "qvel", "effort", "action"))}
        pictures = np.stack([picture(number * 10 + t) for t in range(length)])
        with h5py.File(folder / f"episode_{number}.hdf5", "w") as file:
            file.attrs["sim"] = False
            file.attrs["compress"] = bool(compress)
            for key in ("qpos", "qvel", "effort"):
                file[f"observations/{key}"] = values[key]
            file["action"] = values["action"]
            if base:
                values["base_action"] = numbers(number + 9, length, 2)
                file["base_action"] = values["base_action"]
            if compress == "bytes":
                file["observations/images/cam_high"] = np.array([jpeg(p) for p in pictures])
                file["observations/images/cam_high_depth"] = np.zeros((length, 4, 4), np.uint16)
            elif compress:
                rows = [jpeg(p) for p in pictures]
                padded = np.zeros((length, max(map(len, rows))), np.uint8)
                for row, data in zip(padded, rows, strict=True):
                    row[: len(data)] = np.frombuffer(data, np.uint8)
                file["observations/images/cam_high"] = padded
                file["compress_len"] = np.array([[len(row) for row in rows]])
            else:
                file["observations/images/cam_high"] = pictures
        expected.append(values | {"cam_high": pictures})
    return expected


def jpeg(pixels: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=95)
    return buffer.getvalue()


# --- Zarr


def write_zarr(path: Path, *, lengths: tuple[int, ...] = LENGTHS, dtype: str = "uint8", zarr_format: int = 2) -> dict:
    """A replay buffer; a path that ends in .zip gives a zip file. `unit` as dtype: floats from 0 to 1."""
    import zarr

    total = sum(lengths)
    pictures = np.stack([picture(t) for t in range(total)])
    values = {
        "img": pictures.astype(np.float32) / 255 if dtype == "unit" else pictures.astype(dtype),
        "state": numbers(1, total, 5).astype(np.float32),
        "action": numbers(2, total, 2).astype(np.float32),
        "keypoint": numbers(3, total, 9, 2).astype(np.float32),
        "n_contacts": np.arange(total, dtype=np.float32)[:, None],
    }
    store = zarr.storage.ZipStore(str(path), mode="w") if path.suffix == ".zip" else str(path)
    root = zarr.open_group(store, mode="w", zarr_format=zarr_format)
    for group, arrays in {"data": values, "meta": {"episode_ends": np.cumsum(lengths)}}.items():
        made = root.create_group(group)
        for key, value in arrays.items():
            made.create_array(key, data=value, chunks=(3, *value.shape[1:]))
    if path.suffix == ".zip":
        store.close()
    return values | {"pictures": pictures}


# --- NPZ


def write_npz(folder: Path, *, lengths: tuple[int, ...] = LENGTHS, **more: Any) -> list[dict]:
    """LeRobot's names, a camera under another name, a column nobody knows, and numbers that fit no step."""
    folder.mkdir(parents=True)
    expected = []
    for number, length in enumerate(lengths):
        values = {
            "observation.state": numbers(number, length, 3).astype(np.float32),
            "action": numbers(number + 1, length, 2).astype(np.float32),
            "observation.images.top_rgb": np.stack([picture(number * 10 + t) for t in range(length)]),
            "side_image": np.stack([np.moveaxis(picture(t), 2, 0) for t in range(length)]),
            "next.reward": (np.arange(length) == length - 1).astype(np.float64),
            "success": np.arange(length) == length - 1,
            "force": numbers(number + 2, length, 2, 2),
            "phase": np.arange(length),
            "timestamp": np.arange(length) / 30,
            "label": np.array(["a"] * length),
            **more,
        }
        np.savez_compressed(folder / f"take_{number + 9}.npz", **values)
        expected.append(values)
    return expected


def spoil_npz(path: Path, key: str, data: bytes) -> None:
    """Replace one array of an archive by other bytes."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members[f"{key}.npy"] = data
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


# --- LeRobot v2.1


def write_lerobot_v21(root: Path, *, lengths: tuple[int, ...] = LENGTHS, version: str = "v2.1") -> list[np.ndarray]:
    """A dataset without cameras, with a licence; returns the states."""
    import pandas as pd

    (root / "meta").mkdir(parents=True)
    (root / "data/chunk-000").mkdir(parents=True)
    vector = {"dtype": "float32", "shape": [2], "names": [["a", "b"]]}
    columns = ("timestamp", "frame_index", "episode_index", "index", "task_index")
    own = {c: {"dtype": "float32" if c == "timestamp" else "int64", "shape": [1], "names": None} for c in columns}
    info = {
        "codebase_version": version, "robot_type": "toy", "total_episodes": len(lengths), "total_frames": sum(lengths),
        "total_tasks": 1, "total_videos": 0, "total_chunks": 1, "chunks_size": 1000, "fps": 10,
        "splits": {"train": "0:2"},
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet", "video_path": None,
        "features": {"observation.state": vector, "action": vector, **own},
    }  # fmt: skip
    states, episodes, statistics = [], [], []
    for number, length in enumerate(lengths):
        state = numbers(number, length, 2).astype(np.float32)
        steps = np.arange(length)
        frame = pd.DataFrame({
            "observation.state": list(state), "action": list(state + 1), "timestamp": (steps / 10).astype(np.float32),
            "frame_index": steps, "episode_index": np.full(length, number), "index": steps + sum(lengths[:number]),
            "task_index": np.zeros(length, np.int64),
        })  # fmt: skip
        frame.to_parquet(root / f"data/chunk-000/episode_{number:06d}.parquet", index=False)
        states.append(state)
        episodes.append({"episode_index": number, "tasks": ["wave"], "length": length})
        arrays = {key: np.stack(frame[key]).reshape(length, -1) for key in frame}
        statistics.append({"episode_index": number, "stats": {key: _statistics(v) for key, v in arrays.items()}})
    for name, rows in (
        ("episodes", episodes), ("episodes_stats", statistics), ("tasks", [{"task_index": 0, "task": "wave"}])
    ):  # fmt: skip
        (root / f"meta/{name}.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (root / "meta/info.json").write_text(json.dumps(info))
    (root / "LICENSE").write_text("free\n")
    return states


def _statistics(values: np.ndarray) -> dict[str, list]:
    names = ("min", "max", "mean", "std")
    return {name: getattr(values, name)(axis=0).tolist() for name in names} | {"count": [len(values)]}
