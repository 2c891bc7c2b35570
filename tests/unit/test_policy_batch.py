"""Two ways from a dataset to a batch must agree: LeRobot's loader with `CQNPolicy.to_batch`, and the replay."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_policy, make_pre_post_processors

from cqn_train.agent import Agent
from cqn_train.config import DatasetSettings
from cqn_train.replay.buffer import Replay
from cqn_train.replay.demonstrations import Demonstrations, load_metadata
from lerobot_cqn.configuration_cqn import CQNConfig
from lerobot_cqn.configuration_cqn_as import CQNASConfig
from lerobot_cqn.errors import ConfigError, DataError
from lerobot_cqn.modeling_cqn import CQNPolicy
from lerobot_cqn.schema import Batch, Observation

from ..toy_datasets import CAMERA, LENGTHS, SIDE, make_dataset

SMALL: dict[str, Any] = {"device": "cpu", "hidden_dim": 8, "feature_dim": 4, "encoder_channels": (4, 4)}
KINDS: dict[str, dict[str, Any]] = {
    "unrewarded": {},
    "rewarded": {"reward": True, "failed": (1,)},
    "filmed": {"camera": True, "reward": True, "failed": (2,), "environment_state": 2},
    "pixels": {"camera": True, "state": False},
    "one_number": {"dims": (1, 1), "reward": True},
}


@pytest.fixture(scope="module")
def datasets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("datasets")
    return {name: make_dataset(folder / name, **kind) for name, kind in KINDS.items()}


def make_agent(meta: LeRobotDatasetMetadata, kind: type[CQNConfig] = CQNConfig, **settings: Any) -> Agent:
    config = kind(preset="laptop_state", **SMALL, **settings)
    policy = make_policy(config, ds_meta=meta)
    return Agent(policy, *make_pre_post_processors(config, dataset_stats=meta.stats))


def loader_batch(root: Path, meta: LeRobotDatasetMetadata, agent: Agent) -> Batch:
    """All frames of the dataset, in order, the way lerobot-train gets them."""
    deltas = resolve_delta_timestamps(agent.policy.config, meta)
    dataset = LeRobotDataset("local/toy", root=root, delta_timestamps=deltas)
    items = [dataset[i] for i in range(len(dataset))]
    return agent.policy.to_batch(agent.preprocessor(torch.utils.data.default_collate(items)))


def replay_batch(root: Path, agent: Agent, n_step: int, stack: int, sequence: int = 1, fill: str = "mask") -> Batch:
    """The same steps from the replay."""
    replay = Replay(stack, n_step, agent.policy.config.settings.discount, sequence=sequence, fill=fill)
    for episode in Demonstrations(DatasetSettings("local/toy", str(root))).episodes(agent):
        replay.add(episode, demo=True)
    places = [(episode, step) for episode, length in enumerate(LENGTHS) for step in range(length)]
    return replay.transitions(*(np.array(column) for column in zip(*places, strict=True)))


def assert_same(one: Observation, other: Observation) -> None:
    assert (one.low_dim is None) == (other.low_dim is None)
    if one.low_dim is not None and other.low_dim is not None:
        torch.testing.assert_close(one.low_dim, other.low_dim, rtol=0, atol=1e-6)
    assert len(one.pixels) == len(other.pixels)
    for a, b in zip(one.pixels, other.pixels, strict=True):
        assert b.dtype == torch.uint8
        torch.testing.assert_close(a, b.float() / 255, rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("stack", "n_step"), [(1, 3), (3, 2), (2, 4), (3, 5)])
def test_both_ways_give_the_same_transitions(kind: str, stack: int, n_step: int, datasets: dict[str, Path]) -> None:
    root = datasets[kind]
    meta = load_metadata(DatasetSettings("local/toy", str(root)))
    agent = make_agent(meta, frame_stack=stack, n_step=n_step)
    loader, replay = loader_batch(root, meta, agent), replay_batch(root, agent, n_step, stack)
    assert loader.reward.shape == (sum(LENGTHS), 1)
    torch.testing.assert_close(loader.reward, replay.reward, rtol=0, atol=1e-6)
    torch.testing.assert_close(loader.discount, replay.discount, rtol=0, atol=1e-6)
    torch.testing.assert_close(loader.action.clamp(-1, 1), replay.action, rtol=0, atol=1e-6)
    assert torch.equal(loader.demo, replay.demo)
    assert_same(loader.observation, replay.observation)
    assert_same(loader.next_observation, replay.next_observation)


@pytest.mark.parametrize("fill", ["zeros", "last", "mask"])
@pytest.mark.parametrize(("kind", "sequence"), [("rewarded", 1), ("rewarded", 3), ("one_number", 4), ("unrewarded", 9)])
def test_both_ways_give_the_same_sequences(kind: str, sequence: int, fill: str, datasets: dict[str, Path]) -> None:
    root = datasets[kind]
    meta = load_metadata(DatasetSettings("local/toy", str(root)))
    agent = make_agent(meta, CQNASConfig, action_sequence=sequence, sequence_fill=fill)
    loader, replay = loader_batch(root, meta, agent), replay_batch(root, agent, 3, 1, sequence, fill)
    assert loader.action.shape == (sum(LENGTHS), sequence * agent.policy.action_dims)
    torch.testing.assert_close(loader.action.clamp(-1, 1), replay.action, rtol=0, atol=1e-6)
    assert (loader.real is None) == (replay.real is None) == (fill != "mask" or sequence == 1)
    if loader.real is not None and replay.real is not None:
        assert torch.equal(loader.real, replay.real)
        inside = sum(min(sequence, length - step) for length in LENGTHS for step in range(length))
        assert loader.real.sum() == inside * agent.policy.action_dims


def test_the_numbers_themselves(datasets: dict[str, Path]) -> None:
    """Episodes of 7 (success), 2 (failure) and 5 (success) steps, three-step returns, by hand."""
    root = datasets["rewarded"]
    meta = load_metadata(DatasetSettings("local/toy", str(root)))
    batch = loader_batch(root, meta, make_agent(meta, n_step=3, discount=0.5))
    reward = [0, 0, 0, 0, 0.25, 0.5, 1, 0, 0, 0, 0, 0.25, 0.5, 1]
    discount = [0.125, 0.125, 0.125, 0.125, 0, 0, 0, 0.25, 0.5, 0.125, 0.125, 0, 0, 0]
    assert batch.reward[:, 0].tolist() == reward
    assert batch.discount[:, 0].tolist() == discount


def test_imitation_reads_neither_rewards_nor_later_frames(datasets: dict[str, Path]) -> None:
    root = datasets["rewarded"]
    meta = load_metadata(DatasetSettings("local/toy", str(root)))
    agent = make_agent(meta, frame_stack=2, rl_loss_scale=0.0)
    batch = loader_batch(root, meta, agent)
    assert agent.policy.config.observation_delta_indices == [-1, 0]
    assert not batch.reward.any()
    assert not batch.discount.any()
    assert batch.demo.all()
    assert_same(batch.observation, replay_batch(root, agent, 3, 2).observation)


def test_a_history_built_while_acting_is_the_one_trained_on(datasets: dict[str, Path]) -> None:
    root = datasets["filmed"]
    meta = load_metadata(DatasetSettings("local/toy", str(root)))
    agent = make_agent(meta, frame_stack=3)
    trained_on = loader_batch(root, meta, agent).observation
    dataset = LeRobotDataset("local/toy", root=root)
    row = 0
    for length in LENGTHS:
        agent.policy.reset()
        for _ in range(length):
            frame = {k: v for k, v in dataset[row].items() if k.startswith("observation.")}
            seen = agent.policy.observe(agent.prepare(frame))
            assert_same_float(seen, trained_on, row)
            row += 1


def assert_same_float(seen: Observation, batch: Observation, row: int) -> None:
    assert seen.low_dim is not None
    assert batch.low_dim is not None
    torch.testing.assert_close(seen.low_dim[0], batch.low_dim[row], rtol=0, atol=1e-6)
    for a, b in zip(seen.pixels, batch.pixels, strict=True):
        assert a.shape == (1, 9, SIDE, SIDE)
        torch.testing.assert_close(a[0], b[row], rtol=0, atol=1e-6)


def test_a_policy_without_a_dataset_cannot_cut_windows(datasets: dict[str, Path]) -> None:
    root = datasets["rewarded"]
    meta = load_metadata(DatasetSettings("local/toy", str(root)))
    agent = make_agent(meta)
    orphan = Agent(CQNPolicy(agent.policy.config), agent.preprocessor, agent.postprocessor)
    with pytest.raises(ConfigError, match="cannot tell where episodes end"):
        loader_batch(root, meta, orphan)


def test_missing_and_misshapen_observations_are_named(datasets: dict[str, Path]) -> None:
    meta = load_metadata(DatasetSettings("local/toy", str(datasets["filmed"])))
    policy = make_agent(meta).policy
    complete = {
        "observation.state": torch.zeros(1, 3),
        "observation.environment_state": torch.zeros(1, 2),
        CAMERA: torch.zeros(1, 3, SIDE, SIDE),
    }
    for key in complete:
        with pytest.raises(DataError, match=f"lacks '{key}'"):
            policy.select_action({k: v for k, v in complete.items() if k != key})
    with pytest.raises(DataError, match=r"shape \(4,\), expected \(3,\)"):
        policy.select_action({**complete, "observation.state": torch.zeros(1, 4)})
    assert policy.select_action(complete).shape == (1, 4)
