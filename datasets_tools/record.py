"""``cqn-data record``: scripted demonstrations as a LeRobotDataset, the way ``lerobot-record`` would leave them.

No reward column, and the pauses of a person who thinks are in: what comes after is the work of the other operations.
"""

import contextlib
import inspect
import signal
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from lerobot_cqn.errors import ConfigError, DataError

from .disk.folders import local_root, refuse_existing
from .human_hand import Hand, HumanOperator, moving_dims
from .terminal.console import Interrupted, load_lerobot, note, progress, result
from .terminal.options import help_page, option, parse_all, parse_choice, with_plugins

__all__ = ["RecordConfig", "ScriptedTeleoperator", "help", "main", "record_dataset"]

FAILURES_IN_A_ROW = 20
IS_PAUSE = "complementary_info.is_pause"
EXAMPLE = """
cqn-data record --env.type=ur5e_station --env.task=click_button \\
    --repo_id=local/click --root=data/click --episodes=30 --pause_share=0.45
"""
NOTES = """
  --env.type=NAME (required), --env.task=…, --env.obs_type=… and the other settings of LeRobot's environment NAME.
  --env.discover_packages_path=PACKAGE imports a package that registers further environments.
Where the teleoperator says when it pauses, complementary_info.is_pause has it for each step, to check filters against.
Ctrl-C ends the recording; the episodes so far are kept as a complete dataset.
"""


@dataclass
class RecordConfig:
    """Settings of ``cqn-data record``; the environment's own are given as ``--env.*``."""

    repo_id: str = option(help="Name of the new dataset, as user/name.")
    root: str | None = option(None, help="Its folder, which must not exist; by default LeRobot's home and the repo_id.")
    episodes: int = option(30, help="Successful demonstrations to record.")
    seed: int = option(0, help="Seed of the first attempt; each further attempt takes the next one.")
    pause_share: float = option(0.45, help="Share of time steps in which the teleoperator pauses, 0 to below 1.")
    tremor_rad: float = option(
        0.0, help="Standard deviation of a trembling hand's noise on each joint action, rad a step; in pauses too."
    )
    human: bool = option(
        False, help="Move as a person's hand does: late, too far, unsteady, each time another way (options below)."
    )
    max_steps: int | None = option(
        None, help="An attempt that takes longer has failed; by default the environment's limit."
    )

    def validate(self) -> None:
        """Check ranges; raises ConfigError naming the option, the range and the value."""
        if self.episodes < 1:
            raise ConfigError(f"Expected --episodes >= 1, got {self.episodes}.")
        if not 0 <= self.pause_share < 1:
            raise ConfigError(f"Expected --pause_share in [0, 1), got {self.pause_share}.")
        if not 0 <= self.tremor_rad < float("inf"):
            raise ConfigError(f"Expected a finite --tremor_rad >= 0, got {self.tremor_rad}.")
        if self.max_steps is not None and self.max_steps < 1:
            raise ConfigError(f"Expected --max_steps >= 1, got {self.max_steps}.")
        if self.seed < 0:
            raise ConfigError(f"Expected --seed >= 0, got {self.seed}.")


class ScriptedTeleoperator(Protocol):
    """The object that an environment's ``scripted_teleoperator(pause_share=, seed=)`` returns.

    With ``--tremor_rad`` it is called with ``tremor_rad=`` too. A teleoperator may have an attribute ``pausing``, bool:
    whether the last ``act`` was a pause.
    """

    def reset(self, seed: int) -> None:
        """Begin a demonstration; called after the environment's reset."""

    def act(self) -> Any:
        """Action for the environment's present state, (A,) float32."""


def help(summary: str) -> str:
    """Help page."""
    return help_page("cqn-data record", summary, (RecordConfig, Hand), EXAMPLE, NOTES)


def main(args: list[str]) -> None:
    """Run from the command line; errors as in :func:`record_dataset`."""
    config, hand = parse_all((RecordConfig, Hand), [a for a in args if not a.startswith("--env.")])
    config.validate()
    if hand != Hand() and not config.human:
        raise ConfigError("The habits of a hand (--reaction_s, --overshoot, …) need --human=true.")
    load_lerobot()
    record_dataset(config, env_config([a for a in args if a.startswith("--env.")]), hand)


