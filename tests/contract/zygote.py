"""Processes that start at once: a clean process imports everything and forks a copy for each command.

Tests must not fork themselves: they have threads by then, and a copy of a lock that a thread holds is never released.
"""

import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

SERVE = """
import functools, importlib, importlib.metadata, itertools, json, os, signal, sys
import draccus.wrappers.docstring as texts
import {preload}
# It reads the sources of all options at each parse; the commands of one process need that only once.
texts.get_attribute_docstring = functools.cache(texts.get_attribute_docstring)

def child(order):
    os.chdir(order["folder"])
    os.environ.clear()
    os.environ.update(order["environment"])
    for number, name in ((1, order["out"]), (2, order["err"])):
        os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    sys.argv = [order["command"], *order["arguments"]]
    found = importlib.metadata.entry_points(group="console_scripts", name=order["command"])
    main = next(iter(found)).load()
    if order["dies_after_save"]:
        from cqn_train import build
        saved, save = itertools.count(1), build.save
        def save_and_die(*args, **kwargs):
            written = save(*args, **kwargs)
            if next(saved) == order["dies_after_save"]:
                os.kill(os.getpid(), signal.SIGKILL)
            return written
        build.save = save_and_die
    return main()

answers = os.dup(1)
os.write(answers, b"ready\\n")
for line in iter(sys.stdin.readline, ""):
    order = json.loads(line)
    if "wait" in order:
        os.write(answers, b"%d\\n" % os.waitpid(order["wait"], 0)[1])
        continue
    number = os.fork()
    if number == 0:
        os.close(answers)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        sys.exit(child(order))
    os.write(answers, b"%d\\n" % number)
"""


class Zygote:
    """Made by `zygote`."""

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self._process = process
        assert self._answer() == "ready"

    def start(
        self, command: str, *arguments: str, dies_after_save: int = 0, out: str = os.devnull, err: str = os.devnull
    ) -> int:
        """Begin an installed command, with what it prints in the files `out` and `err`; returns the process number."""
        order = {
            "command": command, "arguments": arguments, "dies_after_save": dies_after_save, "out": out, "err": err,
            "folder": os.getcwd(), "environment": dict(os.environ),
        }  # fmt: skip
        return int(self._ask(order))

    def wait(self, number: int, seconds: float = 400.0) -> int:
        """Wait status of a process, as `os.waitpid` gives it; one that takes longer than so many seconds is killed."""
        self._tell({"wait": number})
        if not select.select([self._process.stdout], [], [], seconds)[0]:
            os.kill(number, 9)
        return int(self._answer())

    def kill(self, number: int) -> None:
        """Kill it for good and see it gone."""
        os.kill(number, 9)
        self.wait(number)

    def _ask(self, order: Mapping[str, object]) -> str:
        self._tell(order)
        return self._answer()

    def _tell(self, order: Mapping[str, object]) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(order) + "\n")
        self._process.stdin.flush()

    def _answer(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()


def wait_until(ready: Callable[[], object], seconds: float = 180.0) -> None:
    """Wait for what another process brings about; however busy the machine."""
    deadline = time.monotonic() + seconds
    while not ready():
        assert time.monotonic() < deadline, "nothing happened"
        time.sleep(0.003)


@contextmanager
def zygote(log: Path, preload: str = "os") -> Iterator[Zygote]:
    """A process that has modules imported and starts commands as often as asked; its own errors go to `log`."""
    with log.open("wb") as stderr:
        command = [sys.executable, "-c", SERVE.replace("{preload}", preload)]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stderr, text=True)
        try:
            yield Zygote(process)
        finally:
            process.kill()
            process.communicate()
