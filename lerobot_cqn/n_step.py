"""n-step returns, for batches of the replay and of LeRobot's loader alike. Pure functions."""

import torch
from torch import Tensor

__all__ = ["n_step_return"]


def n_step_return(rewards: Tensor, window: Tensor, terminal: Tensor, discount: float) -> tuple[Tensor, Tensor]:
    """Discounted sum of the rewards in each window, and the factor of the value that follows it (Algorithm 2).

    Args:
        rewards: [B, n], in the precision to compute in; those past the window do not count.
        window: int64 [B, 1], steps to look ahead, 1 to n: never past the end of the episode.
        terminal: bool [B, 1], whether the window ends with a real end, after which there is no value.
        discount: of a step, (0, 1].

    Returns:
        reward and discount, [B, 1] each.
    """
    steps = torch.arange(rewards.shape[1], device=rewards.device)
    powers = discount ** steps.to(rewards)
    reward = (rewards * (steps < window) * powers).sum(-1, keepdim=True)
    bootstrap = discount ** window.to(rewards)
    return reward, torch.where(terminal, torch.zeros_like(bootstrap), bootstrap)
