"""The operator's page over HTTP and WebSocket: what needs the token, who may steer, what nobody can break."""

import collections
import contextlib
import json
import socket
import threading
import time
from typing import Any

import numpy as np
import pytest

from cqn_train.operator.board import Board
from cqn_train.operator.session import Event, Session, State
from lerobot_cqn.errors import ConfigError

pytest.importorskip("fastapi", reason="needs the extra [page]")
httpx = pytest.importorskip("httpx")

from fastapi.testclient import TestClient  # noqa: E402
from starlette.websockets import WebSocketDisconnect  # noqa: E402
from websockets.exceptions import ConnectionClosed, InvalidStatus  # noqa: E402

from cqn_train.operator.page.app import MAX_BODY, MAX_PAGES, need_extra  # noqa: E402
from cqn_train.operator.page.server import OperatorServer, make_app  # noqa: E402

from ..driven_clock import DrivenClock  # noqa: E402
from .operator_clients import (  # noqa: E402, F401  # fixtures among them
    ANN,
    BOB,
    TOKEN,
    board_fixture,
    client_fixture,
    clock_fixture,
    page_of,
    server_fixture,
    until,
)

WS = "ws://127.0.0.1:8000"


def film(board: Board) -> None:
    board.session.apply(Event.START)
    board.begin_episode(0)
    board.show({"front": np.zeros((48, 64, 3), np.uint8)})
    board.session.apply(Event.SUCCESS)
    board.end_episode(0, 1, 1.0)
    board.session.learning("")


def refused(client: TestClient, path: str, code: int = 1008, **headers: str) -> None:
    """A WebSocket that is not let in."""
    with pytest.raises(WebSocketDisconnect) as caught, client.websocket_connect(WS + path, headers=headers):
        pass
    assert caught.value.code == code


# --- The token.


def paths(client: TestClient) -> list[tuple[str, str]]:
    """Every route with every method, its parameters filled in."""
    found = []
    for route in client.app.routes:
        path = route.path.replace("{name:path}", "front").replace("{episode}", "0").replace("{camera:path}", "front")
        assert "{" not in path, f"say here what to fill in for {route.path}"
        found += [(method, path) for method in getattr(route, "methods", None) or ["WEBSOCKET"]]
    return found


def test_every_route_but_the_page_needs_the_token(client: TestClient, board: Board) -> None:
    film(board)
    before, routes = board.session.snapshot(), paths(client)
    assert {path for _, path in routes} >= {"/", "/ws", "/api/state", "/api/event", "/api/camera/front.jpg"}
    public = {"/", "/page.js", "/style.css", "/cameras.js", "/curve.js", "/film.js"}
    assert client.app.state.public == public  # and each is the same whatever goes on
    wrong = [{}, {"X-Token": ""}, {"X-Token": TOKEN[:-1]}, {"X-Token": TOKEN + "x"}, {"X-Token": "ä"}]
    for method, path in routes:
        for number, headers in enumerate(wrong):
            query = "?client=a" + (f"&token={headers['X-Token']}" if number % 2 else "")
            if method == "WEBSOCKET":
                refused(client, f"{path}{query}")
                continue
            sent = {name: value.encode() for name, value in headers.items()}
            answer = client.request(method, path + query, headers=sent, json={"event": "stop"})
            if path in public and method == "GET":
                assert answer.status_code == 200
            else:
                assert answer.status_code in (401, 429), (method, path)  # many wrong ones
                assert " wrong" in answer.json()["error"]
    assert board.session.snapshot() == before


def test_without_the_token_nothing_is_told_of_what_there_is(client: TestClient) -> None:
    for path in ("/nowhere", "/docs", "/openapi.json", "/static/../session.py", "/..%2fsession.py", "/index.html"):
        assert client.get(path).status_code == 401
        assert client.get(path, headers=ANN).status_code == 404


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example", "localhost@evil.example", "", "[", "10.0.0.9"]
)
def test_other_names_for_this_machine_are_refused(client: TestClient, host: str) -> None:
    answer = client.get("/", headers={"Host": host})
    assert answer.status_code == 403
    assert "Host header" in answer.json()["error"]
    assert client.get("/api/state", headers=ANN | {"Host": host}).status_code == 403


@pytest.mark.parametrize("host", ["localhost:1", "127.0.0.1:9", "[::1]:9", "LOCALHOST", "127.0.0.1"])
def test_names_of_this_machine_are_fine(client: TestClient, host: str) -> None:
    assert client.get("/api/state", headers=ANN | {"Host": host}).status_code == 200


