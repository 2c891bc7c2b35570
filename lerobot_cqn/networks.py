"""Encoders, streams and heads (paper, section 3.2 and table 2). Every size is derived from the features."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .errors import ConfigError

__all__ = [
    "CoarseToFineNetwork",
    "NetworkShape",
    "Precomputed",
    "Stream",
    "ViewEncoder",
    "initialise",
    "projection",
    "zero_head",
]

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


@dataclass(frozen=True, kw_only=True)
class NetworkShape:
    """Sizes of a coarse-to-fine network.

    pixel_size: E, features of all cameras together, 0 without; low_dim_size: S*P values, 0 without; feature_dim: F of
    each projection; hidden_dim: H of the trunk; dims, levels, bins, atoms: D, L, N, A.
    """

    pixel_size: int
    low_dim_size: int
    feature_dim: int
    hidden_dim: int
    dims: int
    levels: int
    bins: int
    atoms: int

    @property
    def feature_size(self) -> int:
        """Values of an observation that enter the trunk."""
        return self.feature_dim * (bool(self.pixel_size) + bool(self.low_dim_size))


class Precomputed(NamedTuple):
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

    def __init__(self, shape: NetworkShape, out: int) -> None:
        super().__init__()
        self.shape, hidden_dim = shape, shape.hidden_dim
        self.pixel_projection = projection(shape.pixel_size, shape.feature_dim) if shape.pixel_size else None
        self.low_dim_projection = projection(shape.low_dim_size, shape.feature_dim) if shape.low_dim_size else None
        self.first = nn.Linear(shape.feature_size + shape.dims + shape.levels, hidden_dim, bias=False)
        self.first_norm = nn.LayerNorm(hidden_dim, eps=LAYER_NORM_EPS)
        self.second = nn.Linear(hidden_dim, hidden_dim, bias=False)
        self.second_norm = nn.LayerNorm(hidden_dim, eps=LAYER_NORM_EPS)
        self.head = nn.Linear(hidden_dim, out)

    def precompute(self, pixels: Tensor | None, low_dim: Tensor | None) -> Tensor:
        """Observation part of the first trunk layer, once per observation: -> [B, H]."""
        parts = []
        if self.pixel_projection is not None:
            parts.append(self.pixel_projection(pixels))
        if self.low_dim_projection is not None:
            parts.append(self.low_dim_projection(low_dim))
        return F.linear(torch.cat(parts, dim=-1), self.first.weight[:, : self.shape.feature_size])

    def forward(self, precomputed: Tensor, previous: Tensor, levels: Tensor) -> Tensor:
        """[B, H], previous-level action [B, K, D], level numbers int64 [K] -> [B, K, out]."""
        features, split = self.shape.feature_size, self.shape.feature_size + self.shape.dims
        hidden = (
            precomputed[:, None]
            + F.linear(previous, self.first.weight[:, features:split])
            + self.first.weight[:, split:].T[levels]
        )
        hidden = F.silu(self.first_norm(hidden))
        hidden = F.silu(self.second_norm(self.second(hidden)))
        out: Tensor = self.head(hidden)
        return out


class CoarseToFineNetwork(nn.Module):
    """Q-network of equation 1: dueling streams shared by all levels and dimensions."""

    def __init__(self, shape: NetworkShape) -> None:
        super().__init__()
        self.shape = shape
        self.advantage = Stream(shape, shape.dims * shape.bins * shape.atoms)
        self.value = Stream(shape, shape.dims * shape.atoms)

    def precompute(self, pixels: Tensor | None, low_dim: Tensor | None) -> Precomputed:
        """Pixel features [B, E] or None and low-dim values [B, S*P] or None -> what `forward` starts from."""
        return Precomputed(self.advantage.precompute(pixels, low_dim), self.value.precompute(pixels, low_dim))

    def forward(self, precomputed: Precomputed, previous: Tensor, levels: Tensor) -> Tensor:
        """Logits of all bins at K levels: previous [B, K, D], levels [K] -> float32 [B, K, D, N, A]."""
        (batch, count), s = previous.shape[:2], self.shape
        advantage = self.advantage(precomputed.advantage, previous, levels).float()
        value = self.value(precomputed.value, previous, levels).float()
        advantage = advantage.view(batch, count, s.dims, s.bins, s.atoms)
        value = value.view(batch, count, s.dims, 1, s.atoms)
        # A sum, then a division of the small result: the gradient of `mean` would be a pass over all logits.
        logits: Tensor = advantage + (value - advantage.sum(-2, keepdim=True) / s.bins)
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
