"""Algorithms 1 and 2 of the paper, line by line: plain, slow and written apart from the production code.

Loops over levels and dimensions: every Q^{l,n} is one call of the network, which projects the features anew and
ends in the slice of the head that belongs to dimension n. Comments cite the lines of the pseudocode ("A1.8" is
Algorithm 1, line 8). Only the weights come from the production code, by name from a CQNModel's state_dict.
`dtype=torch.float64` gives the reference that rounding is measured against.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from lerobot_cqn.critic import CQNModel
from lerobot_cqn.schema import Batch, Observation

Features = tuple[Tensor | None, Tensor | None]


class Oracle:
    """A copy of a model's weights, with everything needed to update them."""

    def __init__(self, model: CQNModel, dtype: torch.dtype = torch.float32) -> None:
        # A2.2: parameters theta and target parameters theta-bar
        self.settings, self.dtype, self.dims = model.settings, dtype, model.critic.shape.dims
        self.views = len(model.encoders)
        self.weights: dict[str, Tensor] = {}
        for name, weight in model.state_dict().items():
            copy = weight.detach().to(dtype, copy=True).contiguous()
            self.weights[name] = copy.requires_grad_(not name.startswith("target_critic."))
        s = self.settings
        step = (s.v_max - s.v_min) / (s.atoms - 1)
        self.atoms = torch.tensor([s.v_min + step * atom for atom in range(s.atoms)], dtype=dtype)
        trained = [weight for weight in self.weights.values() if weight.requires_grad]
        self.optimizer = torch.optim.AdamW(trained, lr=s.lr, weight_decay=s.weight_decay, foreach=False, fused=False)

    # -- networks --------------------------------------------------------------------------------------------

    def encode(self, observation: Observation) -> Features:
        """A2.6: feature h_t of an observation; pixels [B, 3*S, H, W] in [0, 255] -> [B, E]."""
        outputs = []
        for view, pixels in enumerate(observation.pixels):
            scale = 255 if pixels.dtype == torch.uint8 else 1
            x = pixels.to(self.dtype) / scale - 0.5
            for layer in range(len(self.settings.encoder_channels)):
                name = f"encoders.{view}"
                x = F.conv2d(
                    x,
                    self.weights[f"{name}.convolutions.{layer}.weight"],
                    self.weights[f"{name}.convolutions.{layer}.bias"],
                    stride=2,
                    padding=1,
                )
                x = self.layer_norm(x.permute(0, 2, 3, 1), f"{name}.norms.{layer}").permute(0, 3, 1, 2)
                x = F.silu(x)
            outputs.append(x.reshape(x.shape[0], -1))
        pixels = torch.cat(outputs, dim=1) if outputs else None
        low_dim = None if observation.low_dim is None else observation.low_dim.to(self.dtype)
        return pixels, low_dim

    def layer_norm(self, x: Tensor, name: str) -> Tensor:
        weight, bias = self.weights[f"{name}.weight"], self.weights[f"{name}.bias"]
        return F.layer_norm(x, x.shape[-1:], weight, bias, eps=1e-5)

    def stream(self, name: str, features: Features, level: int, previous: Tensor, outputs: slice) -> Tensor:
        """One dueling stream up to the `outputs` of its head: previous [B, D] -> [B, outputs]."""
        parts = []
        for value, projection in zip(features, ("pixel_projection", "low_dim_projection"), strict=True):
            if value is not None:
                projected = value @ self.weights[f"{name}.{projection}.0.weight"].T
                parts.append(torch.tanh(self.layer_norm(projected, f"{name}.{projection}.1")))
        one_hot = torch.zeros(previous.shape[0], self.settings.levels, dtype=self.dtype)
        one_hot[:, level] = 1
        hidden = torch.cat([*parts, previous, one_hot], dim=1)
        for layer in ("first", "second"):
            hidden = hidden @ self.weights[f"{name}.{layer}.weight"].T
            hidden = F.silu(self.layer_norm(hidden, f"{name}.{layer}_norm"))
        return hidden @ self.weights[f"{name}.head.weight"][outputs].T + self.weights[f"{name}.head.bias"][outputs]

    def network(self, critic: str, features: Features, level: int, n: int, previous: Tensor) -> Tensor:
        """Q^{l,n}(h, ., a^{l-1}) for all bins of one level and dimension: logits [B, N, A]."""
        bins, atoms = self.settings.bins, self.settings.critic_atoms
        here = slice(n * bins * atoms, (n + 1) * bins * atoms)
        advantage = self.stream(f"{critic}.advantage", features, level, previous, here).reshape(-1, bins, atoms)
        value = self.stream(f"{critic}.value", features, level, previous, slice(n * atoms, (n + 1) * atoms))
        return torch.stack([value + advantage[:, i] - advantage.mean(1) for i in range(bins)], dim=1)

    def mean_value(self, logits: Tensor) -> Tensor:
        """Q of logits [..., A] -> [...]."""
        if not self.settings.distributional:
            return logits[..., 0]
        probs = torch.softmax(logits, dim=-1)
        q = torch.zeros(probs.shape[:-1], dtype=self.dtype)
        for atom in range(self.settings.atoms):
            q = q + probs[..., atom] * self.atoms[atom]
        return q

    # -- Algorithm 1 -----------------------------------------------------------------------------------------

    def inference(
        self, critic: str, features: Features, action: Tensor | None = None
    ) -> tuple[Tensor, list[list[Tensor]], list[list[Tensor]]]:
        """Coarse-to-fine inference, greedy unless `action` [B, D] is given.

        Returns the action of the last level [B, D] and, for each level and dimension, the chosen bin [B] and the
        logits of all bins [B, N, A].
        """
        s = self.settings
        batch = next(value.shape[0] for value in features if value is not None)
        low = [torch.full((batch,), -1.0, dtype=self.dtype) for _ in range(self.dims)]  # A1.3
        high = [torch.full((batch,), 1.0, dtype=self.dtype) for _ in range(self.dims)]
        previous = torch.zeros(batch, self.dims, dtype=self.dtype)  # A1.4
        chosen: list[list[Tensor]] = []
        logits: list[list[Tensor]] = []
        for level in range(s.levels):  # A1.5
            chosen.append([])
            logits.append([])
            centres = []
            for n in range(self.dims):  # A1.6
                width = (high[n] - low[n]) / s.bins  # A1.8
                logits[level].append(self.network(critic, features, level, n, previous))  # A1.13, A1.15
                if action is not None:  # A1.10
                    index = torch.zeros(batch, dtype=torch.int64)  # A1.11
                    for edge in range(1, s.bins):
                        index = index + (action[:, n] >= low[n] + edge * width)
                else:  # A1.14
                    index = self.mean_value(logits[level][n].detach()).argmax(1)  # A1.15
                chosen[level].append(index)
                low[n], high[n] = low[n] + index * width, low[n] + (index + 1) * width  # A1.19
                centres.append((low[n] + high[n]) / 2)  # A1.12, A1.16
            previous = torch.stack(centres, dim=1)  # A1.22
        return previous, chosen, logits  # A1.26, A1.28

    # -- Algorithm 2 -----------------------------------------------------------------------------------------

    def project(self, probs: Tensor, reward: Tensor, discount: Tensor) -> Tensor:
        """Distribution of reward + discount * Z on the fixed atoms, atom by atom: [B, A], [B], [B] -> [B, A]."""
        s = self.settings
        step = (s.v_max - s.v_min) / (s.atoms - 1)
        projected = torch.zeros_like(probs)
        for atom in range(s.atoms):
            value = (reward + discount * self.atoms[atom]).clamp(s.v_min, s.v_max)
            position = ((value - s.v_min) / step).clamp(0, s.atoms - 1)
            below = position.floor()
            share = position - below
            above = (below + 1).clamp(max=s.atoms - 1)
            projected.scatter_add_(1, below.long()[:, None], (probs[:, atom] * (1 - share))[:, None])
            projected.scatter_add_(1, above.long()[:, None], (probs[:, atom] * share)[:, None])
        return projected

    @torch.no_grad()
    def target(self, next_features: Features, reward: Tensor, discount: Tensor) -> list[list[Tensor]]:
        """What the taken bin is pulled to at each level and dimension: [B, A], or [B] when scalar."""
        s = self.settings
        chooser = "critic" if s.next_action_from == "online" else "target_critic"
        next_action, path, _ = self.inference(chooser, next_features)
        _, _, logits = self.inference("target_critic", next_features, next_action)
        rows = torch.arange(len(reward))
        targets: list[list[Tensor]] = []
        for level in range(s.levels):
            targets.append([])
            for n in range(self.dims):
                taken = logits[level][n][rows, path[level][n]]
                if s.distributional:
                    targets[level].append(self.project(torch.softmax(taken, dim=1), reward, discount))
                else:
                    targets[level].append(reward + discount * taken[:, 0])
        return targets

    def dominance(self, probs: Tensor, expert: Tensor) -> Tensor:
        """First-order stochastic dominance, sample by bin: [B, N, A], [B] -> [B], mean over bins."""
        rows = torch.arange(len(expert))
        total = torch.zeros(len(expert), dtype=self.dtype)
        for bin_ in range(self.settings.bins):
            cdf_expert, cdf_other = torch.zeros_like(total), torch.zeros_like(total)
            for atom in range(self.settings.atoms):
                cdf_expert = cdf_expert + probs[rows, expert, atom]
                cdf_other = cdf_other + probs[:, bin_, atom]
                total = total + (cdf_expert - cdf_other).clamp(min=0)
        return total / self.settings.bins

    def margin(self, q: Tensor, expert: Tensor) -> Tensor:
        """max(0, m - (Q(expert) - Q(other))): [B, N], [B] -> [B], mean over bins."""
        q_expert = q[torch.arange(len(expert)), expert]
        total = torch.zeros_like(q_expert)
        for bin_ in range(self.settings.bins):
            total = total + (self.settings.bc_margin - (q_expert - q[:, bin_])).clamp(min=0)
        return total / self.settings.bins

    def demo_mean(self, per_sample: Tensor, demo: Tensor) -> Tensor:
        """Mean over the demonstrations, 0 without any: [B], [B, 1] -> scalar."""
        rows = [row for row in range(len(demo)) if demo[row, 0] == 1]
        return per_sample[rows].mean() if rows else per_sample.new_zeros(())

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of an already augmented batch, and its parts (before their scales)."""
        features = self.encode(batch.observation)  # A2.6
        with torch.no_grad():
            next_features = self.encode(batch.next_observation)
        return self.loss_of_features(features, next_features, batch)

    def loss_of_features(
        self, features: Features, next_features: Features, batch: Batch
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The same where the encoder's output is already there."""
        s = self.settings
        action = batch.action.to(self.dtype)
        reward, discount = batch.reward[:, 0].to(self.dtype), batch.discount[:, 0].to(self.dtype)
        rows = torch.arange(len(action))
        share = 1 / (self.dims * s.levels)
        zero = torch.zeros((), dtype=self.dtype)
        total, rl, margin, dominance, td_error = zero, zero, zero, zero, zero  # A2.11
        _, expert, logits = self.inference("critic", features, action)
        targets = self.target(next_features, reward, discount) if s.rl_loss_scale > 0 else None
        for level in range(s.levels):  # A2.13
            for n in range(self.dims):  # A2.14
                bins, taken = logits[level][n], expert[level][n]
                rl_here, bc_here = zero, zero
                if targets is not None:  # A2.15
                    if s.distributional:
                        log_probs = torch.log_softmax(bins[rows, taken], dim=1)
                        rl_here = -(targets[level][n] * log_probs).sum(1).mean()
                    else:
                        rl_here = ((bins[rows, taken, 0] - targets[level][n]) ** 2).mean()
                    rl = rl + share * rl_here
                    wanted = targets[level][n]
                    wanted = wanted @ self.atoms if s.distributional else wanted
                    td_error = td_error + share * (self.mean_value(bins[rows, taken]) - wanted).abs().mean()
                if s.bc_loss_scale > 0:  # A2.16
                    margin_here = self.demo_mean(self.margin(self.mean_value(bins), taken), batch.demo)
                    margin, bc_here = margin + share * margin_here, margin_here
                    if s.distributional and s.bc_dominance:
                        probs = torch.softmax(bins, dim=-1)
                        dominance_here = self.demo_mean(self.dominance(probs, taken), batch.demo)
                        dominance, bc_here = dominance + share * dominance_here, bc_here + dominance_here
                total = total + share * (s.rl_loss_scale * rl_here + s.bc_loss_scale * bc_here)  # A2.17
        parts = {"loss": total, "rl_loss": rl, "td_error": td_error, "bc_margin_loss": margin}
        parts["bc_dominance_loss"] = dominance
        return total, {name: value.detach() for name, value in parts.items()}

    def step(self) -> None:
        """A2.20 and A2.21, after the gradients are there."""
        self.optimizer.step()
        with torch.no_grad():
            for name, average in self.weights.items():
                if name.startswith("target_critic."):
                    theta = self.weights[name.removeprefix("target_")]
                    average.copy_((1 - self.settings.tau) * average + self.settings.tau * theta)

    def augment(self, observation: Observation, generator: torch.Generator | None = None) -> Observation:
        """Random shift of every view."""
        pad, views = self.settings.shift_pixels, []
        for pixels in observation.pixels:
            offset = torch.randint(2 * pad + 1, (2, pixels.shape[0]), generator=generator)
            views.append(shift(pixels.to(self.dtype) / 255, pad, offset))
        return Observation(tuple(views), observation.low_dim)

    def update(self, batch: Batch) -> dict[str, Tensor]:
        """One pass of A2.11 to A2.21 on a batch that is not augmented yet."""
        observation, next_observation = self.augment(batch.observation), self.augment(batch.next_observation)
        batch = Batch(
            observation=observation,
            action=batch.action,
            reward=batch.reward,
            discount=batch.discount,
            next_observation=next_observation,
            demo=batch.demo,
        )
        return self.update_augmented(batch)

    def update_augmented(self, batch: Batch) -> dict[str, Tensor]:
        """The same on an augmented batch."""
        loss, parts = self.loss(batch)
        self.optimizer.zero_grad()
        loss.backward()
        self.step()
        return parts


