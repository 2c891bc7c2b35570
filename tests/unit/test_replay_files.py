"""The replay's files: what a kill leaves, how the ring goes round, and batches put together ahead."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cqn_train.replay import buffer as replay_module
from cqn_train.replay.buffer import Replay
from cqn_train.replay.episode import Episode
from cqn_train.replay.files import Journal, Place
from lerobot_cqn.errors import ConfigError, DataError
from lerobot_cqn.schema import Batch

from .test_replay import GAMMA, locate, make_episode

ROW = 2 * 4 + 3 * 4 + 4 + 3 * 16  # bytes: state, action, reward, one picture


def stored(replay: Replay) -> set[int]:
    """Numbers of the episodes that can still be sampled."""
    batch = replay.sample(600, 0, np.random.default_rng(0))
    return {locate(batch, row)[0] for row in range(600)}


def same(one: Batch, other: Batch) -> bool:
    pairs = [(one.observation, other.observation), (one.next_observation, other.next_observation)]
    numbers = all(torch.equal(getattr(one, n), getattr(other, n)) for n in ("action", "reward", "discount", "demo"))
    views = all(torch.equal(x, y) for a, b in pairs for x, y in zip(a.pixels, b.pixels, strict=True))
    return numbers and views and all(torch.equal(a.low_dim, b.low_dim) for a, b in pairs)  # type: ignore[arg-type]


def small(folder: Path | None, rows: int, demonstrations: int = 1) -> Replay:
    """Room for `rows` rows, four of them for each demonstration of three steps."""
    replay = Replay(2, 3, GAMMA, folder=folder, capacity_gib=rows * ROW / 2**30)
    for number in range(demonstrations):
        replay.add_demonstration(make_episode(number, 3, views=1))
    return replay


def test_a_later_process_finds_every_finished_episode(tmp_path: Path) -> None:
    first = small(tmp_path, 10_000)
    for number in range(1, 5):
        first.add(
            make_episode(number, 700 * number % 13 + 2, views=1), demo=number == 2, number=number - 1, note={"n": 1}
        )
    second = small(tmp_path, 10_000)
    places = second.reopen()
    assert [(p.number, p.demo, p.note) for p in places] == [(n, n == 1, {"n": 1}) for n in range(4)]
    rngs = [np.random.default_rng(3) for _ in range(2)]
    assert same(first.sample(50, 50, rngs[0]), second.sample(50, 50, rngs[1]))
    for replay in (first, second):  # and they go on in the same place
        replay.add(make_episode(9, 5, views=1), demo=False)
    assert same(first.sample(50, 50, rngs[0]), second.sample(50, 50, rngs[1]))


def test_pictures_lie_once_and_a_row_is_what_it_must_be(tmp_path: Path) -> None:
    replay = small(tmp_path, 5000)
    assert replay.bytes_per_step == ROW
    for number in range(1, 40):
        replay.add(make_episode(number, 50, views=1), demo=False)
    assert sum(p.stat().st_size for p in tmp_path.glob("*.bin")) <= 5000 * ROW


@given(st.lists(st.integers(1, 9), min_size=1, max_size=25), st.integers(14, 40))
def test_the_oldest_make_room_and_demonstrations_stay(lengths: list[int], rows: int) -> None:
    replay = small(None, rows)
    alive: dict[int, tuple[int, int]] = {}
    head = 4
    for number, length in enumerate(lengths, start=1):
        start = head if head + length + 1 <= rows else 4
        head = start + length + 1
        alive = {n: (a, b) for n, (a, b) in alive.items() if b <= start or a >= head} | {number: (start, head)}
        replay.add(make_episode(number % 2, length, views=1), demo=False, number=number)
        assert [p.number for p in replay._places] == [-1, *alive]
        assert replay.episodes == 1 + len(alive)


def test_what_a_kill_interrupted_is_lost_and_nothing_else(tmp_path: Path) -> None:
    first = small(tmp_path, 24)  # room for four episodes of four steps behind the demonstration
    for number in range(1, 6):  # the fifth lies where the first was
        first.add(make_episode(number, 4, views=1), demo=False, number=number - 1)
    assert stored(first) == {0, 2, 3, 4, 5}
    Journal(tmp_path / "episodes.jsonl").announce(9, 14)  # a sixth begins to overwrite the second, and is killed
    with (tmp_path / "episodes.jsonl").open("a") as file:
        file.write('{"episode": {"start": 9, "len')
    second = small(tmp_path, 24)
    assert [p.number for p in second.reopen()] == [2, 3, 4]
    assert stored(second) == {0, 3, 4, 5}
    second.add(make_episode(7, 4, views=1), demo=True, number=5)
    assert [p.number for p in small(tmp_path, 24).reopen()] == [2, 3, 4, 5]


def test_without_demonstrations_shapes_come_from_the_files(tmp_path: Path) -> None:
    first = Replay(1, 1, GAMMA, folder=tmp_path)
    first.add(make_episode(3, 6, views=1), demo=False)
    second = Replay(1, 1, GAMMA, folder=tmp_path)
    second.reopen()
    assert stored(second) == {3}


@pytest.mark.parametrize("what", ["dataset", "capacity", "journal"])
def test_files_that_do_not_fit_are_refused(tmp_path: Path, what: str) -> None:
    first = small(tmp_path, 2000)
    for number in (1, 2):
        first.add(make_episode(number, 4, views=1), demo=False)
    if what == "journal":
        lines = (tmp_path / "episodes.jsonl").read_text().splitlines()
        (tmp_path / "episodes.jsonl").write_text("\n".join([lines[0], "garbage", *lines[2:]]) + "\n")
    second = small(tmp_path, 3000 if what == "capacity" else 2000, demonstrations=2 if what == "dataset" else 1)
    said = "line 2 is damaged" if what == "journal" else "laid out for another dataset"
    with pytest.raises(DataError, match=said):
        second.reopen()


def test_what_can_never_fit_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"demonstrations need more than --replay\.capacity_gib"):
        small(None, 6, demonstrations=2)
    replay = small(None, 10)
    with pytest.raises(ConfigError, match="does not fit behind the demonstrations"):
        replay.add(make_episode(1, 6, views=1), demo=False)
    assert replay.episodes == 1


def test_batches_ahead_are_those_of_one_after_the_other_and_leave_the_generator_there() -> None:
    replay = Replay(2, 3, GAMMA)
    replay.add(make_episode(0, 30), demo=True)
    one, other = np.random.default_rng(1), np.random.default_rng(1)
    for batch in replay.batches(5, 8, 8, one):
        assert same(batch, replay.sample(8, 8, other))
    assert one.bit_generator.state == other.bit_generator.state
    early = replay.batches(5, 8, 8, one)
    for _ in range(2):
        next(early)
        replay.sample(8, 8, other)
    early.close()
    assert one.bit_generator.state == other.bit_generator.state
    assert list(replay.batches(0, 8, 8, one)) == []


def test_an_error_ahead_surfaces_at_the_next_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    replay = Replay(1, 1, GAMMA)
    replay.add(make_episode(0, 5), demo=True)
    batches = replay.batches(3, 2, 0, np.random.default_rng(0))
    monkeypatch.setattr(replay_module.Replay, "_observation", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        list(batches)


def test_uniform_over_steps_when_asked() -> None:
    replay = Replay(1, 1, GAMMA, by_step=True)
    for number, length in enumerate((2, 40, 8)):
        replay.add(make_episode(number, length), demo=True)
    batch = replay.sample(20_000, 0, np.random.default_rng(5))
    seen = np.bincount([locate(batch, row)[0] for row in range(20_000)], minlength=3)
    expected = 20_000 * np.array([2, 40, 8]) / 50
    assert ((seen - expected) ** 2 / expected).sum() < 13.8  # 2 degrees of freedom, 0.1 %


def test_the_journal_is_plain_lines(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "episodes.jsonl")
    place = Place(start=3, length=4, terminated=True, success=True, demo=False, number=7, note={"x": 1.5})
    journal.announce(3, 8)
    journal.complete(place)
    journal.announce(8, 12)
    assert list(journal.entries()) == [((3, 8), place), ((8, 12), None)]
    assert [list(json.loads(line)) for line in journal.path.read_text().splitlines()] == [
        ["writing"],
        ["episode"],
        ["writing"],
    ]


def test_a_first_episode_that_is_refused_decides_nothing() -> None:
    replay = Replay(1, 1, GAMMA)
    bad = make_episode(0, 3)
    bad.action[1] = np.nan
    with pytest.raises(DataError):
        replay.add(bad, demo=True)
    replay.add(
        Episode(
            low_dim=None,
            pixels=(),
            action=np.zeros((2, 1), np.float32),
            reward=np.zeros(2, np.float32),
            terminated=False,
            success=False,
        ),
        demo=False,
    )
    assert replay.episodes == 1


def run_of(folder: Path | None, count: int = 4) -> Replay:
    """A demonstration, then `count` failed episodes of the run, numbered from 0."""
    replay = small(folder, 10_000)
    for number in range(count):
        replay.add(make_episode(number + 1, 5 + number, views=1, terminated=False), demo=False, number=number)
    return replay


def at_the_end(replay: Replay, episode: int, length: int) -> set[tuple[float, float]]:
    """Reward and discount of the samples of an episode's last step."""
    batch = replay.sample(3000, 0, np.random.default_rng(0))
    rows = [row for row in range(3000) if locate(batch, row) == (episode, length - 1)]
    return {(float(batch.reward[row]), round(float(batch.discount[row]), 3)) for row in rows}


