"""Policies on a Hub on this machine: `cqn-push`, pushes at the end of a training, loading back, and every failure."""

import json
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml
from huggingface_hub import close_session

from cqn_train.cli import main as cqn_train
from cqn_train.push.cli import main

from ..hub_server import HubServer
from .conftest import STATION, TINY_POLICY, TINY_RUN

REPO = "user/click"
WEIGHTS = "model.safetensors"
SENT = {
    WEIGHTS, "config.json", "train_config.json", "README.md", "policy_preprocessor.json", "policy_postprocessor.json",
    "training/curve.png", "training/dataset_card.md", "training/episodes.csv", "training/evaluations.csv",
    "training/updates.csv",
}  # fmt: skip


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> Iterator[HubServer]:
    """The Hub, for this process; nobody waits between tries."""
    with HubServer() as server:
        server.connect(monkeypatch)
        monkeypatch.setattr("lerobot_cqn.hub_retry.pause", lambda seconds: None)
        monkeypatch.setattr("lerobot_cqn.hub_retry.pause", lambda seconds: None)
        monkeypatch.setattr("huggingface_hub.utils._http.time.sleep", lambda seconds: None)
        yield server
        close_session()


@pytest.fixture
def run(straight: Path, tmp_path: Path) -> Path:
    """A copy of a finished run, to look whether it changes."""
    return shutil.copytree(straight, tmp_path / "run", symlinks=True)


def push(run: Path, *options: str, code: int = 0, repo: str = REPO) -> None:
    assert main([f"--run={run}", f"--repo_id={repo}", *options]) == code


def failed(capsys: pytest.CaptureFixture[str], run: Path, *options: str, repo: str = REPO) -> str:
    """The one line in which a push says why it failed."""
    capsys.readouterr()
    push(run, *options, code=2, repo=repo)
    errors = capsys.readouterr().err
    assert "Traceback" not in errors
    last = errors.strip().splitlines()[-1]
    assert last.startswith("cqn-push: error: ")
    return last


