"""A command on some node of a Ray cluster, with the interface of `subprocess.Popen` that `cqn-bench` uses."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lerobot_cqn.errors import ConfigError

__all__ = ["RemoteProcess", "check_shared"]


class Runner:
    """The far side (a Ray actor's class): one command at a time."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def run(self, module: str, arguments: Sequence[str], folder: str, log: str) -> int:
        """Run `python -m module`, from `folder`, with what it prints in `log`; returns its exit code."""
        os.chdir(folder)
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        with Path(log).open("ab") as file:
            self._process = subprocess.Popen(
                [sys.executable, "-m", module, *arguments], stdout=file, stderr=subprocess.STDOUT, env=environment
            )
        return self._process.wait()

    def signal(self, number: int) -> None:
        """Send it a signal."""
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(number)

    def reads(self, path: str) -> str:
        """What a file holds, "" where there is none."""
        return Path(path).read_text() if Path(path).is_file() else ""


class RemoteProcess:
    """`python -m module` on a node with a free processor; waits for one where there is none."""

    def __init__(self, ray: Any, module: str, arguments: Sequence[str], log: Path) -> None:
        methods = {"signal": ray.method(concurrency_group="talk")(Runner.signal)}
        actor = ray.remote(concurrency_groups={"talk": 1})(type("Run", (Runner,), methods))
        self._ray, self._runner = ray, actor.options(num_cpus=1).remote()
        self._code = self._runner.run.remote(module, [*arguments], os.getcwd(), str(log.resolve()))
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """Its exit code; None while it runs, or waits to; that of a kill where its node is gone."""
        if self.returncode is None and self._ray.wait([self._code], timeout=0)[0]:
            try:
                self.returncode = int(self._ray.get(self._code))
            except self._ray.exceptions.RayError:
                self.returncode = -int(signal.SIGKILL)
            self._ray.kill(self._runner)  # its processor is free
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send it a signal."""
        self._runner.signal.remote(number)

    def wait(self, timeout: float) -> int:
        """Its exit code. Raises subprocess.TimeoutExpired."""
        deadline = time.monotonic() + timeout
        while (code := self.poll()) is None:
            if time.monotonic() > deadline:
                raise subprocess.TimeoutExpired("cqn-train", timeout)
            time.sleep(0.1)
        return code

    def kill(self) -> None:
        """End it at once."""
        self._ray.kill(self._runner)
        self.returncode = -int(signal.SIGKILL)


def check_shared(ray: Any, folder: Path) -> None:
    """Every node must see the same folder. Raises ConfigError by the name of one that does not."""
    folder.mkdir(parents=True, exist_ok=True)
    mark = folder / ".shared"
    mark.write_text(str(time.time_ns()))
    runner = ray.remote(num_cpus=0)(Runner)
    affinity = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy
    try:
        for node in (node for node in ray.nodes() if node["Alive"]):
            there = runner.options(scheduling_strategy=affinity(node["NodeID"], soft=False)).remote()
            if ray.get(there.reads.remote(str(mark.resolve()))) != mark.read_text():
                raise ConfigError(
                    f"{node['NodeManagerHostname']} does not see {folder.resolve()}: give an --output_dir on a disk "
                    "that all nodes of the cluster share."
                )
            ray.kill(there)
    finally:
        mark.unlink()
