"""Time of one gradient update: production code against the plain oracle, in one run on the same batch.

    python -m benchmarks.update_step                       # 2 views of 84x84, stack 2, batch 256, paper encoder
    python -m benchmarks.update_step --state-only --batch 128 --stack 1 --hidden 256 --threads 1
    python -m benchmarks.update_step --csv benchmarks/results/update_step.csv

The oracle (tests/oracle.py) is the pseudocode read literally. Both sides augment, and take turns within each
repeat, so that a busy machine slows both; medians are printed. The parts are timed inside the updates they
belong to; `backward` is what remains of an update.
"""

import argparse
import statistics
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from lerobot_cqn.critic import CQNModel
from lerobot_cqn.learner import Learner
from lerobot_cqn.schema import Batch, Observation
from lerobot_cqn.settings import PRESETS, CQNSettings
from tests.oracle import Oracle

from .results_table import append

PARTS = ("augment", "encode", "critic", "backward", "optimiser")
LOW_DIM, DIMS, SIDE = 13, 7, 84


class Contestant:
    """An update, and the seconds each of its parts took."""

    def __init__(self, name: str, update: Callable[[], Any], timed: list[tuple[Any, str, str]]) -> None:
        self.name, self.update = name, update
        self.seconds: dict[str, list[float]] = defaultdict(list)
        self._now: dict[str, float] = defaultdict(float)
        for owner, method, part in timed:
            setattr(owner, method, self._clock(getattr(owner, method), part))

    def _clock(self, function: Callable[..., Any], part: str) -> Callable[..., Any]:
        def clocked(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            result = function(*args, **kwargs)
            self._now[part] += time.perf_counter() - start
            return result

        return clocked

    def run(self) -> None:
        self._now.clear()
        start = time.perf_counter()
        self.update()
        total = time.perf_counter() - start
        now = self._now
        now["critic"] -= now["encode"]  # the loss contains both
        now["backward"] = total - sum(now[part] for part in PARTS if part != "backward")
        for part in PARTS:
            self.seconds[part].append(now[part])
        self.seconds["update"].append(total)

    def milliseconds(self, part: str) -> float:
        return 1e3 * statistics.median(self.seconds[part])


def production(name: str, model: CQNModel, batch: Batch) -> Contestant:
    learner = Learner(model)
    timed = [
        (model, "augment", "augment"), (model, "encode", "encode"), (model, "loss", "critic"),
        (learner.optimizer, "step", "optimiser"), (model, "update_target", "optimiser"),
    ]  # fmt: skip
    return Contestant(name, lambda: learner.update(batch), timed)


def oracle(model: CQNModel, batch: Batch) -> Contestant:
    plain = Oracle(model)
    timed = [
        (plain, "augment", "augment"), (plain, "encode", "encode"), (plain, "loss", "critic"),
        (plain, "step", "optimiser"),
    ]  # fmt: skip
    return Contestant("oracle", lambda: plain.update(batch), timed)


def random_batch(settings: CQNSettings, views: int, size: int) -> Batch:
    """Noise in the shape of data; half of it demonstrations."""

    def observation() -> Observation:
        shape = (size, 3 * settings.frame_stack, SIDE, SIDE)
        pixels = tuple(torch.randint(256, shape, dtype=torch.uint8) for _ in range(views))
        return Observation(pixels, torch.randn(size, LOW_DIM * settings.frame_stack))

    reward, demo = (torch.rand(size, 1) < 0.05).float(), (torch.arange(size) % 2 == 0).float()[:, None]
    return Batch(
        observation=observation(),
        action=2 * torch.rand(size, DIMS) - 1,
        reward=reward,
        discount=0.97 * (1 - reward),
        next_observation=observation(),
        demo=demo,
    )


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=256, help="samples in all, demonstrations included")
    parser.add_argument("--views", type=int, default=2)
    parser.add_argument("--stack", type=int, default=2)
    parser.add_argument("--levels", type=int, default=3)
    parser.add_argument("--bins", type=int, default=5)
    parser.add_argument("--hidden", type=int, default=512)
    parser.add_argument("--preset", default="paper_rlbench", choices=PRESETS)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--state-only", action="store_true", help="no cameras")
    parser.add_argument("--csv", type=Path, help="append the rows to this file")
    return parser.parse_args()


def main() -> None:
    args = parse()
    torch.set_num_threads(args.threads)
    torch.manual_seed(0)
    settings = replace(
        CQNSettings(**PRESETS[args.preset]),
        frame_stack=args.stack, levels=args.levels, bins=args.bins, hidden_dim=args.hidden,
    )  # fmt: skip
    views = 0 if args.state_only else args.views
    batch = random_batch(settings, views, args.batch)

    def model(**changes: Any) -> CQNModel:
        cameras = {str(view): (3, SIDE, SIDE) for view in range(views)}
        return CQNModel(cameras, LOW_DIM, DIMS, replace(settings, **changes))

    contestants = [
        oracle(model(), batch),
        production("production", model(), batch),
        production("production, bf16", model(bf16=True), batch),
    ]
    for repeat in range(args.repeats + 1):
        for contestant in contestants:
            contestant.run()
            if repeat == 0:  # warm-up
                contestant.seconds.clear()

    case = f"{views or 'no'} views, stack {args.stack}, batch {args.batch}, L {args.levels}, N {args.bins}, D {DIMS}"
    print(f"{case}, hidden {args.hidden}, {args.threads} threads, {torch.backends.cpu.get_cpu_capability()}")
    print(f"{'median ms':18}{'update':>10}{'ratio':>8}" + "".join(f"{part:>11}" for part in PARTS))
    slowest = contestants[0].milliseconds("update")
    rows = []
    for contestant in contestants:
        total = contestant.milliseconds("update")
        parts = {part: round(contestant.milliseconds(part), 1) for part in PARTS}
        print(
            f"{contestant.name:18}{total:10.1f}{slowest / total:7.1f}x" + "".join(f"{v:11.1f}" for v in parts.values())
        )
        rows.append(
            {
                "what": contestant.name, "views": views, "stack": args.stack, "batch": args.batch,
                "levels": args.levels, "bins": args.bins, "hidden": args.hidden, "threads": args.threads,
                "repeats": args.repeats, "update_ms": round(total, 1), "ratio": round(slowest / total, 2), **parts,
                "machine": f"{torch.get_num_threads()} threads, {torch.backends.cpu.get_cpu_capability()}, "
                f"torch {torch.__version__.split('+')[0]}",
            }
        )  # fmt: skip
    append(args.csv, rows)


if __name__ == "__main__":
    main()
