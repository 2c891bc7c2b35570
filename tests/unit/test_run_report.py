"""The report of a run from its tables, and what it advises."""

import re
from pathlib import Path

import numpy as np
import pytest

from cqn_train.loop.evaluate import wilson_interval
from cqn_train.run.judgement import Tables, advice, gain, practice, unconverged
from cqn_train.run.metrics import COLUMNS, Metrics
from cqn_train.run.report import write_report


def evaluation(phase: str, successes: int, n: int = 50) -> dict[str, str]:
    rate = successes / n
    row = {"phase": phase, "env_steps": "0", "n": n, "successes": successes, "success_rate": rate,
           "ci_low": max(0.0, rate - 0.1), "ci_high": min(1.0, rate + 0.1), "standing_failures": 0.5}  # fmt: skip
    return {name: str(row.get(name, "")) for name in COLUMNS["evaluations"]}


def episode(success: bool, standing: float | None = 0.0) -> dict[str, str]:
    row = {"success": int(success), "length": 40, "env_steps": 40, "mean_q": 0.5, "standing": standing}
    return {name: "" if row.get(name) is None else str(row[name]) for name in COLUMNS["episodes"]}


def updates(losses: list[float]) -> list[dict[str, str]]:
    return [{"env_steps": "0", "bc_dominance_loss": str(loss), "bc_margin_loss": "0", "bc_action_loss": ""}
            for loss in losses]  # fmt: skip


def test_imitation_that_still_falls_has_not_converged() -> None:
    assert unconverged(updates([1 / (1 + i) for i in range(10)])) is None  # too few rows
    assert unconverged(updates([0.99**i for i in range(200)])) == pytest.approx(1 - 0.99**20, abs=1e-6)
    assert unconverged(updates([0.1] * 200)) is None
    assert unconverged(updates([0.1] * 190 + [0.2] * 10)) is None


def scenes(phase: str, outcomes: list[bool], **columns: float) -> list[dict[str, str]]:
    """Rows of evaluation_episodes.csv; a column holds its value in failures and half of it in successes."""
    return [
        {
            "phase": phase,
            "env_steps": "0",
            "scene": str(scene),
            "success": str(int(ok)),
            "how": "" if ok else "stood still",
        }
        | {name: str(value / 2 if ok else value) for name, value in columns.items()}
        for scene, ok in enumerate(outcomes)
    ]


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        (Tables(evaluations=[evaluation("offline", 20), evaluation("final", 22)]), "show no gain"),
        (Tables(evaluations=[evaluation("offline", 20), evaluation("final", 45)]), None),
        (Tables(episodes=[episode(False, 0.6), episode(True, 0.0), episode(False, 0.5)]), "stand still in 55%"),
        (Tables(episodes=[episode(False, 0.1)]), None),
        (Tables(episodes=[episode(False, None)]), None),  # a policy that sees no state
        (Tables(episodes=[episode(i < 20) for i in range(40)]), "did not rise"),
        (Tables(episodes=[episode(i >= 20) for i in range(40)]), None),
        (
            Tables(episodes=[episode(False) | {"at_bounds": "0.5"}, episode(True) | {"at_bounds": "0.1"}]),
            "50% of the actions",
        ),
        (Tables(episodes=[episode(False) | {"at_bounds": "0.5"}, episode(True) | {"at_bounds": "0.4"}]), None),
        (Tables(evaluation_episodes=scenes("final", [True, False], distance=0.8)), "0.80 from the nearest"),
        (Tables(evaluation_episodes=scenes("final", [True, False], q_end=0.9)), "does not tell failures"),
        (Tables(evaluation_episodes=scenes("final", [True, False], q_end=-0.9)), None),
        # Only the newest evaluation counts: once it failed far away, and does no longer.
        (Tables(evaluation_episodes=[*scenes("offline", [True, False], distance=0.8), *scenes("final", [True])]), None),
    ],
)
def test_advice_speaks_where_a_figure_does(tables: Tables, said: str | None) -> None:
    assert len(advice(tables)) == (said is not None)
    assert said is None or said in advice(tables)[0]


