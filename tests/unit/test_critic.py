"""Acting, the target critic, the learner, and what each setting changes."""

from copy import deepcopy
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from lerobot_cqn.critic import CQNModel
from lerobot_cqn.discretisation import encode, snap
from lerobot_cqn.errors import ConfigError
from lerobot_cqn.learner import Learner, NonFiniteLossError
from lerobot_cqn.losses import margin_loss, take_bin
from lerobot_cqn.schema import Batch, Observation
from lerobot_cqn.settings import PRESETS, CQNSettings, resolve

from .test_oracle import SMALL, P, build, random_batch


def weights(model: CQNModel) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in model.state_dict().items()}


def new_critic(**changes: object) -> CQNModel:
    settings = CQNSettings(frame_stack=1, hidden_dim=16, feature_dim=8, **changes)  # type: ignore[arg-type]
    return CQNModel({}, P, 4, settings)


# -- acting --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("levels", "bins"), [(1, 17), (3, 5), (4, 3), (2, 4)])
def test_actions_are_deterministic_bounded_and_representable(levels: int, bins: int) -> None:
    model = build(1, P, 4, levels=levels, bins=bins)
    observation = random_batch(model, 1, P).observation
    action, q = model.act(observation)
    assert action.shape == (6, 4)
    assert q.shape == (6,)
    assert action.abs().max() <= 1
    assert torch.equal(action, snap(action, levels, bins))
    again, q_again = model.act(observation)
    assert torch.equal(action, again)
    assert torch.equal(q, q_again)


def test_batch_size_does_not_change_the_action() -> None:
    model = build(1, P, 4)
    observation = random_batch(model, 1, P).observation
    assert observation.low_dim is not None
    alone = Observation(tuple(view[:1] for view in observation.pixels), observation.low_dim[:1])
    assert torch.equal(model.act(alone)[0], model.act(observation)[0][:1])


def test_new_critic_explores_every_bin_and_is_deterministic_otherwise() -> None:
    model = new_critic(levels=2, bins=3, exploration_noise=0.0)
    observation = Observation((), torch.randn(400, P))
    torch.manual_seed(0)
    explored, _ = model.act(observation, explore=True)
    values, counts = explored.unique(return_counts=True)
    assert len(values) == 9
    assert counts.min() > 120  # 1600 choices over 9 actions
    first, q = model.act(observation)
    assert torch.equal(first, model.act(observation)[0])
    assert len(first.unique()) == 1
    assert torch.allclose(q, torch.zeros(400), atol=1e-6)  # uniform over [-1, 1]


def test_exploring_keeps_clear_preferences() -> None:
    model = build(0, P, 4, exploration_noise=0.0)
    observation = random_batch(model, 0, P).observation
    assert torch.equal(model.act(observation, explore=True)[0], model.act(observation)[0])


def test_exploration_noise_has_its_size_and_leaves_representable_actions() -> None:
    noisy = build(0, P, 4, exploration_noise=0.1)
    observation = Observation((), torch.randn(2000, P * noisy.settings.frame_stack))
    action, greedy = noisy.act(observation, explore=True)[0], noisy.act(observation)[0]
    inside = greedy.abs() < 0.6
    assert (action - greedy)[inside].std().item() == pytest.approx(0.1, rel=0.1)
    s = noisy.settings
    assert torch.equal(snap(action, s.levels, s.bins), action)
    assert action.abs().max() <= 1


def test_random_bins_can_be_switched_off() -> None:
    model = new_critic(random_bin_below=0.0, exploration_noise=0.0)
    assert len(model.act(Observation((), torch.randn(50, P)), explore=True)[0].unique()) == 1


@pytest.mark.parametrize(("act_with", "used", "unused"), [
    ("target", "target_critic", "critic"), ("online", "critic", "target_critic"),
])  # fmt: skip
def test_act_with_names_the_critic_that_acts(act_with: str, used: str, unused: str) -> None:
    model = build(0, P, 4, act_with=act_with)
    observation = random_batch(model, 0, P).observation
    action, _ = model.act(observation)

    def disturb(critic: str) -> Tensor:
        with torch.no_grad():
            for stream in (getattr(model, critic).advantage, getattr(model, critic).value):
                stream.head.weight.neg_()
                stream.head.bias.neg_()
        return model.act(observation)[0]

    assert torch.equal(disturb(unused), action)
    assert not torch.equal(disturb(used), action)


# -- speed options -------------------------------------------------------------------------------------------


def test_channels_last_gives_the_same_results() -> None:
    plain, last = build(2, P, 3, channels_last=False), build(2, P, 3, channels_last=True)
    batch = random_batch(plain, 2, P)
    assert torch.equal(plain.act(batch.observation)[0], last.act(batch.observation)[0])
    first, _ = plain.loss(batch)
    second, _ = last.loss(batch)
    assert float(first) == pytest.approx(float(second), rel=1e-5)


