"""A Feetech STS3215 servo: its control table as its manual describes it, and a shaft that moves in time.

Positions are steps of 4096 a turn. Addresses, units and encodings are those of the manual (STS series), as LeRobot's
table of the same motor has them.
"""

import math
from dataclasses import dataclass, field

__all__ = ["BAUD_RATES", "Servo", "signed"]

TURN = 4096  # steps
BAUD_RATES = (1_000_000, 500_000, 250_000, 128_000, 115_200, 57_600, 38_400, 19_200)  # by the value of register 6
SIZE = 87  # of the table, in bytes
EEPROM_END = 40
MODEL = 777
FASTEST = 3400.0  # steps/s, without load at 7.4 V
HAND_SPEED = 2500.0  # steps/s, of a person who moves a joint
MULTI_TURN = 0x10  # of the register Phase: angles count over several turns

# Register: first byte, bytes.
ID, BAUD_RATE, STATUS_LEVEL, MIN_POSITION, MAX_POSITION = (5, 1), (6, 1), (8, 1), (9, 2), (11, 2)
PHASE, P_GAIN, OFFSET = (18, 1), (21, 1), (31, 2)
TORQUE, ACCELERATION, GOAL, GOAL_VELOCITY, LOCK = (40, 1), (41, 1), (42, 2), (46, 2), (55, 1)
POSITION, VELOCITY, LOAD, VOLTAGE, TEMPERATURE = (56, 2), (58, 2), (60, 2), (62, 1), (63, 1)
STATUS, MOVING, CURRENT = (65, 1), (66, 1), (69, 2)
READ_ONLY = (*range(5), *range(56, 71))
SIGN_BIT = {OFFSET: 11, GOAL: 15, GOAL_VELOCITY: 15, POSITION: 15, VELOCITY: 15, LOAD: 10}
FACTORY = {
    (0, 1): 3, (1, 1): 10, (3, 2): MODEL, ID: 1, (7, 1): 250, STATUS_LEVEL: 1, MAX_POSITION: 4095, (13, 1): 70,
    (14, 1): 80, (15, 1): 40, (16, 2): 1000, PHASE: 12, (19, 1): 44, (20, 1): 47, P_GAIN: 32, (22, 1): 32, (24, 2): 16,
    (28, 2): 500, (30, 1): 1, (34, 1): 20, (35, 1): 200, (36, 1): 80, (37, 1): 10, (38, 1): 200, (39, 1): 10,
    (48, 2): 1000, LOCK: 1, VOLTAGE: 74, TEMPERATURE: 31, (84, 1): 60, (85, 1): 0,
}  # fmt: skip


def signed(value: int, bit: int) -> int:
    """The number that a register holds as sign and magnitude, the sign in `bit`."""
    magnitude = value & ((1 << bit) - 1)
    return -magnitude if value >> bit & 1 else magnitude


def _coded(number: int, bit: int) -> int:
    """Sign and magnitude of a number, which is cut to what fits."""
    return min(abs(number), (1 << bit) - 1) | (number < 0) << bit


