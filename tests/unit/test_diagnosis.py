"""TD error and gradients by kind of transition, against the losses taken apart by hand; and what they leave alone."""

import numpy as np
import pytest
import torch

from cqn_train.loop.diagnosis import diagnose, shown_in
from cqn_train.replay.buffer import Replay
from cqn_train.replay.episode import Episode
from cqn_train.run.metrics import FORCES, KINDS
from lerobot_cqn.actor_critic import DrQv2Model
from lerobot_cqn.critic import CQNModel
from lerobot_cqn.distributional import expectation
from lerobot_cqn.settings import CQNSettings, DrQv2Settings

SMALL = {"hidden_dim": 16, "feature_dim": 8, "atoms": 5, "frame_stack": 1}
P, D = 3, 2


def episode(success, seed):
    rng = np.random.default_rng(seed)
    reward = np.zeros(6, np.float32)
    reward[-1] = success
    return Episode(
        low_dim=rng.normal(size=(7, P)).astype(np.float32), pixels=(),
        action=rng.uniform(-1, 1, (6, D)).astype(np.float32), reward=reward, terminated=success, success=success,
    )  # fmt: skip


@pytest.fixture
def replay():
    replay = Replay(1, 3, 0.99)
    for seed in range(2):
        replay.add_demonstration(episode(True, seed))
    replay.add(episode(True, 2), demo=True, number=0)
    replay.add(episode(False, 3), demo=False, number=1)
    return replay


def model(kind=CQNModel, **given):
    torch.manual_seed(0)
    settings = CQNSettings(**SMALL, **given) if kind is CQNModel else DrQv2Settings(**SMALL, **given)
    made = kind({}, P, D, settings)
    for parameter in made.parameters():  # a new critic has no preference: give it one
        parameter.data.add_(0.1 * torch.randn_like(parameter))
    return made


def test_columns_are_the_losses_taken_apart(replay):
    cqn, seed = model(rl_loss_scale=0.5), 4
    row = diagnose(cqn, replay, seed)
    rng = np.random.default_rng(seed)  # the same transitions, by the sentence "128 of each kind, in this order"
    for kind, members in zip(KINDS, ([0, 1], [2], [3]), strict=True):
        drawn = rng.choice(np.array(members), 128)
        batch = replay.transitions(drawn, rng.integers(0, np.full(128, 6)))
        cqn.zero_grad()
        target = cqn.td_target(cqn.encode(batch.next_observation), batch.reward, batch.discount)
        total, stats = cqn.loss(batch)
        (0.5 * _rl(cqn, batch, target)).backward()
        norm = torch.cat([p.grad.flatten() for p in cqn.critic.parameters() if p.grad is not None]).norm()
        assert row[f"rl_gradient_{kind}"] == pytest.approx(float(norm), rel=1e-4)
        cqn.zero_grad()
        total.backward()
        whole = torch.cat([p.grad.flatten() for p in cqn.critic.parameters() if p.grad is not None]).norm()
        assert row[f"imitation_gradient_{kind}"] + row[f"rl_gradient_{kind}"] >= float(whole) * 0.999
        assert (row[f"imitation_gradient_{kind}"] == 0) is (kind == "failures")
        assert row[f"td_error_{kind}"] == pytest.approx(float(stats["td_error"]))
        predicted = _taken(cqn, batch)
        by_hand = (cqn.q_values(predicted) - expectation(target, cqn.support)).abs().mean()
        assert row[f"td_error_{kind}"] == pytest.approx(float(by_hand), rel=1e-5)


def _taken(cqn, batch):
    from lerobot_cqn.discretisation import encode
    from lerobot_cqn.losses import take_bin

    indices = encode(batch.action, cqn.settings.levels, cqn.settings.bins)
    logits = cqn.evaluate(cqn.critic, cqn.precompute(cqn.critic, cqn.encode(batch.observation)), indices)
    return take_bin(logits, indices)[..., 0, :]


def _rl(cqn, batch, target):
    return -(target * _taken(cqn, batch).log_softmax(-1)).sum(-1).mean()


@pytest.mark.parametrize("kind", [CQNModel, DrQv2Model])
def test_nothing_of_training_changes(replay, kind):
    made = model(kind)
    before = {name: value.clone() for name, value in made.state_dict().items()}
    settings, random = made.settings, torch.get_rng_state()
    first = diagnose(made, replay, 1)
    assert diagnose(made, replay, 1) == first
    assert made.settings == settings
    assert torch.equal(torch.get_rng_state(), random)
    assert all(torch.equal(value, before[name]) for name, value in made.state_dict().items())
    assert all(p.grad is None for p in made.parameters())
    assert set(first) == {f"{n}_{k}" for k in KINDS for n in FORCES}
    assert all(np.isfinite(value) for value in first.values())


def test_what_is_switched_off_or_missing_has_no_columns(replay):
    assert not [name for name in diagnose(model(rl_loss_scale=0.0), replay, 0) if not name.startswith("imitation")]
    assert not [name for name in diagnose(model(bc_loss_scale=0.0), replay, 0) if name.startswith("imitation")]
    empty = Replay(1, 3, 0.99)
    assert diagnose(model(), empty, 0) == {}
    empty.add(episode(False, 0), demo=False, number=0)
    assert {name.rpartition("_")[2] for name in diagnose(model(), empty, 0)} == {"failures"}


def test_what_is_shown_is_the_datasets_alone(replay):
    assert len(shown_in(replay).states) == 2 * 6
    assert len(shown_in(Replay(1, 3, 0.99)).states) == 0
