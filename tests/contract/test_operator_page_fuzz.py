"""The operator's page under anything at all: nothing breaks, and nothing changes without the token."""

import json
import socket
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cqn_train.operator.board import Board
from cqn_train.operator.session import BY_ITSELF, TRANSITIONS, Event, State

pytest.importorskip("fastapi", reason="needs the extra [page]")

from fastapi.testclient import TestClient

from cqn_train.operator.page.server import OperatorServer

from .operator_clients import (  # noqa: F401  # fixtures
    TOKEN,
    board_fixture,
    client_fixture,
    clock_fixture,
    server_fixture,
)

words = st.sampled_from(
    ["event", "start", "stop", "pause", "success", "fault", "absent", "label", "episode", "id", "client", "token", "x"]
)
values = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(allow_nan=True), words, st.text(max_size=5)),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(words, inner, max_size=3)),
    max_leaves=5,
)
events = st.builds(lambda e: {"event": e}, st.sampled_from([str(event) for event in Event]))
labels = st.builds(
    lambda n, w: {"episode": n, "label": w}, st.integers(-2, 3), st.sampled_from(["success", "failure", "x"])
)
bodies = st.one_of(
    st.binary(max_size=20), st.one_of(values, events, labels).map(lambda value: json.dumps(value).encode())
)
pieces = st.sampled_from(
    ["api", "state", "event", "correct", "control", "camera", "film", "front", "front.jpg", "0", "-1", "9" * 30, "..",
     "%2e%2e", "%00", "ws", "page.js", "a b", "ä", "", "{name}"]
)  # fmt: skip
routes = st.one_of(
    st.sampled_from(["/api/state", "/api/event", "/api/correct", "/api/control", "/api/film/0/front", "/"]),
    st.lists(pieces, max_size=4).map(lambda parts: "/" + "/".join(parts)),
)
queries = st.dictionaries(
    st.sampled_from(["token", "client", "frame", "x"]),
    st.one_of(words, st.text(max_size=5), st.integers().map(str)), max_size=3,
)  # fmt: skip
methods = st.sampled_from(["GET", "POST", "POST", "POST", "PUT", "DELETE", "HEAD", "OPTIONS", "PATCH"])
names = st.sampled_from(["X-Client", "Origin", "Content-Type", "Accept", "X-Forwarded-Host", "X-Token", "Range"])
extra = st.dictionaries(names, st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=8), max_size=3)
FUZZ = settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])


def ask(client: TestClient, method: str, path: str, query: dict, headers: dict, body: bytes) -> Any:
    """The answer to a request by its whole address: of `//api` alone the client would take `api` for a host."""
    return client.request(method, f"{client.base_url}{path}", params=query, headers=headers, content=body)


@FUZZ
@given(methods, routes, queries, extra, bodies)
def test_without_the_token_nothing_changes_whatever_is_sent(
    client: TestClient, board: Board, method: str, path: str, query: dict, headers: dict, body: bytes
) -> None:
    before = (board.session.snapshot(), client.app.state.control.snapshot(None))
    answer = ask(client, method, path, query, headers, body)
    # What was asked for, once the client has put it straight: "/.." is "/".
    page = answer.request.method == "GET" and answer.request.url.path in client.app.state.public
    assert answer.status_code in (401, 403, 429) or (page and answer.status_code in (200, 206, 304, 416))
    assert (board.session.snapshot(), client.app.state.control.snapshot(None)) == before


@FUZZ
@given(st.sampled_from(State), methods, routes, queries, extra, bodies, st.sampled_from([None, "ann", "bob"]))
def test_with_the_token_only_what_the_state_machine_allows(
    client: TestClient, board: Board, state: State, method: str, path: str, query: dict, headers: dict, body: bytes,
    who: str | None,
) -> None:  # fmt: skip
    session = board.session
    session.state, session.episode, session.labels, session.busy = state, 0, {0: "success"}, ""
    client.app.state.control.take("ann")
    query = {name: value for name, value in query.items() if name != "token"} | ({"client": who} if who else {})
    headers = {name: value for name, value in headers.items() if name != "Origin"} | {"X-Token": TOKEN}
    answer = ask(client, method, path, query, headers, body)
    assert answer.status_code < 500
    if session.state is not state:
        allowed = {target for event, target in TRANSITIONS[state].items() if event not in BY_ITSELF}
        assert session.state in allowed
        assert (method, path) == ("POST", "/api/event")
        assert session.state is State.STOPPED or query.get("client", headers.get("X-Client")) == "ann"


@FUZZ
@given(st.lists(st.one_of(st.text(max_size=20), st.one_of(values, events).map(json.dumps)), max_size=6))
def test_whatever_comes_over_the_websocket_is_answered(client: TestClient, board: Board, texts: list[str]) -> None:
    board.session.state, board.session.busy = State.WAITING, ""
    client.app.state.control.take("ann")
    with client.websocket_connect(f"ws://127.0.0.1/ws?token={TOKEN}&client=ann") as page:
        for text in texts:
            page.send_text(text)
        page.send_bytes(b"\x00\x01")
        page.send_json({"event": "stop", "id": 77})
        while (message := page.receive_json()).get("answer") != 77:
            assert "snapshot" in message or isinstance(message["ok"], bool)
        assert message["ok"]


steps = st.sampled_from(["", "api", "state", "event", "..", ".", "%2e%2e", "%00", "ws"])
targets = st.one_of(
    st.lists(steps, min_size=1, max_size=5).map(lambda parts: "/" + "/".join(parts)),
    st.sampled_from(["*", "//", "////api", "http://127.0.0.1/api/state", "//evil.example/api/state", "/api/state?"]),
    st.text(st.characters(min_codepoint=33, max_codepoint=255), max_size=12),
).map(lambda text: text.encode("latin-1"))


@FUZZ
@given(st.sampled_from([b"GET", b"POST", b"HEAD", b"CONNECT", b"", b"get"]), targets)
def test_what_no_client_would_send_is_refused_by_the_server(
    server: OperatorServer, board: Board, method: bytes, target: bytes
) -> None:
    """Bytes over a socket: no client puts the path straight, or refuses it, before the server sees it."""
    before = (board.session.snapshot(), server.control.snapshot(None))
    host = f"127.0.0.1:{server.port}".encode()
    with socket.create_connection(("127.0.0.1", server.port), timeout=60) as raw:
        raw.sendall(method + b" " + target + b" HTTP/1.1\r\nHost: " + host + b"\r\nConnection: close\r\n\r\n")
        answer = raw.makefile("rb").readline().split()
    assert answer[0] == b"HTTP/1.1"
    page = target.partition(b"?")[0] == b"/" and answer[1] == b"200"
    assert page or answer[1] in (b"400", b"401", b"403", b"429")
    assert (board.session.snapshot(), server.control.snapshot(None)) == before