def test_on_every_address_any_address_may_be_named_but_no_foreign_name(board: Board) -> None:
    client = TestClient(make_app(board, TOKEN, host="::"), base_url="http://192.168.1.7:80")
    assert client.get("/api/state", headers=ANN).status_code == 200
    assert client.get("/api/state", headers=ANN | {"Host": "evil.example"}).status_code == 403


@pytest.mark.parametrize("origin", ["http://evil.example", "http://localhost:9999", "null", "http://["])
def test_other_pages_are_refused(client: TestClient, board: Board, origin: str) -> None:
    refused(client, f"/ws?token={TOKEN}&client=ann", Origin=origin, Host="localhost:8000")
    answer = client.post("/api/event", headers=ANN | {"Origin": origin}, json={"event": "stop"})
    assert answer.status_code == 403
    assert board.session.state is State.WAITING


def test_the_own_page_is_fine(client: TestClient) -> None:
    with client.websocket_connect(
        f"{WS}/ws?token={TOKEN}&client=ann", headers={"Origin": "http://localhost:8000", "Host": "localhost:8000"}
    ) as page:
        assert page.receive_json()["snapshot"]["control"]["you"] == "operator"


def test_headers_that_keep_others_out(client: TestClient) -> None:
    headers = client.get("/").headers
    assert "default-src 'none'" in headers["content-security-policy"]
    assert (headers["referrer-policy"], headers["cache-control"]) == ("no-referrer", "no-store")


# --- What is shown and asked.


def test_state_pictures_and_films(client: TestClient, board: Board) -> None:
    film(board)
    board.show({"a/b": np.zeros((4, 4, 3), np.uint8)})
    state = client.get("/api/state", headers=ANN).json()
    assert state["session"]["labels"] == {"0": "success"}
    assert state["finished"][0]["film"] is True
    for path in ("/api/camera/front.jpg", "/api/camera/a%2Fb.jpg", "/api/film/0/front?frame=0"):
        answer = client.get(path, headers=ANN)
        assert answer.headers["content-type"] == "image/jpeg"
        assert answer.content[:2] == b"\xff\xd8"
    assert client.get("/api/film/0/front", headers=ANN).json() == {"times": [0.0]}
    for path in ("/api/camera/no.jpg", "/api/film/7/front", "/api/film/0/no", "/api/film/0/front?frame=9"):
        assert client.get(path, headers=ANN).status_code == 404
    assert client.get("/api/film/x/front", headers=ANN).status_code == 422


def test_a_session_over_http(client: TestClient, board: Board) -> None:
    for event, state in [
        ("start", "running"), ("pause", "paused"), ("resume", "running"), ("take_over", "teaching"),
        ("hand_back", "running"), ("failure", "resetting"), ("home", "resetting"), ("ready", "waiting"),
    ]:  # fmt: skip
        answer = client.post("/api/event", headers=ANN, json={"event": event})
        assert answer.json() == {"ok": True, "state": state}
    answer = client.post("/api/correct", headers=ANN, json={"episode": 0, "label": "success"})
    assert answer.json() == {"ok": True}
    assert board.session.take_corrected() == {0: "success"}
    answer = client.post("/api/correct", headers=ANN, json={"episode": 5, "label": "success"})
    assert (answer.status_code, answer.json()["error"]) == (
        409, "Episode 5 has no label to change: finished episodes are 0 to 0.",
    )  # fmt: skip
    board.session.learning("updates")
    answer = client.post("/api/event", headers=ANN, json={"event": "start"})
    assert answer.status_code == 409
    assert "busy (updates)" in answer.json()["error"]


@pytest.mark.parametrize("body", [
    b"", b"{}", b"[]", b"null", b"{", b'{"event": 1}', b'{"event": "dance"}', b'{"event": "fault"}',
    b'{"event": "absent"}', b'{"event": "start", "more": 1}', b'{"event": ["start"]}', b"[" * 4000,
    b'"' + b"x" * 5000 + b'"', b"\xff\xfe",
    b'{"event": "START"}', b'{"event": null}',
])  # fmt: skip
def test_nonsense_is_refused_in_one_line(client: TestClient, board: Board, body: bytes) -> None:
    answer = client.post("/api/event", headers=ANN, content=body)
    assert answer.status_code == 422
    assert "\n" not in answer.json()["error"]
    assert board.session.state is State.WAITING


@pytest.mark.parametrize("body", [{"episode": True, "label": "success"}, {"episode": "0", "label": "success"},
    {"episode": 0, "label": "good"}, {"episode": 0}, {"episode": 0.0, "label": "success"}])  # fmt: skip
