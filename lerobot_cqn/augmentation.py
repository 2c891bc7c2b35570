"""Image augmentation of the paper: random shift (DrQ-v2), brightness and contrast. Pure functions."""

import torch
from torch import Tensor

__all__ = ["colour_jitter", "random_shift"]


def random_shift(pixels: Tensor, pad: int, generator: torch.Generator | None = None) -> Tensor:
    """Shift each sample by up to `pad` whole pixels, repeating the border: [B, C, H, W] -> [B, C, H, W].

    All stacked frames of a sample move together. Whole-pixel crops give the same distribution as the usual
    bilinear grid sampling at integer offsets, keep uint8, and only copy memory.
    """
    if pad == 0:
        return pixels
    batch, channels, height, width = pixels.shape
    offset = torch.randint(2 * pad + 1, (2, batch), generator=generator).to(pixels.device)
    rows = (torch.arange(-pad, height - pad, device=pixels.device) + offset[0, :, None]).clamp_(0, height - 1)
    columns = (torch.arange(-pad, width - pad, device=pixels.device) + offset[1, :, None]).clamp_(0, width - 1)
    source = (rows[:, :, None] * width + columns[:, None, :]).flatten(1)  # [B, H*W], where each pixel comes from
    return pixels.flatten(2).gather(2, source[:, None].expand(-1, channels, -1)).view(pixels.shape)


def colour_jitter(
    pixels: Tensor, brightness: float, contrast: float, generator: torch.Generator | None = None
) -> Tensor:
    """Random brightness and contrast, one draw per sample: float [B, C, H, W] in [0, 1] -> same, clamped.

    The factors are uniform in [1 - x, 1 + x]; contrast scales around the sample's mean.
    """
    if brightness == 0 and contrast == 0:
        return pixels
    draw = (2 * torch.rand(2, pixels.shape[0], 1, 1, 1, generator=generator) - 1).to(pixels)
    pixels = pixels * (1 + brightness * draw[0])
    mean = pixels.mean((1, 2, 3), keepdim=True)
    return ((pixels - mean) * (1 + contrast * draw[1]) + mean).clamp(0, 1)
