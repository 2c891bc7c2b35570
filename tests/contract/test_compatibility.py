"""docs/compatibility.md: no command of the installed LeRobot is forgotten, and two rows still come out as it says."""

import sys
from pathlib import Path

import pytest

from ..release.compatibility import Bench, console_scripts, differences, forgotten, stated
from ..release.document import PAGE
from ..release.environments import Done
from ..release.lerobot_rows import SECTIONS
from ..release.rows import NOT, UNCONCERNED, WORKS, Outcome, Row, Try, ends_well, judge_row, says, writes

ROWS = [row for rows in SECTIONS.values() for row in rows]
CHEAP = ("lerobot-find-joint-limits", "lerobot-setup-motors")


def test_every_command_of_lerobot_is_tried() -> None:
    assert len(console_scripts()) > 10
    assert forgotten() == set()


def test_every_row_is_on_the_page() -> None:
    assert [row.tries[0].line for row in ROWS if not stated(row)] == [], "run `make compatibility`"
    names = {line.split("`")[1] for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| `")}
    assert console_scripts() <= names


@pytest.mark.parametrize("command", CHEAP)
def test_cheap_rows_come_out_as_the_page_says(command: str, tmp_path: Path) -> None:
    (row,) = [row for row in ROWS if row.command == command]
    outcome = Bench(Path(sys.executable).parent, tmp_path, {}).row(row)
    assert outcome.verdict == stated(row)
    (note,) = row.notes.values()
    assert note in outcome.remark  # the reason is still this one


def test_the_verdict_follows_from_what_happens(tmp_path: Path) -> None:
    plain, other = Try("a --x", ends_well), Try("a --y", ends_well, label="`--y`")
    bad, good = Done(1, "some words\nit broke\n", 0.0), Done(0, "fine\n", 0.0)
    assert judge_row(Row("a", (plain, other)), lambda one: good, tmp_path).verdict == WORKS
    around = judge_row(Row("a", (plain, other)), lambda one: good if one is other else bad, tmp_path)
    assert (around.verdict, around.line) == ("works with `--y`", "a --y")
    failed = judge_row(Row("a", (plain,), {"broke": "It is broken."}, "use b."), lambda one: bad, tmp_path)
    assert (failed.verdict, failed.remark) == (NOT, "It is broken. Instead: use b.")
    unknown = judge_row(Row("a", (plain,), {"other": "x"}), lambda one: bad, tmp_path)
    assert unknown.remark == "It ends with: it broke"
    assert judge_row(Row("a", (plain,), concerned=False), lambda one: bad, tmp_path).verdict == UNCONCERNED
    assert writes("nothing.txt")(good, tmp_path)
    assert says("other words")(good, tmp_path)
    assert says("fi.e")(good, tmp_path) == ""


def test_another_lerobot_is_told_by_what_comes_out_otherwise(tmp_path: Path) -> None:
    row = next(row for row in ROWS if stated(row) == WORKS)
    as_before = Outcome(row, WORKS, row.tries[0].line, "")
    assert differences({"a": [as_before]}, ()) == []
    (line, other) = differences({"a": [Outcome(row, NOT, row.tries[0].line, "It ends.")]}, ["lerobot-new"])
    assert line == "no row tries lerobot-new"
    assert other.endswith("does not, the page says works. It ends.")
    (tmp_path / "pyproject.toml").write_text('[project]\nscripts = {"lerobot-new" = "a:b", "lerobot-train" = "c:d"}\n')
    assert forgotten(tmp_path) == {"lerobot-new"}
