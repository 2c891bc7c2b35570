"""Two SO-101 as one robot, LeRobot's `bi_so_follower`, each arm behind a port of its own."""

import contextlib
import itertools
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import numpy as np
import pytest

pytest.importorskip("scservo_sdk", reason="needs the extra feetech of lerobot")

from lerobot.robots.bi_so_follower import BiSOFollower, BiSOFollowerConfig
from lerobot.robots.so_follower import SOFollowerConfig

from cqn_train.arm.build import _lets_go, check_commands
from cqn_train.robot.connection import motor_buses
from cqn_train.robot.guard import Guard, GuardSettings
from cqn_train.robot.limits import Limits
from cqn_train.virtual_so101.arm import assembled, hand_wave
from cqn_train.virtual_so101.port import VirtualPort

from .conftest import TINY_POLICY
from .test_virtual_so101 import (
    DEGREES,
    SPAN_DEG,
    STEP_DEG,
    Watched,
    calibrated,
    drive,
    drives_well,
    hurried,
    taken_up_again,
)

pytestmark = pytest.mark.real_time(reason="serial ports, and motors that move in the machine's own time")

SIDES = ("left", "right")


@contextlib.contextmanager
def pair(folder: Path, name: str, seed: int) -> Iterator[dict[str, VirtualPort]]:
    """Two arms with their calibrations as LeRobot keeps them for a pair called `name`."""
    with contextlib.ExitStack() as stack:
        ports = {}
        for number, side in enumerate(SIDES):
            ports[side] = stack.enter_context(VirtualPort(assembled(seed + number), folder / f"tty-{name}-{side}"))
            robot = calibrated(ports[side], folder)
            robot.disconnect()
            robot.calibration_fpath = folder / f"{name}_{side}.json"
            robot._save_calibration()
        yield ports


def config(ports: dict[str, VirtualPort], folder: Path) -> BiSOFollowerConfig:
    arms = {f"{side}_arm_config": SOFollowerConfig(port=str(ports[side].link)) for side in SIDES}
    return BiSOFollowerConfig(id="pair", calibration_dir=folder, **arms)


@pytest.fixture
def guarded(tmp_path: Path) -> Iterator[tuple[Guard, dict[str, VirtualPort], list[Watched]]]:
    with pair(tmp_path, "pair", 0) as ports:
        robot = BiSOFollower(config(ports, tmp_path))
        robot.connect(calibrate=False)
        here = np.array([float(robot.get_observation()[name]) for name in robot.action_features])
        for arm in (robot.left_arm, robot.right_arm):
            hurried(arm)
        step = np.full(12, STEP_DEG)
        limits = Limits(low=here - SPAN_DEG, high=here + SPAN_DEG, max_step=step, max_speed=20 * step)
        watched = [Watched(port.chain) for port in ports.values()]
        with Guard(robot, limits, GuardSettings(stale_s=2.0, watchdog_s=0.5)) as guard:
            yield guard, ports, watched


def test_one_arms_cable_is_a_fault_of_both_and_both_are_taken_up_again(guarded: Any) -> None:
    guard, ports, watched = guarded
    check_commands(guard.robot)
    drives_well(guard)
    ports["left"].unplug()
    assert drive(guard, 0.3) > 0
    held = [servo.goal for servo in ports["right"].chain.servos]
    time.sleep(0.3)
    assert [servo.goal for servo in ports["right"].chain.servos] == held  # whose wire is whole: nothing more comes
    assert all(servo.torque for servo in ports["right"].chain.servos)
    ports["left"].plug()
    taken_up_again(guard)
    drives_well(guard)
    assert max(leap for each in watched for leap in each.leaps) <= STEP_DEG + 3 * DEGREES


def test_both_arms_are_let_go_and_held(guarded: Any) -> None:
    guard, ports, _ = guarded
    servos = [servo for port in ports.values() for servo in port.chain.servos]
    assert len(motor_buses(guard.robot)) == 2
    assert guard.can_release
    guard.release()
    assert not any(servo.torque for servo in servos)
    guard.engage()
    assert all(servo.torque for servo in servos)


def test_it_says_which_arms_would_fall(tmp_path: Path) -> None:
    ports: Any = {side: SimpleNamespace(link="/dev/none") for side in SIDES}
    both = config(ports, tmp_path)
    options = [f"{side}_arm_config.disable_torque_on_disconnect" for side in SIDES]
    assert _lets_go(both) == options
    both.left_arm_config = replace(both.left_arm_config, disable_torque_on_disconnect=False)
    assert _lets_go(both) == options[1:]


