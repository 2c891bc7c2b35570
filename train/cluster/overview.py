"""The overview of several arms: one page that shows what each does, with the way to its own page."""

import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cqn_data.web import routes as web
from cqn_data.web.access import Guard
from cqn_data.web.server import PageServer
from cqn_data.web.tls import Certificate

if TYPE_CHECKING:
    from fastapi import FastAPI

__all__ = ["Overview", "make_app", "server"]


class Overview:
    """What the page shows, put together by the process that shows the run; it is a `Monitor`."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._seen: dict[str, Any] = {"phase": "", "done": 0, "total": 0, "note": "", "arms": [], "lines": []}

    def phase(self, name: str, total: int, done: int) -> None:
        """A phase of `total` units begins, `done` of them already behind."""
        self._note(phase=name, total=total, done=done)

    def advance(self, done: int, note: str) -> None:
        """Progress within the phase."""
        self._note(done=done, **({"note": note} if note else {}))

    def message(self, text: str) -> None:
        """A line that stays."""
        with self._lock:
            self._seen["lines"] = [*self._seen["lines"], text][-50:]

    def arms(self, seats: Sequence[Mapping[str, Any]]) -> None:
        """The collectors as they are."""
        self._note(arms=[dict(seat) for seat in seats])

    def _note(self, **values: Any) -> None:
        with self._lock:
            self._seen |= values

    def snapshot(self) -> dict[str, Any]:
        """All of it as plain values."""
        with self._lock:
            return dict(self._seen)


def make_app(overview: Overview, token: str, host: str = "127.0.0.1") -> "FastAPI":
    """The FastAPI app that shows it. Raises ConfigError without FastAPI."""
    web.need_extra("The overview of the arms")
    from fastapi import FastAPI

    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None, redirect_slashes=False)
    web.add_errors(app, {})

    @app.get("/api/state")
    async def state() -> dict[str, Any]:
        return overview.snapshot()

    public = web.add_files(app, Path(__file__).parent / "static")
    app.add_middleware(Guard, token=token, host=host, public=public)
    return app


def server(
    overview: Overview, host: str, port: int, token: str | None, certificate: Certificate | None = None
) -> PageServer:
    """Serves the overview while it is entered. Raises ConfigError for a port in use."""
    return PageServer(
        lambda token: make_app(overview, token, host), "overview", host, port, token, certificate=certificate
    )
