"""The report of a run from its tables, and what it advises."""

from pathlib import Path

import numpy as np
import pytest

from cqn_train.loop.evaluate import wilson_interval
from cqn_train.replay.standing import share_standing
from cqn_train.run.metrics import COLUMNS, Metrics
from cqn_train.run.report import advice, gain, unconverged, write_report


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


def test_standing_is_the_share_of_steps_in_which_nothing_moves() -> None:
    states = np.zeros((6, 3))
    states[3:, 1] = 0.5  # one step of five moves one value
    assert share_standing(states) == pytest.approx(0.8)
    assert share_standing(None) is None
    assert share_standing(np.zeros((4, 0))) is None


def test_imitation_that_still_falls_has_not_converged() -> None:
    assert unconverged(updates([1 / (1 + i) for i in range(10)])) is None  # too few rows
    assert unconverged(updates([0.99**i for i in range(200)])) == pytest.approx(1 - 0.99**20, abs=1e-6)
    assert unconverged(updates([0.1] * 200)) is None
    assert unconverged(updates([0.1] * 190 + [0.2] * 10)) is None


def test_advice_speaks_where_a_figure_does() -> None:
    overlap = [evaluation("offline", 20), evaluation("final", 22)]
    assert any("show no gain" in said for said in advice([], overlap, []))
    apart = [evaluation("offline", 20), evaluation("final", 45)]
    assert advice([], apart, []) == []
    standing = [episode(False, 0.6), episode(True, 0.0), episode(False, 0.5)]
    assert any("stand still in 55%" in said for said in advice(standing, [], []))
    assert advice([episode(False, 0.1)], [], []) == []
    assert advice([episode(False, None)], [], []) == []  # a policy that sees no state
    assert any("did not rise" in said for said in advice([episode(i < 20) for i in range(40)], [], []))
    assert advice([episode(i >= 20) for i in range(40)], [], []) == []


def test_the_interval_of_a_gain_is_newcombes() -> None:
    """His first example: 56 of 70 against 48 of 80."""
    rows = []
    for successes, n in ((48, 80), (56, 70)):
        low, high = wilson_interval(successes, n)
        rows.append({"success_rate": str(successes / n), "ci_low": str(low), "ci_high": str(high)})
    assert gain(*rows) == pytest.approx((0.2, 0.0524, 0.3339), abs=1e-4)


def test_the_page_holds_what_the_tables_say(tmp_path: Path) -> None:
    metrics = Metrics(tmp_path)
    assert write_report(tmp_path) is None
    metrics.write("evaluations", evaluation("offline", 20))
    assert "not complete" in (write_report(tmp_path) or tmp_path).read_text()
    metrics.write("episodes", episode(False, 0.6))
    metrics.write("evaluations", evaluation("final", 45))
    (tmp_path / "videos").mkdir()
    for name in ("final_000040_0_success", "final_000040_1_failure"):
        (tmp_path / "videos" / f"{name}.mp4").touch()
    page = (write_report(tmp_path) or tmp_path).read_text()
    assert "Before practice 0.40 (n=50" in page
    assert "0.90 (n=50" in page
    assert page.index("1 failure") < page.index("0 success")
    assert "stand still in 60%" in page
    assert "data:image/png" in page
