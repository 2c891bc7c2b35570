"""Parts that the networks of every method share: encoders of the camera views, augmentation, the averaged target."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .augmentation import colour_jitter, random_shift
from .distributional import expectation, support
from .networks import ViewEncoder
from .schema import Batch, Observation
from .settings import CommonSettings

__all__ = ["Features", "Model"]

Features = tuple[Tensor | None, Tensor | None]


class Model(nn.Module):
    """Encoders and support; a method adds its online and target networks, `act` and `loss`.

    views: channels, height and width of one frame of each camera; low_dim_size: P, 0 for pixels only;
    plain: convolutions with ReLU and nothing else (`networks.ViewEncoder`).
    """

    support: Tensor
    updates: Tensor
    settings: CommonSettings

    def __init__(self, views: Mapping[str, tuple[int, int, int]], settings: CommonSettings, *, plain: bool) -> None:
        super().__init__()
        self.settings = settings
        s = settings
        encoders = [
            ViewEncoder(
                c * s.frame_stack, height, width, s.encoder_channels, strides=s.encoder_strides,
                kernel=s.encoder_kernel, padding=s.encoder_padding, norm=s.encoder_norm, plain=plain,
            )
            for c, height, width in views.values()
        ]  # fmt: skip
        self.encoders = nn.ModuleList(encoders)
        self.pixel_size = sum(encoder.out_features for encoder in encoders)
        values = support(settings.v_min, settings.v_max, settings.critic_atoms)
        self.register_buffer("support", values, persistent=False)
        if settings.target_interval > 1:  # of a resumed run, too
            self.register_buffer("updates", torch.zeros((), dtype=torch.int64))

    # -- what a method says ----------------------------------------------------------------------------------

    def act(self, observation: Observation, explore: bool = False) -> tuple[Tensor, Tensor]:
        """Action [B, D] in [-1, 1] and its Q [B]."""
        raise NotImplementedError

    def executable(self, action: Tensor) -> Tensor:
        """The action nearest to one [B, D] in [-1, 1] that the method itself could choose."""
        return action

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss and its parts (detached scalars) for an already augmented batch."""
        raise NotImplementedError

    def acting(self) -> Sequence[str]:
        """Names of the networks that `act` asks."""
        raise NotImplementedError

    def averaged(self) -> Sequence[tuple[nn.Module, nn.Module]]:
        """Pairs of a target network and the online network that it follows."""
        raise NotImplementedError

    # -- what they share -------------------------------------------------------------------------------------

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
        with self.autocast():
            views = [
                encoder(_centred(view, layout)) for encoder, view in zip(self.encoders, observation.pixels, strict=True)
            ]
        return torch.cat(views, dim=-1), observation.low_dim

    def autocast(self) -> torch.autocast:
        """Networks in bfloat16 where `bf16` is on."""
        return torch.autocast(self.support.device.type, dtype=torch.bfloat16, enabled=self.settings.bf16)

    def q_values(self, logits: Tensor) -> Tensor:
        """Values from the critic's outputs: [..., A] logits (or A = 1 values) -> [...]."""
        if not self.settings.distributional:
            return logits[..., 0]
        return expectation(F.softmax(logits, dim=-1), self.support)

    @torch.no_grad()
    def update_target(self) -> None:
        """Polyak step: target <- (1 - tau) * target + tau * online (Algorithm 2, last line), where one is due."""
        if self.settings.target_interval > 1:
            self.updates += 1
            if self.updates % self.settings.target_interval:
                return
        for target, online in self.averaged():
            torch._foreach_lerp_(list(target.parameters()), list(online.parameters()), self.settings.tau)


def _unit(pixels: Tensor) -> Tensor:
    """uint8 in [0, 255] -> float in [0, 1]; floats pass."""
    return pixels.float() / 255 if pixels.dtype == torch.uint8 else pixels


def _centred(pixels: Tensor, layout: torch.memory_format) -> Tensor:
    """uint8 in [0, 255] or float in [0, 1] -> float in [-0.5, 0.5] in the given memory layout."""
    if pixels.dtype == torch.uint8:  # the layout changes while values are small, the rest is in place
        return pixels.to(torch.float32, memory_format=layout).div_(255).sub_(0.5)
    return (pixels - 0.5).contiguous(memory_format=layout)
