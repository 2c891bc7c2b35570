"""`cqn-data review`: what it shows is what `cqn-data run` does, and what is decided is on disk at once."""

import json
import time

import numpy as np
import pytest

from cqn_data.cli import main
from cqn_data.disk.source import open_source
from cqn_data.review.decided import Desk
from lerobot_cqn.errors import ConfigError, DataError

from .data_recording import LENGTHS, TOP, column, last_line, run
from .recordings import only, write

pytest.importorskip("fastapi", reason="needs the extra [page]")
pytest.importorskip("httpx", reason="needs the extra [dev]")

from fastapi.testclient import TestClient

from cqn_data.review.app import Review, make_app
from cqn_data.review.recording import Recording

TOKEN = "a-token-of-the-test"  # noqa: S105
EVERYTHING = [
    (0, {"success": False}), (0, {"head": 3, "tail": 2}), (1, {"task": "Put it  down."}), (2, {"threshold": 0.15}),
    (2, {"head": 4}),
]  # fmt: skip


def at_desk(root, recipe, start=0.05):
    """A review of the recording with its decisions in `recipe`."""
    recording = Recording(open_source("local/src", str(root)))
    desk = Desk(recipe, "local/src", recording.lengths, recording.recorded, start)
    return Review(recording, desk, "local/src", str(root))


def visitor(review):
    return TestClient(make_app(review, TOKEN), base_url="http://127.0.0.1:8000", headers={"X-Token": TOKEN})


@pytest.fixture
def review(recording, tmp_path):
    return at_desk(recording, tmp_path / "seen.yaml")


@pytest.fixture
def client(review):
    with visitor(review) as client:
        yield client


def decide(client, index, changes, status=200):
    answer = client.post("/api/decide", json={"episode": index, "changes": changes})
    assert answer.status_code == status, answer.text
    return answer.json()


def frames_left(client, episodes):
    """Steps that stay by the page, as (episode, frame)."""
    left = []
    for index in episodes:
        looked = client.get(f"/api/pauses/{index}").json()
        gone = {first + k for first, length in looked["runs"] for k in range(length)}
        stays = [f for f in range(looked["start"], looked["stop"]) if f not in gone]
        assert looked["kept"] == len(stays)
        left += [(index, f) for f in stays]
    return left


def test_what_the_page_shows_is_what_the_recipe_does(review, client, recording, tmp_path):
    for index, changes in EVERYTHING:
        state = decide(client, index, changes)
    shown = frames_left(client, range(3))
    assert state["total"] == {"episodes": 3, "kept": len(shown)}
    assert 0 < len(shown) < sum(LENGTHS) - 9
    done = run("run", recording, tmp_path / "done", recipe=[str(review.desk.recipe)])
    written = [column(tmp_path / "done", f"source.{name}_index") for name in ("episode", "frame")]
    assert shown == list(zip(*(w.reshape(-1).tolist() for w in written), strict=True))
    ends = [int(done.meta.episodes[i]["dataset_to_index"]) - 1 for i in range(3)]
    rewards = column(tmp_path / "done", "next.reward").reshape(-1)
    assert np.flatnonzero(rewards).tolist() == ends[1:]  # the first one failed
    assert [str(done[end]["task"]) for end in ends] == ["go", "Put it down.", "go"]


def test_what_is_dropped_is_in_no_other_step_of_the_recipe(review, client, recording, tmp_path):
    for index, changes in [*EVERYTHING, (2, {"drop": True})]:
        decide(client, index, changes)
    shown = frames_left(client, [0, 1])
    done = run("run", recording, tmp_path / "done", recipe=[str(review.desk.recipe)])
    assert len(done) == len(shown)
    assert done.meta.total_episodes == 2


def test_a_new_end_takes_the_reward_with_it(recording, tmp_path):
    run("label", recording, tmp_path / "labelled", "--failed=[2]")
    review = at_desk(tmp_path / "labelled", tmp_path / "seen.yaml", start=None)
    with visitor(review) as client:
        decide(client, 1, {"tail": 5})
    done = run("run", tmp_path / "labelled", tmp_path / "done", recipe=[str(review.desk.recipe)])
    rewards = column(tmp_path / "done", "next.reward").reshape(-1)
    assert np.flatnonzero(rewards).tolist() == [LENGTHS[0] - 1, LENGTHS[0] + LENGTHS[1] - 6]
    assert len(done) == sum(LENGTHS) - 5


def test_a_moving_threshold_shows_without_deciding(client):
    before = client.get("/api/state").json()
    fine, coarse = (client.get(f"/api/pauses/0?threshold={t}").json()["kept"] for t in (1e-4, 0.5))
    assert coarse < fine <= LENGTHS[0]
    assert client.get("/api/state").json() == before
    after = client.post("/api/threshold", json={"threshold": 0.5, "on": True}).json()
    assert after["kept"][0] == coarse
    assert client.post("/api/threshold", json={"threshold": 0.5, "on": False}).json()["kept"] == list(LENGTHS)


def test_decisions_are_on_disk_at_once_and_go_on(review, client, recording, tmp_path):
    for index, changes in EVERYTHING:
        state = decide(client, index, changes)
    again = at_desk(recording, tmp_path / "seen.yaml")
    assert again.desk.decided == review.desk.decided
    with visitor(again) as other:
        assert other.get("/api/state").json()["recipe"] == state["recipe"]
    assert [p.name for p in tmp_path.glob(".*")] == []


def test_every_change_can_be_taken_back(review, client):
    states = [client.get("/api/state").json()]
    for index, changes in [*EVERYTHING, (1, {"drop": True})]:
        states.append(decide(client, index, changes))
    for expected in reversed(states[:-1]):
        assert client.post("/api/undo", json={}).json() == expected
        assert json.loads(review.desk.file.read_text())["episodes"] == expected["episodes"]
    assert client.post("/api/undo", json={}).json() == states[0]


