"""Servos on one half-duplex wire: what they answer to packets of Feetech's protocol 0, and what may go wrong."""

import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

from .servo import POSITION, Servo

__all__ = ["Body", "Chain", "Fault", "FaultKind", "packet"]

BROADCAST = 0xFE
PING, READ, WRITE, REG_WRITE, ACTION, SYNC_READ, SYNC_WRITE = 1, 2, 3, 4, 5, 0x82, 0x83
OVERHEAT, OVERLOAD = 4, 32  # bits of the status byte


class FaultKind(StrEnum):
    """What may go wrong with an answer."""

    SILENT = "silent"  # none comes
    LATE = "late"  # by `LATE_S`
    CORRUPT = "corrupt"  # a byte is another one
    CHECKSUM = "checksum"  # the checksum does not fit
    DOUBLED = "doubled"  # it comes twice
    OVERFLOW = "overflow"  # the position is a turn away, as the STS3215 is known to say now and then
    OVERLOAD = "overload"
    OVERHEAT = "overheat"


LATE_S = 0.2


@dataclass(kw_only=True)
class Fault:
    """A fault of the answers of one motor, or of all.

    Attributes:
        kind: what goes wrong.
        motor: id; None: every motor.
        left: how many answers are still concerned; None: all.
    """

    kind: FaultKind
    motor: int | None = None
    left: int | None = None


def packet(number: int, code: int, parameters: bytes = b"") -> bytes:
    """A packet to or from motor `number`; code: instruction, or the status of an answer."""
    body = bytes([number, len(parameters) + 2, code]) + parameters
    return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])


class Body(Protocol):
    """What the servos of a chain move, and what resists them."""

    def move(self, servos: Sequence[Servo], seconds: float) -> None:
        """Let time pass for them."""
        ...


class Chain:
    """Servos behind one port; safe to use from several threads.

    body: what they move; None: nothing that resists. speed: their seconds in a real one.

    Attributes:
        servos: in the order of the wire.
        plugged: places of those that are connected.
        faults: of the answers, present ones.
    """

    def __init__(self, servos: Sequence[Servo], body: Body | None = None, speed: float = 1.0) -> None:
        self.servos, self.body, self.speed = list(servos), body, speed
        self.plugged: frozenset[int] = frozenset(range(len(self.servos)))
        self.faults: list[Fault] = []
        self.lock = threading.RLock()
        self._rest = b""
        self._waiting: dict[int, tuple[int, bytes]] = {}  # by place: what REG_WRITE left for ACTION

    def tick(self, seconds: float) -> None:
        """Let real time pass for all of them."""
        with self.lock:
            if self.body is not None:
                self.body.move(self.servos, seconds * self.speed)
                return
            for servo in self.servos:
                servo.tick(seconds * self.speed)

    def take(self, data: bytes, baud: int) -> list[tuple[float, bytes]]:
        """Bytes that came in at a rate; returns the answers, each with the seconds after which it comes."""
        with self.lock:
            self._rest += data
            answers: list[tuple[float, bytes]] = []
            for number, code, parameters in self._packets():
                answers += self._obey(number, code, parameters, baud)
            return answers

    def _packets(self) -> Iterator[tuple[int, int, bytes]]:
        """Whole packets of what came in so far; what is damaged is passed over, as a servo does."""
        while (start := self._rest.find(b"\xff\xff")) >= 0:
            self._rest = self._rest[start:]
            if len(self._rest) < 4 or len(self._rest) < (length := self._rest[3]) + 4:
                return
            body, check = self._rest[2 : length + 3], self._rest[length + 3]
            if length < 2 or ~sum(body) & 0xFF != check:
                self._rest = self._rest[1:]
                continue
            self._rest = self._rest[length + 4 :]
            yield body[0], body[2], body[3:]

    def _obey(self, number: int, code: int, parameters: bytes, baud: int) -> list[tuple[float, bytes]]:
        here = [(i, s) for i, s in enumerate(self.servos) if i in self.plugged and s.baud == baud]
        if code in (SYNC_READ, SYNC_WRITE):
            address, count = parameters[0], parameters[1]
            rest = parameters[2:]
            size = 1 if code == SYNC_READ else count + 1
            items = {rest[i]: rest[i + 1 : i + size] for i in range(0, len(rest) - size + 1, size)}
            by_id = {servo.id: servo for _, servo in here}
            if code == SYNC_WRITE:
                for each, data in items.items():
                    if each in by_id:
                        by_id[each].write(address, data)
                return []
            return [answer for each in items if each in by_id for answer in self._answer(by_id[each], address, count)]
        answers: list[tuple[float, bytes]] = []
        for place, servo in here:
            if number not in (servo.id, BROADCAST):
                continue
            if code == PING:
                answers += self._answer(servo, 0, 0)
            elif code == READ and number != BROADCAST:
                answers += self._answer(servo, parameters[0], parameters[1])
            elif code in (WRITE, REG_WRITE, ACTION):
                answers += self._answer(servo, 0, 0) if servo.answers_writes and number != BROADCAST else []
                self._change(place, servo, code, parameters)  # the answer still comes from the old id
        return answers

    def _change(self, place: int, servo: Servo, code: int, parameters: bytes) -> None:
        if code == WRITE:
            servo.write(parameters[0], parameters[1:])
        elif code == REG_WRITE:
            self._waiting[place] = parameters[0], parameters[1:]
        elif place in self._waiting:
            servo.write(*self._waiting.pop(place))

    def _answer(self, servo: Servo, address: int, count: int) -> list[tuple[float, bytes]]:
        data = servo.read(address, count)
        kinds = {fault.kind for fault in self._struck(servo)}
        status = OVERLOAD * (FaultKind.OVERLOAD in kinds) | OVERHEAT * (FaultKind.OVERHEAT in kinds)
        first, size = POSITION
        if FaultKind.OVERFLOW in kinds and address <= first and first + size <= address + count:
            at = first - address
            wrong = int.from_bytes(data[at : at + size], "little") ^ 0x1000
            data = data[:at] + wrong.to_bytes(size, "little") + data[at + size :]
        if FaultKind.SILENT in kinds:
            return []
        said = bytearray(packet(servo.id, status, data))
        if FaultKind.CORRUPT in kinds:
            said[len(said) // 2] ^= 0x55
        if FaultKind.CHECKSUM in kinds:
            said[-1] ^= 0xFF
        after = LATE_S if FaultKind.LATE in kinds else 0.0
        return [(after, bytes(said))] * (2 if FaultKind.DOUBLED in kinds else 1)

    def _struck(self, servo: Servo) -> list[Fault]:
        """Faults that this answer meets; those that are used up go."""
        struck = [fault for fault in self.faults if fault.motor in (None, servo.id)]
        for fault in struck:
            if fault.left is not None:
                fault.left -= 1
        self.faults = [fault for fault in self.faults if fault.left is None or fault.left > 0]
        return struck