@dataclass(kw_only=True)
class Servo:
    """One motor, as delivered: id 1, 1 MBd, not calibrated.

    Attributes:
        shaft: where the shaft is, in steps of its own encoder; counts on over several turns.
        ends: between which steps the joint lets it turn.
        sag: steps by which gravity pulls it off its goal at the factory's gain (32), where no simulation knows better.
        hand: steps to which a person turns it while its torque is off; None: nobody does.
    """

    shaft: float = 2048.0
    ends: tuple[float, float] = (0.0, 4095.0)
    sag: float = 0.0
    hand: float | None = None
    velocity: float = 0.0
    _reference: float | None = None  # steps of the shaft where it means to be just now; None: torque off
    _pace: float = 0.0  # of the reference, steps/s
    _table: bytearray = field(default_factory=lambda: bytearray(SIZE))
    _kept: bytes = b""

    def __post_init__(self) -> None:
        for register, value in FACTORY.items():
            self._put(register, value)
        self._kept = bytes(self._table)
        self._put(GOAL, self._position())

    @property
    def id(self) -> int:
        """Number by which it is addressed."""
        return self._get(ID)

    @property
    def baud(self) -> int:
        """Rate at which it listens and answers."""
        return BAUD_RATES[self._get(BAUD_RATE) % len(BAUD_RATES)]

    @property
    def answers_writes(self) -> bool:
        """Whether anything but a ping or a reading is answered."""
        return bool(self._get(STATUS_LEVEL))

    @property
    def torque(self) -> bool:
        """Whether it holds and moves."""
        return self._get(TORQUE) == 1

    @property
    def gain(self) -> float:
        """Stiffness, as a share of what LeRobot sets (P of 16)."""
        return self._get(P_GAIN) / 16

    @property
    def goal(self) -> int:
        """Goal that was written last, within the limits; steps after the homing offset."""
        low, high = self._get(MIN_POSITION), self._get(MAX_POSITION)
        goal = self._signed(GOAL)
        return min(max(goal, low), high) if low < high else goal

    def renumber(self, number: int) -> None:
        """Give it an id for good, as `lerobot-setup-motors` does."""
        for (address, _), value in ((LOCK, 0), (ID, number), (LOCK, 1)):
            self.write(address, bytes([value]))

    def read(self, address: int, count: int) -> bytes:
        """Bytes of the table; beyond its end nothing is there."""
        for register, value in (
            (POSITION, self._position()), (VELOCITY, round(self.velocity)), (MOVING, int(abs(self.velocity) > 1)),
            (LOAD, round(1000 * self._strain())), (CURRENT, round(100 * abs(self._strain()))),
        ):  # fmt: skip
            self._put(register, value)
        return bytes(self._table[address : address + count])

    def write(self, address: int, data: bytes) -> None:
        """Change the table, but for what only the motor writes; what locked EEPROM gets is lost with the power."""
        held = self.torque
        for place, value in enumerate(data, address):
            if place < SIZE and place not in READ_ONLY:
                self._table[place] = value
        if address < EEPROM_END and not self._get(LOCK):
            self._kept = bytes(self._table[:EEPROM_END]) + self._kept[EEPROM_END:]
        if self._get(TORQUE) == 128:  # which makes the present place the middle
            self._put(OFFSET, round(self.shaft) % TURN - TURN // 2)
            self._put(TORQUE, int(held))

    def power_cycle(self) -> None:
        """Off and on: what was not saved is what it was, and the torque is off."""
        self._table[:] = self._kept
        self._put(GOAL, self._position())
        self.velocity, self._reference = 0.0, None

    def tick(self, seconds: float) -> None:
        """Let time pass where nothing resists: as it means to move, or as the hand turns it."""
        wanted = self.plan(seconds)
        self.moved(self.turned_by_hand(seconds) if wanted is None else wanted, seconds)

    def plan(self, seconds: float) -> float | None:
        """Steps of the shaft where it means to be after some time, at the allowed speed and acceleration.

        None with its torque off.
        """
        if not self.torque:
            self._reference = None
            return None
        self.hand = None  # whoever held it has let go
        if self._reference is None:
            self._reference, self._pace = self.shaft, self.velocity
        fastest = min(float(abs(self._signed(GOAL_VELOCITY)) or FASTEST), FASTEST)
        push = 100.0 * (self._get(ACCELERATION) or 254)  # steps/s^2
        rest = self._rest() - self._reference
        # As fast as it can still brake from, and no faster than it can become in this time.
        wanted = math.copysign(min(fastest, math.sqrt(2 * push * abs(rest))), rest)
        self._pace += min(max(wanted - self._pace, -push * seconds), push * seconds)
        step = self._pace * seconds
        if abs(step) >= abs(rest) and step * rest >= 0:
            self._reference, self._pace = self._reference + rest, 0.0
        else:
            self._reference += step
        self._reference = min(max(self._reference, self.ends[0]), self.ends[1])
        return self._reference

    def turned_by_hand(self, seconds: float) -> float:
        """Steps of the shaft where a person has turned it after some time."""
        reach = HAND_SPEED * seconds
        return self.shaft + (min(max(self.hand - self.shaft, -reach), reach) if self.hand is not None else 0.0)

    def moved(self, shaft: float, seconds: float) -> None:
        """Say where the shaft has come to meanwhile."""
        before, self.shaft = self.shaft, min(max(shaft, self.ends[0]), self.ends[1])
        self.velocity = (self.shaft - before) / seconds if seconds > 0 else self.velocity

    def _rest(self) -> float:
        """Where it would come to rest, in steps of the shaft."""
        there = self.goal + self._signed(OFFSET)
        if not self._get(PHASE) & MULTI_TURN:  # the turn that is nearest to the shaft's
            there += TURN * round((self.shaft - there) / TURN) if not self.ends[0] <= there <= self.ends[1] else 0
        return there - self.sag * 32 / max(self._get(P_GAIN), 1)

    def _strain(self) -> float:
        """Share of its torque, -1 to 1: what gravity and being kept from its goal take."""
        if not self.torque:
            return 0.0
        return min(max((self._rest() - self.shaft) / 200 + self.sag / 100, -1.0), 1.0)

    def _position(self) -> int:
        there = round(self.shaft) - self._signed(OFFSET)
        return there if self._get(PHASE) & MULTI_TURN else there % TURN

    def _get(self, register: tuple[int, int]) -> int:
        first, count = register
        return int.from_bytes(self._table[first : first + count], "little")

    def _signed(self, register: tuple[int, int]) -> int:
        return signed(self._get(register), SIGN_BIT[register])

    def _put(self, register: tuple[int, int], number: int) -> None:
        first, count = register
        value = _coded(number, SIGN_BIT[register]) if register in SIGN_BIT else number
        self._table[first : first + count] = (value & (256**count - 1)).to_bytes(count, "little")
