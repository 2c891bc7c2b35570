"""LeRobot's own SO-101 driver and commands on virtual motors: of what lies below LeRobot only the far end is ours."""

import contextlib
import functools
import io
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from cqn_train.robot.guard import Guard, GuardSettings, StoppedError
from cqn_train.robot.limits import Limits
from cqn_train.robot.readings import RobotFault
from cqn_train.virtual_so101.arm import assembled, at_middle, hand_sweep, hand_wave
from cqn_train.virtual_so101.chain import Chain, Fault, FaultKind
from cqn_train.virtual_so101.joints import JOINTS
from cqn_train.virtual_so101.port import VirtualPort

pytest.importorskip("scservo_sdk", reason="needs the extra feetech of lerobot")
pytestmark = pytest.mark.real_time(reason="serial ports, and motors that move in the machine's own time")

from lerobot.motors import MotorCalibration, motors_bus  # noqa: E402
from lerobot.motors.feetech import feetech  # noqa: E402
from lerobot.robots.so_follower import SO101Follower, SO101FollowerConfig  # noqa: E402

STEP_DEG, SPAN_DEG = 4.0, 40.0
DEGREES = 360 / 4096  # in a step of the encoder


@pytest.fixture
def port() -> Iterator[VirtualPort]:
    with VirtualPort(assembled(0)) as made:
        yield made


def follower(port: VirtualPort, folder: Path) -> SO101Follower:
    """A follower whose driver waits a second for an answer, so that no busy machine is a fault; see `hurried`."""
    robot = SO101Follower(SO101FollowerConfig(port=port.name, id="virtual", calibration_dir=folder))
    handler = robot.bus.port_handler
    handler.setPacketTimeout = lambda _: handler.setPacketTimeoutMillis(1000)
    return robot


def hurried(robot: SO101Follower) -> None:
    """Let it wait as long as LeRobot's driver does, 50 ms."""
    handler = robot.bus.port_handler
    handler.setPacketTimeout = functools.partial(feetech.patch_setPacketTimeout, handler)


def calibrated(port: VirtualPort, folder: Path) -> SO101Follower:
    """A follower that is connected, with the calibration that a careful person would have made."""
    robot = follower(port, folder)
    for number, (joint, servo) in enumerate(zip(JOINTS, port.chain.servos, strict=True), start=1):
        middle, low, high = round(at_middle(port.chain, joint)), *servo.ends
        offset = middle - 2047
        robot.calibration[joint] = MotorCalibration(
            id=number, drive_mode=0, homing_offset=offset, range_min=round(low) - offset, range_max=round(high) - offset
        )
    robot.calibration["wrist_roll"].range_min, robot.calibration["wrist_roll"].range_max = 0, 4095
    robot.bus.calibration = robot.calibration
    robot.bus.connect()
    robot.bus.write_calibration(robot.calibration)
    robot.bus.disconnect(disable_torque=False)
    robot.connect(calibrate=False)
    assert robot.is_calibrated
    return robot