def test_bf16_gives_close_results() -> None:
    plain, half = build(1, P, 3), build(1, P, 3, bf16=True)
    batch = random_batch(plain, 1, P, "all")
    loss, _ = plain.loss(batch)
    half_loss, _ = half.loss(batch)
    assert half_loss.dtype == torch.float32
    assert float(half_loss) == pytest.approx(float(loss), rel=0.05)
    loss.backward()  # type: ignore[no-untyped-call]
    half_loss.backward()  # type: ignore[no-untyped-call]
    pairs = [(a.grad, b.grad) for a, b in zip(plain.parameters(), half.parameters(), strict=True) if a.requires_grad]
    first = torch.cat([a.flatten() for a, _ in pairs if a is not None])
    second = torch.cat([b.flatten() for _, b in pairs if b is not None])
    assert torch.cosine_similarity(first, second, dim=0) > 0.95


# -- learning ------------------------------------------------------------------------------------------------


def test_target_moves_by_tau_exactly() -> None:
    model = build(0, P, 2, tau=0.25)
    before = weights(model)
    model.update_target()
    for name, value in model.state_dict().items():
        expected = before[name]
        if name.startswith("target_critic."):
            expected = 0.75 * before[name] + 0.25 * before[name.removeprefix("target_")]
        assert torch.allclose(value, expected, atol=1e-7, rtol=1e-6), name


def test_new_target_equals_the_online_critic() -> None:
    model = new_critic()
    for (name, online), target in zip(model.critic.named_parameters(), model.target_critic.parameters(), strict=True):
        assert torch.equal(online, target), name
        assert not target.requires_grad


@pytest.mark.parametrize("where", ["reward", "observation", "next_observation"])
def test_non_finite_loss_leaves_everything_untouched(where: str) -> None:
    model = build(0, P, 2)
    learner = Learner(model)
    good = random_batch(model, 0, P)
    learner.update(good)
    before, state = weights(model), learner.state_dict()["state"][0]["exp_avg"].clone()
    nan = Observation((), torch.full((6, P), float("nan")))
    broken: Batch = replace(good, **{where: torch.full((6, 1), float("nan")) if where == "reward" else nan})
    with pytest.raises(NonFiniteLossError, match="finite"):
        learner.update(broken)
    for name, value in model.state_dict().items():
        assert torch.equal(value, before[name]), name
    assert torch.equal(learner.state_dict()["state"][0]["exp_avg"], state)
    assert all(torch.isfinite(value) for value in learner.update(good).values())


def test_learner_restores_its_state() -> None:
    first, second = build(0, P, 2), build(0, P, 2)
    batch = random_batch(first, 0, P)
    learner, other = Learner(first), Learner(second)
    learner.update(batch)
    second.load_state_dict(first.state_dict())
    other.load_state_dict(deepcopy(learner.state_dict()))  # torch shares the tensors it is given
    learner.update(batch)
    other.update(batch)
    for name, value in first.state_dict().items():
        assert torch.equal(value, second.state_dict()[name]), name


def test_updates_lower_the_loss() -> None:
    model = build(0, P, 2)
    learner, batch = Learner(model), random_batch(model, 0, P)
    losses = [float(learner.update(batch)["loss"]) for _ in range(60)]
    assert losses[-1] < 0.5 * losses[0]


def test_next_observation_gives_no_gradient() -> None:
    model = build(0, P, 2, bc_loss_scale=0.0)
    batch = random_batch(model, 0, P)
    assert batch.next_observation.low_dim is not None
    batch.next_observation.low_dim.requires_grad_()
    model.loss(batch)[0].backward()  # type: ignore[no-untyped-call]
    assert batch.next_observation.low_dim.grad is None
    assert all(p.grad is None for p in model.target_critic.parameters())


# -- each setting changes what it says ------------------------------------------------------------------------


def stats(**changes: object) -> tuple[float, dict[str, float]]:
    model = build(0, P, 2, **changes)
    torch.manual_seed(1)
    loss, parts = model.loss(random_batch(model, 0, P))
    return float(loss), {name: float(value) for name, value in parts.items()}


def test_loss_is_the_weighted_sum_of_its_parts() -> None:
    loss, parts = stats(rl_loss_scale=0.7, bc_loss_scale=1.3)
    expected = 0.7 * parts["rl_loss"] + 1.3 * (parts["bc_margin_loss"] + parts["bc_dominance_loss"])
    assert loss == pytest.approx(expected, rel=1e-6)


