"""What every page has: its own files, answers of one line to what is refused, bodies that are checked."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_cqn.errors import ConfigError

if TYPE_CHECKING:
    from fastapi import FastAPI

__all__ = ["MAX_BODY", "NonsenseError", "add_errors", "add_files", "body", "check", "error", "need_extra", "parsed"]

MAX_BODY = 4096  # bytes of a request or message
KINDS = {".html": "text/html", ".js": "text/javascript", ".css": "text/css"}


class NonsenseError(ValueError):
    """A message that cannot be understood; the error says what was expected."""


def need_extra(page: str, instead: str = "") -> None:
    """Raises ConfigError where the packages that serve `page` are missing; `instead` says what works without them."""
    try:
        import fastapi  # noqa: F401
        import uvicorn  # noqa: F401
        import websockets  # noqa: F401
    except ImportError as problem:
        raise ConfigError(
            f"{page} needs the package {problem.name}: pip install 'lerobot_policy_cqn[page]'{instead}."
        ) from problem


def error(status: int, text: str) -> Any:
    """An answer that says in one line what is wrong."""
    from fastapi.responses import JSONResponse

    return JSONResponse({"error": " ".join(text.split())}, status)


def add_errors(app: "FastAPI", statuses: Mapping[type[Exception], int]) -> None:
    """Answers of one line to all that is refused; `statuses` has those of a page's own errors."""
    from fastapi.exceptions import RequestValidationError
    from starlette.exceptions import HTTPException

    def handle(kind: type[Exception], status: int) -> None:
        async def answer(_: Any, problem: Exception) -> Any:
            return error(status, str(problem))

        app.add_exception_handler(kind, answer)

    async def not_found(_: Any, problem: Exception) -> Any:
        return error(getattr(problem, "status_code", 400), str(getattr(problem, "detail", problem)))

    async def invalid(_: Any, problem: Exception) -> Any:
        found = problem.errors() if isinstance(problem, RequestValidationError) else []
        return error(422, "; ".join(f"{entry['loc'][-1]}: {entry['msg']}" for entry in found))

    app.add_exception_handler(HTTPException, not_found)
    app.add_exception_handler(RequestValidationError, invalid)
    handle(NonsenseError, 422)
    for kind, status in statuses.items():
        handle(kind, status)


def add_files(app: "FastAPI", folder: Path) -> frozenset[str]:
    """The page itself, read once; returns the paths, which need no token: there are no data in them."""
    from fastapi import Response

    def add(path: str, content: bytes, kind: str) -> None:
        async def route() -> Any:
            return Response(content, media_type=kind)

        app.get(path)(route)

    public = set()
    for file in sorted(folder.iterdir()):
        if file.suffix in KINDS:
            path = "/" if file.name == "index.html" else f"/{file.name}"
            add(path, file.read_bytes(), KINDS[file.suffix])
            public.add(path)
    return frozenset(public)


async def body(request: Any, expected: Mapping[str, type]) -> dict[str, Any]:
    """The body as the JSON object that is expected, {} for none where nothing is. Raises NonsenseError."""
    data = b""
    async for chunk in request.stream():
        data += chunk
        if len(data) > MAX_BODY:
            raise NonsenseError(f"The body is too long: expected at most {MAX_BODY} bytes.")
    given = parsed(data) if data or expected else {}
    check(given, expected)
    return given


def parsed(data: bytes) -> dict[str, Any]:
    """A JSON object. Raises NonsenseError for anything else."""
    try:
        given = json.loads(data)
    except (ValueError, RecursionError) as problem:
        raise NonsenseError("Expected a JSON object.") from problem
    if not isinstance(given, dict):
        raise NonsenseError("Expected a JSON object.")
    return given


def check(given: Mapping[str, Any], expected: Mapping[str, type]) -> None:
    """Raises NonsenseError where the fields are others than these, or of another type."""
    fits = given.keys() == expected.keys() and all(type(given[name]) is kind for name, kind in expected.items())
    if not fits:
        names = ", ".join(f'"{name}" ({kind.__name__})' for name, kind in expected.items()) or "no fields"
        raise NonsenseError(f"Expected a JSON object with exactly {names}.")
