"""Checks that every request passes before it reaches a route: host, origin, token, size; as plain ASGI."""

import ipaddress
import json
import secrets
import time
from collections import deque
from collections.abc import Awaitable, Callable, Collection, Mapping
from typing import Any
from urllib.parse import parse_qs, urlsplit

__all__ = ["Guard"]

Scope = dict[str, Any]
Message = dict[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

LOCAL = frozenset({"localhost", "127.0.0.1", "::1"})
ANY_ADDRESS = frozenset({"0.0.0.0", "::"})  # noqa: S104  # compared with, not bound to
MAX_QUERY = 2048
MOST_WRONG, LOCKED_S, MOST_ADDRESSES = 20, 60.0, 1000  # wrong tokens of an address within so many seconds
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; media-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = [
    (b"cache-control", b"no-store"),
    (b"content-security-policy", POLICY.encode()),
    (b"referrer-policy", b"no-referrer"),
    (b"x-content-type-options", b"nosniff"),
]


class Guard:
    """Refuses what comes from elsewhere or without the token; only `public` paths may be read without it.

    host: what the server listens on; requests must name it, or this machine. Where it listens on every address, they
    may name any address: names of other people's domains, which could be made to point here, stay refused.
    """

    def __init__(self, app: App, token: str, host: str, public: Collection[str]) -> None:
        self._app, self._token, self._public = app, token.encode(), frozenset(public)
        self._names = LOCAL | {host.strip("[]").lower()}
        self._any_address = host.strip("[]") in ANY_ADDRESS
        self._wrong: dict[str, deque[float]] = {}  # by address: when its last wrong tokens came

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One connection."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        refusal = self._refusal(scope)
        if refusal is not None:
            await _refuse(scope, send, *refusal)
            return

        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                message = message | {"headers": [*message.get("headers", ()), *HEADERS]}
            await send(message)

        await self._app(scope, receive, answer)

    def _refusal(self, scope: Scope) -> tuple[int, str] | None:
        """Status and reason, or None for what may pass."""
        headers: dict[bytes, bytes] = {name.lower(): value for name, value in scope["headers"]}
        host = headers.get(b"host", b"").decode("latin-1")
        if not self._is_ours(host):
            return 403, "The Host header names another machine: open the page by the address that was printed."
        origin = headers.get(b"origin")
        if origin is not None and _netloc(origin.decode("latin-1")) != host.lower():
            return 403, "The Origin header names another page: open this one by the address that was printed."
        if scope["type"] == "http" and scope["method"] == "GET" and scope["path"] in self._public:
            return None
        if len(scope["query_string"]) > MAX_QUERY:
            return 414, "The query is too long."
        if not self._has_token(scope["query_string"], headers):
            return self._stranger(scope, headers)
        return None

    def _is_ours(self, host: str) -> bool:
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        return name in self._names or (self._any_address and _is_address(name))

    def _stranger(self, scope: Scope, headers: Mapping[bytes, bytes]) -> tuple[int, str]:
        """Answer to who has no right token: another one where an address gave more than a person does by mistake."""
        told = 401, "The token is missing or wrong: open the page by the address that was printed, with its token."
        if b"token=" not in scope["query_string"] and b"x-token" not in headers:  # no guess
            return told
        address, now = str((scope.get("client") or ("",))[0]), time.monotonic()
        if len(self._wrong) > MOST_ADDRESSES:
            self._wrong.clear()
        times = self._wrong.setdefault(address, deque(maxlen=MOST_WRONG + 1))
        times.append(now)
        locked = len(times) > MOST_WRONG and now - times[0] < LOCKED_S
        return (429, f"Too many wrong tokens: wait {LOCKED_S:.0f} s. The right one is let in.") if locked else told

    def _has_token(self, query: bytes, headers: Mapping[bytes, bytes]) -> bool:
        try:
            given = [value.encode() for value in parse_qs(query.decode("latin-1")).get("token", [])[:1]]
        except ValueError:
            given = []
        given += [headers[b"x-token"]] if b"x-token" in headers else []
        # Each is compared in full: how long that takes must not tell how much of it was right.
        return any([secrets.compare_digest(token, self._token) for token in given])  # noqa: C419


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _netloc(origin: str) -> str:
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""


async def _refuse(scope: Scope, send: Send, status: int, reason: str) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008, "reason": reason[:120]})
        return
    body = json.dumps({"error": reason}).encode()
    headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode()), *HEADERS]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})
