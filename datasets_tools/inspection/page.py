"""The page of ``cqn-data inspect``: one HTML file that needs nothing beside it, for light and dark, desk and phone."""

import base64
import html
import io
from collections.abc import Callable, Iterable, Sequence

from lerobot_cqn.schema import STATE

from .cameras import CameraLook
from .checks import PAPER_SIZE, Dataset, memory
from .finding import LEVELS, Finding
from .history import FRAMES, STRIDES, History
from .numbers import Dimension, EpisodeNumbers, Numbers
from .sequences import Sequences
from .svg import pauses, spark, still_share, threshold_histogram

__all__ = ["page", "sentence_of_actions", "size_text", "verdict"]

PICTURE = 480  # pixels, the widest a first picture is embedded
MOST_EPISODES = 200
MEANING = {
    "error": "training fails, or learns nothing from this",
    "warning": "training suffers",
    "note": "good to know",
}
STYLE = """
:root { color-scheme: light dark; --paper: #fff; --ink: #1d2126; --soft: #5b6470; --line: #dfe3e8; --card: #f5f7f9;
  --move: #2f6fb3; --still: #c3cad3; --cut: #c2410c; --error: #b91c1c; --warning: #b45309; --note: #4b6b8a; }
@media (prefers-color-scheme: dark) { :root { --paper: #14171b; --ink: #e6e9ed; --soft: #9aa5b1; --line: #2d333b;
  --card: #1d2228; --move: #6aa7e8; --still: #4a535f; --cut: #fb923c; --error: #f87171; --warning: #fbbf24;
  --note: #93b4d4; } }
* { box-sizing: border-box; }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); max-width: 62rem;
  margin: 0 auto; padding: 1rem; overflow-wrap: anywhere; }
h1 { font-size: 1.5rem; margin: .5rem 0 0; } h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; }
p { margin: .4rem 0; } .soft, figcaption { color: var(--soft); font-size: .9rem; }
.findings { list-style: none; padding: 0; display: grid; gap: .5rem; }
.findings li { background: var(--card); border-left: 4px solid var(--note); padding: .5rem .8rem; border-radius: 3px; }
.findings .error { border-color: var(--error); } .findings .warning { border-color: var(--warning); }
.tag { font-size: .78rem; font-weight: 600; color: var(--note); text-transform: uppercase; margin-right: .5rem; }
.error .tag { color: var(--error); } .warning .tag { color: var(--warning); }
.pair { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(20rem, 100%), 1fr)); gap: 1.5rem; }
.pair { align-items: start; }
.pair > *, figure { min-width: 0; margin: 0; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .92rem; width: 100%; overflow-wrap: normal; }
th, td { padding: .28rem .6rem; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap;
  font-variant-numeric: tabular-nums; }
th { font-weight: 600; } th:first-child, td:first-child { text-align: left; padding-left: 0; }
tr.chosen td { font-weight: 700; color: var(--cut); }
svg.plot { width: 100%; max-width: 32rem; height: auto; display: block; }
svg.inline { height: 1.1em; width: 6em; vertical-align: middle; }
svg text { font: 11px system-ui, sans-serif; fill: var(--soft); }
svg text.strong { fill: var(--cut); font-weight: 600; }
.key.move { background: var(--move); } .key.still { background: var(--still); }
rect.move { fill: var(--move); } rect.still { fill: var(--still); } rect.track { fill: var(--line); }
line.axis { stroke: var(--soft); } line.cut { stroke: var(--cut); stroke-width: 1.5; }
.key { display: inline-block; width: .8em; height: .8em; border-radius: 2px; margin: 0 .3em 0 .8em; }
img { width: 100%; max-width: 30rem; height: auto; border-radius: 3px; display: block; }
code { background: var(--card); padding: .1rem .3rem; border-radius: 3px; font-size: .88em; }
figure.below { margin-top: 1.5rem; }
@media (max-width: 40rem) { th, td { padding: .25rem .4rem; } td:first-child { white-space: normal; }
  svg.inline { width: 4em; } }
"""


def page(
    dataset: Dataset,
    numbers: Numbers,
    cameras: Sequence[CameraLook],
    found: Sequence[Finding],
    history: History | None = None,
    sequences: Sequences | None = None,
) -> str:
    """The whole document; every name from the dataset is escaped."""
    name = html.escape(dataset.repo_id)
    body = [
        f"<h1>{name}</h1>",
        f"<p class='soft'>{html.escape(overview(dataset, numbers, cameras))}</p>",
        f"<p><b>{html.escape(verdict(found))}</b></p>",
        _findings(found),
        _pauses(numbers),
        _episodes(dataset, numbers),
        _dimensions(numbers),
        _history(history),
        _sequences(sequences),
        _cameras(cameras),
        _memory(numbers, cameras),
    ]
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>Inspection of {name}</title><style>{STYLE}</style></head><body>\n"
        + "\n".join(part for part in body if part)
        + "\n</body></html>\n"
    )


