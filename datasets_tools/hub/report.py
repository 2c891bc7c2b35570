"""A push as a person sees it: files that would be sent, and those that were."""

from collections.abc import Mapping

from ..terminal.console import note, result, table
from .client import Sent
from .files import Content, size_of

__all__ = ["megabytes", "show_dry", "show_sent"]

SHOWN = 40  # files named one by one


def show_dry(files: Mapping[str, Content], card: str, repo_id: str) -> None:
    """The card, and a table of what would be sent."""
    result(card)
    sizes = {path: size_of(content) for path, content in files.items()}
    shown: dict[str, list[int]] = {}
    for path, size in sorted(sizes.items()):
        shown.setdefault(path if len(sizes) <= SHOWN else _folder(path), []).append(size)
    rows = [[name, str(len(all_)), f"{sum(all_):,}"] for name, all_ in shown.items()]
    total = ["total", str(len(sizes)), f"{sum(sizes.values()):,}"]
    table(["file" if len(sizes) <= SHOWN else "folder", "files", "bytes"], rows, total)
    result(f"Dry run: nothing was sent to {repo_id}.")


def show_sent(sent: Sent, repo_id: str, what: str) -> None:
    """Print the changes of a push; what: "dataset" or "policy"."""
    if sent.removed:
        some = ", ".join(sent.removed[:3]) + (", …" if len(sent.removed) > 3 else "")
        note(f"Removed {len(sent.removed)} files that the {what} no longer has: {some}; the history keeps them.")
    counts = f"{len(sent.new)} new and {len(sent.changed)} changed files, {megabytes(sent.size)}"
    if not (sent.new or sent.changed or sent.removed):
        counts = "nothing new"
    result(f"Pushed {repo_id}: {counts}; {len(sent.same)} were there already.")


def megabytes(size: int) -> str:
    """Bytes for a person."""
    return f"{size / 1e6:.1f} MB"


def _folder(path: str) -> str:
    return "/".join(path.split("/")[:-1][:2]) + "/" if "/" in path else path
