"""The routes of the operator's page. Everything but the page itself passes the token first (`cqn_data.web.access`)."""

import asyncio
import contextlib
import re
from collections.abc import AsyncIterator, Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cqn_data.web import routes as web
from cqn_data.web.access import Guard
from cqn_data.web.routes import MAX_BODY, NonsenseError, add_errors, add_files, body, check, error, parsed

from ..board import Board
from ..control import Control, ViewingOnlyError
from ..session import BY_ITSELF, Event, Label, RefusedError

if TYPE_CHECKING:
    from fastapi import FastAPI

__all__ = ["MAX_BODY", "make_app", "need_extra"]

MAX_PAGES = 16  # that are open at once
PUSH_S = 0.5  # between two snapshots where nothing happens
CLIENT = re.compile(r"[A-Za-z0-9_-]{1,64}")


def need_extra() -> None:
    """Raises ConfigError where the packages of the page are missing."""
    web.need_extra("The operator's page", ", or steer with the keys of the terminal")


def make_app(
    board: Board, token: str, control: Control | None = None, *, host: str = "127.0.0.1", check_s: float = 0.25
) -> "FastAPI":
    """The FastAPI app that shows `board` and steers its session.

    token: must come with every request but those for the page's own files. host: the name it is reached by, besides
    this machine's. check_s: seconds between two looks whether the operator is there. Raises ConfigError without
    FastAPI.
    """
    need_extra()
    from fastapi import FastAPI

    control = control if control is not None else Control(board.session, said=board.message)
    pages: set[asyncio.Event] = set()

    def wake() -> None:
        for page in pages:
            page.set()

    async def watch() -> None:
        while True:
            with contextlib.suppress(Exception):  # one failed look must not be the last
                control.check()
            await asyncio.sleep(check_s)

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        loop = asyncio.get_running_loop()
        forget = board.listen(lambda: _later(loop, wake))
        watching = asyncio.create_task(watch())
        yield
        forget()
        watching.cancel()

    app = FastAPI(lifespan=lifespan, docs_url=None, redoc_url=None, openapi_url=None, redirect_slashes=False)
    app.state.control = control
    add_errors(app, {ViewingOnlyError: 403, RefusedError: 409})
    _add_actions(app, board, control, wake)
    _add_pictures(app, board)
    _add_socket(app, board, control, pages, wake)
    app.state.public = add_files(app, Path(__file__).parent / "static")
    app.add_middleware(Guard, token=token, host=host, public=app.state.public)
    return app


def _later(loop: asyncio.AbstractEventLoop, call: Callable[[], None]) -> None:
    loop.call_soon_threadsafe(call)


def _add_actions(app: "FastAPI", board: Board, control: Control, wake: Callable[[], None]) -> None:
    """Routes that a script needs, too: the state, and everything that a person may do."""
    from fastapi import Request
    from fastapi.responses import JSONResponse

    @app.get("/api/state")
    async def _(request: Request) -> JSONResponse:
        client = _client(request.query_params, request.headers)
        if client is not None:
            control.seen(client)
        return JSONResponse(_state(board, control, client))

    @app.post("/api/event")
    async def _(request: Request) -> JSONResponse:
        given = await body(request, {"event": str})
        event = _event(given["event"])
        client = None
        try:
            client = _client(request.query_params, request.headers)
        except NonsenseError:
            if event is not Event.STOP:  # whoever asks for it, however badly
                raise
        return JSONResponse({"ok": True, "state": str(control.apply(client, event))})

    @app.post("/api/correct")
    async def _(request: Request) -> JSONResponse:
        given = await body(request, {"episode": int, "label": str})
        if given["label"] not in list(Label):
            raise NonsenseError(f"Unknown label {given['label'][:40]!r}: expected one of {', '.join(Label)}.")
        control.correct(_client(request.query_params, request.headers), given["episode"], Label(given["label"]))
        return JSONResponse({"ok": True})

    @app.post("/api/control")
    async def _(request: Request) -> JSONResponse:
        await body(request, {})
        client = _client(request.query_params, request.headers)
        if client is None:
            raise NonsenseError("Say who takes control: expected `client=` in the query.")
        control.take(client)
        wake()
        return JSONResponse({"ok": True})


