"""Collectors in threads of this process, that die when asked to: what Ray does between processes, in milliseconds."""

import os
import random
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

from cqn_train.cluster.calls import Gone
from cqn_train.cluster.collector import Collector
from cqn_train.cluster.spool import Spool
from cqn_train.loop.acting import Finished

BESIDE = ("pulse", "stored", "stop")


class Watched(Spool):
    """A spool that remembers what was ever put into it."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.seen: list[str] = []

    def put(self, finished: Finished) -> None:
        super().put(finished)
        self.seen.append(finished.turn.key)


class ThreadedCalls:
    """A transport of `Fleet` without Ray. dies: how often a call's answer is lost together with its collector."""

    def __init__(self, configs: Sequence[Mapping[str, Any]], folder: Path, dies: float = 0.0, seed: int = 0) -> None:
        self._configs, self.spool, self._dies = configs, Watched(folder), dies
        self._rng = random.Random(seed)
        self.deaths = 0
        self.called: list[tuple[int, str]] = []
        self._collectors = [self._new(index) for index in range(len(configs))]
        self._acting = [ThreadPoolExecutor(1) for _ in configs]
        self._beside = [ThreadPoolExecutor(1) for _ in configs]
        self._lock = threading.Lock()
        self.before: Callable[[int, str], None] = lambda _index, _method: None  # called in the collector's thread

    def _new(self, index: int) -> Collector:
        collector = Collector(index, self._configs[index], (), os.getcwd())
        collector._spool = self.spool
        return collector

    def call(self, collector: int, method: str, *arguments: Any) -> Any:
        self.called.append((collector, method))
        pool = self._beside if method in BESIDE else self._acting
        return pool[collector].submit(self._run, collector, method, arguments)

    def _run(self, index: int, method: str, arguments: Sequence[Any]) -> Any:
        with self._lock:
            before, dies = self._rng.random() < self._dies / 2, self._rng.random() < self._dies / 2
            collector = self._collectors[index]
        self.before(index, method)
        if before:
            self._die(index)
        answer = getattr(collector, method)(*arguments)
        if dies:  # it did what it was asked, and nobody hears of it
            self._die(index)
        return answer

    def _die(self, index: int) -> None:
        with self._lock:
            self._collectors[index] = self._new(index)
            self.deaths += 1
        raise Gone("killed by the test")

    def shared(self, value: Any) -> Any:
        return value

    def answered(self, promises: Sequence["Future[Any]"], timeout_s: float) -> Sequence[Any]:
        return [*wait(promises, timeout_s, FIRST_COMPLETED).done]

    def answer(self, promise: "Future[Any]") -> Any:
        return promise.result()
