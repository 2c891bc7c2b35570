"""The report of a run, `report.html` in its folder: did practice pay, and what stands against it."""

import base64
import html
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from lerobot_cqn.errors import ConfigError

from .curve import learning_curve
from .metrics import read_rows

__all__ = ["advice", "gain", "unconverged", "write_report"]

type Rows = Sequence[Mapping[str, str]]

FALLING = 0.1  # share by which the imitation loss still fell in the last tenth of the updates: not converged
STANDS = 0.3  # share of the steps of failures from which on standing still is what they fail by
TENTHS = 10
FEW = 20  # rows below which a tenth says nothing
LATELY = 20  # training episodes


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


def advice(episodes: Rows, evaluations: Rows, updates: Rows) -> list[str]:
    """Sentences about what the figures of a run speak of; empty where they are silent."""
    said = []
    offline = [row for row in updates if row["env_steps"] == "0"]
    if (fell := unconverged(offline)) is not None:
        said.append(
            f"Imitation had not converged: its loss fell by {fell:.0%} in the last tenth of the offline updates; give "
            "more --offline_updates."
        )
    failures = [float(row["standing"]) for row in episodes if row["success"] == "0" and row.get("standing")]
    if failures and (share := float(np.mean(failures))) > STANDS:
        said.append(
            f"Failed training episodes stand still in {share:.0%} of their steps: to the policy that is a moment of "
            "waiting in the demonstrations. A longer history tells them apart (--policy.frame_stack), and "
            "demonstrations without pauses (cqn-data filter)."
        )
    first, last = _phase(evaluations, "offline"), _phase(evaluations, "final")
    if first is not None and last is not None and gain(first, last)[1] <= 0 and float(first["success_rate"]) < 1:
        said.append(
            f"Before practice {_rate(first)}, after it {_rate(last)}: these episodes alone show no gain, its "
            "interval holds 0; evaluate with more (--eval.final_n_episodes)."
        )
    if len(episodes) >= 2 * LATELY:
        begin, end = (
            np.mean([int(row["success"]) for row in rows]) for rows in (episodes[:LATELY], episodes[-LATELY:])
        )
        if end <= begin and end < 1:
            said.append(
                f"Training success did not rise: {begin:.2f} over the first {LATELY} episodes, {end:.2f} over the last."
            )
    return said


def gain(before: Mapping[str, str], after: Mapping[str, str]) -> tuple[float, float, float]:
    """Difference of two success rates, rows of evaluations.csv, with its 95 % interval (Newcombe 1998, method 10)."""
    (p, low_p, high_p), (q, low_q, high_q) = (
        [float(row[name]) for name in ("success_rate", "ci_low", "ci_high")] for row in (before, after)
    )
    return q - p, q - p - math.hypot(q - low_q, high_p - p), q - p + math.hypot(high_q - q, p - low_p)


def write_report(output_dir: Path) -> Path | None:
    """Write report.html from the run's tables; None where it was never evaluated and acted in no episode."""
    episodes, evaluations, updates = (
        read_rows(output_dir / f"{table}.csv") for table in ("episodes", "evaluations", "updates")
    )
    if not episodes and not evaluations:
        return None
    path = output_dir / "report.html"
    temporary = path.with_suffix(".tmp")
    temporary.write_text(_page(output_dir, episodes, evaluations, updates), encoding="utf-8")
    temporary.replace(path)
    return path


_STYLE = """
:root { color-scheme: light dark; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 56rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; margin-bottom: .2rem; } h2 { font-size: 1.15rem; margin-top: 2rem; }
.note { opacity: .7; font-size: .9rem; } .lead { font-size: 1.1rem; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; } th, td { padding: .3rem .8rem; text-align: right;
border-bottom: 1px solid #8884; font-variant-numeric: tabular-nums; }
td:first-child, th:first-child { text-align: left; }
img { max-width: 100%; background: #fff; border-radius: 4px; }
.films { display: grid; grid-template-columns: repeat(auto-fill, minmax(12rem, 1fr)); gap: 1rem; }
figure { margin: 0; } video { width: 100%; } figcaption { font-size: .85rem; }
"""


