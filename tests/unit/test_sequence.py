"""Action sequences: how they are filled, valued, and played as one action a step."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lerobot.configs.types import FeatureType, PolicyFeature
from torch import Tensor

from cqn_train.agent import Agent
from cqn_train.interfaces import Outcome
from cqn_train.replay.recorder import Recorder
from lerobot_cqn.configuration_cqn_as import CQNASConfig
from lerobot_cqn.critic import CQNModel
from lerobot_cqn.errors import ConfigError
from lerobot_cqn.learner import Learner
from lerobot_cqn.modeling_cqn_as import CQNASPolicy
from lerobot_cqn.processor_cqn_as import make_cqn_as_pre_post_processors
from lerobot_cqn.schema import Batch, Observation
from lerobot_cqn.sequence import CQNASModel, OpenLoop, TemporalEnsemble, filled
from lerobot_cqn.settings import CQN_AS_PRESETS, CQNASSettings, CQNSettings, resolve

P, D = 3, 2
SMALL: dict[str, Any] = {"hidden_dim": 16, "feature_dim": 8, "atoms": 11, "frame_stack": 1}


def model_of(**given_: Any) -> CQNASModel:
    """A small model whose heads are random, so that it has preferences."""
    torch.manual_seed(0)
    model = CQNASModel({}, P, D, CQNASSettings(**(SMALL | given_)))
    for critic in (model.critic, model.target_critic):
        for name, weight in critic.named_parameters():
            if "head" in name:
                torch.nn.init.normal_(weight, 0, 0.5)
    return model


def policy_of(**given_: Any) -> CQNASPolicy:
    """A policy with that model."""
    config = CQNASConfig(
        preset="laptop_state", device="cpu", **(SMALL | given_),
        input_features={"observation.state": PolicyFeature(FeatureType.STATE, (P,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (D,))},
    )  # fmt: skip
    policy = CQNASPolicy(config)
    policy.model.load_state_dict(model_of(**given_).state_dict())
    return policy


def frame(seed: int, rows: int = 1) -> dict[str, Tensor]:
    return {"observation.state": torch.randn(rows, P, generator=torch.Generator().manual_seed(seed))}


def batch_of(model: CQNModel, size: int = 6, real: Tensor | None = None) -> Batch:
    torch.manual_seed(1)

    def look() -> Observation:
        return Observation((), torch.randn(size, P * model.settings.frame_stack))

    return Batch(
        observation=look(), action=2 * torch.rand(size, model.critic.shape.entries) - 1, reward=torch.rand(size, 1),
        discount=torch.full((size, 1), 0.9), next_observation=look(), demo=torch.ones(size, 1), real=real,
    )  # fmt: skip


# -- one action a step -----------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(
    steps=st.integers(1, 6),
    length=st.integers(1, 14),
    gain=st.sampled_from([0.0, 0.01, 0.5]),
    resets=st.sets(st.integers(1, 13), max_size=2),
    seed=st.integers(0, 1000),
)
def test_the_ensemble_is_the_weighted_mean_of_what_was_said_about_a_step(
    steps: int, length: int, gain: float, resets: set[int], seed: int
) -> None:
    rng = torch.Generator().manual_seed(seed)
    # Zeros are said, too: whether there is a prediction is not read off its numbers.
    sequences = torch.randn(length, 2, steps, D, generator=rng).round(decimals=0)
    ensemble = TemporalEnsemble(steps, gain)
    began = 0
    for now in range(length):
        if now in resets:
            ensemble.reset()
            began = now
        assert ensemble.due
        ensemble.plan(sequences[now])
        said = [sequences[then][:, now - then] for then in range(began, now + 1) if now - then < steps]
        weights = [2.718281828459045 ** (-gain * i) for i in range(len(said))]
        wanted = sum((w * a for w, a in zip(weights, said, strict=True)), torch.zeros(2, D)) / sum(weights)
        torch.testing.assert_close(ensemble.step(), wanted, rtol=1e-5, atol=1e-6)


def test_an_open_loop_plays_each_sequence_to_its_end() -> None:
    player, played, planned = OpenLoop(), [], 0
    sequences = torch.randn(3, 1, 4, D)
    for _ in range(10):
        if player.due:
            player.plan(sequences[planned])
            planned += 1
        played.append(player.step())
    assert planned == 3
    assert torch.equal(torch.cat(played), sequences.reshape(-1, D)[:10])
    player.reset()
    assert player.due


@pytest.mark.parametrize("ensemble", [True, False])
def test_an_episode_begins_without_what_was_said_before(ensemble: bool) -> None:
    policy = policy_of(temporal_ensemble=ensemble, action_sequence=4)
    fresh = policy.select_action(frame(5))
    for forget in (policy.reset, policy.forget_plan):
        for seed in range(3):
            policy.select_action(frame(seed))
        forget()
        policy._queue.clear()
        assert torch.equal(policy.select_action(frame(5)), fresh)


def test_what_a_pause_or_a_person_came_between_is_not_played() -> None:
    policy = policy_of(action_sequence=4, frame_stack=2)
    chunk = policy_of(action_sequence=4, frame_stack=2)
    for seed in range(3):
        policy.select_action(frame(seed))
        chunk.observe(frame(seed))
    mixed = policy.select_action(frame(3))
    alone = chunk.predict_action_chunk(frame(3))[:, 0]
    assert not torch.equal(mixed, alone)  # else this test could not tell
    policy.forget_newest()  # a pause: another frame takes the place of this one
    chunk.forget_newest()
    assert torch.equal(policy.select_action(frame(4)), chunk.predict_action_chunk(frame(4))[:, 0])
    policy.forget_plan()  # a person drove
    assert torch.equal(policy.select_action(frame(6)), chunk.predict_action_chunk(frame(6))[:, 0])


def test_the_loop_says_where_another_drove_and_where_a_pause_lay() -> None:
    policy, alone = policy_of(action_sequence=4), policy_of(action_sequence=4)
    agent = Agent(policy, *make_cqn_as_pre_post_processors(policy.config))
    recorder = Recorder(agent)

    def step(seed: int, *, taught: bool = False, skipped: bool = False) -> None:
        prepared = agent.prepare(frame(seed))
        if not len(recorder):
            recorder.observe(prepared, frame(seed))
        action, _ = agent.act(prepared, explore=False)
        outcome = Outcome(
            frame=frame(seed + 1), reward=0.0, terminated=False, truncated=False, success=False, sent=action,
            taught=taught, skipped=skipped,
        )  # fmt: skip
        executed = agent.carried_out(action, outcome)
        following = agent.prepare(outcome.frame)
        if skipped:
            recorder.retake(following, outcome.frame, 0.0)
            agent.retake(first=not len(recorder))
        else:
            recorder.step(executed, 0.0, taught=taught)
            recorder.observe(following, outcome.frame)

    for seed, what in enumerate(["", "", "taught", "", "skipped", "skipped", "", ""]):
        step(seed, taught=what == "taught", skipped=what == "skipped")
        if what:  # what was planned before is gone
            chosen = agent.act(agent.prepare(frame(90)), explore=False)[0]
            assert torch.equal(chosen, alone.predict_action_chunk(frame(90))[:, 0])
            agent.policy.forget_plan()
    episode = recorder.episode(terminated=True, success=False)
    assert (len(episode), episode.taught, episode.borders) == (6, ((2, 3),), (4,))


@pytest.mark.parametrize("ensemble", [True, False])
def test_noise_is_on_the_action_of_the_step_and_inside_the_bounds(ensemble: bool) -> None:
    policy = policy_of(temporal_ensemble=ensemble, exploration_noise=0.5, action_sequence=3)
    quiet = policy_of(temporal_ensemble=ensemble, exploration_noise=0.5, action_sequence=3)
    differences = []
    for seed in range(40):
        noisy, _ = policy.act(frame(seed, rows=5), explore=True)
        still, _ = quiet.act(frame(seed, rows=5))
        assert noisy.abs().max() <= 1
        differences.append((noisy - still)[still.abs() < 0.2])
    # Noise on the sequences would be averaged by the ensemble, and repeated by it from step to step.
    assert 0.35 < torch.cat(differences).std() < 0.6


def test_lerobots_chunk() -> None:
    policy = policy_of(action_sequence=5)
    chunk = policy.predict_action_chunk(frame(0, rows=3))
    assert chunk.shape == (3, 5, D)
    assert chunk.abs().max() <= 1
    assert policy.config.action_delta_indices == [0, 1, 2, 3, 4]


# -- what fills a sequence -------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(
    inside=st.lists(st.tuples(st.integers(1, 5), st.booleans()), min_size=1, max_size=6),
    fill=st.sampled_from(["zeros", "last", "mask"]),
    cuts=st.booleans(),
)
def test_filled_sequences(inside: list[tuple[int, bool]], fill: str, cuts: bool) -> None:
    lengths = torch.tensor([length for length, _ in inside])
    flags = torch.arange(5) < lengths[:, None]
    actions = torch.randn(len(inside), 5, D)
    cut = torch.tensor([[c] for _, c in inside]) if cuts else None
    action, real = filled(actions, flags, fill, cut)
    for row, (length, was_cut) in enumerate(inside):
        counts = [True] * length + [fill != "mask" and not (cuts and was_cut)] * (5 - length)
        assert (real is None and all(counts)) or (
            real is not None and real[row].view(5, D).tolist() == [[float(c)] * D for c in counts]
        )
        beyond = action[row].view(5, D)[length:]
        assert torch.equal(action[row].view(5, D)[:length], actions[row, :length])
        assert torch.equal(beyond, torch.zeros_like(beyond) if fill == "zeros" else actions[row, length:])


@pytest.mark.parametrize("changes", [{}, {"distributional": False}, {"centralized_critic": True}], ids=str)
def test_what_is_masked_is_not_learned_from(changes: dict[str, Any]) -> None:
    """A sequence of three of which two count is worth as much as one of two."""
    model = model_of(action_sequence=3, **changes)
    # Two steps only: the same weights, without those of the third step's one-hot.
    short = model_of(action_sequence=2, **changes)
    columns = torch.ones(model.critic.advantage.first.weight.shape[1], dtype=torch.bool)
    columns[model.critic.shape.feature_size + D + 2] = False
    state = {k: v[:, columns] if k.endswith("first.weight") else v for k, v in model.state_dict().items()}
    short.load_state_dict(state)
    real = torch.tensor([1.0] * (2 * D) + [0.0] * D).expand(6, -1)
    masked = batch_of(model, real=real)
    loss, stats = model.loss(masked)
    wanted, wanted_stats = short.loss(replace(masked, action=masked.action[:, : 2 * D], real=None))
    torch.testing.assert_close(loss, wanted, rtol=1e-5, atol=1e-6)
    for name, value in wanted_stats.items():
        torch.testing.assert_close(stats[name], value, rtol=1e-5, atol=1e-6)
    other = masked.action.clone()
    other[:, 2 * D :] = -other[:, 2 * D :]
    assert torch.equal(model.loss(replace(masked, action=other))[0], loss)
    # Nothing is masked: the plain mean, gradients and all.
    everything = torch.ones(6, 3 * D)
    gradients = []
    for flags in (None, everything):
        model.zero_grad()
        model.loss(replace(masked, real=flags))[0].backward()  # type: ignore[no-untyped-call]
        gradients.append(torch.cat([p.grad.flatten() for p in model.parameters() if p.grad is not None]))
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-4, atol=1e-7)


def test_a_sequence_of_one_is_still_not_cqn() -> None:
    parameters = {name for name, _ in model_of(action_sequence=1).critic.named_parameters()}
    plain = {name for name, _ in CQNModel({}, P, D, CQNSettings(**SMALL)).critic.named_parameters()}
    assert plain < parameters
    assert all("gru" in name for name in parameters - plain)


# -- numbers ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("preset", CQN_AS_PRESETS)
def test_presets_learn(preset: str) -> None:
    sizes = {"hidden_dim": 16, "frame_stack": 1, "shift_pixels": 0}
    model = CQNASModel({}, P, D, resolve(CQNASSettings, CQN_AS_PRESETS, preset, sizes))
    learner, before = Learner(model), model.critic.advantage.head.weight.clone()
    stats = learner.update(batch_of(model))
    assert all(torch.isfinite(value) for value in stats.values())
    assert not torch.equal(model.critic.advantage.head.weight, before)


@pytest.mark.parametrize(("interval", "updates"), [(1, 3), (2, 5), (3, 3), (4, 3)])
def test_the_target_moves_every_so_many_updates_also_after_a_restart(interval: int, updates: int) -> None:
    model = model_of(target_interval=interval, tau=1.0, action_sequence=2)
    for update in range(1, updates + 1):
        for weight in model.critic.parameters():
            weight.data.add_(0.01)
        model.update_target()
        again = model_of(target_interval=interval, tau=1.0, action_sequence=2)
        again.load_state_dict(model.state_dict())
        model = again
        same = torch.equal(model.critic.advantage.head.weight, model.target_critic.advantage.head.weight)
        assert same == (update % interval == 0)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("action_sequence", 0, "`action_sequence` must be 1 to 64, got 0"),
        ("gru_layers", 0, "`gru_layers` must be 1 to 8"),
        ("pixel_projection_layers", -1, "`pixel_projection_layers` must be 0 to 8"),
        ("ensemble_gain", -0.1, "`ensemble_gain` must be at least 0"),
        ("target_interval", 0, "`target_interval` must be at least 1"),
        ("sequence_fill", "ones", "sequence_fill"),
    ],
)
def test_ranges(field: str, value: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        CQNASConfig(device="cpu", **{field: value})