def content(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def subprocess_of(hub: HubServer, tmp_path: Path) -> Callable[..., "subprocess.CompletedProcess[str]"]:
    """Run an installed command that is led to the Hub, with an empty cache."""
    environment = {**os.environ, **hub.environment(), "HF_HOME": str(tmp_path / "cache")}

    def call(name: str, *arguments: str, code: int = 0) -> "subprocess.CompletedProcess[str]":
        done = subprocess.run(
            [str(Path(sys.executable).parent / name), *arguments],
            capture_output=True, text=True, timeout=180, check=False, env=environment,
        )  # fmt: skip
        assert done.returncode == code, done.stdout[-1500:] + done.stderr[-3000:]
        return done

    return call


def test_a_run_arrives_without_optimiser_and_without_this_machine(hub: HubServer, run: Path) -> None:
    before = content(run)
    push(run, "--tags=[ur5e]")
    assert content(run) == before
    there = hub.files("models", REPO)
    others = {path for path in there if path.startswith(("policy_pre", "policy_post"))}
    assert {*there} - others - {".gitattributes"} == SENT - {p for p in SENT if p.startswith("policy_")}
    assert not any("optimizer" in path or "rng" in path or "replay" in path for path in there)
    model = run / "checkpoints" / "last" / "pretrained_model"
    assert there[WEIGHTS] == (model / WEIGHTS).read_bytes()
    assert all(there[path] == (model / path).read_bytes() for path in others)
    small = [path for path in there if path.endswith((".json", ".md", ".csv"))]
    assert not [path for path in small if str(run.parent).encode() in there[path]]
    assert not [path for path in small if b"/click/click" in there[path]]  # the dataset's folder
    settings = json.loads(there["train_config.json"])
    assert (settings["output_dir"], settings["dataset"]["root"], settings["steps"]) == (None, None, 60)
    front = yaml.safe_load(there["README.md"].decode().split("---\n")[1])
    assert (front["license"], front["library_name"], front["pipeline_tag"]) == ("apache-2.0", "lerobot", "robotics")
    assert {"cqn", "ur5e", "lerobot", "robotics"} <= set(front["tags"])
    assert "datasets" not in front  # it is not on the Hub


def test_the_card_says_what_the_run_left(hub: HubServer, run: Path) -> None:
    push(run, "--dataset=user/click_f", "--license=mit")
    card = hub.files("models", REPO)["README.md"].decode()
    rows = [line.split(",") for line in (run / "evaluations.csv").read_text().splitlines()[1:]]
    offline, final = rows[0], rows[-1]
    for row in (offline, final):
        rate, successes, n = float(row[6]), row[5], row[4]
        assert f"| {row[2]} updates, {row[1]} steps online | {rate:.2f} | {successes}/{n} |" in card
    front = yaml.safe_load(card.split("---\n")[1])
    metric = front["model-index"][0]["results"][0]["metrics"][0]
    assert (metric["type"], metric["value"]) == ("success_rate", float(final[6]))
    assert (front["datasets"], front["license"]) == (["user/click_f"], "mit")
    assert "`feature_dim=8`, `hidden_dim=16`" in card
    assert "| Changed from the preset's schedule | batch_size=4, demo_batch_size=4 |" in card
    assert "Recorded scripted demonstrations" in card
    assert "| shoulder_pan.pos | as the robot takes it |" in card
    assert f"lerobot-eval --policy.path={REPO} --env.type=ur5e_station --env.task=click_button" in card
    assert f"cqn-train --policy.path={REPO}" in card
    assert "--dataset.repo_id=user/click_f" in card
    assert "@inproceedings{seo2024continuous" in card


def test_a_second_push_sends_nothing_and_keeps_a_persons_text(hub: HubServer, run: Path) -> None:
    push(run)
    card = hub.files("models", REPO)["README.md"].decode()
    mine = card.replace("# click\n", "# click\n\nBy hand.\n", 1) + "\nThanks.\n"
    hub.write("models", REPO, {"README.md": mine.encode(), "videos/old.mp4": b"x", "NOTES.txt": b"mine"})
    commits = len(hub.repositories["models", REPO].messages)
    push(run)
    there = hub.files("models", REPO)
    assert there["README.md"].decode() == mine
    assert "videos/old.mp4" not in there
    assert there["NOTES.txt"] == b"mine"
    assert len(hub.repositories["models", REPO].messages) == commits + 1
    hub.requests.clear()
    push(run)
    assert not [r for r in hub.requests if r.startswith("PUT") or "/commit/" in r]


def test_an_earlier_checkpoint_and_a_folder_that_stands_alone(hub: HubServer, run: Path, tmp_path: Path) -> None:
    steps = sorted(p.name for p in (run / "checkpoints").iterdir() if p.name.isdigit())
    push(run, f"--checkpoint={int(steps[1])}")
    early = (run / "checkpoints" / steps[1] / "pretrained_model" / WEIGHTS).read_bytes()
    assert hub.files("models", REPO)[WEIGHTS] == early
    alone = shutil.copytree(run / "checkpoints" / "last" / "pretrained_model", tmp_path / "alone")
    push(alone, repo="user/alone")
    there = hub.files("models", "user/alone")
    assert "training/curve.png" not in there
    assert b"It has not been evaluated" in there["README.md"]


def test_a_branch_and_a_dry_run(hub: HubServer, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    push(run, "--dry_run")
    assert not hub.requests
    shown = capsys.readouterr().out
    assert "## Results" in shown
    assert "Dry run: nothing was sent to user/click." in shown
    push(run, "--branch=try", "--message=A try.")
    assert WEIGHTS not in hub.files("models", REPO)
    assert WEIGHTS in hub.files("models", REPO, "try")
    assert hub.repositories["models", REPO].messages[-1] == "A try."


@pytest.mark.parametrize(
    ("method", "path", "status", "said"),
    [
        ("POST", "/create", 401, "does not accept the token (401)"),
        ("POST", "/create", 403, "No permission to write to user/click (403), logged in as user"),
        ("POST", "/commit/", 409, "was changed by somebody else meanwhile (409)"),
        ("PUT", "/lfs/", 500, "The Hub answers 500 again and again"),
        ("POST", "/preupload/", 503, "The Hub answers 503 again and again"),
        ("PUT", "/lfs/", None, "broke off"),
    ],
)
def test_what_the_hub_refuses_is_one_line_and_the_next_push_goes_on(
    hub: HubServer, run: Path, capsys: pytest.CaptureFixture[str], method: str, path: str, status: int, said: str
) -> None:
    before = content(run)
    hub.fail(method, path, status, times=1000, after=1000)
    line = failed(capsys, run, "--private", "--tags=[a b]")
    assert said in line
    assert f"cqn-push --run={run} --repo_id=user/click --private=true '--tags=[a b]'" in line
    assert content(run) == before
    hub.heal()
    push(run)
    assert hub.files("models", REPO)[WEIGHTS]


def test_a_connection_that_breaks_once_is_taken_up_again(hub: HubServer, run: Path) -> None:
    hub.fail("PUT", "/lfs/", after=2000)
    hub.fail("POST", "/commit/", done=True)  # it took effect, and nobody heard
    push(run)
    assert hub.files("models", REPO)[WEIGHTS] == (run / "checkpoints/last/pretrained_model" / WEIGHTS).read_bytes()
    assert len(hub.repositories["models", REPO].messages) == 2


def test_mistakes_are_named_before_anything_is_sent(
    hub: HubServer, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "No checkpoint 'last' in" in failed(capsys, tmp_path / "nowhere")
    assert "No checkpoint '7' in" in failed(capsys, run, "--checkpoint=7")
    assert "Expected --repo_id=user/name" in failed(capsys, run, repo="click")
    assert "Did you mean '--private'?" in failed(capsys, run, "--privat")
    weights = (run / "checkpoints" / "last" / "pretrained_model" / WEIGHTS).resolve()
    whole = weights.read_bytes()
    weights.write_bytes(whole[: len(whole) // 2])
    assert "cannot be loaded, so it is not pushed" in failed(capsys, run)
    weights.write_bytes(whole)
    table = run / "evaluations.csv"
    kept = table.read_text()
    table.write_text("garbage\n1,2\n")
    assert "evaluations.csv is damaged: expected the columns phase, env_steps" in failed(capsys, run)
    table.write_text(kept)
    monkeypatch.delenv("HF_TOKEN")
    monkeypatch.setenv("HF_TOKEN_PATH", str(tmp_path / "none"))
    monkeypatch.setattr("huggingface_hub.constants.HF_TOKEN_PATH", str(tmp_path / "none"))
    assert "Nobody is logged in to the Hub" in failed(capsys, run)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    assert "HF_HUB_OFFLINE" in failed(capsys, run)
    assert not hub.requests


def test_it_loads_back_in_lerobot_eval_and_trains_on(
    hub: HubServer, run: Path, click: list[str], tmp_path: Path
) -> None:
    push(run)
    call, card = subprocess_of(hub, tmp_path), hub.files("models", REPO)["README.md"].decode()

    def told(command: str, *but: str) -> list[str]:
        """The arguments that the card gives a command, without some that make it long."""
        text = card[card.index(f"{command} --policy.path") :].partition("\n```")[0]
        return [a for a in shlex.split(text.replace("\\\n", " "))[1:] if not a.startswith(but)]

    call("lerobot-eval", *told("lerobot-eval", "--eval"), "--eval.n_episodes=1", "--eval.batch_size=1",
         "--policy.device=cpu", f"--output_dir={tmp_path / 'eval'}")  # fmt: skip
    assert "pc_success" in (tmp_path / "eval" / "eval_info.json").read_text()
    given = told("cqn-train", "--steps", "--output_dir", "--dataset")
    assert {STATION[0], STATION[2], "--batch_size=4"} <= set(given)
    call("cqn-train", *given, *click, "--steps=20", f"--output_dir={tmp_path / 'more'}",
         "--eval.final_n_episodes=1", "--save_freq=100", "--threads=1")  # fmt: skip
    rows = (tmp_path / "more" / "episodes.csv").read_text().splitlines()
    assert len(rows) == 3
    main([f"--run={tmp_path / 'more'}", "--repo_id=user/more"])
    later = hub.files("models", "user/more")["README.md"].decode()
    assert yaml.safe_load(later.split("---\n")[1])["base_model"] == REPO
    assert f"continued from [{REPO}]" in later
    assert "| Trained with | cqn-train: online |" in later
    saved = json.loads((tmp_path / "more/checkpoints/last/pretrained_model/config.json").read_text())
    assert (saved["hidden_dim"], saved["push_to_hub"], saved["repo_id"]) == (16, False, None)


def short(click: list[str], folder: Path, *more: str) -> list[str]:
    """A run of some seconds that is to be pushed."""
    wanted = [a for a in TINY_RUN if not a.startswith(("--steps", "--eval.freq"))]
    return [
        *wanted, *click, "--steps=20", "--eval.freq=0", "--policy.push_to_hub=true", f"--output_dir={folder}", *more,
    ]  # fmt: skip


def test_cqn_train_pushes_at_its_end(hub: HubServer, click: list[str], tmp_path: Path) -> None:
    assert cqn_train(short(click, tmp_path / "run", f"--policy.repo_id={REPO}", "--policy.private=true")) == 0
    there = hub.files("models", REPO)
    assert hub.repositories["models", REPO].private
    assert there[WEIGHTS] == (tmp_path / "run/checkpoints/last/pretrained_model" / WEIGHTS).read_bytes()
    assert b"20 steps online" in there["README.md"]


def test_a_push_that_fails_loses_no_run(
    hub: HubServer, click: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hub.fail("POST", "/commit/", 500, times=100)
    folder = tmp_path / "run"
    assert cqn_train(short(click, folder, f"--policy.repo_id={REPO}")) == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("cqn-train: error: ")
    assert f"cqn-push --run={folder} --repo_id={REPO}" in last
    hub.heal()
    push(folder)
    assert WEIGHTS in hub.files("models", REPO)


@pytest.mark.parametrize(
    ("repo", "setting", "said"),
    [
        ("click", None, r"Expected --policy.repo_id=user/name"),
        ("other/click", None, "'user' is logged in to the Hub and may not write to other/click"),
        (REPO, "no token", "Nobody is logged in to the Hub"),
        (REPO, "bad token", "The Hub does not accept the token (401)"),
    ],
)
def test_a_push_that_could_not_work_is_refused_before_the_training(
    hub: HubServer, click: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch, repo: str, setting: str | None, said: str,
) -> None:  # fmt: skip
    if setting == "no token":
        monkeypatch.delenv("HF_TOKEN")
        monkeypatch.setattr("huggingface_hub.constants.HF_TOKEN_PATH", str(tmp_path / "none"))
    if setting == "bad token":
        monkeypatch.setenv("HF_TOKEN", "hf_wrong")
    assert cqn_train(short(click, tmp_path / "run", f"--policy.repo_id={repo}")) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


LEROBOT = ["--batch_size=4", "--steps=2", "--num_workers=0", "--save_freq=2", "--policy.push_to_hub=true"]


def test_lerobot_train_pushes_with_our_card(hub: HubServer, rewarded: list[str], tmp_path: Path) -> None:
    call = subprocess_of(hub, tmp_path)
    call("lerobot-train", *TINY_POLICY, *rewarded, *LEROBOT, f"--policy.repo_id={REPO}",
         f"--output_dir={tmp_path / 'run'}")  # fmt: skip
    there = hub.files("models", REPO)
    assert {WEIGHTS, "config.json", "policy_preprocessor.json", "policy_postprocessor.json"} <= set(there)
    card = there["README.md"].decode()
    assert "A **Coarse-to-fine Q-Network (CQN)** policy" in card
    assert "| Updates | 2 |" in card
    assert "`feature_dim=8`, `hidden_dim=16`" in card
    assert "It has not been evaluated" in card
    assert yaml.safe_load(card.split("---\n")[1])["library_name"] == "lerobot"
    push(tmp_path / "run", repo="user/later")
    assert hub.files("models", "user/later")[WEIGHTS] == there[WEIGHTS]


def test_lerobot_train_ends_with_the_command_that_pushes_later(
    hub: HubServer, rewarded: list[str], tmp_path: Path
) -> None:
    call, folder = subprocess_of(hub, tmp_path), tmp_path / "run"
    ours = [*TINY_POLICY, *rewarded, *LEROBOT, f"--output_dir={folder}"]
    done = call("lerobot-train", *ours, "--policy.repo_id=other/click", code=1)
    last = done.stderr.strip().splitlines()[-1]
    assert f"The run is safe in {folder}; push it when that is mended: cqn-push --run={folder}" in last
    push(folder)
    assert WEIGHTS in hub.files("models", REPO)
