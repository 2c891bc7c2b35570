"""A dataset's history (``meta/cqn_history.json``) in sentences for people; Markdown that shows any text as it is."""

from collections.abc import Mapping, Sequence
from typing import Any

__all__ = ["code", "numbered", "plain", "rows_of", "shown", "tell", "told"]

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
            lines.append(f"   Settings: `{code(', '.join(f'{k}={shown(v)}' for k, v in settings.items()))}`")
    return "\n".join(lines) + "\n\nEvery figure is in `meta/cqn_history.json`."


def told(entry: Mapping[str, Any]) -> str:
    """One operation of ``meta/cqn_history.json`` as a sentence, safe to put into Markdown.

    It is the operation's own, under ``told``; of one that left none there are the settings.
    """
    return plain(str(entry.get("told") or ("Done with the settings below." if entry.get("settings") else "Done.")))


def numbered(episodes: Sequence[Any]) -> str:
    """Episodes by their numbers, the first twenty of them."""
    more = f" and {len(episodes) - MOST} more" if len(episodes) > MOST else ""
    return f"episode{'s' * (len(episodes) != 1)} {', '.join(map(str, episodes[:MOST]))}{more}"


def shown(value: Any) -> str:
    """A setting as it would be given on the command line, numbers to six digits."""
    return f"{value:.6g}" if isinstance(value, float) else str(value).lower() if isinstance(value, bool) else str(value)


def plain(value: str) -> str:
    """One line that Markdown shows as it is and that closes no marker."""
    line = " ".join(value.split())
    for character, escaped in (("&", "&amp;"), ("<", "&lt;"), ("|", "\\|"), ("`", "\\`"), ("*", "\\*"), ("[", "\\[")):
        line = line.replace(character, escaped)
    return line


def code(value: str) -> str:
    """One line to stand between backticks."""
    return " ".join(value.replace("`", "'").replace("<!--", "< !--").split())


def rows_of(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown; cells stand as they are."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
