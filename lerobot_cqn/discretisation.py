"""Coarse-to-fine discretisation of [-1, 1] (paper, section 3.1; Algorithm 1, steps 1 and 3). Pure functions.

Level 1 cuts [-1, 1] into N equal intervals, each later level cuts the chosen interval into N again.
An action is therefore L indices per dimension and is represented by the centre of its last interval.
"""

import torch
from torch import Tensor

__all__ = ["decode", "encode", "previous_centres", "snap", "zoom"]


def zoom(low: Tensor, high: Tensor, index: Tensor, bins: int) -> tuple[Tensor, Tensor]:
    """Bounds of interval `index` (0..bins-1) out of `bins` equal parts of [low, high]; all [..., D]."""
    width = (high - low) / bins
    new_low = low + width * index
    return new_low, new_low + width


def encode(action: Tensor, levels: int, bins: int) -> Tensor:
    """Indices of the intervals that hold `action`: [..., D] in [-1, 1] -> int64 [..., L, D] in 0..bins-1.

    Values outside [-1, 1] fall into the outermost intervals.
    """
    low, high = torch.full_like(action, -1.0), torch.full_like(action, 1.0)
    indices = []
    for _ in range(levels):
        index = torch.floor((action - low) / ((high - low) / bins)).clamp_(0, bins - 1)
        indices.append(index.long())
        low, high = zoom(low, high, index, bins)
    return torch.stack(indices, dim=-2)


def _bounds(indices: Tensor, bins: int) -> list[tuple[Tensor, Tensor]]:
    """Interval bounds before level 1 and after each level, L + 1 pairs of [..., D]."""
    low = torch.full(indices.shape[:-2] + indices.shape[-1:], -1.0, device=indices.device)
    bounds = [(low, -low)]
    for level in range(indices.shape[-2]):
        bounds.append(zoom(*bounds[-1], indices[..., level, :], bins))
    return bounds


def decode(indices: Tensor, bins: int) -> Tensor:
    """Centre of the last interval: int64 [..., L, D] -> float32 [..., D]."""
    low, high = _bounds(indices, bins)[-1]
    return (low + high) / 2


def previous_centres(indices: Tensor, bins: int) -> Tensor:
    """Action of the previous level for each level, a^{l-1} of equation 1: [..., L, D] -> [..., L, D].

    Zero at level 1, else the centre of the interval that is about to be cut.
    """
    return torch.stack([(low + high) / 2 for low, high in _bounds(indices, bins)[:-1]], dim=-2)


def snap(action: Tensor, levels: int, bins: int) -> Tensor:
    """Nearest representable action: clamp to [-1, 1], encode, decode; [..., D] -> [..., D]."""
    return decode(encode(action.clamp(-1.0, 1.0), levels, bins), bins)
