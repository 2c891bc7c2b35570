"""Corrections of a policy that one already has, for several types that LeRobot brings."""

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.factory import get_policy_class, make_policy, make_policy_config, make_pre_post_processors

import lerobot_policy_cqn  # noqa: F401  # registers our policies, as LeRobot's commands do
from cqn_train.agent import Agent
from cqn_train.config import DatasetSettings
from cqn_train.interfaces import Outcome
from cqn_train.replay.buffer import Replay
from cqn_train.replay.demonstrations import Demonstrations, load_metadata
from lerobot_cqn.configuration_cqn import CQNConfig
from lerobot_cqn.configuration_cqn_as import CQNASConfig
from lerobot_cqn.correction import AddBaseActionProcessorStep, Base, base_of
from lerobot_cqn.errors import ConfigError, DataError
from lerobot_cqn.schema import BASE_ACTION

from ..toy_datasets import LENGTHS, make_dataset

STATE, ENV, SMALL = "observation.state", "observation.environment_state", {"hidden_dim": 8, "feature_dim": 4}
ACT = {
    "chunk_size": 6, "n_action_steps": 3, "dim_model": 16, "n_heads": 2, "dim_feedforward": 16, "n_encoder_layers": 1,
    "use_vae": False,
}  # fmt: skip
BASES: dict[str, tuple[str, dict[str, Any]]] = {
    "act": ("act", ACT),  # plays three actions of each sequence
    "act_ensemble": ("act", {**ACT, "n_action_steps": 1, "temporal_ensemble_coeff": 0.01}),
    "cqn": ("cqn", {"preset": "laptop_state", "frame_stack": 3, **SMALL}),
    "cqn_as": ("cqn_as", {"preset": "laptop_state", "action_sequence": 3, **SMALL}),
    "drqv2": ("drqv2", {"preset": "laptop_state", **SMALL}),
}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of three short episodes with rewards, states and objects."""
    return make_dataset(tmp_path_factory.mktemp("data") / "toy", reward=True, environment_state=2)


@pytest.fixture(scope="module")
def bases(data: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Folders of untrained policies, as LeRobot saves them."""
    meta = load_metadata(DatasetSettings("local/toy", str(data)))
    folders = {}
    for name, (kind, sizes) in BASES.items():
        torch.manual_seed(0)
        config = make_policy_config(kind, device="cpu", push_to_hub=False, **sizes)
        policy = make_policy(config, ds_meta=meta)
        for part, weight in policy.named_parameters():
            if "head" in part:  # new heads of ours are zero, and no preference is no test
                torch.nn.init.normal_(weight, 0, 0.5)
        folders[name] = tmp_path_factory.mktemp(name)
        policy.save_pretrained(folders[name])
        for step in make_pre_post_processors(config, dataset_stats=meta.stats):
            step.save_pretrained(folders[name])
    return folders


def agent_on(base: Path, data: Path, **settings: Any) -> Agent:
    meta = load_metadata(DatasetSettings("local/toy", str(data)))
    config = CQNConfig(preset="laptop_state", device="cpu", base_path=str(base), **(SMALL | settings))
    policy: Any = make_policy(config, ds_meta=meta)
    return Agent(policy, *make_pre_post_processors(config, dataset_stats=meta.stats, dataset_meta=meta))


def frames(count: int, rows: int = 2) -> list[dict[str, torch.Tensor]]:
    rng = torch.Generator().manual_seed(3)
    return [
        {STATE: torch.randn(rows, 3, generator=rng), ENV: torch.randn(rows, 2, generator=rng)} for _ in range(count)
    ]


def executed(agent: Agent, seen: list[dict[str, torch.Tensor]], *, explore: bool = False) -> torch.Tensor:
    torch.manual_seed(5)
    agent.reset()
    return torch.stack([agent.postprocessor(agent.act(agent.prepare(f), explore=explore)[0]) for f in seen])


