"""Control of the session: which of the pages is the operator's, and whether anybody is there; no web in it."""

import threading
from collections import Counter
from collections.abc import Callable
from typing import Any

from lerobot_cqn.errors import CQNError

from ..clock import REAL, Clock
from .session import BY_ITSELF, Event, Label, RefusedError, Session, State

__all__ = ["Control", "ViewingOnlyError"]

LEFT_S = 2.0  # after the operator's page is closed; loading it anew takes less


class ViewingOnlyError(CQNError, PermissionError):
    """Only the operator may do this."""


class Control:
    """One operator, several viewers; safe to use from several threads.

    Who is seen first is the operator, until somebody takes over. While the arm moves, the operator must be seen every
    `absent_s` seconds, and within LEFT_S after closing the page; otherwise `check` lets the session pause.

    said: called with a line for people when control changes hands or nobody is there.
    """

    def __init__(
        self,
        session: Session,
        absent_s: float = 10.0,
        *,
        said: Callable[[str], None] = lambda _: None,
        clock: Clock = REAL,
    ) -> None:
        self._session, self._absent_s, self._said, self._clock = session, absent_s, said, clock
        self._operator: str | None = None
        self._seen = self._left = -float("inf")
        self._gone = True  # the operator has closed the page, or is none
        self._pages: Counter[str] = Counter()
        self._lock = threading.RLock()

    def seen(self, client: str) -> None:
        """A sign of life; makes this client the operator where there is none."""
        with self._lock:
            if self._operator is None:
                self._operator = client
            if client == self._operator:
                self._seen, self._gone = self._clock.now, False

    def opened(self, client: str) -> None:
        """A page of this client is connected."""
        with self._lock:
            self._pages[client] += 1
            self.seen(client)

    def closed(self, client: str) -> None:
        """A page of this client is no longer connected."""
        with self._lock:
            self._pages[client] -= 1
            if self._pages[client] <= 0:
                del self._pages[client]
                if client == self._operator:
                    self._left, self._gone = self._clock.now, True

    def take(self, client: str) -> None:
        """Make this client the operator."""
        with self._lock:
            changed = self._operator not in (None, client)
            self._operator = client
            self.seen(client)
        if changed:
            self._said(f"Control was taken over by the page {client[:4]}.")

    def apply(self, client: str | None, event: Event) -> State:
        """Apply what a person asks for. `stop` and `pause` are everybody's; the rest is the operator's alone.

        Raises ViewingOnlyError for others, RefusedError where the event has no place now or is not a person's.
        """
        if event in BY_ITSELF:
            raise RefusedError(f"'{event}' happens by itself: nobody can ask for it.")
        if client is not None:
            self.seen(client)
        if event not in (Event.STOP, Event.PAUSE):
            self._only_operator(client)
        return self._session.apply(event)

    def correct(self, client: str | None, episode: int, label: Label) -> None:
        """Say otherwise how an episode went. Raises ViewingOnlyError, or RefusedError for an unfinished one."""
        if client is not None:
            self.seen(client)
        self._only_operator(client)
        self._session.correct(episode, label)

    def check(self) -> bool:
        """Pause the session where the arm moves and nobody is there; to be called often. True: it did."""
        if not self._session.moving or self.present():
            return False
        return self.pause("Nobody is at the operator's page: the arm pauses.")

    def pause(self, why: str) -> bool:
        """Pause the session where the arm moves. True: it did."""
        try:
            self._session.apply(Event.ABSENT)
        except RefusedError:  # it came to rest meanwhile
            return False
        self._said(why)
        return True

    def present(self) -> bool:
        """Whether there is an operator who has been seen lately."""
        with self._lock:
            now = self._clock.now
            if self._operator is None or now - self._seen > self._absent_s:
                return False
            return not (self._gone and now - self._left > min(LEFT_S, self._absent_s))

    def snapshot(self, client: str | None) -> dict[str, Any]:
        """Presence of others as this client may know it: nobody learns the name under which another one acts."""
        with self._lock:
            return {
                "you": "operator" if client is not None and client == self._operator else "viewer",
                "operator": self._operator is not None, "present": self.present(), "pages": len(self._pages),
                "absent_s": self._absent_s,
            }  # fmt: skip

    def _only_operator(self, client: str | None) -> None:
        with self._lock:
            if client is None or client != self._operator:
                raise ViewingOnlyError("Viewing only: another page has control. Take control first.")
