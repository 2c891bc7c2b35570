"""The virtual STS3215: its table, its wire and its shaft, against what the manual says of the real one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lerobot.motors.encoding_utils import decode_sign_magnitude, encode_sign_magnitude
from lerobot.motors.feetech.tables import (
    MODEL_NUMBER_TABLE,
    STS_SMS_SERIES_BAUDRATE_TABLE,
    STS_SMS_SERIES_CONTROL_TABLE,
)

from cqn_train.virtual_so101 import servo as registers
from cqn_train.virtual_so101.chain import BROADCAST, Chain, Fault, FaultKind, packet
from cqn_train.virtual_so101.servo import BAUD_RATES, Servo, signed

FAST = 1_000_000
PING, READ, WRITE, REG_WRITE, ACTION, SYNC_READ, SYNC_WRITE = 1, 2, 3, 4, 5, 0x82, 0x83
NAMES = {
    "ID": "ID", "BAUD_RATE": "Baud_Rate", "MIN_POSITION": "Min_Position_Limit", "MAX_POSITION": "Max_Position_Limit",
    "PHASE": "Phase", "P_GAIN": "P_Coefficient", "OFFSET": "Homing_Offset", "TORQUE": "Torque_Enable",
    "ACCELERATION": "Acceleration", "GOAL": "Goal_Position", "GOAL_VELOCITY": "Goal_Velocity", "LOCK": "Lock",
    "POSITION": "Present_Position", "VELOCITY": "Present_Velocity", "LOAD": "Present_Load",
    "VOLTAGE": "Present_Voltage", "TEMPERATURE": "Present_Temperature",
    "STATUS": "Status", "MOVING": "Moving", "CURRENT": "Present_Current",
}  # fmt: skip


def word(number: int) -> bytes:
    return number.to_bytes(2, "little")


def numbered(number: int, **options: float) -> Servo:
    servo = Servo(**options)  # type: ignore[arg-type]
    servo.renumber(number)
    return servo


def position(servo: Servo) -> int:
    return signed(int.from_bytes(servo.read(*registers.POSITION), "little"), 15)


def test_registers_lie_where_lerobot_looks_for_them() -> None:
    for ours, theirs in NAMES.items():
        assert getattr(registers, ours) == STS_SMS_SERIES_CONTROL_TABLE[theirs]
    assert {rate: i for i, rate in enumerate(BAUD_RATES)} == STS_SMS_SERIES_BAUDRATE_TABLE
    assert int.from_bytes(Servo().read(3, 2), "little") == MODEL_NUMBER_TABLE["sts3215"]


@given(st.integers(-2047, 2047), st.integers(0, 4095))
def test_an_offset_moves_what_is_read_and_nothing_else(offset: int, shaft: int) -> None:
    servo = Servo(shaft=float(shaft))
    servo.write(31, word(encode_sign_magnitude(offset, 11)))
    raw = int.from_bytes(servo.read(56, 2), "little")
    assert decode_sign_magnitude(raw, 15) == (shaft - offset) % 4096
    servo.write(18, bytes([12 | registers.MULTI_TURN]))
    raw = int.from_bytes(servo.read(56, 2), "little")
    assert decode_sign_magnitude(raw, 15) == shaft - offset
    assert servo.shaft == shaft


@given(st.integers(0, 4095), st.integers(0, 254), st.integers(0, 3000), st.floats(0.001, 0.03))
def test_it_arrives_without_being_faster_than_allowed(goal: int, push: int, speed: int, tick: float) -> None:
    servo = Servo(shaft=2048.0)
    for address, data in ((41, bytes([push])), (46, word(speed)), (42, word(goal)), (40, b"\1")):
        servo.write(address, data)
    fastest, before = float(speed or registers.FASTEST), servo.shaft
    for _ in range(int(60 / tick)):
        servo.tick(tick)
        assert abs(servo.shaft - before) <= fastest * tick + 1e-6
        before = servo.shaft
        if abs(servo.shaft - goal) < 0.5 and abs(servo.velocity) < 1:
            break
    assert abs(servo.shaft - goal) < 1 or speed * 60 < abs(goal - 2048) or 0 < push < 3


def test_gravity_pulls_it_off_its_goal_the_more_the_smaller_the_gain() -> None:
    found = []
    for gain in (32, 16):
        servo = Servo(sag=6.0)
        for address, data in ((21, bytes([gain])), (42, word(2200)), (40, b"\1")):
            servo.write(address, data)
        for _ in range(500):
            servo.tick(0.01)
        found.append(servo.shaft)
        assert signed(int.from_bytes(servo.read(60, 2), "little"), 10) > 0
    np.testing.assert_allclose(found, [2194, 2188], atol=1)


def test_without_torque_it_goes_where_a_hand_turns_it_and_not_beyond_its_ends() -> None:
    servo = Servo(ends=(1000.0, 3000.0))
    servo.write(42, word(1500))
    servo.hand = 3500.0
    for _ in range(200):
        servo.tick(0.01)
    assert position(servo) == 3000
    servo.write(40, b"\1")
    for _ in range(200):
        servo.tick(0.01)
    assert position(servo) == 1500  # the goal of before is still there: it leaps, as the real one does


def test_what_locked_memory_gets_is_lost_with_the_power() -> None:
    servo = Servo()
    servo.write(31, word(100))
    assert position(servo) == 1948
    servo.write(40, b"\1")
    servo.power_cycle()
    assert position(servo) == 2048
    assert not servo.torque
    servo.write(55, b"\0")
    servo.write(31, word(100))
    servo.power_cycle()
    assert position(servo) == 1948


@given(st.binary(max_size=200), st.integers(0, 3))
def test_noise_on_the_wire_is_passed_over(noise: bytes, cut: int) -> None:
    chain = Chain([numbered(3)])
    table = bytes(chain.servos[0].read(0, registers.SIZE))
    asked = packet(3, READ, bytes([56, 2]))
    answers = chain.take(noise, FAST)
    if bytes(chain.servos[0].read(0, registers.SIZE)) == table:  # no write by chance
        # Whatever a begun packet swallows, silence ends it in the end.
        answers = [
            a
            for _ in range(90)
            for a in [*chain.take(asked[: len(asked) - cut], FAST), *chain.take(asked[len(asked) - cut :], FAST)]
        ]
        assert (0.0, packet(3, 0, word(2048))) in answers


def test_instructions_are_obeyed_as_the_manual_says() -> None:
    chain = Chain([numbered(1), numbered(2)])
    assert chain.take(packet(BROADCAST, PING), FAST) == [(0.0, packet(1, 0)), (0.0, packet(2, 0))]
    assert chain.take(packet(2, PING), 500_000) == []
    assert chain.take(packet(7, PING), FAST) == []
    both = packet(BROADCAST, SYNC_WRITE, bytes([42, 2, 1]) + word(2100) + bytes([2]) + word(2200))
    assert chain.take(both, FAST) == []
    read = packet(BROADCAST, SYNC_READ, bytes([42, 2, 2, 1]))
    assert chain.take(read, FAST) == [(0.0, packet(2, 0, word(2200))), (0.0, packet(1, 0, word(2100)))]
    assert chain.take(packet(1, REG_WRITE, bytes([42]) + word(2300)), FAST) == [(0.0, packet(1, 0))]
    assert chain.servos[0].goal == 2100
    chain.take(packet(BROADCAST, ACTION), FAST)
    assert chain.servos[0].goal == 2300
    # A new number and a new rate: the answer still comes as before.
    assert chain.take(packet(1, WRITE, bytes([5, 9])), FAST) == [(0.0, packet(1, 0))]
    assert chain.take(packet(9, WRITE, bytes([6, 1])), FAST) == [(0.0, packet(9, 0))]
    assert chain.take(packet(9, PING), FAST) == []
    assert chain.take(packet(9, PING), 500_000) == [(0.0, packet(9, 0))]
    chain.plugged = frozenset([1])
    assert chain.take(packet(9, PING), 500_000) == []


@pytest.mark.parametrize("kind", FaultKind)
def test_a_fault_strikes_as_often_as_it_is_said_and_only_the_motor_that_is_named(kind: FaultKind) -> None:
    chain, asked = Chain([numbered(1), numbered(2)]), bytes([56, 2])
    right = (0.0, packet(1, 0, word(2048)))
    chain.faults.append(Fault(kind=kind, motor=1, left=2))
    assert chain.take(packet(2, READ, asked), FAST) == [(0.0, packet(2, 0, word(2048)))]
    assert all(chain.take(packet(1, READ, asked), FAST) != [right] for _ in range(2))
    assert chain.take(packet(1, READ, asked), FAST) == [right]
