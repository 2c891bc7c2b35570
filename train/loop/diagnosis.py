"""What a run says about itself at each evaluation: its episodes one by one, and what learning lives on."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from lerobot_cqn.model import Model
from lerobot_cqn.schema import Batch

from ..replay.buffer import Replay
from ..replay.course import Shown, describe, how_it_failed
from ..replay.files import Place
from ..run.metrics import KINDS
from .evaluate import Evaluation

__all__ = ["diagnose", "episode_rows", "shown_in"]

SAMPLES = 128  # transitions of each kind


def shown_in(replay: Replay) -> Shown:
    """What the dataset's demonstrations cover."""
    places = [place for place in replay.places if place.number < 0]
    if not places:
        return Shown()
    states, actions = (
        np.concatenate([replay.values(name, place) for place in places]) for name in ("low_dim", "action")
    )
    return Shown.of(states, actions)


def episode_rows(result: Evaluation, shown: Shown, max_steps: int) -> list[dict[str, Any]]:
    """Row of evaluation_episodes.csv for each episode, but for what all have in common."""
    rows = []
    for success, length, total, course in zip(
        result.outcomes, result.steps, result.returns, result.courses, strict=True
    ):
        said = describe(course, shown)
        how = "" if success else how_it_failed(said, cut_off=length >= max_steps)
        rows.append({"success": int(success), "length": length, "return": total, "how": how, **said})
    return rows


def diagnose(model: Model, replay: Replay, seed: int) -> dict[str, float]:
    """TD error and gradient norms of RL and of imitation, each as it is weighed, on transitions of each of `KINDS`.

    A kind of which there is nothing has no columns. Neither the weights nor any random state of training change.
    """
    rng, row = np.random.default_rng(seed), dict[str, float]()
    for kind in KINDS:
        episodes = np.array([i for i, place in enumerate(replay.places) if _kind(place) == kind])
        if len(episodes):
            drawn = rng.choice(episodes, SAMPLES)
            lengths = np.array([place.length for place in replay.places])
            batch = replay.transitions(drawn, rng.integers(0, lengths[drawn])).to(model.support.device)
            with torch.random.fork_rng(devices=[]):  # DrQ-v2's losses draw noise
                row |= {f"{name}_{kind}": value for name, value in _forces(model, batch).items()}
    return row


def _kind(place: Place) -> str:
    return KINDS[0] if place.number < 0 else KINDS[1] if place.success else KINDS[2]


def _forces(model: Model, batch: Batch) -> dict[str, float]:
    """TD error, and the norm of each loss's gradient; what is switched off is missing."""
    settings, forces = model.settings, dict[str, float]()
    parameters = [p for p in model.parameters() if p.requires_grad]
    alone = {}
    if settings.rl_loss_scale:
        alone["rl_gradient"] = replace(settings, bc_loss_scale=0.0)
    if settings.bc_loss_scale:
        alone["imitation_gradient"] = replace(settings, rl_loss_scale=0.0)
    for name, one in alone.items():
        try:
            model.settings = one
            loss, stats = model.loss(batch)
        finally:
            model.settings = settings
        forces[name] = _norm(loss, parameters)
        if "td_error" in stats:
            forces["td_error"] = float(stats["td_error"])
    return forces


def _norm(loss: torch.Tensor, parameters: Sequence[torch.Tensor]) -> float:
    gradients = torch.autograd.grad(loss, parameters, allow_unused=True) if loss.requires_grad else ()
    squares = [gradient.double().square().sum() for gradient in gradients if gradient is not None]
    return float(torch.stack(squares).sum().sqrt()) if squares else 0.0
