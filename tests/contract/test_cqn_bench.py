"""`cqn-bench`: plans, runs that are resumed, and aggregates against numbers worked out by hand."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from cqn_train.bench.cli import main
from cqn_train.bench.plan import load_plan, runs_of
from cqn_train.bench.report import aggregate
from lerobot_cqn.errors import ConfigError

from .conftest import STATION, TINY_POLICY

COMMON = ["--batch_size=4", "--demo_batch_size=4", "--offline_updates=3", "--steps=20", "--eval.freq=10",
          "--eval.n_episodes=1", "--eval.final_n_episodes=2", "--save_freq=10", "--log_freq=1"]  # fmt: skip


@pytest.fixture
def plan(click: list[str], tmp_path: Path) -> Path:
    methods = {"cqn": TINY_POLICY, "cbc": [*TINY_POLICY, "--policy.rl_loss_scale=0"]}
    content = {"common": COMMON, "methods": methods, "tasks": {"click": [*STATION, *click]}, "seeds": [1]}
    path = tmp_path / "plan.yaml"
    path.write_text(json.dumps(content))  # JSON is YAML
    return path


def test_runs_once_continues_what_was_killed_and_reports(plan: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-m", "cqn_train.bench.cli", str(plan), f"--output_dir={out}", "--processes=2"]
    first = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    deadline = time.monotonic() + 120
    while not (out / "click" / "cqn" / "1" / "checkpoints" / "last").exists():
        assert first.poll() is None, first.communicate()[0]
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.kill(first.pid, signal.SIGINT)
    said, _ = first.communicate(timeout=180)
    assert first.returncode == 130, said
    assert "the same command continues" in said
    assert main([str(plan), f"--output_dir={out}"]) == 0
    stamps = {p: p.stat().st_mtime_ns for p in out.rglob("evaluations.csv")}
    assert len(stamps) == 2
    with (out / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {(r["task"], r["method"], r["seed"], r["n"]) for r in rows} == {
        ("click", m, "1", "2") for m in ("cqn", "cbc")
    }
    for name in ("table.png", "aggregate.png", "curves.png"):
        assert Image.open(out / name).width > 300
    with (out / "curves.csv").open() as file:
        curves = list(csv.DictReader(file))
    ends = {(r["method"], r["mean"]) for r in curves if r["env_steps"] == curves[-1]["env_steps"]}
    assert ends == {(r["method"], f"{float(r['success_rate']):.4f}") for r in rows}
    assert "| cbc |" in (out / "results.md").read_text()
    assert main([str(plan), f"--output_dir={out}"]) == 0  # nothing is left to do
    assert stamps == {p: p.stat().st_mtime_ns for p in out.rglob("evaluations.csv")}


def test_a_failed_run_is_named_and_the_others_go_on(
    plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = json.loads(plan.read_text())
    content["methods"] = {"bad": [*TINY_POLICY, "--dataset.root=nowhere"]}
    content["tasks"] = {"click": [option for option in content["tasks"]["click"] if "dataset.root" not in option]}
    plan.write_text(json.dumps(content))
    assert main([str(plan), f"--output_dir={tmp_path / 'out'}"]) == 2
    said = "".join(capsys.readouterr()).replace("\n", "")
    assert "click / bad / 1 failed: cqn-train: error: No dataset at nowhere" in said
    assert f"(log: {tmp_path / 'out/click/bad/1'}.log)" in said
    assert "there is nothing to report" in said


def test_wrong_arguments_of_a_method_are_found_before_any_run(
    plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = json.loads(plan.read_text())
    content["methods"]["bad"] = ["--policy.type=cqn", "--policy.preset=no_such"]
    plan.write_text(json.dumps(content))
    assert main([str(plan), f"--output_dir={tmp_path / 'out'}"]) == 2
    assert "click / bad: Unknown preset 'no_such'" in "".join(capsys.readouterr())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("methods: {a: [--x=1]}\ntasks: {t: [--y=1]}\nseeds: []", "seeds as a list of different whole numbers"),
        ("methods: {a: --x}\ntasks: {t: [--y=1]}\nseeds: [1]", "expected methods as NAME"),
        ("methods: {a: [--x=1]}\nseeds: [1]", "expected tasks as NAME"),
        ("method: {a: []}", "Did you mean 'methods'?"),
        ("methods: {../a: [--x=1]}\ntasks: {t: [--y=1]}\nseeds: [1]", "becomes a folder"),
        ("methods: {a: [--x=1]}\ntasks: {t: [--y=1]}\nseeds: [1]\nscore: sucess_rate", "Did you mean 'success_rate'?"),
        ("[", "is not YAML"),
        ("- 1", "expected the keys"),
    ],
)
def test_plans_that_cannot_work_say_why(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        load_plan(path)
    assert said in str(error.value)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--output_dir=x"], "Name a plan first"),
        (["nowhere.yaml", "--output_dir=x"], "No plan at nowhere.yaml"),
        (["nowhere.yaml"], "No output directory"),
        (["nowhere.yaml", "--output_dri=x"], "Did you mean '--output_dir'?"),
        (["nowhere.yaml", "--output_dir=x", "--processes=0"], "--processes of at least 1"),
    ],
)
def test_wrong_arguments(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    assert said in "".join(capsys.readouterr())


def test_every_combination_is_a_run_and_the_shipped_plan_is_one() -> None:
    plan = load_plan(Path(__file__).parents[2] / "benchmarks" / "station_state.yaml")
    runs = runs_of(plan, Path("out"))
    assert len({run.folder for run in runs}) == len(plan.seeds) * len(plan.tasks) * len(plan.methods) == len(runs)
    assert all(f"--seed={run.seed}" in run.arguments for run in runs)


def test_aggregates_are_the_interquartile_mean_and_pairs_won() -> None:
    better, worse = np.array([[0.9, 0.4], [1.0, 0.6], [0.8, 0.5]]), np.array([[0.5, 0.4], [0.6, 0.7], [0.8, 0.3]])
    iqm, versus = aggregate({"a": better, "b": worse})
    middle = np.sort(better.ravel())[1:-1]  # scipy trims a quarter of six, rounded down, at either end
    assert iqm["a"][0] == pytest.approx(middle.mean())
    assert iqm["a"][1] <= iqm["a"][0] <= iqm["a"][2]
    won = np.mean([(x > y) + 0.5 * (x == y) for t in range(2) for x in better[:, t] for y in worse[:, t]])
    assert versus["b"][0] == pytest.approx(won)
    assert aggregate({"alone": better})[1] == {}
