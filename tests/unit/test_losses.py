"""The terms of the loss on their own."""

from itertools import product

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from lerobot_cqn.losses import demo_mean, dominance_loss, margin_loss, q_learning_loss, scalar_q_learning_loss

SEEDS = st.integers(0, 2**31)
B, L, D, N, A = 3, 2, 4, 5, 11


def probabilities(seed: int) -> tuple[Tensor, Tensor]:
    """Distributions [B, L, D, N, A] and experts [B, L, D]."""
    generator = torch.Generator().manual_seed(seed)
    logits = 2 * torch.randn(B, L, D, N, A, generator=generator)
    return logits.softmax(-1), torch.randint(N, (B, L, D), generator=generator)


def plain_dominance(probs: Tensor, expert: Tensor) -> Tensor:
    cdf = probs.cumsum(-1)
    expert_cdf = torch.empty(B, L, D, A, dtype=probs.dtype)
    for place in product(range(B), range(L), range(D)):
        expert_cdf[place] = cdf[place][expert[place]]
    return (expert_cdf[:, :, :, None] - cdf).clamp(min=0).sum(-1).mean((1, 2, 3))


@given(SEEDS)
def test_dominance_value_and_gradient_equal_autograd_of_the_formula(seed: int) -> None:
    probs, expert = probabilities(seed)
    weights = torch.rand(B)
    results = []
    for function in (dominance_loss, plain_dominance):
        leaf = probs.clone().requires_grad_()
        loss = function(leaf, expert)
        (loss * weights).sum().backward()
        assert leaf.grad is not None
        results.append((loss.detach(), leaf.grad))
    assert torch.allclose(results[0][0], results[1][0], atol=1e-6)
    # All of a distribution's values end at 1: rounding decides that atom's sign, which shifts all its atoms alike.
    first, second = (gradient - gradient.mean(-1, keepdim=True) for _, gradient in results)
    assert torch.allclose(first, second, atol=1e-6)


def test_dominance_gradient_in_double_precision() -> None:
    probs, expert = probabilities(0)
    logits = probs.double().log().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: dominance_loss(x.softmax(-1), expert), (logits,))


def test_a_new_critic_gets_a_gradient_from_dominance() -> None:
    """All bins tie under zero heads; the expert's mass must still be pushed to higher values."""
    logits = torch.zeros(1, 1, 1, 3, A, requires_grad=True)
    dominance_loss(logits.softmax(-1), torch.ones(1, 1, 1, dtype=torch.int64)).sum().backward()
    assert logits.grad is not None
    expert, other = logits.grad[0, 0, 0, 1], logits.grad[0, 0, 0, 0]
    assert expert[0] > 0 > expert[-1]
    assert other[0] < 0 < other[-1]


@given(SEEDS)
def test_dominance_is_zero_where_the_expert_dominates(seed: int) -> None:
    probs, expert = probabilities(seed)
    best = torch.zeros(A)
    best[-1] = 1
    index = expert[..., None, None].expand(B, L, D, 1, A)
    assert dominance_loss(probs.scatter(-2, index, best.expand(B, L, D, 1, A)), expert).abs().max() <= 1e-6
    worst = best.flip(0)
    assert (dominance_loss(probs.scatter(-2, index, worst.expand(B, L, D, 1, A)), expert) > 0.1).all()


def test_dominance_by_hand() -> None:
    # CDFs: expert (0.5, 1, 1), other (0.2, 0.5, 1): excess 0.3 + 0.5, averaged with the expert's own zero.
    probs = torch.tensor([[0.5, 0.5, 0.0], [0.2, 0.3, 0.5]]).view(1, 1, 1, 2, 3)
    assert dominance_loss(probs, torch.zeros(1, 1, 1, dtype=torch.int64)).item() == pytest.approx(0.4)
    assert dominance_loss(probs, torch.ones(1, 1, 1, dtype=torch.int64)).item() == pytest.approx(0.0, abs=1e-7)


def test_margin_by_hand() -> None:
    # m = 0.1, Q(expert) = 0.5; others 0.45 (short by 0.05), 0.7 (by 0.3), 0.1 (none), itself 0.1: mean 0.45 / 4.
    q = torch.tensor([0.45, 0.5, 0.7, 0.1]).view(1, 1, 1, 4)
    assert margin_loss(q, torch.ones(1, 1, 1, dtype=torch.int64), 0.1).item() == pytest.approx(0.45 / 4)


def test_cross_entropy_by_hand() -> None:
    logits = torch.tensor([0.25, 0.75]).log().view(1, 1, 1, 2)
    target = torch.tensor([0.5, 0.5]).view(1, 1, 1, 2)
    expected = -0.5 * (torch.tensor(0.25).log() + torch.tensor(0.75).log())
    assert q_learning_loss(logits, target).item() == pytest.approx(expected.item())


@given(SEEDS)
def test_cross_entropy_is_least_at_the_target(seed: int) -> None:
    probs, _ = probabilities(seed)
    target = probs[..., 0, :]
    at_target = q_learning_loss(target.log(), target)
    assert (q_learning_loss(probs[..., 1, :].log(), target) >= at_target - 1e-6).all()


def test_squared_error_by_hand() -> None:
    q, target = torch.tensor([[[1.0, 2.0]]]), torch.tensor([[[0.0, 4.0]]])
    assert scalar_q_learning_loss(q, target).tolist() == [2.5]


@given(st.lists(st.tuples(st.floats(-10, 10), st.booleans()), min_size=1, max_size=8))
def test_demo_mean_is_the_mean_of_demonstrations_and_never_nan(samples: list[tuple[float, bool]]) -> None:
    values = [value for value, demo in samples if demo]
    expected = sum(values) / len(values) if values else 0.0
    per_sample = torch.tensor([value for value, _ in samples], requires_grad=True)
    mean = demo_mean(per_sample, torch.tensor([[float(demo)] for _, demo in samples]))
    mean.backward()
    assert mean.item() == pytest.approx(expected, abs=1e-5)
    assert per_sample.grad is not None
    assert per_sample.grad.tolist() == pytest.approx([demo / max(len(values), 1) for _, demo in samples])
