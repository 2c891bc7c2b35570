"""The guard as the session of a person uses it: pauses, stops, moving by hand, recovering; judged at the motors."""

import threading

import numpy as np
import pytest

from cqn_train.robot.guard import Guard, GuardSettings, HeldError, StoppedError
from cqn_train.robot.readings import RobotFault

from ..driven_clock import DrivenClock
from .test_robot_guard import D, Motors, failing, guarded, limits


def test_no_goal_comes_after_the_hold_of_a_pause() -> None:
    """However the threads meet: whether the arm may move is asked with nobody else between it and the motors."""
    guard, motors, clock = guarded()
    moving, asked, go_on = [True], threading.Event(), threading.Event()

    def may_move() -> bool:
        asked.set()
        clock.wait(go_on, 5)
        return moving[0]

    def pause() -> None:
        moving[0] = False
        guard.hold()

    clock.now = 0.1
    sender = clock.thread(lambda: guard.send(np.ones(D), may_move), "sender")
    sender.start()
    assert clock.wait(asked, 5)
    pauser = clock.thread(lambda: (clock.sleep(0.01), go_on.set(), pause()), "pauser")
    pauser.start()
    sender.join(5)
    pauser.join(5)
    held = len(motors.goals)
    for _ in range(3):
        with pytest.raises(HeldError):
            guard.send(np.full(D, 3.0), may_move)
    assert len(motors.goals) == held
    moving[0] = True
    guard.send(np.full(D, 3.0), may_move)
    assert len(motors.goals) == held + 1


def test_refusing_waits_for_nothing() -> None:
    """A reading that hangs has the lock: the stop comes through all the same, and holds once it can."""
    guard, motors, clock = guarded()
    hangs, go_on = threading.Event(), threading.Event()
    motors.on_read = lambda _: (hangs.set(), clock.wait(go_on, 5))[0]  # type: ignore[func-returns-value]
    reader = clock.thread(guard.read, "reader")
    reader.start()
    assert clock.wait(hangs, 5)
    begun = clock.now
    guard.refuse()
    assert clock.now == begun
    assert guard.stopped
    assert motors.goals == []
    go_on.set()
    reader.join(5)
    with pytest.raises(StoppedError):
        guard.send(np.ones(D))
    guard.stop()
    assert len(motors.goals) == 1
    assert np.array_equal(motors.goals[0], np.zeros(D))


class Bus:
    """Motors that go where they were told last as soon as they are switched on, as many do."""

    def __init__(self, motors: Motors) -> None:
        self.motors, self.on, self.fails = motors, True, False
        self.leaps: list[float] = []

    def disable_torque(self) -> None:
        self.on = False

    def enable_torque(self) -> None:
        if self.fails:
            raise ConnectionError("no answer")
        self.leaps.append(float(np.abs(self.motors.goals[-1] - self.motors.joints).max()))
        self.on = True


def test_an_arm_that_was_moved_by_hand_is_held_where_it_is_now() -> None:
    guard, motors, clock = guarded()
    assert not guard.can_release
    with pytest.raises(RobotFault, match="no motor bus"):
        guard.release()
    bus = motors.bus = Bus(motors)
    assert guard.can_release
    clock.now = 0.1
    guard.send(np.ones(D))
    guard.release()
    assert (guard.released, bus.on) == (True, False)
    sent = len(motors.goals)
    with pytest.raises(HeldError):
        guard.send(np.ones(D))
    guard.hold()
    assert len(motors.goals) == sent  # nothing goes to motors that are off
    motors.joints = np.array([40.0, -30.0, 93.0])  # by hand, one of them a little beyond its limit
    clock.now = 5.0
    guard.engage()
    assert (guard.released, bus.on) == (False, True)
    assert bus.leaps == [0.0]
    clock.now += 0.1
    guard.send(np.zeros(D))
    assert motors.goals[-1] == pytest.approx([35.0, -25.0, 88.0])  # from there, at the speed and step allowed
    guard.engage()
    assert len(bus.leaps) == 1  # only after a release


def test_motors_that_do_not_come_on_again_stay_released() -> None:
    guard, motors, _ = guarded()
    bus = motors.bus = Bus(motors)
    guard.release()
    bus.fails = True
    with pytest.raises(RobotFault, match="cannot be switched on: no answer"):
        guard.engage()
    assert guard.released
    with pytest.raises(HeldError):
        guard.send(np.ones(D))
    bus.fails = False
    guard.engage()
    assert bus.on


def test_recovering_connects_again_and_holds_where_the_arm_is_found() -> None:
    guard, motors, clock = guarded()
    clock.now = 0.1
    guard.send(np.ones(D))
    motors.disconnect()
    motors.joints = np.full(D, -50.0)  # it was moved while it was off
    motors.on_send = failing(ConnectionError("unplugged"))
    with pytest.raises(RobotFault, match="takes no goal"):
        guard.recover()
    motors.on_send = lambda: None
    guard.recover()
    assert motors.is_connected
    assert np.array_equal(motors.goals[-1], np.full(D, -50.0))
    clock.now = 10.0
    guard.send(np.zeros(D))
    assert motors.goals[-1] == pytest.approx(np.full(D, -45.0))
    motors.connect = failing(ConnectionError("port"))  # type: ignore[method-assign]
    motors.disconnect()
    with pytest.raises(RobotFault, match="cannot be connected: port"):
        guard.recover()


def test_an_arm_that_is_found_outside_its_limits_is_held_there() -> None:
    motors, clock = Motors(), DrivenClock()
    motors.connect()
    motors.joints = np.array([130.0, 0.0, -130.0])
    guard = Guard(motors, limits(), GuardSettings(), clock)  # type: ignore[arg-type]
    guard.read()
    guard.hold()
    assert np.array_equal(motors.goals[-1], [130.0, 0.0, -130.0])
    for _ in range(40):
        before = motors.joints.copy()
        clock.now += 0.1
        guard.read()
        guard.send(np.array([200.0, 0.0, 0.0]))
        assert np.abs(motors.goals[-1] - before).max() <= 5.0
        assert motors.goals[-1][0] == 130.0
    assert motors.joints[2] == 0.0


def test_a_robot_that_leaves_a_joint_out_is_a_fault() -> None:
    guard, motors, _ = guarded()
    motors.on_read = lambda observation: observation.pop("b.pos")
    with pytest.raises(RobotFault, match=r"cannot be read.*b\.pos"):
        guard.read()
