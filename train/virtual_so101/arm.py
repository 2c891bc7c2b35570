"""An SO-101's six motors with the joints that they turn, as built or as delivered, and a person's hand on them."""

import math
import time
from collections.abc import Callable, Mapping

import numpy as np

from .chain import Body, Chain
from .joints import JOINTS, SPANS
from .servo import TURN, Servo

__all__ = ["assembled", "at_middle", "hand_sweep", "hand_wave"]

SAGS = {"shoulder_lift": 6.0, "elbow_flex": 5.0, "wrist_flex": 2.0}  # steps at the factory's gain
TICK_S = 0.01
HOLD_S = 0.1  # at each end


def assembled(seed: int, *, numbered: bool = True, body: Body | None = None, speed: float = 1.0) -> Chain:
    """A chain of six motors, each mounted at another angle of its encoder; a person holds each joint in its middle.

    numbered: with the ids 1 to 6; else all as delivered, with 1. body, speed: of `Chain`.
    """
    rng, servos = np.random.default_rng(seed), []
    for number, joint in enumerate(JOINTS, start=1):
        span = SPANS[joint]
        low = float(rng.integers(0, TURN - span)) if span < TURN - 1 else 0.0
        sag = SAGS.get(joint, 0.0) if body is None else 0.0
        servo = Servo(shaft=low + span / 2, ends=(low, low + span), sag=sag, hand=low + span / 2)
        if numbered:
            servo.renumber(number)
        servos.append(servo)
    return Chain(servos, body, speed)


def at_middle(chain: Chain, joint: str) -> float:
    """Steps of the shaft at which a joint is in the middle."""
    low, high = chain.servos[JOINTS.index(joint)].ends
    return (low + high) / 2


def hand_sweep(chain: Chain, sleep: Callable[[float], None] = time.sleep) -> None:
    """A person moves each joint to both of its ends and back to the middle, one after the other."""
    for joint, servo in zip(JOINTS, chain.servos, strict=True):
        for place in (*servo.ends, at_middle(chain, joint)):
            sleep(HOLD_S)  # long enough to be seen there
            servo.hand = place
            while abs(servo.shaft - place) > 1:
                sleep(TICK_S)


def hand_wave(
    chain: Chain, seconds: float, reach: Mapping[str, float], sleep: Callable[[float], None] = time.sleep
) -> None:
    """A person moves joints back and forth for some time; reach: steps from the middle, by joint."""
    begun = time.monotonic()
    while (now := time.monotonic() - begun) < seconds:
        for number, (joint, far) in enumerate(reach.items()):
            chain.servos[JOINTS.index(joint)].hand = at_middle(chain, joint) + far * math.sin(
                (1.3 + 0.4 * number) * now
            )
        sleep(TICK_S)
