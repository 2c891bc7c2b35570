"""The coarse-to-fine critic: action selection (Algorithm 1) and the loss (Algorithm 2) over all levels."""

from collections.abc import Mapping
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .augmentation import colour_jitter, random_shift
from .distributional import expectation, project, support
from .intervals import decode, encode, previous_centres, zoom
from .losses import (
    demo_mean,
    dominance_loss,
    margin_loss,
    mean_log_probs,
    q_learning_loss,
    scalar_q_learning_loss,
    take_bin,
)
from .networks import CoarseToFineNetwork, Projected, ViewEncoder, initialise, zero_head
from .schema import Batch, Observation
from .settings import CQNSettings

__all__ = ["CQNModel"]

Features = tuple[Tensor | None, Tensor | None]


class CQNModel(nn.Module):
    """Encoders, online critic and target critic; everything a checkpoint must carry to act as trained.

    views: channels, height and width of one frame of each camera; low_dim_size: P, 0 for pixels only;
    dims: D.
    """

    support: Tensor

    def __init__(
        self, views: Mapping[str, tuple[int, int, int]], low_dim_size: int, dims: int, settings: CQNSettings
    ) -> None:
        super().__init__()
        self.settings = settings
        stack = settings.frame_stack
        encoders = [
            ViewEncoder(c * stack, height, width, settings.encoder_channels) for c, height, width in views.values()
        ]
        self.encoders = nn.ModuleList(encoders)
        pixel_size = sum(encoder.out_features for encoder in encoders)
        sizes = (pixel_size, low_dim_size * stack, settings.feature_dim, settings.hidden_dim, dims)
        shape = (settings.levels, settings.bins, settings.critic_atoms)
        self.critic = CoarseToFineNetwork(*sizes, *shape)
        self.target_critic = CoarseToFineNetwork(*sizes, *shape)
        initialise(self)
        zero_head(self.critic.advantage)
        zero_head(self.critic.value)
        self.target_critic.load_state_dict(self.critic.state_dict())
        self.target_critic.requires_grad_(False)
        values = support(settings.v_min, settings.v_max, settings.critic_atoms)
        self.register_buffer("support", values, persistent=False)

    # -- observation ---------------------------------------------------------------------------------------

    def augment(self, observation: Observation, generator: torch.Generator | None = None) -> Observation:
        """Random shift, and colour jitter where it is on, drawn anew for each view and each call."""
        s = self.settings
        views = tuple(random_shift(view, s.shift_pixels, generator) for view in observation.pixels)
        if s.brightness or s.contrast:
            views = tuple(colour_jitter(_unit(v), s.brightness, s.contrast, generator) for v in views)
        return Observation(views, observation.low_dim)

    def augment_batch(self, batch: Batch) -> Batch:
        """The batch with both observations augmented, each on its own."""
        return replace(
            batch,
            observation=self.augment(batch.observation),
            next_observation=self.augment(batch.next_observation),
        )

    def encode(self, observation: Observation) -> Features:
        """Pixel features [B, E] (None without cameras) and low-dim values [B, S*P] (None without state)."""
        if not observation.pixels:
            return None, observation.low_dim
        # Pictures only: LeRobot cannot save the optimiser state of weights in this layout, which gain nothing from it.
        layout = torch.channels_last if self.settings.channels_last else torch.contiguous_format
        with self._autocast():
            views = [
                encoder(_centred(view, layout)) for encoder, view in zip(self.encoders, observation.pixels, strict=True)
            ]
        return torch.cat(views, dim=-1), observation.low_dim

    def project(self, critic: CoarseToFineNetwork, features: Features) -> Projected:
        """First layers of a critic, once per observation."""
        with self._autocast():
            projected: Projected = critic.project(*features)
        return projected

    def _autocast(self) -> torch.autocast:
        return torch.autocast(self.support.device.type, dtype=torch.bfloat16, enabled=self.settings.bf16)

    # -- values --------------------------------------------------------------------------------------------

    def q_values(self, logits: Tensor) -> Tensor:
        """Q of each bin: [..., A] logits -> [...]."""
        if not self.settings.distributional:
            return logits[..., 0]
        return expectation(F.softmax(logits, dim=-1), self.support)

    def evaluate(self, critic: CoarseToFineNetwork, projected: Projected, indices: Tensor) -> Tensor:
        """Logits along a known path, all levels in one pass: indices [B, L, D] -> [B, L, D, N, A]."""
        previous = previous_centres(indices, self.settings.bins)
        levels = torch.arange(self.settings.levels, device=indices.device)
        with self._autocast():
            logits: Tensor = critic(projected, previous, levels)
        return logits

    @torch.no_grad()
    def greedy(
        self, critic: CoarseToFineNetwork, projected: Projected, random_below: float = 0.0
    ) -> tuple[Tensor, Tensor]:
        """Algorithm 1 without input actions: indices [B, L, D] and the mean Q of the chosen bins [B].

        random_below: where Q spreads less than this over the bins, a random bin is taken (0: never).
        """
        s = self.settings
        low = torch.full((projected.value.shape[0], critic.dims), -1.0, device=projected.value.device)
        high = -low
        indices, chosen = [], []
        for level in range(s.levels):
            centre = (low + high) / 2 if level else torch.zeros_like(low)
            with self._autocast():
                logits = critic(projected, centre[:, None], torch.tensor([level], device=low.device))
            q = self.q_values(logits[:, 0])  # [B, D, N]
            index = q.argmax(-1)
            if random_below > 0:
                flat = (q.amax(-1) - q.amin(-1)) < random_below
                index = torch.where(flat, torch.randint_like(index, s.bins), index)
            chosen.append(q.gather(-1, index[..., None])[..., 0])
            indices.append(index)
            low, high = zoom(low, high, index, s.bins)
        return torch.stack(indices, dim=1), torch.stack(chosen).mean((0, 2))

    @torch.no_grad()
    def act(self, observation: Observation, explore: bool = False) -> tuple[Tensor, Tensor]:
        """Greedy action [B, D] in [-1, 1] and its mean Q [B], from the critic that `act_with` names."""
        s = self.settings
        critic = self.target_critic if s.act_with == "target" else self.critic
        projected = self.project(critic, self.encode(observation))
        indices, q = self.greedy(critic, projected, s.random_bin_below if explore else 0.0)
        return decode(indices, s.bins), q

    # -- learning ------------------------------------------------------------------------------------------

    @torch.no_grad()
    def td_target(self, next_features: Features, reward: Tensor, discount: Tensor) -> Tensor:
        """Target of the taken action: distribution [B, L, D, A], or scalar values [B, L, D].

        The next action is greedy under the online critic, its value is read from the target critic along
        that same path (the authors' implementation); `next_action_from="target"` is equation 2 as written.
        """
        s = self.settings
        target = self.project(self.target_critic, next_features)
        if s.next_action_from == "online":
            path, _ = self.greedy(self.critic, self.project(self.critic, next_features))
        else:
            path, _ = self.greedy(self.target_critic, target)
        logits = take_bin(self.evaluate(self.target_critic, target, path), path)[..., 0, :]  # [B, L, D, A]
        if not s.distributional:
            return reward[..., None] + discount[..., None] * logits[..., 0]
        return project(F.softmax(logits, dim=-1), reward, discount, self.support)

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of Algorithm 2 and its parts (detached scalars) for an already augmented batch."""
        s = self.settings
        projected = self.project(self.critic, self.encode(batch.observation))
        indices = encode(batch.action, s.levels, s.bins)
        logits = self.evaluate(self.critic, projected, indices)
        total = logits.new_zeros(())
        stats: dict[str, Tensor] = {}
        if s.rl_loss_scale > 0:
            with torch.no_grad():
                target = self.td_target(self.encode(batch.next_observation), batch.reward, batch.discount)
            taken = take_bin(logits, indices)[..., 0, :]
            if s.centralized_critic:
                taken = mean_log_probs(taken) if s.distributional else taken.mean(2, keepdim=True)
                target = target.mean(2, keepdim=True)
            if s.distributional:
                rl = q_learning_loss(taken, target).mean()
            else:
                rl = scalar_q_learning_loss(taken[..., 0], target).mean()
            total = total + s.rl_loss_scale * rl
            stats["rl_loss"] = rl.detach()
        if s.bc_loss_scale > 0:
            probs = F.softmax(logits, dim=-1) if s.distributional else logits
            q = expectation(probs, self.support) if s.distributional else logits[..., 0]
            bc = demo_mean(margin_loss(q, indices, s.bc_margin), batch.demo)
            stats["bc_margin_loss"] = bc.detach()
            if s.distributional and s.bc_dominance:
                dominance = demo_mean(dominance_loss(probs, indices), batch.demo)
                stats["bc_dominance_loss"] = dominance.detach()
                bc = bc + dominance
            total = total + s.bc_loss_scale * bc
        stats["loss"] = total.detach()
        return total, stats

    @torch.no_grad()
    def update_target(self) -> None:
        """Polyak step of the target critic: target <- (1 - tau) * target + tau * online (Algorithm 2, last line)."""
        torch._foreach_lerp_(list(self.target_critic.parameters()), list(self.critic.parameters()), self.settings.tau)


def _unit(pixels: Tensor) -> Tensor:
    """uint8 in [0, 255] -> float in [0, 1]; floats pass."""
    return pixels.float() / 255 if pixels.dtype == torch.uint8 else pixels


def _centred(pixels: Tensor, layout: torch.memory_format) -> Tensor:
    """uint8 in [0, 255] or float in [0, 1] -> float in [-0.5, 0.5] in the given memory layout."""
    if pixels.dtype == torch.uint8:  # the layout changes while values are small, the rest is in place
        return pixels.to(torch.float32, memory_format=layout).div_(255).sub_(0.5)
    return (pixels - 0.5).contiguous(memory_format=layout)
