"""`cqn-train`: what a run leaves behind, that it can be killed at any moment, and what it says to wrong input."""

import csv
import json
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig
from safetensors.torch import load_file

from cqn_train.cli import main
from cqn_train.run.metrics import COLUMNS
from cqn_train.run.stop import StopRequest
from lerobot_cqn.critic import CQNModel
from lerobot_cqn.modeling_cqn import CQNPolicy

from ..toy_datasets import make_dataset
from .conftest import STATION, TINY_POLICY, TINY_RUN, Command
from .zygote import Zygote, wait_until

Rows = list[dict[str, str]]


def tables(folder: Path) -> dict[str, Rows]:
    """All metrics but the time they took."""
    found = {}
    for table in COLUMNS:
        with (folder / f"{table}.csv").open() as file:
            found[table] = [{k: v for k, v in row.items() if k != "wall_s"} for row in csv.DictReader(file)]
    return found


def assert_same_run(one: Path, other: Path) -> None:
    assert tables(one) == tables(other)
    a, b = (load_file(run / "checkpoints/last/pretrained_model/model.safetensors") for run in (one, other))
    assert a.keys() == b.keys()
    assert [key for key in a if not torch.equal(a[key], b[key])] == []


# -- a run -----------------------------------------------------------------------------------------------------


def test_metrics_tell_the_run(straight: Path) -> None:
    found = tables(straight)
    assert [row["phase"] for row in found["evaluations"]] == ["offline", "online", "final"]
    assert [int(row["env_steps"]) for row in found["evaluations"]] == [0, 30, 60]
    assert [int(row["length"]) for row in found["episodes"]] == [10] * 6
    assert {row["demonstrations"] for row in found["episodes"]} == {"3"}  # nobody succeeds within ten steps
    updates = [int(row["updates"]) for row in found["updates"]]
    assert updates == list(range(5, 71, 5))  # 10 offline, then one a step
    assert [int(row["env_steps"]) for row in found["updates"]][:3] == [0, 0, 5]
    assert all(float(row["loss"]) > 0 for row in found["updates"])


def test_checkpoints_follow_lerobots_layout(straight: Path) -> None:
    folder = straight / "checkpoints"
    assert os.readlink(folder / "last") == "000060"
    assert sorted(p.name for p in folder.iterdir()) == [*(f"{step:06d}" for step in range(0, 61, 10)), "last"]
    names = {p.name for p in (folder / "last" / "pretrained_model").iterdir()}
    assert {"config.json", "model.safetensors", "policy_preprocessor.json", "policy_postprocessor.json"} <= names
    kept = sorted(p.name for p in folder.iterdir() if (p / "training_state").exists() and not p.is_symlink())
    assert kept == ["000050", "000060"]  # the newest, and the one before where that is damaged


def test_one_seed_gives_one_run(straight: Path, click: list[str], tmp_path: Path) -> None:
    assert main([*TINY_RUN, *click, f"--output_dir={tmp_path / 'again'}"]) == 0
    assert_same_run(straight, tmp_path / "again")


def test_another_seed_gives_another_run(straight: Path, click: list[str], tmp_path: Path) -> None:
    assert main([*TINY_RUN, "--steps=10", "--seed=4", *click, f"--output_dir={tmp_path / 'other'}"]) == 0
    assert tables(straight)["episodes"][0] != tables(tmp_path / "other")["episodes"][0]