def _add_pictures(app: "FastAPI", board: Board) -> None:
    """Cameras and films. Not `async`: pictures are encoded beside the loop that answers requests."""
    from fastapi import Response
    from fastapi.responses import JSONResponse

    def jpeg(data: bytes | None, what: str) -> Any:
        return error(404, f"There is no such {what}.") if data is None else Response(data, media_type="image/jpeg")

    @app.get("/api/camera/{name:path}.jpg")
    def _(name: str) -> Any:
        return jpeg(board.jpeg(name), "camera")

    @app.get("/api/film/{episode}/{camera:path}")
    def _(episode: int, camera: str, frame: int | None = None) -> Any:
        if frame is not None:
            return jpeg(board.film_jpeg(episode, camera, frame), "picture")
        times = board.film_times(episode, camera)
        return error(404, "There is no such film.") if times is None else JSONResponse({"times": times})


def _add_socket(
    app: "FastAPI", board: Board, control: Control, pages: set[asyncio.Event], wake: Callable[[], None]
) -> None:
    """The page's connection: the state at each change, signs of life and events the other way."""
    from fastapi import WebSocket, WebSocketDisconnect

    @app.websocket("/ws")
    async def _(socket: WebSocket) -> None:
        try:
            client = _client(socket.query_params, socket.headers)
        except NonsenseError:
            client = None
        if client is None or len(pages) >= MAX_PAGES:
            await socket.close(1008 if client is None else 1013)
            return
        changed, pushing = asyncio.Event(), None
        pages.add(changed)
        control.opened(client)
        wake()
        try:
            await socket.accept()
            pushing = asyncio.create_task(_push(socket, changed, lambda: _state(board, control, client)))
            while (message := await socket.receive())["type"] != "websocket.disconnect":
                control.seen(client)
                answer = _answer(message.get("text"), lambda event: control.apply(client, event))
                if answer is not None:
                    await socket.send_json(answer)
        except (WebSocketDisconnect, RuntimeError, OSError):  # it went away in the middle
            pass
        finally:
            pages.discard(changed)
            control.closed(client)
            wake()
            if pushing is not None:
                pushing.cancel()


def _state(board: Board, control: Control, client: str | None) -> dict[str, Any]:
    return board.snapshot() | {"control": control.snapshot(client)}


async def _push(socket: Any, changed: asyncio.Event, state: Callable[[], dict[str, Any]]) -> None:
    """Send the state at each change, and every PUSH_S seconds, until the page is gone."""
    with contextlib.suppress(Exception):  # the page is gone: whoever receives from it notices, too
        while True:
            changed.clear()
            await socket.send_json({"snapshot": state()})
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(changed.wait(), PUSH_S)


def _answer(text: str | None, apply: Callable[[Event], Any]) -> dict[str, Any] | None:
    """Answer to a message of a page; None to a sign of life."""
    number: int | None = None
    try:
        given = parsed((text or "").encode(errors="replace"))
        if given == {"alive": True}:
            return None
        asked = given.get("id")
        number = asked if isinstance(asked, int) and not isinstance(asked, bool) and abs(asked) < 2**53 else None
        check(given, {"event": str, "id": int})
        after = apply(_event(given["event"]))
    except (NonsenseError, RefusedError, ViewingOnlyError) as problem:
        return {"answer": number, "ok": False, "error": str(problem)}
    return {"answer": number, "ok": True, "state": str(after)}


def _event(name: str) -> Event:
    events = [event for event in Event if event not in BY_ITSELF]
    if name not in events:
        raise NonsenseError(f"Unknown event {name[:40]!r}: expected one of {', '.join(events)}.")
    return Event(name)


def _client(query: Mapping[str, str], headers: Mapping[str, str]) -> str | None:
    """Name of the client, by `client=` or the header X-Client; None where none is given."""
    given = query.get("client", headers.get("x-client"))
    if given is not None and not CLIENT.fullmatch(given):
        raise NonsenseError("The client's name is 1 to 64 letters, digits, '-' or '_'.")
    return given
