"""What the tables of a run say: whether practice paid, and what stands against it. Pure functions."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .metrics import read_rows

__all__ = ["Rows", "Tables", "advice", "gain", "mean", "practice", "read_tables", "unconverged"]

type Rows = Sequence[Mapping[str, str]]

FALLING = 0.1  # share by which the imitation loss still fell in the last tenth of the updates: not converged
STANDS = 0.3  # share of the steps of failures from which on standing still is what they fail by
AT_BOUNDS = 0.2  # share of the actions of failures from which on bounds may be what they fail by
TWICE = 2.0  # times as much in failures as in successes
TOLD = 0.1  # of Q: what the ends of failures lie below those of successes where the critic tells them apart
TENTHS = 10
FEW = 20  # rows below which a tenth says nothing
LATELY = 20  # training episodes


@dataclass(frozen=True, kw_only=True)
class Tables:
    """The tables of a run (docs/metrics.md), rows as text by column."""

    episodes: Rows = ()
    evaluations: Rows = ()
    updates: Rows = ()
    evaluation_episodes: Rows = ()
    diagnosis: Rows = ()


def read_tables(output_dir: Path) -> Tables:
    """The tables in a run's folder; those that do not exist are empty."""
    return Tables(**{name: read_rows(output_dir / f"{name}.csv") for name in Tables.__annotations__})


def unconverged(updates: Rows) -> float | None:
    """Share by which the imitation loss fell from the last tenth but one of the rows to the last; None below `FALLING`.

    updates: rows of updates.csv.
    """
    losses = [_imitation(row) for row in updates]
    if len(losses) < FEW or not all(loss > 0 for loss in losses):
        return None
    size = len(losses) // TENTHS
    before, last = np.mean(losses[-2 * size : -size]), np.mean(losses[-size:])
    fell = float(1 - last / before)
    return fell if fell > FALLING else None


def practice(tables: Tables) -> str:
    """Sentence about the success rates before and after practice, paired by their scenes where both have the same."""
    first, last = _phase(tables.evaluations, "offline"), _phase(tables.evaluations, "final")
    if last is None:
        return "The run is not complete."
    after = f"after {int(last['env_steps']):,} control steps {_rate(last)}"
    if first is None:
        return f"{after.capitalize()}."
    pairs = _pairs(tables.evaluation_episodes)
    more, low, high = gain(first, last, _phi(pairs) if len(pairs) == int(last["n"]) else 0.0)
    of_same = ""
    if len(pairs) == int(last["n"]):
        won, lost = (sum(pair == kind for pair in pairs) for kind in ((0, 1), (1, 0)))
        of_same = f"; of the same {len(pairs)} scenes {won} succeed only after it, {lost} only before"
    return f"Before practice {_rate(first)}; {after}: {more:+.2f} (95 % {low:+.2f} to {high:+.2f}){of_same}."


def advice(tables: Tables) -> list[str]:
    """Sentences about what the figures of a run speak of; empty where they are silent."""
    return [
        said
        for speaks in (_imitates, _stands, _pushes, _strays, _values, _gains, _rises)
        if (said := speaks(tables)) is not None
    ]


def _imitates(tables: Tables) -> str | None:
    fell = unconverged([row for row in tables.updates if row["env_steps"] == "0"])
    if fell is None:
        return None
    return (
        f"Imitation had not converged: its loss fell by {fell:.0%} in the last tenth of the offline updates; give more "
        "--offline_updates."
    )


def _stands(tables: Tables) -> str | None:
    share = mean(_failed(tables.episodes), "standing")
    if share is None or share <= STANDS:
        return None
    return (
        f"Failed training episodes stand still in {share:.0%} of their steps: to the policy that is a moment of "
        "waiting in the demonstrations. A longer history tells them apart (--policy.frame_stack), and "
        "demonstrations without pauses (cqn-data filter)."
    )


def _pushes(tables: Tables) -> str | None:
    failed, other = (mean(rows, "at_bounds") for rows in (_failed(tables.episodes), _succeeded(tables.episodes)))
    if failed is None or failed <= AT_BOUNDS or failed < TWICE * (other or 0.0):
        return None
    return (
        f"In failed training episodes {failed:.0%} of the actions are at their bounds, in successful ones "
        f"{other or 0.0:.0%}: the demonstrations' range may be too narrow to recover (--policy.action_margin=0.1)."
    )


def _strays(tables: Tables) -> str | None:
    rows = _of_last_phase(tables)
    failed, other = mean(_failed(rows), "distance"), mean(_succeeded(rows), "distance")
    if failed is None or other is None or failed < TWICE * other:
        return None
    return (
        f"Failures go where no demonstration was: {failed:.2f} from the nearest demonstrated state on average, "
        f"successes {other:.2f}. Demonstrations that start or recover there would help, and so would more practice "
        "(--steps)."
    )


