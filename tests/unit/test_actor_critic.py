"""DrQ-v2 and DrQ-v2+ against plain versions of their losses, sample by sample in float64."""

from copy import deepcopy
from typing import Any

import pytest
import torch
from torch import Tensor

from lerobot_cqn.actor_critic import DrQv2Model
from lerobot_cqn.learner import Learner
from lerobot_cqn.schema import Batch, Observation
from lerobot_cqn.settings import DrQv2Settings

SIDE, P, DIMS, SIZE = 20, 3, 2, 6
SMALL = {
    "encoder_channels": (4, 6), "feature_dim": 8, "hidden_dim": 16, "atoms": 21, "shift_pixels": 0, "lr": 1e-3,
    "frame_stack": 1, "exploration_noise": 0.0, "rl_loss_scale": 0.7, "bc_loss_scale": 1.3,
}  # fmt: skip


def build(views: int = 0, low_dim: int = P, **changes: Any) -> DrQv2Model:
    torch.manual_seed(0)
    shapes = {str(view): (3, SIDE, SIDE) for view in range(views)}
    model = DrQv2Model(shapes, low_dim, DIMS, DrQv2Settings(**(SMALL | changes)))
    with torch.no_grad():  # a target that differs
        for weight in model.target_critic.parameters():
            weight.add_(0.05 * torch.randn_like(weight))
    return model


def random_batch(views: int = 0, low_dim: int = P, demo: str = "some") -> Batch:
    def observation() -> Observation:
        pixels = tuple(torch.randint(256, (SIZE, 3, SIDE, SIDE), dtype=torch.uint8) for _ in range(views))
        return Observation(pixels, torch.randn(SIZE, low_dim) if low_dim else None)

    flags = {"some": [1.0, 0.0, 1.0, 0.0, 0.0, 1.0], "none": [0.0] * SIZE}[demo]
    discount = torch.tensor([0.9, 0.0, 0.97, 0.97, 0.0, 1.0])[:, None]
    action = 2 * torch.rand(SIZE, DIMS) - 1
    return Batch(
        observation=observation(),
        action=action,
        reward=torch.randn(SIZE, 1),
        discount=discount,
        next_observation=observation(),
        demo=torch.tensor(flags)[:, None],
    )


class Plain:
    """The same weights, one sample and one atom at a time."""

    def __init__(self, model: DrQv2Model) -> None:
        self.s, self.model = model.settings, deepcopy(model).double()
        self.support = [
            self.s.v_min + i * (self.s.v_max - self.s.v_min) / (self.s.atoms - 1) for i in range(self.s.atoms)
        ]

    def mlp(self, net: Any, x: Tensor) -> Tensor:
        x = torch.relu(net[0].weight @ x + net[0].bias)
        x = torch.relu(net[2].weight @ x + net[2].bias)
        return net[4].weight @ x + net[4].bias

    def trunk(self, trunk: Any, observation: Observation, i: int) -> Tensor:
        parts = []
        if observation.pixels:
            features = []
            for encoder, view in zip(self.model.encoders, observation.pixels, strict=True):
                x = view[i : i + 1].double() / 255 - 0.5
                for convolution in encoder.convolutions:
                    x = torch.relu(convolution(x))
                features.append(x.flatten())
            parts.append((trunk.pixels, torch.cat(features)))
        if observation.low_dim is not None:
            parts.append((trunk.low_dim, observation.low_dim[i].double()))
        return torch.cat([torch.tanh(net[1](net[0].weight @ x + net[0].bias)) for net, x in parts])

    def actor(self, observation: Observation, i: int) -> Tensor:
        return torch.tanh(self.mlp(self.model.actor.head, self.trunk(self.model.actor.trunk, observation, i)))

    def critics(self, critic: Any, observation: Observation, i: int, action: Tensor) -> list[Tensor]:
        x = torch.cat([self.trunk(critic.trunk, observation, i), action])
        return [self.mlp(head, x) for head in critic.heads]

    def value(self, out: Tensor) -> Tensor:
        if not self.s.distributional:
            return out[0]
        return sum((p * z for p, z in zip(out.softmax(0), self.support, strict=True)), out.new_zeros(()))

    def loss(self, batch: Batch) -> dict[str, float]:
        critic = td_error = actor = imitation = 0.0
        demos = int(batch.demo.sum())
        for i in range(SIZE):
            reward, discount = float(batch.reward[i]), float(batch.discount[i])
            following = self.critics(
                self.model.target_critic, batch.next_observation, i, self.actor(batch.next_observation, i)
            )
            lower = min(following, key=lambda out: float(self.value(out)))
            for out in self.critics(self.model.critic, batch.observation, i, batch.action[i].double()):
                if self.s.distributional:
                    sure = reward + discount * float(self.value(lower))
                    target = (
                        self.projected(torch.ones(1, dtype=torch.float64), sure, 0.0, [0.0])
                        if self.s.two_hot_target
                        else self.projected(lower.softmax(0), reward, discount, self.support)
                    )
                    critic -= float(target @ out.log_softmax(0))
                    wanted = sum(float(p) * z for p, z in zip(target, self.support, strict=True))
                else:
                    wanted = float(reward + discount * lower[0])
                    critic += (float(out[0]) - wanted) ** 2
                td_error += abs(float(self.value(out)) - wanted) / 2
            mean = self.actor(batch.observation, i)
            values = self.critics(self.model.critic, batch.observation, i, mean)
            actor -= min(float(self.value(out)) for out in values)
            if batch.demo[i]:
                squares = sum(float((mean[d] - batch.action[i, d]) ** 2) for d in range(DIMS))
                imitation += squares if self.s.bc_sum else squares / DIMS
        return {
            "rl_loss": critic / SIZE, "td_error": td_error / SIZE, "actor_loss": actor / SIZE,
            "bc_action_loss": imitation / max(demos, 1),
        }  # fmt: skip

    def projected(self, probs: Tensor, reward: float, discount: float, atoms: Any) -> Tensor:
        step = self.support[1] - self.support[0]
        target = torch.zeros(self.s.atoms, dtype=torch.float64)
        for p, z in zip(probs.tolist(), atoms, strict=True):
            where = (min(max(reward + discount * z, self.s.v_min), self.s.v_max) - self.s.v_min) / step
            below = min(int(where + 1e-9), self.s.atoms - 1)
            target[below] += p * (1 - (where - below))
            if below + 1 < self.s.atoms:
                target[below + 1] += p * (where - below)
        return target


