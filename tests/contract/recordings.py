"""Small recordings with known faults, for the tests of `cqn-data inspect`."""

import numpy as np
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset

FPS = 20
CAMERA = "observation.images.top"
NAMES = ["pan.pos", "lift.pos", "gripper.pos"]


def demonstration(seed, steps=60, lag=1):
    """Columns of a good episode: two joints that move, pause and move; a gripper that shuts; success at the end."""
    rng = np.random.default_rng(seed)
    speed = (
        rng.uniform(0.02, 0.05, (steps + lag, 2))
        * rng.choice([-1, 1], (1 + steps // 10, 2)).repeat(10, 0)[: steps + lag]
    )
    speed[20:26] = 0
    joints = np.cumsum(speed, axis=0)
    command = np.column_stack([joints[lag : steps + lag], np.arange(steps) > 40])
    state = np.column_stack([joints[:steps], np.arange(steps) > 42])
    reward = np.zeros(steps)
    reward[-1] = 1
    return {
        "observation.state": state.astype(np.float32),
        "action": command.astype(np.float32),
        "next.reward": reward[:, None].astype(np.float32),
    }


def write(root, episodes, tasks=("Press.",), names=NAMES):
    """A dataset of the given columns; those with four axes become cameras."""
    features = {}
    for key, values in episodes[0].items():
        if values.ndim == 4:
            axes = ["height", "width", "channels"]
            features[key] = {"dtype": "video", "shape": values.shape[1:], "names": axes}
        else:
            own = names if values.shape[1] == len(names) else None
            features[key] = {"dtype": str(values.dtype), "shape": values.shape[1:], "names": own}
    dataset = LeRobotDataset.create(
        "local/toy", fps=FPS, features=features, root=root, use_videos=CAMERA in features,
        rgb_encoder=RGBEncoderConfig(vcodec="h264"),
    )  # fmt: skip
    for number, episode in enumerate(episodes):
        for step in range(len(episode["action" if "action" in episode else "observation.state"])):
            dataset.add_frame({**{k: v[step] for k, v in episode.items()}, "task": tasks[number % len(tasks)]})
        dataset.save_episode()
    dataset.finalize()
    return root


def change(seed=0, **columns):
    """A good episode with some columns replaced; a function gets the old column."""
    episode = demonstration(seed)
    for key, value in columns.items():
        name = {"state": "observation.state", "reward": "next.reward"}.get(key, key)
        episode[name] = np.asarray(value(episode[name].copy()), np.float32)
    return episode


def spike(values):
    values[30, 0] += 9
    return values


def wrap(values):
    values[30:, 1] -= 6.28
    return values


def chatter(values):
    values[:, 2] = np.arange(len(values)) % 2
    return values


def stretch(values):
    values[7, 0] = 60
    return values


def slow(values):
    rng = np.random.default_rng(int(1e6 * abs(values[1, 0])))
    size = 10 ** rng.normal(-2, 0.4, (len(values), 1)) * rng.choice([-1, 1], values.shape)
    return np.cumsum(size, axis=0) + rng.normal(0, 2e-3, values.shape)


def pair(**columns):
    return [change(seed, **columns) for seed in (0, 1)]


def only(*keys, steps=60):
    return [{k: v[:steps] for k, v in demonstration(seed).items() if k in keys} for seed in (0, 1)]


def halting(values):
    return values[(np.arange(60) // 2).clip(0, 19)]
