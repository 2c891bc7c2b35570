"""A plan of `cqn-bench` and its runs, each a process of `cqn-train` that is judged by what it leaves on disk."""

import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import yaml

from lerobot_cqn.errors import ConfigError, one_of

from ..run.metrics import read_rows
from ..run.progress import last_line

__all__ = ["Begin", "Plan", "Run", "begin_here", "load_plan", "runs_of"]


@dataclass(frozen=True)
class Plan:
    """Runs to make: arguments of `cqn-train` by method and by task, seeds, and what all have in common."""

    methods: Mapping[str, Sequence[str]]
    tasks: Mapping[str, Sequence[str]]
    seeds: Sequence[int]
    common: Sequence[str] = ()
    score: str = "success_rate"

    @property
    def digits(self) -> int:
        """Decimals of a score in tables."""
        return 2 if self.score == "success_rate" else 0


@dataclass
class Run:
    """One training run and how far it is."""

    task: str
    method: str
    seed: int
    folder: Path
    arguments: list[str]
    state: str = "waiting"
    process: "Process | None" = field(default=None, repr=False)

    def rows(self) -> list[dict[str, str]]:
        """Its evaluations so far."""
        return read_rows(self.folder / "evaluations.csv")

    def last_words(self) -> str:
        """Last line of its log, and where it is."""
        path = self.folder.with_suffix(".log")
        said = last_line(path)
        return f"{said} (log: {path})" if said else f"see {path}"

    @property
    def done(self) -> bool:
        """Whether it has its final evaluation."""
        return any(row["phase"] == "final" for row in self.rows())

    def start(self, begin: "Begin") -> None:
        """Begin, or continue from its last checkpoint; what it prints goes to a log beside its folder."""
        resumes = (self.folder / "checkpoints" / "last").exists()
        target = [f"--output_dir={self.folder}"]
        arguments = ["--resume=true", *target] if resumes else [*self.arguments, *target]
        self.folder.parent.mkdir(parents=True, exist_ok=True)
        self.process = begin("cqn_train.cli", arguments, self.folder.with_suffix(".log"))
        self.state = "running"

    def look(self) -> None:
        """Notice that it has ended."""
        if self.process is None or self.process.poll() is None:
            return
        code = self.process.returncode
        self.state = "done" if code == 0 and self.done else "stopped" if code == 130 else "failed"
        self.process = None


class Process(Protocol):
    """A run's process, here or on another machine, as `subprocess.Popen` has it."""

    returncode: int | None

    def poll(self) -> int | None:
        """Exit code; None while it runs."""
        ...

    def send_signal(self, sig: int) -> None:
        """Send it a signal."""
        ...

    def wait(self, timeout: float) -> int:
        """Exit code. Raises subprocess.TimeoutExpired."""
        ...

    def kill(self) -> None:
        """End it at once."""
        ...


Begin = Callable[[str, Sequence[str], Path], Process]


def begin_here(module: str, arguments: Sequence[str], log: Path) -> "subprocess.Popen[bytes]":
    """`python -m module` in a process of this machine, with what it prints in a log."""
    command = [sys.executable, "-m", module, *arguments]
    with log.open("ab") as file:
        return subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT, start_new_session=True)


def load_plan(path: Path) -> Plan:
    """Read a plan. Raises ConfigError when it is not there or not of the form that `HELP` shows."""
    if not path.is_file():
        raise ConfigError(f"No plan at {path}: give a YAML file, as cqn-bench --help shows.")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not YAML: {' '.join(str(error).split())}") from error
    keys = ("common", "methods", "tasks", "seeds", "score")
    if not isinstance(content, Mapping):
        raise ConfigError(f"{path}: expected the keys {', '.join(keys)}.")
    for key in content:
        if key not in keys:
            raise ConfigError(f"{path}: " + one_of("key", str(key), keys))
    plan = Plan(content.get("methods") or {}, content.get("tasks") or {}, content.get("seeds") or [],
                content.get("common") or [], content.get("score", "success_rate"))  # fmt: skip
    for name in ("methods", "tasks"):
        table: Any = getattr(plan, name)
        if not isinstance(table, Mapping) or not table or not all(_flags(flags) for flags in table.values()):
            raise ConfigError(f"{path}: expected {name} as NAME: [--flag=value, …], at least one.")
        for entry in table:
            if not str(entry).replace("_", "").replace("-", "").replace(".", "").isalnum():
                raise ConfigError(f"{path}: '{entry}' becomes a folder: expected letters, digits, '_', '-' and '.'.")
    if not _flags(plan.common):
        raise ConfigError(f"{path}: expected common as a list of --flag=value.")
    if plan.score not in (valid := ("success_rate", "mean_return")):
        raise ConfigError(f"{path}: " + one_of("score", str(plan.score), valid))
    whole = isinstance(plan.seeds, list) and all(type(seed) is int and seed >= 0 for seed in plan.seeds)
    if not plan.seeds or not whole or len(set(plan.seeds)) < len(plan.seeds):
        raise ConfigError(f"{path}: expected seeds as a list of different whole numbers, got {plan.seeds}.")
    return plan


def runs_of(plan: Plan, folder: Path) -> list[Run]:
    """All runs, seeds first, so that every method has a first result early."""
    runs = []
    for seed in plan.seeds:
        for task, of_task in plan.tasks.items():
            for method, of_method in plan.methods.items():
                arguments = [*plan.common, *of_method, *of_task, f"--seed={seed}"]
                runs.append(Run(task, method, seed, folder / task / method / str(seed), arguments))
    return runs


def _flags(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(v, str) and v.startswith("--") for v in value)
