"""Ray for a run: one that lives with it on this machine, or a cluster that is there; never an open door unsaid."""

import contextlib
import functools
import ipaddress
import os
import secrets
import signal
import socket
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from lerobot_cqn.errors import ConfigError, CQNError

from ..config import RaySettings
from .calls import Gone

__all__ = ["RayCalls", "check_resource", "connected"]

STORE_BYTES = 512 * 2**20  # of the object store of a Ray of our own, for weights,
STORE_OF_ONE = 32 * 2**20  # and for each collector: a few episodes
CURRENT = Path("/tmp/ray/ray_current_cluster")  # noqa: S108  # where Ray notes the one that was started last
ANSWERS_S = 5.0
LOOPBACK_ONLY = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"  # at 0 all ports of Ray are on this machine alone


@contextlib.contextmanager
def connected(settings: RaySettings, actors: int) -> Iterator[Any]:
    """The package `ray`, connected while the block runs. Raises ConfigError in one line where it cannot be.

    actors: that a Ray of our own must have room for.
    """
    own, before = settings.address is None, dict(os.environ)
    if own:  # before the package is imported: it reads them then
        os.environ |= {LOOPBACK_ONLY: "0", "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": _token()}
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is told to anybody
    try:
        with _joined(settings, actors) as ray:
            yield ray
    finally:
        os.environ.clear()
        os.environ.update(before)


@functools.cache
def _token() -> str:
    """Token of Rays of our own; Ray reads it once a process."""
    return secrets.token_hex(32)


@contextlib.contextmanager
def _joined(settings: RaySettings, actors: int) -> Iterator[Any]:
    """The package, connected as the environment says."""
    try:
        import ray
    except ImportError as error:
        raise ConfigError("--ray.actors needs the extra: pip install 'lerobot_policy_cqn[ray]'.") from error
    own = settings.address is None
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    common: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    try:
        if own:
            room = max(os.cpu_count() or 1, actors)
            resources: dict[str, float] = {settings.robot_resource: actors} if settings.robot_resource else {}
            ray.init(
                address="local", include_dashboard=False, num_cpus=room, resources=resources,
                object_store_memory=STORE_BYTES + actors * STORE_OF_ONE, **common,
            )  # fmt: skip
        else:
            _refuse_open(settings)
            _refuse_silent(settings)
            ray.init(address=settings.address, **common)
    except CQNError:
        raise
    except Exception as error:  # whatever Ray raises: no cluster, another version, a wrong token
        raise ConfigError(f"{_what(settings)} {_reason(error)}") from error
    for number, handler in handlers.items():  # Ray puts its own in their place
        signal.signal(number, handler)
    try:
        yield ray
    finally:
        ray.shutdown()


def _what(settings: RaySettings) -> str:
    if settings.address is None:
        return "Ray does not start on this machine:"
    return (
        f"--ray.address={settings.address} cannot be joined (start one with `ray start --head`; Ray and Python must be "
        "of one version everywhere, RAY_AUTH_TOKEN the same):"
    )


def _reason(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"


def _refuse_open(settings: RaySettings) -> None:
    """Refuse a cluster that asks nobody for a token, unless it is on this machine alone. Raises ConfigError."""
    token = os.environ.get("RAY_AUTH_MODE", "").lower() == "token"
    if token or settings.open_network or _is_loopback(settings.address or ""):
        return
    raise ConfigError(
        f"--ray.address={settings.address} would be joined without a token, and whoever reaches a Ray's ports controls "
        "its machines: set RAY_AUTH_MODE=token and RAY_AUTH_TOKEN on all of them (docs/scale.md), or give "
        "--ray.open_network=true for a network that nobody else is in."
    )


def _refuse_silent(settings: RaySettings) -> None:
    """Refuse an address that nobody listens at: Ray would try for minutes. Raises ConfigError."""
    address = settings.address or ""
    if address == "auto":
        found = os.environ.get("RAY_ADDRESS") or (CURRENT.read_text().strip() if CURRENT.is_file() else "")
        if not found:
            raise ConfigError("--ray.address=auto: no Ray runs on this machine: start one with `ray start`.")
        address = found
    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=ANSWERS_S).close()
    except (OSError, ValueError, OverflowError) as error:
        raise ConfigError(f"{_what(settings)} nobody answers at {address} ({error}).") from error


def _is_loopback(address: str) -> bool:
    """Whether HOST:PORT names this machine by an address that others cannot reach; "auto" may be anywhere."""
    host = address.removeprefix("ray://").rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    with contextlib.suppress(ValueError, OSError):
        return ipaddress.ip_address(host or socket.gethostbyname(host)).is_loopback
    return False


def check_resource(ray: Any, name: str, option: str) -> None:
    """Make sure that some node of the cluster has a resource. Raises ConfigError where none does."""
    have = {key: value for key, value in ray.cluster_resources().items() if not key.startswith("node:")}
    if not have.get(name):
        others = ", ".join(sorted(key for key in have if "memory" not in key)) or "none"
        raise ConfigError(
            f"{option}={name}: no node of the cluster has it (there are: {others}). Start Ray on the computer with the "
            f"arm by `ray start --address=… --resources='{{\"{name}\": 1}}'`."
        )


class RayCalls:
    """Calls of a fleet over Ray's actors."""

    def __init__(self, handles: Sequence[Any]) -> None:
        self._handles = handles

    def call(self, collector: int, method: str, *arguments: Any) -> Any:
        """Ask; returns a promise."""
        return getattr(self._handles[collector], method).remote(*arguments)

    def shared(self, value: Any) -> Any:
        """The value in the object store."""
        import ray

        return ray.put(value)

    def answered(self, promises: Sequence[Any], timeout_s: float) -> Sequence[Any]:
        """Those of the promises that are answered, waiting for the first one so long at most."""
        import ray

        first, rest = ray.wait([*promises], num_returns=1, timeout=timeout_s)
        more = ray.wait(rest, num_returns=len(rest), timeout=0)[0] if first and rest else []
        return [*first, *more]

    def answer(self, promise: Any) -> Any:
        """The answer. Raises Gone, or CQNError for what went wrong at the collector."""
        import ray
        from ray import exceptions

        try:
            return ray.get(promise)
        except exceptions.RayTaskError as error:
            cause = error.cause
            if isinstance(cause, CQNError):
                raise cause from error
            raise CQNError(f"{type(cause).__name__}: {' '.join(str(cause).split())[:300]}") from error
        except exceptions.RayError as error:  # its process, its node, or the way there
            raise Gone(type(error).__name__) from error
