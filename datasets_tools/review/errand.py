"""The recipe carried out: ``cqn-data run`` in a process of its own, whose words the page shows."""

import subprocess
import sys
import threading
from collections import deque
from collections.abc import Sequence

__all__ = ["Errand"]

SHOWN = 200  # lines
PATIENCE_S = 20.0  # for a command that tidies up after a stop


class Errand:
    """One command at a time, with its last lines."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._lines: deque[str] = deque(maxlen=SHOWN)

    @property
    def code(self) -> int | None:
        """Exit code of the last command; None while it runs, or where none was started."""
        return None if self._process is None else self._process.poll()

    @property
    def running(self) -> bool:
        """Whether a command is at work."""
        return self._process is not None and self._process.poll() is None

    @property
    def lines(self) -> list[str]:
        """Its last lines."""
        return list(self._lines)

    def start(self, arguments: Sequence[str]) -> None:
        """Start `cqn-data ARGUMENTS`; a command that is at work must have ended."""
        self._lines.clear()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "cqn_data.cli", *arguments],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace",
        )  # fmt: skip
        threading.Thread(target=self._read, args=(self._process,), daemon=True).start()

    def stop(self) -> None:
        """End the command, which leaves nothing half written."""
        if self._process is not None and self.running:
            self._process.terminate()
            try:
                self._process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                self._process.kill()

    def _read(self, process: subprocess.Popen[str]) -> None:
        for line in process.stdout or ():
            self._lines.append(line.rstrip())
        process.wait()
