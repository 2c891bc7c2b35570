"""Progress for a person: a live bar on a terminal, a line now and then in a log."""

import contextlib
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

if TYPE_CHECKING:
    from ..interfaces import Monitor  # which needs PyTorch, and the bench shows progress without

__all__ = ["ConsoleMonitor", "Monitors", "last_line"]

LOG_EVERY_S = 15.0


class ConsoleMonitor:
    """Shows phases, ETA and notes. Use as a context manager."""

    def __init__(self, console: Console | None = None) -> None:
        self.console = console or Console(highlight=False, soft_wrap=True)
        self._bar = Progress(
            TextColumn("{task.description:>8}"),
            BarColumn(bar_width=30),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("eta"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}"),
            console=self.console,
            disable=not self.console.is_terminal,
        )
        self._task: TaskID | None = None
        self._name, self._total, self._note = "", 0, ""
        self._begun, self._first, self._logged = 0.0, 0, 0.0

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def phase(self, name: str, total: int, done: int) -> None:
        """A phase of `total` units begins, `done` of them already behind."""
        self._name, self._total, self._first = name, total, done
        self._begun = self._logged = time.monotonic()
        if self._task is not None:
            self._bar.remove_task(self._task)
            self._task = None
        if total > done:
            self._task = self._bar.add_task(name, total=total, completed=done, note="")

    def advance(self, done: int, note: str) -> None:
        """Progress within the phase; an empty note keeps the last one."""
        self._note = note or self._note
        if self._task is not None:
            self._bar.update(self._task, completed=min(done, self._total), note=self._note)
        now = time.monotonic()
        if not self.console.is_terminal and now - self._logged > LOG_EVERY_S:
            self._logged = now
            left = (now - self._begun) / max(done - self._first, 1) * max(self._total - done, 0)
            part = f"{min(done, self._total)}/{self._total}"
            self.message(f"{self._name:>8}  {part}  eta {left:.0f} s  {self._note}")

    def message(self, text: str) -> None:
        """A line that stays; where whoever read it is gone, the run goes on."""
        with contextlib.suppress(OSError):
            self.console.print(text)


def last_line(log: Path, begin: str = "") -> str:
    """The last line of a command's log that is not blank and begins so; "" where there is none."""
    lines = log.read_text(errors="replace").splitlines() if log.is_file() else []
    return next((line.strip() for line in reversed(lines) if line.strip() and line.strip().startswith(begin)), "")


class Monitors:
    """Several places that show the same progress."""

    def __init__(self, monitors: "Sequence[Monitor]") -> None:
        self.monitors = monitors

    def phase(self, name: str, total: int, done: int) -> None:
        """A phase begins, in every place."""
        for monitor in self.monitors:
            monitor.phase(name, total, done)

    def advance(self, done: int, note: str) -> None:
        """Progress within the phase, in every place."""
        for monitor in self.monitors:
            monitor.advance(done, note)

    def message(self, text: str) -> None:
        """A line that stays, in every place."""
        for monitor in self.monitors:
            monitor.message(text)
