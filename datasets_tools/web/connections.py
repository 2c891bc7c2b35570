"""How many connections a page's server keeps, and for how long one may stay without a whole request."""

import asyncio
from typing import Any

__all__ = ["HEAD_S", "MOST_CONNECTIONS", "bounded_protocol"]

MOST_CONNECTIONS = 64  # of the process's descriptors, of which saving needs some, too
HEAD_S = 5.0  # for the head of a first request


def bounded_protocol(most: int = MOST_CONNECTIONS, head_s: float = HEAD_S) -> type[Any]:
    """Uvicorn's HTTP protocol with bounds, for one server.

    A connection that brings no whole request within `head_s` seconds is closed. Where `most` are open, the oldest of
    those that have brought none makes room, so that whoever asks for something at once always gets in.
    """
    from uvicorn.protocols.http.h11_impl import H11Protocol

    waiting: dict[Any, asyncio.TimerHandle] = {}  # in the order in which they came

    class Bounded(H11Protocol):
        """One connection."""

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            if len(self.connections) > most:
                oldest = next(iter(waiting), self)
                oldest.transport.abort()
                if oldest in waiting:  # at once: the next one must not choose it again
                    waiting.pop(oldest).cancel()
            waiting[self] = asyncio.get_running_loop().call_later(head_s, transport.abort)

        def data_received(self, data: bytes) -> None:
            super().data_received(data)
            if self.headers is not None:  # of a whole request, which may have become a WebSocket
                self._counted()

        def connection_lost(self, exc: Exception | None) -> None:
            self._counted()
            super().connection_lost(exc)

        def _counted(self) -> None:
            if (deadline := waiting.pop(self, None)) is not None:
                deadline.cancel()

    return Bounded
