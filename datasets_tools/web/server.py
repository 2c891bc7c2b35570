"""A page's server in a thread of its own, on this machine unless asked otherwise."""

import contextlib
import secrets
import socket
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self
from urllib.parse import quote

from lerobot_cqn.errors import ConfigError

from .access import ANY_ADDRESS
from .connections import bounded_protocol
from .routes import MAX_BODY
from .tls import Certificate

__all__ = ["PageServer", "own_address"]

MIN_TOKEN = 8  # characters
START_S = 15.0
CLOSE_S = 1.0  # for requests that are under way


class PageServer:
    """Serves the app that `make_app(token)` makes while it is entered.

    name: of the page, for errors and its thread. host: address to listen on; 0.0.0.0 lets other machines reach it.
    port: 0 takes any free one, which `port` then says. token: what a request must bring; None makes one. ended: called
    when nothing is served any more. certificate: for https.

    Raises ConfigError when made: for a port in use, for a short token.
    """

    def __init__(
        self,
        make_app: Callable[[str], Any],
        name: str,
        host: str = "127.0.0.1",
        port: int = 0,
        token: str | None = None,
        ended: Callable[[], None] = lambda: None,
        certificate: Certificate | None = None,
    ) -> None:
        if token is not None and len(token) < MIN_TOKEN:
            raise ConfigError(f"The page's token has {len(token)} characters: expected at least {MIN_TOKEN}.")
        self.host, self.token = host, token if token is not None else secrets.token_urlsafe(16)
        self._name, self._ended = name, ended
        app = make_app(self.token)
        self._socket = _listen(host, port)
        self.port: int = self._socket.getsockname()[1]
        self._scheme = "http" if certificate is None else "https"
        self._server = _quiet_server(app, certificate)
        self._thread = threading.Thread(target=self._run, name=name.replace(" ", "-"), daemon=True)

    @property
    def url(self) -> str:
        """Address of the page, with its token."""
        host = own_address() if self.host in ANY_ADDRESS else self.host
        return (
            f"{self._scheme}://{f'[{host}]' if ':' in host else host}:{self.port}/?token={quote(self.token, safe='')}"
        )

    def __enter__(self) -> Self:
        """Start; returns when the page can be opened. Raises ConfigError where it does not start."""
        self._thread.start()
        deadline = time.monotonic() + START_S
        while not self._server.started:
            if not self._thread.is_alive() or time.monotonic() > deadline:
                self.close()
                raise ConfigError(f"The {self._name} does not start on {self.host}:{self.port}.")
            time.sleep(0.01)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop, whoever is still looking."""
        self.close()

    def close(self) -> None:
        """Stop serving and give the port back; may be called again."""
        self._server.should_exit = True
        if self._thread.is_alive():
            self._thread.join(CLOSE_S + 1)
            self._server.force_exit = True
            self._thread.join(CLOSE_S)
        self._socket.close()

    def _run(self) -> None:
        try:
            self._server.run(sockets=[self._socket])
        except SystemExit:  # uvicorn's way to say that it could not start
            pass
        finally:
            self._ended()


def _quiet_server(app: Any, certificate: Certificate | None) -> Any:
    import uvicorn

    certfile, keyfile = certificate or (None, None)
    config = uvicorn.Config(
        app, http=bounded_protocol(), ssl_certfile=certfile, ssl_keyfile=keyfile,
        log_config=None, access_log=False, log_level="critical", server_header=False, lifespan="on",
        ws_max_size=MAX_BODY, ws_max_queue=8, ws_ping_interval=5.0, ws_ping_timeout=10.0, timeout_keep_alive=5,
        timeout_graceful_shutdown=int(CLOSE_S), proxy_headers=False,
    )  # fmt: skip
    return uvicorn.Server(config)


def _listen(host: str, port: int) -> socket.socket:
    """A socket that listens already: two runs on one port are noticed before anything starts."""
    name = host.strip("[]")
    if not 0 <= port <= 65535:  # a larger one would be taken for another
        raise ConfigError(f"The page's port is {port}: expected 1 to 65535, or 0 for any free one.")
    try:
        family, kind, proto, _, address = socket.getaddrinfo(name, port, type=socket.SOCK_STREAM)[0]
    except (OSError, OverflowError, UnicodeError) as error:
        raise ConfigError(f"The page cannot be served on {host}:{port}: {error}. Give another host.") from error
    listening = socket.socket(family, kind, proto)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(address)
        listening.listen(64)
    except (OSError, OverflowError) as error:
        listening.close()
        raise ConfigError(
            f"The page cannot be served on {host}:{port}: {error}. Give another port, or 0 for any free one."
        ) from error
    return listening


def own_address() -> str:
    """The address by which other machines reach this one; nothing is sent to find it."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))
        return str(probe.getsockname()[0])
    return "127.0.0.1"
