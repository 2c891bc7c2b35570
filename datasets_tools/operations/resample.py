"""``cqn-data resample``: fewer steps a second, e.g. 30 -> 10; no command or reward in between is lost."""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from lerobot_cqn.errors import ConfigError

from ..terminal.console import result
from ..terminal.options import option
from .job import Step, settings_of

if TYPE_CHECKING:
    from ..views.view import DerivedView, View

__all__ = ["Resample"]


@dataclasses.dataclass
class Resample(Step):
    """Settings of ``cqn-data resample``."""

    name = "resample"
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
        if self.fps < 1:
            raise ConfigError(f"Expected --fps >= 1, got {self.fps}.")

    def on(self, view: "View") -> "DerivedView":
        """The view at the lower rate; raises ConfigError for one that would need frames that do not exist."""
        from ..views.resampled import Resampled

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

    @staticmethod
    def told(entry: Mapping[str, Any]) -> str:
        """The sentence for the history."""
        total, settings = entry["total"], entry["settings"]
        rates = f"{settings['fps']} steps a second instead of {settings['from_fps']}"
        return f"Took {rates}: {total['steps']} steps became {total['kept']}."
