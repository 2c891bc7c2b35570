"""`cqn-data push` against a Hub on this machine: what arrives, what a second push sends, and every way it can fail."""

import hashlib
import logging
import os
import re
import shutil
import subprocess
import sys

import pytest
import yaml
from huggingface_hub import HfApi, close_session

from cqn_data.cli import main
from cqn_data.hub.card import TOOL
from cqn_data.hub.readme import end_mark, start_mark

from ..hub_server import TOKEN, HubServer
from ..toy_datasets import CAMERA, make_dataset

REPO = "user/toy"
START, END = start_mark(TOOL), end_mark(TOOL)
DATA = "data/chunk-000/file-000.parquet"
RECIPE = "steps: [drop: {episodes: [1], reason: clumsy}, label: {all: true}, bounds: {margin: 0.5}]"


@pytest.fixture(autouse=True)
def _logs():
    yield
    logging.disable(logging.NOTSET)


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    """A dataset with a camera and a history; only read."""
    folder = tmp_path_factory.mktemp("push")
    source = make_dataset(folder / "source", camera=True, reward=True, lengths=(7, 6, 5))
    (folder / "recipe.yaml").write_text(RECIPE)
    names = ["--repo_id=local/toy", f"--root={source}", "--new_repo_id=local/done", f"--new_root={folder / 'done'}"]
    assert main(["run", str(folder / "recipe.yaml"), *names]) == 0
    return folder / "done"


@pytest.fixture
def dataset(prepared, tmp_path):
    """A copy to change."""
    return shutil.copytree(prepared, tmp_path / "dataset")


@pytest.fixture
def hub(monkeypatch):
    """The Hub, for this process; nobody waits between tries."""
    with HubServer() as server:
        server.connect(monkeypatch)
        server.waits = []
        monkeypatch.setattr("lerobot_cqn.hub_retry.pause", server.waits.append)
        monkeypatch.setattr("huggingface_hub.utils._http.time.sleep", lambda seconds: None)
        yield server
        close_session()


def push(root, *options, code=0, repo=REPO):
    assert main(["push", f"--repo_id={repo}", f"--root={root}", *options]) == code


def failed(capsys, root, *options, repo=REPO):
    """The one line in which a push says why it failed."""
    capsys.readouterr()
    push(root, *options, code=2, repo=repo)
    printed = capsys.readouterr()
    assert "Traceback" not in printed.err
    lines = [line for line in printed.err.strip().splitlines() if "error:" in line]
    assert lines == [printed.err.strip().splitlines()[-1]]
    return lines[0]


def content(root):
    return {p.relative_to(root).as_posix(): p.read_bytes() for p in root.rglob("*") if p.is_file()}


def writes(requests):
    return [r for r in requests if r.startswith("PUT") or "/commit/" in r or "/tag/" in r]


def front_matter(card):
    return yaml.safe_load(card.split("---\n")[1])


ROUND_TRIP = """
import sys
from cqn_data.cli import main
assert main(["push", "--repo_id=user/toy", "--root=" + sys.argv[1], "--tags=[ur5e]", "--message=First."]) == 0
from lerobot.datasets.lerobot_dataset import LeRobotDataset
dataset = LeRobotDataset("user/toy")
item = dataset[11]
print("LOADED", dataset.num_episodes, len(dataset), item["observation.images.wrist"].shape, float(item["next.reward"]))
"""