def _values(tables: Tables) -> str | None:
    rows = _of_last_phase(tables)
    failed, other = mean(_failed(rows), "q_end"), mean(_succeeded(rows), "q_end")
    if failed is None or other is None or failed < other - TOLD:
        return None
    return (
        f"The critic does not tell failures from successes: mean Q {failed:.2f} in the last third of failures, "
        f"{other:.2f} of successes. RL may weigh too little (--policy.rl_loss_scale, 1 in practice_state), or have "
        "seen too few failures yet."
    )


def _gains(tables: Tables) -> str | None:
    first, last = _phase(tables.evaluations, "offline"), _phase(tables.evaluations, "final")
    if first is None or last is None or float(first["success_rate"]) == 1:
        return None
    pairs = _pairs(tables.evaluation_episodes)
    if gain(first, last, _phi(pairs) if len(pairs) == int(last["n"]) else 0.0)[1] > 0:
        return None
    return (
        f"Before practice {_rate(first)}, after it {_rate(last)}: these episodes alone show no gain, its interval "
        "holds 0; evaluate with more (--eval.final_n_episodes)."
    )


def _rises(tables: Tables) -> str | None:
    rows = tables.episodes
    if len(rows) < 2 * LATELY:
        return None
    begin, end = (np.mean([int(row["success"]) for row in part]) for part in (rows[:LATELY], rows[-LATELY:]))
    if end > begin or end == 1:
        return None
    return f"Training success did not rise: {begin:.2f} over the first {LATELY} episodes, {end:.2f} over the last."


def gain(before: Mapping[str, str], after: Mapping[str, str], phi: float = 0.0) -> tuple[float, float, float]:
    """Difference of two success rates, rows of evaluations.csv, with its 95 % interval (Newcombe 1998).

    phi: correlation of the outcomes where the scenes are the same (his method 10 for paired data); 0: they are not.
    """
    (p, low_p, high_p), (q, low_q, high_q) = (
        [float(row[name]) for name in ("success_rate", "ci_low", "ci_high")] for row in (before, after)
    )
    down = (q - low_q) ** 2 - 2 * phi * (q - low_q) * (high_p - p) + (high_p - p) ** 2
    up = (high_q - q) ** 2 - 2 * phi * (high_q - q) * (p - low_p) + (p - low_p) ** 2
    return q - p, q - p - math.sqrt(down), q - p + math.sqrt(up)


def mean(rows: Rows, name: str) -> float | None:
    """Mean of a column over the rows that have it; None where none has."""
    values = [float(row[name]) for row in rows if row.get(name) not in (None, "", "nan")]
    return float(np.mean(values)) if values else None


def _pairs(rows: Rows) -> list[tuple[int, int]]:
    """Success before and after practice on each scene that both evaluations had."""
    before, after = ({row["scene"]: int(row["success"]) for row in rows if row["phase"] == phase}
                     for phase in ("offline", "final"))  # fmt: skip
    return [(before[scene], after[scene]) for scene in before if scene in after]


def _phi(pairs: Sequence[tuple[int, int]]) -> float:
    """Correlation of paired outcomes, towards 0 by Newcombe's correction for continuity."""
    both, lost, won, none = (sum(pair == kind for pair in pairs) for kind in ((1, 1), (1, 0), (0, 1), (0, 0)))
    product = (both + lost) * (won + none) * (both + won) * (lost + none)
    agreement = float(both * none - lost * won)
    if agreement > 0:
        agreement = max(agreement - len(pairs) / 2, 0.0)
    return agreement / math.sqrt(product) if product else 0.0


def _of_last_phase(tables: Tables) -> Rows:
    """Episodes of the newest evaluation."""
    rows = tables.evaluation_episodes
    return [row for row in rows if (row["phase"], row["env_steps"]) == (rows[-1]["phase"], rows[-1]["env_steps"])]


def _failed(rows: Rows) -> Rows:
    return [row for row in rows if row["success"] == "0"]


def _succeeded(rows: Rows) -> Rows:
    return [row for row in rows if row["success"] == "1"]


def _phase(evaluations: Rows, phase: str) -> Mapping[str, str] | None:
    return next((row for row in reversed(evaluations) if row["phase"] == phase), None)


def _rate(row: Mapping[str, str]) -> str:
    return (
        f"{float(row['success_rate']):.2f} (n={row['n']}, 95 % {float(row['ci_low']):.2f}-{float(row['ci_high']):.2f})"
    )


def _imitation(row: Mapping[str, str]) -> float:
    names = ("bc_dominance_loss", "bc_margin_loss", "bc_action_loss")
    return sum(float(row[name]) for name in names if row.get(name))
