"""The clock of the tests: one thread at a time, in an order that is always the same."""

import threading

import pytest

from cqn_train.clock import REAL, Clock

from ..driven_clock import DrivenClock, until


def test_time_passes_where_it_is_slept_on_and_nowhere_else() -> None:
    clock: Clock = DrivenClock()
    assert clock.now == clock.now == 100
    clock.sleep(3.5)
    assert clock.now == 103.5
    assert not clock.wait(threading.Event(), 2.0)
    assert clock.now == 105.5


def test_threads_run_in_the_order_in_which_they_are_due() -> None:
    clock, seen = DrivenClock(), list[tuple[str, float]]()

    def work(name: str, period: float) -> None:
        for _ in range(3):
            clock.sleep(period)
            seen.append((name, clock.now))

    for name, period in (("slow", 2.0), ("fast", 0.5)):
        clock.thread(lambda name=name, period=period: work(name, period), name).start()
    clock.sleep(5.0)
    assert seen == [("fast", 100.5), ("fast", 101), ("fast", 101.5), ("slow", 102), ("slow", 104)]
    assert clock.now == 105


def test_who_waits_for_an_event_goes_on_at_the_moment_it_is_set() -> None:
    clock, event, seen = DrivenClock(), threading.Event(), list[float]()
    waiter = clock.thread(lambda: (clock.wait(event, 50), seen.append(clock.now)), "waiter")
    setter = clock.thread(lambda: (clock.sleep(7), event.set()), "setter")
    waiter.start()
    setter.start()
    waiter.join()
    assert seen == [107]
    assert not waiter.is_alive()


def test_a_lock_is_held_while_time_passes() -> None:
    clock, seen = DrivenClock(), list[tuple[str, float]]()
    lock = clock.lock()

    def hold() -> None:
        with lock, lock:
            clock.sleep(4)
            seen.append(("held", clock.now))

    holder = clock.thread(hold, "holder")
    holder.start()
    clock.sleep(1)
    with lock:
        seen.append(("mine", clock.now))
    assert seen == [("held", 104), ("mine", 104)]


def test_threads_that_wait_for_one_another_are_an_error_and_no_hanging_test() -> None:
    clock = DrivenClock()
    with pytest.raises(AssertionError, match="every thread waits"):
        clock.wait(threading.Event(), float("inf"))
    with pytest.raises(AssertionError, match="did not happen"):
        until(clock, lambda: False)


@pytest.mark.real_time(reason="the machine's own clock is what is tested")
def test_the_real_clock() -> None:
    began, event = REAL.now, threading.Event()
    REAL.sleep(0.02)
    assert REAL.now - began >= 0.02
    assert not REAL.wait(event, 0.01)
    setter = REAL.thread(lambda: (REAL.sleep(0.01), event.set()), "setter")
    setter.start()
    assert REAL.wait(event, 60)
    setter.join(60)
    with REAL.lock() as lock:
        assert lock