def test_motors_are_numbered_and_calibrated_and_go_where_they_are_sent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """setup_motors and calibrate of LeRobot, with the person's part played at the motors."""
    chain = assembled(1, numbered=False)
    with VirtualPort(chain) as port:
        robot, todo = follower(port, tmp_path), iter(reversed(JOINTS))

        def one_motor(prompt: str) -> str:
            joint = next(todo)
            assert f"'{joint}' motor only" in prompt
            chain.plugged = frozenset([JOINTS.index(joint)])
            return ""

        monkeypatch.setattr("builtins.input", one_motor)
        with contextlib.redirect_stdout(io.StringIO()):
            robot.setup_motors()
        chain.plugged = frozenset(range(6))
        assert [servo.id for servo in chain.servos] == [1, 2, 3, 4, 5, 6]
        robot.bus.disconnect(disable_torque=False)

        monkeypatch.setattr("builtins.input", lambda _: "")
        swept = threading.Event()
        hand = threading.Thread(target=lambda: (hand_sweep(chain), swept.set()))

        def enter() -> bool:
            if not hand.is_alive() and not swept.is_set():
                hand.start()
            return swept.is_set()

        monkeypatch.setattr(motors_bus, "enter_pressed", enter)
        with contextlib.redirect_stdout(io.StringIO()):
            robot.connect()
        for joint, servo in zip(JOINTS, chain.servos, strict=True):
            found, span = robot.calibration[joint], servo.ends[1] - servo.ends[0]
            assert abs(found.range_max - found.range_min - span) <= 2
        seen = robot.get_observation()
        wanted = {"shoulder_pan.pos": 25.0, "shoulder_lift.pos": -10.0, "wrist_roll.pos": 40.0, "gripper.pos": 80.0}
        robot.send_action({**seen, **wanted})
        time.sleep(1.5)
        after = robot.get_observation()
        assert all(abs(after[name] - value) < 2.0 for name, value in wanted.items()), after
        pan = chain.servos[0]
        assert abs((pan.shaft - at_middle(chain, "shoulder_pan")) * DEGREES - 25) < 2
        robot.disconnect()
        assert not any(servo.torque for servo in chain.servos)


def guarded(robot: SO101Follower) -> Guard:
    here = np.array([float(robot.get_observation()[name]) for name in robot.action_features])
    hurried(robot)
    step = np.full(6, STEP_DEG)
    limits = Limits(low=here - SPAN_DEG, high=here + SPAN_DEG, max_step=step, max_speed=20 * step)
    return Guard(robot, limits, GuardSettings(stale_s=2.0, watchdog_s=0.5))


class Watched:
    """Goals that reach the control table while the motors hold, and the places they had then."""

    def __init__(self, chain: Chain) -> None:
        self.leaps: list[float] = []  # degrees from where the joint was, or from the goal before
        self._goals: dict[int, int] = {}
        for number, servo in enumerate(chain.servos[:5]):
            servo.write = functools.partial(self._write, number, servo, servo.write)  # type: ignore[method-assign]

    def _write(self, number: int, servo: Any, write: Callable[[int, bytes], None], address: int, data: bytes) -> None:
        write(address, data)
        if address == 42:
            place = int.from_bytes(servo.read(56, 2), "little")
            before = self._goals.get(number, place)
            self.leaps.append(min(abs(servo.goal - place), abs(servo.goal - before)) * DEGREES)
            self._goals[number] = servo.goal


def drive(guard: Guard, seconds: float) -> int:
    """Send a wave of goals at 20 Hz, as a policy would, and take the arm up again after each fault; counts faults."""
    begun, faults = time.monotonic(), 0
    while (now := time.monotonic() - begun) < seconds:
        try:
            places = guard.read().joints
            guard.send(places + 3 * STEP_DEG * np.sin(5 * now))
        except StoppedError:
            raise
        except RobotFault:
            faults += 1
            with contextlib.suppress(RobotFault):
                guard.recover()
        time.sleep(0.05)
    return faults


def taken_up_again(guard: Guard) -> None:
    """Recover, again and again, as the attendant does."""
    deadline = time.monotonic() + 20
    while True:
        try:
            guard.recover()
            return
        except RobotFault:
            assert time.monotonic() < deadline, "it is not taken up again"
            time.sleep(0.2)


def drives_well(guard: Guard) -> None:
    """It moves for a while without a fault; a busy machine makes one now and then, since the driver waits 50 ms."""
    deadline = time.monotonic() + 30
    while drive(guard, 0.5):
        assert time.monotonic() < deadline, "it does not come back"


