"""Wheel and sdist, installed into empty environments and tried there: `make release-check` (needs the network).

python -m tests.release.check [--only NAME ...] [--keep_page]

One environment at a time, removed afterwards; about 6 GB of disk while it is there. Prints a table, and writes what
was tried into docs/compatibility.md; exit status 1 where something failed.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ..foreign_formats import write_robomimic, write_zarr
from ..toy_datasets import make_dataset
from . import smoke
from .build import SETTINGS, build, clean_copy, different_files, sdist_problems, unpack, wheel_problems
from .document import read_section, write_section
from .environments import Environment, FailureError, uv
from .extras import EXTRAS, PROBES, missing_line

NOT_FOR_USERS = ("dev", "docs")
OTHER_PYTHON = "3.13"
NOT_THERE = ("aloha", "dmc", "gyms")  # dm-control needs labmaze, which has no wheel for it
SHOWN = ("lerobot", "torch", "numpy")

Check = tuple[str, Callable[[], str]]


@dataclass
class Result:
    """What came of one environment: (check, what it said, whether it failed) in order."""

    name: str
    versions: str = ""
    checks: list[tuple[str, str, bool]] = field(default_factory=list)

    @property
    def failed(self) -> list[str]:
        """Names of the checks that failed."""
        return [name for name, _, failed in self.checks if failed]


@dataclass
class Case:
    """An environment to be made: its requirement, Python and constraints, and the checks that run in it."""

    name: str
    requirement: str
    checks: Callable[[Environment], list[Check]]
    python: str = ""
    constraints: str = ""


class Plan:
    """Distributions, small inputs, and the cases that use them."""

    def __init__(self, folder: Path) -> None:
        """Build everything in `folder`."""
        self.folder = folder
        self.inputs = folder / "inputs"
        self.source = clean_copy(self.inputs / "source")
        self.wheel = build(self.source, "wheel", folder / "wheel")
        self.sdist = build(clean_copy(folder / "for_sdist"), "sdist", folder / "sdist")
        self.user_extras = [name for name in EXTRAS if name not in NOT_FOR_USERS]
        make_dataset(self.inputs / "toy")
        write_robomimic(self.inputs / "small.hdf5")
        write_zarr(self.inputs / "small.zarr")

    def contents(self) -> Result:
        """What the two distributions hold, and that the sdist builds the same wheel."""

        def again() -> str:
            built = build(unpack(self.sdist, self.folder / "unpacked"), "wheel", self.folder / "again")
            if different := different_files(self.wheel, built):
                raise FailureError(f"other files in the wheel that the sdist builds: {different}")
            return "the same, file by file"

        return _tried(
            Result("the distributions"),
            [
                ("wheel", lambda: _none(wheel_problems(self.wheel, self.source))),
                ("sdist", lambda: _none(sdist_problems(self.sdist, self.source))),
                ("wheel from the sdist", again),
            ],
        )

    def cases(self) -> list[Case]:
        """All environments, the cheap ones first."""
        project = SETTINGS["project"]["name"]
        found = [
            Case("wheel, no extra", str(self.wheel), self._without_extras),
            Case("sdist, no extra", str(self.sdist), self._basics),
        ]
        every = f"{project}[{','.join(self.user_extras)}] @ {self.wheel.as_uri()}"
        found.append(
            Case(
                "lowest versions",
                every,
                self._everything(self.user_extras),
                constraints=self._pins("lowest-direct", self.user_extras),
            )
        )
        if other := other_python():
            names = [name for name in self.user_extras if name not in NOT_THERE]
            wanted = f"{project}[{','.join(names)}] @ {self.wheel.as_uri()}"
            found.append(Case(f"Python {OTHER_PYTHON}", wanted, self._everything(names), python=other))
        found += [
            Case(f"wheel [{name}]", f"{project}[{name}] @ {self.wheel.as_uri()}", self._extra(name)) for name in PROBES
        ]
        return found

    def lerobot_range(self) -> tuple[str, str]:
        """The lowest and the newest LeRobot that pyproject.toml allows and the registry has."""
        found = []
        for resolution in ("lowest-direct", "highest"):
            pins = Path(self._pins(resolution, [])).read_text(encoding="utf-8")
            found.append(re.findall(r"^lerobot(?:\[.*\])?==(\S+)", pins, re.MULTILINE)[0])
        return found[0], found[1]

    def _pins(self, resolution: str, extras: Sequence[str]) -> str:
        """Write the versions that a resolution picks to a file; returns its path."""
        target = self.folder / f"{resolution}-{len(extras)}.txt"
        if not target.exists():
            options = [option for name in extras for option in ("--extra", name)]
            uv(
                "pip", "compile", "--quiet", str(self.source / "pyproject.toml"), *options, "--python", sys.executable,
                f"--resolution={resolution}", "--no-header", "--no-annotate", "--no-emit-index-url",
                "--no-emit-find-links", "--output-file", str(target),
            )  # fmt: skip
        # An extra is no part of a constraint.
        target.write_text(re.sub(r"\[.*?\]", "", target.read_text(encoding="utf-8")), encoding="utf-8")
        return str(target)

    def _basics(self, environment: Environment) -> list[Check]:
        return [
            ("pip check", environment.check),
            ("discovery", lambda: smoke.discovery(environment)),
            ("--help", lambda: smoke.helps(environment, self.wheel)),
            ("types", lambda: smoke.types(environment)),
            ("policy", lambda: smoke.bare_policy(environment)),
        ]

    def _without_extras(self, environment: Environment) -> list[Check]:
        lines = [
            (f"without [{name}]", lambda name=name: missing_line(environment, self.inputs, name)) for name in PROBES
        ]
        return self._basics(environment) + lines

    def _extra(self, name: str) -> Callable[[Environment], list[Check]]:
        return lambda environment: [
            ("pip check", environment.check),
            (f"[{name}]", lambda: PROBES[name].works(environment, self.inputs)),
        ]

    def _everything(self, names: Sequence[str]) -> Callable[[Environment], list[Check]]:
        return lambda environment: self._basics(environment) + [
            (f"[{name}]", lambda name=name: PROBES[name].works(environment, self.inputs))
            for name in names if name != "gyms"  # all the others, once more
        ]  # fmt: skip


def other_python() -> str:
    """Path of an interpreter of the other Python version, on the path or of pyenv; nothing where there is none."""
    versions = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    for path in (f"python{OTHER_PYTHON}", *map(str, sorted(versions.glob(f"{OTHER_PYTHON}*/bin/python")))):
        if not (found := shutil.which(path)):
            continue
        probe = [found, "-c", "import ssl, sys; print(sys.version)"]  # a shim is there also where it does not work
        done = subprocess.run(probe, capture_output=True, text=True, check=False, timeout=60)
        if not done.returncode and done.stdout.startswith(OTHER_PYTHON):
            return found
    return ""


def run_case(case: Case, environment: Environment, console: Console) -> Result:
    """Make the environment, run its checks, remove it."""
    result = Result(case.name)
    constraints = ("--constraint", case.constraints) if case.constraints else ()
    with console.status(f"{case.name}: installing"):
        try:
            environment.make(case.python or sys.executable, [case.requirement], *constraints)
        except FailureError as error:
            result.checks.append(("installation", str(error), True))
            return result
    try:
        versions = environment.versions()
        python = environment.succeed("python", "-c", "import platform; print(platform.python_version())").strip()
        result.versions = ", ".join([f"Python {python}", *(f"{name} {versions[name]}" for name in SHOWN)])
        return _tried(result, case.checks(environment), console)
    finally:
        environment.remove()


def _tried(result: Result, checks: Sequence[Check], console: Console | None = None) -> Result:
    for name, check in checks:
        if console is not None:
            console.print(f"{result.name}: {name}", style="dim", markup=False, highlight=False)
        try:
            result.checks.append((name, check(), False))
        except (FailureError, OSError, RuntimeError, subprocess.TimeoutExpired) as error:
            result.checks.append((name, str(error), True))
            if console is not None:
                console.print(f"  {error}", markup=False)
    return result


def _none(problems: list[str]) -> str:
    if problems:
        raise FailureError("; ".join(problems))
    return "nothing missing, nothing else"


def table(results: Sequence[Result]) -> Table:
    """The results for the terminal."""
    made = Table("environment", "tried", "outcome", show_lines=False)
    for result in results:
        for row, (name, said, failed) in enumerate(result.checks):
            outcome = f"[red]FAILS[/red] {escape(said)}" if failed else escape(said)
            made.add_row(escape(result.name) if row == 0 else "", escape(name), outcome)
        made.add_row("", "", f"[dim]{result.versions}[/dim]", end_section=True)
    return made


def section(
    results: Sequence[Result], lerobot: tuple[str, str], python_found: bool, before: Sequence[str] = ()
) -> list[str]:
    """The same in Markdown, shorter: one line for an environment; environments not run keep their line of `before`."""
    rows = {line.split("|")[1].strip(): line for line in before if line.startswith("| ")}
    for result in results:
        tried = []
        for name, outcome, failed in result.checks:
            said = " ".join(outcome.replace("|", "/").split())
            tried.append(f"**{name} fails**: {said}" if failed else _short(name, said))
        without = [part.removeprefix("without ") for part in tried if part.startswith("without ")]
        tried = [part for part in tried if not part.startswith("without ")]
        tried += [f"one line names the missing extra: {', '.join(without)}"] if without else []
        tried = [part for part in tried if part]
        rows[result.name] = f"| {result.name} | {result.versions or '–'} | {'; '.join(tried)} |"
    rows.pop("environment", None)
    lines = ["| environment | installed | tried there |", "|---|---|---|", *rows.values()]
    low, high = lerobot
    newest = "which is also the newest that the range allows" if low == high else f"the newest is {high}"
    wanted = next(line for line in SETTINGS["project"]["dependencies"] if line.startswith("lerobot"))
    lines += ["", f"`{wanted}`: the lowest is {low}, {newest}."]
    lines += [
        "*Lowest versions*: every package that `pyproject.toml` names, at the lowest version that it allows; the others"
    ]
    lines += ["at their newest."]
    if python_found:
        names = ", ".join(f"`{name}`" for name in NOT_THERE)
        lines += [
            f"On Python {OTHER_PYTHON} {names} were left out: labmaze, which dm-control needs, has no wheel for it."
        ]
    else:
        lines += [f"Python {OTHER_PYTHON} was not tried: no interpreter was there."]
    return lines


def _short(name: str, said: str) -> str:
    if said == "named in one line":
        return name
    if said.startswith("no such line"):
        return ""
    return f"{name}: {said}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run it all; 1 where something failed."""
    parser = argparse.ArgumentParser(prog="make release-check", description=__doc__.splitlines()[0])
    parser.add_argument(
        "--only",
        nargs="+",
        metavar="TEXT",
        help="environments whose name contains one of these; lines of the others stay",
    )
    parser.add_argument("--keep_page", action="store_true", help="leave docs/compatibility.md as it is")
    options = parser.parse_args(arguments)
    console = Console(width=None if sys.stdout.isatty() else 160)
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    with tempfile.TemporaryDirectory(prefix="cqn-release-") as name:
        folder = Path(name)
        with console.status("building wheel and sdist"):
            plan = Plan(folder)
        results = [plan.contents()]
        environment = Environment(folder)
        cases = [case for case in plan.cases() if not options.only or any(text in case.name for text in options.only)]
        results += [run_case(case, environment, console) for case in cases]
        console.print(table(results))
        lerobot = plan.lerobot_range()
        console.print(f"lerobot: lowest {lerobot[0]}, newest in the range {lerobot[1]}")
    if not (python := other_python()):
        console.print(f"Python {OTHER_PYTHON} is not there: untested")
    if not options.keep_page:
        write_section("installed", section(results, lerobot, bool(python), read_section("installed")))
    failed = [f"{result.name}: {', '.join(result.failed)}" for result in results if result.failed]
    for line in failed:
        console.print(f"failed: {line}", style="red", markup=False)
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
