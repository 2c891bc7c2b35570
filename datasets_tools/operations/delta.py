"""``cqn-data delta``: absolute joint actions to delta joint actions on disk, and back. The maths: see ``deltas``."""

import dataclasses
import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, cast

from lerobot_cqn.delta_actions import KINDS, DeltaJoints, Kind, description
from lerobot_cqn.errors import ConfigError, DataError, one_of
from lerobot_cqn.schema import ACTION, STATE, dimension_names

from ..terminal.console import note, result, table
from ..terminal.options import option
from .job import Step, settings_of

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

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

    def suffix(self) -> str:
        """What was made: deltas, or absolute actions."""
        return self.to

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
        from ..decisions.joints import Matched, gripper_dims, match_joints, no_positions

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
            left_out = {*gripper_dims(names, self.keep_absolute), *no_positions(names)}
            joints = tuple(i for i in range(len(names)) if i not in left_out)
            matched, kind = Matched(joints, joints, "name", tuple(names[i] for i in no_positions(names))), "state"
        else:
            matched, kind = match_joints(view.features, self.keep_absolute), self.of
        if remark := matched.remark():
            note(remark)
        if not matched.action_dims:
            raise DataError(
                f"No action dimension would be a delta: {', '.join(names)} are grippers, kept absolute, or no"
                " positions; leave out this step."
            )
        deltas = DeltaJoints(cast(Kind, "command" if kind == "auto" else kind), matched.action_dims, matched.state_dims)
        self._check(view, deltas)
        return deltas

    def _check(self, view: "View", deltas: DeltaJoints) -> None:
        """Refuse angles that wrap, and say so where the actions look like deltas already."""
        import numpy as np

        from ..decisions.angles import full_turn, turned
        from ..decisions.deltas import to_delta
        from ..decisions.joints import gripper_dims

        low, high, moved, gap = np.inf, -np.inf, -np.inf, []
        for index in view.episodes:
            state, action = _joints(view.episode(index), deltas)
            both = np.concatenate([state, action])
            low, high = np.minimum(low, both.min(axis=0)), np.maximum(high, both.max(axis=0))
            moved = np.maximum(moved, np.ptp(state, axis=0))
            gap.append(np.abs(action - state).mean(axis=0))
        if ACTION in view.features and (np.mean(gap, axis=0) > np.maximum(moved, 1e-9)).mean() > 0.5:
            note("Most commands are farther from the arm than it ever moves: these actions look like deltas already.")
        turns = full_turn(np.asarray(low), np.asarray(high))
        for index in view.episodes if np.isfinite(turns).any() else ():
            state, action = _joints(view.episode(index), deltas)
            found = np.argwhere(turned(to_delta(action, state, deltas.kind), turns))
            if len(found):
                frame, joint = (int(n) for n in found[0])
                names = dimension_names(view.features.get(ACTION, view.features[STATE]))
                wraps = [names[d] for d, turn in zip(deltas.action_dims, turns, strict=True) if np.isfinite(turn)]
                kept = [n for i, n in enumerate(names) if n in wraps or i in gripper_dims(names, self.keep_absolute)]
                raise DataError(
                    f"Episode {index}, frame {frame}: the difference of '{names[deltas.action_dims[joint]]}' would be"
                    f" nearly a full turn ({turns[joint]:.4g}): an angle that wraps, or a wrong reading. Keep such"
                    f" angles absolute: --keep_absolute='{json.dumps(kept)}'."
                )


def _joints(episode: "Episode", deltas: DeltaJoints) -> "tuple[NDArray[np.float64], NDArray[np.float64]]":
    """(T, J) measured and commanded joints of an episode; where there are no commands, the next measurement."""
    import numpy as np

    state = np.asarray(episode.columns[STATE], np.float64)
    action = np.asarray(episode.columns.get(ACTION, np.concatenate([state[1:], state[-1:]])), np.float64)
    return state[:, list(deltas.state_dims)], action[:, list(deltas.action_dims)]


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
