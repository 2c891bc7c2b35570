"""A task of the station; each is one file and one entry in `tasks.py`."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from .ur5e import Arm

__all__ = ["Goal", "Task"]


@dataclass(frozen=True)
class Goal:
    """Place that a skilled operator would steer to from the present state.

    Attributes:
        tip: fingertip position to move towards, (3,) m in the world.
        closure: gripper command, 0 (open) to 1 (closed).
        speed: cap on the fingertip's speed, m/s.
        yaw: direction of the finger-to-finger axis about the vertical, rad; 0 is along the world's y.
        pitch: turn of the tool about the finger-to-finger axis, rad; 0 points down, pi / 2 back along -x.
        hesitate: number of the natural moment to pause that is reached (an operator checks before committing),
            1 to the task's `natural_pauses`; 0 is none.
    """

    tip: NDArray[np.float64]
    closure: float
    speed: float
    yaw: float = 0.0
    pitch: float = 0.0
    hesitate: int = 0


class Task:
    """Base of the station's tasks: objects, their randomisation, success, and how it is done.

    Subclasses must import without a simulator. Only `arm` (passed to each method) touches MuJoCo.
    """

    name: ClassVar[str]
    description: ClassVar[str]
    max_episode_steps: ClassVar[int]  # control steps at 10 Hz
    typical_steps: ClassVar[int]  # steps the scripted teleoperator needs without pauses
    state_names: ClassVar[tuple[str, ...]]  # of `state`, one name a value
    start_closure: ClassVar[float] = 0.0
    natural_pauses: ClassVar[int] = 1  # moments that `Goal.hesitate` numbers

    def mjcf(self) -> str:
        """Objects of the task, as top-level MJCF sections."""
        raise NotImplementedError

    def reset(self, arm: Arm, rng: np.random.Generator) -> None:
        """Place the objects at random; the arm is already placed."""
        raise NotImplementedError

    def state(self, arm: Arm) -> NDArray[np.float64]:
        """Simulator state of the objects, (len(state_names),)."""
        raise NotImplementedError

    def success(self, arm: Arm) -> bool:
        """Whether the task is done now."""
        raise NotImplementedError

    def goal(self, arm: Arm) -> Goal:
        """Place to steer to now; a function of the present state only, so that cloning it is well posed."""
        raise NotImplementedError
