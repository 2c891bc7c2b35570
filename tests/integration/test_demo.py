"""The whole chain, small: record -> filter -> offline -> online -> evaluation -> report, by the demo's own commands."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from cqn_train.demo.so101 import LateAnswerError, _patiently, _spoken
from cqn_train.demo.stages import DemoError, Stages
from cqn_train.sim_arm.keyboard import Terminal

TINY = (
    "--demonstrations=3", "--offline_updates=4", "--steps=30", "--eval_freq=0", "--eval_episodes=1",
    "--final_episodes=2", "--expert_episodes=2",
)  # fmt: skip


def test_demo_runs_every_arrow_and_a_second_start_does_not_repeat_it(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    command = [sys.executable, "-m", "cqn_train.demo.station", f"--output_dir={out}", *TINY]
    first = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert first.returncode == 0, first.stdout + first.stderr

    summary = json.loads((out / "summary.json").read_text())
    assert summary["expert"]["n"] == 2
    kept, recorded = (summary["variants"][name]["steps_in_dataset"] for name in ("filtered", "unfiltered"))
    assert kept < recorded
    for variant in summary["variants"].values():
        assert variant["offline"]["n"] == variant["online"]["n"] == 2
        assert variant["online"]["updates"] > variant["offline"]["updates"] == 4
        assert (
            0 <= variant["online"]["ci_low"] <= variant["online"]["success_rate"] <= variant["online"]["ci_high"] <= 1
        )

    page = (out / "report.html").read_text()
    assert not re.search(r"""(?:src|href)=["'](?!data:)""", page), "the report must not load anything"
    assert page.count("data:image/webp") == 5
    assert "scripted expert" in first.stdout
    assert "Traceback" not in first.stdout + first.stderr

    stamps = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    second = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert second.returncode == 0
    assert "Already done" in second.stdout
    assert stamps == {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}


def test_what_a_cut_off_recording_left_is_not_taken_for_all_of_it(tmp_path: Path) -> None:
    """A folder without the mark of a finished stage is moved aside, not used and not deleted."""
    left = tmp_path / "data" / "unfiltered"
    left.mkdir(parents=True)
    (left / "part").write_text("of a recording")
    stages = Stages(tmp_path, Console(quiet=True))
    stages.run("record", "recording", left, "json.tool", "--help")
    assert not left.exists()
    assert [(path / "part").read_text() for path in left.parent.iterdir()] == ["of a recording"]
    assert (stages.logs / "record.done").exists()


def test_demo_names_the_command_that_failed(tmp_path: Path) -> None:
    """A broken stage ends in one line with the log's last line, not in a traceback."""
    out = tmp_path / "demo"
    out.mkdir()
    (out / "data").write_text("a file in the way of the recording")
    command = [sys.executable, "-m", "cqn_train.demo.station", f"--output_dir={out}", *TINY]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert result.stderr.startswith("demo: error: 'record' failed")
    assert "Traceback" not in result.stdout + result.stderr


def test_only_a_late_answer_of_a_motor_is_tried_again(tmp_path: Path) -> None:
    """What a busy machine does to LeRobot's drivers is no failure of the demo; anything else is."""
    stages, begun = Stages(tmp_path, Console(quiet=True)), []

    def ends_with(*errors: Exception) -> None:
        begun.clear()

        def attempt() -> None:
            begun.append(len(begun))
            if len(begun) <= len(errors):
                raise errors[len(begun) - 1]

        _patiently(stages, attempt)

    ends_with(LateAnswerError("late"), LateAnswerError("late"))
    assert len(begun) == 3
    with pytest.raises(LateAnswerError):
        ends_with(*[LateAnswerError("late")] * 3)
    with pytest.raises(DemoError, match="broken"):
        ends_with(DemoError("broken"))
    assert len(begun) == 1


def test_a_command_that_ends_says_why(tmp_path: Path) -> None:
    stages = Stages(tmp_path, Console(quiet=True))
    late = "import sys; print('There is no status packet!'); print('and more'); sys.exit(1)"
    for script, kind in ((late, LateAnswerError), ("print('no such port'); raise SystemExit(3)", DemoError)):
        command = Terminal([sys.executable, "-c", script])
        with pytest.raises(DemoError) as raised, _spoken(stages, "talk", command):
            command.hears("what it never says")
        assert type(raised.value) is kind
    assert "no such port" in str(raised.value)
    assert "no such port" in (stages.logs / "talk.log").read_text()
