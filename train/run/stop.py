"""The wish to stop, as a signal says it."""

import contextlib
import os
import signal
import socket
import sys
import threading
from types import FrameType, TracebackType
from typing import Any, Self

__all__ = ["StopRequest"]

ENDING = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)  # a closed terminal is SIGHUP


class StopRequest:
    """Ctrl-C, SIGTERM or a closed terminal once: stop at the next safe point; Ctrl-C or SIGTERM again: at once.

    Use as a context manager in the main thread. Other threads see the wish at once, whatever the main thread is at: it
    may be in a computation that lets no handler run. A signal that is ignored at the start (nohup) stays ignored.
    """

    def __init__(self) -> None:
        self.asked = False
        self._handled = False
        self._before: dict[signal.Signals, Any] = {}
        self._ends: tuple[socket.socket, socket.socket] | None = None
        self._terminals: list[int] = []

    def __enter__(self) -> Self:
        self._terminals = [number for number in (1, 2) if _is_terminal(number)]
        self._ends = socket.socketpair()
        self._ends[1].setblocking(False)
        signal.set_wakeup_fd(self._ends[1].fileno(), warn_on_full_buffer=False)
        threading.Thread(target=self._listen, args=(self._ends[0],), name="signals", daemon=True).start()
        for number in ENDING:
            if signal.getsignal(number) is not signal.SIG_IGN:
                self._before[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(-1)
        for end in self._ends or ():
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)  # the listener wakes up
            end.close()

    def _listen(self, end: socket.socket) -> None:
        """The numbers of signals, as they arrive: written below Python, so also while no handler can run."""
        with contextlib.suppress(OSError):
            while data := end.recv(64):
                self.asked = self.asked or any(number in self._before for number in data)

    def _on_signal(self, number: int, _frame: FrameType | None) -> None:
        closed = number == getattr(signal, "SIGHUP", None)
        if closed:  # what is printed from now on would be an error
            self._leave_terminal()
        elif self._handled:
            raise KeyboardInterrupt
        self.asked = True
        if not self._handled:
            self._handled = True
            with contextlib.suppress(OSError, ValueError):
                print("\nStopping: saving a checkpoint (once more to stop at once) ...", file=sys.stderr)  # noqa: T201

    def _leave_terminal(self) -> None:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for number in self._terminals:
            os.dup2(nowhere, number)
        os.close(nowhere)

    def __call__(self) -> bool:
        """Whether to stop."""
        return self.asked


def _is_terminal(number: int) -> bool:
    try:
        return os.isatty(number)
    except OSError:
        return False
