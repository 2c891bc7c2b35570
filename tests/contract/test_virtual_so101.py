"""LeRobot's own SO-101 driver and commands on virtual motors: of what lies below LeRobot only the far end is ours."""

import contextlib
import functools
import io
import itertools
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
from cqn_train.virtual_so101.arm import JOINTS, assembled, at_middle, hand_sweep, hand_wave
from cqn_train.virtual_so101.chain import Chain, Fault, FaultKind
from cqn_train.virtual_so101.port import VirtualPort

pytest.importorskip("scservo_sdk", reason="needs the extra feetech of lerobot")
pytestmark = pytest.mark.real_time(reason="serial ports, and motors that move in the machine's own time")

import httpx  # noqa: E402
from lerobot.motors import MotorCalibration, motors_bus  # noqa: E402
from lerobot.robots.so_follower import SO101Follower, SO101FollowerConfig  # noqa: E402

from .conftest import TINY_POLICY  # noqa: E402

TOKEN = "a-token-of-the-test"  # noqa: S105
STEP_DEG, SPAN_DEG = 4.0, 40.0
DEGREES = 360 / 4096  # in a step of the encoder


@pytest.fixture
def port() -> Iterator[VirtualPort]:
    with VirtualPort(assembled(0)) as made:
        yield made


def follower(port: VirtualPort, folder: Path) -> SO101Follower:
    return SO101Follower(SO101FollowerConfig(port=port.name, id="virtual", calibration_dir=folder))


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
            deadline = time.monotonic() + 20
            while True:
                try:
                    guard.recover()
                    break
                except RobotFault:
                    assert time.monotonic() < deadline, "it is not taken up again"
                    time.sleep(0.2)
            drives_well(guard)
            for end in other:
                os.close(end)
        assert max(watched.leaps) <= STEP_DEG + 3 * DEGREES


# -- the commands themselves -------------------------------------------------------------------------------------------


class Spoken:
    """A command with a person at its terminal, who reads all that it prints."""

    def __init__(self, *command: str, **environment: str) -> None:
        self.process = subprocess.Popen(
            [str(Path(sys.executable).parent / command[0]), *command[1:]], stdin=subprocess.PIPE, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            env={**os.environ, "PYTHONUNBUFFERED": "1", **environment},
        )  # fmt: skip
        self.said, self._heard = "", 0
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        while more := os.read(self.process.stdout.fileno(), 65536):
            self.said += more.decode(errors="replace")

    def hears(self, what: str, seconds: float = 90.0) -> None:
        """Wait until it has said something new."""
        deadline = time.monotonic() + seconds
        while (place := self.said.find(what, self._heard)) < 0:
            assert time.monotonic() < deadline, self.said[-2000:]
            assert self._reader.is_alive(), f"it ended without '{what}': {self.said[-2000:]}"
            time.sleep(0.02)
        self._heard = place + len(what)

    def line(self, text: str = "") -> None:
        """Type a line."""
        assert self.process.stdin is not None
        self.process.stdin.write(text + "\n")
        self.process.stdin.flush()

    def ends(self, seconds: float = 90.0) -> None:
        """Wait for its end, which must be a good one."""
        self._reader.join(seconds)
        assert self.process.wait(5) == 0, self.said[-2000:]


