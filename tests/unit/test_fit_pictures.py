"""Live pictures equal those that `cqn-data resize` made, byte for byte."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.utils import prepare_observation_for_inference
from torch import Tensor

from cqn_data.disk.pictures import shaped
from cqn_data.views.episode import Camera
from lerobot_cqn.configuration_cqn import CQNConfig
from lerobot_cqn.configuration_drqv2 import DrQv2Config
from lerobot_cqn.fit_pictures import FitPicturesProcessorStep, fitted

TOP = "observation.images.top"
SIDE = 84


def pictures(height: int, width: int, count: int = 1, seed: int = 0) -> Any:
    return np.random.default_rng(seed).integers(0, 256, (count, height, width, 3), dtype=np.uint8)


def as_tensor(stack: Any) -> Tensor:
    return torch.from_numpy(stack).permute(0, 3, 1, 2)


def expected(stack: Any, size: tuple[int, int]) -> Tensor:
    return as_tensor(np.stack([shaped(p, Camera(size=size)) for p in stack]))


sizes = st.tuples(st.integers(2, 70), st.integers(2, 70))


@given(before=sizes, after=sizes, seed=st.integers(0, 10**6))
def test_bytes_are_those_of_the_dataset(before: tuple[int, int], after: tuple[int, int], seed: int) -> None:
    stack = pictures(*before, count=2, seed=seed)
    live = as_tensor(stack)
    assert torch.equal(fitted(live, after), expected(stack, after))
    floats = fitted(live.float() / 255, after)
    assert floats.dtype == torch.float32
    assert torch.equal(floats, expected(stack, after).float() / 255)


@pytest.mark.parametrize("size", [(480, 640), (96, 128), (84, 200), (60, 84)])  # smaller, squeezed, grown
def test_the_usual_sizes(size: tuple[int, int]) -> None:
    stack = pictures(*size)
    assert torch.equal(fitted(as_tensor(stack), (SIDE, SIDE)), expected(stack, (SIDE, SIDE)))


def test_the_right_size_is_not_touched() -> None:
    step = FitPicturesProcessorStep({TOP: (3, 8, 9)})
    for picture in (torch.rand(2, 3, 8, 9), torch.zeros(2, 3, 8, 9, dtype=torch.uint8)):
        assert step.observation({TOP: picture})[TOP] is picture


def test_histories_single_channels_and_other_keys() -> None:
    step = FitPicturesProcessorStep({TOP: (3, 8, 9), "observation.images.grey": (1, 4, 4)})
    stack = pictures(16, 18, count=6)
    frame = {
        TOP: as_tensor(stack).reshape(2, 3, 3, 16, 18),
        "observation.images.grey": torch.ones(2, 1, 8, 8),
        "observation.images.other": torch.zeros(1, 3, 5, 5),
        "observation.state": torch.zeros(1, 2),
    }
    seen = step.observation(frame)
    assert torch.equal(seen[TOP].flatten(0, 1), expected(stack, (8, 9)))
    assert seen["observation.images.grey"].shape == (2, 1, 4, 4)
    assert seen["observation.images.grey"].eq(1).all()
    assert seen["observation.images.other"].shape == (1, 3, 5, 5)
    # Channels last: the policy says what it expects.
    assert step.observation({TOP: torch.zeros(1, 16, 18, 3)})[TOP].shape == (1, 16, 18, 3)


def config(policy: type[Any]) -> Any:
    return policy(
        preset="laptop_state", device="cpu",
        input_features={TOP: PolicyFeature(FeatureType.VISUAL, (3, SIDE, SIDE)),
                        "observation.state": PolicyFeature(FeatureType.STATE, (2,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
    )  # fmt: skip


@pytest.mark.parametrize("policy", [CQNConfig, DrQv2Config])
@pytest.mark.parametrize("saved", [False, True])
def test_as_rollout_shows_them(policy: type[Any], saved: bool, tmp_path: Path) -> None:
    """From the robot's array to what the network sees, through LeRobot's own preparation."""
    pre, post = make_pre_post_processors(config(policy))
    if saved:
        for pipeline in (pre, post):
            pipeline.save_pretrained(tmp_path)
        pre, _ = make_pre_post_processors(config(policy), pretrained_path=str(tmp_path))
    stack = pictures(120, 160)
    raw = {TOP: stack[0], "observation.state": np.zeros(2, np.float32)}
    seen = pre(prepare_observation_for_inference(raw, torch.device("cpu"), "task", "robot"))[TOP]
    assert torch.equal(seen, expected(stack, (SIDE, SIDE)).float() / 255)


def test_policies_without_cameras_have_no_such_step() -> None:
    blind = CQNConfig(
        preset="laptop_state", device="cpu",
        input_features={"observation.state": PolicyFeature(FeatureType.STATE, (2,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
    )  # fmt: skip
    pre, _ = make_pre_post_processors(blind)
    assert not any(isinstance(step, FitPicturesProcessorStep) for step in pre.steps)


def test_old_checkpoints_load(tmp_path: Path) -> None:
    for pipeline in make_pre_post_processors(config(CQNConfig)):
        pipeline.steps = [step for step in pipeline.steps if not isinstance(step, FitPicturesProcessorStep)]
        pipeline.save_pretrained(tmp_path)
    pre, _ = make_pre_post_processors(config(CQNConfig), pretrained_path=str(tmp_path))
    picture = torch.rand(1, 3, SIDE, SIDE)
    assert torch.equal(pre({TOP: picture, "observation.state": torch.zeros(1, 2)})[TOP], picture)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_on_a_gpu() -> None:
    stack = pictures(120, 160, count=2)
    seen = fitted(as_tensor(stack).float().cuda() / 255, (SIDE, SIDE))
    assert seen.device.type == "cuda"
    torch.testing.assert_close(seen.cpu(), expected(stack, (SIDE, SIDE)).float() / 255, rtol=0, atol=1e-7)
