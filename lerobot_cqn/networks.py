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
    "SequenceStream",
    "Stream",
    "ViewEncoder",
    "initialise",
    "projection",
    "zero_head",
]

STRIDE = 2  # of a convolution where none is given (table 2)
LAYER_NORM_EPS = 1e-5


class ViewEncoder(nn.Module):
    """Convolutions with layer norm over the channels at each pixel and SiLU, for one camera view.

    strides: of each convolution, empty: 2 each; norm: over the "channels" at each pixel, or over the whole "picture"
    (group norm of one group). plain: ReLU and no norm instead, as in DrQ-v2.
    """

    def __init__(
        self,
        in_channels: int,
        height: int,
        width: int,
        channels: Sequence[int],
        *,
        strides: Sequence[int] = (),
        kernel: int = 4,
        padding: int = 1,
        norm: str = "channels",
        plain: bool = False,
    ) -> None:
        super().__init__()
        self.plain, self.whole = plain, norm == "picture" and not plain
        sizes, strides = [in_channels, *channels], strides or [STRIDE] * len(channels)
        self.convolutions = nn.ModuleList(
            nn.Conv2d(a, b, kernel, stride, padding) for (a, b), stride in zip(pairwise(sizes), strides, strict=True)
        )
        self.norms = nn.ModuleList(self._norm(count) for count in channels)
        given = f"{height} x {width}"
        for stride in strides:
            height, width = ((size + 2 * padding - kernel) // stride + 1 for size in (height, width))
        if min(height, width) < 1:
            raise ConfigError(
                f"Images of {given} pixels are too small for {len(channels)} convolutions of strides {[*strides]}: "
                "resize them, or shorten `encoder_channels`."
            )
        self.out_features = channels[-1] * height * width

    def _norm(self, channels: int) -> nn.Module:
        if self.plain:
            return nn.Identity()
        whole = nn.GroupNorm(1, channels, eps=LAYER_NORM_EPS)
        return whole if self.whole else nn.LayerNorm(channels, eps=LAYER_NORM_EPS)

    def forward(self, pixels: Tensor) -> Tensor:
        """[B, 3*S, H, W] float in [-0.5, 0.5] -> [B, out_features]."""
        for convolution, norm in zip(self.convolutions, self.norms, strict=True):
            if self.whole:
                pixels = F.silu(norm(convolution(pixels)))
                continue
            # Layer norm over the last axis of the channels-last view: no copy when memory is channels-last.
            features = norm(convolution(pixels).permute(0, 2, 3, 1))
            activate = F.relu if self.plain else F.silu
            pixels = activate(features, inplace=not features.requires_grad).permute(0, 3, 1, 2)
        return pixels.flatten(1)


@dataclass(frozen=True, kw_only=True)
class NetworkShape:
    """Sizes of a coarse-to-fine network.

    pixel_size: E, features of all cameras, 0 without; low_dim_size: S*P values, 0 without; feature_dim: F of each
    projection; hidden_dim: H of the trunk; dims, levels, bins, atoms: D, L, N, A.
    sequence: T of CQN-AS, with `gru_layers` over it; None: CQN, one action without such a core. pixel_layers: of
    width H before the projection of pixels; project_low_dim: False hands the numbers on as they are; dueling: False
    leaves the value stream out.
    """

    pixel_size: int
    low_dim_size: int
    feature_dim: int
    hidden_dim: int
    dims: int
    levels: int
    bins: int
    atoms: int
    sequence: int | None = None
    gru_layers: int = 1
    pixel_layers: int = 0
    project_low_dim: bool = True
    dueling: bool = True

    @property
    def entries(self) -> int:
        """Numbers that the critic chooses, T*D in the order of the steps; D without a sequence."""
        return self.dims * (self.sequence or 1)

    @property
    def feature_size(self) -> int:
        """Values of an observation that enter the trunk."""
        low_dim = self.feature_dim * bool(self.low_dim_size) if self.project_low_dim else self.low_dim_size
        return self.feature_dim * bool(self.pixel_size) + low_dim


class Precomputed(NamedTuple):
    """An observation after everything that does not depend on level or action; one [B, H] per stream that is there."""

    advantage: Tensor
    value: Tensor | None


def projection(inputs: int, outputs: int, bias: bool = False, before: Sequence[int] = ()) -> nn.Sequential:
    """Linear, layer norm, tanh: what observations pass on their way into a trunk; before: widths of SiLU layers."""
    layers: list[nn.Module] = []
    for width in before:
        layers += [nn.Linear(inputs, width, bias=bias), nn.LayerNorm(width, eps=LAYER_NORM_EPS), nn.SiLU()]
        inputs = width
    last = [nn.Linear(inputs, outputs, bias=bias), nn.LayerNorm(outputs, eps=LAYER_NORM_EPS), nn.Tanh()]
    return nn.Sequential(*layers, *last)


class Stream(nn.Module):
    """One of the two dueling streams: projections, a two-layer trunk and a head of `out` numbers for each action.

    The trunk's input is [pixels F | low-dim F | previous-level action D | one-hot level L].
    """

    between = 0  # columns of the trunk's input between action and level

    def __init__(self, shape: NetworkShape, out: int) -> None:
        super().__init__()
        self.shape, hidden_dim = shape, shape.hidden_dim
        before = [hidden_dim] * shape.pixel_layers
        low_dim, feature_dim = shape.low_dim_size, shape.feature_dim
        pixels = projection(shape.pixel_size, feature_dim, before=before) if shape.pixel_size else None
        self.pixel_projection = pixels
        self.low_dim_projection = projection(low_dim, feature_dim) if low_dim and shape.project_low_dim else None
        columns = shape.feature_size + shape.dims + self.between + shape.levels
        self.first = nn.Linear(columns, hidden_dim, bias=False)
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
        elif low_dim is not None:
            parts.append(low_dim)
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


class SequenceStream(Stream):
    """Stream of CQN-AS: the trunk sees each step of the sequence for itself, a GRU goes along the steps.

    The trunk's input is [pixels F | low-dim F | previous-level action of the step D | one-hot step T | one-hot level
    L].
    The authors' code leaves PyTorch's initialisation of the GRU.
    """

    def __init__(self, shape: NetworkShape, out: int) -> None:
        assert shape.sequence is not None  # noqa: S101  # the network chooses the stream by it
        self.between = shape.sequence
        super().__init__(shape, out)
        self.gru = nn.GRU(shape.hidden_dim, shape.hidden_dim, shape.gru_layers)

    def forward(self, precomputed: Tensor, previous: Tensor, levels: Tensor) -> Tensor:
        """[B, H], previous-level sequence [B, K, T*D], level numbers int64 [K] -> [B, K, T, out]."""
        (batch, count), dims, steps = previous.shape[:2], self.shape.dims, self.between
        parts = [self.shape.feature_size, dims, steps, self.shape.levels]
        _, action, step, level = torch.split(self.first.weight, parts, dim=1)
        hidden = (
            precomputed[:, None, None]
            + F.linear(previous.view(batch, count, steps, dims), action)
            + (step.T + level.T[levels][:, None])
        )
        hidden = F.silu(self.first_norm(hidden))
        hidden = F.silu(self.second_norm(self.second(hidden)))
        # The step goes first, with copies: on views of another order the matrix products take twice as long.
        along = self.gru(hidden.flatten(0, 1).transpose(0, 1).contiguous())[0]
        hidden = along.transpose(0, 1).contiguous().view(batch, count, steps, -1)
        out: Tensor = self.head(hidden)
        return out


class CoarseToFineNetwork(nn.Module):
    """Q-network of equation 1: dueling streams shared by all levels and dimensions."""

    def __init__(self, shape: NetworkShape) -> None:
        super().__init__()
        self.shape = shape
        stream = Stream if shape.sequence is None else SequenceStream
        self.advantage = stream(shape, shape.dims * shape.bins * shape.atoms)
        self.value = stream(shape, shape.dims * shape.atoms) if shape.dueling else None

    def precompute(self, pixels: Tensor | None, low_dim: Tensor | None) -> Precomputed:
        """Pixel features [B, E] or None and low-dim values [B, S*P] or None -> what `forward` starts from."""
        value = None if self.value is None else self.value.precompute(pixels, low_dim)
        return Precomputed(self.advantage.precompute(pixels, low_dim), value)

    def forward(self, precomputed: Precomputed, previous: Tensor, levels: Tensor) -> Tensor:
        """Logits of all bins at K levels: previous [B, K, D], levels [K] -> float32 [B, K, D, N, A].

        With a sequence, D stands for its T*D entries.
        """
        (batch, count), s = previous.shape[:2], self.shape
        advantage: Tensor = self.advantage(precomputed.advantage, previous, levels).float()
        advantage = advantage.view(batch, count, s.entries, s.bins, s.atoms)
        if self.value is None:
            return advantage
        value = self.value(precomputed.value, previous, levels).float()
        value = value.view(batch, count, s.entries, 1, s.atoms)
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