@pytest.mark.slow
def test_the_documented_commands_from_setup_to_rollout(tmp_path: Path, free_port: int) -> None:  # noqa: PLR0915  # one long way
    """lerobot-setup-motors, -calibrate, -teleoperate, -record, cqn-data, cqn-train, lerobot-rollout on two arms."""
    home = {"HF_LEROBOT_HOME": str(tmp_path / "home"), "HF_LEROBOT_CALIBRATION": str(tmp_path / "calibration")}
    names = {"follower": str(tmp_path / "ttyF"), "leader": str(tmp_path / "ttyL")}
    kinds = {"follower": ("robot", "so101_follower"), "leader": ("teleop", "so101_leader")}
    arms = Spoken("cqn-virtual-so101", "--new", *(f"--{arm}={name}" for arm, name in names.items()))
    arms.hears(f"leader: {names['leader']}")
    for arm, (what, kind) in kinds.items():
        setup = Spoken("lerobot-setup-motors", f"--{what}.type={kind}", f"--{what}.port={names[arm]}", **home)
        for joint in reversed(JOINTS):
            setup.hears(f"'{joint}' motor only and press enter.")
            arms.line(f"only {arm} {joint}")
            arms.hears("only: done")
            setup.line()
            setup.hears(f"'{joint}' motor id set to {JOINTS.index(joint) + 1}")
        setup.ends()
        arms.line(f"all {arm}")
        arms.hears("all: done")
        calibrate = Spoken(
            "lerobot-calibrate", f"--{what}.type={kind}", f"--{what}.port={names[arm]}", f"--{what}.id={arm}", **home
        )
        calibrate.hears("press ENTER....")
        calibrate.line()
        calibrate.hears("Press ENTER to stop...")
        arms.line(f"sweep {arm}")
        arms.hears("sweep: done")
        calibrate.line()
        calibrate.hears("Calibration saved to")
        calibrate.ends()
    both = [
        *(f"--{what}.{option}" for arm, (what, kind) in kinds.items()
          for option in (f"type={kind}", f"port={names[arm]}", f"id={arm}")),
        "--robot.disable_torque_on_disconnect=false",
    ]  # fmt: skip
    teleoperate = Spoken("lerobot-teleoperate", *both, "--fps=10", "--teleop_time_s=3", **home)
    arms.line("wave leader 12")
    teleoperate.ends()
    arms.hears("wave: done")
    record = Spoken(
        "lerobot-record", *both, "--dataset.repo_id=local/press", f"--dataset.root={tmp_path / 'press'}",
        "--dataset.fps=10", "--dataset.num_episodes=2", "--dataset.episode_time_s=4", "--dataset.reset_time_s=1",
        "--dataset.single_task=Press the red button.", "--dataset.push_to_hub=false", "--play_sounds=false", **home,
    )  # fmt: skip
    arms.line("wave leader 40")
    record.ends(120)
    rows = pd.concat([pd.read_parquet(file) for file in sorted((tmp_path / "press/data").rglob("*.parquet"))])
    assert len(rows) >= 70
    state, action = (np.stack(rows[name].to_numpy()) for name in ("observation.state", "action"))
    assert np.ptp(action[:, 0]) > 30  # degrees: the hand's wave
    assert np.ptp(state[:, 0]) > 30  # which the follower mirrors
    inspect = Spoken("cqn-data", "inspect", "--repo_id=local/press", f"--root={tmp_path / 'press'}", **home)
    inspect.ends()
    clean = Spoken(
        "cqn-data", "run", "arm_state", "--repo_id=local/press", f"--root={tmp_path / 'press'}",
        "--new_repo_id=local/clean", f"--new_root={tmp_path / 'clean'}", **home,
    )  # fmt: skip
    clean.ends()
    train = Spoken(
        "cqn-train", *both, "--dataset.repo_id=local/clean", f"--dataset.root={tmp_path / 'clean'}", *TINY_POLICY,
        "--offline_updates=20", "--updates_per_episode=2", "--batch_size=4", "--demo_batch_size=4", "--steps=60",
        "--arm.episode_s=2", "--eval.final_n_episodes=1", "--eval.freq=0", "--threads=1", "--operator_page",
        f"--page.port={free_port}", f"--output_dir={tmp_path / 'run'}", **home, CQN_PAGE_TOKEN=TOKEN,
    )  # fmt: skip
    person(free_port, train)
    train.ends()
    assert "Limits changed goals" in train.said
    episodes = pd.read_csv(tmp_path / "run/episodes.csv")
    assert episodes["length"].sum() >= 60
    assert set(episodes["success"]) == {0, 1}
    arms.line("state")
    arms.hears("follower: ")
    policy = tmp_path / "run/checkpoints/last/pretrained_model"
    rollout = Spoken(
        "lerobot-rollout", f"--policy.path={policy}", *both[:3], both[-1], "--fps=10", "--duration=4",
        "--return_to_initial_position=false", "--play_sounds=false", **home,
    )  # fmt: skip
    rollout.ends()
    arms.line("quit")
    arms.ends()


def person(port: int, command: "Spoken") -> None:
    """Starts each episode at the page, calls every other one a success, and sets up the scene, until the run ends."""
    asked = {"X-Token": TOKEN, "X-Client": "ann"}
    answers = itertools.cycle(("success", "failure"))
    with httpx.Client(base_url=f"http://127.0.0.1:{port}", headers=asked, timeout=5) as page:
        while command.process.poll() is None:
            time.sleep(0.1)
            with contextlib.suppress(httpx.HTTPError):
                session = page.get("/api/state").json()["session"]
                event = {"waiting": "start", "resetting": "ready"}.get(session["state"])
                event = next(answers) if session["state"] == "labelling" else event
                if event in session["allowed"] and not session["homing"]:
                    page.post("/api/event", json={"event": event})


def test_the_hand_moves_a_leader_only_where_no_motor_holds(port: VirtualPort) -> None:
    hand_wave(port.chain, 0.5, {"shoulder_pan": 400.0})
    moved = port.chain.servos[0].shaft
    assert moved != at_middle(port.chain, "shoulder_pan")
    port.chain.servos[0].write(40, b"\1")
    time.sleep(0.8)
    held = port.chain.servos[0].shaft
    hand_wave(port.chain, 0.5, {"shoulder_pan": -400.0})
    assert abs(port.chain.servos[0].shaft - held) < 1
