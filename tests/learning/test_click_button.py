"""Slow: does it learn? Three seeds of the demo's filtered variant, judged by evaluation episodes."""

import csv
import subprocess
import sys
from pathlib import Path

import pytest

from cqn_train.loop.evaluate import wilson_interval

SEEDS = (0, 1, 2)
STATION = ("--env.type=ur5e_station", "--env.task=click_button")


def run(module: str, *arguments: str) -> None:
    result = subprocess.run([sys.executable, "-m", module, *arguments], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_filtered_demonstrations_then_online_reach_ninety_percent(tmp_path: Path) -> None:
    successes = n = 0
    for seed in SEEDS:
        raw, kept, out = tmp_path / f"raw{seed}", tmp_path / f"kept{seed}", tmp_path / f"run{seed}"
        run(
            "cqn_data.cli",
            "record",
            *STATION,
            "--repo_id=t/raw",
            f"--root={raw}",
            "--episodes=30",
            f"--seed={1000 * seed}",
        )
        recipe = ["--repo_id=t/raw", f"--root={raw}", "--new_repo_id=t/kept", f"--new_root={kept}"]
        run("cqn_data.cli", "run", "simulation", *recipe)
        run(
            "cqn_train.cli", "--policy.type=cqn", "--policy.preset=laptop_state", "--policy.device=cpu", *STATION,
            "--dataset.repo_id=t/kept", f"--dataset.root={kept}", f"--output_dir={out}", f"--seed={seed}",
            "--offline_updates=150", "--steps=2400", "--eval.freq=0", "--threads=1",
        )  # fmt: skip
        with (out / "evaluations.csv").open() as file:
            final = next(row for row in csv.DictReader(file) if row["phase"] == "final")
        successes, n = successes + int(final["successes"]), n + int(final["n"])
    low, high = wilson_interval(successes, n)
    print(f"success {successes}/{n}, 95 % interval {low:.2f}-{high:.2f} over {len(SEEDS)} seeds")
    assert successes / n >= 0.9
