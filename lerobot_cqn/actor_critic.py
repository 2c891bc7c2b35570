"""DrQ-v2 (Yarats et al. 2022) and DrQ-v2+: the paper's actor-critic baselines on the same encoders and batches.

DrQ-v2+ is the paper's own strong baseline: a distributional critic and the recipes for demonstrations. Where the paper
leaves it open, docs/baselines.md says what is done here.
"""

from collections.abc import Mapping, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .distributional import expectation, project_onto_support, two_hot
from .losses import demo_mean
from .model import Features, Model
from .networks import initialise, projection
from .schema import Batch, Observation
from .settings import DrQv2Settings

__all__ = ["DrQv2Model"]

TWINS = 2


class Trunk(nn.Module):
    """Projections of pixels and low-dimensional values to [B, width], as CQN's streams have them."""

    def __init__(self, pixel_size: int, low_dim_size: int, feature_dim: int) -> None:
        super().__init__()
        self.pixels = projection(pixel_size, feature_dim, bias=True) if pixel_size else None
        self.low_dim = projection(low_dim_size, feature_dim, bias=True) if low_dim_size else None
        self.width = feature_dim * (bool(pixel_size) + bool(low_dim_size))

    def forward(self, features: Features) -> Tensor:
        """Pixel features [B, E] or None and low-dim values [B, S*P] or None -> [B, width]."""
        pixels, low_dim = features
        parts = []
        if self.pixels is not None:
            parts.append(self.pixels(pixels))
        if self.low_dim is not None:
            parts.append(self.low_dim(low_dim))
        return torch.cat(parts, dim=-1)


def _mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, outputs)
    )


class Actor(nn.Module):
    """Deterministic policy: observation -> mean action in [-1, 1]."""

    def __init__(self, sizes: tuple[int, int, int], hidden_dim: int, dims: int) -> None:
        super().__init__()
        self.trunk = Trunk(*sizes)
        self.head = _mlp(self.trunk.width, hidden_dim, dims)

    def forward(self, features: Features) -> Tensor:
        """-> [B, D]."""
        return torch.tanh(self.head(self.trunk(features)).float())


class TwinCritic(nn.Module):
    """Two Q-functions on one projection."""

    def __init__(self, sizes: tuple[int, int, int], hidden_dim: int, dims: int, atoms: int) -> None:
        super().__init__()
        self.trunk = Trunk(*sizes)
        self.heads = nn.ModuleList(_mlp(self.trunk.width + dims, hidden_dim, atoms) for _ in range(TWINS))

    def forward(self, features: Features, action: Tensor) -> Tensor:
        """Action [B, D] -> logits (or values, A = 1) of both, [B, 2, A]."""
        inputs = torch.cat([self.trunk(features), action], dim=-1)
        return torch.stack([head(inputs) for head in self.heads], dim=1).float()