@pytest.mark.parametrize(
    ("index", "changes", "status"),
    [
        (3, {"drop": True}, 422), (-1, {"drop": True}, 422), (0, {"drop": 1}, 422), (0, {"head": 2.5}, 422),
        (0, {"weight": 1}, 422), (0, {"threshold": -1.0}, 422), (0, {"head": LENGTHS[0] - 1}, 409),
        (0, {"tail": -1}, 409), (0, {"task": 5}, 422), (0, {"success": "yes"}, 422),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_refused_in_a_line_and_changes_nothing(client, index, changes, status):
    before = client.get("/api/state").json()
    answer = decide(client, index, changes, status)
    assert answer["error"]
    assert "\n" not in answer["error"]
    assert client.get("/api/state").json() == before


def test_without_the_token_nothing_but_the_empty_page_is_shown(review):
    with TestClient(make_app(review, TOKEN), base_url="http://127.0.0.1:8000") as stranger:
        assert stranger.get("/").status_code == 200
        for path in ("/api/state", "/api/recording", "/api/episode/0", "/api/pauses/0", f"/api/film/0/{TOP}"):
            assert stranger.get(path).status_code == 401, path
        assert stranger.post("/api/run", json={"new_repo_id": "", "new_root": ""}).status_code == 401


def test_films_are_the_files_as_they_are_in_parts(review, client, recording):
    path = review.recording.source.video_path(1, TOP)
    part = client.get(f"/api/film/1/{TOP}", headers={"Range": "bytes=10-29"})
    assert (part.status_code, part.content) == (206, path.read_bytes()[10:30])
    assert client.get(f"/api/film/1/{TOP}").content == path.read_bytes()
    assert client.get("/api/film/1/..%2f..%2fmeta%2finfo.json").status_code == 404


def test_pictures_show_the_step_that_was_asked_for(client):
    import io

    from PIL import Image

    answer = client.get(f"/api/pictures/1/{TOP}?first=7")
    picture = np.asarray(Image.open(io.BytesIO(answer.content)), float)
    half = picture.shape[1] // 2
    assert abs(picture[:, :half].mean() - (20 + 7 * 7)) < 4
    assert abs(picture[:, half:].mean() - 120) < 4
    strip = client.get(f"/api/pictures/0/{TOP}?count=5&height=24")
    assert Image.open(io.BytesIO(strip.content)).size == (5 * 24, 24)
    assert strip.headers["X-Frames"] == "0,5,10,14,19"
    assert client.get(f"/api/pictures/0/{TOP}?first=99").status_code == 404


def test_the_page_runs_the_recipe_and_says_how_it_went(review, client, tmp_path):
    assert (
        "nothing to run" in _run(at_desk(review.root, tmp_path / "empty.yaml", start=None), tmp_path / "none")["error"]
    )
    decide(client, 0, {"drop": True})
    given = {"new_repo_id": "local/dst", "new_root": str(tmp_path / "done")}
    assert client.post("/api/run", json=given).json()["errand"]["running"]
    deadline = time.monotonic() + 120
    while (errand := client.get("/api/state").json()["errand"])["running"]:
        assert time.monotonic() < deadline
        time.sleep(0.1)
    assert errand["code"] == 0, errand
    assert "Wrote local/dst" in errand["lines"][-1]
    assert open_source("local/dst", str(tmp_path / "done")).meta.total_episodes == 2
    assert "exists already" in client.post("/api/run", json=given).json()["error"]


def _run(review, target):
    with visitor(review) as client:
        return client.post("/api/run", json={"new_repo_id": "local/dst", "new_root": str(target)}).json()


def test_a_recording_without_states_can_be_labelled(tmp_path):
    write(tmp_path / "src", only("action"))
    review = at_desk(tmp_path / "src", tmp_path / "seen.yaml", start=None)
    with visitor(review) as client:
        shown = client.get("/api/recording").json()
        assert (shown["pauses"], shown["cameras"]) == (None, [])
        assert client.get("/api/episode/1").json()["states"] == []
        state = decide(client, 1, {"success": False})
    assert state["kept"] == [60, 60]
    assert review.desk.steps() == [{"label": {"failed": [1]}}]


def test_decisions_are_not_taken_for_those_about_another_recording(recording, tmp_path):
    at_desk(recording, tmp_path / "seen.yaml").desk.change(0, drop=True)
    run("drop", recording, tmp_path / "two", "--episodes=[0]")
    with pytest.raises(ConfigError, match="with 3 episodes, not about 'local/src' as it is now"):
        at_desk(tmp_path / "two", tmp_path / "seen.yaml")
    (tmp_path / "mine.yaml").write_text("steps: [{label: {all: true}}]\n")
    with pytest.raises(ConfigError, match="no review wrote it"):
        at_desk(recording, tmp_path / "mine.yaml")
    (tmp_path / "seen.json").write_text("{")
    with pytest.raises(DataError, match="damaged"):
        at_desk(recording, tmp_path / "seen.yaml")


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("--recipe=seen.json", "Expected --recipe=FILE.yaml"), ("--recipe=nowhere/seen.yaml", "there is no folder"),
        ("--token=short", "expected at least 8"), ("--port=99999", "expected 1 to 65535"),
        ("--root=nothing", "not found"),
    ],
)  # fmt: skip
def test_bad_options_end_in_a_line(recording, tmp_path, monkeypatch, capsys, option, said):
    monkeypatch.chdir(tmp_path)
    given = ["--repo_id=local/src", *([] if "root" in option else [f"--root={recording}"]), option]
    assert main(["review", *given]) == 2
    assert said in last_line(capsys)
