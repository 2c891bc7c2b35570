"""A kill at any moment of a save leaves a whole checkpoint behind `last`."""

import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from safetensors.torch import load_file

from cqn_train.agent import Agent
from cqn_train.replay.buffer import Replay
from cqn_train.replay.episode import Episode
from cqn_train.run.checkpoint import Counters, last_checkpoint, restore, save
from lerobot_cqn.configuration_cqn import CQNConfig
from lerobot_cqn.errors import DataError
from lerobot_cqn.learner import Learner
from lerobot_cqn.modeling_cqn import CQNPolicy
from lerobot_cqn.processor_cqn import make_cqn_pre_post_processors


class Killed(BaseException):
    """Stands in for a power cut: no handler of ours may catch it."""


_fuse: dict[str, int | None] = {"left": None}


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    left = _fuse["left"]
    if left is None or event not in ("os.rename", "os.remove", "os.rmdir", "os.link", "os.symlink", "os.mkdir"):
        return
    if left == 0:
        raise Killed
    _fuse["left"] = left - 1


@pytest.fixture(scope="module", autouse=True)
def _audit() -> None:
    sys.addaudithook(_hook)  # stays for good, and does nothing while the fuse is out


@pytest.fixture
def parts() -> tuple[Agent, Learner, Replay]:
    config = CQNConfig(
        preset="laptop_state", device="cpu", hidden_dim=4, feature_dim=2,
        input_features={"observation.state": PolicyFeature(FeatureType.STATE, (2,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
    )  # fmt: skip
    policy = CQNPolicy(config)
    replay = Replay(1, 3, 0.9)
    rng = np.random.default_rng(0)
    for _ in range(2):
        state = rng.normal(size=(5, 2)).astype(np.float32)
        action = rng.uniform(-1, 1, (4, 2)).astype(np.float32)
        replay.add(
            Episode(
                low_dim=state,
                pixels=(),
                action=action,
                reward=np.array([0, 0, 0, 1], np.float32),
                terminated=True,
                success=True,
            ),
            demo=True,
        )
    return Agent(policy, *make_cqn_pre_post_processors(config)), Learner(policy.model), replay


def saver(folder: Path, parts: tuple[Agent, Learner, Replay]) -> Callable[[int], Path]:
    agent, learner, replay = parts
    rng = np.random.default_rng(1)

    def write(steps: int) -> Path:
        learner.update(replay.sample(4, 4, rng))
        counters = Counters(env_steps=steps, episodes=1, updates=1)
        return save(folder, agent, learner, rng, counters, tables={"updates": 0}, run_config={})

    return write


def assert_whole(folder: Path, parts: tuple[Agent, Learner, Replay]) -> None:
    checkpoint = last_checkpoint(folder)
    agent, _, _ = parts
    policy = CQNPolicy.from_pretrained(checkpoint / "pretrained_model", config=agent.policy.config)
    counters, _ = restore(checkpoint, Learner(policy.model), np.random.default_rng())
    assert counters.episodes == 1


@pytest.mark.parametrize("steps", [10, 20], ids=["same step again", "next step"])
def test_a_kill_at_any_moment(steps: int, tmp_path: Path, parts: tuple[Agent, Learner, Replay]) -> None:
    generator = torch.get_rng_state()
    moment = 0
    while True:
        folder = tmp_path / str(moment)
        write = saver(folder, parts)
        write(10)
        _fuse["left"] = moment
        try:
            write(steps)
        except Killed:
            _fuse["left"] = None
            assert_whole(folder, parts)
            write(steps)  # and the next save finds its way through the rubble
            assert_whole(folder, parts)
            assert last_checkpoint(folder).resolve().name == f"{steps:06d}"
        else:
            break
        finally:
            _fuse["left"] = None
        shutil.rmtree(folder)
        moment += 1
    assert moment > 5
    assert sorted(p.name for p in (folder / "checkpoints").iterdir()) == sorted({"000010", f"{steps:06d}", "last"})
    torch.set_rng_state(generator)


def test_what_is_restored(tmp_path: Path, parts: tuple[Agent, Learner, Replay]) -> None:
    agent, learner, replay = parts
    rng = np.random.default_rng(5)
    for _ in range(3):
        learner.update(replay.sample(4, 4, rng))
    counters = Counters(env_steps=8, episodes=2, updates=3, offline_done=True, wall_s=1.5)
    save(tmp_path, agent, learner, rng, counters, tables={"updates": 12}, run_config={})
    expected_draws, expected_torch = rng.random(3), torch.rand(3)
    weights = load_file(last_checkpoint(tmp_path) / "pretrained_model" / "model.safetensors")
    policy = CQNPolicy.from_pretrained(last_checkpoint(tmp_path) / "pretrained_model", config=agent.policy.config)
    assert all(torch.equal(weights[key], value) for key, value in policy.state_dict().items() if key in weights)
    fresh, again = Learner(policy.model), np.random.default_rng(0)
    assert restore(last_checkpoint(tmp_path), fresh, again) == (counters, {"updates": 12})
    np.testing.assert_array_equal(again.random(3), expected_draws)
    assert torch.equal(torch.rand(3), expected_torch)
    # The same batch now makes the same update in both: the optimiser is where it was.
    batch = replay.sample(4, 4, np.random.default_rng(9))
    learner.update(batch)
    fresh.update(batch)
    for one, other in zip(agent.policy.parameters(), policy.parameters(), strict=True):
        assert torch.equal(one, other)


def test_the_two_newest_states_are_kept(tmp_path: Path, parts: tuple[Agent, Learner, Replay]) -> None:
    write = saver(tmp_path, parts)
    for steps in (10, 20, 20, 30):
        write(steps)
    folder = tmp_path / "checkpoints"
    assert sorted(p.parent.name for p in folder.glob("0*/pretrained_model")) == ["000010", "000020", "000030"]
    assert sorted(p.parent.name for p in folder.glob("0*/training_state")) == ["000020", "000030"]


def empty(path: Path) -> None:
    path.write_bytes(b"")


def half(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flipped(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 0xFF
    path.write_bytes(bytes(data))


@pytest.mark.parametrize("damage", [empty, half, Path.unlink])
@pytest.mark.parametrize(
    "name",
    ["training_state/optimizer.pt", "training_state/torch_rng.pt", "training_state/progress.json",
     "pretrained_model/model.safetensors", "pretrained_model/config.json", "pretrained_model/train_config.json"],
)  # fmt: skip
def test_a_damaged_checkpoint_is_told_of_and_the_one_before_taken(
    name: str, damage: Callable[[Path], None], tmp_path: Path, parts: tuple[Agent, Learner, Replay]
) -> None:
    write = saver(tmp_path, parts)
    for steps in (10, 20, 30):
        write(steps)
    damage(tmp_path / "checkpoints" / "000030" / name)
    said: list[str] = []
    assert last_checkpoint(tmp_path, said.append).name == "000020"
    assert len(said) == 1
    assert said[0].startswith("Warning: the checkpoint 000030 is damaged (")
    assert said[0].endswith("going on from 000020.")
    assert_whole(tmp_path, parts)
    write(25)  # the run goes on from there, and forgets the damaged state
    assert last_checkpoint(tmp_path).resolve().name == "000025"
    states = sorted(p.parent.name for p in (tmp_path / "checkpoints").glob("0*/training_state"))
    assert states == ["000020", "000025"]
    for steps in (20, 25):
        damage(tmp_path / "checkpoints" / f"{steps:06d}" / name)
    with pytest.raises(DataError, match=r"No checkpoint in .* is whole \(000025: .*000020: "):
        last_checkpoint(tmp_path)


def test_a_changed_byte_of_the_optimiser_is_noticed(tmp_path: Path, parts: tuple[Agent, Learner, Replay]) -> None:
    write = saver(tmp_path, parts)
    write(10)
    write(20)
    flipped(tmp_path / "checkpoints" / "000020" / "training_state" / "optimizer.pt")
    assert last_checkpoint(tmp_path).name == "000010"


def test_a_full_disk_leaves_the_checkpoint_before(
    tmp_path: Path, parts: tuple[Agent, Learner, Replay], monkeypatch: pytest.MonkeyPatch
) -> None:
    write = saver(tmp_path, parts)
    write(10)

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(OSError, match="No space left"):
        write(20)
    monkeypatch.undo()
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir()) == ["000010", "last"]
    assert_whole(tmp_path, parts)


def test_nothing_to_resume_is_said(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"Nothing to resume in .*expected checkpoints/last"):
        last_checkpoint(tmp_path)
