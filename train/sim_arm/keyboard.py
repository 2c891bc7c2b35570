"""A command on a terminal of its own, and a simulated person at its keys: lerobot-record asks for some.

python -m cqn_train.sim_arm.keyboard lerobot-record --robot.type=sim_ur5e --teleop.type=sim_leader ...
"""

import os
import pty
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

__all__ = ["RECORD_KEYS", "Terminal"]

NEXT = b"n"  # lerobot-record's key in a terminal: the episode, or the reset, is over
# What the simulated leader prints, and the key that a person presses then: the task is done, or the arm is home.
RECORD_KEYS: Mapping[str, bytes] = {"sim_leader: home": NEXT, "sim_leader: wait": NEXT}


class Terminal:
    """A command on a terminal of its own, whose lines are read and whose keys are pressed.

    Attributes:
        name: of the command; said: everything it has printed.
        process: the command.
    """

    def __init__(self, command: Sequence[str], folder: Path | None = None) -> None:
        """Start it in `folder` (the present one), without the network and without a display."""
        self.name = command[0]
        self._master, slave = pty.openpty()
        environment = {**os.environ, "HF_HUB_OFFLINE": "1", "DISPLAY": "", "TERM": "dumb"}
        self.process = subprocess.Popen(
            list(command), stdin=slave, stdout=slave, stderr=slave, cwd=folder, env=environment, close_fds=True
        )
        os.close(slave)
        self.said = ""

    def run(self, answers: Mapping[str, bytes], seconds: float) -> int:
        """Press keys at the lines that ask for them; returns the exit code. Raises TimeoutError after `seconds`."""
        deadline, unread = time.monotonic() + seconds, ""
        try:
            while True:
                if time.monotonic() > deadline:
                    self.process.kill()
                    raise TimeoutError(f"{self.name} did not end within {seconds:.0f} s.")
                try:
                    data = os.read(self._master, 4096).decode(errors="replace")
                except OSError:  # the other end is closed
                    return self.process.wait(30)
                self.said += data
                *lines, unread = (unread + data).split("\n")
                for line in lines:
                    for text, key in answers.items():
                        if text in line:
                            os.write(self._master, key)
        finally:
            os.close(self._master)


def main(arguments: Sequence[str]) -> int:
    """Run lerobot-record with its arguments and press its keys; returns its exit code."""
    name, *rest = arguments
    own = Path(sys.executable).parent / name  # beside this Python, whether or not its folder is on the path
    terminal = Terminal([str(own) if own.is_file() else name, *rest])
    try:
        return terminal.run(RECORD_KEYS, 3600.0)
    finally:
        sys.stdout.write(terminal.said)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
