"""What ``meta/cqn_history.json`` holds, told in sentences for people; Markdown that shows any text as it is."""

from collections.abc import Mapping, Sequence
from typing import Any

__all__ = ["code", "plain", "rows_of", "tell", "told"]

MOST = 20  # numbers of episodes named in full


def tell(history: Sequence[Mapping[str, Any]]) -> str:
    """A numbered list in Markdown: each operation as a sentence, with its settings below."""
    if not history:
        return "None is kept: the dataset is as it was recorded, or was prepared by other means."
    lines = []
    for number, entry in enumerate(history, start=1):
        lines.append(f"{number}. **{plain(str(entry.get('operation', '?')))}**: {told(entry)}")
        settings = {k: v for k, v in dict(entry.get("settings") or {}).items() if k not in ("why", "clear")}
        if settings:
            lines.append(f"   Settings: `{code(', '.join(f'{k}={_value(v)}' for k, v in settings.items()))}`")
    return "\n".join(lines) + "\n\nEvery figure is in `meta/cqn_history.json`."


def told(entry: Mapping[str, Any]) -> str:
    """One operation of ``meta/cqn_history.json`` as a sentence with its figures, safe to put into Markdown.

    An entry of an operation that is not known, or one that lacks figures, is told with what it has.
    """
    operation = str(entry.get("operation", ""))
    try:
        sentence = _TELL[operation](entry, dict(entry.get("settings") or {}))
    except (KeyError, TypeError, ValueError, AttributeError, ZeroDivisionError):
        sentence = "Done with the settings below." if entry.get("settings") else "Done."
    left = entry.get("left_out")
    if operation == "filter" and isinstance(left, Mapping):
        sentence += f" Left out {_numbered(list(left))}, of which too little would be left."
    return plain(sentence)


def _record(entry: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    said = f"Recorded scripted demonstrations in an environment until {settings['episodes']} had succeeded"
    return f"{said}; the script pauses in {float(settings.get('pause_share', 0)):.0%} of the time steps."


def _convert(entry: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    total, skipped = entry["total"], entry.get("skipped") or []
    said = f"Converted {entry['source']} from {entry['format']}: {total['episodes']} episodes, {total['steps']} steps"
    return said + (f"; {len(skipped)} could not be taken over." if skipped else ".")


def _filter(entry: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    total = entry["total"]
    gone, pauses = total["steps"] - total["kept"], sum(len(e["pauses"]) for e in entry["episodes"])
    said = (
        f"Left out {gone} of {total['steps']} steps ({gone / total['steps']:.0%}), in {pauses} pauses in which nothing"
    )
    why = f" {str(settings['why']).rstrip('.')}." if settings.get("why") else ""
    return f"{said} moves: below {_value(settings['threshold'])} a step.{why}"


def _trim(entry: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    head, tail = (sum(e[k] for e in entry["episodes"]) for k in ("head", "tail"))
    return f"Cut {head} steps off the starts and {tail} off the ends of {len(entry['episodes'])} episodes."


def _delta(entry: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    if not entry["deltas"]:
        return f"Turned the delta actions of kind {settings['of']} back into absolute ones."
    joints = ", ".join(entry["deltas"]["action"])
    return f"Turned absolute actions into deltas of kind {settings['of']}, of {joints}."


def _resample(entry: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    total = entry["total"]
    rates = f"{settings['fps']} steps a second instead of {settings['from_fps']}"
    return f"Took {rates}: {total['steps']} steps became {total['kept']}."


def _resize(entry: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    size, crop = settings.get("size"), settings.get("crop")
    done = [f"Cut out parts of the pictures ({_value(crop)}: top, left, height, width)"] if crop else []
    done += (
        [f"scaled them to {size[0]}x{size[1]}" if crop else f"Scaled the pictures to {size[0]}x{size[1]}"]
        if size
        else []
    )
    return (", then ".join(done) or "Wrote the pictures anew") + "."


def _label(entry: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    failed = entry["failures"]
    which = f"every episode but {_numbered(failed)}, which failed" if failed else "every episode; all are successes"
    return f"Wrote sparse rewards: 1 on the last step of {which}."


def _bounds(entry: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    inner = f"{100 * float(settings.get('quantile', 0)):.4g}% of the steps left out at either end"
    outer = f"{100 * float(settings.get('margin', 0)):.4g}% of the range added there"
    return f"Set the action bounds of {len(entry['bounds']['low'])} dimensions: {inner}, {outer}."


def _drop(entry: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    dropped = entry["dropped"]
    groups = {why: [i for i in dropped if dropped[i] == why] for why in dropped.values()}
    reasons = "; ".join(f"{why}: {_numbered(episodes)}" for why, episodes in groups.items())
    return (
        f"Dropped {len(dropped)} episode{'s' * (len(dropped) != 1)} ({reasons})." if dropped else "Dropped no episode."
    )


def _skip(entry: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    return f"Left out {_numbered(list(entry['episodes']))}, which could not be read."  # reasons may hold folders


_TELL = {
    "record": _record, "convert": _convert, "filter": _filter, "trim": _trim, "delta": _delta, "resample": _resample,
    "resize": _resize, "label": _label, "bounds": _bounds, "drop": _drop, "skip_bad_episodes": _skip,
}  # fmt: skip


def _numbered(episodes: Sequence[Any]) -> str:
    more = f" and {len(episodes) - MOST} more" if len(episodes) > MOST else ""
    return f"episode{'s' * (len(episodes) != 1)} {', '.join(map(str, episodes[:MOST]))}{more}"


def _value(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value).lower() if isinstance(value, bool) else str(value)


def plain(value: str) -> str:
    """One line that Markdown shows as it is and that closes no marker."""
    line = " ".join(value.split())
    for character, shown in (("&", "&amp;"), ("<", "&lt;"), ("|", "\\|"), ("`", "\\`"), ("*", "\\*"), ("[", "\\[")):
        line = line.replace(character, shown)
    return line


def code(value: str) -> str:
    """One line to stand between backticks."""
    return " ".join(value.replace("`", "'").replace("<!--", "< !--").split())


def rows_of(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown; cells stand as they are."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