def test_nonsense_labels(client: TestClient, board: Board, body: dict) -> None:
    film(board)
    assert client.post("/api/correct", headers=ANN, json=body).status_code == 422
    assert board.session.take_corrected() == {}


# --- Operator and viewers.


def test_viewers_look_and_pause_and_stop_and_take_over(client: TestClient, board: Board) -> None:
    assert client.get("/api/state", headers=ANN).json()["control"]["you"] == "operator"
    client.post("/api/event", headers=ANN, json={"event": "start"})
    assert client.get("/api/state", headers=BOB).json()["control"]["you"] == "viewer"
    for headers in (BOB, {"X-Token": TOKEN}):
        answer = client.post("/api/event", headers=headers, json={"event": "success"})
        assert (answer.status_code, answer.json()["error"].split(":")[0]) == (403, "Viewing only")
    assert client.post("/api/control", headers={"X-Token": TOKEN}).status_code == 422
    assert client.post("/api/control", headers=BOB, json={}).status_code == 200
    assert client.post("/api/event", headers=ANN, json={"event": "pause"}).status_code == 200
    assert client.post("/api/event", headers=ANN, json={"event": "resume"}).status_code == 403
    assert client.post("/api/event", headers=BOB, json={"event": "resume"}).status_code == 200
    assert "taken over" in board.snapshot()["log"][-1]["text"]
    text = json.dumps(client.get("/api/state", headers=ANN).json())
    assert '"bob"' not in text  # by whose name others could act


@pytest.mark.parametrize("state", State)
@pytest.mark.parametrize("headers", [BOB, {"X-Token": TOKEN}, {"X-Token": TOKEN, "X-Client": "?!"}])
def test_everybody_stops_in_every_state(client: TestClient, board: Board, state: State, headers: dict) -> None:
    client.get("/api/state", headers=ANN)
    board.session.state = state
    answer = client.post("/api/event", headers=headers, json={"event": "stop"})
    assert answer.json() == {"ok": True, "state": "stopped"}


def test_an_operator_over_http_is_present_by_asking(client: TestClient, board: Board, clock: DrivenClock) -> None:
    client.post("/api/event", headers=ANN, json={"event": "start"})
    for _ in range(3):
        clock.now += 8
        client.get("/api/state", headers=ANN)
        client.get("/api/state", headers=BOB)
        assert not client.app.state.control.check()
    assert board.session.state is State.RUNNING
    clock.now += 11
    client.get("/api/state", headers=BOB)
    until(lambda: board.session.state is State.PAUSED)
    assert "Nobody is at the operator's page" in board.snapshot()["log"][-1]["text"]


# --- The WebSocket.


def test_a_session_over_the_websocket(client: TestClient, board: Board) -> None:
    def answered(page: Any) -> dict:
        while "answer" not in (message := page.receive_json()):
            pass
        return message

    with client.websocket_connect(f"{WS}/ws?token={TOKEN}&client=ann") as page:
        assert page.receive_json()["snapshot"]["session"]["state"] == "waiting"
        page.send_json({"event": "start", "id": 1})
        assert answered(page) == {"answer": 1, "ok": True, "state": "running"}
        while page.receive_json().get("snapshot", {}).get("session", {}).get("state") != "running":
            pass
        page.send_json({"event": "ready", "id": 2})
        refused = answered(page)
        assert (refused["answer"], refused["ok"]) == (2, False)
        assert "no place while running" in refused["error"]
        with client.websocket_connect(f"{WS}/ws?token={TOKEN}&client=bob") as other:
            other.send_json({"event": "success", "id": 1})
            assert "Viewing only" in answered(other)["error"]
            other.send_json({"event": "pause", "id": 3})
            assert answered(other)["state"] == "paused"
            other.send_json({"event": "stop", "id": 2})
            assert answered(other)["state"] == "stopped"
        while page.receive_json().get("snapshot", {}).get("session", {}).get("state") != "stopped":
            pass


def test_the_websocket_needs_to_know_who_it_is(client: TestClient) -> None:
    for query in ("", "&client=", "&client=a%20b", "&client=" + "x" * 65):
        refused(client, f"/ws?token={TOKEN}{query}")


# --- A real server.


def test_the_address_that_is_printed_works(server: OperatorServer) -> None:
    assert httpx.get(server.url, timeout=60).status_code == 200
    assert httpx.get(server.url.replace("/?", "/api/state?"), timeout=60).json()["cameras"] == ["front"]
    assert len(server.token) >= 20