def test_rl_off_is_imitation_alone() -> None:
    loss, parts = stats(rl_loss_scale=0.0, bc_loss_scale=1.0)
    assert set(parts) == {"loss", "bc_margin_loss", "bc_dominance_loss"}
    assert loss == pytest.approx(parts["bc_margin_loss"] + parts["bc_dominance_loss"])


def test_imitation_off_is_rl_alone() -> None:
    loss, parts = stats(rl_loss_scale=1.0, bc_loss_scale=0.0)
    assert set(parts) == {"loss", "rl_loss", "td_error"}
    assert loss == pytest.approx(parts["rl_loss"])


def test_dominance_off_leaves_the_margin() -> None:
    _, with_dominance = stats()
    _, without = stats(bc_dominance=False)
    assert "bc_dominance_loss" not in without
    assert without["bc_margin_loss"] == with_dominance["bc_margin_loss"]


def test_scalar_critic_has_one_output_per_bin_and_no_dominance() -> None:
    model = build(0, P, 2, distributional=False)
    assert model.critic.advantage.head.out_features == 2 * model.settings.bins
    assert "bc_dominance_loss" not in stats(distributional=False)[1]


def test_margin_is_the_one_given() -> None:
    small, large = stats(bc_margin=0.01)[1], stats(bc_margin=5.0)[1]
    # With a margin beyond every difference the loss is linear in it.
    assert large["bc_margin_loss"] > small["bc_margin_loss"] + 4
    q = torch.tensor([0.0, 1.0]).view(1, 1, 1, 2)
    assert margin_loss(q, torch.ones(1, 1, 1, dtype=torch.int64), 3.0).item() == pytest.approx((3 + 2) / 2)


def test_next_action_is_chosen_by_the_critic_named() -> None:
    """Scalar values: what equation 2 maximises is at least the double-Q value, level by level."""
    online, target = (build(0, P, 2, next_action_from=name, distributional=False, levels=1)
                      for name in ("online", "target"))  # fmt: skip
    batch = random_batch(online, 0, P)
    arguments = (online.encode(batch.next_observation), batch.reward, torch.ones(6, 1))
    double, maximum = online.td_target(*arguments), target.td_target(*arguments)
    assert (maximum >= double - 1e-6).all()
    assert (maximum > double + 1e-3).any()


def test_levels_bins_and_stack_size_the_network() -> None:
    model = build(1, P, 2, levels=4, bins=3, frame_stack=2)
    assert model.critic.advantage.head.out_features == 2 * 3 * model.settings.atoms
    assert model.critic.value.head.out_features == 2 * model.settings.atoms
    assert model.critic.advantage.first.in_features == 8 + 8 + 2 + 4
    assert model.encoders[0].convolutions[0].in_channels == 6
    assert model.critic.advantage.low_dim_projection[0].in_features == 2 * P


def test_value_range_is_the_support() -> None:
    model = build(0, P, 2, v_min=0.0, v_max=200.0)
    assert model.support[[0, -1]].tolist() == [0, 200]
    q = model.act(random_batch(model, 0, P).observation)[1]
    assert q.min() >= 0
    assert q.max() <= 200


def test_optimiser_uses_the_settings_and_leaves_the_target_out() -> None:
    model = build(1, P, 2, lr=0.02, weight_decay=0.3)
    learner = Learner(model)
    (group,) = learner.optimizer.param_groups
    assert (group["lr"], group["weight_decay"]) == (0.02, 0.3)
    held = {id(parameter) for parameter in group["params"]}
    assert {id(p) for p in model.encoders.parameters()} | {id(p) for p in model.critic.parameters()} == held


def test_augmentation_is_part_of_the_update_only() -> None:
    model = build(1, 0, 2, shift_pixels=4)
    observation = random_batch(model, 1, 0).observation
    assert torch.equal(model.act(observation)[0], model.act(observation)[0])
    assert not torch.equal(model.augment(observation).pixels[0], observation.pixels[0])
    jittered = build(1, 0, 2, brightness=0.2).augment(observation).pixels[0]
    assert jittered.is_floating_point()


def taken_and_target(model: CQNModel, samples: Batch) -> tuple[Tensor, Tensor]:
    """Outputs for the taken bins, and what they are pulled to; [B, L, D, A] each, the target [B, L, D] when scalar."""
    with torch.no_grad():
        path = encode(samples.action, model.settings.levels, model.settings.bins)
        projected = model.precompute(model.critic, model.encode(samples.observation))
        taken = take_bin(model.evaluate(model.critic, projected, path), path)[..., 0, :]
        return taken, model.td_target(model.encode(samples.next_observation), samples.reward, samples.discount)


