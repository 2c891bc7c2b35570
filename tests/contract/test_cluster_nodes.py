"""Two nodes of a Ray cluster on this machine: collectors where their resource is, and a benchmark's grid."""

import json
import os
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from cqn_train.replay.files import Journal

from .conftest import STATION, TINY_POLICY, TINY_RUN
from .test_cluster import free_port
from .test_cqn_train import tables

pytestmark = pytest.mark.slow
COMMON = ["--batch_size=4", "--demo_batch_size=4", "--offline_updates=3", "--steps=40", "--eval.freq=10",
          "--eval.n_episodes=1", "--eval.final_n_episodes=2", "--save_freq=10", "--log_freq=1"]  # fmt: skip


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, dict[str, str]]]:
    """Address and environment of a head and a node with two arms, which answer only those who have the token."""
    environment = os.environ | {
        "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32), "RAY_USAGE_STATS_ENABLED": "0",
        "XDG_CACHE_HOME": str(tmp_path_factory.mktemp("cache")),
    }  # fmt: skip
    ray, address = str(Path(sys.executable).parent / "ray"), f"127.0.0.2:{free_port()}"
    for options in (
        ["--head", "--node-ip-address=127.0.0.2", f"--port={address.partition(':')[2]}", "--include-dashboard=false"],
        [f"--address={address}", "--node-ip-address=127.0.0.3", '--resources={"arm": 2}'],
    ):
        subprocess.run([ray, "start", "--num-cpus=2", *options], env=environment, check=True, capture_output=True)
    try:
        yield address, environment
    finally:
        subprocess.run([ray, "stop", "--force"], env=environment, check=False, capture_output=True)


def run(module: str, *arguments: str, env: dict[str, str]) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", module, *arguments]
    return subprocess.run(command, env=env, capture_output=True, text=True, timeout=300, check=False)


def test_collectors_act_on_the_node_that_has_their_resource(
    cluster: tuple[str, dict[str, str]], click: list[str], tmp_path: Path
) -> None:
    address, environment = cluster
    options = ["--ray.actors=2", f"--ray.address={address}", "--ray.robot_resource=arm"]
    done = run("cqn_train.cli", *TINY_RUN, *click, *options, f"--output_dir={tmp_path / 'run'}", env=environment)
    assert done.returncode == 0, done.stderr[-2000:]
    assert int(tables(tmp_path / "run")["evaluations"][-1]["env_steps"]) >= 60
    places = [place for _, place in Journal(tmp_path / "run/replay/episodes.jsonl").entries() if place]
    assert len({place.note["key"] for place in places}) == len(places) >= 6


@pytest.mark.parametrize(
    ("options", "said", "changed"),
    [
        (["--ray.robot_resource=leg"], "--ray.robot_resource=leg: no node of the cluster has it", {}),
        ([], "cannot be joined", {"RAY_AUTH_TOKEN": "a" * 64}),
    ],
)
def test_a_cluster_that_does_not_fit_is_refused(
    cluster: tuple[str, dict[str, str]], click: list[str], tmp_path: Path, options: list[str], said: str,
    changed: dict[str, str],
) -> None:  # fmt: skip
    address, environment = cluster
    more = ["--ray.actors=1", f"--ray.address={address}", *options, f"--output_dir={tmp_path / 'run'}"]
    done = run("cqn_train.cli", *TINY_RUN, *click, *more, env=environment | changed)
    assert done.returncode == 2
    assert said in done.stderr.strip().splitlines()[-1]


def test_a_grid_runs_on_the_cluster_and_goes_on_after_ctrl_c(
    cluster: tuple[str, dict[str, str]], click: list[str], tmp_path: Path
) -> None:
    address, environment = cluster
    plan, out = tmp_path / "plan.yaml", tmp_path / "out"
    tasks = {"click": [*STATION, *click]}
    plan.write_text(json.dumps({"common": COMMON, "methods": {"cqn": TINY_POLICY}, "tasks": tasks, "seeds": [1, 2, 3]}))
    command = [
        sys.executable,
        "-m",
        "cqn_train.bench.cli",
        str(plan),
        f"--output_dir={out}",
        f"--ray.address={address}",
    ]
    first = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    deadline = time.monotonic() + 120
    while not (out / "click" / "cqn" / "1" / "checkpoints" / "last").exists():
        assert first.poll() is None, first.communicate()[0]
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.kill(first.pid, signal.SIGINT)
    said, _ = first.communicate(timeout=180)
    assert first.returncode == 130, said
    assert "the same command continues" in said
    done = run("cqn_train.bench.cli", *command[3:], env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (out / "results.csv").read_text().count("\n") == 4
