"""CPU time of the commands' answers: `--help`, and what each says to a mistake on its command line.

python -m benchmarks.answers
"""

import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from rich.console import Console
from rich.table import Table

from cqn_data.operations.registry import OPERATIONS

REPEATS = 3


def commands() -> Iterator[list[str]]:
    """Command lines that end before any work begins."""
    yield ["cqn-data", "--help"]
    yield ["cqn-data", "filtr"]
    for name in OPERATIONS:
        recipe = ["simulation"] if name == "run" else []
        yield ["cqn-data", name, "--help"]
        yield ["cqn-data", name, *recipe]
        yield ["cqn-data", name, *recipe, "--nope=1"]
    yield ["cqn-data", "filter", "--repo_id=a/b", "--threshold=abc"]
    yield ["cqn-data", "record", "--repo_id=a/b", "--env.type=nope"]
    for name in ("cqn-train", "cqn-push", "cqn-bench"):
        yield [name, "--help"]
        yield [name, "--nope=1"]


def cpu_seconds(command: list[str]) -> float:
    """User and system time of one call."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    script = str(Path(sys.executable).parent / command[0])
    subprocess.run([script, *command[1:]], capture_output=True, check=False, env={**os.environ, "HF_HUB_OFFLINE": "1"})
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Print a table, the smallest of three calls each."""
    table = Table("command", "CPU s", box=None)
    for command in commands():
        table.add_row(" ".join(command), f"{min(cpu_seconds(command) for _ in range(REPEATS)):.2f}")
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
