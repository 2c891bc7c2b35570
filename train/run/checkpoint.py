"""Checkpoints in LeRobot's layout, written whole or not at all, and what a resumed run restores from them.

output_dir/checkpoints/<env step>/pretrained_model/   what lerobot-eval loads
                                 /training_state/     optimiser, counters, random state
output_dir/checkpoints/last -> <env step>
output_dir/.begun                                     until the first checkpoint: the run can be begun again
output_dir/replay/                                    the episodes, written as they end (replay/files.py)

A resumed run (build.py) loads weights and processors from the one, restores the other here, cuts its tables back to the
checkpoint, and takes up the episodes that ended since.
"""

import json
import os
import random
import shutil
import zipfile
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open

from lerobot_cqn.errors import DataError

from .durable import flush, flush_tree

if TYPE_CHECKING:
    from lerobot_cqn.learner import Learner

    from ..agent import Agent

__all__ = ["Counters", "last_checkpoint", "restore", "save", "stored_episodes"]

KEPT_STATES = 2  # checkpoints from which a run can go on: the newest may be damaged


@dataclass
class Counters:
    """Progress of a run."""

    env_steps: int = 0
    episodes: int = 0
    updates: int = 0
    offline_done: bool = False
    wall_s: float = 0.0
    owed: int = 0  # updates that an interrupt left to be made
    online_s: float = 0.0  # acting and learning online, without waiting for a person


def last_checkpoint(output_dir: Path, say: Callable[[str], None] = lambda _: None) -> Path:
    """Folder of the newest checkpoint that is whole; `say` is told where newer ones are damaged.

    Raises DataError when there is none.
    """
    folder = output_dir / "checkpoints"
    last = folder / "last"
    # A link that points nowhere, or to a folder without a state, is no checkpoint; older ones may be there.
    candidates = [last, *sorted(_with_state(folder), reverse=True)] if last.is_symlink() or folder.is_dir() else []
    damages: dict[Path, str] = {}
    for candidate in candidates:
        place = candidate.resolve()
        if place in damages:
            continue
        if not (damage := _damage(place)):
            for other, what in damages.items():
                say(f"Warning: the checkpoint {other.name} is damaged ({what}): going on from {place.name}.")
            return candidate
        damages[place] = damage
    found = [f"{place.name}: {what}" for place, what in damages.items() if place.is_dir()]
    if found:
        raise DataError(f"No checkpoint in {output_dir} is whole ({'; '.join(found)}): start anew in another folder.")
    raise DataError(
        f"Nothing to resume in {output_dir}: expected checkpoints/last, which the first save makes; leave out "
        "--resume to start anew."
    )


def _with_state(folder: Path) -> list[Path]:
    """Checkpoints that a run can go on from."""
    return [
        place
        for place in folder.iterdir()
        if place.name.isdigit() and not place.is_symlink() and (place / "training_state").is_dir()
    ]


def _damage(checkpoint: Path) -> str:
    """What of a checkpoint is missing or cannot be read; "" where it is whole."""
    model, state = checkpoint / "pretrained_model", checkpoint / "training_state"
    named = [model / "config.json", model / "train_config.json", model / "model.safetensors"]
    named += [state / "progress.json", state / "optimizer.pt", state / "torch_rng.pt"]
    for path in (*named, *sorted(model.glob("*.json")), *sorted(model.glob("*.safetensors"))):
        try:
            if path.suffix == ".json":
                json.loads(path.read_text())
            elif path.suffix == ".safetensors":
                with safe_open(path, framework="np"):
                    pass
            else:
                with zipfile.ZipFile(path) as archive:
                    if archive.testzip() is not None:
                        return f"{path.name} is damaged"
        except FileNotFoundError:
            return f"{path.name} is missing"
        except (OSError, ValueError, SafetensorError, zipfile.BadZipFile):
            return f"{path.name} cannot be read"
    missing = {"counters", "tables", "numpy_rng"} - {*json.loads((state / "progress.json").read_text())}
    return f"progress.json lacks {', '.join(sorted(missing))}" if missing else ""


def save(
    output_dir: Path,
    agent: "Agent",
    learner: "Learner",
    rng: np.random.Generator,
    counters: Counters,
    *,
    tables: dict[str, int],
    run_config: dict[str, Any],
    episodes: Iterable[int] = (),
) -> Path:
    """Write a checkpoint and point `last` at it; a kill or a power cut at any moment leaves the previous one in place.

    episodes: numbers of the run's episodes that the replay holds. Raises OSError where it does not fit on the disk.
    """
    folder = output_dir / "checkpoints"
    target = folder / f"{counters.env_steps:06d}"
    temporary = folder / f".{target.name}.tmp"
    for left in folder.glob(".*.tmp"):  # of a process that was killed while it saved
        if left.is_dir() and not left.is_symlink():
            shutil.rmtree(left, ignore_errors=True)
    progress = {
        "counters": asdict(counters), "tables": tables, "numpy_rng": rng.bit_generator.state, "episodes": [*episodes],
    }  # fmt: skip
    try:
        _write(temporary, agent, learner, run_config, progress)
        flush_tree(temporary)
    except OSError:
        shutil.rmtree(temporary, ignore_errors=True)  # it fills the disk
        raise
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


def _write(
    temporary: Path, agent: "Agent", learner: "Learner", run_config: dict[str, Any], progress: dict[str, Any]
) -> None:
    """All files of a checkpoint."""
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
    (state / "progress.json").write_text(json.dumps(progress))


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


def stored_episodes(checkpoint: Path) -> frozenset[int]:
    """Numbers of the run's episodes that the replay held when a checkpoint was saved."""
    progress = json.loads((checkpoint / "training_state" / "progress.json").read_text())
    return frozenset(progress.get("episodes", ()))


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
    flush(folder)
    os.replace(link, folder / "last")
    flush(folder)


def _link_or_copy(source: str, destination: str) -> None:
    """A second name for the same bytes where the file system knows hard links, else a copy."""
    try:
        os.link(source, destination)
    except OSError:
        shutil.copy2(source, destination)


def _forget_old_states(folder: Path, newest: Path) -> None:
    """Keep every policy, but the state of training only of the newest checkpoints."""
    before = sorted((other for other in _with_state(folder) if int(other.name) < int(newest.name)), reverse=True)
    kept = {newest, *before[: KEPT_STATES - 1]}
    for other in _with_state(folder):
        if other not in kept:  # also those behind it, of a run that went on from an older one
            shutil.rmtree(other / "training_state", ignore_errors=True)