@pytest.mark.slow
def test_recorded_cleaned_trained_and_driven(tmp_path: Path, free_port: int) -> None:
    token = "a-token-of-the-test"  # noqa: S105
    surroundings = {**os.environ, "HF_LEROBOT_HOME": str(tmp_path / "home"), "CQN_PAGE_TOKEN": token}
    with pair(tmp_path, "pair", 0) as follower, pair(tmp_path, "lead", 4) as leader:
        robot, teleop = (
            [f"--{what}.type={kind}", f"--{what}.id={name}", f"--{what}.calibration_dir={tmp_path}",
             *(f"--{what}.{side}_arm_config.port={ports[side].link}" for side in SIDES)]
            for what, kind, name, ports in (
                ("robot", "bi_so_follower", "pair", follower), ("teleop", "bi_so_leader", "lead", leader),
            )
        )  # fmt: skip
        robot += [f"--robot.{side}_arm_config.disable_torque_on_disconnect=false" for side in SIDES]
        done = threading.Event()

        def wave() -> None:
            while not done.is_set():
                for port in leader.values():
                    hand_wave(port.chain, 0.5, {"shoulder_pan": 300.0, "gripper": 200.0})

        def run(name: str, *arguments: str) -> str:
            own = str(Path(sys.executable).parent / name)
            ended = subprocess.run(
                [own, *arguments], capture_output=True, text=True, env=surroundings, timeout=200, check=False
            )
            assert ended.returncode == 0, ended.stdout[-1000:] + ended.stderr[-2000:]
            return ended.stdout + ended.stderr

        threading.Thread(target=wave, daemon=True).start()
        run(
            "lerobot-record", *robot, *teleop, "--dataset.repo_id=local/raw", f"--dataset.root={tmp_path / 'raw'}",
            "--dataset.fps=10", "--dataset.num_episodes=2", "--dataset.episode_time_s=4", "--dataset.reset_time_s=0",
            "--dataset.single_task=Wave", "--dataset.push_to_hub=false", "--play_sounds=false",
        )  # fmt: skip
        run(
            "cqn-data", "run", "arm_state", "--repo_id=local/raw", f"--root={tmp_path / 'raw'}",
            "--new_repo_id=local/clean", f"--new_root={tmp_path / 'clean'}",
        )  # fmt: skip
        over = threading.Event()
        threading.Thread(target=person, args=(free_port, token, over), daemon=True).start()
        said = run(
            "cqn-train", *robot, *teleop, "--dataset.repo_id=local/clean", f"--dataset.root={tmp_path / 'clean'}",
            *TINY_POLICY, "--offline_updates=5", "--updates_per_episode=2", "--batch_size=4", "--demo_batch_size=4",
            "--steps=30", "--arm.episode_s=2", "--eval.final_n_episodes=0", "--eval.freq=0", "--threads=1",
            "--operator_page", f"--page.port={free_port}", f"--output_dir={tmp_path / 'run'}",
        )  # fmt: skip
        over.set()
        assert "Control: 10.0 Hz of 10" in said
        assert all(servo.torque for port in follower.values() for servo in port.chain.servos)  # held at the end
        run(
            "lerobot-rollout", f"--policy.path={tmp_path / 'run/checkpoints/last/pretrained_model'}", *robot,
            "--fps=10", "--duration=3", "--return_to_initial_position=false", "--play_sounds=false",
        )  # fmt: skip
        done.set()


def person(port: int, token: str, over: threading.Event) -> None:
    """Starts each episode at the page, calls every other one a success, and sets up the scene."""
    answers = itertools.cycle(("success", "failure"))
    with httpx.Client(
        base_url=f"http://127.0.0.1:{port}", headers={"X-Token": token, "X-Client": "ann"}, timeout=5
    ) as page:
        while not over.wait(0.1):
            with contextlib.suppress(httpx.HTTPError, KeyError):
                session = page.get("/api/state").json()["session"]
                event = {"waiting": "start", "resetting": "ready"}.get(session["state"])
                event = next(answers) if session["state"] == "labelling" else event
                if event in session["allowed"] and not session["homing"]:
                    page.post("/api/event", json={"event": event})