@pytest.mark.parametrize(
    ("kind", "motor"), [*((kind, 2) for kind in FaultKind), (FaultKind.SILENT, None), (FaultKind.OVERFLOW, None)]
)
def test_no_fault_on_the_wire_makes_a_leap(
    port: VirtualPort, tmp_path: Path, kind: FaultKind, motor: int | None
) -> None:
    robot = calibrated(port, tmp_path)
    watched = Watched(port.chain)
    with guarded(robot) as guard:
        drive(guard, 0.4)
        for left in (1, 3):
            port.chain.faults.append(Fault(kind=kind, motor=motor, left=left))
            drive(guard, 0.6)
        port.chain.faults.clear()
        drive(guard, 0.4)
        drives_well(guard)
    assert len(watched.leaps) > 10
    assert max(watched.leaps) <= STEP_DEG + 3 * DEGREES  # what rounding to steps of the encoder makes of a step


def test_a_cable_that_is_pulled_out_is_a_fault_and_put_in_again_the_arm_is_taken_up(tmp_path: Path) -> None:
    link = tmp_path / "ttyFollower"
    with VirtualPort(assembled(0), link) as port:
        robot = calibrated(port, tmp_path)
        robot.bus.port = robot.bus.port_handler.port_name = str(link)
        watched = Watched(port.chain)
        with guarded(robot) as guard:
            drives_well(guard)
            before = port.name
            port.unplug()
            with pytest.raises(RobotFault, match="Check cables"):
                guard.read()
            assert robot.is_connected  # as the driver still believes
            with pytest.raises(RobotFault):
                guard.recover()
            other = os.openpty()  # which takes the old number
            port.plug()
            assert port.name != before
            taken_up_again(guard)
            drives_well(guard)
            for end in other:
                os.close(end)
        assert max(watched.leaps) <= STEP_DEG + 3 * DEGREES


@pytest.mark.slow
def test_the_documented_commands_from_setup_to_rollout(tmp_path: Path, free_port: int) -> None:
    """All of `make demo-so101`, small; stopped on the way by SIGTERM, and started again."""
    out = tmp_path / "demo"
    command = [
        sys.executable, "-m", "cqn_train.demo.so101", f"--output_dir={out}", "--demonstrations=3", "--steps=120",
        "--eval_episodes=2", "--offline_updates=20", f"--port={free_port}",
    ]  # fmt: skip
    first = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    deadline = time.monotonic() + 300
    while not (out / "run/episodes.csv").is_file() or len(pd.read_csv(out / "run/episodes.csv")) < 2:
        assert first.poll() is None, first.communicate()[0]
        assert time.monotonic() < deadline, first.kill()
        time.sleep(0.2)
    first.terminate()
    said, _ = first.communicate(timeout=120)
    assert first.returncode == 130, said
    assert "start it again to continue" in said
    assert not [path for path in out.iterdir() if path.is_symlink()], "names of ports that are no more"

    again = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert again.returncode == 0, again.stdout + again.stderr
    rows = pd.concat([pd.read_parquet(file) for file in sorted((out / "data/raw/data").rglob("*.parquet"))])
    state, action = (np.stack(rows[name].to_numpy()) for name in ("observation.state", "action"))
    assert np.ptp(action[:, 1]) > 30  # degrees: the leader's lift
    assert np.ptp(state[:, 1]) > 30  # which the follower mirrors
    episodes = pd.read_csv(out / "run/episodes.csv")
    assert episodes["length"].sum() >= 120
    summary = json.loads((out / "summary.json").read_text())
    assert summary["offline"]["n"] == summary["final"]["n"] == 2
    assert "20.0 Hz of 20" in summary["control"]
    assert "lerobot-rollout drove it" in again.stdout
    assert (out / "session.png").stat().st_size > 10_000


def test_the_hand_moves_a_leader_only_where_no_motor_holds(port: VirtualPort) -> None:
    hand_wave(port.chain, 0.5, {"shoulder_pan": 400.0})
    moved = port.chain.servos[0].shaft
    assert moved != at_middle(port.chain, "shoulder_pan")
    port.chain.servos[0].write(40, b"\1")
    time.sleep(0.8)
    held = port.chain.servos[0].shaft
    hand_wave(port.chain, 0.5, {"shoulder_pan": -400.0})
    assert abs(port.chain.servos[0].shaft - held) < 1
