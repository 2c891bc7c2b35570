"""What the tests of the operator's page share: an app with a board, two clients, a real server, a clock to turn."""

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from cqn_train.operator.board import Board
from cqn_train.operator.session import Session

pytest.importorskip("fastapi", reason="needs the extra [page]")
pytest.importorskip("httpx", reason="needs the extra [dev]")

from fastapi.testclient import TestClient
from websockets.sync.client import connect

from cqn_train.operator.control import Control
from cqn_train.operator.page.server import OperatorServer, make_app

from ..driven_clock import DrivenClock

TOKEN = "a-token-of-the-test"  # noqa: S105
ANN = {"X-Token": TOKEN, "X-Client": "ann"}
BOB = {"X-Token": TOKEN, "X-Client": "bob"}


@pytest.fixture(name="board")
def board_fixture() -> Board:
    board = Board(Session())
    board.show({"front": np.zeros((48, 64, 3), np.uint8)})
    return board


@pytest.fixture(name="clock")
def clock_fixture() -> DrivenClock:
    return DrivenClock()


@pytest.fixture(name="client")
def client_fixture(board: Board, clock: DrivenClock) -> Iterator[TestClient]:
    control = Control(board.session, 10.0, said=board.message, clock=clock)
    with TestClient(make_app(board, TOKEN, control, check_s=0.01), base_url="http://127.0.0.1:8000") as client:
        yield client


def until(what: Callable[[], Any], seconds: float = 60) -> None:
    """Wait for what another thread brings about; however busy the machine."""
    deadline = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.fixture(name="server")
def server_fixture(board: Board, clock: DrivenClock) -> Iterator[OperatorServer]:
    with OperatorServer(board, absent_s=1.0, clock=clock) as server:
        yield server


def page_of(server: OperatorServer, client: str) -> Any:
    return connect(
        f"ws://127.0.0.1:{server.port}/ws?token={server.token}&client={client}", max_queue=None, open_timeout=60
    )