@pytest.mark.real_time(reason="the server pushes by the machine's own clock, at once and twice a second")
def test_changes_are_pushed_at_once_and_signs_of_life_every_second(server: OperatorServer, board: Board) -> None:
    with page_of(server, "ann") as page:
        page.recv(60)
        began = time.monotonic()
        board.session.apply(Event.HOME)
        json.loads(page.recv(60))
        at_once = time.monotonic() - began
        page.recv(60)
        page.recv(60)
        assert at_once < 0.45
        assert time.monotonic() - began < 3


def test_an_operator_who_vanishes_pauses_the_arm_and_may_come_back(
    server: OperatorServer, board: Board, clock: DrivenClock
) -> None:
    with page_of(server, "ann") as page:
        page.send(json.dumps({"event": "start", "id": 1}))
        until(lambda: board.session.state is State.RUNNING)
        page.socket.shutdown(socket.SHUT_RDWR)
    until(lambda: server.control._gone)
    clock.now += 1.1
    until(lambda: board.session.state is State.PAUSED)
    with page_of(server, "ann") as page:
        page.send(json.dumps({"event": "resume", "id": 1}))
        until(lambda: board.session.state is State.RUNNING)
        for _ in range(8):  # longer than it may be silent
            clock.now += 0.2
            page.send('{"alive": true}')
            until(lambda: server.control._seen == clock.now)
            assert not server.control.check()
        assert board.session.state is State.RUNNING
        clock.now += 1.1
        until(lambda: board.session.state is State.PAUSED)  # connected, but silent


@pytest.mark.real_time(reason="a server's stop must not take long for those who wait for it")
def test_it_stops_quickly_with_open_pages_and_half_open_requests(board: Board) -> None:
    with contextlib.ExitStack() as stack:
        server = OperatorServer(board)
        with server:
            pages = [stack.enter_context(page_of(server, f"page{i}")) for i in range(3)]
            half = stack.enter_context(socket.create_connection(("127.0.0.1", server.port)))
            half.sendall(b"POST /api/event HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100\r\n\r\n{")
            board.session.apply(Event.START)
            began = time.monotonic()
        assert time.monotonic() - began < 4
        assert board.session.state is State.PAUSED  # nobody can steer it any more
        for page in pages:
            with pytest.raises(ConnectionClosed, match="1012"):  # closed in good order
                collections.deque(page, 0)
    assert not [thread for thread in threading.enumerate() if thread.name == "operator-page"]
    with OperatorServer(board, port=server.port):  # the port is free again
        pass


def test_a_port_in_use_is_one_line_before_anything_starts(server: OperatorServer) -> None:
    before = threading.active_count()
    with pytest.raises(ConfigError, match=rf"127.0.0.1:{server.port}: .*in use.*Give another port") as caught:
        OperatorServer(Board(Session()), port=server.port)
    assert "\n" not in str(caught.value)
    assert threading.active_count() == before


@pytest.mark.parametrize(("options", "message"), [
    ({"port": 99999}, "99999"), ({"host": "nowhere.invalid"}, "nowhere.invalid"), ({"token": "short"}, "at least 8"),
])  # fmt: skip
def test_settings_that_cannot_be(options: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        OperatorServer(Board(Session()), **options)


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "uvicorn", None)
    with pytest.raises(ConfigError, match=r"lerobot_policy_cqn\[page\]"):
        OperatorServer(Board(Session()))
    with pytest.raises(ConfigError, match=r"needs the package uvicorn"):
        need_extra()


def test_too_many_pages_are_turned_away(server: OperatorServer) -> None:
    with contextlib.ExitStack() as stack:
        for number in range(MAX_PAGES):
            stack.enter_context(page_of(server, f"page{number}")).recv(60)
        with pytest.raises(InvalidStatus):
            page_of(server, "one-more")


def test_long_messages_close_the_page_and_nothing_else(server: OperatorServer) -> None:
    with page_of(server, "ann") as page:
        page.send("x" * (MAX_BODY + 1))
        with pytest.raises(ConnectionClosed):
            collections.deque(page, 0)
    assert httpx.get(f"http://127.0.0.1:{server.port}/", timeout=60).status_code == 200


def test_what_is_no_http_at_all(server: OperatorServer) -> None:
    for data in (b"\x00" * 100, b"GET / HTTP/9\r\n\r\n", b"\x16\x03\x01\x00", b"GET " + b"a" * 100_000, b"\r\n" * 10):
        with socket.create_connection(("127.0.0.1", server.port)) as raw, contextlib.suppress(OSError):
            raw.sendall(data)
            raw.settimeout(0.2)
            raw.recv(1000)
    assert httpx.get(f"http://127.0.0.1:{server.port}/", timeout=60).status_code == 200
