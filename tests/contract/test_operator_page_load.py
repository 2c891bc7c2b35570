"""The operator's page under load and from strangers: half-open connections, guesses of the token, and TLS."""

import hashlib
import os
import socket
import ssl
import stat
import time
from pathlib import Path

import pytest

from cqn_train.operator.board import Board
from cqn_train.operator.session import Session, State
from lerobot_cqn.errors import ConfigError

pytest.importorskip("fastapi", reason="needs the extra [page]")
httpx = pytest.importorskip("httpx")
pytest.importorskip("cryptography")

from fastapi.testclient import TestClient  # noqa: E402

from cqn_data.web.access import MOST_WRONG  # noqa: E402
from cqn_data.web.connections import HEAD_S, MOST_CONNECTIONS  # noqa: E402
from cqn_data.web.tls import check_certificate, own_certificate  # noqa: E402
from cqn_train.operator.page.server import OperatorServer  # noqa: E402

from .operator_clients import (  # noqa: E402, F401  # fixtures among them
    ANN,
    board_fixture,
    client_fixture,
    clock_fixture,
    server_fixture,
    until,
)


def half_open(server: OperatorServer, count: int, said: bytes) -> list[socket.socket]:
    found = []
    for _ in range(count):
        found.append(socket.create_connection(("127.0.0.1", server.port), timeout=10))
        if said:
            found[-1].sendall(said)
    return found


def descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))


@pytest.mark.real_time(reason="connections are counted by the system")
@pytest.mark.parametrize("said", [b"", b"POST /api/event HTTP/1.1\r\nHost: 127.0.0.1\r\n"])
def test_half_open_connections_hold_up_neither_stop_nor_the_disk(
    server: OperatorServer, board: Board, said: bytes
) -> None:
    before = descriptors()
    strangers = half_open(server, 190, said)
    begun = time.monotonic()
    answer = httpx.post(
        f"http://127.0.0.1:{server.port}/api/event", json={"event": "stop"}, headers={"X-Token": server.token},
        timeout=30,
    )  # fmt: skip
    waited = time.monotonic() - begun
    assert answer.json()["state"] == board.session.state == State.STOPPED
    until(lambda: descriptors() - before - len(strangers) <= MOST_CONNECTIONS + 16)
    assert waited < HEAD_S, "it had to wait for them to give up"
    for stranger in strangers:
        stranger.close()


@pytest.mark.real_time(reason="the server's own patience")
def test_who_sends_no_whole_request_is_cut_off(server: OperatorServer) -> None:
    (stranger,) = half_open(server, 1, b"GET / HTTP/1.1\r\n")
    stranger.settimeout(10 * HEAD_S)
    assert stranger.recv(100) == b""


@pytest.mark.real_time(reason="a WebSocket stays open beside them")
def test_pages_stay_open_while_strangers_come(server: OperatorServer) -> None:
    from .operator_clients import page_of

    with page_of(server, "ann") as page:
        strangers = half_open(server, 2 * MOST_CONNECTIONS, b"")
        assert page.recv(timeout=30)
        page.send('{"event": "start", "id": 1}')
        until(lambda: '"answer":1' in str(page.recv(timeout=30)).replace(" ", ""))
        for stranger in strangers:
            stranger.close()


def test_guesses_of_the_token_are_answered_differently_and_the_right_one_always_passes(client: TestClient) -> None:
    codes = [client.get("/api/state", headers={"X-Token": f"guess-{i:04d}"}).status_code for i in range(MOST_WRONG + 5)]
    assert codes == [401] * MOST_WRONG + [429] * 5
    assert client.get("/api/state", headers=ANN).status_code == 200
    assert client.get("/api/state").status_code == 401  # no guess
    assert client.post("/api/event", headers=ANN, json={"event": "stop"}).json()["state"] == State.STOPPED


def test_https_by_a_certificate_made_here(tmp_path: Path) -> None:
    pair, fingerprint = own_certificate(tmp_path / "page", ["localhost", "127.0.0.1"])
    assert stat.S_IMODE(pair[1].stat().st_mode) == 0o600
    assert check_certificate(*pair) == pair
    with OperatorServer(Board(Session()), certificate=pair) as server:
        assert server.url.startswith("https://127.0.0.1:")
        trusted = ssl.create_default_context(cafile=str(pair[0]))
        answer = httpx.get(server.url.replace("/?", "/api/state?"), verify=trusted)
        assert answer.status_code == 200
        shown = ssl.PEM_cert_to_DER_cert(ssl.get_server_certificate(("127.0.0.1", server.port)))
        assert hashlib.sha256(shown).hexdigest().upper() == fingerprint.replace(":", "")
        with pytest.raises(httpx.HTTPError):
            httpx.get(f"http://127.0.0.1:{server.port}/")


def test_files_that_are_no_certificate_are_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "key.pem").write_text("no key")
    with pytest.raises(ConfigError, match=r"--page\.certfile=.*no such file"):
        check_certificate(tmp_path / "nothing.pem", tmp_path / "key.pem")
    with pytest.raises(ConfigError, match="cannot be used"):
        check_certificate(tmp_path / "key.pem", tmp_path / "key.pem")
    pair, _ = own_certificate(tmp_path / "one", ["localhost"])
    other, _ = own_certificate(tmp_path / "two", ["localhost"])
    with pytest.raises(ConfigError, match="cannot be used"):
        check_certificate(pair[0], other[1])
