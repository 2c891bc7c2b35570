"""Work in a thread of its own for as long as a block runs."""

import threading
from collections.abc import Callable
from types import TracebackType
from typing import Self

__all__ = ["Background"]


class Background:
    """Runs `work(stop)` beside a block, which ends once `stop()` is true; its errors surface when the block ends."""

    def __init__(self, work: Callable[[Callable[[], bool]], None]) -> None:
        self._stop = threading.Event()
        self._error: BaseException | None = None
        self._work = work
        self._thread = threading.Thread(target=self._run, name="updates", daemon=True)

    def _run(self) -> None:
        try:
            self._work(self._stop.is_set)
        except BaseException as error:  # the other thread raises it
            self._error = error

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()
        if self._error is not None and error is None:
            raise self._error