def test_a_finished_run_resumes_to_more_steps(straight: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(straight, run, symlinks=True)
    assert main(["--resume=true", f"--output_dir={run}", "--steps=70"]) == 0
    assert [row["env_steps"] for row in tables(run)["evaluations"]] == ["0", "30", "60", "70"]
    assert len(tables(run)["episodes"]) == 7


def test_imitation_only_then_online_from_its_policy(click: list[str], tmp_path: Path) -> None:
    small = [*click, "--eval.final_n_episodes=1", "--batch_size=4", "--demo_batch_size=4"]
    imitation = [*TINY_POLICY, "--policy.rl_loss_scale=0", "--steps=0", "--offline_updates=4", "--log_freq=2"]
    assert main([*imitation, *STATION, *small, f"--output_dir={tmp_path / 'bc'}"]) == 0
    assert {row["rl_loss"] for row in tables(tmp_path / "bc")["updates"]} == {""}
    policy = tmp_path / "bc/checkpoints/last/pretrained_model"
    online = [f"--policy.path={policy}", "--policy.rl_loss_scale=0.1", "--steps=10", "--log_freq=5"]
    assert main([*online, *STATION, *small, f"--output_dir={tmp_path / 'rl'}"]) == 0
    assert float(tables(tmp_path / "rl")["updates"][0]["rl_loss"]) > 0
    saved = json.loads((tmp_path / "rl/checkpoints/last/pretrained_model/config.json").read_text())
    assert (saved["rl_loss_scale"], saved["hidden_dim"]) == (0.1, 16)


# -- interruptions -----------------------------------------------------------------------------------------------


def test_a_loss_that_is_not_finite_stops_the_run_and_keeps_the_batch(
    click: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    original, calls = CQNModel.loss, iter(range(1000))

    def loss(self: CQNModel, batch: Any) -> Any:
        value, stats = original(self, batch)
        return value * (float("nan") if next(calls) == 25 else 1.0), stats

    monkeypatch.setattr(CQNModel, "loss", loss)
    assert main([*TINY_RUN, *click, f"--output_dir={run}"]) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert "The loss is nan" in said
    assert str(run / "bad_batch.pt") in said
    assert torch.load(run / "bad_batch.pt", weights_only=True)["action"].shape == (8, 7)
    monkeypatch.undo()
    assert main(["--resume=true", f"--output_dir={run}", "--steps=20"]) == 0


def test_ctrl_c_saves_and_says_how_to_continue(click: list[str], tmp_path: Path, processes: Zygote) -> None:
    run, said_out, said_err = (tmp_path / name for name in ("run", "out", "err"))
    steps = ["--steps=1000000", f"--output_dir={run}"]
    process = processes.start("cqn-train", *TINY_RUN, *click, *steps, out=str(said_out), err=str(said_err))
    # The last table to be made is that of the diagnosis.
    wait_until(lambda: (run / "diagnosis.csv").exists() and len(tables(run)["episodes"]) >= 2)
    os.kill(process, signal.SIGINT)
    code = os.waitstatus_to_exitcode(processes.wait(process))
    out, err = said_out.read_text(), said_err.read_text()
    assert code == 130
    # All that a person sees beside the progress: nothing of the libraries below.
    said = [line for line in err.splitlines() if line]
    assert len(said) == 2, err
    assert "the last step of each episode counts as the success" in said[0]
    assert "Stopping: saving a checkpoint" in said[1]
    assert f"cqn-train --resume=true --output_dir={run}" in " ".join(out.split())
    last = run / "checkpoints" / "last"
    steps = int(last.resolve().name)
    policy = CQNPolicy.from_pretrained(
        last / "pretrained_model", config=PreTrainedConfig.from_pretrained(str(last / "pretrained_model"))
    )
    assert policy.action_dims == 7
    assert main(["--resume=true", f"--output_dir={run}", f"--steps={steps + 10}"]) == 0
    assert int(last.resolve().name) >= steps + 10


def test_stopping_during_the_offline_phase(
    straight: Path, click: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between two updates nothing is lost: the resumed run is the uninterrupted one."""
    asked = iter([False] * 6 + [True] * 1000)
    monkeypatch.setattr(StopRequest, "__call__", lambda _: next(asked))
    assert main([*TINY_RUN, *click, f"--output_dir={tmp_path / 'run'}"]) == 130
    monkeypatch.undo()
    assert main(["--resume=true", f"--output_dir={tmp_path / 'run'}"]) == 0
    assert_same_run(straight, tmp_path / "run")


def test_signal_handlers_are_given_back(click: list[str], tmp_path: Path) -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    assert main([*TINY_RUN, *click, "--steps=0", f"--output_dir={tmp_path / 'run'}"]) == 0
    assert before == (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM))


# -- wrong input ---------------------------------------------------------------------------------------------------

MATCHING: dict[str, Any] = {"dims": (7, 7), "environment_state": 3}  # what the station gives

DATASETS: dict[str, dict[str, Any]] = {
    "empty": {**MATCHING, "lengths": ()},
    "no_action": {**MATCHING, "action": "command"},
    "no_observation": {"state": False, "dims": (7, 7)},
    "small_action": {**MATCHING, "dims": (7, 4)},
    "camera": {**MATCHING, "camera": True},
    "nan": {**MATCHING, "nan_at": (1, 1)},
    "pixels_only": {"state": False, "dims": (7, 7), "camera": True},
    "wide_state": {**MATCHING, "dims": (9, 7)},
}


@pytest.fixture(scope="module")
def damaged(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], list[str]]:
    """Arguments that name a dataset of DATASETS, made on first use."""
    folder = tmp_path_factory.mktemp("damaged")

    def arguments(name: str) -> list[str]:
        root = folder / name
        if name in DATASETS and not root.exists():
            make_dataset(root, **DATASETS[name])
        if name == "broken" and not root.exists():
            (root / "meta").mkdir(parents=True)
            (root / "meta" / "info.json").write_text("{")
        return ["--dataset.repo_id=local/toy", f"--dataset.root={root}"]

    return arguments


def assert_refused(arguments: list[str], said: list[str], capfd: pytest.CaptureFixture[str]) -> None:
    """Exit code 2 and one line on stderr with all of `said`."""
    capfd.readouterr()
    code = main(arguments)
    err = capfd.readouterr().err
    assert code == 2, err
    assert err.startswith("cqn-train: error: ")
    assert err.count("\n") == 1, err
    for part in said:
        assert part in err


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("missing", ["No dataset at", "missing", "expected meta/info.json", "check --dataset.root"]),
        ("broken", ["No readable LeRobotDataset v3", "--dataset.root=DIR"]),
        ("empty", ["is empty", "expected at least one episode"]),
        ("no_action", ["Expected one action vector under 'action'", "found None"]),
        ("no_observation", ["Nothing to observe", "observation.state", "found []"]),
        ("small_action", ["action has 7 dimensions", "4", "use the environment"]),
        ("camera", ["The dataset has 'observation.images.wrist'", "does not give", "--env.cameras"]),
        ("nan", ["'observation.state'", "episode 1, frame 1", "expected finite numbers", "repair the episode"]),
    ],
)
def test_damaged_datasets(
    name: str,
    said: list[str],
    damaged: Callable[[str], list[str]],
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    run = tmp_path / "run"
    arguments = damaged(name)
    assert_refused([*TINY_RUN, *arguments, f"--output_dir={run}"], said, capfd)
    assert not run.exists()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--policy.preset=laptop_stat"], ["Unknown preset 'laptop_stat'", "Did you mean 'laptop_state'?"]),
        (["--policy.levls=3"], ["Unknown option '--policy.levls'", "Did you mean '--policy.levels'?"]),
        (["--offline_update=3"], ["Unknown option '--offline_update'", "Did you mean '--offline_updates'?"]),
        (["--env.episode_len=3"], ["'--env.episode_len'", "Did you mean '--env.episode_length'?"]),
        (["steps=3"], ["Unknown option 'steps'", "--name=value"]),
        (["--steps"], ["--steps", "expected one argument"]),
        (["--policy.levels=0"], ["`levels` must be 1 to 16, got 0"]),
        (["--policy.levels=many"], ["policy.levels", "'many'", "int"]),
        (["--policy.tau=0"], ["`tau` must be in (0, 1], got 0"]),
        (["--batch_size=-1"], ["`batch_size` must be 0 to 65536, got -1"]),
        (["--eval.n_episodes=0"], ["eval.n_episodes", "at least 1"]),
        (["--policy.act_with=both"], ["act_with", "'both'", "online, target"]),
        (["--policy.normalization_mapping={STATE: MINMAX}"], ["normalization_mapping", "MINMAX"]),
        (["--policy.device=gpu"], ["gpu", "cuda", "cpu"]),
        (["--dataset.episodes=[7]"], ["--dataset.episodes=[7]", "episodes 0 to 2"]),
        (["--dataset.episodes=[]"], ["--dataset.episodes=[]", "at least one"]),
        (["--env.type=ur5e_statio"], ["'ur5e_statio'", "Did you mean 'ur5e_station'?"]),
        (["--env.obs_type=state_only"], ["Unknown obs_type 'state_only'", "both, pixels, state"]),
        (
            ["--env.obs_type=both"],
            ["has not the environment's camera 'observation.images.left_sh", "leave it"],
        ),
        (["--config_path=/nowhere.json"], ["/nowhere.json"]),
        (["--policy.type=act"], ["`preset`", "not valid for ACTConfig"]),
    ],
    ids=lambda value: value[0] if value[0].startswith(("-", "steps")) else "",
)
def test_wrong_options(
    given: list[str], said: list[str], click: list[str], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    replaced = {option.partition("=")[0] for option in given}
    base = [option for option in [*TINY_RUN, *click] if option.partition("=")[0] not in replaced]
    assert_refused([*base, f"--output_dir={run}", *given], said, capfd)
    assert not run.exists()


@pytest.mark.parametrize(
    ("left_out", "said"),
    [
        ("--policy.", ["No policy", "--policy.type=cqn"]),
        ("--env.", ["No environment and no arm", "--env.type=ur5e_station", "--robot.type="]),
        ("--env.type", ["--env.obs_type=state", "give --env.type="]),
        ("--dataset.", ["No demonstrations", "--dataset.repo_id="]),
        ("--output_dir", ["No output directory", "--output_dir=DIR"]),
    ],
)
def test_something_left_out(
    left_out: str, said: list[str], click: list[str], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    arguments = [*TINY_RUN, *click, f"--output_dir={tmp_path / 'run'}"]
    assert_refused([a for a in arguments if not a.startswith(left_out)], said, capfd)
    assert list(tmp_path.iterdir()) == []


def test_an_existing_run_is_left_alone(straight: Path, click: list[str], capfd: pytest.CaptureFixture[str]) -> None:
    before = {path: path.stat().st_mtime_ns for path in straight.rglob("*")}
    said = [str(straight), "exists and is not empty", "another --output_dir", "--resume=true"]
    assert_refused([*TINY_RUN, *click, f"--output_dir={straight}"], said, capfd)
    assert {path: path.stat().st_mtime_ns for path in straight.rglob("*")} == before


def test_resume_without_a_checkpoint(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    said = ["Nothing to resume", str(tmp_path), "expected checkpoints/last", "leave out --resume"]
    assert_refused(["--resume=true", f"--output_dir={tmp_path}"], said, capfd)
    assert_refused(["--resume=true"], ["--resume", "give --output_dir"], capfd)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("path", "given", "said"),
    [
        ("nowhere", [], ["No policy at", "nowhere", "pretrained_model", "check --policy.path"]),
        ("", [], ["No policy in", "expected config.json", "`pretrained_model` folder"]),
        ("checkpoints/last/pretrained_model", ["--policy.levls=3"], ["'--policy.levls'", "'--policy.levels'"]),
        ("checkpoints/last/pretrained_model", ["--policy.hidden_dim=5"], ["do not fit", "leave out"]),
    ],
    ids=["nowhere", "not a policy", "unknown option", "another network"],
)
def test_policies_that_cannot_be_loaded(
    path: str,
    given: list[str],
    said: list[str],
    straight: Path,
    click: list[str],
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    base = [a for a in TINY_RUN if not a.startswith("--policy.")]
    run = f"--output_dir={tmp_path / 'run'}"
    assert_refused([*base, *click, f"--policy.path={straight / path}", *given, run], said, capfd)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("pixels_only", ["no 'observation.state'", "which the policy needs"]),
        ("wide_state", ["'observation.state' has shape (9,) in the dataset", "(7,) in the policy"]),
        ("small_action", ["'action' has shape (4,) in the dataset", "(7,) in the policy"]),
    ],
)
def test_a_trained_policy_meets_another_dataset(
    name: str,
    said: list[str],
    damaged: Callable[[str], list[str]],
    straight: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    policy = f"--policy.path={straight / 'checkpoints/last/pretrained_model'}"
    base = [a for a in TINY_RUN if not a.startswith("--policy.")]
    arguments = damaged(name)
    assert_refused([*base, policy, *arguments, f"--output_dir={tmp_path / 'run'}"], said, capfd)
    assert not (tmp_path / "run").exists()


def test_a_device_that_is_not_there_is_named(
    click: list[str], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    if torch.cuda.is_available():
        pytest.skip("this machine has the device")
    arguments = [a for a in TINY_RUN if not a.startswith("--policy.device")]
    assert main([*arguments, *click, "--policy.device=cuda", "--steps=0", f"--output_dir={tmp_path / 'run'}"]) == 0
    assert "The device 'cuda' is not available: using 'cpu'." in capfd.readouterr().err


def test_from_a_terminal(command: Command, tmp_path: Path) -> None:
    """The installed command, without a test's capture around it: one line, exit code 2."""
    done = command("cqn-train", *TINY_POLICY, "--policy.levls=2", f"--output_dir={tmp_path / 'run'}", code=2)
    assert done.stdout == ""
    assert done.stderr.startswith("cqn-train: error: Unknown option '--policy.levls'")
    assert done.stderr.count("\n") == 1
