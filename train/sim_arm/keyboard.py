"""A command on a terminal of its own, and a simulated person at its keys: lerobot-record asks for some.

python -m cqn_train.sim_arm.keyboard lerobot-record --robot.type=sim_ur5e --teleop.type=sim_leader ...
"""

import codecs
import contextlib
import os
import pty
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

__all__ = ["NEXT", "RECORD_KEYS", "Terminal", "own_program"]

LOOK_S = 0.02  # between two looks at what it has said
NEXT = b"n"  # lerobot-record's key in a terminal: the episode, or the reset, is over
# What the simulated leader prints, and the key that a person presses then: the task is done, or the arm is home.
RECORD_KEYS: Mapping[str, bytes] = {"sim_leader: home": NEXT, "sim_leader: wait": NEXT}


class Terminal:
    """A command on a terminal of its own, whose lines are read and whose keys are pressed.

    Attributes:
        name: of the command; said: everything it has printed.
        process: the command.
    """

    def __init__(
        self, command: Sequence[str], folder: Path | None = None, environment: Mapping[str, str] | None = None
    ) -> None:
        """Start it in `folder` (the present one), without the network and without a display."""
        self.name = command[0]
        self._master, slave = pty.openpty()
        self.process = subprocess.Popen(
            list(command), stdin=slave, stdout=slave, stderr=slave, cwd=folder, close_fds=True,
            env={**os.environ, **(environment or {}), "HF_HUB_OFFLINE": "1", "DISPLAY": "", "TERM": "dumb"},
        )  # fmt: skip
        os.close(slave)
        self.said, self._heard = "", 0
        self._reader = threading.Thread(target=self._read, name="terminal", daemon=True)
        self._reader.start()

    def press(self, keys: bytes) -> None:
        """Press keys; does nothing where the command has ended."""
        with contextlib.suppress(OSError):
            os.write(self._master, keys)

    def hears(self, text: str, seconds: float = 90.0) -> None:
        """Wait until it says something that was not heard before.

        Raises:
            TimeoutError: it did not within so many seconds.
            ChildProcessError: it ended without.
        """
        deadline = time.monotonic() + seconds
        while (place := self.said.find(text, self._heard)) < 0:
            over = not self._reader.is_alive()  # asked first: it may say something meanwhile
            if over and text not in self.said[self._heard :]:
                raise ChildProcessError(f"{self.name} ended without '{text}': {self.said[-2000:]}")
            if time.monotonic() > deadline:
                raise TimeoutError(f"{self.name} did not say '{text}' within {seconds:.0f} s: {self.said[-2000:]}")
            time.sleep(LOOK_S)
        self._heard = place + len(text)

    def ends(self, seconds: float) -> int:
        """Wait for its end; returns the exit code. Raises TimeoutError after `seconds`, when it is killed."""
        try:
            return self.process.wait(seconds)
        except subprocess.TimeoutExpired as error:
            self.process.kill()
            raise TimeoutError(f"{self.name} did not end within {seconds:.0f} s.") from error
        finally:
            self._reader.join(5)

    def run(self, answers: Mapping[str, bytes], seconds: float) -> int:
        """Press keys at the lines that ask for them; returns the exit code. Raises TimeoutError after `seconds`."""
        deadline, seen = time.monotonic() + seconds, 0
        while self._reader.is_alive() and time.monotonic() < deadline:
            time.sleep(LOOK_S)
            *lines, rest = (new := self.said[seen:]).split("\n")
            seen += len(new) - len(rest)
            for line in lines:
                for text, key in answers.items():
                    if text in line:
                        self.press(key)
        return self.ends(max(deadline - time.monotonic(), 0.0))

    def _read(self) -> None:
        decoder = codecs.getincrementaldecoder("utf-8")(errors="replace")
        with contextlib.suppress(OSError):  # the other end is closed
            while data := os.read(self._master, 4096):
                self.said += decoder.decode(data)
        os.close(self._master)


def own_program(name: str) -> str:
    """A command beside this Python, whether or not its folder is on the path; else its name."""
    own = Path(sys.executable).parent / name
    return str(own) if own.is_file() else name


def main(arguments: Sequence[str]) -> int:
    """Run lerobot-record with its arguments and press its keys; returns its exit code."""
    name, *rest = arguments
    terminal = Terminal([own_program(name), *rest])
    try:
        return terminal.run(RECORD_KEYS, 3600.0)
    finally:
        sys.stdout.write(terminal.said)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