def record_dataset(config: RecordConfig, env_config: Any, hand: Hand | None = None) -> None:
    """Record and report.

    Args:
        config: what to record.
        env_config: a LeRobot ``EnvConfig``.
        hand: habits of the hand with ``human``; None: the usual ones.

    Raises:
        ConfigError: a setting out of range, or an environment without a scripted teleoperator.
        DataError: too many attempts in a row failed; the episodes before are saved.
        OutputExistsError: the folder exists already.
        Interrupted: Ctrl-C; the episodes before are saved.
    """
    config.validate()
    from .disk.target import new_dataset, write_history

    root = local_root(config.repo_id, config.root)
    refuse_existing(root)
    with _environment(env_config) as env:
        hand = hand or Hand()
        teleoperator = _teleoperator(env, env_config, config, hand)
        session = _Session(env, teleoperator, config, task=_task(env, env_config), hand=hand)
        features = session.features()
        writer = new_dataset(
            config.repo_id, root, fps=int(env_config.fps), features=features, robot_type=str(env_config.type)
        )
        with writer as target, _stop_on_interrupt(session):
            session.run(target)
            if target.episodes == 0:
                session.explain(saved=0, root=str(root))
            write_history(target.folder, [session.entry()])
            episodes, frames = target.episodes, target.frames
    session.explain(saved=episodes, root=str(root))
    retried = f" {session.failures} failed attempts were left out." if session.failures else ""
    result(f"Recorded {episodes} episodes, {frames} steps at {int(env_config.fps)} Hz to {root}.{retried}")


class _Session:
    """One recording: attempts until enough succeeded, it was stopped, or too many failed."""

    def __init__(
        self, env: Any, teleoperator: ScriptedTeleoperator, config: RecordConfig, task: str, hand: Hand
    ) -> None:
        self.env, self.teleoperator, self.config, self.task = env, teleoperator, config, task
        self.hand = hand
        self.failures = 0
        self._stop_asked = False
        self.gave_up = False

    def features(self) -> dict[str, dict[str, Any]]:
        """LeRobot features of the first observation and the action space."""
        observation, _ = self.env.reset(seed=self.config.seed)
        plain = self.env.unwrapped
        names = {
            "observation.state": getattr(plain, "state_names", None),
            "observation.environment_state": getattr(plain, "environment_state_names", None),
        }
        features: dict[str, dict[str, Any]] = {}
        for key, value in _columns(observation).items():
            if value.ndim == 3:
                axes = ["height", "width", "channels"]
                features[key] = {"dtype": "video", "shape": value.shape, "names": axes}
            else:
                features[key] = {"dtype": "float32", "shape": value.shape, "names": _list(names.get(key))}
        shape = tuple(self.env.action_space.shape)
        features["action"] = {"dtype": "float32", "shape": shape, "names": _list(getattr(plain, "action_names", None))}
        if self._pausing():
            features[IS_PAUSE] = {"dtype": "bool", "shape": (1,), "names": None}
        return features

    def run(self, target: Any) -> None:
        """Fill ``target``; is ``stopped()`` or ``gave_up`` where it ends early."""
        seed, in_a_row = self.config.seed, 0
        with progress() as bar:
            line = bar.add_task("Recording episodes", total=self.config.episodes)
            while target.episodes < self.config.episodes and not self.stopped():
                success = self._attempt(target, seed)
                seed += 1
                if self.stopped():
                    target.drop_episode()
                elif success:
                    target.save_episode()
                    bar.advance(line)
                    in_a_row = 0
                else:
                    target.drop_episode()
                    self.failures += 1
                    in_a_row += 1
                    if in_a_row >= FAILURES_IN_A_ROW:
                        self.gave_up = True
                        return

    def explain(self, saved: int, root: str) -> None:
        """Raise what ended the recording early, naming what is on disk; nothing when it was complete."""
        asked = self.config.episodes
        kept = f"{saved} of {asked} episodes are saved in {root}" if saved else "nothing was saved"
        if self.stopped():
            raise Interrupted(f"Interrupted: {kept}.")
        if self.gave_up:
            raise DataError(
                f"{FAILURES_IN_A_ROW} attempts in a row failed, the last with seed"
                f" {self.config.seed + saved + self.failures - 1}; {kept}. Raise --max_steps or lower --pause_share."
            )

    def stopped(self) -> bool:
        """Whether somebody asked to end the session; a method, since a signal handler changes it at any time."""
        return self._stop_asked

    def stop(self) -> None:
        """End the session after the present step."""
        self._stop_asked = True

    def _attempt(self, target: Any, seed: int) -> bool:
        """One demonstration; the observation stored with an action is the one before it."""
        import numpy as np

        observation, _ = self.env.reset(seed=seed)
        self.teleoperator.reset(seed)
        steps, over, success = 0, False, False
        while not over and not self.stopped():
            action = np.asarray(self.teleoperator.act(), dtype=np.float32)
            target.add({**_columns(observation), "action": action, **self._pausing()}, self.task)
            observation, _, terminated, truncated, info = self.env.step(action)
            steps += 1
            success = bool(info.get("is_success", False))
            late = self.config.max_steps is not None and steps >= self.config.max_steps
            over = bool(terminated or truncated or success or late)
        return success

    def entry(self) -> dict[str, Any]:
        """Entry of the history: settings, and what the actions are where the environment says it."""
        settings = {k: v for k, v in vars(self.config).items() if k not in ("repo_id", "root") and v is not None}
        settings |= vars(self.hand) if self.config.human else {}
        entry = {"operation": "record", "target": self.config.repo_id, "settings": settings, "told": told(settings)}
        plain = self.env.unwrapped
        kind = getattr(plain, "action_kind", None)
        if kind is None:
            return entry
        joints = [n for n in plain.action_names if n in plain.state_names and "gripper" not in n]
        return {**entry, "deltas": {"kind": kind, "action": joints, "state": joints}}

    def _pausing(self) -> dict[str, Any]:
        """Column of one step, (1,) bool; none where the teleoperator does not say."""
        import numpy as np

        pausing = getattr(self.teleoperator, "pausing", None)
        return {} if pausing is None else {IS_PAUSE: np.array([bool(pausing)])}


