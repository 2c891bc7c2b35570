"""The three terms of the CQN loss (paper, equations 2 and 3, appendix A). Pure functions.

All take the predictions of every level and dimension at once and average over L and D as Algorithm 2 does. With action
sequences D stands for their T*D entries. `real`, [B, D] in {0, 1}, leaves entries out; one of each sample must be 1.
"""

import math
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

__all__ = [
    "demo_mean",
    "dominance_loss",
    "entry_mean",
    "margin_loss",
    "mean_log_probs",
    "q_learning_loss",
    "scalar_q_learning_loss",
    "take_bin",
]


def entry_mean(values: Tensor, real: Tensor | None = None) -> Tensor:
    """Mean over everything but B: [B, L, D, ...] -> [B]."""
    if real is None:
        return values.mean(tuple(range(1, values.ndim)))
    each = values.transpose(1, 2).flatten(2).mean(-1)  # [B, D]
    return (each * real).sum(1) / real.sum(1)


def q_learning_loss(logits_taken: Tensor, target: Tensor, real: Tensor | None = None) -> Tensor:
    """Cross-entropy between target distribution and prediction for the taken action (equation 2 with C51).

    logits_taken, target: [B, L, D, A]. Returns [B], the mean over L and D.
    """
    return entry_mean(-(target * F.log_softmax(logits_taken, dim=-1)).sum(-1), real)


def scalar_q_learning_loss(q_taken: Tensor, target: Tensor, real: Tensor | None = None) -> Tensor:
    """Squared temporal-difference error (equation 2 as written); q_taken, target: [B, L, D]. Returns [B]."""
    return entry_mean((q_taken - target).square(), real)


def mean_log_probs(logits: Tensor) -> Tensor:
    """Logarithm of the mean over D of the distributions: [..., D, A] -> [..., A].

    A centralised critic values an action as a whole by the mean over its dimensions (Seyde et al. 2023; one of the
    paper's ablations).
    """
    return F.log_softmax(logits, dim=-1).logsumexp(-2) - math.log(logits.shape[-2])


def dominance_loss(probs: Tensor, expert: Tensor, real: Tensor | None = None) -> Tensor:
    """First-order stochastic dominance of the expert's bin over every other bin (appendix A).

    probs: [B, L, D, N, A]; expert: int64 [B, L, D], the bin of the demonstrated action.
    Sum over atoms of max(0, CDF(expert) - CDF(other)). Returns [B], the mean over L, D and N.
    """
    loss: Tensor = _Dominance.apply(probs, expert, real)  # type: ignore[no-untyped-call]
    return loss


class _Dominance(torch.autograd.Function):
    """`dominance_loss` with its gradient written out: fewer passes over [B, L, D, N, A], and counts stay exact.

    With cdf = cumsum(probs), the loss of a sample is mean(sum over atoms of max(0, cdf[expert] - cdf)).
    """

    @staticmethod
    def forward(ctx: Any, probs: Tensor, expert: Tensor, real: Tensor | None) -> Tensor:
        cdf = probs.cumsum(-1)
        gap = cdf.neg_().sub_(take_bin(cdf, expert))  # cdf is negated by now: CDF(expert) - CDF
        # Equality counts, as for torch.clamp: a new critic is all ties.
        ctx.save_for_backward(gap >= 0, expert, real)
        return entry_mean(gap.clamp_(min=0).sum(-1), real)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        ahead, expert, real = ctx.saved_tensors
        flow = ahead.to(grad.dtype).neg_()  # d loss / d cdf in whole numbers: -1 where the other bin is ahead, ...
        index = _bin_index(expert, flow.shape[-1])
        flow.scatter_add_(-2, index, -flow.sum(-2, keepdim=True))  # ... and their number at the expert's bin
        # Each probability enters its own and every later value of the cdf: sum(flow[j:]) for atom j.
        tail = flow.cumsum(-1).neg_().add_(flow).add_(flow.sum(-1, keepdim=True))
        count, dims = flow[0].numel() // flow.shape[-1], flow.shape[2]
        per_entry = (
            grad[:, None] / count if real is None else grad[:, None] * real / (real.sum(1)[:, None] * count / dims)
        )
        return tail.mul_(per_entry[:, None, :, None, None]), None, None


def margin_loss(q: Tensor, expert: Tensor, margin: float, real: Tensor | None = None) -> Tensor:
    """Large-margin imitation: max(0, m - (Q(expert) - Q(other))) (equation 3, averaged instead of maximised).

    q: [B, L, D, N]; expert: int64 [B, L, D]. Returns [B], the mean over L, D and N (the expert's own bin adds
    the constant m / N, as in the authors' implementation).
    """
    q_expert = q.gather(-1, expert.unsqueeze(-1))
    return entry_mean((margin - (q_expert - q)).clamp(min=0), real)


def demo_mean(per_sample: Tensor, demo: Tensor) -> Tensor:
    """Mean over the samples flagged as demonstrations; 0, never NaN, when there are none.

    per_sample: [B]; demo: [B, 1] in {0, 1}. Returns a scalar.
    """
    flags = demo.flatten()
    return (per_sample * flags).sum() / flags.sum().clamp(min=1)


def take_bin(values: Tensor, index: Tensor) -> Tensor:
    """Entries of the chosen bins: [B, L, D, N, A], int64 [B, L, D] -> [B, L, D, 1, A]."""
    return values.gather(-2, _bin_index(index, values.shape[-1]))


def _bin_index(index: Tensor, atoms: int) -> Tensor:
    """[B, L, D] -> [B, L, D, 1, A], as gather and scatter want it."""
    return index[..., None, None].expand(*index.shape, 1, atoms)
