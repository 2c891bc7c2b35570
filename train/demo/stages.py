"""Commands one after the other, each with its output in a log; what is done is not done again."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import draccus
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from cqn_data.terminal.console import explain
from lerobot_cqn.errors import CQNError

from ..run.progress import last_line

__all__ = ["DemoError", "Stages", "Watched", "await_end", "fresh", "run_once"]

LOG_EVERY_S = 30.0  # between lines where there is no terminal for a bar


class Terminated(KeyboardInterrupt):
    """SIGTERM came."""


class DemoError(CQNError):
    """A command of the demo failed; the message names its log."""


@dataclass(frozen=True, kw_only=True)
class Watched:
    """A running command, and how far it is: `progress` gives the units done of `total`, and a note."""

    process: subprocess.Popen[bytes]
    text: str
    total: int
    progress: Callable[[], tuple[int, str]]


class Stages:
    """Runs commands with their output in a log, one line on the terminal each, skipping what is done."""

    def __init__(self, folder: Path, console: Console) -> None:
        self.folder, self.console = folder, console
        self.logs = folder / "logs"
        self.logs.mkdir(parents=True, exist_ok=True)
        self.environment = os.environ | {
            "HF_HUB_OFFLINE": "1",
            "OMP_NUM_THREADS": "1",
            "TOKENIZERS_PARALLELISM": "false",
        }

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Note how long this start worked; `seconds` adds up all starts."""
        begun = time.monotonic()
        try:
            yield
        finally:
            with (self.logs / "seconds.txt").open("a") as file:
                file.write(f"{time.monotonic() - begun:.1f}\n")

    def seconds(self) -> float:
        """Working time of this and of interrupted starts."""
        return sum(float(line) for line in (self.logs / "seconds.txt").read_text().split())

    def start(self, name: str, module: str, *arguments: str) -> subprocess.Popen[bytes]:
        """Start `python -m module arguments` with its output in logs/name.log."""
        with (self.logs / f"{name}.log").open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", module, *arguments], stdout=log, stderr=subprocess.STDOUT, env=self.environment
            )

    def check(self, name: str, code: int) -> None:
        """Raise DemoError with the last line of the log when a command failed."""
        if code:
            log = self.logs / f"{name}.log"
            raise DemoError(
                f"'{name}' failed with exit code {code}: {last_line(log) or 'no output'} (all of it in {log})"
            )

    def run(self, name: str, text: str, target: Path, module: str, *arguments: str) -> None:
        """Run a command that makes the folder `target`, unless an earlier start has finished it."""
        begun, finished = time.monotonic(), self.logs / f"{name}.done"
        if finished.exists():
            self.console.print(f"  {text:<58} already done")
            return
        fresh(target)
        with self.console.status(f"  {text}"):
            process = self.start(name, module, *arguments)
            try:
                code = process.wait()
            except KeyboardInterrupt as stop:
                await_end(process, stop)
                raise
            self.check(name, code)
        finished.touch()
        self.console.print(f"  {text:<58} {time.monotonic() - begun:5.0f} s")

    def watch(self, running: Mapping[str, Watched]) -> None:
        """Show a bar for each command until all have ended. Raises DemoError when one has failed."""
        columns = (
            TextColumn("  {task.description:<26}"), BarColumn(bar_width=24), TimeElapsedColumn(), TextColumn("eta"),
            TimeRemainingColumn(), TextColumn("{task.fields[note]}"),
        )  # fmt: skip
        told = time.monotonic()
        with Progress(*columns, console=self.console) as bars:
            tasks = {name: bars.add_task(one.text, total=one.total, note="") for name, one in running.items()}
            try:
                while any(one.process.poll() is None for one in running.values()):
                    tell = not self.console.is_terminal and time.monotonic() - told > LOG_EVERY_S
                    for name, one in running.items():
                        done, note = one.progress()
                        bars.update(tasks[name], completed=done, note=note)
                        if tell:
                            self.console.print(f"  {one.text:<26} {done}/{one.total}  {note}")
                    told = time.monotonic() if tell else told
                    time.sleep(1.0)
            except KeyboardInterrupt as stop:
                for one in running.values():
                    await_end(one.process, stop)
                raise
        for name, one in running.items():
            self.check(name, one.process.returncode)


def await_end(process: subprocess.Popen[bytes], stop: KeyboardInterrupt) -> None:
    """Wait until a command has tidied up: Ctrl-C at the terminal has reached it, too; SIGTERM is handed on."""
    if isinstance(stop, Terminated):
        process.terminate()
    process.wait()


def fresh(run: Path) -> Path:
    """Move what a cut-off start has left out of the way."""
    if run.exists():
        run.rename(run.with_name(f"{run.name}-unfinished-{int(time.time())}"))
    return run


def _terminated(number: int, frame: FrameType | None) -> None:
    raise Terminated


def run_once(
    name: str,
    kind: type,
    introduction: str,
    run: Callable[[Any, Console], dict[str, Any]],
    show: Callable[[dict[str, Any], Any, Console], None],
) -> int:
    """A demo as a command, with settings `kind` from the command line; what it has finished is only shown again.

    Returns 0, 2 for an error of the user's or of a command, 130 after an interrupt.
    """
    console = Console(highlight=False)
    signal.signal(signal.SIGTERM, _terminated)
    try:
        config: Any = draccus.parse(kind)
        finished = config.output_dir / "summary.json"
        if finished.exists():
            console.print(f"Already done; delete {config.output_dir} to run it again.")
            summary = json.loads(finished.read_text())
        else:
            console.print(introduction, soft_wrap=True)
            summary = run(config, console)
        show(summary, config, console)
    except KeyboardInterrupt:
        console.print("Stopped; start it again to continue.")
        return 130
    except CQNError as error:
        return int(explain(name, error))
    return 0
