"""Work beside a block: it ends with the block, and its errors come out there."""

import threading
import time
from collections.abc import Callable

import pytest

from cqn_train.loop.background import Background

Stop = Callable[[], bool]


def wait_for(ready: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 5
    while not ready():
        assert time.monotonic() < deadline
        time.sleep(0.001)


def test_it_runs_beside_and_ends_with_the_block() -> None:
    done: list[int] = []
    threads = set[str]()

    def work(stop: Stop) -> None:
        threads.add(threading.current_thread().name)
        while not stop():
            done.append(len(done))
            time.sleep(0.001)

    with Background(work):
        wait_for(lambda: len(done) > 3)
    ended = len(done)
    time.sleep(0.02)
    assert len(done) == ended  # joined: nothing learns while the run saves
    assert threads == {"updates"}


def test_work_that_is_done_early_does_not_end_the_block() -> None:
    with Background(lambda _: None):
        time.sleep(0.01)


@pytest.mark.parametrize("error", [ZeroDivisionError("learner"), KeyboardInterrupt()])
def test_its_error_surfaces_when_the_block_ends(error: BaseException) -> None:
    failed, reached = threading.Event(), list[str]()

    def work(_: Stop) -> None:
        failed.set()
        raise error

    def run() -> None:
        with Background(work):
            failed.wait(5)
            reached.append("the episode goes on")
        reached.append("nothing comes after")

    with pytest.raises(type(error)):
        run()
    assert reached == ["the episode goes on"]


def test_the_blocks_own_error_comes_first() -> None:
    def work(stop: Stop) -> None:
        while not stop():
            time.sleep(0.001)
        raise KeyError("later")

    with pytest.raises(ZeroDivisionError), Background(work):
        raise ZeroDivisionError
