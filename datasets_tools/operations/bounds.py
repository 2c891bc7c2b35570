"""``cqn-data bounds``: the action range that training maps to [-1, 1], written where it reads it: meta/stats.json."""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from lerobot_cqn.errors import ConfigError, DataError
from lerobot_cqn.schema import dimension_names

from ..terminal.console import note, table
from ..terminal.options import option
from .job import Step, settings_of

if TYPE_CHECKING:
    from ..views.bounded import Bounded
    from ..views.view import DerivedView, View

__all__ = ["SetBounds"]


@dataclasses.dataclass
class SetBounds(Step):
    """Settings of ``cqn-data bounds``."""

    name = "bounds"
    example = """
cqn-data bounds --repo_id=local/pick --root=data/pick --new_root=data/pick_bounded --quantile=0.001 --margin=0.1
"""
    notes = """
The bounds become min and max of the action in meta/stats.json, which policies with MIN_MAX scaling (CQN) map to -1 and
1; actions outside are cut to them in training. Operations that change actions or steps set them back to min and max.
Merging and splitting with lerobot-edit-dataset does so, too.
"""

    quantile: float = option(0.0, help="Share of the steps left out at either end of each dimension, 0 to below 0.5.")
    margin: float = option(
        0.0,
        help=(
            "Share of the range added at either end; 0.2 is like the authors' code. Where some actions are "
            "differences, only of these: the ends of an absolute one (a gripper) are the robot's own."
        ),
    )

    def validate(self) -> None:
        """Check ranges; raises ConfigError naming the option, the range and the value."""
        if not 0 <= self.quantile < 0.5:
            raise ConfigError(f"Expected --quantile in [0, 0.5), got {self.quantile}.")
        if not 0 <= self.margin < float("inf"):
            raise ConfigError(f"Expected --margin >= 0, got {self.margin}.")

    def on(self, view: "View") -> "DerivedView":
        """Compute the bounds and show them; raises DataError without actions."""
        from ..views.bounded import Bounded

        if "action" not in view.features:
            raise DataError(f"Expected a feature 'action', found {', '.join(view.features)}.")
        after = Bounded(view, quantile=self.quantile, margin=self.margin)
        after.settle(list(view.episodes))
        self._show(view, after)
        after.entry.update(settings=settings_of(self))
        return after

    @staticmethod
    def told(entry: Mapping[str, Any]) -> str:
        """The sentence for the history."""
        settings = entry["settings"]
        inner = f"{100 * settings['quantile']:.4g}% of the steps left out at either end"
        outer = f"{100 * settings['margin']:.4g}% of the range added there"
        return f"Set the action bounds of {len(entry['bounds']['low'])} dimensions: {inner}, {outer}."

    def _show(self, view: "View", after: "Bounded") -> None:
        import numpy as np

        from ..views.bounded import actions, extremes

        names, bounds = dimension_names(view.features["action"]), after.bounds
        assert bounds is not None  # noqa: S101  # settled above
        low, high = extremes(view, view.episodes)
        outside, steps = np.zeros(len(names)), 0
        for values in actions(view, view.episodes):
            outside += ((values < bounds.low - 1e-9) | (values > bounds.high + 1e-9)).sum(axis=0)
            steps += len(values)
        rows = []
        for i, name in enumerate(names):
            numbers = (low[i], high[i], bounds.low[i], bounds.high[i])
            rows.append([name, *(f"{v:.4g}" for v in numbers), f"{outside[i] / steps:.2%}"])
        table(["dimension", "min", "max", "lower bound", "upper bound", "outside"], rows)
        constant = [n for n, a, b in zip(names, bounds.low, bounds.high, strict=True) if b - a <= 1e-8]
        if constant:
            note(f"Constant: {', '.join(constant)}; CQN maps such a dimension to 0 and back to its constant.")
