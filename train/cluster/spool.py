"""Finished episodes on the collector's disk until the learner has stored them: none is lost with a process."""

import contextlib
import json
import os
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ..loop.acting import Finished, Turn
from ..replay.episode import Episode
from ..run.durable import flush

__all__ = ["Spool"]


class Spool:
    """A folder with a file for each episode that nobody else has yet, named by the key of its turn."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def put(self, finished: Finished) -> None:
        """Keep an episode; a kill at any moment leaves it whole or not there. Raises OSError on a full disk."""
        if finished.episode is None:
            return
        self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        said: dict[str, Any] = {
            "turn": asdict(finished.turn), "success": finished.success, "discarded": finished.discarded,
            "terminated": finished.episode.terminated, "taught": finished.episode.taught,
            "borders": finished.episode.borders, "state": finished.episode.low_dim is not None,
        }  # fmt: skip
        arrays = finished.episode.arrays() | {"values": finished.values}
        temporary = self.folder / f".{finished.turn.key}.tmp"
        with temporary.open("wb") as file:
            np.savez(file, said=np.array(json.dumps(said)), **arrays)  # type: ignore[arg-type]
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(self._path(finished.turn.key))
        flush(self.folder)

    def drop(self, key: str) -> None:
        """Forget an episode that the learner has stored."""
        self._path(key).unlink(missing_ok=True)

    def __iter__(self) -> Iterator[Finished]:
        """All that are kept, in the order in which their turns began."""
        read = []
        for path in self.folder.glob("*.npz"):
            with contextlib.suppress(FileNotFoundError):  # another collector of this machine heard that it is stored
                read.append(_read(path))
        return iter(sorted(read, key=lambda finished: finished.turn.number))

    def _path(self, key: str) -> Path:
        return self.folder / f"{key}.npz"


def _read(path: Path) -> Finished:
    with np.load(path, allow_pickle=False) as file:
        said = json.loads(str(file["said"]))
        views = sorted((name for name in file if name.startswith("view_")), key=lambda name: int(name[5:]))
        episode = Episode(
            low_dim=file["low_dim"] if said["state"] else None,
            pixels=tuple(file[name] for name in views),
            action=file["action"][:-1],
            reward=file["reward"][:-1],
            terminated=said["terminated"],
            success=said["success"],
            taught=tuple((first, last) for first, last in said["taught"]),
            borders=tuple(said["borders"]),
        )
        return Finished(
            turn=Turn(**said["turn"]), episode=episode, success=said["success"], discarded=said["discarded"],
            values=file["values"],
        )  # fmt: skip
