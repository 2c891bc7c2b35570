"""The one way to the motors: every goal of policy, person and reset passes here, and so does every reading."""

import contextlib
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.robots.robot import Robot
from numpy.typing import NDArray

from lerobot_cqn.errors import CQNError

from ..clock import REAL, Clock
from .limits import Limits, allowed_goal

__all__ = ["Guard", "GuardSettings", "Reading", "RobotFault", "StoppedError"]

Array = NDArray[np.float64]


class RobotFault(CQNError, RuntimeError):  # noqa: N818  # what people call it
    """The robot cannot be read or moved, or what it says cannot be true; the arm is held where that is possible."""

    def __init__(self, text: str) -> None:
        super().__init__(" ".join(text.split()))  # drivers' errors have many lines


class StoppedError(CQNError, RuntimeError):
    """A goal came after the stop; nothing is sent any more."""


class HeldError(CQNError, RuntimeError):
    """A goal came when the arm may not move, for example just after a pause; it was not sent."""


@dataclass(frozen=True)
class GuardSettings:
    """Time limits in seconds.

    stale_s: how long a camera's picture, or the joints while they are told to move, may stay exactly the same.
    watchdog_s: after how long without a goal the arm is held where it is.
    slow_s: how long a reading or sending may take.
    """

    stale_s: float = 1.0
    watchdog_s: float = 0.5
    slow_s: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Reading:
    """One observation: joints [D] in the robot's units, pictures by name, everything the robot gave, and when."""

    joints: Array
    pictures: Mapping[str, NDArray[np.uint8]]
    raw: Mapping[str, Any]
    at: float