def pair_of(distributional: bool, **changes: object) -> tuple[CQNModel, CQNModel]:
    """Two models with the same weights, of which the second one has `changes`."""
    alone, changed = (
        build(0, P, 3, distributional=distributional, bc_loss_scale=0.0, rl_loss_scale=1.0, **more)
        for more in ({}, changes)
    )
    changed.load_state_dict(alone.state_dict())
    return alone, changed


@pytest.mark.parametrize("distributional", [True, False])
def test_centralized_critic_learns_the_mean_over_dimensions(distributional: bool) -> None:
    """Against the definition, value by value; nothing else of the loss changes."""
    alone, together = pair_of(distributional, centralized_critic=True)
    samples = random_batch(alone, 0, P)
    taken, target = taken_and_target(alone, samples)
    if distributional:
        expected = -(target.mean(2) * taken.softmax(-1).mean(2).log()).sum(-1).mean()
    else:
        expected = (taken[..., 0].mean(2) - target.mean(2)).square().mean()
    torch.testing.assert_close(together.loss(samples)[0], expected)
    assert not torch.allclose(alone.loss(samples)[0], expected)
    torch.testing.assert_close(together.act(samples.observation)[0], alone.act(samples.observation)[0])


@pytest.mark.parametrize("distributional", [True, False])
def test_centralized_target_pulls_every_dimension_to_the_mean(distributional: bool) -> None:
    alone, together = pair_of(distributional, centralized_target=True)
    samples = random_batch(alone, 0, P)
    taken, target = taken_and_target(alone, samples)
    each = []
    for dim in range(3):
        if distributional:
            each.append(-(target.mean(2) * taken[:, :, dim].log_softmax(-1)).sum(-1).mean())
        else:
            each.append((taken[:, :, dim, 0] - target.mean(2)).square().mean())
    torch.testing.assert_close(together.loss(samples)[0], torch.stack(each).mean())
    assert not torch.allclose(alone.loss(samples)[0], torch.stack(each).mean())


@pytest.mark.parametrize("distributional", [True, False])
@pytest.mark.parametrize("bins", [3, 5])
def test_a_critic_without_preference_takes_the_middle_where_told_so(distributional: bool, bins: int) -> None:
    settings = CQNSettings(**(SMALL | {"bins": bins, "flat_bin": "middle", "distributional": distributional}))  # type: ignore[arg-type]
    model = CQNModel({}, P, 3, settings)
    action, _ = model.act(Observation((), torch.randn(4, P)))
    assert action.abs().max() < 1e-6
    with torch.no_grad():
        model.target_critic.advantage.head.bias.normal_(0, 0.1)  # from here on it has preferences
    assert model.act(Observation((), torch.randn(4, P)))[0].abs().max() > 0.1


def test_the_authors_encoder_for_dmc() -> None:
    """Four convolutions of 3x3, strides 2, 1, 1, 1, group norm of one group, SiLU: 32 * 35 * 35 features of 84x84."""
    settings = resolve(CQNSettings, PRESETS, "reference_dmc_pixels", {"hidden_dim": 16, "shift_pixels": 0})
    model = CQNModel({"camera": (3, 84, 84)}, 0, 2, settings)
    assert model.pixel_size == 32 * 35 * 35
    pixels = torch.randint(256, (2, 9, 84, 84), dtype=torch.uint8)
    with torch.no_grad():
        for weight in model.encoders.parameters():
            weight.add_(0.1 * torch.randn_like(weight))
        features, _ = model.encode(Observation((pixels,)))
        x = pixels.double() / 255 - 0.5
        state = {name: weight.double() for name, weight in model.encoders[0].state_dict().items()}
        for layer, stride in enumerate((2, 1, 1, 1)):
            x = F.conv2d(
                x, state[f"convolutions.{layer}.weight"], state[f"convolutions.{layer}.bias"], stride=stride
            )  # fmt: skip
            mean, variance = x.mean((1, 2, 3), keepdim=True), x.var((1, 2, 3), keepdim=True, correction=0)
            scale, shift = (state[f"norms.{layer}.{kind}"][None, :, None, None] for kind in ("weight", "bias"))
            x = (x - mean) / torch.sqrt(variance + 1e-5) * scale + shift
            x = x * torch.sigmoid(x)
    assert features is not None
    torch.testing.assert_close(features.double(), x.flatten(1), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"encoder_strides": (2, 1)}, "`encoder_strides` must be a positive number for each"),
        ({"encoder_norm": "batch"}, "encoder_norm"),
        ({"encoder_kernel": 0}, "`encoder_kernel` must be 1 to 16"),
    ],
)
def test_encoders_that_cannot_be(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        CQNSettings(**changes)  # type: ignore[arg-type]
