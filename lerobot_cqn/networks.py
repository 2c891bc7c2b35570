"""Encoders, streams and heads (paper, section 3.2 and table 2). Every size is derived from the features."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .errors import ConfigError

__all__ = ["CoarseToFineNetwork", "Projected", "Stream", "ViewEncoder", "initialise", "projection", "zero_head"]

# Kernel, stride and padding of every convolution (table 2; the kernel is the authors' choice).
KERNEL, STRIDE, PADDING = 4, 2, 1
LAYER_NORM_EPS = 1e-5


class ViewEncoder(nn.Module):
    """Convolutions with layer norm over the channels at each pixel and SiLU, for one camera view.

    plain: ReLU and no norm instead, as in DrQ-v2.
    """

    def __init__(self, in_channels: int, height: int, width: int, channels: Sequence[int], plain: bool = False) -> None:
        super().__init__()
        self.plain = plain
        sizes = [in_channels, *channels]
        self.convolutions = nn.ModuleList(nn.Conv2d(a, b, KERNEL, STRIDE, PADDING) for a, b in pairwise(sizes))
        self.norms = nn.ModuleList(nn.Identity() if plain else nn.LayerNorm(c, eps=LAYER_NORM_EPS) for c in channels)
        for _ in channels:
            height, width = (
                (height + 2 * PADDING - KERNEL) // STRIDE + 1,
                (width + 2 * PADDING - KERNEL) // STRIDE + 1,
            )
        if min(height, width) < 1:
            raise ConfigError(
                f"Images are too small for {len(channels)} convolutions of stride {STRIDE}: expected at least "
                f"{STRIDE ** len(channels)} pixels a side; resize them or shorten `encoder_channels`."
            )
        self.out_features = channels[-1] * height * width

    def forward(self, pixels: Tensor) -> Tensor:
        """[B, 3*S, H, W] float in [-0.5, 0.5] -> [B, out_features]."""
        for convolution, norm in zip(self.convolutions, self.norms, strict=True):
            # Layer norm over the last axis of the channels-last view: no copy when memory is channels-last.
            features = norm(convolution(pixels).permute(0, 2, 3, 1))
            activate = F.relu if self.plain else F.silu
            pixels = activate(features, inplace=not features.requires_grad).permute(0, 3, 1, 2)
        return pixels.flatten(1)


class Projected(NamedTuple):
    """An observation after everything that does not depend on level or action; one [B, H] per stream."""

    advantage: Tensor
    value: Tensor


def projection(inputs: int, outputs: int, bias: bool = False) -> nn.Sequential:
    """Linear, layer norm, tanh: what observations pass on their way into a trunk."""
    return nn.Sequential(nn.Linear(inputs, outputs, bias=bias), nn.LayerNorm(outputs, eps=LAYER_NORM_EPS), nn.Tanh())


class Stream(nn.Module):
    """One of the two dueling streams: projections, a two-layer trunk and a head.

    The trunk's input is [pixels F | low-dim F | previous-level action D | one-hot level L].
    """

    def __init__(
        self,
        pixel_size: int,
        low_dim_size: int,
        feature_dim: int,
        hidden_dim: int,
        dims: int,
        levels: int,
        out: int,
    ) -> None:
        super().__init__()
        self.pixel_projection = projection(pixel_size, feature_dim) if pixel_size else None
        self.low_dim_projection = projection(low_dim_size, feature_dim) if low_dim_size else None
        self.feature_size = feature_dim * (bool(pixel_size) + bool(low_dim_size))
        self.action_dims = dims
        self.first = nn.Linear(self.feature_size + dims + levels, hidden_dim, bias=False)
        self.first_norm = nn.LayerNorm(hidden_dim, eps=LAYER_NORM_EPS)
        self.second = nn.Linear(hidden_dim, hidden_dim, bias=False)
        self.second_norm = nn.LayerNorm(hidden_dim, eps=LAYER_NORM_EPS)
        self.head = nn.Linear(hidden_dim, out)

    def project(self, pixels: Tensor | None, low_dim: Tensor | None) -> Tensor:
        """Observation part of the first trunk layer, once per observation: -> [B, H]."""
        parts = []
        if self.pixel_projection is not None:
            parts.append(self.pixel_projection(pixels))
        if self.low_dim_projection is not None:
            parts.append(self.low_dim_projection(low_dim))
        return F.linear(torch.cat(parts, dim=-1), self.first.weight[:, : self.feature_size])

    def forward(self, projected: Tensor, previous: Tensor, levels: Tensor) -> Tensor:
        """[B, H], previous-level action [B, K, D], level numbers int64 [K] -> [B, K, out]."""
        split = self.feature_size + self.action_dims
        hidden = (
            projected[:, None]
            + F.linear(previous, self.first.weight[:, self.feature_size : split])
            + self.first.weight[:, split:].T[levels]
        )
        hidden = F.silu(self.first_norm(hidden))
        hidden = F.silu(self.second_norm(self.second(hidden)))
        out: Tensor = self.head(hidden)
        return out


class CoarseToFineNetwork(nn.Module):
    """Q-network of equation 1: dueling streams shared by all levels and dimensions."""

    def __init__(
        self,
        pixel_size: int,
        low_dim_size: int,
        feature_dim: int,
        hidden_dim: int,
        dims: int,
        levels: int,
        bins: int,
        atoms: int,
    ) -> None:
        super().__init__()
        self.dims, self.levels, self.bins, self.atoms = dims, levels, bins, atoms
        sizes = (pixel_size, low_dim_size, feature_dim, hidden_dim, dims, levels)
        self.advantage = Stream(*sizes, dims * bins * atoms)
        self.value = Stream(*sizes, dims * atoms)

    def project(self, pixels: Tensor | None, low_dim: Tensor | None) -> Projected:
        """Pixel features [B, E] or None and low-dim values [B, S*P] or None -> what `forward` starts from."""
        return Projected(self.advantage.project(pixels, low_dim), self.value.project(pixels, low_dim))

    def forward(self, projected: Projected, previous: Tensor, levels: Tensor) -> Tensor:
        """Logits of all bins at K levels: previous [B, K, D], levels [K] -> float32 [B, K, D, N, A]."""
        batch, count = previous.shape[:2]
        advantage = self.advantage(projected.advantage, previous, levels).float()
        value = self.value(projected.value, previous, levels).float()
        advantage = advantage.view(batch, count, self.dims, self.bins, self.atoms)
        value = value.view(batch, count, self.dims, 1, self.atoms)
        # A sum, then a division of the small result: the gradient of `mean` would be a pass over all logits.
        logits: Tensor = advantage + (value - advantage.sum(-2, keepdim=True) / self.bins)
        return logits


def initialise(module: nn.Module) -> None:
    """Orthogonal weights (gain of ReLU for convolutions), zero biases, unit layer norms."""
    for layer in module.modules():
        if isinstance(layer, nn.Conv2d | nn.Linear):
            gain = nn.init.calculate_gain("relu") if isinstance(layer, nn.Conv2d) else 1.0
            nn.init.orthogonal_(layer.weight, gain)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


def zero_head(stream: Stream) -> None:
    """Zero output: a new critic is uniform over atoms and has no preference among bins."""
    nn.init.zeros_(stream.head.weight)
    nn.init.zeros_(stream.head.bias)
