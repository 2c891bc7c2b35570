"""A person who leads the leader through the task: at a person's varying speed, with pauses, and with a tremor."""

import threading
import time

import numpy as np
from numpy.typing import NDArray

from ..envs.scripted_pauses import Pauses
from .chain import Chain
from .joints import REST, shaft_of
from .table import Table

__all__ = ["Demonstrator"]

Array = NDArray[np.float64]

STEP_S = 0.1  # of the pauses, whose lengths are in steps of it
LOOK_S = 0.005  # real, between two movements of the hand
SPEEDS = (0.75, 1.3)  # of a person, times the usual one
AIM_M = 0.002  # standard deviation of where a person aims at
TREMOR_STEPS, TREMOR_SHARE = 0.7, 0.1  # of the motor, and how much of it is new every 0.1 s
HOLD_S = 0.4  # after the task is done


class Demonstrator:
    """A hand on a leader whose motors are off."""

    def __init__(self, table: Table, leader: Chain, pause_share: float = 0.3, seed: int = 0) -> None:
        """Take the leader.

        pause_share: expected share of the time in which the hand is still, [0, 0.9].

        Raises:
            ConfigError: a share out of range.
        """
        self._table, self._leader = table, leader
        self._rng = np.random.default_rng(seed)
        self._pauses = Pauses(pause_share, 3, 45)
        self._stop = threading.Event()

    def show(self) -> bool:
        """Do the task from where the leader is; whether it is done at the end."""
        self._pauses.reset(self._rng)
        for number, (move, joints) in enumerate(self._table.moves()):
            if self._table.success and not move.hesitates and number:
                break
            self._lead(joints, move.seconds / self._rng.uniform(*SPEEDS), number if move.hesitates else None)
        self._rest(HOLD_S)
        return self._table.success

    def home(self) -> None:
        """Lead it home."""
        self._lead(REST, 1.5, None)

    def stop(self) -> None:
        """Let a movement that is under way end at once, and all later ones."""
        self._stop.set()

    def _lead(self, goal: Array, seconds: float, moment: int | None) -> None:
        """Along the path of least jerk, with pauses in between; moment: a natural one to pause."""
        servos = self._leader.servos
        start = np.array([servo.shaft for servo in servos])
        end = np.array(
            [shaft_of(number, servo, angle) for number, (servo, angle) in enumerate(zip(servos, goal, strict=True))]
        )
        tremor, passed, told = np.zeros(len(servos)), 0.0, self._table.now
        still = moment is not None and self._pauses.next((moment,))
        next_step = told + STEP_S
        while passed < seconds and not self._stop.is_set():
            time.sleep(LOOK_S)
            now = self._table.now
            passed, told = passed + (0.0 if still else now - told), now
            if now >= next_step:
                next_step += STEP_S
                still = moment is not None and self._pauses.next()
                fresh = self._rng.normal(0.0, TREMOR_STEPS, len(servos))
                tremor = tremor * (1 - TREMOR_SHARE) + fresh * TREMOR_SHARE**0.5
            share = min(passed / seconds, 1.0)
            place = start + (end - start) * (10 * share**3 - 15 * share**4 + 6 * share**5)
            for servo, steps in zip(servos, place + tremor, strict=True):
                servo.hand = float(steps)

    def _rest(self, seconds: float) -> None:
        until = self._table.now + seconds
        while self._table.now < until and not self._stop.is_set():
            time.sleep(LOOK_S)
