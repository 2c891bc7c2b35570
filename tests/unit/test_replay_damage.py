"""A replay with damaged files: said with what is gone and left, and gone on with only when that is asked for."""

import errno
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cqn_train.replay.buffer import Replay
from cqn_train.replay.files import Rows, reserve_all
from lerobot_cqn.errors import DataError, OutputError

from .test_replay import make_episode
from .test_replay_files import ROW, small

EPISODES = 6


def numbers(replay: Replay) -> list[int]:
    return [place.number for place in replay.places if place.number >= 0]


def written(folder: Path, demonstrations: int) -> None:
    replay = small(folder, 2000, demonstrations)
    for number in range(EPISODES):
        replay.add(make_episode(number % 2, 200, views=1), demo=False, number=number)


def there(folder: Path) -> Replay:
    """The replay of an earlier process, as a resumed run finds it: nothing is loaded yet."""
    return Replay(2, 3, 0.9, folder=folder, capacity_gib=2000 * ROW / 2**30)


def halve(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def halve_lines(path: Path) -> None:
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[: len(lines) // 2]))


def spoil_line(path: Path) -> None:
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join([*lines[:3], "{garbage\n", *lines[4:]]))


# What happens to which file, what is said, and how many of the six episodes are left.
DAMAGES: dict[str, tuple[str, Callable[[Path], None], str, int]] = {
    "journal halved": ("episodes.jsonl", halve_lines, "episodes.jsonl lacks lines; 3 of the run's 6", 3),
    "journal gone": ("episodes.jsonl", Path.unlink, "episodes.jsonl lacks lines; 6 of the run's 6", 0),
    "journal spoilt": ("episodes.jsonl", spoil_line, "line 4 is damaged", 5),
    "actions cut": ("action.bin", halve, "action.bin is cut off; ", 5),
    "states gone": ("low_dim.bin", Path.unlink, "low_dim.bin is missing; 6 of the run's 6", 0),
    "pictures cut": ("view_0.bin", halve, "view_0.bin is cut off; ", 5),
}  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("demonstrations", [0, 1])
def test_what_is_gone_is_said_and_accepted_only_on_request(tmp_path: Path, damage: str, demonstrations: int) -> None:
    name, spoil, said, _ = DAMAGES[damage]
    written(tmp_path, demonstrations)
    spoil(tmp_path / name)
    for _ in range(2):  # refusing changes nothing
        with pytest.raises(DataError, match=said) as raised:
            there(tmp_path).examine(range(EPISODES))
        assert "--replay.accept_loss=true" in str(raised.value)
        assert "\n" not in str(raised.value)


@pytest.mark.parametrize("damage", DAMAGES)
def test_it_goes_on_with_the_rest(tmp_path: Path, damage: str) -> None:
    name, spoil, _, most = DAMAGES[damage]
    written(tmp_path, 0)
    whole = there(tmp_path)
    whole.examine(range(EPISODES))
    assert len(whole.reopen()) == EPISODES
    spoil(tmp_path / name)
    lines: list[str] = []
    replay = there(tmp_path)
    replay.examine(range(EPISODES), accept_loss=True, say=lines.append)
    left = replay.reopen()
    assert len(left) <= most
    assert len(lines) == 1
    assert f"{len(left)} are left" in lines[0]
    replay.add(make_episode(1, 5, views=1), demo=False, number=EPISODES)
    assert numbers(replay) == [*(place.number for place in left), EPISODES]
    replay.sample(8, 0, np.random.default_rng(0))
    if damage != "journal spoilt":  # nothing is said twice
        again = there(tmp_path)
        again.examine(numbers(replay))
        assert [place.number for place in again.reopen()] == numbers(replay)


def test_rows_are_reserved_for_real(tmp_path: Path) -> None:
    """A hole in a file ends the process when it is written to on a full disk."""
    rows = Rows(tmp_path / "a.bin", (1000,), np.float32)
    rows.reserve(1000)
    status = (tmp_path / "a.bin").stat()
    assert status.st_blocks * 512 >= status.st_size == 4_000_000


@pytest.mark.parametrize("free", [0, 150, 10_000])
def test_a_full_disk_is_said_and_less_is_taken_where_that_is_enough(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, free: int
) -> None:
    real = os.posix_fallocate

    def limited(number: int, offset: int, length: int) -> None:
        if offset + length > free * 4:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(number, offset, length)

    monkeypatch.setattr(os, "posix_fallocate", limited)
    rows = Rows(tmp_path / "a.bin", (), np.float32)
    if not free:
        with pytest.raises(OutputError, match=r"needs 1 MiB on the disk and cannot have them: No space left"):
            reserve_all([rows], 1024, 100)
    else:
        assert reserve_all([rows], 1024, 100) == (100 if free < 1024 else 1024)
        rows.write(99, np.ones(1, np.float32))
