"""A collector: one environment, or one arm with its page, that acts the turns it is given (a Ray actor's class)."""

import contextlib
import os
import platform
import socket
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import torch
from lerobot.envs.configs import EnvConfig
from lerobot.utils.import_utils import register_third_party_plugins
from numpy.typing import NDArray

from cqn_data.terminal.options import with_plugins
from lerobot_cqn.base_config import RLConfig
from lerobot_cqn.errors import CQNError

from .. import envs  # noqa: F401  # registers our environments
from ..agent import Agent
from ..arm.build import Operated, make_operated, steering
from ..arm.devices import register_devices
from ..build import make_scenes
from ..config import RunConfig
from ..interfaces import Interrupted, Label
from ..loop.acting import Acting, Finished, Turn
from ..loop.evaluate import Evaluation
from ..loop.experience import Here
from ..loop.gym_env import GymEnvironment, OneScene
from ..replay.demonstrations import Recorded
from ..run.checkpoint import seed_everything
from .parcel import Files, Weights, take_weights, unpack
from .spool import Spool

__all__ = ["Collector", "Description", "Done", "Fit", "Left", "NewbornError", "Paused", "Pulse", "Reply", "versions"]

RandomState = NDArray[np.uint8]
SIGN_S = 10.0  # without a sign of the learner after which the page says so


@dataclass(frozen=True, kw_only=True)
class Description:
    """Where a collector runs, and what it acts in as far as it is known without a policy.

    bounds: `min` and `max` [D] of the environment's action, None where it has none.
    """

    host: str
    versions: Mapping[str, str]
    bounds: Mapping[str, NDArray[Any]] | None


@dataclass(frozen=True, kw_only=True)
class Fit:
    """What a collector acts in once it has its policy. limits: of an arm, [low, high, largest step] by joint; spans: of
    its motors by joint, in encoder steps from its calibration; page: address of the operator's page, with its token.
    """

    fps: int
    max_steps: int
    limits: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    spans: Mapping[str, int] = field(default_factory=dict)
    page: str = ""


@dataclass(frozen=True, kw_only=True)
class Paused:
    """A turn that waits for the updates of its last step. steps: control steps of the run so far."""

    steps: int
    random_state: RandomState


@dataclass(frozen=True, kw_only=True)
class Done:
    """A turn that is over. acted_s, idle_s: seconds of the turn, and before it without one."""

    finished: Finished
    random_state: RandomState
    acted_s: float
    idle_s: float


@dataclass(frozen=True, kw_only=True)
class Left:
    """A collector that acts no more: its person stopped it, or it was asked to."""


@dataclass(frozen=True, kw_only=True)
class Pulse:
    """Sign of life: what the person changed of finished episodes, what they are to read, and what goes on."""

    corrected: Mapping[int, Label]
    said: Sequence[str]
    doing: str


Reply = Paused | Done | Left


class NewbornError(CQNError):
    """The collector's process began anew, and knows nothing of what the one before it was given."""


