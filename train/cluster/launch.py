"""`cqn-train --ray.actors=N`: starts learner and collectors, shows what they do, and ends them together."""

import contextlib
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import draccus

from lerobot_cqn.errors import ConfigError, CQNError

from ..arm.build import announced, make_certificate
from ..config import RunConfig, ValidRun
from ..interfaces import PAGE_TOKEN, Monitor
from ..run.checkpoint import last_checkpoint
from ..run.progress import Monitors
from .collector import Collector
from .connect import RayCalls, check_resource, connected
from .learner import Ended, Learner, Shown
from .overview import Overview, server

Seats = Callable[[Sequence[Mapping[str, Any]]], None]

__all__ = ["launch", "settings_of"]

LOOK_S = 0.3
STOPS_WITHIN_S = 30.0  # that collectors have to hold their arms and close
TRIES = 3  # of a learner, without a new checkpoint in between


def launch(valid: ValidRun, arguments: Sequence[str], monitor: Monitor, should_stop: Callable[[], bool]) -> int:
    """Train with collectors; returns the command's exit code. Raises CQNError in one line."""
    settings, plugins = valid.config.ray, [a for a in arguments if ".discover_packages_path=" in a]
    configs = settings_of(valid.config)
    for config in configs:  # before anything starts
        draccus.decode(RunConfig, config)
    monitor.message("Starting Ray …" if settings.address is None else f"Joining Ray at {settings.address} …")
    with connected(settings, settings.actors + 1) as ray:
        if settings.robot_resource:
            check_resource(ray, settings.robot_resource, "--ray.robot_resource")
        one = {settings.robot_resource: 1} if settings.robot_resource else {}
        actor = ray.remote(concurrency_groups={"talk": 4})(_grouped(ray, Collector, ("pulse", "stored", "stop")))
        collectors = [
            actor.options(num_cpus=1, resources=one, max_restarts=-1).remote(index, config, plugins, os.getcwd())
            for index, config in enumerate(configs)
        ]
        with _overview(valid, monitor) as (shown, note):
            try:
                return _with_learner(ray, valid, list(arguments), RayCalls(collectors), shown, note, should_stop)
            finally:
                _close(ray, collectors)


@contextlib.contextmanager
def _overview(valid: ValidRun, monitor: Monitor) -> Iterator[tuple[Monitor, Seats]]:
    """What shows the run, and what is told of the collectors: with several arms there is a page of all of them."""
    config = valid.config
    if config.robot is None or config.ray.actors == 1 or not config.operator_page:
        yield monitor, lambda _: None
        return
    overview = Overview()
    page, token = config.page, os.environ.get(PAGE_TOKEN) or None
    certificate = make_certificate(page, valid.output_dir, monitor.message)
    with server(overview, page.host, page.port, token, certificate) as shown:
        monitor.message(f"Overview of the arms: {announced(shown.url, valid.output_dir)}")
        yield Monitors([monitor, overview]), overview.arms


def settings_of(config: RunConfig) -> list[Mapping[str, Any]]:
    """The run's settings for each collector, encoded, with those of its own on top. Raises ConfigError for a bad name.

    With several arms the run's page is the overview; each arm's own has a port of its own, counted up from it.
    """
    found = []
    for index in range(config.ray.actors):
        encoded = draccus.encode(config)
        if config.page.port:
            encoded["page"]["port"] = config.page.port + index + (config.ray.actors > 1)
        for name, value in (config.ray.each[index] if index < len(config.ray.each) else {}).items():
            *groups, last = str(name).split(".")
            part: Any = encoded
            for group in groups:
                part = part.get(group) if isinstance(part, dict) else None
            if not isinstance(part, dict) or last not in part:
                raise ConfigError(
                    f"--ray.each: there is no setting '{name}': expected one of cqn-train's, e.g. robot.port."
                )
            part[last] = value
        found.append(encoded)
    return found


def _with_learner(
    ray: Any,
    valid: ValidRun,
    arguments: list[str],
    calls: RayCalls,
    monitor: Monitor,
    note: Seats,
    should_stop: Callable[[], bool],
) -> int:
    """Run a learner to its end; one that dies is followed by another that goes on from the last checkpoint."""
    gpus = int(valid.policy.device == "cuda" and ray.cluster_resources().get("GPU", 0) >= 1)
    here = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(
        ray.get_runtime_context().get_node_id(), soft=False
    )  # where the run's folder is
    actor = ray.remote(concurrency_groups={"talk": 2})(_grouped(ray, Learner, ("look", "stop")))
    actor = actor.options(num_cpus=1, num_gpus=gpus, scheduling_strategy=here)
    threads = max(1, (os.cpu_count() or 1) - valid.config.ray.actors)
    died = 0
    while True:
        begun = _checkpoint_time(valid)
        learner = actor.remote(arguments, calls, threads, os.getcwd())
        ended = _watch(ray, learner, monitor, note, should_stop)
        if ended is not None:
            if ended.error:
                raise (CQNError if ended.code == 2 else OSError)(ended.error)
            return ended.code
        now = _checkpoint_time(valid)
        died = died + 1 if now == begun else 0
        if now is None or died >= TRIES or should_stop():
            raise CQNError(
                "The learner's process died (Ray's logs: /tmp/ray/session_latest/logs): --resume=true goes on from its "
                "last checkpoint, where there is one."
            )
        monitor.message("The learner's process died: another one goes on from the last checkpoint.")
        arguments = ["--resume=true", f"--output_dir={valid.output_dir}"]


def _watch(ray: Any, learner: Any, monitor: Monitor, note: Seats, should_stop: Callable[[], bool]) -> Ended | None:
    """Show what a learner does until it ends; None where its process died."""
    running, asked = learner.run.remote(), False
    while True:
        done = ray.wait([running], timeout=LOOK_S)[0]
        try:
            shown: Shown = ray.get(learner.look.remote())
            for name, given in shown.calls:
                getattr(monitor, name)(*given)
            note(shown.seats)
            if done:
                ended: Ended = ray.get(running)
                return ended
        except ray.exceptions.RayTaskError:
            raise
        except ray.exceptions.RayError:
            return None
        if should_stop() and not asked:
            asked = True
            learner.stop.remote()


def _checkpoint_time(valid: ValidRun) -> float | None:
    """When the newest checkpoint was written; None while there is none."""
    with contextlib.suppress(CQNError, OSError):
        return last_checkpoint(valid.output_dir).stat().st_mtime
    return None


def _close(ray: Any, collectors: Sequence[Any]) -> None:
    """Let every collector come to its end: an arm is held and left as configured."""
    with contextlib.suppress(ray.exceptions.RayError, KeyboardInterrupt):
        for collector in collectors:
            collector.stop.remote()
        closing = [collector.close.remote() for collector in collectors]
        deadline = time.monotonic() + STOPS_WITHIN_S
        while closing and time.monotonic() < deadline:
            _, closing = ray.wait(closing, timeout=LOOK_S)


def _grouped(ray: Any, kind: type, beside: Sequence[str]) -> type:
    """A class whose methods named in `beside` run beside the others, one of which runs at a time."""
    methods = {name: ray.method(concurrency_group="talk")(_forwarded(kind, name)) for name in beside}
    return type(kind.__name__, (kind,), methods)


def _forwarded(kind: type, name: str) -> Callable[..., Any]:
    def method(self: Any, *arguments: Any) -> Any:
        return getattr(kind, name)(self, *arguments)

    method.__name__ = name
    return method
