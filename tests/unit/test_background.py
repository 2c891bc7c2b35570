"""Work beside a block: it ends with the block, and its errors come out there."""

import threading
import time
from collections.abc import Callable

import pytest

from cqn_train.loop.background import Background

Stop = Callable[[], bool]


def test_it_runs_beside_and_ends_with_the_block() -> None:
    done: list[int] = []
    threads, under_way = list[threading.Thread](), threading.Event()

    def work(stop: Stop) -> None:
        threads.append(threading.current_thread())
        while not stop():
            done.append(len(done))
            if len(done) > 3:
                under_way.set()
            time.sleep(0)  # lets the block go on

    with Background(work):
        assert under_way.wait(60)
    ended = len(done)
    assert not threads[0].is_alive()  # joined: nothing learns while the run saves
    assert len(done) == ended
    assert {thread.name for thread in threads} == {"updates"}


def test_work_that_is_done_early_does_not_end_the_block() -> None:
    threads, reached = list[threading.Thread](), list[str]()
    with Background(lambda _: threads.append(threading.current_thread())) as background:
        background._thread.join(60)
        assert not threads[0].is_alive()
        reached.append("the episode goes on")
    reached.append("and what comes after it")
    assert reached == ["the episode goes on", "and what comes after it"]


@pytest.mark.parametrize("error", [ZeroDivisionError("learner"), KeyboardInterrupt()])
def test_its_error_surfaces_when_the_block_ends(error: BaseException) -> None:
    failed, reached = threading.Event(), list[str]()

    def work(_: Stop) -> None:
        failed.set()
        raise error

    def run() -> None:
        with Background(work):
            assert failed.wait(60)
            reached.append("the episode goes on")
        reached.append("nothing comes after")

    with pytest.raises(type(error)):
        run()
    assert reached == ["the episode goes on"]


def test_the_blocks_own_error_comes_first() -> None:
    def work(stop: Stop) -> None:
        while not stop():
            time.sleep(0)
        raise KeyError("later")

    with pytest.raises(ZeroDivisionError), Background(work):
        raise ZeroDivisionError
