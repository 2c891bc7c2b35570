"""What a run of `cqn-train` leaves to look at: films, and tables of single evaluation episodes that add up."""

from pathlib import Path

import numpy as np
import pytest

from cqn_train.cli import main
from cqn_train.run.metrics import read_rows

from .conftest import TINY_RUN


def test_films_of_evaluations(click: list[str], tmp_path: Path) -> None:
    flags = ["--steps=0", "--offline_updates=1", "--eval.videos=1", f"--output_dir={tmp_path / 'run'}"]
    assert main([*TINY_RUN, *click, *flags]) == 0
    (film,) = (tmp_path / "run" / "videos").iterdir()
    (row,) = read_rows(tmp_path / "run" / "evaluation_episodes.csv")[:1]
    label = "success" if row["success"] == "1" else f"failure_{row['how'].replace(' ', '_')}"
    assert film.name == f"final_000000_0_{label}.mp4"
    assert (tmp_path / "run" / "first_batch.png").stat().st_size > 1000


def test_what_a_run_says_of_itself(click: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Evaluation episodes add up to the evaluation; before and after have the same scenes, the way has others."""
    run, flags = tmp_path / "run", ["--offline_updates=2", "--steps=6", "--eval.freq=3", "--eval.n_episodes=2"]
    assert main([*TINY_RUN, *click, *flags, "--eval.final_n_episodes=3", f"--output_dir={run}"]) == 0
    episodes, evaluations = read_rows(run / "evaluation_episodes.csv"), read_rows(run / "evaluations.csv")
    scenes = {
        row["phase"]: [each["scene"] for each in episodes if each["phase"] == row["phase"]] for row in evaluations
    }
    assert scenes["offline"] == scenes["final"]
    assert not {*scenes.get("online", [])} & {*scenes["final"]}
    for row in evaluations:
        of_it = [e for e in episodes if (e["phase"], e["env_steps"]) == (row["phase"], row["env_steps"])]
        assert len(of_it) == int(row["n"])
        assert sum(int(e["success"]) for e in of_it) == int(row["successes"])
        assert np.mean([int(e["length"]) for e in of_it]) == pytest.approx(float(row["mean_length"]), rel=1e-4)
        assert all(bool(e["how"]) is (e["success"] == "0") for e in of_it)
    assert all(float(e["distance"]) >= 0 and 0 <= float(e["at_bounds"]) <= 1 for e in episodes)
    last = read_rows(run / "diagnosis.csv")[-1]
    assert float(last["td_error_demonstrations"]) >= 0
    assert float(last["rl_gradient_failures"] or last["rl_gradient_successes"]) > 0
    said = capsys.readouterr().out
    assert "Before practice" in said
    assert "of the same 3 scenes" in said
