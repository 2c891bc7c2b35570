"""An arm and its leader: taking over never leaps, home is reached slowly, frames are what the policy was trained on."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cqn_train.robot.arm import Arm
from cqn_train.robot.guard import Guard, GuardSettings, HeldError
from cqn_train.robot.limits import Limits
from cqn_train.robot.readings import RobotFault
from cqn_train.robot.settings import ArmSettings
from lerobot_cqn.errors import ConfigError

from ..driven_clock import DrivenClock
from .test_robot_guard import Motors, limits

NAMES = ("a.pos", "b.pos", "gripper.pos")
D, FPS = 3, 10
poses = arrays(np.float64, D, elements=st.floats(-80, 80))


class Gripped(Motors):
    """Two joints and a gripper, as the guard's motors; gives a value of the scene as well."""

    action_features = dict.fromkeys(NAMES, float)
    observation_features = dict.fromkeys((*NAMES, "object.x.pos"), float) | {"eye": (4, 6, 3)}

    def get_observation(self) -> dict[str, Any]:
        self.noise += 1
        joints = dict(zip(NAMES, self.joints, strict=True))
        picture = np.zeros((4, 6, 3), np.uint8)
        picture[1, 2] = 255, 51, self.noise % 256
        observation = {"object.x.pos": 0.5, **joints, "eye": picture}
        self.on_read(observation)
        return observation

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        self.on_send()
        self.goals.append(np.array([action[name] for name in NAMES]))
        self.joints = self.goals[-1].copy()
        return action


class Leader:
    """A leader in a person's hand; remembers where it was led to."""

    def __init__(self, names: tuple[str, ...] = NAMES, *, motors: bool = True) -> None:
        self.action_features = dict.fromkeys(names, float)
        self.feedback_features = dict.fromkeys(names, float) if motors else {}
        self.joints = np.zeros(len(names))
        self.led: list[dict[str, float]] = []
        self.is_connected = False
        self.on_read: Callable[[], None] = lambda: None

    def connect(self) -> None:
        self.is_connected = True

    def disconnect(self) -> None:
        self.is_connected = False

    def get_action(self) -> dict[str, float]:
        self.on_read()
        return dict(zip(self.action_features, self.joints.tolist(), strict=True))

    def send_feedback(self, feedback: dict[str, float]) -> None:
        self.led.append(feedback)


def made(leader: Leader | None = None, home: Any = None, **settings: Any) -> tuple[Arm, Gripped, DrivenClock]:
    motors, clock = Gripped(), DrivenClock(0.0)
    guard = Guard(motors, limits(), GuardSettings(), clock)  # type: ignore[arg-type]
    arm = Arm(guard, ArmSettings(**settings), FPS, leader=leader, clutched=[0, 1], home=home)  # type: ignore[arg-type]
    motors.connect()
    return arm, motors, clock


def test_a_leader_without_the_arms_joints_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"gives no 'b\.pos'.*use a leader with the same joints"):
        made(Leader(("a.pos", "gripper.pos")))


@given(poses, poses, poses)
def test_taking_over_never_leaps_and_then_follows(place: Any, held: Any, moved: Any) -> None:
    leader = Leader()
    arm, motors, _ = made(leader)
    motors.joints = place.copy()
    arm.guard.read()
    leader.joints = held.copy()
    first = arm.follow()
    np.testing.assert_allclose(first[:2], place[:2], atol=1e-9)  # where the arm is, wherever the leader is
    assert first[2] == held[2]  # a gripper is open or closed as the hand says
    leader.joints = held + moved
    np.testing.assert_allclose(arm.follow()[:2], (place + moved)[:2], atol=1e-9)
    motors.joints = place + 1.0
    arm.guard.read()
    arm.let_go()
    leader.joints = -held
    np.testing.assert_allclose(arm.follow()[:2], place[:2] + 1.0, atol=1e-9)  # taken anew


def test_a_leader_with_motors_is_led_along_and_one_without_is_left_alone() -> None:
    led, still = Leader(), Leader(motors=False)
    for leader in (led, still):
        arm, motors, _ = made(leader)
        motors.joints = np.array([1.0, 2.0, 3.0])
        arm.guard.read()
        arm.let_go()
    assert led.led == [{"a.pos": 1.0, "b.pos": 2.0, "gripper.pos": 3.0}]
    assert still.led == []


