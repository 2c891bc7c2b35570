"""An arm and the leader that a person takes it over with, in arrays; every goal passes the guard."""

import contextlib
from collections.abc import Callable, Sequence

import numpy as np
import torch
from lerobot.robots.robot import Robot
from lerobot.teleoperators.teleoperator import Teleoperator
from lerobot.utils.constants import OBS_IMAGES, OBS_STATE
from numpy.typing import NDArray

from lerobot_cqn.errors import ConfigError

from ..interfaces import Frame
from .guard import Guard
from .limits import Limits
from .readings import Reading, RobotFault
from .settings import ArmSettings

__all__ = ["Arm", "state_names"]

Array = NDArray[np.float64]
TAKEN = 5  # tries for two readings of the leader that agree
AT_HOME = 0.1  # share of the largest step within which the arm counts as being at home
REST_S = 1.0  # without getting nearer: gravity, or an obstacle, keeps it from there


def state_names(robot: Robot) -> list[str]:
    """Names of the values P in a robot's state, in the order in which LeRobot records them."""
    return [name for name, kind in robot.observation_features.items() if kind is float]


class Arm:
    """The arm that the session moves: goals [D] in the robot's units, frames under LeRobot's names.

    Attributes:
        guard: through which everything goes.
        names: joints in the order of goals.
        home: joints [D] to go to between episodes; None: the arm stays where it is.
    """

    def __init__(
        self,
        guard: Guard,
        settings: ArmSettings,
        fps: int,
        *,
        leader: Teleoperator | None = None,
        clutched: Sequence[int] = (),
        home: Array | None = None,
    ) -> None:
        """Put together what is made already; nothing moves yet.

        clutched: dimensions of the goal in which the leader's movements count from where it was taken, so that the arm
            does not leap to it; the others (a gripper) follow the leader as it is.
        Raises ConfigError when the leader does not have the arm's joints.
        """
        self.guard, self.settings, self.fps, self.leader = guard, settings, fps, leader
        self.names, self.home = guard.names, home
        self._clutched = list(clutched)
        self._offset: Array | None = None
        self._states = state_names(guard.robot)
        self._rested = 0  # control steps on the way home without getting nearer
        self._at: tuple[Array, Array] = np.zeros(0), np.zeros(0)  # goal and joints before them
        if leader is not None:
            missing = [name for name in self.names if name not in leader.action_features]
            if missing:
                raise ConfigError(
                    f"The leader gives no '{missing[0]}': expected the arm's joints {list(self.names)}, it has "
                    f"{list(leader.action_features)}; use a leader with the same joints."
                )

    @property
    def limits(self) -> Limits:
        """Limits that every goal keeps to."""
        return self.guard.limits

    def connect(self) -> None:
        """Connect leader and arm, and start the watchdog. Raises RobotFault when one does not answer."""
        try:
            if self.leader is not None and not self.leader.is_connected:
                self.leader.connect()
        except Exception as error:  # drivers raise many kinds
            raise RobotFault(
                f"The leader cannot be connected: {error} Check cables, power and --teleop.port."
            ) from error
        try:
            self.guard.open()
        except Exception:
            self.close()
            raise

    def close(self) -> None:
        """Leave the arm as `on_exit` says, and disconnect both, whatever goes wrong on the way."""
        try:
            self.guard.close(release=self.settings.on_exit == "release")
        finally:
            if self.leader is not None and self.leader.is_connected:
                with contextlib.suppress(Exception):
                    self.leader.disconnect()

    def frame(self, reading: Reading) -> Frame:
        """A reading as an observation: state [1, P], pictures uint8 [1, 3, H, W]."""
        state = torch.tensor([[float(reading.raw[name]) for name in self._states]], dtype=torch.float32)
        frame: Frame = {OBS_STATE: state}
        for name, picture in reading.pictures.items():
            frame[f"{OBS_IMAGES}.{name}"] = torch.from_numpy(picture).permute(2, 0, 1)[None].contiguous()
        return frame

    # -- the leader ------------------------------------------------------------------------------------------

    def follow(self) -> Array:
        """Goal [D] that the person at the leader asks for. Raises RobotFault when the leader cannot be read."""
        if self.leader is None:
            raise RobotFault("There is no leader arm.")
        wanted = self._led(self.leader)
        if self._offset is None:
            # What it says when it is taken counts as long as it is held: one wrong reading would lead the arm astray.
            for _ in range(TAKEN):
                before, wanted = wanted, self._led(self.leader)
                if (np.abs(wanted - before)[self._clutched] <= self.limits.max_step[self._clutched]).all():
                    break
            else:
                raise RobotFault("The leader's readings do not agree: keep it still while you take over.")
            self._offset = np.zeros(len(self.names))
            self._offset[self._clutched] = (self.guard.joints - wanted)[self._clutched]
        return wanted + self._offset

    def _led(self, leader: Teleoperator) -> Array:
        """The leader's joints [D]."""
        try:
            action = leader.get_action()
            wanted = np.array([float(action[name]) for name in self.names])
        except Exception as error:  # drivers raise many kinds
            raise RobotFault(f"The leader cannot be read: {error} Check its cable and power.") from error
        if not np.isfinite(wanted).all():
            bad = self.names[int(np.flatnonzero(~np.isfinite(wanted))[0])]
            raise RobotFault(f"The leader's joint '{bad}' reads {action[bad]}: expected a finite number.")
        return wanted

    def let_go(self) -> None:
        """The person does not drive; a leader with motors is led along, so that it is where the arm is when taken."""
        self._offset = None
        if self.leader is not None and self.leader.feedback_features:
            with contextlib.suppress(Exception):  # it is a convenience: taking over works without
                self.leader.send_feedback(dict(zip(self.names, map(float, self.guard.joints), strict=True)))

    # -- home ------------------------------------------------------------------------------------------------

    def set_off(self) -> None:
        """A way home begins."""
        self._rested = 0

    def step_home(self, may_move: Callable[[], bool]) -> bool:
        """One control step towards home, at `home_speed`; whether it is over. Raises what `Guard.send` does.

        It is where the arm is at home, and where neither its goal nor its joints have come nearer for REST_S.
        """
        if self.home is None:
            return True
        joints, start = self.guard.joints, self.guard.goal
        near = AT_HOME * self.limits.max_step
        if (np.abs(self.home - joints) <= near).all():
            self.guard.send(self.home, may_move)
            return True
        most = self.settings.home_speed * self.limits.max_speed / self.fps
        goal = self.guard.send(start + np.clip(self.home - start, -most, most), may_move)
        if (
            not self._rested
            or (np.abs(goal - self._at[0]) > most / 2).any()
            or (np.abs(joints - self._at[1]) > near).any()
        ):
            self._rested, self._at = 0, (goal, joints)
        self._rested += 1
        return self._rested > REST_S * self.fps

    def short_of_home(self) -> str:
        """A line where the arm rests more than a step from home; "" where it is there, but for what it sags."""
        if self.home is None:
            return ""
        away = np.abs(self.home - self.guard.joints)
        i = int(np.argmax(away / self.limits.max_step))
        if away[i] <= self.limits.max_step[i]:
            return ""
        return (
            f"The arm came to rest {away[i]:g} from home in '{self.names[i]}': is something in its way? Press home "
            "again, or move it by hand."
        )