def test_the_interval_of_a_gain_is_newcombes() -> None:
    """His first example: 56 of 70 against 48 of 80."""
    rows = []
    for successes, n in ((48, 80), (56, 70)):
        low, high = wilson_interval(successes, n)
        rows.append({"success_rate": str(successes / n), "ci_low": str(low), "ci_high": str(high)})
    assert gain(*rows) == pytest.approx((0.2, 0.0524, 0.3339), abs=1e-4)


def tables_of(before: np.ndarray, after: np.ndarray) -> Tables:
    rows = []
    for phase, outcomes in (("offline", before), ("final", after)):
        n, successes = len(outcomes), int(outcomes.sum())
        low, high = wilson_interval(successes, n)
        rows.append(evaluation(phase, successes, n) | {"ci_low": str(low), "ci_high": str(high)})
    return Tables(
        evaluations=rows,
        evaluation_episodes=[*scenes("offline", before.tolist()), *scenes("final", after.tolist())],
    )


def interval_of(tables: Tables) -> tuple[float, float]:
    (found,) = re.findall(r"\(95 % ([+-][\d.]+) to ([+-][\d.]+)\)", practice(tables))
    return float(found[0]), float(found[1])


def test_the_same_scenes_before_and_after_narrow_the_interval_and_it_holds_the_truth() -> None:
    """Scenes of which half are hard, and of which practice solves some: the interval by simulation."""
    rng, held, widths, apart = np.random.default_rng(0), 0, [], []
    for _ in range(300):
        hard = rng.random(100) < 0.5
        before, after = ~hard & (rng.random(100) < 0.9), np.where(hard, rng.random(100) < 0.3, rng.random(100) < 0.95)
        tables = tables_of(before, after)
        low, high = interval_of(tables)
        held += low - 0.005 <= 0.5 * (0.3 + 0.95 - 0.9) <= high + 0.005  # two decimals are printed
        widths.append(high - low)
        _, unpaired_low, unpaired_high = gain(*tables.evaluations)
        apart.append(unpaired_high - unpaired_low)
    assert 0.92 <= held / 300 <= 0.995
    assert np.mean(widths) < 0.85 * np.mean(apart)


def test_practice_is_told_by_scenes() -> None:
    before, after = np.array([True] * 4 + [False] * 6), np.array([False] + [True] * 8 + [False])
    said = practice(tables_of(before, after))
    assert "of the same 10 scenes 5 succeed only after it, 1 only before" in said
    assert "+0.40" in said
    alone = practice(Tables(evaluations=[evaluation("final", 45)]))
    assert alone.startswith("After 0 control steps 0.90")
    assert practice(Tables()) == "The run is not complete."


def test_the_page_holds_what_the_tables_say(tmp_path: Path) -> None:
    metrics = Metrics(tmp_path)
    assert write_report(tmp_path) is None
    metrics.write("evaluations", evaluation("offline", 20))
    assert "not complete" in (write_report(tmp_path) or tmp_path).read_text()
    metrics.write("episodes", episode(False, 0.6))
    metrics.write("evaluations", evaluation("final", 45))
    (tmp_path / "videos").mkdir()
    for name in ("final_000040_0_success", "final_000040_1_failure_stood_still", "final_000040_2_failure_ended_early"):
        (tmp_path / "videos" / f"{name}.mp4").touch()
    page = (write_report(tmp_path) or tmp_path).read_text()
    assert "Before practice 0.40 (n=50" in page
    assert "0.90 (n=50" in page
    order = [page.index(label) for label in ("failure: ended early (", "failure: stood still (", "success (final")]
    assert order == sorted(order)
    assert "stand still in 60%" in page
    assert "data:image/png" in page
