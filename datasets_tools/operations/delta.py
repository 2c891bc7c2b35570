"""``cqn-data delta``: absolute joint actions to delta joint actions on disk, and back. The maths: see ``deltas``."""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, cast

from lerobot_cqn.delta_actions import KINDS, DeltaJoints, Kind, description
from lerobot_cqn.errors import ConfigError, DataError, one_of
from lerobot_cqn.schema import ACTION, STATE, dimension_names

from ..terminal.console import note, result, table
from ..terminal.options import option
from .job import Step, settings_of

if TYPE_CHECKING:
    from ..views.episode import Episode
    from ..views.view import DerivedView, View

__all__ = ["Delta"]


@dataclasses.dataclass
class Delta(Step):
    """Settings of ``cqn-data delta``."""

    name = "delta"
    example = """
cqn-data delta --repo_id=local/pick --root=data/pick --new_root=data/pick_delta
cqn-data delta --repo_id=local/pick_delta --root=data/pick_delta --new_root=data/pick_back --to=absolute
"""
    notes = """
Kinds (--of): command = commanded minus measured position (executed as goal = measured + delta; exact inverse);
command_steps = command minus the command before (goal = last goal + delta; exact inverse); state = measured position
of the next step minus this one (the way back gives where the arm went, not what was commanded).
"""

    to: str = option("delta", help="delta, or absolute for the way back.")
    of: str = option(
        "auto", help="command, command_steps or state; auto: command, or state where there are no actions."
    )
    keep_absolute: list[str] = dataclasses.field(
        default_factory=list,
        metadata={
            "help": """Dimensions that stay absolute, e.g. '["right_hand"]'; by default those named *gripper*."""
        },
    )

    def validate(self) -> None:
        """Check choices; raises ConfigError naming the option and the valid values."""
        for name, valid in (("to", ("delta", "absolute")), ("of", ("auto", *KINDS))):
            if getattr(self, name) not in valid:
                raise ConfigError(one_of(f"--{name}", getattr(self, name), valid))
        if self.to == "absolute" and (self.of != "auto" or self.keep_absolute):
            raise ConfigError(
                "--to=absolute takes its kind from the dataset's history; leave out --of and --keep_absolute."
            )

    def on(self, view: "View") -> "DerivedView":
        """Decide which dimensions are joints; raises ConfigError or DataError where that cannot be done."""
        from ..views.delta import AbsoluteView, DeltaView

        after: DerivedView
        if self.to == "absolute":
            deltas = self._known(view)
            after = AbsoluteView(view)
            if deltas.kind == "state":
                note("These deltas came from measured positions: the result says where the arm went, not its commands.")
        else:
            deltas = self._wanted(view)
            after = DeltaView(view, made=deltas)
        names = description(deltas, view.features)
        result(f"{self.to.capitalize()} actions of kind {deltas.kind}: {', '.join(names['action'])}")
        _show(after)
        now = names if self.to == "delta" else None
        after.entry.update(settings=settings_of(self) | {"of": deltas.kind}, deltas=now)
        return after

    @staticmethod
    def told(entry: Mapping[str, Any]) -> str:
        """The sentence for the history."""
        kind = entry["settings"]["of"]
        if not entry["deltas"]:
            return f"Turned the delta actions of kind {kind} back into absolute ones."
        return f"Turned absolute actions into deltas of kind {kind}, of {', '.join(entry['deltas']['action'])}."

    def _known(self, view: "View") -> "DeltaJoints":

        if view.deltas is None:
            raise ConfigError(
                "The dataset's history does not say that its actions are deltas; if they are, say of which kind with"
                " --actions=command, command_steps or state."
            )
        return view.deltas

    def _wanted(self, view: "View") -> "DeltaJoints":
        import numpy as np

        from ..decisions.joints import gripper_dims, match_joints

        if view.deltas is not None:
            raise ConfigError(f"The actions are deltas already (kind {view.deltas.kind}); nothing to do.")
        if STATE not in view.features:
            raise DataError(f"Expected a feature '{STATE}', found {', '.join(view.features)}.")
        names = dimension_names(view.features[ACTION if ACTION in view.features else STATE])
        for name in self.keep_absolute:
            if name not in names:
                raise ConfigError(one_of("dimension", name, names))
        if ACTION not in view.features:
            if self.of not in ("auto", "state"):
                raise DataError(f"There is no '{ACTION}' to take commands from; leave out --of={self.of}.")
            left_out = gripper_dims(names, self.keep_absolute)
            joints = tuple(i for i in range(len(names)) if i not in left_out)
            return DeltaJoints("state", joints, joints)
        matched = match_joints(view.features, self.keep_absolute)
        kind = cast(Kind, "command" if self.of == "auto" else self.of)
        if not matched[0]:
            raise DataError(f"No action dimension would be a delta: {', '.join(names)} are all kept absolute.")
        low, high, gap = np.inf, -np.inf, []
        for index in view.episodes:
            columns = view.episode(index).columns
            state = columns[STATE][:, list(matched[1])]
            low, high = np.minimum(low, state.min(axis=0)), np.maximum(high, state.max(axis=0))
            gap.append(np.abs(columns[ACTION][:, list(matched[0])] - state).mean(axis=0))
        if (np.mean(gap, axis=0) > np.maximum(high - low, 1e-9)).mean() > 0.5:
            note("Most commands are farther from the arm than it ever moves: these actions look like deltas already.")
        return DeltaJoints(kind, *matched)


def _show(view: "View") -> None:
    """Range of every dimension after the operation."""
    import numpy as np

    def actions(episode: "Episode") -> Any:
        return np.asarray(episode.columns[ACTION], np.float64)

    names = dimension_names(view.features[ACTION])
    low, high, size, steps = np.full(len(names), np.inf), np.full(len(names), -np.inf), np.zeros(len(names)), 0
    for index in view.episodes:
        values = actions(view.episode(index))
        low, high = np.minimum(low, values.min(axis=0)), np.maximum(high, values.max(axis=0))
        size, steps = size + np.abs(values).sum(axis=0), steps + len(values)
    rows = [[n, f"{a:.4g}", f"{b:.4g}", f"{c:.4g}"] for n, a, b, c in zip(names, low, high, size / steps, strict=True)]
    table(["dimension", "min", "max", "mean size"], rows)
