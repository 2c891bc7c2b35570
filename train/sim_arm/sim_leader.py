"""A leader arm that a scripted person moves: does the task, holds, goes home, waits for the next scene."""

from typing import Any

import numpy as np
from lerobot.teleoperators.teleoperator import Teleoperator
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from numpy.typing import NDArray

from ..envs.ur5e_station.expert import ScriptedTeleoperator
from ..envs.ur5e_station.station import MAX_JOINT_SPEED
from ..envs.ur5e_station.ur5e import HOME, STATE_NAMES
from .config_sim_leader import SimLeaderConfig
from .sim_ur5e import from_robot_units, to_robot_units
from .world import World, find_world

__all__ = ["SimLeader"]


class SimLeader(Teleoperator):
    """Joint angles of a leader that the arm mirrors, in the robot's units.

    Attributes:
        phase: "task", "hold" (it is done), "home" (on the way back) or "wait" (at home, for the next scene); each
            change is printed, for whoever presses the keys of lerobot-record.
    """

    config_class = SimLeaderConfig
    name = "sim_leader"

    def __init__(self, config: SimLeaderConfig) -> None:
        super().__init__(config)
        self.config = config
        self.phase = "task"
        self._world: World | None = None
        self._connected = False

    @property
    def action_features(self) -> dict[str, type]:
        """Seven joints."""
        return dict.fromkeys(STATE_NAMES, float)

    @property
    def feedback_features(self) -> dict[str, type]:
        """Joints that it can be led to, as motorised leaders can."""
        return dict.fromkeys(STATE_NAMES, float)

    @property
    def is_connected(self) -> bool:
        """Whether it can be read."""
        return self._connected

    @property
    def is_calibrated(self) -> bool:
        """Nothing: there is nothing to calibrate."""
        return True

    def connect(self, calibrate: bool = True) -> None:
        """LeRobot connects leaders first, so the arm is looked for when the leader is first read."""
        del calibrate
        if self._connected:
            raise DeviceAlreadyConnectedError(f"{self} is connected already.")
        self._connected = True

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do."""

    def get_action(self) -> dict[str, Any]:
        """Joints where the person holds the leader now. Raises DeviceNotConnectedError, ConfigError without an arm."""
        if not self._connected:
            raise DeviceNotConnectedError(f"{self} is not connected: call connect() first.")
        world = self._world or self._meet()
        with world.lock:
            world.catch_up()
            while self._moved + 1 / world.fps <= world.now:
                self._moved += 1 / world.fps
                self._move(world)
        return to_robot_units(self._joints, self._closure)

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Lead the leader to these joints, in degrees and 0..100: the person lets it, and does the task from there."""
        if not all(name in feedback for name in STATE_NAMES):
            return
        world = self._world or self._meet()
        with world.lock:
            world.catch_up()
            self._joints, self._closure = from_robot_units(feedback)
            self._moved, self._since = world.now, world.now
            if self.phase != "task":
                self._enter("task", world)

    def disconnect(self) -> None:
        """Let go."""
        if not self._connected:
            raise DeviceNotConnectedError(f"{self} is not connected.")
        self._connected, self._world = False, None

    def _meet(self) -> World:
        world = self._world = find_world(self.config.world)
        self._person = ScriptedTeleoperator(world, self.config.pause_share, seed=self.config.seed)
        self._joints, self._closure = world.arm.joints, world.arm.closure
        self._moved = self._since = world.now
        self._scene = world.scenes
        self._enter("task", world)
        return world

    def _enter(self, phase: str, world: World) -> None:
        self.phase, self._since = phase, world.now
        print(f"sim_leader: {phase}", flush=True)  # noqa: T201  # a person watches the arm; a script reads this

    def _move(self, world: World) -> None:
        """One step of the person, 1 / fps of the simulated clock."""
        held = world.now - self._since
        if self.phase == "task":
            if world.success:
                self._enter("hold", world)
                return
            action = self._person.act()
            self._joints = world.arm.leashed(self._joints + action[:6])
            self._closure = float(action[6])
        elif self.phase == "hold" and held >= self.config.hold_s:
            self._enter("home", world)
        elif self.phase == "home":
            way: NDArray[np.float64] = np.array(HOME) - self._joints
            largest = float(np.abs(way).max())
            limit = MAX_JOINT_SPEED / world.fps
            self._joints = self._joints + way * min(1.0, limit / max(largest, 1e-9))
            self._closure = world.station_task.start_closure
            if world.scenes != self._scene:
                self._scene = world.scenes
                self._enter("wait", world)
        elif self.phase == "wait" and held >= self.config.hold_s:
            self._person.reset(self.config.seed + self._scene)
            self._enter("task", world)
