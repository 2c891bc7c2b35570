"""A scripted operator's movements as a person's hand makes them: late, too far, unsteady, each time another way."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from lerobot_cqn.ranges import Range, check_ranges
from lerobot_cqn.schema import opens_and_closes

if TYPE_CHECKING:  # options are read without NumPy
    import numpy as np
    from numpy.typing import NDArray

__all__ = ["Hand", "HumanOperator", "moving_dims"]

HESITATES_STEPS = (2, 6)
SLOW = 1 / 7  # share of the speed that is left while hesitating
DETOUR_S = 0.8  # time constant in which a person comes back to the straight way


def _habit(default: float, most: float, help: str, unit: str = "") -> Any:
    return field(default=default, metadata={"help": help, "range": Range(least=0, most=most, unit=unit)})


@dataclass(frozen=True)
class Hand:
    """Habits of a person's hand, with ``--human``; with all at 0 it does what the script wants.

    Raises ConfigError when one is out of its range.
    """

    reaction_s: float = _habit(0.1, 1, "What is done is what was right so many seconds ago.", "seconds")
    overshoot: float = _habit(0.3, 0.9, "Share of the last movement that goes on by itself.")
    tremor: float = _habit(0.08, 1, "Deviation of independent noise in each step, as a share of the largest movement.")
    drift: float = _habit(0.08, 1, "Deviation of an error of aim that changes within a second, likewise.")
    speed_spread: float = _habit(0.3, 1, "Deviation of the logarithm of an episode's speed.")
    hesitation: float = _habit(0.1, 0.8, "Share of the steps in which it goes on at a seventh of the speed.")
    detour: float = _habit(0.5, 1, "How far episodes swing out at first, each another way, as a share likewise.")

    def __post_init__(self) -> None:
        check_ranges(self)


def moving_dims(names: list[str], low: "NDArray[Any]", high: "NDArray[Any]") -> "NDArray[np.intp]":
    """Dimensions of an action that are movements: as far one way as the other, and no gripper by their name."""
    import numpy as np

    held = np.array([opens_and_closes(name) for name in names])
    return np.flatnonzero(~held & np.isclose(low, -high))


class HumanOperator:
    """An operator between a scripted one and the environment; everything random follows from the episode's seed.

    Attributes:
        pausing: whether the scripted operator paused in what this one did last; only its tremor is left then.
    """

    def __init__(self, operator: Any, hand: Hand, moving: "NDArray[np.intp]", most: "NDArray[Any]", fps: int) -> None:
        """Stand between.

        Args:
            operator: with `reset(seed)`, `act()` and perhaps `pausing`.
            hand: its habits.
            moving: dimensions [M] of the action that are movements.
            most: largest movement of a step in each of them, [M].
            fps: control steps a second.
        """
        import numpy as np

        self._operator, self._hand, self._moving = operator, hand, moving
        self._most, self._fps = np.asarray(most, np.float64), fps
        self._delay = round(hand.reaction_s * fps)
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Begin a demonstration; called after the environment's reset."""
        import numpy as np

        self._operator.reset(seed)
        self._rng = np.random.default_rng((seed, 1))
        count = len(self._moving)
        self._waiting: list[tuple[NDArray[Any], bool]] = []
        self._momentum, self._aim = np.zeros(count), np.zeros(count)
        self._speed = float(np.exp(self._rng.normal(0.0, self._hand.speed_spread)))
        # One of the ways round: along one dimension, to either side, or straight on.
        self._way = np.zeros(count)
        if count:
            self._way[self._rng.integers(count)] = self._rng.choice([-1.0, 0.0, 1.0]) * self._hand.detour
        self._slow, self._step = 0, 0
        self.pausing = False

    def act(self) -> "NDArray[np.float32]":
        """Action for the environment's present state, (A,) float32."""
        import numpy as np

        wanted = np.asarray(self._operator.act(), np.float64)
        self._waiting.append((wanted, bool(getattr(self._operator, "pausing", False))))
        action, self.pausing = self._waiting.pop(0) if len(self._waiting) > self._delay else (wanted, True)
        action = action.copy()
        movement = np.zeros(len(self._moving)) if self.pausing else self._movement(action[self._moving] / self._most)
        if self.pausing:
            self._momentum[:] = 0.0
        movement = movement + self._rng.normal(0.0, self._hand.tremor, len(movement))
        action[self._moving] = np.clip(movement, -1.0, 1.0) * self._most
        self._step += 1
        return action.astype(np.float32)

    def _movement(self, wanted: "NDArray[np.float64]") -> "NDArray[np.float64]":
        """A movement [M] in shares of the largest, for the one that the script wants."""
        import numpy as np

        hand, keeps = self._hand, 1.0 - 1.0 / self._fps
        self._aim = keeps * self._aim + np.sqrt(1 - keeps**2) * self._rng.normal(0.0, hand.drift, len(wanted))
        mean = sum(HESITATES_STEPS) / 2
        if self._slow == 0 and self._rng.random() < hand.hesitation / (mean * (1 - hand.hesitation)):
            self._slow = int(self._rng.integers(HESITATES_STEPS[0], HESITATES_STEPS[1] + 1))
        speed = self._speed * (SLOW if self._slow else 1.0)
        self._slow = max(0, self._slow - 1)
        back = np.exp(-self._step / (DETOUR_S * self._fps))
        self._momentum = hand.overshoot * self._momentum + (1 - hand.overshoot) * speed * (wanted + self._way * back)
        return self._momentum + self._aim * float(np.abs(self._momentum).max(initial=0.0) > 0)
