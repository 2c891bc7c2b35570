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
from .connection import connect, motor_buses, reconnect, reconnect_cameras
from .limits import Limits, allowed_goal
from .readings import (
    Agreement,
    Contents,
    LateReadingError,
    LostError,
    Reading,
    RobotFault,
    Whereabouts,
    WrongReadingError,
)

__all__ = ["Guard", "GuardSettings", "HeldError", "StoppedError"]

Array = NDArray[np.float64]
WRONG = 3  # readings in a row that cannot be true: a fault; fewer are read again
AGAIN_S = 0.005  # between them: the same answer of a bus is not read twice
TELLS_S = 5.0  # after the last goal: then joints that do not change are no sign any more
LATE = 5  # readings that take too long, where nothing moves yet: cameras warm up
ASKED = 12  # readings until enough agree, where nothing is known yet
APART_S = 0.05  # between them: a glitch is shorter


class StoppedError(CQNError, RuntimeError):
    """A goal came after the stop; nothing is sent any more."""


class HeldError(CQNError, RuntimeError):
    """A goal came when the arm may not move, for example just after a pause; it was not sent."""


@dataclass(frozen=True)
class GuardSettings:
    """Time limits in seconds.

    stale_s: how long a camera's picture, or the joints while they are told to move, may stay exactly the same.
    watchdog_s: after how long without a goal the arm is held where it is.
    current_s: how long a reading may take, and how old it may be when a goal is sent that rests on it.
    """

    stale_s: float = 1.0
    watchdog_s: float = 0.5
    current_s: float = 0.3