@pytest.mark.parametrize("distributional", [True, False])
@pytest.mark.parametrize(("views", "low_dim"), [(0, P), (1, 0), (2, P)])
@pytest.mark.parametrize("demo", ["some", "none"])
@pytest.mark.parametrize("as_authors", [True, False])
def test_losses(views: int, low_dim: int, distributional: bool, demo: str, as_authors: bool) -> None:
    model = build(views, low_dim, distributional=distributional, bc_sum=as_authors, two_hot_target=as_authors)
    batch = random_batch(views, low_dim, demo)
    loss, stats = model.loss(batch)
    expected = Plain(model).loss(batch)
    assert stats.keys() == {*expected, "loss"}
    for name, value in expected.items():
        assert float(stats[name]) == pytest.approx(value, rel=1e-4, abs=1e-6), name
    total = 0.7 * (expected["rl_loss"] + expected["actor_loss"]) + 1.3 * expected["bc_action_loss"]
    assert float(loss.detach()) == pytest.approx(total, rel=1e-4, abs=1e-6)


def gradients(model: DrQv2Model, batch: Batch) -> dict[str, bool]:
    """Whether anything reaches encoders, actor, critic and target critic."""
    model.zero_grad()
    model.loss(batch)[0].backward()  # type: ignore[no-untyped-call]
    parts = {"encoders": model.encoders, "actor": model.actor, "critic": model.critic, "target": model.target_critic}
    return {
        name: any(p.grad is not None and bool(p.grad.any()) for p in part.parameters()) for name, part in parts.items()
    }


def test_each_loss_reaches_its_own_networks() -> None:
    batch = random_batch(1, P)
    assert gradients(build(1), batch) == {"encoders": True, "actor": True, "critic": True, "target": False}
    only_imitation = gradients(build(1, rl_loss_scale=0.0), batch)
    assert only_imitation == {"encoders": True, "actor": True, "critic": False, "target": False}


def test_the_actors_gradient_does_not_train_the_critic() -> None:
    """The critic's gradient is that of its own loss alone: leaving the actor out changes nothing."""
    model, batch = build(1), random_batch(1, P)
    model.loss(batch)[0].backward()  # type: ignore[no-untyped-call]
    both = {n: p.grad.clone() for n, p in model.named_parameters() if p.grad is not None and not n.startswith("actor")}
    model.zero_grad()
    (0.7 * model._critic_loss(model.encode(batch.observation), batch)[0]).backward()
    alone = {n: p.grad for n, p in model.named_parameters() if p.grad is not None}
    assert both.keys() == alone.keys()
    assert all(torch.allclose(both[n], alone[n], atol=1e-7) for n in both)


def test_the_actor_climbs_and_the_demonstration_attracts() -> None:
    model, batch = build(bc_loss_scale=0.0), random_batch()
    features = model.encode(batch.observation)
    before = float(model.q_values(model.critic(features, model.actor(features))).amin(1).mean())
    optimiser = torch.optim.SGD(model.actor.parameters(), 0.05)
    for _ in range(20):
        optimiser.zero_grad()
        model._actor_loss(features, model.actor(features)).backward()  # type: ignore[no-untyped-call]
        optimiser.step()
    assert float(model.q_values(model.critic(features, model.actor(features))).amin(1).mean()) > before

    model = build(rl_loss_scale=0.0, weight_decay=0.0)
    learner = Learner(model)
    losses = [float(learner.update(batch)["bc_action_loss"]) for _ in range(60)]
    assert losses[-1] < 0.5 * losses[0]


def test_exploration_noise_and_its_bounds() -> None:
    model = build(exploration_noise=0.2)
    observation = Observation((), torch.randn(3000, P))
    mean, explored = model.act(observation)[0], model.act(observation, explore=True)[0]
    inside = mean.abs() < 0.3
    assert (explored - mean)[inside].std().item() == pytest.approx(0.2, rel=0.1)
    assert explored.abs().max() <= 1
    assert torch.equal(model.act(observation)[0], mean)
    noisy = model._noisy(torch.zeros(5000, DIMS))
    assert noisy.abs().max().item() == pytest.approx(0.3)  # Yarats et al. clip at 0.3


def test_the_gradient_passes_where_the_noisy_action_is_at_its_bound() -> None:
    model = build(exploration_noise=0.2)
    action = torch.full((50, DIMS), 0.999, requires_grad=True)
    noisy = model._noisy(action)
    assert noisy.max() <= 1
    noisy.sum().backward()  # type: ignore[no-untyped-call]
    assert torch.equal(action.grad, torch.ones_like(action))


def test_the_target_follows() -> None:
    model = build(tau=0.25)
    name = "heads.0.0.weight"
    target, online = (dict(c.named_parameters())[name].clone() for c in (model.target_critic, model.critic))
    model.update_target()
    assert torch.allclose(dict(model.target_critic.named_parameters())[name], 0.75 * target + 0.25 * online)
    assert {id(a) for a, _ in model.averaged()} == {id(model.target_critic)}
