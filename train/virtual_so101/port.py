"""A serial port that is none: a pseudo-terminal with a chain of servos at its far side, in real time."""

import contextlib
import os
import select
import termios
import threading
import time
import tty
from pathlib import Path
from types import TracebackType
from typing import Self

from .chain import Chain

__all__ = ["VirtualPort"]

URGENT = -15  # nice value: a driver waits 50 ms for an answer, and LeRobot's commands do not ask twice
LOOK_S = 0.002  # between two looks at the wire, in which the motors move
RATES = {  # that a terminal has names for: at others nobody answers
    termios.B1000000: 1_000_000, termios.B500000: 500_000, termios.B115200: 115_200, termios.B57600: 57_600,
    termios.B38400: 38_400, termios.B19200: 19_200,
}  # fmt: skip


class VirtualPort:
    """Serves a chain while it is entered.

    link: a name to give the port besides its own, such as /dev/ttyACM7; must not exist.

    Attributes:
        chain: the servos.
        name: path that a driver opens; another one after `unplug` and `plug`.
    """

    def __init__(self, chain: Chain, link: Path | None = None) -> None:
        self.chain, self.link = chain, link
        self.name = ""
        self._ends: tuple[int, int] | None = None
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        self.plug()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.unplug()

    def plug(self) -> None:
        """Make the port, where there is none; the motors move from now on."""
        if self._ends is not None:
            return
        near, far = os.openpty()
        tty.setraw(far)
        os.set_blocking(near, False)
        self._ends, self.name = (near, far), os.ttyname(far)
        if self.link is not None:
            self.link.symlink_to(self.name)
        self._closing.clear()
        self._thread = threading.Thread(target=self._run, args=(near, far), name="virtual-port", daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        """Take the port away, as a cable that is pulled out does; may be called again."""
        if self._thread is None or self._ends is None:
            return
        self._closing.set()
        self._thread.join()
        if self.link is not None:
            self.link.unlink(missing_ok=True)
        for end in self._ends:
            os.close(end)
        self._thread = self._ends = None

    def _run(self, near: int, far: int) -> None:
        with contextlib.suppress(OSError, AttributeError):  # servos do not wait for a busy machine; needs the right to
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), URGENT)
        late: list[tuple[float, bytes]] = []
        before = time.monotonic()
        while not self._closing.is_set():
            ready = select.select([near], [], [], LOOK_S)[0]
            now = time.monotonic()
            self.chain.tick(now - before)
            before = now
            data = b""
            if ready:
                with contextlib.suppress(OSError):
                    data = os.read(near, 4096)
            answers = self.chain.take(data, RATES.get(termios.tcgetattr(far)[5], 0)) if data else []
            late += [(now + after, said) for after, said in answers if after]
            due = [said for after, said in answers if not after] + [said for at, said in late if at <= now]
            late = [(at, said) for at, said in late if at > now]
            if due:
                with contextlib.suppress(OSError):  # nobody reads, and the buffer is full
                    os.write(near, b"".join(due))
