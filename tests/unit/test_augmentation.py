"""Random shift and colour jitter."""

from collections import Counter

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from lerobot_cqn.augmentation import colour_jitter, random_shift
from lerobot_cqn.critic import CQNModel
from lerobot_cqn.schema import Observation
from lerobot_cqn.settings import CQNSettings
from tests import oracle

PAD = 4


def images(batch: int, height: int = 12, width: int = 16, channels: int = 3) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randint(256, (batch, channels, height, width), dtype=torch.uint8, generator=generator)


def crops(image: Tensor, pad: int) -> dict[tuple[int, int], Tensor]:
    """Every window of the padded image [C, H, W], by its offset."""
    height, width = image.shape[1:]
    padded = F.pad(image[None].float(), (pad,) * 4, "replicate")[0].to(image.dtype)
    sides = range(2 * pad + 1)
    return {(y, x): padded[:, y : y + height, x : x + width] for y in sides for x in sides}


def offset_of(shifted: Tensor, windows: dict[tuple[int, int], Tensor]) -> tuple[int, int]:
    return next(offset for offset, window in windows.items() if torch.equal(window, shifted))


def test_every_shift_is_a_crop_and_all_81_are_equally_likely() -> None:
    torch.manual_seed(0)
    count = 81 * 100
    shifted = random_shift(images(1).expand(count, -1, -1, -1), PAD)
    assert shifted.dtype == torch.uint8
    windows = crops(images(1)[0], PAD)
    rows = {window.numpy().tobytes(): offset for offset, window in windows.items()}
    assert len(rows) == 81
    found = Counter(rows[sample.numpy().tobytes()] for sample in shifted)
    assert set(found) == set(windows)
    statistic = sum((found[offset] - 100) ** 2 / 100 for offset in windows)
    assert statistic < 135  # chi-squared with 80 degrees of freedom: p < 0.0002 beyond


@pytest.mark.parametrize("pad", [1, 4])
def test_equals_the_grid_sampling_of_drq(pad: int) -> None:
    pixels = images(16, 20, 20)
    offset = torch.randint(2 * pad + 1, (2, 16), generator=torch.Generator().manual_seed(3))
    sampled = oracle.shift(pixels.float(), pad, offset)
    copied = random_shift(pixels, pad, torch.Generator().manual_seed(3))
    assert torch.allclose(sampled, copied.float(), atol=0.01)  # of 255: the grid is rounded to float32


def test_stacked_frames_move_together() -> None:
    frame = images(8)
    shifted = random_shift(torch.cat([frame, frame], dim=1), PAD)
    assert torch.equal(shifted[:, :3], shifted[:, 3:])
    assert not torch.equal(shifted[:, :3], frame)


def test_no_pad_is_the_identity() -> None:
    pixels = images(2)
    assert random_shift(pixels, 0) is pixels


def test_floats_and_other_layouts_are_shifted_alike() -> None:
    pixels = images(8)
    expected = random_shift(pixels, PAD, torch.Generator().manual_seed(1))
    for other in (pixels.float(), pixels.contiguous(memory_format=torch.channels_last)):
        got = random_shift(other, PAD, torch.Generator().manual_seed(1))
        assert torch.equal(got.to(torch.uint8), expected)


def test_views_and_calls_are_shifted_independently() -> None:
    model = CQNModel({"a": (3, 32, 32), "b": (3, 32, 32)}, 0, 1, CQNSettings(frame_stack=1, hidden_dim=8))
    pixels = images(16, 32, 32)
    observation = Observation((pixels, pixels))
    first, second = model.augment(observation), model.augment(observation)
    windows = [crops(image, PAD) for image in pixels]
    offsets = [
        [offset_of(sample, windows[i]) for i, sample in enumerate(view)] for view in (*first.pixels, *second.pixels)
    ]
    assert len({tuple(view) for view in offsets}) == 4
    assert all(len(set(view)) > 1 for view in offsets)


def test_jitter_off_is_the_identity_and_on_stays_in_range() -> None:
    pixels = images(4).float() / 255
    assert colour_jitter(pixels, 0, 0) is pixels
    jittered = colour_jitter(pixels, 0.5, 0.5)
    assert jittered.min() >= 0
    assert jittered.max() <= 1
    assert not torch.equal(jittered, pixels)


def test_brightness_scales_and_contrast_keeps_the_mean() -> None:
    pixels = 0.4 + 0.2 * images(64).float() / 255  # far from the ends: nothing is clamped
    factor = colour_jitter(pixels, 0.2, 0) / pixels
    assert torch.allclose(factor, factor[:, :1, :1, :1].expand_as(factor), atol=1e-5)
    assert factor.min() >= 0.8 - 1e-5
    assert factor.max() <= 1.2 + 1e-5
    assert factor[:, 0, 0, 0].std() > 0.05
    contrasted = colour_jitter(pixels, 0, 0.2)
    assert torch.allclose(contrasted.mean((1, 2, 3)), pixels.mean((1, 2, 3)), atol=1e-5)
    spread = contrasted.std((1, 2, 3)) / pixels.std((1, 2, 3))
    assert spread.min() >= 0.8 - 1e-4
    assert spread.max() <= 1.2 + 1e-4
    assert spread.std() > 0.05


def test_the_model_does_not_change_the_pixels_it_is_given() -> None:
    model = CQNModel({"a": (3, 32, 32)}, 0, 1, CQNSettings(frame_stack=1, hidden_dim=8, channels_last=False))
    for pixels in (images(2, 32, 32), images(2, 32, 32).float() / 255):
        before = pixels.clone()
        model.act(Observation((pixels,)))
        assert torch.equal(pixels, before)