def alone(path: Path, seen: list[dict[str, torch.Tensor]]) -> torch.Tensor:
    """What LeRobot's own loop would do with the base."""
    config = PreTrainedConfig.from_pretrained(str(path), cli_overrides=["--device=cpu"])
    policy = get_policy_class(config.type).from_pretrained(str(path), config=config).eval()
    pre, post = make_pre_post_processors(config, pretrained_path=str(path))
    torch.manual_seed(5)
    policy.reset()
    with torch.inference_mode():  # as lerobot-eval
        return torch.stack([post(policy.select_action(pre(dict(f)))) for f in seen])


@pytest.mark.parametrize("kind", BASES)
def test_it_begins_as_the_base_exactly(kind: str, bases: dict[str, Path], data: Path) -> None:
    seen = frames(10)
    wanted = alone(bases[kind], seen)
    assert wanted.std() > 1e-3  # else any policy would do
    agent = agent_on(bases[kind], data)
    assert torch.equal(executed(agent, seen), wanted)
    assert torch.equal(executed(agent, seen), wanted)  # and in the next episode again


def random_heads(agent: Agent) -> None:
    for name, weight in agent.policy.model.named_parameters():
        if "head" in name:
            torch.nn.init.normal_(weight, 0, 0.5)


def test_corrections_are_no_larger_than_said(bases: dict[str, Path], data: Path) -> None:
    seen = frames(20)
    agent = agent_on(bases["act"], data, correction_range=0.2)
    random_heads(agent)
    away = executed(agent, seen, explore=True) - alone(bases["act"], seen)
    stats = load_metadata(DatasetSettings("local/toy", str(data))).stats["action"]
    reach = 0.2 * (np.asarray(stats["max"]) - np.asarray(stats["min"]))
    assert (away.abs() <= torch.from_numpy(reach) + 1e-5).all()
    assert (away.abs().amax((0, 1))[:-1] > 0).all()  # the last dimension never moves


def test_the_checkpoint_knows_its_base(bases: dict[str, Path], data: Path, tmp_path: Path) -> None:
    agent, seen = agent_on(bases["act"], data), frames(6)
    random_heads(agent)
    wanted = executed(agent, seen)
    for part in (agent.policy, agent.preprocessor, agent.postprocessor):
        part.save_pretrained(tmp_path)
    base_of.cache_clear()
    torch.testing.assert_close(alone(tmp_path, seen), wanted, rtol=0, atol=1e-6)


def test_demonstrations_are_the_corrections_that_lead_to_them(
    bases: dict[str, Path], data: Path, caplog: pytest.LogCaptureFixture
) -> None:
    settings = DatasetSettings("local/toy", str(data))
    agent = agent_on(bases["act"], data, correction_range=0.7)
    with caplog.at_level(logging.WARNING):
        episodes = Demonstrations(settings).episodes(agent)
    rows = Demonstrations(settings).dataset.hf_dataset.with_format("numpy")
    actions = np.stack(rows["action"])
    at = 0
    beyond = 0
    stats = load_metadata(settings).stats["action"]
    reach = 0.7 * (np.asarray(stats["max"]) - np.asarray(stats["min"]))
    fresh = Base(str(bases["act"]))
    for episode, length in zip(episodes, LENGTHS, strict=True):
        imitable = np.zeros(length, bool)
        for step in range(length):
            row = rows[at + step]
            seen = {key: torch.from_numpy(np.asarray(row[key], np.float32))[None] for key in (STATE, ENV)}
            base = fresh.act_apart(seen)[0].numpy()
            missing = actions[at + step] - base
            inside = (np.abs(missing) <= reach * 1.0005) | (reach == 0)  # where none is made, it is the base's
            made = inside & (reach > 0)
            np.testing.assert_allclose((episode.action[step] * reach)[made], missing[made], atol=1e-4)
            imitable[step] = inside.all()
        beyond += (~imitable).sum()
        flagged = np.ones(length, bool) if not episode.taught and imitable.all() else np.zeros(length, bool)
        for first, last in episode.taught:
            flagged[first:last] = True
        assert flagged.tolist() == imitable.tolist()
        at += length
    assert 0 < beyond < at  # else this test sees one side only
    assert f"{beyond} of {at} demonstrated steps lie beyond --policy.correction_range" in caplog.text
    replay = Replay(1, 3, 0.99)
    for episode in episodes:
        replay.add_demonstration(episode)
    batch = replay.sample(500, 500, np.random.default_rng(0))
    assert batch.demo[500:].all()
    assert 0 < batch.demo[:500].mean() < 1