@pytest.mark.parametrize(("broken", "said"), [
    (lambda leader: setattr(leader, "on_read", lambda: 1 / 0), "leader cannot be read: division by zero"),
    (lambda leader: setattr(leader, "action_features", dict.fromkeys(("a.pos", "c.pos", "gripper.pos"))),
     r"leader cannot be read: 'b\.pos'"),
    (lambda leader: leader.joints.fill(np.nan), r"leader's joint 'a\.pos' reads nan"),
])  # fmt: skip
def test_a_leader_that_fails_is_a_fault_and_spoils_nothing(broken: Callable[[Leader], None], said: str) -> None:
    leader = Leader()
    arm, motors, _ = made(leader)
    arm.guard.read()
    broken(leader)
    with pytest.raises(RobotFault, match=said):
        arm.follow()
    leader.on_read, leader.action_features = lambda: None, dict.fromkeys(NAMES, float)
    leader.joints = np.full(D, 7.0)
    assert np.array_equal(arm.follow(), [0.0, 0.0, 7.0])
    assert motors.goals == []
    arm.leader = None
    with pytest.raises(RobotFault, match="There is no leader arm"):
        arm.follow()


def test_one_wrong_reading_of_the_leader_does_not_lead_the_arm_astray() -> None:
    leader = Leader()
    arm, motors, _ = made(leader)
    motors.joints = np.array([10.0, -20.0, 0.0])
    arm.guard.read()
    for wrong in range(2):
        reads = iter(range(100))
        leader.on_read = lambda wrong=wrong, reads=reads: leader.joints.fill(360.0 * (next(reads) == wrong))  # type: ignore[misc]
        assert arm.follow()[:2] == pytest.approx([10.0, -20.0])
        assert arm.follow()[:2] == pytest.approx([10.0, -20.0])
        arm.let_go()
    reads = iter(range(100))
    leader.on_read = lambda: leader.joints.fill(50.0 * next(reads))
    with pytest.raises(RobotFault, match="leader's readings do not agree"):
        arm.follow()


@given(poses, st.floats(0.05, 1.0))
def test_home_is_reached_and_never_faster_than_home_speed(start: Any, share: float) -> None:
    home = np.array([10.0, -20.0, 30.0])
    arm, motors, clock = made(home=home, home_speed=share)
    motors.joints = start.copy()
    for _ in range(2000):
        clock.now += 1 / FPS
        arm.guard.read()
        before = motors.joints.copy()
        if arm.step_home(lambda: True):
            break
        assert np.abs(motors.joints - before).max() <= share * 50.0 / FPS + 1e-6
    assert np.abs(motors.joints - home).max() <= 0.5
    assert np.array_equal(motors.goals[-1], home)


def test_on_the_way_home_it_may_be_stopped_and_without_a_home_it_stays() -> None:
    arm, motors, _ = made(home=np.full(D, 40.0))
    arm.guard.read()
    with pytest.raises(HeldError):
        arm.step_home(lambda: False)
    assert motors.goals == []
    arm, motors, _ = made()
    arm.guard.read()
    assert arm.step_home(lambda: True)
    assert motors.goals == []


def test_a_frame_is_what_the_dataset_calls_it() -> None:
    arm, motors, _ = made()
    motors.joints = np.array([1.5, -2.0, 99.0])
    frame = arm.frame(arm.guard.read())
    assert frame.keys() == {"observation.state", "observation.images.eye"}
    assert frame["observation.state"].tolist() == [[1.5, -2.0, 99.0, 0.5]]
    assert frame["observation.state"].dtype == torch.float32
    picture = frame["observation.images.eye"]
    assert picture.shape == (1, 3, 4, 6)
    assert picture.dtype == torch.uint8  # as the camera gave it
    assert (picture[0, :2, 1, 2] / 255).tolist() == pytest.approx([1.0, 0.2])


def test_both_are_disconnected_whatever_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    leader = Leader()
    arm, motors, _ = made(leader)
    arm.connect()
    assert leader.is_connected
    monkeypatch.setattr(motors, "disconnect", lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        arm.close()
    assert not leader.is_connected
    monkeypatch.undo()
    arm.close()
    assert not motors.is_connected


def test_what_does_not_answer_is_said_and_nothing_is_left_connected() -> None:
    leader = Leader()
    arm, motors, _ = made(leader)
    motors.on_read = lambda _: fails("no power")
    with pytest.raises(RobotFault, match="robot cannot be read: no power"):
        arm.connect()
    assert not leader.is_connected
    assert not motors.is_connected
    leader.connect = lambda: fails("port is taken")  # type: ignore[method-assign]
    with pytest.raises(RobotFault, match=r"leader cannot be connected: port is taken.*--teleop\.port"):
        arm.connect()


def fails(text: str) -> None:
    raise ConnectionError(text)


def test_limits_are_the_guards() -> None:
    arm, *_ = made()
    assert isinstance(arm.limits, Limits)
    assert arm.names == NAMES