class Collector:
    """Acts in an environment of its own. Calls come one after another, those of `talk` beside them."""

    def __init__(
        self, index: int, config: Mapping[str, Any], plugins: Sequence[str], folder: str, spool: str | None = None
    ) -> None:
        """Nothing is made yet.

        config: the run's, encoded; plugins: arguments that name packages to load first; folder: that the command was
        given in, which paths of plugins begin at where this machine has it.
        """
        self.index, self._encoded, self._plugins, self._folder = index, config, plugins, folder
        self._spool = Spool(Path(spool) if spool else _cache())
        self._stack = contextlib.ExitStack()
        self._stopping = False
        self._config: RunConfig | None = None
        self._gym: GymEnvironment | None = None
        self._agent: Agent | None = None
        self._here: Here | None = None
        self._operated: Operated | None = None
        self._acting: Acting | None = None
        self._steps: Iterator[int] = iter(())
        self._since = self._heard = time.monotonic()
        self._idle_s, self._busy = 0.0, False
        self._said: list[str] = []
        self._corrected: dict[int, Label] = {}

    # -- before it acts --------------------------------------------------------------------------------------

    def describe(self) -> Description:
        """Make the environment, and say where it is. Raises CQNError in one line."""
        if self._config is None:
            if Path(self._folder).is_dir():
                os.chdir(self._folder)
            register_third_party_plugins()
            register_devices()
            with_plugins(list(self._plugins))
            config: RunConfig = draccus.decode(RunConfig, self._encoded)
            if config.threads:
                torch.set_num_threads(config.threads)
            seed_everything(config.seed)
            # Certificate and address of its page; the run's own folder may be on another machine.
            config.output_dir = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="cqn-collector-")))
            if isinstance(config.env, EnvConfig):
                assert config.policy is not None  # noqa: S101  # RunConfig.validate has checked it
                self._gym = GymEnvironment(config.env, config.policy)
                self._stack.callback(self._gym.close)
            self._config = config
        bounds = self._gym.action_bounds() if self._gym is not None else None
        return Description(host=socket.gethostname(), versions=versions(), bounds=bounds)

    def equip(self, files: Files, recorded: Recorded | None) -> Fit:
        """Take the policy, and get ready to act: an arm is connected and held from now on. Raises CQNError."""
        config = self._config
        if config is None:
            raise NewbornError("It was not described yet.")
        self._agent = unpack(files, config.ray.device)
        if self._here is None:
            self._here = self._make(config, self._agent, recorded)
            self._here.open(())
        fit = Fit(fps=self._here.fps, max_steps=self._here.max_steps)
        if self._operated is None:
            return fit
        guard, page = self._operated.env.arm.guard, config.output_dir and config.output_dir / "page" / "address"
        limits = zip(guard.limits.low, guard.limits.high, guard.limits.max_step, strict=True)
        return Fit(
            fps=fit.fps, max_steps=fit.max_steps,
            limits={n: (float(a), float(b), float(c)) for n, (a, b, c) in zip(guard.names, limits, strict=True)},
            spans={n: m.range_max - m.range_min for n, m in (guard.robot.calibration or {}).items()},
            page=page.read_text().strip() if page and page.is_file() else "",
        )  # fmt: skip

    def _make(self, config: RunConfig, agent: Agent, recorded: Recorded | None) -> Here:
        if self._gym is not None:
            assert config.env is not None and isinstance(config.policy, RLConfig)  # noqa: S101, PT018
            scenes = make_scenes(config.env, config.policy, self._gym, config.eval, self._stack)
            return Here.alone(self._gym, scenes, config.recipe.random_steps)
        assert config.robot is not None  # noqa: S101  # one of the two is there
        operated = make_operated(config.robot, config, agent, recorded, lambda: self._stopping, self._say)
        self._stack.enter_context(steering(config, operated, self._say))
        self._stack.callback(operated.env.close)
        self._operated = operated
        threading.Thread(target=self._watch, name="watch", daemon=True).start()
        return Here(env=operated.env, scenes=OneScene(operated.env), person=operated.session)

    # -- acting ----------------------------------------------------------------------------------------------

    def act(self, turn: Turn, weights: Weights, random_state: RandomState | None, pauses: bool) -> Reply:
        """Act a turn. random_state: torch's, to go on from; None: one that follows from run, collector and turn.

        pauses: stop after each control step, for `go_on`.
        """
        here, agent = self._ready(weights)
        self._take(random_state)
        if random_state is None:
            entropy = [turn.seed, turn.number, self.index]
            torch.manual_seed(int(np.random.SeedSequence(entropy).generate_state(1)[0]))
        self._acting = Acting(turn, agent, here.env, here.person, here.random_steps)
        self._steps = iter(self._acting)
        now = time.monotonic()
        self._idle_s, self._since = now - self._since, now
        return self._go(pauses)

    def go_on(self, weights: Weights, random_state: RandomState) -> Reply:
        """Go on with a turn that paused."""
        if self._acting is None:
            raise NewbornError("It has no turn.")
        self._ready(weights)
        self._take(random_state)
        return self._go(True)

    def _go(self, pauses: bool) -> Reply:
        acting = self._acting
        assert acting is not None  # noqa: S101  # `act` comes first
        self._busy = True
        try:
            before = acting.turn.steps
            for steps in self._steps:
                if self._stopping:
                    return Left()
                if pauses and steps > before:
                    return Paused(steps=steps, random_state=torch.get_rng_state().numpy())
        except Interrupted:
            return Left()
        finally:
            self._busy = False
        assert acting.finished is not None  # noqa: S101  # it came to its end
        self._spool.put(acting.finished)
        now = time.monotonic()
        acted_s, self._since = now - self._since, now
        return Done(
            finished=acting.finished, random_state=torch.get_rng_state().numpy(), acted_s=acted_s, idle_s=self._idle_s
        )

    def evaluate(self, weights: Weights, episodes: int, seed: int, film: int) -> Evaluation | Left:
        """Evaluation episodes with seeds from `seed` on."""
        here, agent = self._ready(weights)

        def look() -> None:
            if self._stopping:
                raise Interrupted

        self._busy = True
        try:
            return here.evaluate(agent, episodes, seed, look, film)
        except Interrupted:
            return Left()
        finally:
            self._busy, self._since = False, time.monotonic()

    def _ready(self, weights: Weights) -> tuple[Here, Agent]:
        if self._here is None or self._agent is None:
            raise NewbornError("It has no policy yet.")
        take_weights(self._agent, weights)
        return self._here, self._agent

    def _take(self, random_state: RandomState | None) -> None:
        if random_state is not None:
            torch.set_rng_state(torch.from_numpy(np.array(random_state)))

    # -- beside that -----------------------------------------------------------------------------------------

    def pulse(self, doing: str) -> Pulse:
        """Hear of the learner, and tell it what is new."""
        self._heard = time.monotonic()
        if self._here is not None:
            self._corrected |= self._here.take_corrected()
            if not self._busy:
                self._here.learning(doing)
        said, self._said = self._said, []
        session = self._operated.session if self._operated is not None else None
        state = str(session.state) if session is not None else "acting" if self._busy else "waiting"
        return Pulse(corrected=dict(self._corrected), said=said, doing=state)

    def unstored(self, prefix: str) -> list[Finished]:
        """Episodes of the run whose keys begin so, of whatever collector on this machine, that were never stored."""
        return [finished for finished in self._spool if finished.turn.key.startswith(prefix)]

    def stored(self, keys: Sequence[str]) -> None:
        """The learner has these."""
        for key in keys:
            self._spool.drop(key)

    def stop(self) -> None:
        """Come to an end at the next step; an arm is held at once."""
        self._stopping = True

    def close(self) -> None:
        """Free simulator or arm and page."""
        self._stack.close()

    def _say(self, text: str) -> None:
        self._said.append(text)

    def _watch(self) -> None:
        """Tell the person at an arm where nothing is heard of the learner; the arm is held all the time."""
        while not self._stopping:
            time.sleep(1.0)
            silent = time.monotonic() - self._heard
            if silent > SIGN_S and not self._busy and self._here is not None:
                self._here.learning(f"no sign of the learner for {silent:.0f} s: the arm holds, episodes are kept")


def versions() -> dict[str, str]:
    """What must be the same on both ends."""
    names = ("lerobot_policy_cqn", "lerobot", "torch", "numpy")
    return {name: version(name) for name in names} | {"python": ".".join(platform.python_version_tuple()[:2])}


def _cache() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "lerobot_policy_cqn" / "episodes"
