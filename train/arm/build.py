"""Parts of a run on an arm, checked to fit one another: robot, leader, limits, home, page or keys."""

import contextlib
import dataclasses
import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.configs.types import FeatureType
from lerobot.robots.config import RobotConfig
from lerobot.robots.robot import Robot
from lerobot.robots.utils import make_robot_from_config
from lerobot.teleoperators.utils import make_teleoperator_from_config
from lerobot.utils.constants import ACTION, OBS_STATE
from numpy.typing import NDArray

from cqn_data.decisions.joints import no_positions
from cqn_data.web.access import ANY_ADDRESS
from cqn_data.web.server import own_address
from cqn_data.web.tls import Certificate, check_certificate, own_certificate
from lerobot_cqn.errors import ConfigError, DataError, one_of

from ..agent import Agent
from ..clock import REAL, Clock
from ..config import PageSettings, RunConfig
from ..interfaces import PAGE_TOKEN
from ..operator.board import Board
from ..operator.session import Session
from ..replay.demonstrations import Recorded
from ..robot.arm import Arm, state_names
from ..robot.guard import Guard, GuardSettings
from ..robot.limits import Forward, Limits
from ..robot.settings import ArmSettings
from ..run.beginning import PAGE
from ..run.metrics import read_rows
from .environment import ArmEnvironment

__all__ = ["Operated", "announced", "make_certificate", "make_operated", "recall", "steering"]

Array = NDArray[np.float64]
# Of a joint's range: the largest step where actions are goals, so that none says how far is usual.
ABSOLUTE_SHARE = 0.05
LEAST_STEP = 0.1  # of the largest step of a joint
FAR_LIMIT = 10.0  # times the demonstrated range: degrees are 57 radians
LIMP = "disable_torque_on_disconnect"  # as LeRobot's arms call it
CURRENT_S = 0.3  # that a reading may be old, and no less than two control steps


@dataclass(frozen=True)
class Operated:
    """An arm as the loop's environment, and what its person sees and says."""

    env: ArmEnvironment
    session: Session
    board: Board


def make_operated(
    robot_config: RobotConfig,
    config: RunConfig,
    agent: Agent,
    recorded: Recorded | None,
    should_stop: Callable[[], bool],
    say: Callable[[str], None],
    clock: Clock = REAL,
) -> Operated:
    """Robot, leader and session, checked to fit the policy; nothing is connected yet.

    say: shows a warning. Raises ConfigError or DataError in one line.
    """
    robot = _made("robot", make_robot_from_config, robot_config)
    leader = _made("teleop", make_teleoperator_from_config, config.teleop) if config.teleop is not None else None
    check_commands(robot)
    check_robot_fits(robot, agent)
    if recorded is not None:
        _check_names(robot, recorded.names)
    fps = config.arm.fps or (round(recorded.fps) if recorded is not None else None)
    if fps is None:
        raise ConfigError("How many control steps a second? Give --arm.fps (that of the demonstrations).")
    seen_fps = recorded.fps if recorded is not None else fps
    limits = limits_of(robot, agent, config.arm, fps, seen_fps)
    first = recorded.first_states if recorded is not None else None
    home = home_of(first, robot, config.arm) if recorded is not None or config.arm.home else None
    names = tuple(robot.action_features)
    _check_home(home, names, limits)
    settings = GuardSettings(config.arm.stale_s, config.arm.watchdog_s, current_s=max(CURRENT_S, 2 / fps))
    clutched = [i for i, name in enumerate(names) if "gripper" not in name]
    arm = Arm(Guard(robot, limits, settings, clock), config.arm, fps, leader=leader, clutched=clutched, home=home)
    if agent.deltas is None:
        say(
            "Warning: the policy's actions are absolute goals, which may lie far from the arm; on real arms learn "
            "differences (cqn-data delta, or the recipe paper_real_world)."
        )
    session = Session(leader=leader is not None, can_free=arm.guard.can_release)
    board = Board(session, clock=clock)
    if config.arm.on_exit == "hold" and (falls := _lets_go(robot_config)):
        say(
            "Warning: this robot lets its motors go when it is disconnected, so the arm falls at the end of the run: "
            f"give {' '.join(f'--robot.{name}=false' for name in falls)} to hold it."
        )
    return Operated(ArmEnvironment(arm, session, board, should_stop, clock), session, board)


