"""Parts of the collectors that need no Ray: what is kept on disk, what is compared, what is shown."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cqn_train.cluster import collector
from cqn_train.cluster.agreement import check_fit, check_versions
from cqn_train.cluster.collector import Collector, Description, Fit, versions
from cqn_train.cluster.connect import _is_loopback, _refuse_open
from cqn_train.cluster.overview import Overview
from cqn_train.cluster.spool import Spool
from cqn_train.config import RaySettings
from cqn_train.loop.acting import Finished, Turn
from cqn_train.replay.episode import Episode
from lerobot_cqn.errors import ConfigError


def finished(steps: int, views: int, state: bool, key: str = "run-1", **more: Any) -> Finished:
    rng = np.random.default_rng(steps)
    episode = Episode(
        low_dim=rng.normal(size=(steps + 1, 3)).astype(np.float32) if state else None,
        pixels=tuple(rng.integers(0, 256, (steps + 1, 3, 4, 4), dtype=np.uint8) for _ in range(views)),
        action=rng.normal(size=(steps, 2)).astype(np.float32), reward=rng.normal(size=steps).astype(np.float32),
        terminated=bool(steps % 2), success=bool(steps % 3), taught=((0, 1),), borders=(1,),
    )  # fmt: skip
    turn = Turn(number=7, seed=3, steps=12, key=key)
    return Finished(turn=turn, episode=episode, success=episode.success, discarded=False,
                    values=rng.normal(size=steps), **more)  # fmt: skip


def plain(one: Finished) -> dict[str, Any]:
    """All of it as values that can be compared; arrays with their types."""
    said = dataclasses.asdict(one)
    said |= said.pop("episode")
    said["pixels"] = dict(enumerate(said["pixels"]))
    flat = {f"pixels_{i}": view for i, view in said.pop("pixels").items()} | said
    return {k: (str(v.dtype), v.tolist()) if isinstance(v, np.ndarray) else v for k, v in flat.items()}


@given(steps=st.integers(2, 9), views=st.integers(0, 12), state=st.booleans())
def test_an_episode_comes_back_from_the_disk_as_it_went(
    tmp_path_factory: pytest.TempPathFactory, steps: int, views: int, state: bool
) -> None:
    spool = Spool(tmp_path_factory.mktemp("spool"))
    put = finished(steps, views, state or not views)
    spool.put(put)
    (found,) = spool
    assert plain(put) == plain(found)
    spool.drop(put.turn.key)
    spool.drop(put.turn.key)
    assert not list(spool)


def test_what_a_kill_left_half_written_is_no_episode(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    spool.put(finished(3, 1, True))
    whole = (tmp_path / "run-1.npz").read_bytes()
    (tmp_path / ".run-2.tmp").write_bytes(whole[: len(whole) // 2])
    assert [one.turn.key for one in spool] == ["run-1"]


ONE = Fit(fps=10, max_steps=50, limits={"pan": (-10.0, 10.0, 1.0)}, spans={"pan": 2000})


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"fps": 15}, "control steps a second: 15, and 10 of collector 2"),
        ({"max_steps": 60}, "steps an episode: 60, and 50"),
        ({"limits": {"tilt": (0.0, 1.0, 1.0)}}, "joints: tilt, and pan"),
        ({"limits": {"pan": (-10.0, 11.0, 1.0)}}, "'pan' may go from -10 to 11"),
        ({"spans": {"pan": 2300}}, "'pan' was calibrated over 2300 steps"),
    ],
)
def test_an_arm_that_differs_is_named(changed: dict[str, Any], said: str) -> None:
    check_fit(ONE, {})
    check_fit(dataclasses.replace(ONE, limits={"pan": (-10.1, 10.1, 1.2)}, spans={"pan": 2050}), {2: ONE, 5: ONE})
    with pytest.raises(ConfigError, match=said):
        check_fit(dataclasses.replace(ONE, **changed), {2: ONE, 5: ONE})


def test_ends_of_different_versions_are_named() -> None:
    check_versions(Description(host="arm", versions=versions(), bounds=None))
    with pytest.raises(ConfigError, match=r"arm has lerobot 0\.5\.0, the learner"):
        check_versions(Description(host="arm", versions=versions() | {"lerobot": "0.5.0"}, bounds=None))


@pytest.mark.parametrize(
    ("address", "token", "flag", "refused"),
    [
        ("127.0.0.1:6379", "", False, False), ("localhost:6379", "", False, False), ("[::1]:6379", "", False, False),
        ("10.8.0.1:6379", "", False, True), ("auto", "", False, True), ("10.8.0.1:6379", "token", False, False),
        ("10.8.0.1:6379", "", True, False), ("127.0.0.1.evil.example:6379", "", False, True),
    ],
)  # fmt: skip
def test_an_open_cluster_is_joined_only_on_purpose(
    address: str, token: str, flag: bool, refused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_AUTH_MODE", token)
    settings = RaySettings(actors=1, address=address, open_network=flag)
    assert not (_is_loopback(address) and refused)
    if refused:
        with pytest.raises(ConfigError, match="without a token"):
            _refuse_open(settings)
    else:
        _refuse_open(settings)


def test_an_arm_that_hears_nothing_of_its_learner_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """And no longer once it hears of it again."""
    said: list[str] = []
    here = SimpleNamespace(learning=said.append, take_corrected=dict)
    arm = Collector(0, {}, (), str(Path.cwd()), str(tmp_path))
    arm._here = here  # type: ignore[assignment]
    now = [100.0]
    monkeypatch.setattr(collector.time, "monotonic", lambda: now[0])

    def sleep(_: float) -> None:
        now[0] += 4.0
        arm._stopping = now[0] > 130.0

    monkeypatch.setattr(collector.time, "sleep", sleep)
    arm.pulse("update 3")
    arm._watch()
    assert said[0] == "update 3"
    assert said[1] == "no sign of the learner for 12 s: the arm holds, episodes are kept"
    assert len(said) > 3
    arm.pulse("update 4")
    assert said[-1] == "update 4"


def test_the_overview_asks_for_its_token(tmp_path: Path) -> None:
    pytest.importorskip("fastapi")
    from starlette.testclient import TestClient

    from cqn_train.cluster.overview import make_app

    overview = Overview()
    overview.phase("online", 100, 0)
    overview.advance(40, "episode 4")
    overview.advance(41, "")
    overview.message("<b>hello</b>")
    overview.arms([{"collector": 0, "host": "lab", "state": "running", "episodes": 2, "successes": 1, "page": ""}])
    with TestClient(make_app(overview, "a-token-of-this-test"), base_url="http://127.0.0.1") as client:
        assert client.get("/").status_code == 200
        assert client.get("/overview.js").status_code == 200
        assert client.get("/api/state").status_code == 401
        seen = client.get("/api/state", headers={"X-Token": "a-token-of-this-test"}).json()
    assert (seen["phase"], seen["done"], seen["total"], seen["note"]) == ("online", 41, 100, "episode 4")
    assert seen["lines"] == ["<b>hello</b>"]
    assert seen["arms"][0]["host"] == "lab"
