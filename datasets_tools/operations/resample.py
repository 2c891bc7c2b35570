"""``cqn-data resample``: fewer steps a second, e.g. 30 -> 10; no command or reward in between is lost."""

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..terminal.console import result
from ..terminal.options import option
from ..views.view import Bounds, Episode, View
from .job import Step, help_for, main_for, settings_of

if TYPE_CHECKING:
    from ..decisions.deltas import Deltas

__all__ = ["Resample", "Resampled", "help", "main", "windows"]


@dataclasses.dataclass
class Resample(Step):
    """Settings of ``cqn-data resample``."""

    name = "resample"
    summary = "take fewer steps a second"
    example = """
cqn-data resample --repo_id=local/click --root=data/click --new_root=data/click_5hz --fps=5
"""
    notes = """
A new step holds the observation of its time, the last command before the next one (delta actions are formed anew, so
that they connect the states), the sum of the rewards in between, and done or success if any of them had it.
"""

    fps: int = option(help="Steps a second, fewer than now.")

    def validate(self) -> None:
        """Check ranges; raises ConfigError."""
        from lerobot_cqn.errors import ConfigError

        if self.fps < 1:
            raise ConfigError(f"Expected --fps >= 1, got {self.fps}.")

    def on(self, view: View) -> View:
        """Raises ConfigError for a rate that would need frames that do not exist."""
        from lerobot_cqn.errors import ConfigError

        if self.fps >= view.fps:
            raise ConfigError(
                f"Expected --fps below the present {view.fps}, got {self.fps}: frames cannot be invented."
            )
        after = Resampled(view, rate=self.fps)
        steps = {i: (len(view.episode(i)), len(after.episode(i))) for i in view.episodes}
        old, new = (sum(pair[k] for pair in steps.values()) for k in (0, 1))
        result(f"{old} steps at {view.fps} Hz become {new} at {self.fps} Hz.")
        after.entry.update(settings=settings_of(self) | {"from_fps": view.fps}, total={"steps": old, "kept": new})
        return after


@dataclasses.dataclass
class Resampled(View):
    """With fewer steps a second."""

    rate: int = 1

    @property
    def fps(self) -> int:
        """The new rate."""
        return self.rate

    @property
    def bounds(self) -> Bounds | None:
        """Those of the view before were for other steps."""
        return None

    def episode(self, index: int) -> Episode:
        """The chosen steps."""
        return _resampled(self.parent.episode(index), self.parent.fps, self.rate, self.parent.deltas)


def windows(steps: int, old: int, new: int) -> NDArray[np.int64]:
    """(K,) first row of each new step; the rows until the next one belong to it. ``new`` < ``old``, in Hz."""
    count = -(-steps * new // old)
    starts: NDArray[np.int64] = np.floor(np.arange(count) * (old / new) + 0.5).astype(np.int64)
    return starts[starts < steps]


def _resampled(episode: Episode, old: int, new: int, deltas: "Deltas | None") -> Episode:
    from lerobot_cqn.schema import NEXT_DONE, NEXT_REWARD, NEXT_SUCCESS

    from ..decisions.deltas import select

    rows = windows(len(episode), old, new)
    last = np.append(rows[1:], len(episode)) - 1
    chosen = select(episode, rows, deltas, action_rows=last)
    joined: dict[str, Any] = {}
    if NEXT_REWARD in episode.columns:
        joined[NEXT_REWARD] = np.add.reduceat(episode.columns[NEXT_REWARD], rows, axis=0)
    for key in (NEXT_DONE, NEXT_SUCCESS, "next.truncated"):
        if key in episode.columns:
            joined[key] = np.logical_or.reduceat(episode.columns[key], rows, axis=0)
    return chosen.with_columns(joined)


def help() -> str:
    """Help page."""
    return help_for(Resample)


def main(args: list[str]) -> None:
    """Run from the command line; errors as in ``run_job``."""
    main_for(Resample, args)
