"""Output for a person: result tables on stdout, progress and notes on stderr, no library chatter."""

import logging
import os
import traceback
import warnings
from collections.abc import Iterable, Sequence

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from lerobot_cqn.errors import CQNError

__all__ = ["Interrupted", "explain", "load_lerobot", "note", "progress", "quiet", "result", "table"]

MAX_ROWS = 40

_state = {"quiet": False}


class Interrupted(KeyboardInterrupt):
    """Ctrl-C after which something was done on purpose; the message says what is on disk now."""


def quiet() -> None:
    """Silence the encoders and libraries below; called before they are imported, since some read it once."""
    _state["quiet"] = True
    os.environ.setdefault("SVT_LOG", "1")
    os.environ.setdefault("HF_DATASETS_DISABLE_PROGRESS_BARS", "1")
    os.environ.setdefault("HF_HUB_DISABLE_PROGRESS_BARS", "1")
    os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")
    logging.disable(logging.ERROR)  # what fails is raised, too
    warnings.simplefilter("ignore")


def load_lerobot() -> None:
    """Import LeRobot's dataset code, which takes seconds, and say so on a terminal."""
    with Console(stderr=True).status("Loading LeRobot …"):
        import av
        import lerobot.datasets.lerobot_dataset  # noqa: F401
    if _state["quiet"]:
        av.logging.set_libav_level(av.logging.PANIC)  # what cannot be read is said by file, episode and frame


def note(message: str) -> None:
    """Print one remark to stderr, where it does not mix with results."""
    Console(stderr=True, highlight=False, soft_wrap=True).print(message, markup=False)


def result(message: str) -> None:
    """Print one line of result to stdout."""
    Console(highlight=False, soft_wrap=True).print(message, markup=False)


def explain(program: str, error: Exception, *, debug: bool = False) -> int:
    """Say in one line why a command ends; returns its exit code: 2 for what its user can mend, 1 for anything else.

    debug: the traceback comes first.
    """
    if debug:
        traceback.print_exception(error)
    text = " ".join(str(error).split()) or type(error).__name__
    if isinstance(error, CQNError | OSError):
        note(f"{program}: error: {text}")
        return 2
    note(f"{program}: unexpected {type(error).__name__}: {text[:300]}" + ("" if debug else " (--debug shows where)"))
    return 1


def progress() -> Progress:
    """Bar with count and time remaining, on stderr; shows nothing when stderr is not a terminal."""
    console = Console(stderr=True)
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )


def table(columns: Sequence[str], rows: Sequence[Iterable[str]], total: Iterable[str] = ()) -> None:
    """Print right-aligned ``rows`` and a ``total`` row, if there is one; beyond 40 rows only 40 are shown."""
    view = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
    for name in columns:
        view.add_column(name, justify="right", no_wrap=True)
    for row in rows[:MAX_ROWS]:
        view.add_row(*map(escape, row))
    if len(rows) > MAX_ROWS:
        view.add_row(*["…"] * len(columns))
    if total := tuple(total):
        view.add_section()
        view.add_row(*map(escape, total), style="bold")
    Console().print(view)
    if len(rows) > MAX_ROWS:
        note(f"{len(rows) - MAX_ROWS} more rows are in the report (--report=FILE).")
