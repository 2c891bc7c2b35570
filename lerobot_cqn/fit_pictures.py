"""Pictures of any size scaled to the policy's, as `cqn-data resize` scaled those it was trained on."""

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
import torch
from lerobot.processor import ObservationProcessorStep, ProcessorStepRegistry
from torch import Tensor

__all__ = ["FitPicturesProcessorStep", "fitted"]


def fitted(pictures: Tensor, size: tuple[int, int]) -> Tensor:
    """Scale pictures, rounding as uint8: the area filter when shrinking, linear when growing.

    Args:
        pictures: [..., C, H, W], uint8 or float in [0, 1]; returned as they are where the size is right.
        size: height and width, pixels.
    """
    if tuple(pictures.shape[-2:]) == size:
        return pictures
    *leading, channels, height, width = pictures.shape
    whole = pictures if pictures.dtype == torch.uint8 else (pictures * 255).round().clamp(0, 255).to(torch.uint8)
    rows = whole.reshape(-1, channels, height, width).permute(0, 2, 3, 1).contiguous().cpu().numpy()
    how = cv2.INTER_AREA if size[0] <= height and size[1] <= width else cv2.INTER_LINEAR
    # OpenCV drops the axis of a single channel.
    scaled = [cv2.resize(row, size[::-1], interpolation=how).reshape(*size, channels) for row in rows]
    result = torch.from_numpy(np.stack(scaled)).permute(0, 3, 1, 2).reshape(*leading, channels, *size)
    result = result.contiguous().to(pictures.device)
    return result if pictures.dtype == torch.uint8 else result.to(pictures.dtype) / 255


@ProcessorStepRegistry.register(name="cqn_fit_pictures")
class FitPicturesProcessorStep(ObservationProcessorStep):
    """Scales each camera's pictures to the policy's; what has another number of channels is left to the policy.

    shapes: camera feature -> (channels, height, width).
    """

    def __init__(self, shapes: Mapping[str, Sequence[int]]) -> None:
        self.shapes = {key: (int(c), int(h), int(w)) for key, (c, h, w) in shapes.items()}

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """An observation with pictures [..., C, H, W] of the policy's size."""
        changed = dict(observation)
        for key, (channels, *size) in self.shapes.items():
            pictures = changed.get(key)
            if isinstance(pictures, Tensor) and pictures.ndim >= 3 and pictures.shape[-3] == channels:
                changed[key] = fitted(pictures, (size[0], size[1]))
        return changed

    def get_config(self) -> dict[str, Any]:
        """Settings that are saved with the checkpoint."""
        return {"shapes": {key: list(shape) for key, shape in self.shapes.items()}}

    def transform_features(self, features: Any) -> Any:
        """Types stay; shapes are the policy's already."""
        return features
