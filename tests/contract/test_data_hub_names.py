"""Datasets by their name on the Hub, and results sent there, against a Hub on this machine."""

import logging
import shutil

import numpy as np
import pytest
from huggingface_hub import close_session

from cqn_data.cli import main

from ..hub_server import HubServer
from .columns import ACTION
from .data_recording import column, history, last_line

REPO = "user/taken"


@pytest.fixture(autouse=True)
def _logs():
    yield
    logging.disable(logging.NOTSET)


@pytest.fixture
def hub(monkeypatch, tmp_path):
    """The Hub, an empty home of LeRobot's and an empty cache."""
    with HubServer() as server:
        server.connect(monkeypatch)
        for name in ("HF_LEROBOT_HOME", "HF_LEROBOT_HUB_CACHE"):
            for module in ("lerobot.utils.constants", "lerobot.datasets.dataset_metadata"):
                monkeypatch.setattr(f"{module}.{name}", tmp_path / name)
        monkeypatch.setattr("lerobot_cqn.hub_retry.pause", lambda seconds: None)
        yield server
        close_session()


@pytest.fixture
def there(hub, recording):
    """The recording on the Hub, as LeRobot and `cqn-data push` put it: a tag of the format's version."""
    assert main(["push", f"--repo_id={REPO}", f"--root={recording}"]) == 0
    return hub


def test_inspect_downloads_what_is_not_here(there, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    assert main(["inspect", f"--repo_id={REPO}"]) == 0
    out, err = capsys.readouterr()
    assert f"Downloading {REPO}, v3.0: 3 episodes" in err
    assert "Ready for training" in out
    assert (tmp_path / "HF_LEROBOT_HUB_CACHE").is_dir()
    assert not (tmp_path / "HF_LEROBOT_HOME" / REPO / "meta/info.json").exists()


def test_an_operation_reads_from_the_hub_and_sends_its_result_there(there, recording, tmp_path):
    there.requests.clear()
    names = [f"--repo_id={REPO}", "--new_repo_id=user/ready", f"--new_root={tmp_path / 'ready'}"]
    assert main(["label", *names, "--all", "--push_to_hub"]) == 0
    np.testing.assert_array_equal(column(tmp_path / "ready", ACTION), column(recording, ACTION))
    sent = there.files("datasets", "user/ready", "v3.0")
    files = [p for p in (tmp_path / "ready").rglob("*") if p.is_file()]
    here = {p.relative_to(tmp_path / "ready").as_posix(): p.read_bytes() for p in files}
    cards = ("README.md", ".gitattributes")
    assert {k: v for k, v in sent.items() if k not in cards} == {k: v for k, v in here.items() if k not in cards}
    assert history(tmp_path / "ready")[-1]["source"] == REPO


def test_a_second_look_downloads_nothing_again(there, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["inspect", f"--repo_id={REPO}"]) == 0
    there.requests.clear()
    assert main(["inspect", f"--repo_id={REPO}"]) == 0
    assert [r for r in there.requests if r.startswith("GET") and ("parquet" in r or "mp4" in r)] == []


def test_a_revision_is_taken_and_an_unknown_one_refused(there, recording, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(recording, tmp_path / "HF_LEROBOT_HOME" / REPO)  # is left aside where a revision is asked for
    assert main(["inspect", f"--repo_id={REPO}", "--revision=main"]) == 0
    assert f"Downloading {REPO}, main" in capsys.readouterr().err
    assert main(["inspect", f"--repo_id={REPO}", "--revision=nowhere"]) == 2
    assert "at revision nowhere" in last_line(capsys)
    assert main(["inspect", f"--repo_id={REPO}", "--revision=main", f"--root={recording}"]) == 2
    assert "give one of them" in last_line(capsys)


def test_a_name_that_is_nowhere_ends_in_a_line(hub, capsys, monkeypatch):
    assert main(["inspect", "--repo_id=user/nothing"]) == 2
    assert "No LeRobotDataset 'user/nothing' on this machine, and the Hub does not give it" in last_line(capsys)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    assert main(["inspect", "--repo_id=user/nothing"]) == 2
    assert "HF_HUB_OFFLINE forbids" in last_line(capsys)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--push_to_hub", "--new_repo_id=no--name/x"], "Expected --new_repo_id=user/name"),
        (["--private"], "give it with --push_to_hub"),
    ],
)
def test_what_cannot_be_sent_is_said_before_any_work(hub, recording, tmp_path, capsys, options, said):
    names = ["--repo_id=local/src", f"--root={recording}", f"--new_root={tmp_path / 'done'}"]
    assert main(["label", *names, "--all", *options]) == 2
    assert said in last_line(capsys)
    assert not (tmp_path / "done").exists()


def test_who_is_not_logged_in_hears_it_before_any_work(hub, recording, tmp_path, capsys, monkeypatch):
    hub.connect(monkeypatch, token=None)
    monkeypatch.setattr("lerobot_cqn.hub_retry.get_token", lambda: None)
    names = ["--repo_id=local/src", f"--root={recording}", f"--new_root={tmp_path / 'done'}", "--new_repo_id=user/x"]
    assert main(["label", *names, "--all", "--push_to_hub"]) == 2
    assert "Nobody is logged in" in last_line(capsys)
    assert not (tmp_path / "done").exists()