def told(settings: Mapping[str, Any]) -> str:
    """The sentence for the history, from the settings of a recording."""
    said = f"Recorded scripted demonstrations in an environment until {settings['episodes']} had succeeded"
    hand = " and moves as a person's hand does" if settings.get("human") else ""
    return f"{said}; the script pauses in {settings['pause_share']:.0%} of the time steps{hand}."


def _columns(observation: dict[str, Any]) -> dict[str, Any]:
    """Gymnasium observation under LeRobot's column names; vectors float32, pictures (H, W, 3) uint8."""
    import numpy as np

    pixels = observation.get("pixels", {})
    pictures = pixels if isinstance(pixels, dict) else {None: pixels}
    columns: dict[str, Any] = {
        f"observation.images.{name}" if name else "observation.image": np.asarray(picture, dtype=np.uint8)
        for name, picture in pictures.items()
    }
    for name, key in (("agent_pos", "observation.state"), ("environment_state", "observation.environment_state")):
        if name in observation:
            columns[key] = np.asarray(observation[name], dtype=np.float32)
    return columns


def _list(names: Any) -> list[str] | None:
    return [str(n) for n in names] if names else None


def _task(env: Any, env_config: Any) -> str:
    described = getattr(env.unwrapped, "task_description", None)
    return str(described or env_config.task or env_config.type).replace("_", " ")


def env_config(args: Sequence[str]) -> Any:
    """LeRobot's environment config from ``--env.*`` options; raises ConfigError."""
    from lerobot.envs.configs import EnvConfig
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    settings = with_plugins(args)
    if any("=" not in setting for setting in settings):
        raise ConfigError("Settings of the environment are written --env.NAME=VALUE.")
    return parse_choice("env", EnvConfig, settings)


@contextlib.contextmanager
def _environment(env_config: Any) -> Iterator[Any]:
    """One environment, made by LeRobot itself so that whatever it can evaluate in can be recorded in."""
    from lerobot.envs.factory import make_env

    try:
        with contextlib.redirect_stdout(None):
            suites = make_env(env_config, n_envs=1)
    except ImportError as error:
        raise ConfigError(f"Environment '{env_config.type}' cannot be made: {error}") from error
    vector = next(iter(next(iter(suites.values())).values()))
    try:
        yield vector.envs[0]
    finally:
        vector.close()


def _teleoperator(env: Any, env_config: Any, config: RecordConfig, hand: Hand) -> ScriptedTeleoperator:
    make = getattr(env.unwrapped, "scripted_teleoperator", None)
    if make is None:
        raise ConfigError(
            f"Environment '{env_config.type}' has no scripted teleoperator: record a person with lerobot-record, or"
            " train without demonstrations (cqn-train --demo_batch_size=0 --action_bounds=environment)."
        )
    tremor = {"tremor_rad": config.tremor_rad} if config.tremor_rad > 0 else {}
    if tremor and "tremor_rad" not in inspect.signature(make).parameters:
        raise ConfigError(f"The teleoperator of '{env_config.type}' cannot tremble; leave --tremor_rad out.")
    teleoperator: ScriptedTeleoperator = make(pause_share=config.pause_share, seed=config.seed, **tremor)
    if not config.human:
        return teleoperator
    space = env.action_space
    names = [str(name) for name in getattr(env.unwrapped, "action_names", None) or map(str, range(space.shape[0]))]
    moving = moving_dims(names, space.low, space.high)
    if not len(moving):
        raise ConfigError(f"The actions of '{env_config.type}' are no movements ({names}); leave --human out.")
    return HumanOperator(teleoperator, hand, moving, space.high[moving], int(env_config.fps))


@contextlib.contextmanager
def _stop_on_interrupt(session: _Session) -> Iterator[None]:
    """Let the first Ctrl-C end the session between two steps, and a second one abandon everything."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(signum: int, frame: Any) -> None:
        if session.stopped():
            raise KeyboardInterrupt
        session.stop()
        note("Stopping: the finished episodes are being saved (Ctrl-C again abandons them).")

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
