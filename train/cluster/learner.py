"""The learner: the process that trains (a Ray actor's class), with collectors elsewhere as its source of episodes."""

import contextlib
import logging
import os
import secrets
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from lerobot.envs.configs import EnvConfig
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_cqn.errors import CQNError

from .. import envs  # noqa: F401  # registers our environments
from ..arguments import parse
from ..build import World, make_agent
from ..config import ValidRun
from ..execute import execute
from ..loop.gym_env import check_fits
from ..replay.demonstrations import Demonstrations
from ..run.beginning import RUN_ID
from .calls import Calls
from .fleet import Fleet

__all__ = ["Ended", "Learner", "Shown"]


@dataclass(frozen=True, kw_only=True)
class Ended:
    """How a run ended. code: of the command; error: in one line, "" for none."""

    code: int
    error: str = ""


@dataclass(frozen=True, kw_only=True)
class Shown:
    """What happened since the last look: calls of a `Monitor`, and the collectors as they are."""

    calls: Sequence[tuple[str, tuple[Any, ...]]]
    seats: Sequence[Mapping[str, Any]]


class Learner:
    """A run; `look` and `stop` may be called beside `run`."""

    def __init__(self, arguments: Sequence[str], calls: Calls, threads: int, folder: str) -> None:
        """Nothing is made yet.

        arguments: of cqn-train; threads: of torch, where they do not say how many; folder: that paths in them begin at.
        """
        self._arguments, self._calls, self._threads, self._folder = list(arguments), calls, threads, folder
        self._told: list[tuple[str, tuple[Any, ...]]] = []
        self._seats: Sequence[Mapping[str, Any]] = ()
        self._lock = threading.Lock()
        self._stopping = False

    def run(self) -> Ended:
        """Train; what a person could mend becomes one line."""
        os.chdir(self._folder)
        register_third_party_plugins()
        torch.set_num_threads(self._threads)
        ours, notices = logging.getLogger(__package__.partition(".")[0]), _Notices(self.message)
        ours.addHandler(notices)
        try:
            valid = parse(self._arguments).validate()
            return Ended(code=execute(valid, self, lambda: self._stopping, self._world))
        except (CQNError, OSError) as error:
            return Ended(code=2 if isinstance(error, CQNError) else 1, error=" ".join(str(error).split()))
        finally:
            ours.removeHandler(notices)

    def _world(
        self,
        run: ValidRun,
        checkpoint: Path | None,
        data: Demonstrations | None,
        say: Callable[[str], None],
        should_stop: Callable[[], bool],
        stack: contextlib.ExitStack,
    ) -> World:
        """Policy, and the collectors as the source of its episodes. Raises CQNError where they do not fit."""
        settings, recipe = run.config.ray, run.config.recipe
        fleet = Fleet(
            calls=self._calls, count=settings.actors, max_staleness=settings.max_staleness,
            worth=lambda steps: recipe.updates_of_steps(0, steps) + recipe.updates_per_episode,
            steps_apart=settings.actors == 1 and settings.max_staleness == 0 and recipe.updates_per_step > 0,
            run_id=lambda: run_id(run.output_dir), say=say, should_stop=should_stop, batch=run.config.eval.batch_size,
            on_seats=self._note_seats,
        )  # fmt: skip
        stack.callback(fleet.close)
        bounds = fleet.describe().bounds
        agent = make_agent(run, checkpoint, data, bounds)
        if isinstance(run.acts_in, EnvConfig):
            check_fits(run.acts_in, agent.policy, "policy" if run.config.continues else "dataset")
        fleet.equip(agent, data.recorded() if data is not None and run.config.robot is not None else None)
        return World(agent=agent, experience=fleet, bounds=bounds)

    # -- as a monitor, for the process that shows it ------------------------------------------------------------

    def phase(self, name: str, total: int, done: int) -> None:
        """A phase begins."""
        self._tell("phase", name, total, done)

    def advance(self, done: int, note: str) -> None:
        """Progress within the phase."""
        self._tell("advance", done, note)

    def message(self, text: str) -> None:
        """A line that stays."""
        self._tell("message", text)

    def _tell(self, name: str, *arguments: Any) -> None:
        with self._lock:
            if name == "advance" and self._told and self._told[-1][0] == name:
                self._told.pop()  # nobody saw it
            self._told.append((name, arguments))

    def _note_seats(self, seats: Sequence[Mapping[str, Any]]) -> None:
        self._seats = seats

    def look(self) -> Shown:
        """What happened since the last look."""
        with self._lock:
            told, self._told = self._told, []
        return Shown(calls=told, seats=self._seats)

    def stop(self) -> None:
        """Save and end at the next safe point."""
        self._stopping = True


class _Notices(logging.Handler):
    """Passes on what the code says through its logger: nobody sees this process's own stderr."""

    def __init__(self, say: Callable[[str], None]) -> None:
        super().__init__()
        self._say = say

    def emit(self, record: logging.LogRecord) -> None:
        self._say(record.getMessage())


def run_id(output_dir: Path) -> str:
    """What tells a run's turns from those of others on the same collectors; made when it is first asked for."""
    path = output_dir / RUN_ID
    with contextlib.suppress(FileNotFoundError):
        return path.read_text().strip()
    path.write_text(secrets.token_hex(6) + "\n")
    return path.read_text().strip()