def test_a_push_arrives_byte_for_byte_and_lerobot_loads_it(prepared, tmp_path):
    before = {str(p): (p.stat().st_mtime_ns, p.stat().st_size) for p in prepared.rglob("*")}
    with HubServer() as hub:
        env = {**os.environ, **hub.environment(), "HF_HOME": str(tmp_path), "HF_LEROBOT_HOME": str(tmp_path / "le")}
        done = subprocess.run(
            [sys.executable, "-c", ROUND_TRIP, str(prepared)],
            env=env, capture_output=True, text=True, check=False, timeout=120,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr[-2000:]
        assert "LOADED 2 12 torch.Size([3, 24, 24]) 1.0" in done.stdout
        assert 'The tag v3.0 names this state: LeRobotDataset("user/toy") loads it.' in done.stdout
        there, repository = hub.files("datasets", REPO), hub.repositories["datasets", REPO]
        card = there.pop("README.md").decode()
        there.pop(".gitattributes")
        assert there == content(prepared)
        assert any(path.startswith(f"videos/{CAMERA}/") for path in there)
        assert repository.tags == {"v3.0": repository.branches["main"]}
        assert repository.messages == ["initial commit", "First."]
        assert not repository.private
    assert before == {str(p): (p.stat().st_mtime_ns, p.stat().st_size) for p in prepared.rglob("*")}
    front = front_matter(card)
    assert front["tags"] == ["LeRobot", "cqn-data", "ur5e"]
    assert front["license"] == "apache-2.0"
    assert front["task_categories"] == ["robotics"]
    assert front["configs"] == [{"config_name": "default", "data_files": "data/*/*.parquet"}]
    assert "2 episodes, 12 steps at 10 fps" in card
    assert f"`{CAMERA}` 24x24 (video)" in card
    assert "2 of 2 episodes are successes" in card
    told = ["Dropped 1 episode (clumsy: episode 1).", "1 on the last step of every episode", "50% of the range added"]
    assert sorted(told, key=card.index) == told
    assert 'LeRobotDataset("user/toy")' in card
    assert "lerobot-train --policy.type=cqn --dataset.repo_id=user/toy" in card


def test_a_second_push_sends_only_what_changed(dataset, hub, capsys):
    push(dataset)
    known = len(hub.requests)
    push(dataset)
    assert writes(hub.requests[known:]) == []
    assert "nothing new; 8 were there already" in capsys.readouterr().out
    (dataset / "meta/notes.json").write_text("{}")
    (dataset / DATA).rename(dataset / "data/chunk-000/file-001.parquet")  # the same content needs no upload
    known = len(hub.requests)
    push(dataset)
    assert not [r for r in hub.requests[known:] if r.startswith("PUT")]
    assert "Removed 1 files that the dataset no longer has: data/chunk-000/file-000.parquet" in capsys.readouterr().err
    there, repository = hub.files("datasets", REPO), hub.repositories["datasets", REPO]
    assert content(dataset).items() <= there.items()
    assert DATA not in there
    assert repository.tags == {"v3.0": repository.branches["main"]}
    assert repository.messages[-1].startswith("cqn-data push: 2 episodes, 12 steps")


def test_hidden_files_and_left_over_pictures_stay_here(dataset, hub):
    for path in (".cache/huggingface/x", "images/top/frame.png", "meta/.tmp"):
        (dataset / path).parent.mkdir(parents=True, exist_ok=True)
        (dataset / path).write_text("x")
    (dataset / "LICENSE").write_text("mine")
    push(dataset)
    there = hub.files("datasets", REPO)
    assert not [p for p in there if ".cache" in p or p.startswith("images") or ".tmp" in p]
    assert there["LICENSE"] == b"mine"


AGAIN = "push again: cqn-data push --repo_id=user/toy --root="


@pytest.mark.parametrize(
    ("method", "path", "status", "said"),
    [
        ("POST", "/repos/create", 401, "The Hub does not accept the token (401): log in with `hf auth login`"),
        ("POST", "/commit/", 403, "No permission to write to user/toy (403), logged in as user"),
        ("GET", "/tree/", 404, "user/toy or its branch main is not on the Hub (404)"),
        ("POST", "/commit/", 409, "user/toy was changed by somebody else meanwhile (409)"),
        ("POST", "/commit/", 412, "user/toy was changed by somebody else meanwhile (412)"),
        ("POST", "/validate-yaml", 400, "The Hub refuses (400): As the test wants it"),
        ("POST", "/commit/", 413, "The Hub refuses (413): As the test wants it"),
        ("PUT", "/lfs/", 403, "No permission to write to user/toy (403)"),
        ("POST", "/preupload/", 500, "The Hub answers 500 again and again (As the test wants it)"),
        ("PUT", "/lfs/", 503, "The Hub answers 503 again and again"),
        ("PUT", "/lfs/", None, "The connection to the Hub broke off"),
        ("POST", "/tag/", 500, "The Hub answers 500 again and again"),
    ],
)
def test_each_failure_is_one_line_with_the_command_to_go_on(prepared, hub, capsys, method, path, status, said):
    hub.fail(method, path, status, times=10**6, after=1000)
    line = failed(capsys, prepared)
    assert said in line
    assert line.endswith(f"{AGAIN}{prepared}")
    hub.heal()
    push(prepared)
    there, repository = hub.files("datasets", REPO), hub.repositories["datasets", REPO]
    assert content(prepared).items() <= there.items()
    assert repository.tags == {"v3.0": repository.branches["main"]}
    assert len(repository.messages) == 2


@pytest.mark.parametrize(
    ("method", "path", "status", "times"),
    [
        ("POST", "/repos/create", 500, 2),
        ("POST", "/preupload/", 503, 2),
        ("PUT", "/lfs/", 500, 3),
        ("PUT", "/lfs/", None, 3),
        ("POST", "/commit/", 502, 3),
        ("POST", "/commit/", None, 2),
        ("POST", "/tag/", 504, 1),
    ],
)
def test_what_passes_is_tried_again(prepared, hub, method, path, status, times):
    hub.fail(method, path, status, times=times, after=1000)
    push(prepared)
    assert content(prepared).items() <= hub.files("datasets", REPO).items()
    assert len(hub.repositories["datasets", REPO].messages) == 2
    assert hub.waits == sorted(hub.waits)


def test_a_commit_whose_answer_is_lost_is_not_made_twice(prepared, hub):
    hub.fail("POST", "/commit/", done=True)
    push(prepared)
    assert len(hub.repositories["datasets", REPO].messages) == 2
    assert hub.waits == [1.0]


def test_a_push_that_broke_off_goes_on_where_it_was(prepared, hub, capsys, monkeypatch):
    monkeypatch.setattr("cqn_data.hub.files.BATCH_FILES", 1)
    video = next(p for p in content(prepared) if p.endswith(".mp4"))
    hub.fail("PUT", hashlib.sha256((prepared / video).read_bytes()).hexdigest(), None, times=10**6)
    line = failed(capsys, prepared)
    assert "files have arrived and are not sent again" in line
    assert set(hub.files("datasets", REPO)) == {".gitattributes"}  # nothing is shown by halves
    arrived, known = set(hub.stored), len(hub.requests)
    assert arrived
    hub.heal()
    push(prepared)
    sent_again = {r.rpartition("/")[2] for r in hub.requests[known:] if r.startswith("PUT")}
    assert not sent_again & arrived
    assert content(prepared).items() <= hub.files("datasets", REPO).items()


def test_ctrl_c_says_what_is_there(prepared, hub, capsys, monkeypatch):
    def interrupted(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(HfApi, "preupload_lfs_files", interrupted)
    push(prepared, code=130)
    said = capsys.readouterr().err
    assert "Interrupted: user/toy shows the old files or all of the new ones" in said
    assert f"Go on with: cqn-data push --repo_id=user/toy --root={prepared}" in said


def test_files_that_the_repository_ignores_are_missed(prepared, hub, capsys):
    hub.ignored = re.compile(r"\.mp4$")
    assert "1 files did not get into user/toy, videos/" in failed(capsys, prepared)


def test_another_name_space_an_unknown_token_or_none(prepared, hub, capsys, monkeypatch):
    said = failed(capsys, prepared, repo="somebody/toy")
    assert "No permission to write to somebody/toy (403), logged in as user" in said
    hub.connect(monkeypatch, token="hf_wrong")  # noqa: S106  # made up
    said = failed(capsys, prepared)
    assert "does not accept the token (401): log in with `hf auth login`" in said
    assert TOKEN not in said
    assert "hf_wrong" not in said
    hub.connect(monkeypatch, token=None)
    assert "Nobody is logged in to the Hub: run `hf auth login`" in failed(capsys, prepared)


def test_offline_mode_and_no_network(prepared, hub, capsys, monkeypatch):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    assert "HF_HUB_OFFLINE (or TRANSFORMERS_OFFLINE) is set" in failed(capsys, prepared)
    assert hub.requests == []
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", "http://127.0.0.1:9")
    assert "No connection to http://127.0.0.1:9 (" in failed(capsys, prepared)


def test_private_data_never_goes_to_a_public_repository(prepared, hub, capsys):
    push(prepared, "--private", repo="user/hidden")
    assert hub.repositories["datasets", "user/hidden"].private
    push(prepared, "--private", repo="user/hidden")
    hub.create("datasets", REPO)
    line = failed(capsys, prepared, "--private")
    assert "is there already and public" in line
    assert set(hub.files("datasets", REPO)) == {".gitattributes"}


def test_a_branch_leaves_main_and_the_tag_alone(prepared, hub, capsys):
    push(prepared, "--branch=filtered")
    repository = hub.repositories["datasets", REPO]
    assert set(hub.files("datasets", REPO)) == {".gitattributes"}
    assert content(prepared).items() <= hub.files("datasets", REPO, "filtered").items()
    assert repository.tags == {}
    assert 'LeRobotDataset("user/toy", revision="filtered")' in capsys.readouterr().out


MINE = "---\nlicense: cc-by-4.0\ntags: [mine]\npretty_name: Toy\n---\n\n# My toy\n\nWritten by hand.\n"


def test_a_card_of_a_person_is_kept_and_added_to(dataset, hub, capsys):
    (dataset / "README.md").write_text(MINE)
    push(dataset)
    assert "README.md keeps its text" in capsys.readouterr().err
    card = hub.files("datasets", REPO)["README.md"].decode()
    front = front_matter(card)
    assert front["license"] == "cc-by-4.0"
    assert front["pretty_name"] == "Toy"
    assert front["tags"] == ["mine", "LeRobot", "cqn-data"]
    assert card.index("Written by hand.") < card.index(START) < card.index("Dropped 1 episode") < card.index(END)
    assert (dataset / "README.md").read_text() == MINE
    (dataset / "README.md").unlink()  # edited in the browser, nothing in the folder
    hub.write("datasets", REPO, {"README.md": card.replace("by hand", "in the browser").encode()})
    push(dataset, "--license=mit")
    card = hub.files("datasets", REPO)["README.md"].decode()
    assert "Written in the browser." in card
    assert (card.count(START), front_matter(card)["license"]) == (1, "mit")
    (dataset / "README.md").write_text(MINE)
    push(dataset)
    assert "README.md on the Hub is replaced by the folder's" in capsys.readouterr().err
    known = len(hub.requests)
    push(dataset)
    assert writes(hub.requests[known:]) == []


def test_dry_run_shows_card_and_files_without_network_or_login(dataset, hub, capsys, monkeypatch):
    hub.connect(monkeypatch, token=None)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    push(dataset, "--dry_run")
    out = capsys.readouterr().out
    assert "## History" in out
    size = sum(map(len, content(dataset).values()))
    assert f"{(dataset / DATA).stat().st_size:,}" in out
    assert size < int(out.strip().splitlines()[-2].split()[-1].replace(",", "")) < size + 10_000
    assert out.strip().endswith("Dry run: nothing was sent to user/toy.")
    assert hub.requests == []


def test_datasets_that_are_not_whole_are_refused_before_anything_is_sent(dataset, hub, capsys, tmp_path):
    assert "meta/info.json not found" in failed(capsys, tmp_path / "nowhere")
    (dataset / "README.md").write_text("---\na: [\n---\n")
    assert "The front matter of README.md is not YAML" in failed(capsys, dataset)
    next((dataset / "videos").rglob("*.mp4")).unlink()
    assert "is missing; restore it" in failed(capsys, dataset)
    assert hub.requests == []


def test_folders_of_this_machine_in_the_history_are_named(dataset, hub, capsys):
    path = dataset / "meta/cqn_history.json"
    path.write_text(path.read_text().replace("clumsy", f"see {dataset}"))
    push(dataset)
    assert f"names a folder of this machine ({dataset})" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("--repo_id=toy", "Expected --repo_id=user/name"),
        ("--repo_id=a/b/c", "Expected --repo_id=user/name"),
        ("--repo_id=user/to y", "Expected --repo_id=user/name"),
        ("--repo_id=../toy", "Expected --repo_id=user/name"),
        ("--license=Apache 2", "Expected --license as on the Hub"),
        ("--tags=['']", "Expected --tags"),
        ("--branch=a..b", "Expected --branch"),
        ("--message='  '", "Expected --message"),
        ("--privat", "Did you mean '--private'?"),
    ],
)
def test_options_of_a_wrong_form(prepared, hub, capsys, option, said):
    assert said in failed(capsys, prepared, option)
    assert hub.requests == []


def test_a_file_that_goes_away_while_sending_is_named(dataset, hub, capsys, monkeypatch):
    store = HfApi.preupload_lfs_files

    def lose_one(*args, **kwargs):
        store(*args, **kwargs)
        (dataset / "meta/info.json").unlink()

    monkeypatch.setattr(HfApi, "preupload_lfs_files", lose_one)
    assert f"{dataset / 'meta/info.json'} cannot be read: No such file or directory." in failed(capsys, dataset)
