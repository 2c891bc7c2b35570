"""Two simulated arms that practise one policy, each with its page and its person, and the overview of both."""

import json
import socket
import time
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from cqn_train.cli import main

from .conftest import TINY_POLICY
from .test_arm_training import demonstrations  # noqa: F401  # a fixture
from .test_cluster import stored
from .test_cqn_train import tables
from .zygote import Zygote, wait_until

pytest.importorskip("mujoco")
TOKEN = "two-arms-at-once"  # noqa: S105  # of this test
RUN = [
    *TINY_POLICY, "--robot.type=sim_ur5e", "--robot.speed=8", "--robot.ramp_s=0.2", "--robot.camera_names=[]",
    "--robot.state=true", "--batch_size=4", "--demo_batch_size=4", "--updates_per_episode=2", "--log_freq=1",
    "--arm.home_speed=1", "--arm.episode_s=1", "--arm.fps=20", "--page.absent_s=2", "--threads=1", "--ray.actors=2",
    "--ray.robot_resource=arm",
]  # fmt: skip


def free_ports(count: int) -> int:
    """The first of `count` ports in a row that nobody listens at."""
    for port in range(20_000, 60_000, count):
        try:
            for number in range(port, port + count):
                with socket.socket() as probe:
                    probe.bind(("127.0.0.1", number))
        except OSError:
            continue
        return port
    raise AssertionError("no ports are free")


def ask(port: int, path: str, body: dict[str, Any] | None = None) -> Any:
    request = urllib.request.Request(  # this machine
        f"http://127.0.0.1:{port}{path}?client=test", data=None if body is None else json.dumps(body).encode(),
        headers={"X-Token": TOKEN, "Content-Type": "application/json"},
    )  # fmt: skip
    with urllib.request.urlopen(request, timeout=5) as answer:  # noqa: S310
        return json.load(answer)


@pytest.mark.real_time(reason="two arms move by the machine's own clock, and their persons look at them")
def test_two_arms_practise_one_policy(
    demonstrations: list[str],  # noqa: F811
    tmp_path: Path,
    processes: Zygote,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("CQN_PAGE_TOKEN", TOKEN)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    port, run, out = free_ports(3), tmp_path / "run", tmp_path / "out"
    persons = ", ".join(f"{{robot.person: 'http://127.0.0.1:{port + 1 + i}', robot.seed: {i}}}" for i in range(2))
    process = processes.start(
        "cqn-train", *RUN, *demonstrations, f"--ray.each=[{persons}]", f"--page.port={port}", "--steps=120",
        f"--output_dir={run}", out=str(out), err=str(out),
    )  # fmt: skip

    def arms() -> list[dict[str, Any]]:
        time.sleep(0.2)  # the processor is for the arms
        try:
            found: list[dict[str, Any]] = ask(port, "/api/state")["arms"]
        except OSError:
            return []
        return found

    try:
        wait_until(lambda: len(arms()) == 2 and all(arm["episodes"] >= 1 for arm in arms()), 240)
        seen = arms()
        assert [arm["page"].startswith(f"http://127.0.0.1:{port + 1 + i}/") for i, arm in enumerate(seen)] == [True] * 2
        # A person changes their mind on the page of the arm that had the first episode.
        for number in range(2):
            labels = ask(port + 1 + number, "/api/state")["session"]["labels"]
            if "0" in labels:
                ask(port + 1 + number, "/api/control", {})
                ask(port + 1 + number, "/api/correct", {"episode": 0, "label": "success"})
    finally:
        code = processes.wait(process, 300)
    assert code == 0, out.read_text()
    keys = stored(run)
    assert len({*keys}) == len({row["episode"] for row in tables(run)["episodes"]})
    said = out.read_text()
    assert "Overview of the arms" in said
    assert "Collector 0: Operator's page:" in said
    assert "Collector 1: Operator's page:" in said
    assert "Episode 0 is a success now." in said
    assert TOKEN not in said  # it would be in a log that others may read


def test_arms_with_other_limits_are_refused_by_name(
    demonstrations: list[str],  # noqa: F811
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    port = free_ports(3)
    each = "--ray.each=[{}, {arm.joint_limits: {shoulder_pan.pos: [-200, 200]}}]"
    options = [*RUN, *demonstrations, each, f"--page.port={port}", f"--output_dir={tmp_path / 'run'}"]
    assert main(options) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert "'shoulder_pan.pos' may go from" in error
    assert "give both the same --arm.joint_limits" in error
