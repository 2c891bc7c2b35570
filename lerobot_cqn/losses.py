"""The three terms of the CQN loss (paper, equations 2 and 3, appendix A). Pure functions.

All take the predictions of every level and dimension at once and average over L and D as Algorithm 2 does.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

__all__ = ["demo_mean", "dominance_loss", "margin_loss", "q_learning_loss", "scalar_q_learning_loss"]


def q_learning_loss(logits_taken: Tensor, target: Tensor) -> Tensor:
    """Cross-entropy between target distribution and prediction for the taken action (equation 2 with C51).

    logits_taken, target: [B, L, D, A]. Returns [B], the mean over L and D.
    """
    return -(target * F.log_softmax(logits_taken, dim=-1)).sum(-1).mean((1, 2))


def scalar_q_learning_loss(q_taken: Tensor, target: Tensor) -> Tensor:
    """Squared temporal-difference error (equation 2 as written); q_taken, target: [B, L, D]. Returns [B]."""
    return (q_taken - target).square().mean((1, 2))


def dominance_loss(probs: Tensor, expert: Tensor) -> Tensor:
    """First-order stochastic dominance of the expert's bin over every other bin (appendix A).

    probs: [B, L, D, N, A]; expert: int64 [B, L, D], the bin of the demonstrated action.
    Sum over atoms of max(0, CDF(expert) - CDF(other)). Returns [B], the mean over L, D and N.
    """
    atoms = probs.shape[-1]
    # A product with a triangle of ones is the cumulative sum, and several times faster than torch.cumsum on CPU.
    cdf = probs @ torch.ones(atoms, atoms, device=probs.device, dtype=probs.dtype).triu()
    expert_cdf = _take_bin(cdf, expert)
    return (expert_cdf - cdf).clamp(min=0).sum(-1).mean((1, 2, 3))


def margin_loss(q: Tensor, expert: Tensor, margin: float) -> Tensor:
    """Large-margin imitation: max(0, m - (Q(expert) - Q(other))) (equation 3, averaged instead of maximised).

    q: [B, L, D, N]; expert: int64 [B, L, D]. Returns [B], the mean over L, D and N (the expert's own bin adds
    the constant m / N, as in the authors' implementation).
    """
    q_expert = q.gather(-1, expert.unsqueeze(-1))
    return (margin - (q_expert - q)).clamp(min=0).mean((1, 2, 3))


def demo_mean(per_sample: Tensor, demo: Tensor) -> Tensor:
    """Mean over the samples flagged as demonstrations; 0, never NaN, when there are none.

    per_sample: [B]; demo: [B, 1] in {0, 1}. Returns a scalar.
    """
    flags = demo.flatten()
    return (per_sample * flags).sum() / flags.sum().clamp(min=1)


def _take_bin(values: Tensor, index: Tensor) -> Tensor:
    """[B, L, D, N, A], [B, L, D] -> [B, L, D, 1, A]."""
    return values.gather(-2, index[..., None, None].expand(*index.shape, 1, values.shape[-1]))
