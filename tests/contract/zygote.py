"""Processes that start at once: a clean process imports everything and forks a copy for each command.

Tests must not fork themselves: they have threads by then, and a copy of a lock that a thread holds is never released.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

SERVE = """
import itertools, json, os, signal, sys
import {preload}
from {module} import main

def child(order):
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os.dup2(1, 2)
    if order["dies_after_save"]:
        from cqn_train import build
        saved, save = itertools.count(1), build.save
        def save_and_die(*args, **kwargs):
            written = save(*args, **kwargs)
            if next(saved) == order["dies_after_save"]:
                os.kill(os.getpid(), signal.SIGKILL)
            return written
        build.save = save_and_die
    return main(order["arguments"])

answers = os.dup(1)
os.write(answers, b"ready\\n")
for line in sys.stdin:
    order = json.loads(line)
    if "wait" in order:
        os.write(answers, b"%d\\n" % os.waitpid(order["wait"], 0)[1])
        continue
    number = os.fork()
    if number == 0:
        code = 1
        try:
            code = child(order)
        finally:
            os._exit(code)
    os.write(answers, b"%d\\n" % number)
"""


class Zygote:
    """Made by `zygote`."""

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self._process = process
        assert self._answer() == "ready"

    def start(self, *arguments: str, dies_after_save: int = 0) -> int:
        """Begin `main(arguments)`; returns the process number."""
        return int(self._ask({"arguments": arguments, "dies_after_save": dies_after_save}))

    def wait(self, number: int) -> int:
        """Wait status of a process, as `os.waitpid` gives it."""
        return int(self._ask({"wait": number}))

    def kill(self, number: int) -> None:
        """Kill it for good and see it gone."""
        os.kill(number, 9)
        self.wait(number)

    def _ask(self, order: dict[str, object]) -> str:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(order) + "\n")
        self._process.stdin.flush()
        return self._answer()

    def _answer(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()


@contextmanager
def zygote(module: str, log: Path, preload: str = "os") -> Iterator[Zygote]:
    """A process that has `module` and `preload` imported and starts `main` as often as asked; stderr goes to `log`."""
    with log.open("wb") as stderr:
        command = [sys.executable, "-c", SERVE.replace("{module}", module).replace("{preload}", preload)]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stderr, text=True)
        try:
            yield Zygote(process)
        finally:
            process.kill()
            process.communicate()
