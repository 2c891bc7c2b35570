"""The control rate by a clock that only the test moves."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cqn_train.robot.pace import Pace

from ..driven_clock import DrivenClock


def paced(fps: float = 10.0) -> tuple[Pace, DrivenClock]:
    clock = DrivenClock()
    pace = Pace(fps, clock)
    pace.start()
    return pace, clock


def test_work_within_a_period_does_not_move_the_ticks() -> None:
    pace, clock = paced()
    for tick in range(1, 50):
        clock.now += 0.001 * (tick % 90)
        pace.wait()
        assert clock.now == pytest.approx(100 + 0.1 * tick)
    assert pace.statistics() == pytest.approx({"rate_hz": 10, "jitter_ms": 0, "worst_ms": 100, "late": 0}, abs=1e-6)


def test_a_tick_that_is_a_little_late_is_made_up_for() -> None:
    pace, clock = paced()
    clock.now += 0.15
    pace.wait()
    assert clock.now == pytest.approx(100.15)
    pace.wait()
    assert clock.now == pytest.approx(100.2)  # where it would have been
    assert pace.late == 1


@given(st.lists(st.floats(0, 0.5), min_size=1, max_size=30))
def test_however_long_the_work_takes_no_ticks_are_caught_up(work: list[float]) -> None:
    pace, clock = paced()
    ticks, missed = [clock.now], False
    for seconds in work:
        due = ticks[-1] + 0.1
        clock.now += seconds
        begun = clock.now
        pace.wait()
        if missed:  # after one that was left out, the arm has its whole period again
            assert clock.now >= due - 1e-9
        missed = begun > due + 0.1 + 1e-9
        assert clock.now >= begun
        ticks.append(clock.now)
    # A tick never comes before its time: over the whole, there are not more than the rate allows.
    assert ticks[-1] - ticks[0] >= 0.1 * len(work) - 1e-6


def test_after_a_break_it_begins_anew() -> None:
    pace, clock = paced()
    pace.wait()
    clock.now += 60
    pace.start()
    pace.wait()
    assert clock.now == pytest.approx(160.2)
    assert pace.late == 0
    assert pace.statistics()["worst_ms"] == pytest.approx(100)


def test_statistics_are_those_of_the_intervals() -> None:
    pace, clock = paced()
    assert pace.statistics() == {}
    pace.wait()
    assert pace.statistics() == {}
    clock.now += 0.14
    pace.wait()  # 140 ms, and the next one 60 ms
    pace.wait()
    found = pace.statistics()
    assert found["rate_hz"] == pytest.approx(10)
    assert found["worst_ms"] == pytest.approx(140)
    assert found["jitter_ms"] == pytest.approx((2 * 40**2 / 3) ** 0.5)
    assert found["late"] == 1


@pytest.mark.real_time(reason="the rate on the machine's own clock is what is tested")
def test_it_keeps_time_by_the_real_clock() -> None:
    pace = Pace(100)
    pace.start()
    for _ in range(20):
        pace.wait()
    assert pace.statistics()["rate_hz"] == pytest.approx(100, rel=0.2)