def overview(dataset: Dataset, numbers: Numbers, cameras: Sequence[CameraLook]) -> str:
    """One line on what the dataset is."""
    state, action = len(numbers.of(STATE)), len(numbers.dimensions) - len(numbers.of(STATE))
    parts = [
        f"{dataset.episodes} episodes",
        f"{numbers.steps} steps",
        f"{dataset.fps} fps ({numbers.steps / dataset.fps:.0f} s)",
        f"{state} state values, {action} action values",
        f"{len(cameras)} camera{'s' if len(cameras) != 1 else ''}",
        *([f"task: {next(iter(numbers.tasks))}"] if len(numbers.tasks) == 1 else []),
    ]
    return ", ".join(parts)


def verdict(found: Sequence[Finding]) -> str:
    """Number of findings of each level, as a sentence."""
    counts = {level: sum(f.level == level for f in found) for level in LEVELS}
    listed = ", ".join(f"{n} {level}{'s' if n != 1 else ''}" for level, n in counts.items() if n)
    start = "Not ready for training" if counts["error"] else "Ready for training"
    return f"{start}: {listed}." if listed else f"{start}: nothing found."


def sentence_of_actions(numbers: Numbers) -> str:
    """Kind of the actions and lag of the arm in a sentence; empty where they cannot be matched with states."""
    follow = numbers.follow
    if follow is None or not numbers.episodes:
        return ""
    kind, lag = follow.kind(), follow.lag()
    what = {
        "absolute": "Actions look like absolute joint positions",
        "delta": "Actions look like joint differences",
        "other": "Actions look neither like joint positions nor like differences",
    }[kind]
    late = ""
    if lag is not None:
        steps = f"{lag[0]} step{'s' if lag[0] != 1 else ''}"
        late = f"; the motion follows the command after {steps} ({lag[0] / follow.fps:.2f} s, r = {lag[1]:.2f})"
    gap = follow.gap()
    off = f"; mean |action - state| is {gap.mean():.3g}, {gap.max():.3g} for the worst joint"
    return f"{what}{late}{off if kind == 'absolute' and len(gap) else ''}."


def size_text(count: int) -> str:
    """Bytes for people."""
    value, unit = float(count), "B"
    for larger in ("KiB", "MiB", "GiB", "TiB"):
        if value < 1000:
            break
        value, unit = value / 1024, larger
    return f"{value:.3g} {unit}"


def _findings(found: Sequence[Finding]) -> str:
    items = "".join(
        f"<li class='{f.level}'><span class='tag' title='{MEANING[f.level]}'>{f.level}</span>"
        f"<b>{html.escape(f.where)}</b><p>{html.escape(f.text)}</p>"
        + (f"<p class='soft'>{html.escape(f.advice)}</p>" if f.advice else "")
        + "</li>"
        for f in found
    )
    return f"<ul class='findings'>{items}</ul>" if items else ""


def _pauses(numbers: Numbers) -> str:
    found = numbers.threshold
    if found is None or not found.steps:
        return ""
    rows = "".join(
        f"<tr{" class='chosen'" if a.threshold == found.threshold else ''}><td>{a.threshold:g}"
        f"{' (suggested)' if a.threshold == found.threshold else ''}</td><td>{still_share(a.share)}</td>"
        f"<td>{a.share:.0%}</td></tr>"
        for a in found.alternatives
    )
    sure = "" if found.clear else " <b>Look at the alternatives before you choose.</b>"
    return f"""<h2>Pauses</h2>
<p>Suggested threshold <b>{found.threshold:g}</b>, in the unit of the joints: {found.share:.0%} of the steps are still.
{html.escape(found.reason)}{sure}</p>
<div class="pair"><figure>{threshold_histogram(found)}<figcaption><span class="key still"></span>still
<span class="key move"></span>moving; the bar at the left holds all that is slower.</figcaption></figure>
<div><table><tr><th>threshold</th><th></th><th>still steps</th></tr>{rows}</table>
<p class="soft">Use it: <code>cqn-data filter --threshold={found.threshold:g}</code></p></div></div>
<figure class="below">{pauses(numbers.episodes)}
<figcaption>Where the episodes stand still, at the suggested threshold.</figcaption></figure>"""


def _episodes(dataset: Dataset, numbers: Numbers) -> str:
    if not numbers.episodes:
        return ""
    fps = dataset.fps
    columns: dict[str, Callable[[EpisodeNumbers], object]] = {
        "episode": lambda e: e.index,
        "steps": lambda e: e.steps,
        "length": lambda e: f"{e.steps / fps:.1f} s",
    }
    if numbers.threshold is not None:
        columns |= {
            "still": lambda e: f"{e.still:.0%}",
            "still at start": lambda e: f"{e.still_start / fps:.1f} s",
            "still at end": lambda e: f"{e.still_end / fps:.1f} s",
        }
    if any(e.gripper_events is not None for e in numbers.episodes):
        columns["gripper moves"] = lambda e: e.gripper_events
    if any(e.success is not None for e in numbers.episodes):
        columns["outcome"] = lambda e: "success" if e.success else "failure"
    columns["jitter"] = lambda e: f"{e.jitter:.1%}"
    head = "".join(f"<th>{name}</th>" for name in columns)
    rows = "".join(_row(value(e) for value in columns.values()) for e in numbers.episodes[:MOST_EPISODES])
    more = len(numbers.episodes) - MOST_EPISODES
    rest = f"<p class='soft'>and {more} more; --json lists all.</p>" if more > 0 else ""
    return f"<h2>Episodes</h2><div class='scroll'><table><tr>{head}</tr>{rows}</table></div>{rest}"