def _lets_go(config: Any, prefix: str = "") -> list[str]:
    """Options, also of the arms that a robot is made of, by which motors go limp at the end."""
    found = [f"{prefix}{LIMP}"] if getattr(config, LIMP, False) else []
    parts = {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
    arms = {name: part for name, part in parts.items() if dataclasses.is_dataclass(part) and hasattr(part, LIMP)}
    return found + [one for name, part in arms.items() for one in _lets_go(part, f"{prefix}{name}.")]


@contextlib.contextmanager
def steering(config: RunConfig, operated: Operated, say: Callable[[str], None]) -> Any:
    """The operator's page, or keys in the terminal, while the block runs. Raises ConfigError without either."""
    if not config.operator_page:
        if not sys.stdin.isatty():
            raise ConfigError("There is no terminal whose keys could steer the arm: leave out --operator_page=false.")
        from ..operator.keys import TerminalKeys

        with TerminalKeys(operated.session):
            yield
        return
    from ..operator.page.server import OperatorServer

    page, token = config.page, os.environ.get(PAGE_TOKEN) or None
    certificate = make_certificate(page, config.output_dir, say)
    with OperatorServer(operated.board, page.host, page.port, token, page.absent_s, certificate=certificate) as server:
        say(f"Operator's page: {announced(server.url, config.output_dir)}")
        yield


def announced(url: str, output_dir: Path | None) -> str:
    """The page's address for a person; without its token where it goes into a log, which others may read."""
    if sys.stdout.isatty() or output_dir is None:
        return url
    path = output_dir / PAGE / "address"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)  # of an earlier run, whoever might read it
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
        file.write(url + "\n")
    return f"{url.partition('?')[0]} (with its token in {path}, which only you can read)"


def make_certificate(page: PageSettings, output_dir: Path | None, say: Callable[[str], None]) -> Certificate | None:
    """For https where it was asked for. Raises ConfigError for files that cannot be used."""
    if page.certfile and page.keyfile:
        return check_certificate(page.certfile, page.keyfile)
    if not page.tls or output_dir is None:
        return None
    hosts = ["localhost", "127.0.0.1", own_address(), *([] if page.host in ANY_ADDRESS else [page.host])]
    made, fingerprint = own_certificate(output_dir / PAGE, hosts)
    say(f"Certificate: {made[0]}, SHA-256 {fingerprint}; the browser shows the same before you trust it.")
    return made


def recall(board: Board, output_dir: Path) -> None:
    """Show what a resumed run did before: the rows of its tables."""
    for table in ("episodes", "evaluations"):
        for row in read_rows(output_dir / f"{table}.csv"):
            numbers = {f"{table}/{name}": text for name, text in row.items() if text and name != "phase"}
            board.log({name: float(text) for name, text in numbers.items()})


def check_commands(robot: Robot) -> None:
    """An arm must be moved by positions that it can be read at. Raises ConfigError by name where it is not."""
    names, states = list(robot.action_features), state_names(robot)
    if others := [names[i] for i in no_positions(names)]:
        raise ConfigError(
            f"--robot.type={robot.name} takes {', '.join(others)}, by their names no positions: to hold such a "
            "robot would be to drive on. cqn-train moves arms by joint positions only."
        )
    if unread := [name for name in names if name not in states]:
        raise ConfigError(
            f"--robot.type={robot.name} takes {', '.join(unread)}, but its observation has only {', '.join(states)}: "
            "each joint that is moved must be read under the same name."
        )


def check_robot_fits(robot: Robot, agent: Agent) -> None:
    """Cameras, state and action must be those of the policy. Raises ConfigError where they are not."""
    needed, features = agent.policy.config.input_features or {}, robot.observation_features
    cameras = [name for name, kind in features.items() if isinstance(kind, tuple)]
    states = state_names(robot)
    for key, feature in needed.items():
        if feature.type is FeatureType.VISUAL and (name := key.rpartition(".")[2]) not in cameras:
            raise ConfigError(one_of("camera of the robot", name, cameras) + " The policy was trained with it.")
        if key == OBS_STATE and feature.shape[0] != len(states):
            raise ConfigError(
                f"The policy's state has {feature.shape[0]} values, the robot's {len(states)} ({', '.join(states)}): "
                "use the robot and the options of the demonstrations."
            )
        if feature.type is FeatureType.ENV:
            raise ConfigError(f"The policy needs '{key}', which only a simulator gives: train it without.")
    if agent.policy.action_dims != len(robot.action_features):
        raise ConfigError(
            f"The policy's action has {agent.policy.action_dims} values, the robot takes {len(robot.action_features)} "
            f"({', '.join(robot.action_features)}): use the robot of the demonstrations."
        )


