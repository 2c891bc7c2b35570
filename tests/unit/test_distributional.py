"""The C51 projection and the expectation."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from lerobot_cqn.critic import CQNModel
from lerobot_cqn.distributional import expectation, project_onto_support, support, two_hot
from lerobot_cqn.settings import CQNSettings
from tests.oracle import Oracle

SEEDS = st.integers(0, 2**31)


def distributions(seed: int, atoms: int, batch: int = 3) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.softmax(3 * torch.randn(batch, 2, atoms, generator=generator), dim=-1)


def column(*values: float) -> Tensor:
    return torch.tensor(values)[:, None]


def test_support_is_even() -> None:
    assert support(-2.0, 2.0, 5).tolist() == [-2, -1, 0, 1, 2]


@given(SEEDS, st.integers(2, 60), st.floats(-3, 3), st.floats(0, 1))
def test_projection_keeps_the_mass(seed: int, atoms: int, reward: float, discount: float) -> None:
    probs, values = distributions(seed, atoms), support(-1, 1, atoms)
    projected = project_onto_support(probs, column(*[reward] * 3), column(*[discount] * 3), values)
    assert projected.shape == probs.shape
    assert projected.min() >= 0
    assert torch.allclose(projected.sum(-1), torch.ones(3, 2), atol=1e-5)


@given(SEEDS, st.integers(2, 60), st.floats(0, 1), st.floats(-1, 1))
def test_projection_keeps_the_mean_inside_the_support(seed: int, atoms: int, discount: float, share: float) -> None:
    probs, values = distributions(seed, atoms), support(-1, 1, atoms)
    reward = share * (1 - discount)  # reward + discount * [-1, 1] stays within [-1, 1]
    projected = project_onto_support(probs, column(*[reward] * 3), column(*[discount] * 3), values)
    expected = reward + discount * expectation(probs, values)
    assert torch.allclose(expectation(projected, values), expected, atol=1e-5)


@given(SEEDS, st.sampled_from([2, 3, 51]), st.floats(-3, 3), st.floats(0, 1))
def test_projection_equals_the_loop_over_atoms(seed: int, atoms: int, reward: float, discount: float) -> None:
    settings = CQNSettings(atoms=atoms, v_min=-1.5, v_max=0.5, levels=1, hidden_dim=4, feature_dim=4)
    oracle = Oracle(CQNModel({}, 1, 1, settings), torch.float64)
    probs = distributions(seed, atoms)
    rewards, discounts = column(reward, 0.0, -reward), column(discount, 1.0, 0.0)
    got = project_onto_support(probs, rewards, discounts, support(-1.5, 0.5, atoms))
    for row in range(2):
        expected = oracle.project(probs[:, row].double(), rewards[:, 0].double(), discounts[:, 0].double())
        assert torch.allclose(got[:, row].double(), expected, atol=1e-5)


@given(SEEDS, st.integers(0, 50))
def test_discount_zero_gives_all_mass_to_the_reward(seed: int, atom: int) -> None:
    values = support(-1, 1, 51)
    projected = project_onto_support(distributions(seed, 51, 1), values[atom].view(1, 1), column(0.0), values)
    expected = torch.zeros(51)
    expected[atom] = 1
    assert torch.allclose(projected, expected.expand(1, 2, 51), atol=1e-5)


def test_reward_between_atoms_is_shared_by_hand() -> None:
    probs = torch.full((1, 1, 3), 1 / 3)
    projected = project_onto_support(probs, column(0.25), column(0.0), torch.tensor([-1.0, 0.0, 1.0]))
    assert projected.flatten().tolist() == pytest.approx([0, 0.75, 0.25])


@pytest.mark.parametrize(("reward", "end"), [(5.0, -1), (-5.0, 0)])
def test_beyond_the_support_is_moved_to_its_end(reward: float, end: int) -> None:
    projected = project_onto_support(distributions(0, 51, 1), column(reward), column(0.9), support(-1, 1, 51))
    assert torch.allclose(projected[..., end], torch.ones(1, 2))


def test_identity() -> None:
    probs = distributions(1, 51)
    assert torch.allclose(
        project_onto_support(probs, column(0, 0, 0), column(1, 1, 1), support(-1, 1, 51)), probs, atol=1e-5
    )


@given(value=st.floats(-3, 3), low=st.floats(-2, 0), span=st.floats(0.5, 4), atoms=st.integers(2, 101))
def test_two_hot_is_the_value_on_two_neighbours(value: float, low: float, span: float, atoms: int) -> None:
    values = support(low, low + span, atoms).double()
    probs = two_hot(torch.tensor([value], dtype=torch.float64), values)[0]
    assert float(probs.sum()) == pytest.approx(1.0)
    assert float(expectation(probs, values)) == pytest.approx(min(max(value, low), low + span), abs=1e-5)
    places = torch.nonzero(probs > 1e-9).flatten()
    assert len(places) <= 2
    assert int(places[-1] - places[0]) <= 1
