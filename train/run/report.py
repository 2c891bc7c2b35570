"""The report of a run, `report.html` in its folder: did practice pay, and what stands against it."""

import base64
import html
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from lerobot_cqn.errors import ConfigError

from .curve import learning_curve
from .judgement import Rows, Tables, advice, mean, practice, read_tables
from .metrics import FORCES, KINDS

__all__ = ["write_report"]


def write_report(output_dir: Path) -> Path | None:
    """Write report.html from the run's tables; None where it was never evaluated and acted in no episode."""
    tables = read_tables(output_dir)
    if not tables.episodes and not tables.evaluations:
        return None
    path = output_dir / "report.html"
    temporary = path.with_suffix(".tmp")
    temporary.write_text(_page(output_dir, tables), encoding="utf-8")
    temporary.replace(path)
    return path


_STYLE = """
:root { color-scheme: light dark; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; margin-bottom: .2rem; } h2 { font-size: 1.15rem; margin-top: 2rem; }
.note { opacity: .7; font-size: .9rem; } .lead { font-size: 1.1rem; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; } th, td { padding: .3rem .8rem; text-align: right;
border-bottom: 1px solid #8884; font-variant-numeric: tabular-nums; }
th { font-weight: 500; opacity: .75; } td.word, th.word { text-align: left; white-space: nowrap; }
img { max-width: 100%; background: #fff; border-radius: 4px; }
.films { display: grid; grid-template-columns: repeat(auto-fill, minmax(12rem, 1fr)); gap: 1rem; }
figure { margin: 0; } video { width: 100%; } figcaption { font-size: .85rem; }
"""


def _page(output_dir: Path, tables: Tables) -> str:
    said = "".join(f"<li>{html.escape(sentence)}</li>" for sentence in advice(tables))
    parts = [
        f'<p class="lead">{html.escape(practice(tables))}</p>',
        _picture(tables.episodes, tables.evaluations) if tables.evaluations else "",
        f"<h2>What the figures say</h2><ul>{said}</ul>" if said else "",
        _table("Evaluations", tuple(_EVALUATIONS), _evaluations(tables.evaluations)),
        _table("How evaluation episodes went, before and after", _GROUPS, _groups(tables.evaluation_episodes)),
        _table("Training episodes", _GROUPS[1:], _outcomes(tables.episodes)),
        _table("What learning lives on", _FORCES, _forces(tables.diagnosis)),
        _films(output_dir),
    ]
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{html.escape(output_dir.name)}</title><style>{_STYLE}</style></head><body>"
        f"<h1>{html.escape(output_dir.name)}</h1>{''.join(parts)}"
        '<p class="note">Made from the tables beside it (docs/metrics.md says what each number is).</p></body></html>\n'
    )


_EVALUATIONS = {
    "phase": ("phase", ""), "step": ("env_steps", ".0f"), "updates": ("updates", ".0f"), "n": ("n", ".0f"),
    "success": ("success_rate", ".2f"), "95 % from": ("ci_low", ".2f"), "to": ("ci_high", ".2f"),
    "length": ("mean_length", ".0f"), "return": ("mean_return", ".3g"),
    "failures stand still": ("standing_failures", ".0%"),
}  # fmt: skip
_GROUPS = (
    "phase", "outcome", "episodes", "length", "stands still", "at bounds", "distance", "Q, first third", "second",
    "last",
)  # fmt: skip
_FORCES = ("phase", "step", "of", "TD error", "RL gradient", "imitation gradient", "share of RL")


def _evaluations(rows: Rows) -> Rows:
    """The figures of each evaluation, rounded for a person."""
    return [
        {title: _figure(mean([row], name), form) if form else row[name] for title, (name, form) in _EVALUATIONS.items()}
        for row in rows
    ]


def _groups(rows: Rows) -> Rows:
    """Successes and each kind of failure in the evaluations before and after practice, the most frequent first."""
    grouped = []
    for phase in ("offline", "final"):
        grouped += [{"phase": phase, **row} for row in _outcomes([row for row in rows if row["phase"] == phase])]
    return grouped


def _outcomes(rows: Rows) -> Rows:
    """One row for the successes and one for each kind of failure (`how`, where the rows have it)."""
    kinds = ["success" if row["success"] == "1" else row.get("how") or "failure" for row in rows]
    found = []
    for kind, count in Counter(kinds).most_common():
        group = [row for row, its in zip(rows, kinds, strict=True) if its == kind]
        columns = (("length", ".0f"), ("standing", ".0%"), ("at_bounds", ".0%"), ("distance", ".2f"),
                   ("q_begin", ".2f"), ("q_middle", ".2f"), ("q_end", ".2f"))  # fmt: skip
        figures = [_figure(mean(group, name), form) for name, form in columns]
        found.append(dict(zip(_GROUPS[1:], (kind, str(count), *figures), strict=True)))
    return found


def _forces(rows: Rows) -> Rows:
    """A row for each kind of transition in the newest diagnosis."""
    if not rows:
        return []
    row, found = rows[-1], []
    for kind in KINDS:
        td, rl, imitation = (mean([row], f"{name}_{kind}") for name in FORCES)
        if rl is not None or imitation is not None:  # else a kind has no transitions
            share = None if rl is None or imitation is None or not rl + imitation else rl / (rl + imitation)
            figures = [_figure(td, ".3f"), _figure(rl, ".3f"), _figure(imitation, ".3f"), _figure(share, ".0%")]
            found.append(dict(zip(_FORCES, (row["phase"], row["env_steps"], kind, *figures), strict=True)))
    return found


def _figure(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


def _picture(episodes: Rows, evaluations: Rows) -> str:
    try:
        picture = base64.b64encode(learning_curve(episodes, evaluations)).decode()
    except ConfigError as error:  # the extra is not installed: the figures are there all the same
        return f'<p class="note">{html.escape(str(error))}</p>'
    return f'<img alt="success over control steps" src="data:image/png;base64,{picture}">'


def _table(title: str, columns: Sequence[str], rows: Rows) -> str:
    if not rows:
        return ""
    head = "".join(f"<th{_word(name)}>{html.escape(name)}</th>" for name in columns)
    body = "".join(
        "<tr>" + "".join(f"<td{_word(name)}>{html.escape(row.get(name) or '')}</td>" for name in columns) + "</tr>"
        for row in rows
    )
    return f'<h2>{title}</h2><div class="scroll"><table><tr>{head}</tr>{body}</table></div>'


def _word(column: str) -> str:
    return ' class="word"' if column in ("phase", "outcome", "of") else ""


def _films(output_dir: Path) -> str:
    """Films of evaluations, failures first and sorted by how they failed; they stay files beside the report."""
    parts = [(path.name, *_film(path.stem)) for path in output_dir.glob("videos/*.mp4")]
    shown = "".join(
        f'<figure><video controls preload="metadata" src="videos/{html.escape(name)}"></video>'
        f"<figcaption>{html.escape(f'{label} ({which})')}</figcaption></figure>"
        for name, which, label in sorted(parts, key=lambda part: (part[2] == "success", part[2], part[1]))
    )
    return f'<h2>Films</h2><div class="films">{shown}</div>' if shown else ""


def _film(stem: str) -> tuple[str, str]:
    """Which film, and how its episode went, of a name as phase_steps_number_label."""
    phase, steps, number, label = stem.split("_", 3)
    return f"{phase}, step {int(steps):,}, episode {number}", label.replace("_", ": ", 1).replace("_", " ")
