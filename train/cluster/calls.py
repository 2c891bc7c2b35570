"""The way from the learner to its collectors, as `Fleet` sees it."""

from collections.abc import Sequence
from typing import Any, Protocol

__all__ = ["Calls", "Gone"]


class Gone(Exception):  # noqa: N818  # a state of affairs
    """A collector that does not answer: its process, its node or the way there is gone."""


class Calls(Protocol):
    """The way to the collectors: calls that are answered later. Answers raise CQNError, or Gone."""

    def call(self, collector: int, method: str, *arguments: Any) -> Any:
        """Ask; returns a promise."""
        ...

    def shared(self, value: Any) -> Any:
        """Something that several calls can be given and that travels once."""
        ...

    def answered(self, promises: Sequence[Any], timeout_s: float) -> Sequence[Any]:
        """Those of the promises that are answered, waiting for the first one so long at most."""
        ...

    def answer(self, promise: Any) -> Any:
        """The answer to an answered promise."""
        ...
