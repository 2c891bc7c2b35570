"""Coarse-to-fine discretisation of [-1, 1]."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from lerobot_cqn.discretisation import decode, encode, previous_centres, snap, zoom

LEVELS, BINS = st.integers(1, 5), st.integers(2, 9)
ACTIONS = st.lists(st.floats(-1, 1, width=32), min_size=1, max_size=16).map(torch.tensor)
ROUNDING = 1e-6


@st.composite
def grids(draw: st.DrawFn) -> tuple[int, int, Tensor]:
    """Levels, bins and every action [K, 1] of a grid (up to 3000 of them, evenly spread)."""
    levels, bins = draw(LEVELS), draw(BINS)
    count = bins**levels
    chosen = torch.arange(0, count, max(1, count // 3000))
    indices = torch.stack([chosen // bins ** (levels - 1 - level) % bins for level in range(levels)], dim=-1)
    return levels, bins, indices[:, :, None]


@given(ACTIONS, LEVELS, BINS)
def test_decoded_action_is_within_half_a_finest_bin(action: Tensor, levels: int, bins: int) -> None:
    indices = encode(action, levels, bins)
    assert indices.shape == (levels, len(action))
    assert indices.min() >= 0
    assert indices.max() < bins
    assert (decode(indices, bins) - action).abs().max() <= bins**-levels + ROUNDING


@given(grids())
def test_encode_is_the_inverse_of_decode(grid: tuple[int, int, Tensor]) -> None:
    levels, bins, indices = grid
    assert torch.equal(encode(decode(indices, bins), levels, bins), indices)


@given(grids())
def test_decoded_grid_is_even_and_in_order(grid: tuple[int, int, Tensor]) -> None:
    levels, bins, indices = grid
    rank = sum(indices[:, level, 0] * bins ** (levels - 1 - level) for level in range(levels))
    assert torch.allclose(decode(indices, bins)[:, 0], -1 + (2 * rank + 1) / bins**levels, atol=ROUNDING)


@given(ACTIONS, LEVELS, BINS)
def test_intervals_nest(action: Tensor, levels: int, bins: int) -> None:
    indices = encode(action, levels, bins)
    low, high = torch.full_like(action, -1.0), torch.full_like(action, 1.0)
    for level in range(levels):
        inner_low, inner_high = zoom(low, high, indices[level], bins)
        assert (inner_low >= low - ROUNDING).all()
        assert (inner_high <= high + ROUNDING).all()
        assert torch.allclose(inner_high - inner_low, (high - low) / bins, atol=ROUNDING)
        assert (inner_low - ROUNDING <= action).all()
        assert (action <= inner_high + ROUNDING).all()
        low, high = inner_low, inner_high


@given(ACTIONS, LEVELS, BINS)
def test_snap_is_idempotent(action: Tensor, levels: int, bins: int) -> None:
    snapped = snap(action, levels, bins)
    assert torch.equal(snap(snapped, levels, bins), snapped)


@given(ACTIONS, LEVELS, BINS)
def test_a_shorter_encoding_is_a_prefix(action: Tensor, levels: int, bins: int) -> None:
    assert torch.equal(encode(action, levels + 1, bins)[:levels], encode(action, levels, bins))


@given(ACTIONS, LEVELS, BINS)
def test_previous_centres_are_the_coarser_actions(action: Tensor, levels: int, bins: int) -> None:
    indices = encode(action, levels, bins)
    centres = previous_centres(indices, bins)
    assert torch.equal(centres[0], torch.zeros_like(action))
    for level in range(1, levels):
        assert torch.equal(centres[level], decode(indices[:level], bins))


@pytest.mark.parametrize("value", [1.0, 1.5, 1e6])
def test_out_of_range_falls_into_the_outermost_interval(value: float) -> None:
    action = torch.tensor([value, -value])
    assert encode(action, 3, 5).tolist() == [[4, 0]] * 3
    assert torch.allclose(snap(action, 3, 5), torch.tensor([1 - 1 / 125, 1 / 125 - 1]))


@pytest.mark.parametrize("bins", [3, 5, 7, 17])
@pytest.mark.parametrize("levels", [1, 2, 3, 4])
def test_odd_bins_represent_zero(levels: int, bins: int) -> None:
    assert snap(torch.zeros(1), levels, bins).abs().item() < 1e-7


def test_by_hand() -> None:
    # Level 1: [-1, -1/3, 1/3, 1] holds 0.5 in bin 2; level 2: [1/3, 5/9, 7/9, 1] holds it in bin 0.
    indices = encode(torch.tensor([0.5]), 2, 3)
    assert indices.tolist() == [[2], [0]]
    assert decode(indices, 3).item() == pytest.approx(4 / 9)
    assert previous_centres(indices, 3).flatten().tolist() == pytest.approx([0, 2 / 3])


def test_leading_dimensions_are_free() -> None:
    action = torch.rand(2, 3, 4) * 2 - 1
    indices = encode(action, 3, 5)
    assert indices.shape == (2, 3, 3, 4)
    assert torch.equal(decode(indices, 5)[1, 2], decode(indices[1, 2], 5))