def test_a_persons_command_is_learned_as_the_correction_to_it(bases: dict[str, Path], data: Path) -> None:
    agent = agent_on(bases["act"], data, correction_range=0.5)
    agent.reset()
    prepared = agent.prepare(frames(1, rows=1)[0])
    action, _ = agent.act(prepared, explore=False)
    sent = agent.postprocessor(action) + torch.tensor([0.01, -0.02, 0.01, 0.0])
    outcome = Outcome(frame={}, reward=0.0, terminated=False, truncated=False, success=False, sent=sent, taught=True)
    again = agent.postprocessor(agent.carried_out(action, outcome))
    torch.testing.assert_close(again, sent, rtol=0, atol=1e-5)


def test_the_critic_sees_what_the_base_does(bases: dict[str, Path], data: Path) -> None:
    agent = agent_on(bases["act"], data)
    assert agent.policy.low_dim_keys[-1] == BASE_ACTION
    prepared = agent.prepare(frames(1)[0])
    assert prepared[BASE_ACTION].shape == (2, agent.policy.action_dims)
    low_dim = agent.low_dim(prepared)
    assert low_dim is not None
    assert low_dim.shape[1] == 3 + 2 + agent.policy.action_dims


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"bins": 4}, "`bins` must be odd"), ({"correction_range": 0.0}, "`correction_range` must be in")],
)
def test_settings_that_cannot_be(settings: dict[str, Any], message: str, bases: dict[str, Path], data: Path) -> None:
    with pytest.raises(ConfigError, match=message):
        agent_on(bases["act"], data, **settings)


def test_a_base_that_is_not_there(data: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"No policy to correct at --policy.base_path=.*expected a `pretrained_model`"):
        agent_on(tmp_path, data).prepare(frames(1)[0])


def test_sequences_are_no_corrections(bases: dict[str, Path], data: Path) -> None:
    meta = load_metadata(DatasetSettings("local/toy", str(data)))
    config = CQNASConfig(preset="laptop_state", device="cpu", base_path=str(bases["act"]), **SMALL)
    make_policy(config, ds_meta=meta)
    with pytest.raises(ConfigError, match=r"Corrections are for --policy\.type=cqn"):
        make_pre_post_processors(config, dataset_stats=meta.stats, dataset_meta=meta)


def test_a_base_that_needs_more_than_there_is(bases: dict[str, Path]) -> None:
    with pytest.raises(DataError, match=r"needs 'observation.state' of shape \(3,\), and gets \(4,\)"):
        Base(str(bases["act"])).act({STATE: torch.zeros(1, 4), ENV: torch.zeros(1, 2)})
    with pytest.raises(DataError, match=r"needs 'observation.environment_state', and the observation has"):
        Base(str(bases["act"])).act({STATE: torch.zeros(1, 3)})
    assert PolicyFeature(FeatureType.STATE, (3,)) == Base(str(bases["act"])).config.input_features[STATE]


def test_a_base_of_another_arm(bases: dict[str, Path]) -> None:
    base_of(str(bases["act"])).act(frames(1)[0])
    step = AddBaseActionProcessorStep(str(bases["act"]), [0.0] * 6, [1.0] * 6)
    with pytest.raises(DataError, match="actions have 4 dimensions, the demonstrations' 6"):
        step({"action": torch.zeros(2, 6)})  # type: ignore[typeddict-item]
