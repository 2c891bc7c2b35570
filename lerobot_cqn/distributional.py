"""Categorical value distributions (C51, Bellemare et al. 2017; paper, section 3.2). Pure functions."""

import torch
from torch import Tensor

__all__ = ["expectation", "project_onto_support", "support", "two_hot"]


def support(v_min: float, v_max: float, atoms: int, device: torch.device | str | None = None) -> Tensor:
    """Equally spaced values of the atoms, [A] from v_min to v_max."""
    return torch.linspace(v_min, v_max, atoms, device=device)


def expectation(probs: Tensor, values: Tensor) -> Tensor:
    """Q = sum over atoms of probability times value: [..., A], [A] -> [...]."""
    return probs @ values


def project_onto_support(probs: Tensor, reward: Tensor, discount: Tensor, values: Tensor) -> Tensor:
    """Distribution of `reward + discount * Z` projected on the fixed support; keeps the probability mass.

    probs: [B, ..., A] distribution of Z over `values`; reward, discount: [B, 1]; values: [A], equally spaced.
    Returns [B, ..., A]. Atoms beyond the support are moved to its ends.
    """
    weight = _placed(reward + discount * values, values)  # [B, A, A]
    middle = probs.flatten(1, -2)  # [B, M, A]
    return torch.bmm(middle, weight.transpose(1, 2)).view_as(probs)


def two_hot(value: Tensor, values: Tensor) -> Tensor:
    """Distribution on the two atoms next to a value, whose expectation it is: [B], [A] -> [B, A]; cut at the ends.

    values: [A], equally spaced.
    """
    return _placed(value[:, None], values)[..., 0]


def _placed(points: Tensor, values: Tensor) -> Tensor:
    """Share of each of K points that lands on each atom, a triangle of width one around it: [B, K] -> [B, A, K]."""
    v_min, v_max = values[0], values[-1]
    atoms = values.shape[0]
    position = (points.clamp(v_min, v_max) - v_min) / ((v_max - v_min) / (atoms - 1))
    return (1 - (position[:, None, :] - torch.arange(atoms, device=values.device)[:, None]).abs()).clamp_(0)