class Guard:
    """A robot behind limits, staleness checks, a watchdog and a stop that always wins. Use as a context manager.

    Attributes:
        interventions: how often each limit changed a goal, by its name, and how many readings were refused.
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
        self._contents = Contents(robot)
        self._whereabouts = Whereabouts(self.names, limits)
        self._measured: Array | None = None
        self._trusted = True  # whether the joints that were read last can be believed
        self._lost = False  # whether the robot could not be read when it was to be taken up again
        self._anew = False  # whether its motors were connected anew since the fault
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
        """Connect, read, start the watchdog.

        Raises RobotFault when the robot does not answer, or stands far outside the range of its limits.
        """
        connect(self.robot)
        self._whereabouts.check_start(self.read().joints)
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
                self.robot.disconnect()  # its own way, which may switch the motors off

    # -- reading ---------------------------------------------------------------------------------------------

    def read(self) -> Reading:
        """Joints and pictures that can be true: one reading is read again, WRONG in a row are a fault.

        While the arm is moved by hand its joints may be anywhere. The first reading is one of several that agree.
        Raises RobotFault when it fails, takes too long, cannot be true, or is stale.
        """
        with self._lock:
            if self._measured is None:
                return self._settle()
            self._trusted = False
            for left in reversed(range(WRONG)):
                try:
                    reading = self._look()
                    if not self._released:
                        self._whereabouts.check(reading.joints)
                    break
                except WrongReadingError:
                    self._count("wrong reading")
                    if not left:
                        raise
                    self._clock.sleep(AGAIN_S)
            self._believe(reading)
            return reading

    def _settle(self) -> Reading:
        """A reading that several in a row agree with: where the arm is, when nothing is known of it."""
        self._trusted = False
        agreement = Agreement(self.names, self._whereabouts.slack / 2)
        late = 0
        for asked in range(ASKED):
            if asked:
                self._clock.sleep(APART_S)
            try:
                settled = agreement.add(self._look())
            except (WrongReadingError, LateReadingError) as error:
                self._count("wrong reading")
                late += isinstance(error, LateReadingError)
                if asked == ASKED - 1 or late == LATE:
                    raise
                continue
            if settled is not None:
                if self._measured is None:
                    self._whereabouts.begin(settled.joints)
                self._believe(settled)
                return settled
        raise RobotFault(
            f"The robot's readings do not agree: {agreement.doubt}. Keep the arm still; check its sensors and cables."
        )

    def _look(self) -> Reading:
        """One reading as the driver gives it, complete and current."""
        begun = self._clock.now
        try:
            raw = self.robot.get_observation()
        except Exception as error:  # drivers raise many kinds
            raise LostError(f"The robot cannot be read: {error} Check cables and power.") from error
        took = self._clock.now - begun
        if took > self.settings.current_s:
            raise LateReadingError(
                f"Reading the robot took {took:.1f} s, expected at most {self.settings.current_s:g} s."
            )
        reading = self._contents.take(raw, begun)
        self._check_fresh(reading.joints, reading.pictures, begun + took)
        return reading

    def _believe(self, reading: Reading) -> None:
        joints = reading.joints
        if self._goal is None:
            self._goal = joints
        self._whereabouts.believe(joints, self._goal)
        self._measured, self._trusted, self._read_at = joints, True, reading.at

    def _count(self, what: str) -> None:
        self.interventions[what] = self.interventions.get(what, 0) + 1

    def _check_fresh(self, joints: Array, pictures: Mapping[str, NDArray[np.uint8]], now: float) -> None:
        """Refusal of what does not change at all, and so was not measured: noise alone makes real readings differ."""
        # Sent nowhere for a while, an arm rests where gravity and obstacles let it: equal readings tell nothing.
        goal = self._goal if now - self._asked_at < TELLS_S else None
        moving = goal is not None and (np.abs(goal - joints) > 0.5 * self.limits.max_step).any()
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
            self._check_may_move(may_move)
            if self._measured is None or self._clock.now - self._read_at > self.settings.current_s:
                self.read()
                self._check_may_move(may_move)  # reading takes time
            assert self._measured is not None and self._goal is not None  # noqa: S101, PT018  # read sets both
            now, sure = self._clock.now, self._whereabouts.sure
            # After a break the arm must not catch up in one leap.
            seconds = min(now - self._sent_at, self.settings.watchdog_s)
            places = np.stack([self._measured, self._measured if sure is None else sure])
            verdict = allowed_goal(wanted, places, self._goal, seconds, self.limits)
            for reason in verdict.reasons:
                self._count(reason)
            self._transmit(verdict.goal)
            self._asked_at, self._held = now, False
            return verdict.goal

    def _check_may_move(self, may_move: Callable[[], bool]) -> None:
        if self._stopped.is_set():
            raise StoppedError("The arm was stopped: start again to move it.")
        if self._released or not may_move():
            raise HeldError("The arm may not move now.")

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
        """Hold the arm where it is now, after `release`.

        Raises RobotFault when the robot does not do it, its readings do not agree, or it was put beyond the limits.
        """
        with self._lock:
            if self._released:
                self._found()
                assert self._goal is not None  # noqa: S101  # found sets it
                # Before the motors hold again: they would leap to the goal that they were given last.
                self._transmit(self._goal)
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
        buses = motor_buses(self.robot)
        switches = [getattr(bus, f"{verb}_torque", None) for bus in buses for verb in ("disable", "enable")]
        return bool(switches) and all(map(callable, switches))

    def _torque(self, *, on: bool) -> None:
        if not self.can_release:
            raise RobotFault("This robot cannot be moved by hand: it has no motor bus that lets go.")
        try:
            for bus in motor_buses(self.robot):
                (bus.enable_torque if on else bus.disable_torque)()
        except Exception as error:  # drivers raise many kinds
            raise RobotFault(f"The motors cannot be switched {'on' if on else 'off'}: {error}") from error

    def recover(self) -> None:
        """After a fault: read until readings agree, hold; call it again until it does not raise.

        The second time that the robot cannot be read it is disconnected and connected. Motors that were connected
        throughout still go to the goal that they have, so the arm is held there, a step nearer to where it reads at
        most. An arm that a person moves by hand stays released. Raises RobotFault where it fails, or the arm is beyond
        its limits.
        """
        with self._lock:
            if self._lost or not self.robot.is_connected:
                if self._anew or not reconnect_cameras(self.robot):
                    self._anew = True  # also where it fails half-way: the next time everything is connected again
                    reconnect(self.robot)
                if self._released:
                    self._torque(on=False)  # drivers switch it on as they connect
            try:
                self._found(anew=self._anew)
            except LostError:
                self._lost = True
                raise
            self._lost = self._anew = False
            self._hold()

    def _found(self, *, anew: bool = True) -> None:
        """Settle where the arm is; anew: motors that were off have no goal of before, so theirs is here."""
        joints = self._settle().joints
        assert self._goal is not None  # noqa: S101  # settling sets it
        self._trusted = False
        self._whereabouts.check_inside(joints, self._goal)
        self._goal = joints if anew else self._goal
        self._whereabouts.begin(joints)
        self._whereabouts.sent(self._goal)
        self._trusted = True

    def _hold(self) -> None:
        # Where the arm says it is; where it was sent last when that is newer, or the reading cannot be believed.
        place = self._whereabouts.sure if self._trusted and self._read_at >= self._sent_at else self._goal
        if place is not None and self._goal is not None and not self._released:
            self._held = True
            # An arm that is beyond a limit stays there: led back at once, it would leap.
            low, high = np.minimum(self.limits.low, self._goal), np.maximum(self.limits.high, self._goal)
            # It can only be a step from its goal: what reads farther does not lead it there.
            step = self.limits.max_step
            self._transmit(np.clip(np.clip(place, low, high), self._goal - step, self._goal + step))

    def _transmit(self, goal: Array) -> None:
        try:
            self.robot.send_action({name: float(value) for name, value in zip(self.names, goal, strict=True)})
        except Exception as error:  # drivers raise many kinds
            raise RobotFault(f"The robot takes no goal: {error} Check cables and power.") from error
        self._goal, self._sent_at = goal, self._clock.now
        self._whereabouts.sent(goal)

    def _run(self) -> None:
        while not self._clock.wait(self._closing, self.settings.watchdog_s / 5):
            self.watch()

    def watch(self) -> None:
        """One look of the watchdog: hold the arm when nobody has sent a goal for too long, whatever the reason."""
        # Without the lock: a reading that hangs must not blind the watchdog, only delay its goal.
        if not self._held and self._clock.now - self._asked_at > self.settings.watchdog_s:
            self._count("watchdog")
            with self._lock, contextlib.suppress(RobotFault):
                if not self._held:
                    self._hold()
