"""One gradient update: loss, AdamW, Polyak step of the target (Algorithm 2)."""

from typing import Any

import torch

from .errors import CQNError
from .model import Model
from .schema import Batch

__all__ = ["Learner", "NonFiniteLossError"]


class NonFiniteLossError(CQNError, ArithmeticError):
    """The loss became NaN or infinite; the weights are still those of the last good update."""


class Learner:
    """Owns the optimiser of a model. Method names follow LeRobot's `RLAlgorithm`."""

    def __init__(self, model: Model) -> None:
        self.model = model
        parameters = [p for p in model.parameters() if p.requires_grad]
        s = model.settings
        self.optimizer = torch.optim.AdamW(parameters, lr=s.lr, weight_decay=s.weight_decay, fused=True)

    def update(self, batch: Batch) -> dict[str, torch.Tensor]:
        """One update on a batch on any device; returns detached scalars (docs/metrics.md).

        Raises NonFiniteLossError before the weights are touched.
        """
        batch = batch.to(self.model.support.device)
        loss, stats = self.model.loss(self.model.augment_batch(batch))
        if not torch.isfinite(loss):
            raise NonFiniteLossError(
                f"The loss is {loss.item()}: expected a finite number. Look for NaN or huge values in the states and "
                "rewards, or lower `--policy.lr`; the last checkpoint is untouched."
            )
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        self.model.update_target()
        return stats

    def state_dict(self) -> dict[str, Any]:
        """Optimiser state; the weights live in the policy's checkpoint."""
        return self.optimizer.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` gave."""
        self.optimizer.load_state_dict(state)