class DrQv2Model(Model):
    """Encoders, actor, twin critic and its target.

    views: channels, height and width of one frame of each camera; low_dim_size: P, 0 for pixels only; dims: D.
    """

    settings: DrQv2Settings

    def __init__(
        self, views: Mapping[str, tuple[int, int, int]], low_dim_size: int, dims: int, settings: DrQv2Settings
    ) -> None:
        super().__init__(views, settings, plain=True)
        sizes = (self.pixel_size, low_dim_size * settings.frame_stack, settings.feature_dim)
        self.actor = Actor(sizes, settings.hidden_dim, dims)
        self.critic = TwinCritic(sizes, settings.hidden_dim, dims, settings.critic_atoms)
        self.target_critic = TwinCritic(sizes, settings.hidden_dim, dims, settings.critic_atoms)
        initialise(self)
        self.target_critic.load_state_dict(self.critic.state_dict())
        self.target_critic.requires_grad_(False)

    def acting(self) -> Sequence[str]:
        """Encoders, actor, and the critic that says what its action is worth."""
        return "encoders", "actor", "critic"

    def averaged(self) -> Sequence[tuple[nn.Module, nn.Module]]:
        """The target critic follows the critic; DrQ-v2 has no target actor and no target encoder."""
        return [(self.target_critic, self.critic)]

    @torch.no_grad()
    def act(self, observation: Observation, explore: bool = False) -> tuple[Tensor, Tensor]:
        """Mean action [B, D] in [-1, 1], with noise N(0, exploration_noise) to explore, and its lower Q [B]."""
        features = self.encode(observation)
        with self.autocast():
            action = self.actor(features)
            if explore:
                noise = self.settings.exploration_noise * torch.randn_like(action)
                action = (action + noise).clamp(-1, 1)
            logits = self.critic(features, action)
        return action, self.q_values(logits).amin(1)

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Critic loss, actor loss and imitation in one sum, each reaching only the networks that it trains.

        The encoders learn from the critic alone, as in DrQ-v2; without an RL loss they learn from imitation.
        """
        s = self.settings
        features = self.encode(batch.observation)
        imitates_only = s.rl_loss_scale == 0
        with self.autocast():
            mean = self.actor(features if imitates_only else _detached(features))
        total = mean.new_zeros(())
        stats: dict[str, Tensor] = {}
        if s.rl_loss_scale > 0:
            critic, td_error = self._critic_loss(features, batch)
            actor = self._actor_loss(_detached(features), mean)
            total = total + s.rl_loss_scale * (critic + actor)
            stats |= {"rl_loss": critic.detach(), "td_error": td_error, "actor_loss": actor.detach()}
        if s.bc_loss_scale > 0:
            squares = (mean - batch.action).square()
            imitation = demo_mean(squares.sum(-1) if s.bc_sum else squares.mean(-1), batch.demo)
            stats["bc_action_loss"] = imitation.detach()
            total = total + s.bc_loss_scale * imitation
        stats["loss"] = total.detach()
        return total, stats

    def _critic_loss(self, features: Features, batch: Batch) -> tuple[Tensor, Tensor]:
        """Both critics against the target of the lower one: cross-entropy, or squared error with scalar values.

        And the mean absolute difference of their values, both scalars.
        """
        with torch.no_grad():
            target = self.td_target(self.encode(batch.next_observation), batch.reward, batch.discount)[:, None]
        with self.autocast():
            logits = self.critic(features, batch.action)
        expected = target[..., 0]
        if self.settings.distributional:
            errors, expected = -(target * F.log_softmax(logits, dim=-1)).sum(-1), expectation(target, self.support)
        else:
            errors = (logits - target).square().squeeze(-1)
        return errors.sum(1).mean(), (self.q_values(logits.detach()) - expected).abs().mean()

    @torch.no_grad()
    def td_target(self, next_features: Features, reward: Tensor, discount: Tensor) -> Tensor:
        """Target [B, A]: value or distribution of the target critic with the lower value for a noisy next action."""
        with self.autocast():
            logits: Tensor = self.target_critic(next_features, self._noisy(self.actor(next_features)))
        q = self.q_values(logits)  # [B, 2]
        if self.settings.distributional and self.settings.two_hot_target:
            return two_hot((reward + discount * q.amin(1, keepdim=True))[:, 0], self.support)
        lower = q.argmin(1)
        logits = logits[torch.arange(len(logits), device=logits.device), lower]  # [B, A]
        if not self.settings.distributional:
            return reward + discount * logits
        return project_onto_support(F.softmax(logits, dim=-1)[:, None], reward, discount, self.support)[:, 0]

    def _actor_loss(self, features: Features, mean: Tensor) -> Tensor:
        """Minus the lower value of a noisy action; the gradient passes through the critic to the actor only."""
        frozen = {name: value.detach() for name, value in self.critic.named_parameters()}
        with self.autocast():
            logits = torch.func.functional_call(self.critic, frozen, (features, self._noisy(mean)))
        lower = self.q_values(logits).amin(1)
        return -lower.mean()

    def _noisy(self, action: Tensor) -> Tensor:
        """Clipped Gaussian noise inside the action bounds; beyond them the gradient is that of the bound action."""
        s = self.settings
        noise = (s.exploration_noise * torch.randn_like(action)).clamp(-s.noise_clip, s.noise_clip)
        noisy = action + noise
        bounded: Tensor = noisy + (noisy.clamp(-1, 1) - noisy).detach()
        return bounded


def _detached(features: Features) -> Features:
    pixels, low_dim = features
    return (None if pixels is None else pixels.detach()), low_dim