def _dimensions(numbers: Numbers) -> str:
    if not numbers.episodes:
        return ""

    def rows(dimensions: Sequence[Dimension]) -> str:
        return "".join(
            f"<tr><td>{html.escape(d.name)}</td><td>{'never changes' if d.constant else spark(d.histogram)}</td>"
            + "".join(f"<td>{v:.3g}</td>" for v in (d.low, d.inner_low, d.inner_high, d.high))
            + "</tr>"
            for d in dimensions
        )

    head = "<tr><th>name</th><th>distribution</th><th>lowest</th><th>1 %</th><th>99 %</th><th>highest</th></tr>"
    parts = [f"<h2>Actions and states</h2><p>{html.escape(sentence_of_actions(numbers))}</p>"]
    for column in dict.fromkeys(d.column for d in reversed(numbers.dimensions)):
        table = f"<table>{head}{rows(numbers.of(column))}</table>"
        parts.append(f"<p><b>{html.escape(column)}</b></p><div class='scroll'>{table}</div>")
    return "\n".join(parts)


def _history(history: History | None) -> str:
    if history is None:
        return ""
    head = "<tr><th>frames</th>" + "".join(f"<th>{s} step{'s' * (s > 1)} apart</th>" for s in STRIDES) + "</tr>"
    rows = "".join(
        _row([f, *(f"{history.mean(f, s):.1%}" if (f, s) in history.shares else "" for s in STRIDES)]) for f in FRAMES
    )
    note = (
        f"Share of the actions' variance that small regressions on {' and '.join(history.columns)} leave unexplained"
        " on episodes they have not seen. A policy sees frames one step apart (--policy.frame_stack)."
    )
    return (
        f"<h2>History</h2><p class='soft'>{html.escape(note)}</p><div class='scroll'><table>{head}{rows}</table></div>"
    )


def _sequences(sequences: Sequences | None) -> str:
    if sequences is None:
        return ""
    shares = "".join(_row([n, f"{share:.1%}"]) for n, share in sequences.unexplained.items())
    noise = "".join(_row([name, f"{share:.0%}"]) for name, share in sequences.noise.items())
    return (
        f"<h2>Action sequences</h2><p class='soft'>{html.escape(sequences.sentence())}</p><div class='pair'>"
        f"<table><tr><th>actions</th><th>return left unexplained</th></tr>{shares}</table>"
        f"<table><tr><th>action</th><th>noise from step to step</th></tr>{noise}</table></div>"
    )


def _cameras(cameras: Sequence[CameraLook]) -> str:
    if not cameras:
        return ""
    shown = []
    for c in cameras:
        name = html.escape(c.key)
        caption = f"<b>{name}</b>, {c.width} x {c.height}, {c.looked} pictures looked at"
        shown.append(f"<figure>{_picture(c)}<figcaption>{caption}</figcaption></figure>")
    return f"<h2>Cameras</h2><div class='pair'>{''.join(shown)}</div>"


def _picture(camera: CameraLook) -> str:
    from PIL import Image

    if camera.first is None:
        return "<p class='soft'>No picture can be read.</p>"
    picture = Image.fromarray(camera.first)
    picture.thumbnail((PICTURE, PICTURE))
    buffer = io.BytesIO()
    picture.save(buffer, format="JPEG", quality=80)
    encoded = base64.b64encode(buffer.getvalue()).decode()
    return f'<img alt="first picture of {html.escape(camera.key)}" src="data:image/jpeg;base64,{encoded}">'


def _memory(numbers: Numbers, cameras: Sequence[CameraLook]) -> str:
    if not numbers.episodes:
        return ""
    needed = memory(numbers, cameras)
    rows = [_row(("joints, actions, rewards", size_text(needed.vectors)))]
    if cameras:
        rows.append(_row(("pictures as they are", size_text(needed.pictures))))
        rows.append(_row((f"pictures at {PAPER_SIZE} x {PAPER_SIZE}", size_text(needed.pictures_84))))
    note = "What these steps take up in the replay, pauses in; online steps come on top."
    return f"<h2>Memory</h2><p class='soft'>{note}</p><table>{''.join(rows)}</table>"


def _row(cells: Iterable[object]) -> str:
    return "<tr>" + "".join(f"<td>{html.escape(str(c))}</td>" for c in cells) + "</tr>"