def shift(pixels: Tensor, pad: int, offset: Tensor) -> Tensor:
    """Random shift as in DrQ-v2: pad by repeating the border, then bilinear grid sampling at whole pixels.

    pixels: float [B, C, H, W]; offset: int64 [2, B], rows and columns in 0..2*pad.
    """
    batch, _, height, width = pixels.shape
    padded = F.pad(pixels, (pad, pad, pad, pad), "replicate")
    axes = []
    for size, moved in ((width, offset[1]), (height, offset[0])):
        whole = size + 2 * pad
        ticks = torch.linspace(-1 + 1 / whole, 1 - 1 / whole, whole, dtype=pixels.dtype)[:size]
        axes.append(ticks + moved[:, None] * (2 / whole))  # [B, size]
    grid = torch.stack(
        [axes[0][:, None, :].expand(batch, height, width), axes[1][:, :, None].expand(batch, height, width)], dim=-1
    )
    return F.grid_sample(padded, grid, mode="bilinear", padding_mode="zeros", align_corners=False)


def largest_share(got: Tensor, expected: Tensor) -> float:
    """Largest deviation relative to the largest expected value; 0 for two empty or zero tensors."""
    worst = float((got.double() - expected.double()).abs().max())
    scale = float(expected.double().abs().max())
    return 0.0 if worst == 0 else worst / max(scale, math.ulp(1.0))