class Guard:
    """A robot behind limits, staleness checks, a watchdog and a stop that always wins. Use as a context manager.

    Attributes:
        interventions: how often each limit changed a goal, by its name.
        names: joints, in the order of arrays [D].
    """

    def __init__(
        self, robot: Robot, limits: Limits, settings: GuardSettings | None = None, clock: Clock = REAL
    ) -> None:
        self.robot, self.limits, self.settings = robot, limits, settings or GuardSettings()
        self.names = tuple(robot.action_features)
        self.interventions: dict[str, int] = {}
        self._clock = clock
        self._lock = clock.lock()
        self._stopped = threading.Event()
        self._closing = threading.Event()
        self._goal: Array | None = None
        self._measured: Array | None = None
        self._trusted = True  # whether the joints that were read last can be believed
        self._sent_at = self._asked_at = self._read_at = clock.now
        self._held, self._released = True, False
        self._changed_at: dict[str, float] = {}
        self._before: dict[str, Any] = {}
        self._watchdog: threading.Thread | None = None

    # -- life ------------------------------------------------------------------------------------------------

    def __enter__(self) -> "Guard":
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(self) -> None:
        """Connect, read once, start the watchdog. Raises RobotFault when the robot does not answer."""
        try:
            if not self.robot.is_connected:
                self.robot.connect()
        except CQNError:
            raise
        except Exception as error:  # drivers raise many kinds
            raise RobotFault(f"The robot cannot be connected: {error} Check cables, power and --robot.port.") from error
        self.read()
        self._watchdog = self._clock.thread(self._run, "watchdog")
        self._watchdog.start()

    def close(self, *, release: bool = False) -> None:
        """Leave the arm holding, or released, and disconnect; whatever goes wrong, the rest is still tried."""
        self._closing.set()
        if self._watchdog is not None:
            self._watchdog.join(2 * self.settings.watchdog_s)
        with self._lock:
            with contextlib.suppress(Exception):
                self._hold()
                if release:
                    self.release()
            if self.robot.is_connected:
                self.robot.disconnect()

    # -- reading ---------------------------------------------------------------------------------------------

    def read(self) -> Reading:
        """Joints and pictures. Raises RobotFault when it fails, takes too long, or is not finite, or stale."""
        with self._lock:
            begun = self._clock.now
            try:
                raw = self.robot.get_observation()
                joints = np.array([float(raw[name]) for name in self.names])
            except Exception as error:  # drivers raise many kinds, or leave a joint out
                raise RobotFault(f"The robot cannot be read: {error} Check cables and power.") from error
            now = self._clock.now
            if now - begun > self.settings.slow_s:
                raise RobotFault(
                    f"Reading the robot took {now - begun:.1f} s, expected at most {self.settings.slow_s:g} s."
                )
            self._trusted = False
            if not np.isfinite(joints).all():
                bad = self.names[int(np.flatnonzero(~np.isfinite(joints))[0])]
                raise RobotFault(f"The joint '{bad}' reads {raw[bad]}: expected a finite number; check its sensor.")
            pictures = {name: value for name, value in raw.items() if isinstance(value, np.ndarray) and value.ndim == 3}
            self._check_fresh(joints, pictures, now)
            self._measured, self._trusted, self._read_at = joints, True, now
            if self._goal is None:
                self._goal = joints
        return Reading(joints=joints, pictures=pictures, raw=raw, at=now)

    def _check_fresh(self, joints: Array, pictures: Mapping[str, NDArray[np.uint8]], now: float) -> None:
        """Refusal of what does not change at all, and so was not measured: noise alone makes real readings differ."""
        moving = self._goal is not None and (np.abs(self._goal - joints) > 0.5 * self.limits.max_step).any()
        values: dict[str, NDArray[Any]] = {"joints": joints, **pictures}
        for name, value in values.items():
            same = name in self._before and np.array_equal(value, self._before[name])
            if not same or (name == "joints" and not moving):
                self._before[name], self._changed_at[name] = value, now
            elif now - self._changed_at[name] > self.settings.stale_s:
                what = "The joints have" if name == "joints" else f"The camera '{name}' has"
                raise RobotFault(
                    f"{what} not changed for {now - self._changed_at[name]:.1f} s: it is frozen or disconnected."
                )

    @property
    def joints(self) -> Array:
        """Joints [D] as read last. Raises RobotFault before the first reading."""
        if self._measured is None:
            raise RobotFault("The robot was not read yet.")
        return self._measured.copy()

    @property
    def goal(self) -> Array:
        """Goal [D] that was sent last; the joints before the first one."""
        return self.joints if self._goal is None else self._goal.copy()

    # -- moving ----------------------------------------------------------------------------------------------

    def send(self, wanted: Array, may_move: Callable[[], bool] = lambda: True) -> Array:
        """Send the nearest goal [D] that the limits allow; returns it.

        may_move: asked while nobody else can send, so that no goal comes after the `hold` of a pause.
        Raises StoppedError after `stop`, HeldError where the arm may not move, RobotFault when the robot does not take
        the goal.
        """
        with self._lock:
            if self._stopped.is_set():
                raise StoppedError("The arm was stopped: start again to move it.")
            if self._released or not may_move():
                raise HeldError("The arm may not move now.")
            now = self._clock.now
            if self._measured is None or self._goal is None:
                self.read()
            assert self._measured is not None and self._goal is not None  # noqa: S101, PT018  # read sets both
            # After a break the arm must not catch up in one leap.
            seconds = min(now - self._sent_at, self.settings.watchdog_s)
            verdict = allowed_goal(wanted, self._measured, self._goal, seconds, self.limits)
            for reason in verdict.reasons:
                self.interventions[reason] = self.interventions.get(reason, 0) + 1
            self._transmit(verdict.goal)
            self._asked_at, self._held = now, False
            return verdict.goal

    def hold(self) -> None:
        """Stay where the arm is now. Raises RobotFault when the robot does not take it."""
        with self._lock:
            self._hold()

    def refuse(self) -> None:
        """Refuse every goal from now on, without waiting for anything; `stop` holds the arm as well."""
        self._stopped.set()

    def stop(self) -> None:
        """Hold, and refuse every goal from now on; may be called from any thread, at any time, repeatedly."""
        self.refuse()  # before the lock: a goal that waits for it is refused as well
        with self._lock, contextlib.suppress(RobotFault):
            self._hold()

    @property
    def stopped(self) -> bool:
        """Whether `stop` was called."""
        return self._stopped.is_set()

    def release(self) -> None:
        """Let a person move the arm by hand; no goal is sent before `engage`. Raises RobotFault where it cannot be."""
        with self._lock:
            self._torque(on=False)
            self._released = True

    def engage(self) -> None:
        """Hold the arm where it is now, after `release`. Raises RobotFault when the robot does not do it."""
        with self._lock:
            if self._released:
                # Before the motors hold again: they would leap to the goal that they were given last.
                self._transmit(self.read().joints)
                self._torque(on=True)
                self._released = False
                self._hold()

    @property
    def released(self) -> bool:
        """Whether a person may move the arm by hand."""
        return self._released

    @property
    def can_release(self) -> bool:
        """Whether the robot's motors can be switched off and on, as LeRobot's motor buses can."""
        bus = getattr(self.robot, "bus", None)
        return callable(getattr(bus, "disable_torque", None)) and callable(getattr(bus, "enable_torque", None))

    def _torque(self, *, on: bool) -> None:
        if not self.can_release:
            raise RobotFault("This robot cannot be moved by hand: it has no motor bus that lets go.")
        try:
            bus: Any = getattr(self.robot, "bus")  # noqa: B009  # not of every robot
            (bus.enable_torque if on else bus.disable_torque)()
        except Exception as error:  # drivers raise many kinds
            raise RobotFault(f"The motors cannot be switched {'on' if on else 'off'}: {error}") from error

    def recover(self) -> None:
        """After a fault: connect again where the connection is gone, read, hold. Raises RobotFault where it fails."""
        with self._lock:
            try:
                if not self.robot.is_connected:
                    self.robot.connect()
            except Exception as error:  # drivers raise many kinds
                raise RobotFault(f"The robot cannot be connected: {error} Check cables and power.") from error
            self.read()
            self._goal = self._measured  # not where it was sent before: it may have been moved
            self._hold()

    def _hold(self) -> None:
        # Where the arm says it is; where it was sent last when that is newer, or the reading cannot be believed.
        place = self._measured if self._trusted and self._read_at >= self._sent_at else self._goal
        if place is not None and self._goal is not None and not self._released:
            self._held = True
            # An arm that is beyond a limit stays there: led back at once, it would leap.
            low, high = np.minimum(self.limits.low, self._goal), np.maximum(self.limits.high, self._goal)
            self._transmit(np.clip(place, low, high))

    def _transmit(self, goal: Array) -> None:
        try:
            self.robot.send_action({name: float(value) for name, value in zip(self.names, goal, strict=True)})
        except Exception as error:  # drivers raise many kinds
            raise RobotFault(f"The robot takes no goal: {error} Check cables and power.") from error
        self._goal, self._sent_at = goal, self._clock.now

    def _run(self) -> None:
        while not self._clock.wait(self._closing, self.settings.watchdog_s / 5):
            self.watch()

    def watch(self) -> None:
        """One look of the watchdog: hold the arm when nobody has sent a goal for too long, whatever the reason."""
        # Without the lock: a reading that hangs must not blind the watchdog, only delay its goal.
        if not self._held and self._clock.now - self._asked_at > self.settings.watchdog_s:
            self.interventions["watchdog"] = self.interventions.get("watchdog", 0) + 1
            with self._lock, contextlib.suppress(RobotFault):
                if not self._held:
                    self._hold()
