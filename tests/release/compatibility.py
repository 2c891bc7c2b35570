"""Runs every command of LeRobot with the policy and writes docs/compatibility.md: `make compatibility`.

python -m tests.release.compatibility [--only TEXT ...] [--lerobot FOLDER]

Needs the network for packages. All of it happens in a temporary environment with the wheel and the extras of LeRobot
that some commands need. With `--only`, rows whose line contains one of the texts are run
anew, and the others stay on the page as they are. With `--lerobot`, LeRobot is installed from a source tree: the page
stays as it is, and what came out otherwise than it says is listed.
"""

import argparse
import json
import shutil
import sys
import tempfile
import tomllib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from importlib.metadata import entry_points, version
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from ..foreign_formats import write_zarr
from ..hub_server import HubServer
from .build import SETTINGS, build, clean_copy
from .document import read_section, write_section
from .environments import Done, Environment, run, uv
from .lerobot_rows import SECTIONS
from .robot_rows import PLUGINS
from .rows import NOT, SHORT, Outcome, Row, Try, expand, judge_row, what_is_kept

EXTRAS = ("core_scripts", "async", "hilserl", "peft", "kinematics")
TRY_S = 150
PREPARE = (
    "cqn-data record --env.type=ur5e_station --env.task=click_button --env.obs_type=state --repo_id=local/demos "
    "--root=demos --episodes=2 --pause_share=0.3",
    "cqn-data run simulation --repo_id=local/demos --root=demos --new_repo_id=local/plain --new_root=plain",
    "cqn-data bounds --repo_id=local/plain --root=plain --new_repo_id=local/clean --new_root=clean --margin=0.1",
    "cqn-data record --env.type=ur5e_station --env.task=click_button --env.obs_type=both --env.cameras=[upper_wrist] "
    "--repo_id=local/seen --root=pictures --episodes=1 --pause_share=0",
)
MANIPULATOR = {
    "env": {"name": "real_robot", "fps": 10, "robot": {"type": "sim_ur5e"}, "teleop": {"type": "sim_leader"}},
    "dataset": {"repo_id": "local/none", "task": "Press"},
}