@pytest.mark.parametrize("reopened", [False, True])
def test_an_episode_that_is_corrected_earns_its_reward_and_ends(tmp_path: Path, reopened: bool) -> None:
    replay = run_of(tmp_path)
    assert replay.demonstrations == 1
    assert replay.correct(2, success=True, demo=True)
    assert replay.correct(1, success=True, demo=True)
    assert replay.correct(1, success=False, demo=False)  # a second thought
    if reopened:
        replay = small(tmp_path, 10_000)
        assert [(p.number, p.success, p.terminated) for p in replay.reopen()] == [
            (0, False, False), (1, False, True), (2, True, True), (3, False, False),
        ]  # fmt: skip
    assert replay.demonstrations == 2
    assert at_the_end(replay, 3, 7) == {(1.0, 0.0)}
    assert at_the_end(replay, 2, 6) == {(0.0, 0.0)}
    assert {discount for _, discount in at_the_end(replay, 4, 8)} == {GAMMA}  # only cut off, as before
    replay.add(make_episode(9, 5, views=1), demo=False, number=4)
    assert stored(replay) == {0, 1, 2, 3, 4, 9}


@pytest.mark.parametrize("reopened", [False, True])
def test_an_episode_that_is_forgotten_is_not_sampled_again(tmp_path: Path, reopened: bool) -> None:
    replay = run_of(tmp_path)
    assert replay.forget(1)
    assert not replay.forget(1)
    assert not replay.correct(1, success=True, demo=True)
    assert replay.correct(3, success=True, demo=True)  # right after it in the journal
    if reopened:
        replay = small(tmp_path, 10_000)
        replay.reopen()
    assert stored(replay) == {0, 1, 3, 4}
    replay.add(make_episode(9, 5, views=1), demo=False, number=4)
    assert stored(replay) == {0, 1, 3, 4, 9}


def test_what_has_made_room_cannot_be_corrected() -> None:
    replay = small(None, 14)
    for number in range(4):
        replay.add(make_episode(number + 1, 3, views=1), demo=False, number=number)
    assert not replay.correct(0, success=True, demo=True)
    assert replay.correct(3, success=True, demo=True)
