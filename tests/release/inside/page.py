"""The operator's page answers: the page itself, and its state, which needs the token."""

import http.client
import json
import sys

from cqn_train.operator.board import Board
from cqn_train.operator.page.server import OperatorServer
from cqn_train.operator.session import Session
from lerobot_cqn.errors import CQNError

try:
    with OperatorServer(Board(Session())) as server:
        connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
        connection.request("GET", "/")
        page = connection.getresponse().read().decode()
        connection.request("GET", "/api/state?client=probe", headers={"X-Token": server.token})
        state = json.load(connection.getresponse())
        connection.close()
except CQNError as error:
    print(error)
    sys.exit(2)
assert "<html" in page, page[:200]
print(f"the page and its state ({len(state)} fields) over HTTP")