def console_scripts(tree: Path | None = None) -> set[str]:
    """Commands of the installed LeRobot, or of a source tree."""
    if tree is not None:
        return set(tomllib.loads((tree / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"])
    return {
        point.name for point in entry_points(group="console_scripts") if point.dist and point.dist.name == "lerobot"
    }


def forgotten(tree: Path | None = None) -> set[str]:
    """Commands of LeRobot that no row tries."""
    return console_scripts(tree) - {row.command for rows in SECTIONS.values() for row in rows}


def stated(row: Row) -> str:
    """The verdict of the page for a row, found by what was run; nothing where it is not there."""
    shown = [one.shown or one.line for one in row.tries]
    for line in read_section("commands"):
        cells = [cell.strip() for cell in line.split(" | ")]
        if cells[0] == f"| `{row.command}`" and cells[2].strip("`").replace("\\|", "|") in shown:
            return cells[1]
    return ""


def differences(outcomes: Mapping[str, Sequence[Outcome]], missing: Collection[str]) -> list[str]:
    """Lines on what is otherwise than the page says, for another LeRobot; missing: commands that no row tries."""
    lines = [f"no row tries {name}" for name in sorted(missing)]
    for one in (one for found in outcomes.values() for one in found):
        if (before := stated(one.row)) != one.verdict:
            lines += [f"{one.line}: {one.verdict}, the page says {before or 'nothing'}. {one.remark}"]
    return lines


class Bench:
    """Runs rows in a folder, with the commands of one `bin` folder."""

    def __init__(self, programs: Path, folder: Path, variables: Mapping[str, str]) -> None:
        self.programs, self.folder, self.variables = programs, folder, variables

    def prepare(self) -> None:
        """Small datasets for the rows. Raises RuntimeError where one cannot be made."""
        (self.folder / "manipulator.json").write_text(json.dumps(MANIPULATOR), encoding="utf-8")
        for line in PREPARE:
            self.must(line)
        shutil.copytree(self.folder / "clean", self.folder / "copy")
        shutil.copytree(self.folder / "pictures", Path(self.variables["HF_LEROBOT_HOME"]) / "local/pictures")

    def command(self, words: Sequence[str], variables: Mapping[str, str] | None = None) -> Done:
        """Run a command of the environment."""
        name, *arguments = words
        given = {**self.variables, **(variables or {})}
        return run([str(self.programs / name), *arguments], self.folder, given, TRY_S)

    def must(self, line: str) -> None:
        """Run a line that has to succeed. Raises RuntimeError."""
        done = self.command(expand(line))
        if done.code:
            raise RuntimeError(f"{line}\n{done.said[-2000:]}")

    def attempt(self, one: Try) -> Done:
        """Run one way of a row."""
        if not one.hub:
            return self.command(one.command())
        with HubServer() as hub:
            done = self.command(one.command(), hub.environment())
            for kind, name in hub.repositories:
                branches = hub.repositories[kind, name].branches
                for path, content in ((p, c) for b in branches for p, c in hub.files(kind, name, b).items()):
                    target = self.folder / "hub" / kind / name / path
                    target.parent.mkdir(parents=True, exist_ok=True)
                    target.write_bytes(content)
            return done

    def row(self, row: Row) -> Outcome:
        """Run a row, and what the following ones need of it."""
        outcome = judge_row(row, self.attempt, self.folder)
        if row.target and outcome.verdict != NOT:
            kept = what_is_kept(self.folder / "clean", self.folder / row.target)
            outcome = replace(outcome, remark=f"{outcome.remark} {kept}".strip())
        for line in row.then:
            self.must(line)
        return outcome


def page(outcomes: Mapping[str, Sequence[Outcome]], before: Sequence[str] = ()) -> list[str]:
    """The generated part of docs/compatibility.md; before: lines of it, which rows without an outcome keep."""
    lines_of = {_key(line): line for line in before if line.startswith("| `")}
    lines_of |= {_key(line): line for found in outcomes.values() for one in found for line in [one.markdown()]}
    extras = ", ".join(f"`{name}`" for name in EXTRAS)
    lines = [
        f"LeRobot {version('lerobot')} with its extras {extras}, on a machine",
        "without a GPU. *Works with*: the plain command fails, the one that is shown succeeds. *Not concerned*: the",
        "command takes neither a policy nor a dataset nor an arm of this package, or none of it matters to it.",
        "",
        "The commands share the options below, under `$CQN` and so on; `local/clean` is two demonstrations of",
        "`cqn-data record` after the recipe `simulation` and `bounds --margin=0.1`.",
        "",
        "```bash",
        *(f"{name}={json.dumps(options) if ' ' in options else options}" for name, options in SHORT.items()),
        "```",
    ]
    for title, rows in SECTIONS.items():
        lines += ["", f"## {title}", "", "| command | verdict | what was run | |", "|---|---|---|---|"]
        ways = [[Outcome(row, "", one.shown or one.line, "").markdown() for one in row.tries] for row in rows]
        lines += [lines_of[_key(way)] for ways_of_row in ways for way in ways_of_row if _key(way) in lines_of]
    return lines


def _key(line: str) -> str:
    """What was run, by a row of the page's table."""
    return line.split(" | ", 3)[2]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run it all."""
    parser = argparse.ArgumentParser(prog="make compatibility", description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", metavar="TEXT", help="rows that contain one of these; the others stay")
    parser.add_argument(
        "--lerobot", type=Path, metavar="FOLDER", help="a source tree of LeRobot instead of its release"
    )
    options = parser.parse_args(arguments)
    console = Console(width=None if sys.stdout.isatty() else 200)
    tree = options.lerobot and options.lerobot.resolve()
    if tree and not (tree / "pyproject.toml").is_file():
        console.print(f"--lerobot={options.lerobot}: expected a source tree of LeRobot, found no pyproject.toml")
        return 2
    if (names := forgotten()) and not tree:
        console.print(f"no row tries {', '.join(sorted(names))}: add them to tests/release/lerobot_rows.py")
        return 1
    with tempfile.TemporaryDirectory(prefix="cqn-compatibility-") as name:
        folder = Path(name)
        with console.status("building and installing"):
            wheel = build(clean_copy(folder / "source"), "wheel", folder / "wheel")
            environment = Environment(folder)
            wanted = f"{SETTINGS['project']['name']}[sim,page] @ {wheel.as_uri()}"
            lerobot = f"lerobot[{','.join(EXTRAS)}]" + (f" @ {tree.as_uri()}" if tree else f"=={version('lerobot')}")
            environment.make(sys.executable, [wanted, lerobot], "--no-sources")  # a tree may name indices of its own
            # Afterwards, as a user does: together with all of LeRobot's extras they have no solution.
            uv("pip", "install", "--quiet", "--python", str(environment.python), *PLUGINS)
        write_zarr(folder / "small.zarr")
        bench = Bench(environment.place / "bin", environment.user, environment.variables)
        with console.status("preparing datasets"):
            bench.prepare()
            converter = [
                str(Path(sys.executable).parent / "cqn-data"), "convert", "--from=diffusion_policy",
                f"--input={folder / 'small.zarr'}",
                "--new_repo_id=local/images", "--new_root=images", "--video=false", "--fps=10",
            ]  # fmt: skip
            if (done := run(converter, environment.user, environment.variables)).code:
                raise RuntimeError(done.said[-2000:])
        outcomes: dict[str, list[Outcome]] = {}
        for title, rows in SECTIONS.items():
            outcomes[title] = []
            for row in rows:
                text = f"{row.command} {row.tries[0].line}"
                if options.only and not row.then and not any(part in text for part in options.only):
                    continue
                outcome = bench.row(row)
                outcomes[title].append(outcome)
                console.print(
                    f"{outcome.verdict:<12} {escape(outcome.line[:120])}\n             {escape(outcome.remark)}"
                )
    if tree:
        found = differences(outcomes, forgotten(tree))
        console.print("\n".join(["", *found]) if found else "\nas the page says", markup=False)
        return int(bool(found))
    write_section("commands", page(outcomes, read_section("commands") if options.only else ()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