def limits_of(robot: Robot, agent: Agent, settings: ArmSettings, fps: int, seen_fps: float) -> Limits:
    """Limits from what the demonstrations did: their joints with a margin, their largest step with a factor.

    fps: control steps a second; at a higher rate than `seen_fps`, that of the demonstrations, steps are shorter: the
        speed limit stays.

    Raises ConfigError for joints that are not the robot's, or where neither data nor settings say a limit.
    """
    names = tuple(robot.action_features)
    states = state_names(robot)
    for name in (*settings.joint_limits, *settings.home):
        if name not in names:
            raise ConfigError(one_of("joint", name, names))
    action, state = agent.ranges(ACTION), agent.ranges(OBS_STATE)
    deltas = agent.deltas
    low: Array = np.zeros(len(names))
    high, step = low.copy(), low.copy()
    for i, name in enumerate(names):
        delta = deltas is not None and i in deltas.action_dims
        seen = state[:, states.index(name)] if state is not None and name in states else None
        if action is None or (seen is None and delta):
            raise ConfigError(f"No range of '{name}' in the policy's statistics: give --arm.joint_limits.")
        if delta:
            assert seen is not None  # noqa: S101  # checked above
            low[i], high[i] = seen[0] + min(0.0, action[0, i]), seen[1] + max(0.0, action[1, i])
            step[i] = settings.step_factor * np.abs(action[:, i]).max()
        else:
            low[i], high[i] = action[:, i]
            if seen is not None:
                low[i], high[i] = min(low[i], seen[0]), max(high[i], seen[1])
            gripper = "gripper" in name
            step[i] = (high[i] - low[i]) * (1.0 if gripper else settings.step_factor * ABSOLUTE_SHARE)
        span, given = high[i] - low[i], settings.joint_limits.get(name)
        if given is not None and span > 0 and max(low[i] - given[0], given[1] - high[i]) > FAR_LIMIT * span:
            raise ConfigError(
                f"--arm.joint_limits of '{name}' is {given}, the demonstrations' range {low[i]:.4g} to {high[i]:.4g}:"
                f" it may reach {FAR_LIMIT:g} times that range beyond it at most. Is it in another unit?"
            )
        margin = settings.joint_margin * span
        low[i], high[i] = given or (low[i] - margin, high[i] + margin)
    step *= min(1.0, seen_fps / fps)
    # A joint that hardly moved must still be able to lift itself against gravity, which shorter steps never do.
    arm = np.array(["gripper" not in name for name in names])
    step[arm] = np.maximum(step[arm], LEAST_STEP * step[arm].max(initial=0.0))
    step = np.maximum(step, 1e-3 * np.maximum(high - low, 1e-6))
    box = None
    if settings.workspace is not None:
        corners = np.array(settings.workspace, dtype=np.float64).reshape(3, 2)
        box = corners[:, 0], corners[:, 1]
    forward = _forward(robot, settings) if box is not None else None
    return Limits(low=low, high=high, max_step=step, max_speed=step * fps, box=box, forward=forward)


def home_of(first: NDArray[Any] | None, robot: Robot, settings: ArmSettings) -> Array:
    """Home [D], where the demonstrations start: the median of their first states [K, P]; `arm.home` on top.

    Raises ConfigError for a joint of which neither says it.
    """
    names, home = tuple(robot.action_features), dict[str, float]()
    if first is not None:
        home = dict(zip(state_names(robot), np.median(first, axis=0).tolist(), strict=True))
    home |= settings.home
    missing = [name for name in names if name not in home]
    if missing:
        raise ConfigError(f"Where is home for '{missing[0]}'? Give it, e.g. --arm.home='{{{missing[0]}: 0}}'.")
    return np.array([home[name] for name in names])


def _check_home(home: Array | None, names: tuple[str, ...], limits: Limits) -> None:
    """An arm would never arrive at a home that its limits keep it from. Raises ConfigError."""
    for i, name in enumerate(names):
        if home is not None and not limits.low[i] - 1e-6 <= home[i] <= limits.high[i] + 1e-6:
            raise ConfigError(
                f"Home of '{name}' is {home[i]:g}, its limits are {limits.low[i]:g} to {limits.high[i]:g}: give "
                "another --arm.home or --arm.joint_limits."
            )


def _made(kind: str, make: Callable[[Any], Any], config: Any) -> Any:
    try:
        return make(config)
    except Exception as error:  # drivers raise many kinds, and miss packages
        raise ConfigError(f"The device of --{kind}.type cannot be made: {error}") from error


def _check_names(robot: Robot, recorded: Mapping[str, list[str]]) -> None:
    """A robot with other joints, or in another order, would be driven wrongly. Raises DataError."""
    states = state_names(robot)
    for key, own in ((OBS_STATE, states), (ACTION, list(robot.action_features))):
        names = recorded.get(key, own)
        if names != own:
            raise DataError(f"The dataset's {key} is {names}, the robot's {own}: use the robot of the dataset.")


def _forward(robot: Robot, settings: ArmSettings) -> Forward:
    """Joints [D] -> tip [3], m: the robot's own `tip_position`, or from a URDF. Raises ConfigError without either."""
    names, own = list(robot.action_features), getattr(robot, "tip_position", None)
    if callable(own):
        return lambda joints: np.asarray(own(dict(zip(names, joints.tolist(), strict=True))), dtype=np.float64)
    if not settings.urdf:
        raise ConfigError("--arm.workspace needs the arm's kinematics: give --arm.urdf=FILE (and --arm.tip).")
    try:
        from lerobot.model.kinematics import RobotKinematics

        kinematics = RobotKinematics(settings.urdf, settings.tip)
    except Exception as error:  # the package is missing, or it cannot read the file
        raise ConfigError(f"--arm.urdf={settings.urdf} cannot be used: {error}") from error
    return lambda joints: np.asarray(kinematics.forward_kinematics(joints)[:3, 3], dtype=np.float64)