def _page(output_dir: Path, episodes: Rows, evaluations: Rows, updates: Rows) -> str:
    said = "".join(f"<li>{html.escape(sentence)}</li>" for sentence in advice(episodes, evaluations, updates))
    parts = [
        _lead(evaluations),
        _picture(episodes, evaluations) if evaluations else "",
        f"<h2>What the figures say</h2><ul>{said}</ul>" if said else "",
        _table("Evaluations", _EVALUATIONS, evaluations),
        _table("Training episodes", ("", "episodes", "length", "steps that stand still", "mean Q"), _groups(episodes)),
        _films(output_dir),
    ]
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{html.escape(output_dir.name)}</title><style>{_STYLE}</style></head><body>"
        f"<h1>{html.escape(output_dir.name)}</h1>{''.join(parts)}"
        '<p class="note">Made from the tables beside it (docs/metrics.md says what each number is).</p></body></html>\n'
    )


_EVALUATIONS = (
    "phase", "env_steps", "updates", "n", "successes", "success_rate", "ci_low", "ci_high", "mean_length",
    "standing_failures",
)  # fmt: skip


def _lead(evaluations: Rows) -> str:
    first, last = _phase(evaluations, "offline"), _phase(evaluations, "final")
    if last is None:
        return '<p class="lead">The run is not complete.</p>'
    if first is None:
        return f'<p class="lead">After {last["env_steps"]} control steps {_rate(last)}.</p>'
    more, low, high = gain(first, last)
    return (
        f'<p class="lead">Before practice {_rate(first)}; after {last["env_steps"]} control steps {_rate(last)}: '
        f"<b>{more:+.2f}</b> (95 % {low:+.2f} to {high:+.2f}).</p>"
    )


def _picture(episodes: Rows, evaluations: Rows) -> str:
    try:
        picture = base64.b64encode(learning_curve(episodes, evaluations)).decode()
    except ConfigError as error:  # the extra is not installed: the figures are there all the same
        return f'<p class="note">{html.escape(str(error))}</p>'
    return f'<img alt="success over control steps" src="data:image/png;base64,{picture}">'


def _groups(episodes: Rows) -> Rows:
    """One row for the successes and one for the failures among the training episodes."""
    rows = []
    for name, value in (("success", "1"), ("failure", "0")):
        group = [row for row in episodes if row["success"] == value]
        if group:
            rows.append({
                "": name, "episodes": str(len(group)), "length": _mean(group, "length", ".0f"),
                "steps that stand still": _mean(group, "standing", ".0%"), "mean Q": _mean(group, "mean_q", ".3f"),
            })  # fmt: skip
    return rows


def _table(title: str, columns: Sequence[str], rows: Rows) -> str:
    if not rows:
        return ""
    head = "".join(f"<th>{html.escape(name.replace('_', ' '))}</th>" for name in columns)
    body = "".join(
        "<tr>" + "".join(f"<td>{html.escape(row.get(name) or '')}</td>" for name in columns) + "</tr>" for row in rows
    )
    return f'<h2>{title}</h2><div class="scroll"><table><tr>{head}</tr>{body}</table></div>'


def _films(output_dir: Path) -> str:
    """Films of evaluations, failures first; they stay files beside the report."""
    films = sorted(output_dir.glob("videos/*.mp4"), key=lambda path: (path.stem.endswith("success"), path.name))
    shown = "".join(
        f'<figure><video controls preload="metadata" src="videos/{html.escape(path.name)}"></video>'
        f"<figcaption>{html.escape(path.stem.replace('_', ' '))}</figcaption></figure>"
        for path in films
    )
    return f'<h2>Films</h2><div class="films">{shown}</div>' if shown else ""


def _phase(evaluations: Rows, phase: str) -> Mapping[str, str] | None:
    return next((row for row in reversed(evaluations) if row["phase"] == phase), None)


def _rate(row: Mapping[str, str]) -> str:
    return (
        f"{float(row['success_rate']):.2f} (n={row['n']}, 95 % {float(row['ci_low']):.2f}-{float(row['ci_high']):.2f})"
    )


def _mean(rows: Rows, name: str, form: str) -> str:
    values = [float(row[name]) for row in rows if row.get(name) not in (None, "", "nan")]
    return format(float(np.mean(values)), form) if values else ""


def _imitation(row: Mapping[str, str]) -> float:
    names = ("bc_dominance_loss", "bc_margin_loss", "bc_action_loss")
    return sum(float(row[name]) for name in names if row.get(name))
