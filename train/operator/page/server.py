"""The operator's page as a server beside the training loop, in a thread of its own."""

from cqn_data.web.server import PageServer
from cqn_data.web.tls import Certificate

from ...clock import REAL, Clock
from ..board import Board
from ..control import Control
from .app import make_app, need_extra

__all__ = ["OperatorServer", "make_app"]


class OperatorServer(PageServer):
    """Serves `board` to operator and viewers while it is entered.

    host, port, token, certificate: as of every page. absent_s: seconds without a sign of the operator after which a
    moving arm pauses.

    Raises ConfigError when made: without the packages of the extra, for a port in use, for a short token.
    """

    def __init__(
        self,
        board: Board,
        host: str = "127.0.0.1",
        port: int = 0,
        token: str | None = None,
        absent_s: float = 10.0,
        clock: Clock = REAL,
        certificate: Certificate | None = None,
    ) -> None:
        need_extra()
        self.control = Control(board.session, absent_s, said=board.message, clock=clock)
        super().__init__(
            lambda token: make_app(board, token, self.control, host=host, check_s=min(0.25, absent_s / 4)),
            "operator page", host, port, token,
            ended=lambda: self.control.pause("The operator's page is closed: the arm pauses."), certificate=certificate,
        )  # fmt: skip
