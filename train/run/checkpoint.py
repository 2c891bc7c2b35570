"""Checkpoints in LeRobot's layout, written whole or not at all, and what a resumed run restores from them.

output_dir/checkpoints/<env step>/pretrained_model/   what lerobot-eval loads
                                 /training_state/     optimiser, counters, random state
output_dir/checkpoints/last -> <env step>
output_dir/replay/                                    the episodes, written as they end (replay/files.py)

A resumed run (build.py) loads weights and processors from the one, restores the other here, cuts its tables back to the
checkpoint, and takes up the episodes that ended since.
"""

import json
import os
import random
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from lerobot_cqn.errors import DataError

if TYPE_CHECKING:
    from lerobot_cqn.learner import Learner

    from ..agent import Agent

__all__ = ["Counters", "last_checkpoint", "restore", "save"]


@dataclass
class Counters:
    """Progress of a run."""

    env_steps: int = 0
    episodes: int = 0
    updates: int = 0
    offline_done: bool = False
    wall_s: float = 0.0
    online_s: float = 0.0  # acting and learning online, without waiting for a person


def last_checkpoint(output_dir: Path) -> Path:
    """Folder of the newest checkpoint. Raises DataError when there is none."""
    last = output_dir / "checkpoints" / "last"
    if not (last / "training_state").is_dir():
        raise DataError(
            f"Nothing to resume in {output_dir}: expected checkpoints/last, which the first save makes; leave out "
            "--resume to start anew in a new or empty folder."
        )
    return last


def save(
    output_dir: Path,
    agent: "Agent",
    learner: "Learner",
    rng: np.random.Generator,
    counters: Counters,
    *,
    tables: dict[str, int],
    run_config: dict[str, Any],
) -> Path:
    """Write a checkpoint and point `last` at it; a kill at any moment leaves the previous one in place."""
    folder = output_dir / "checkpoints"
    target = folder / f"{counters.env_steps:06d}"
    temporary = folder / f".{target.name}.tmp"
    for left in folder.glob(".*.tmp"):  # of a process that was killed while it saved
        if left.is_dir() and not left.is_symlink():
            shutil.rmtree(left, ignore_errors=True)
    model, state = temporary / "pretrained_model", temporary / "training_state"
    state.mkdir(parents=True)
    agent.policy.save_pretrained(model)
    agent.preprocessor.save_pretrained(model)
    agent.postprocessor.save_pretrained(model)
    (model / "train_config.json").write_text(json.dumps(run_config, indent=2))
    torch.save(learner.state_dict(), state / "optimizer.pt")
    # Exploration draws on the policy's device, everything else on the CPU.
    devices = torch.cuda.get_rng_state_all() if torch.cuda.is_available() else []
    torch.save([torch.get_rng_state(), *devices], state / "torch_rng.pt")
    progress = {"counters": asdict(counters), "tables": tables, "numpy_rng": rng.bit_generator.state}
    (state / "progress.json").write_text(json.dumps(progress))
    old = folder / f".{target.name}.old"
    if target.exists():  # same step again (the end right after a save): `last` must never point nowhere
        if (folder / "last").resolve() == target.resolve():
            shutil.rmtree(old, ignore_errors=True)
            shutil.copytree(target, old, copy_function=_link_or_copy)
            _point_last(folder, old)
        shutil.rmtree(target)
    temporary.rename(target)
    _point_last(folder, target)
    shutil.rmtree(old, ignore_errors=True)
    _forget_old_states(folder, target)
    return target


def restore(checkpoint: Path, learner: "Learner", rng: np.random.Generator) -> tuple[Counters, dict[str, int]]:
    """Optimiser and random state; returns counters and table sizes. Weights load with the policy."""
    state = checkpoint / "training_state"
    learner.load_state_dict(torch.load(state / "optimizer.pt", weights_only=True))
    progress = json.loads((state / "progress.json").read_text())
    rng.bit_generator.state = progress["numpy_rng"]
    cpu, *devices = torch.load(state / "torch_rng.pt", weights_only=True)
    torch.set_rng_state(cpu)
    if len(devices) == torch.cuda.device_count():  # on another machine a resumed run goes on, but not identically
        torch.cuda.set_rng_state_all(devices)
    return Counters(**progress["counters"]), progress["tables"]


def seed_everything(seed: int) -> np.random.Generator:
    """Seed Python, NumPy's old generator and torch; return the generator for sampling."""
    random.seed(seed)
    np.random.seed(seed)  # some environments draw from it
    torch.manual_seed(seed)
    return np.random.default_rng(seed)


def _point_last(folder: Path, target: Path) -> None:
    """Make `last` point at `target` in one step."""
    link = folder / ".last.tmp"
    link.unlink(missing_ok=True)
    link.symlink_to(target.name)
    os.replace(link, folder / "last")


def _link_or_copy(source: str, destination: str) -> None:
    """A second name for the same bytes where the file system knows hard links, else a copy."""
    try:
        os.link(source, destination)
    except OSError:
        shutil.copy2(source, destination)


def _forget_old_states(folder: Path, newest: Path) -> None:
    """Keep every policy, but the optimiser only of the newest checkpoint."""
    for other in folder.iterdir():
        if other.is_dir() and not other.is_symlink() and other.name.isdigit() and other != newest:
            shutil.rmtree(other / "training_state", ignore_errors=True)
