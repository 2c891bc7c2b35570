"""The command line: quick help, one-line errors, exit codes."""

import subprocess
import sys

import pytest

from cqn_data.cli import main
from cqn_data.operations.registry import OPERATIONS


def fails(capsys, *args):
    """Run, expect exit code 2 and one line on stderr, and return it."""
    assert main(list(args)) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1, err
    assert "Traceback" not in err
    return err


def test_help_needs_no_heavy_import():
    code = (
        "import sys; from cqn_data.cli import main; main(['--help']); main(['filter', '--help']);"
        "main(['record', '--help']); sys.exit(any(m in sys.modules for m in ('torch', 'lerobot', 'datasets')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    for word in (*OPERATIONS, "--threshold", "(default 1)", "--pause_share", "Example:"):
        assert word in done.stdout


ANSWERS = """
import contextlib, io, sys
from cqn_data.cli import main
from cqn_data.operations.registry import OPERATIONS

HEAVY = {"torch", "lerobot", "datasets", "pyarrow", "cv2", "av", "mujoco", "transformers", "numpy", "huggingface_hub"}

def answers(code, *args):
    with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
        assert main(list(args)) == code, args
    assert not HEAVY & sys.modules.keys(), (args, HEAVY & sys.modules.keys())

answers(0, "--help")
answers(2, "filtr")
for name in OPERATIONS:
    recipe = ["simulation"] if name == "run" else []
    answers(0, name, "--help")
    answers(2, name, *recipe)
    answers(2, name, *recipe, "--repo_id=a/b", "--nope=1")
answers(2, "filter", "--repo_id=a/b", "--threshold=abc")
answers(2, "resize", "--repo_id=a/b", "--size=[a]")
answers(2, "record", "--repo_id=a/b", "--episodes=x")
answers(2, "run", "simulation", "--repo_id=a/b", "--filter.threshold=abc")
"""


def test_help_and_usage_errors_load_nothing_heavy():
    done = subprocess.run([sys.executable, "-c", ANSWERS], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr


def test_unknown_operation_names_the_nearest(capsys):
    assert "Did you mean 'filter'?" in fails(capsys, "filtr")


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["--repo_id=a/b", "--treshold=1"], "Did you mean '--threshold'?"),
        ([], "Missing --repo_id"),
        (["--repo_id=a/b", "--threshold=abc"], "threshold"),
        (["--repo_id=a/b", "--threshold.x=1"], "Did you mean '--threshold'?"),
        (["--repo_id=a/b", "--joint_thresholds={a"], "Bad option value: while parsing a flow mapping"),
        (["--repo_id=a/b", "--threshold=-1"], "positive"),
        (["--repo_id=a/b", "--threshold=nan"], "positive"),
        (["--repo_id=a/b", "--threshold"], "needs a value"),
        (["--repo_id=a/b", "--keep_last=0"], "--keep_last >= 1"),
        (["--repo_id=a/b", "--min_pause=0"], "--min_pause >= 1"),
        (["--repo_id=a/b", "--auto", "--threshold=1"], "only one of them"),
        (["--repo_id=a/b", "--actions=comand"], "Did you mean 'command'?"),
        (["--repo_id=a/b", "--preview=film.gif"], "FILE.mp4 or FILE.png"),
        (["--repo_id=a/b", "--compare=x"], "after, before"),
        (["--repo_id=a/b", '--joint_thresholds={"a": 0}'], "'a'"),
        (["--repo_id=a/b", "stray"], "Unexpected 'stray'"),
    ],
)
def test_filter_options_are_checked_before_anything_is_read(capsys, args, said):
    assert said in fails(capsys, "filter", *args)


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["--episodes=0"], "--episodes >= 1"),
        (["--pause_share=1"], "--pause_share in [0, 1)"),
        (["--max_steps=0"], "--max_steps >= 1"),
        (["--seed=-1"], "--seed >= 0"),
    ],
)
def test_record_options_are_checked(capsys, args, said):
    assert said in fails(capsys, "record", "--repo_id=a/b", *args)


def test_debug_shows_where_and_the_same_line_last(capsys):
    assert main(["filtr", "--debug"]) == 2
    printed = capsys.readouterr().err
    assert "Traceback" in printed
    assert printed.strip().splitlines()[-1].startswith("cqn-data filtr: error: Unknown operation 'filtr'")
