"""Samples a second and bytes a step of the replay, against the paper's replay written plainly in NumPy.

The plain version keeps episodes in a list and puts each transition together by itself: choose an episode and a step,
stack the frames one by one, sum the n-step return in a loop, and collate the batch at the end. Both hold the same
episodes (4 views of 84x84, stack 8, n 3 by default) and take turns in one process; medians are printed.

    python -m benchmarks.replay --csv=benchmarks/results/replay.csv
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from cqn_train.replay.buffer import Replay
from cqn_train.replay.episode import Episode

from .results_table import append

GAMMA = 0.99


class PlainReplay:
    """One transition after the other."""

    def __init__(self, stack: int, n_step: int) -> None:
        self.stack, self.n_step = stack, n_step
        self.episodes: list[Episode] = []

    def transition(self, rng: np.random.Generator) -> dict[str, Any]:
        episode = self.episodes[rng.integers(len(self.episodes))]
        step = int(rng.integers(len(episode)))
        reward, discount, at = 0.0, 1.0, step
        for _ in range(self.n_step):
            reward += discount * float(episode.reward[at])
            discount *= GAMMA
            at += 1
            if at == len(episode):
                discount = 0.0 if episode.terminated else discount
                break
        observation, later = self.history(episode, step), self.history(episode, at)
        return {
            "observation": observation,
            "next": later,
            "action": episode.action[step],
            "numbers": (reward, discount),
        }

    def history(self, episode: Episode, step: int) -> list[np.ndarray]:
        frames = [max(step - back, 0) for back in reversed(range(self.stack))]
        views = [np.concatenate([view[frame] for frame in frames]) for view in episode.pixels]
        return [*views, np.concatenate([episode.low_dim[frame] for frame in frames])]

    def sample(self, count: int, rng: np.random.Generator) -> dict[str, Any]:
        rows = [self.transition(rng) for _ in range(count)]
        batch: dict[str, Any] = {
            name: [torch.from_numpy(np.stack(parts)) for parts in zip(*(row[name] for row in rows), strict=True)]
            for name in ("observation", "next")
        }
        batch["action"] = torch.from_numpy(np.stack([row["action"] for row in rows]))
        batch["numbers"] = torch.tensor([row["numbers"] for row in rows])
        return batch


def make_episode(rng: np.random.Generator, steps: int, views: int, side: int) -> Episode:
    pictures = tuple(rng.integers(0, 256, (steps + 1, 3, side, side), np.uint8) for _ in range(views))
    state, action = rng.normal(size=(steps + 1, 7)), rng.uniform(-1, 1, (steps, 7))
    return Episode(
        low_dim=state.astype(np.float32),
        pixels=pictures,
        action=action.astype(np.float32),
        reward=np.zeros(steps, np.float32),
        terminated=False,
        success=True,
    )


def clock(work: Callable[[], Any]) -> float:
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun


def main() -> None:
    """Measure, print, and append to a CSV file if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, value in (("episodes", 40), ("steps", 100), ("views", 4), ("side", 84), ("stack", 8), ("n-step", 3),
                        ("batch", 128), ("repeats", 9), ("threads", 0)):  # fmt: skip
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--csv", type=Path, help="append the rows to this file")
    o = parser.parse_args()
    if o.threads:
        torch.set_num_threads(o.threads)
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        replay, plain = Replay(o.stack, o.n_step, GAMMA, folder=Path(folder)), PlainReplay(o.stack, o.n_step)
        for _ in range(o.episodes):
            episode = make_episode(rng, o.steps, o.views, o.side)
            replay.add(episode, demo=True)
            plain.episodes.append(episode)
        times: dict[str, list[float]] = {"plain": [], "replay": []}
        for _ in range(o.repeats + 1):
            times["plain"].append(clock(lambda: plain.sample(o.batch, rng)))
            times["replay"].append(clock(lambda: replay.sample(o.batch, 0, rng)))
        frame = 3 * o.side * o.side * o.views
        median = {name: statistics.median(values[1:]) for name, values in times.items()}
        rows = [
            {
                "what": name, "views": o.views, "side": o.side, "stack": o.stack, "n": o.n_step, "batch": o.batch,
                "samples_per_s": round(o.batch / seconds), "ratio": round(median["plain"] / seconds, 2),
                "bytes_per_step": replay.bytes_per_step if name == "replay" else "",
                "frame_bytes": frame, "machine": f"{torch.get_num_threads()} threads, torch {torch.__version__}",
            }
            for name, seconds in median.items()
        ]  # fmt: skip
    for row in rows:
        print(row)
    append(o.csv, rows)


if __name__ == "__main__":
    main()
