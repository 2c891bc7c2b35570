"""What a person is told of the demonstrations, and the picture of the first batch."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from cqn_train.replay.buffer import Replay
from cqn_train.replay.episode import Episode
from cqn_train.run.first_look import draw_batch, save_batch, warnings_about


def demonstration(seed: int, *, still: float = 0.0, narrow: bool = False, success: bool = True) -> Episode:
    """60 steps of two joints and a gripper; a share of them still, actions at their bounds where they are narrow."""
    rng = np.random.default_rng(seed)
    moves = rng.uniform(0.2, 0.9, (60, 3)) * rng.choice([-1, 1], (60, 3))
    moves[: int(60 * still)] = 0
    state = np.concatenate([np.zeros((1, 3)), np.cumsum(0.02 * moves, axis=0)]).astype(np.float32)
    action = np.clip(moves * (4 if narrow else 1), -1, 1).astype(np.float32)
    action[:, 2] = 1  # a shut gripper is no bound
    reward = np.zeros(60, np.float32)
    reward[-1] = success
    return Episode(low_dim=state, pixels=(), action=action, reward=reward, terminated=success, success=success)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({}, None),
        ({"success": False}, "No demonstration ends in success"),
        ({"narrow": True}, "Action dimensions at their bounds in many steps: 0 ("),
        ({"still": 0.5}, "of the demonstrated steps stand still"),
    ],
)
def test_warnings(options: dict[str, bool | float], said: str | None) -> None:
    found = warnings_about([demonstration(seed, **options) for seed in range(8)])  # type: ignore[arg-type]
    assert len(found) == (said is not None), found
    assert said is None or said in found[0]


def test_where_the_environment_ends_nothing_is_lost() -> None:
    narrow = [demonstration(seed, narrow=True) for seed in range(8)]
    assert warnings_about(narrow, free=np.array([False, False, True])) == []
    assert "1 (" in warnings_about(narrow, free=np.array([False, True, True]))[0]


def test_objects_that_lie_still_are_no_pauses() -> None:
    episodes = [demonstration(seed) for seed in range(5)]
    for episode in episodes:
        assert episode.low_dim is not None
        objects = np.repeat(np.clip((np.arange(61) - 40) / 20, 0, 1)[:, None], 3, axis=1)  # carried in the last steps
        episode.low_dim[:, 2:] = 0.0
        object.__setattr__(episode, "low_dim", np.concatenate([episode.low_dim * 0.001, objects], axis=1))
    assert "stand still" in "".join(warnings_about(episodes))
    assert warnings_about(episodes, joints=3) == []


def test_no_demonstrations_no_warnings() -> None:
    assert warnings_about([]) == []


@pytest.mark.parametrize("views", [0, 2])
def test_the_picture_of_a_batch_shows_every_view_twice(tmp_path: Path, views: int) -> None:
    episode = demonstration(0)
    pixels = tuple(np.full((61, 3, 8, 8), 80 * (view + 1), np.uint8) for view in range(views))
    replay = Replay(2, 3, 0.9)
    replay.add(
        Episode(
            low_dim=episode.low_dim,
            pixels=pixels,
            action=episode.action,
            reward=episode.reward,
            terminated=True,
            success=True,
        ),
        demo=True,
    )
    batch = replay.sample(3, 2, np.random.default_rng(0))
    draw_batch(batch, tmp_path / "first_batch.png")
    picture = np.asarray(Image.open(tmp_path / "first_batch.png"))
    for view in range(views):
        tiles = (picture == 80 * (view + 1)).all(axis=-1).sum()
        assert tiles == 5 * 2 * 112 * 112
    assert (picture != 255).any()
    save_batch(batch, tmp_path / "batch.pt")
    stored = torch.load(tmp_path / "batch.pt", weights_only=True)
    assert torch.equal(stored["action"], batch.action)
