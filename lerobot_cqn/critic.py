"""The coarse-to-fine critic: action selection (Algorithm 1) and the loss (Algorithm 2) over all levels."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .discretisation import decode, encode, previous_centres, snap, zoom
from .distributional import expectation, project_onto_support
from .losses import (
    demo_mean,
    dominance_loss,
    entry_mean,
    margin_loss,
    mean_log_probs,
    q_learning_loss,
    scalar_q_learning_loss,
    take_bin,
)
from .model import Features, Model
from .networks import CoarseToFineNetwork, NetworkShape, Precomputed, initialise, zero_head
from .schema import Batch, Observation
from .settings import CQNSettings

__all__ = ["CQNModel"]

FLAT = 1e-6  # a spread of Q below this is rounding


class CQNModel(Model):
    """Encoders, online critic and target critic; everything a checkpoint must carry to act as trained.

    views: channels, height and width of one frame of each camera; low_dim_size: P, 0 for pixels only;
    dims: D.
    """

    settings: CQNSettings

    def __init__(
        self, views: Mapping[str, tuple[int, int, int]], low_dim_size: int, dims: int, settings: CQNSettings
    ) -> None:
        super().__init__(views, settings, plain=False)
        shape = NetworkShape(
            pixel_size=self.pixel_size, low_dim_size=low_dim_size * settings.frame_stack,
            feature_dim=settings.feature_dim, hidden_dim=settings.hidden_dim, dims=dims, levels=settings.levels,
            bins=settings.bins, atoms=settings.critic_atoms, **self.shape_of_sequences(),
        )  # fmt: skip
        self.critic, self.target_critic = CoarseToFineNetwork(shape), CoarseToFineNetwork(shape)
        initialise(self)
        for stream in (self.critic.advantage, self.critic.value):
            if stream is not None:
                zero_head(stream)
        self.target_critic.load_state_dict(self.critic.state_dict())
        self.target_critic.requires_grad_(False)

    def acting(self) -> Sequence[str]:
        """Encoders and the critic that `act_with` names."""
        return "encoders", "target_critic" if self.settings.act_with == "target" else "critic"

    def averaged(self) -> Sequence[tuple[nn.Module, nn.Module]]:
        """The target critic follows the critic; the reference has no target encoder."""
        return [(self.target_critic, self.critic)]

    def shape_of_sequences(self) -> dict[str, Any]:
        """Fields of `NetworkShape` that say how sequences are valued; none for single actions."""
        return {}

    # -- values --------------------------------------------------------------------------------------------

    def precompute(self, critic: CoarseToFineNetwork, features: Features) -> Precomputed:
        """First layers of a critic, once per observation."""
        with self.autocast():
            precomputed: Precomputed = critic.precompute(*features)
        return precomputed

    def evaluate(self, critic: CoarseToFineNetwork, precomputed: Precomputed, indices: Tensor) -> Tensor:
        """Logits along a known path, all levels in one pass: indices [B, L, D] -> [B, L, D, N, A]."""
        previous = previous_centres(indices, self.settings.bins)
        levels = torch.arange(self.settings.levels, device=indices.device)
        with self.autocast():
            logits: Tensor = critic(precomputed, previous, levels)
        return logits

    @torch.no_grad()
    def greedy(
        self, critic: CoarseToFineNetwork, precomputed: Precomputed, random_below: float = 0.0
    ) -> tuple[Tensor, Tensor]:
        """Algorithm 1 without input actions: indices [B, L, D] and the mean Q of the chosen bins [B].

        random_below: where Q spreads less than this over the bins, a random bin is taken (0: never).
        """
        s = self.settings
        size, device = len(precomputed.advantage), precomputed.advantage.device
        low = torch.full((size, critic.shape.entries), -1.0, device=device)
        high = -low
        indices, chosen = [], []
        for level in range(s.levels):
            centre = (low + high) / 2
            with self.autocast():
                logits = critic(precomputed, centre[:, None], torch.tensor([level], device=device))
            q = self.q_values(logits[:, 0])  # [B, D, N]
            index = q.argmax(-1)
            if s.flat_bin == "middle":
                index = torch.where(_spread(q) < FLAT, s.bins // 2, index)
            if random_below > 0:
                index = torch.where(_spread(q) < random_below, torch.randint_like(index, s.bins), index)
            chosen.append(q.gather(-1, index[..., None])[..., 0])
            indices.append(index)
            low, high = zoom(low, high, index, s.bins)
        return torch.stack(indices, dim=1), torch.stack(chosen).mean((0, 2))

    @torch.no_grad()
    def choose(self, observation: Observation, explore: bool = False) -> tuple[Tensor, Tensor]:
        """Greedy action [B, D] in [-1, 1] and its mean Q [B], from the critic that `act_with` names.

        explore: where the critic has no preference, a random bin.
        """
        s = self.settings
        critic = self.target_critic if s.act_with == "target" else self.critic
        precomputed = self.precompute(critic, self.encode(observation))
        indices, q = self.greedy(critic, precomputed, s.random_bin_below if explore else 0.0)
        return decode(indices, s.bins), q

    @torch.no_grad()
    def act(self, observation: Observation, explore: bool = False) -> tuple[Tensor, Tensor]:
        """Greedy action [B, D] in [-1, 1] and its mean Q [B].

        explore: with Gaussian noise, then the nearest representable action.
        """
        s = self.settings
        action, q = self.choose(observation, explore)
        if explore and s.exploration_noise > 0:
            action = self.executable(action + s.exploration_noise * torch.randn_like(action))
        return action, q

    def executable(self, action: Tensor) -> Tensor:
        """The nearest representable action."""
        return snap(action, self.settings.levels, self.settings.bins)

    # -- learning ------------------------------------------------------------------------------------------

    @torch.no_grad()
    def td_target(self, next_features: Features, reward: Tensor, discount: Tensor) -> Tensor:
        """Target of the taken action: distribution [B, L, D, A], or scalar values [B, L, D].

        The next action is greedy under the online critic, its value is read from the target critic along
        that same path (the authors' implementation); `next_action_from="target"` is equation 2 as written.
        """
        s = self.settings
        target = self.precompute(self.target_critic, next_features)
        if s.next_action_from == "online":
            path, _ = self.greedy(self.critic, self.precompute(self.critic, next_features))
        else:
            path, _ = self.greedy(self.target_critic, target)
        logits = take_bin(self.evaluate(self.target_critic, target, path), path)[..., 0, :]  # [B, L, D, A]
        if not s.distributional:
            return reward[..., None] + discount[..., None] * logits[..., 0]
        return project_onto_support(F.softmax(logits, dim=-1), reward, discount, self.support)

    def _by_step(self, values: Tensor) -> Tensor:
        """[B, L, T*D, ...] -> [B, L, T, D, ...], T = 1 without sequences."""
        shape = self.critic.shape
        return values.view(*values.shape[:2], shape.sequence or 1, shape.dims, *values.shape[3:])

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of Algorithm 2 and its parts (detached scalars) for an already augmented batch."""
        s = self.settings
        precomputed = self.precompute(self.critic, self.encode(batch.observation))
        indices, real = encode(batch.action, s.levels, s.bins), batch.real
        logits = self.evaluate(self.critic, precomputed, indices)
        total = logits.new_zeros(())
        stats: dict[str, Tensor] = {}
        if s.rl_loss_scale > 0:
            with torch.no_grad():
                target = self.td_target(self.encode(batch.next_observation), batch.reward, batch.discount)
            taken = take_bin(logits, indices)[..., 0, :]
            counts = real
            if s.centralized_target:
                by_step = self._by_step(target)
                target = by_step.mean(3, keepdim=True).expand_as(by_step).flatten(2, 3)
            if s.centralized_critic:  # the mean over D of each step: [B, L, T, A]
                taken, target = self._by_step(taken), self._by_step(target).mean(3)
                taken = mean_log_probs(taken) if s.distributional else taken.mean(3)
                counts = None if real is None else real[:, :: self.critic.shape.dims]
            if s.distributional:
                rl = q_learning_loss(taken, target, counts).mean()
            else:
                rl = scalar_q_learning_loss(taken[..., 0], target, counts).mean()
            total = total + s.rl_loss_scale * rl
            expected = expectation(target, self.support) if s.distributional else target
            error = entry_mean((self.q_values(taken.detach()) - expected).abs(), counts).mean()
            stats["rl_loss"], stats["td_error"] = rl.detach(), error
        if s.bc_loss_scale > 0:
            probs = F.softmax(logits, dim=-1) if s.distributional else logits
            q = expectation(probs, self.support) if s.distributional else logits[..., 0]
            bc = demo_mean(margin_loss(q, indices, s.bc_margin, real), batch.demo)
            stats["bc_margin_loss"] = bc.detach()
            if s.distributional and s.bc_dominance:
                dominance = demo_mean(dominance_loss(probs, indices, real), batch.demo)
                stats["bc_dominance_loss"] = dominance.detach()
                bc = bc + dominance
            total = total + s.bc_loss_scale * bc
        stats["loss"] = total.detach()
        return total, stats


def _spread(q: Tensor) -> Tensor:
    """Best minus worst over the bins, [B, D] from [B, D, N]."""
    return q.amax(-1) - q.amin(-1)
