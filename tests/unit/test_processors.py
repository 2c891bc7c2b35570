"""Scaling of states and actions: what the network sees, and what the robot gets back."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from torch import Tensor

from lerobot_cqn.configuration_cqn import CQNConfig
from lerobot_cqn.errors import DataError
from lerobot_cqn.processor_cqn import make_cqn_pre_post_processors
from lerobot_cqn.processors import scaling_stats

LOW, HIGH = [-1.0, 0.25, 2.0], [3.0, 0.25, 2.5]  # the middle dimension never moves
STATS: dict[str, dict[str, Any]] = {
    key: {name: np.array(value, np.float32) for name, value in (("min", LOW), ("max", HIGH))}
    for key in ("action", "observation.state")
}


def make(stats: dict[str, dict[str, Any]] | None = None, **settings: Any) -> tuple[Any, Any]:
    config = CQNConfig(
        preset="laptop_state",
        device="cpu",
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (3,)),
            "observation.images.wrist": PolicyFeature(FeatureType.VISUAL, (3, 8, 8)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (3,))},
        **settings,
    )
    return make_cqn_pre_post_processors(config, dataset_stats=STATS if stats is None else stats)


def seen(pre: Any, state: Any) -> Tensor:
    value: Tensor = pre({"observation.state": torch.as_tensor(state, dtype=torch.float32)})["observation.state"]
    return value


def test_the_demonstrations_range_becomes_minus_one_to_one() -> None:
    pre, post = make()
    torch.testing.assert_close(seen(pre, [LOW, HIGH]), torch.tensor([[-1.0, 0, -1], [1, 0, 1]]))
    batch = pre({"observation.state": torch.zeros(2, 3), "action": torch.tensor([LOW, HIGH])})
    torch.testing.assert_close(batch["action"], torch.tensor([[-1.0, 0, -1], [1, 0, 1]]))
    torch.testing.assert_close(post(torch.tensor([[-1.0, 0, -1], [1, 0, 1]])), torch.tensor([LOW, HIGH]))


def test_a_constant_dimension_is_zero_and_comes_back_as_its_constant() -> None:
    pre, post = make()
    assert seen(pre, [LOW])[0, 1] == 0
    for action in (-1.0, -0.3, 0.0, 1.0):  # whatever the network chooses
        assert post(torch.full((1, 3), action))[0, 1] == 0.25


@pytest.mark.parametrize("constant", [0.0, 1e-12, -3.0, 1e4])
def test_constants_of_any_size(constant: float) -> None:
    stats = {key: {"min": np.full(3, constant), "max": np.full(3, constant)} for key in STATS}
    pre, post = make(stats)
    assert torch.equal(seen(pre, [[constant] * 3]), torch.zeros(1, 3))
    torch.testing.assert_close(post(torch.ones(1, 3)), torch.full((1, 3), constant))


def test_there_and_back_again() -> None:
    pre, post = make()
    moving = torch.tensor(LOW) + torch.rand(50, 3) * (torch.tensor(HIGH) - torch.tensor(LOW))
    scaled = pre({"observation.state": torch.zeros(50, 3), "action": moving})["action"]
    torch.testing.assert_close(post(scaled), moving)


def test_margin_widens_the_actions_and_not_the_state() -> None:
    pre, post = make(action_margin=0.25)
    torch.testing.assert_close(post(torch.tensor([[-1.0, 1, -1], [1, 1, 1]])),
                               torch.tensor([[-2.0, 0.25, 1.875], [4.0, 0.25, 2.625]]))  # fmt: skip
    torch.testing.assert_close(seen(pre, [HIGH]), torch.tensor([[1.0, 0, 1]]))
    scaled = pre({"observation.state": torch.zeros(1, 3), "action": torch.tensor([HIGH])})["action"]
    torch.testing.assert_close(scaled, torch.tensor([[2 / 3, 0, 2 / 3]]))


def test_a_share_of_each_bound_widens_as_the_reference_does() -> None:
    """Its rule: low - 0.2 |low|, high + 0.2 |high|; a bound of 0 stays, a constant too."""
    _, post = make(bound_margin=0.2)
    torch.testing.assert_close(post(torch.tensor([[-1.0, 1, -1], [1, 1, 1]])),
                               torch.tensor([[-1.2, 0.25, 1.6], [3.6, 0.25, 3.0]]))  # fmt: skip


@pytest.mark.parametrize("bound", [1.0, 2.0, 5.0])
def test_states_outside_the_demonstrations_are_bounded(bound: float) -> None:
    pre, _ = make(state_bound=bound)
    assert seen(pre, [[1e9, -1e9, 1e30]]).tolist() == [[bound, -bound, bound]]
    # Half a range outside is told apart from the edge.
    assert seen(pre, [[4.0, 0.25, 2.5]])[0, 0] == pytest.approx(min(1.5, bound))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_states_that_are_not_finite_are_refused(value: float) -> None:
    pre, _ = make()
    with pytest.raises(DataError, match=r"'observation.state' holds NaN or infinite.*check the sensor"):
        seen(pre, [[0.0, value, 0.0]])


def test_pictures_pass_untouched() -> None:
    stats = {**STATS, "observation.images.wrist": {name: np.full((3, 1, 1), 0.4) for name in ("mean", "std")}}
    pre, _ = make(stats)
    picture = torch.rand(1, 3, 8, 8)
    batch = pre({"observation.state": torch.zeros(1, 3), "observation.images.wrist": picture})
    assert torch.equal(batch["observation.images.wrist"], picture)


def test_a_single_frame_gets_a_batch_dimension() -> None:
    pre, _ = make()
    assert seen(pre, LOW).shape == (1, 3)


def test_histories_are_scaled_alike() -> None:
    pre, _ = make()
    history = torch.randn(4, 5, 3)
    torch.testing.assert_close(seen(pre, history)[:, 2], seen(pre, history[:, 2]))


def test_scaling_can_be_switched_off() -> None:
    off = {"VISUAL": "IDENTITY", "STATE": "IDENTITY", "ENV": "IDENTITY", "ACTION": "IDENTITY"}
    pre, post = make(normalization_mapping={k: NormalizationMode(v) for k, v in off.items()}, state_bound=10.0)
    assert seen(pre, [[3.0, -4.0, 5.0]]).tolist() == [[3.0, -4.0, 5.0]]
    assert post(torch.tensor([[0.1, 0.2, 0.3]])).tolist() == torch.tensor([[0.1, 0.2, 0.3]]).tolist()


def test_without_statistics_values_stay() -> None:
    pre, post = make({})
    assert seen(pre, [[0.5, -0.5, 1.0]]).tolist() == [[0.5, -0.5, 1.0]]
    assert post(torch.tensor([[0.5]])).tolist() == [[0.5]]


def test_the_source_statistics_are_not_changed() -> None:
    before = {key: {name: value.copy() for name, value in entry.items()} for key, entry in STATS.items()}
    scaling_stats(STATS, 0.3, inverse=True)
    for key, entry in before.items():
        for name, value in entry.items():
            np.testing.assert_array_equal(STATS[key][name], value)


def saved(folder: Path, **settings: Any) -> tuple[CQNConfig, Path]:
    config = CQNConfig(
        preset="laptop_state",
        device="cpu",
        input_features={"observation.state": PolicyFeature(FeatureType.STATE, (3,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (3,))},
        **settings,
    )
    for pipeline in make_cqn_pre_post_processors(config, dataset_stats=STATS):
        pipeline.save_pretrained(folder)
    return config, folder


def test_saved_pipelines_do_the_same(tmp_path: Path) -> None:
    config, folder = saved(tmp_path, state_bound=1.5, action_margin=0.1)
    pre, post = make(state_bound=1.5, action_margin=0.1)
    pre2, post2 = make_pre_post_processors(config, pretrained_path=str(folder))
    states, actions = torch.randn(20, 3) * 5, torch.rand(20, 3) * 2 - 1
    assert torch.equal(seen(pre, states), seen(pre2, states))
    assert torch.equal(post(actions), post2(actions))
    assert post2(actions)[:, 1].eq(0.25).all()
    with pytest.raises(DataError):
        seen(pre2, [[np.nan] * 3])


def test_lerobots_overrides_find_their_steps(tmp_path: Path) -> None:
    """The names that lerobot-train and lerobot-eval override when they load a checkpoint."""
    config, folder = saved(tmp_path)
    new = {key: {"min": np.full(3, -2.0), "max": np.full(3, 2.0)} for key in STATS}
    features = {**(config.input_features or {}), **(config.output_features or {})}
    pre, post = make_pre_post_processors(
        config,
        pretrained_path=str(folder),
        preprocessor_overrides={
            "device_processor": {"device": "cpu"},
            "rename_observations_processor": {"rename_map": {"observation.joints": "observation.state"}},
            "normalizer_processor": {
                "stats": new, "features": features, "norm_map": config.normalization_mapping,
            },
        },
        postprocessor_overrides={
            "unnormalizer_processor": {
                "stats": new, "features": config.output_features, "norm_map": config.normalization_mapping,
            },
        },
    )  # fmt: skip
    assert pre({"observation.joints": torch.tensor([[2.0, -2, 0]])})["observation.state"].tolist() == [[1, -1, 0]]
    assert post(torch.tensor([[1.0, -1, 0]])).tolist() == [[2, -2, 0]]
