"""Every ablation of the paper is one flag away, and changes what it says: the flag is parsed as `cqn-train` does.

Absolute actions are the dataset's affair (`cqn-data delta --to=absolute`, test_data_operations.py).
"""

import draccus
import pytest
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from torch import Tensor

import cqn_train.envs  # noqa: F401  # registers the station
from cqn_train.config import RunConfig
from lerobot_cqn.configuration_cqn import CQNConfig
from lerobot_cqn.critic import CQNModel
from lerobot_cqn.processors import make_processors
from lerobot_cqn.schema import Batch, Observation
from lerobot_cqn.settings import CQNSettings

P, D, B = 3, 2, 16
SMALL = [
    "--policy.type=cqn", "--policy.device=cpu", "--policy.preset=laptop_state", "--policy.hidden_dim=16",
    "--policy.feature_dim=8", "--policy.exploration_noise=0",
]  # fmt: skip


def run(*flags: str) -> RunConfig:
    config: RunConfig = draccus.parse(RunConfig, args=[*SMALL, *flags])
    return config


def settings(*flags: str) -> CQNSettings:
    policy = run(*flags).policy
    assert isinstance(policy, CQNConfig)
    return policy.settings


def model(*flags: str) -> CQNModel:
    """With heads that have preferences, and a target that differs."""
    torch.manual_seed(0)
    made = CQNModel({}, P, D, settings(*flags))
    with torch.no_grad():
        for critic in (made.critic, made.target_critic):
            for stream in (critic.advantage, critic.value):
                stream.head.weight.normal_(0, 0.5)
    return made


def batch(made: CQNModel, demo: float = 1.0) -> Batch:
    torch.manual_seed(1)
    low_dim = [torch.randn(B, P * made.settings.frame_stack) for _ in range(2)]
    action, reward = 2 * torch.rand(B, D) - 1, torch.rand(B, 1)
    discount, flags = torch.full((B, 1), 0.97), torch.full((B, 1), demo)
    return Batch(
        observation=Observation((), low_dim[0]),
        action=action,
        reward=reward,
        discount=discount,
        next_observation=Observation((), low_dim[1]),
        demo=flags,
    )


def parts(*flags: str, demo: float = 1.0) -> dict[str, float]:
    made = model(*flags)
    return {name: float(value) for name, value in made.loss(batch(made, demo))[1].items()}


def representable(*flags: str) -> int:
    """Different values that an action dimension takes."""
    torch.manual_seed(0)
    made = CQNModel({}, P, D, settings(*flags))  # a new critic explores every bin
    return len(made.act(Observation((), torch.randn(4000, P)), explore=True)[0].unique())


@pytest.mark.parametrize(("flags", "values"), [
    ((), 125), (("--policy.levels=2",), 25), (("--policy.levels=1",), 5), (("--policy.bins=3",), 27),
    (("--policy.levels=1", "--policy.bins=17"), 17),
])  # fmt: skip
def test_levels_and_bins_are_the_resolution(flags: tuple[str, ...], values: int) -> None:
    assert representable(*flags) == values


def test_rl_off_is_the_papers_cbc() -> None:
    assert parts("--policy.rl_loss_scale=0").keys() == {"bc_margin_loss", "bc_dominance_loss", "loss"}
    assert not run("--relabel=false").recipe.relabel
    assert run().recipe.relabel


def test_imitation_off() -> None:
    assert parts("--policy.bc_loss_scale=0").keys() == {"rl_loss", "td_error", "loss"}


def test_scalar_values() -> None:
    made = model("--policy.distributional=false")
    assert made.critic.shape.atoms == 1
    assert parts("--policy.distributional=false").keys() == {"rl_loss", "td_error", "bc_margin_loss", "loss"}
    assert model().critic.shape.atoms == 51


def test_margin_only() -> None:
    without, both = parts("--policy.bc_dominance=false"), parts()
    assert "bc_dominance_loss" not in without
    assert without["bc_margin_loss"] == both["bc_margin_loss"]
    assert both["loss"] - without["loss"] == pytest.approx(both["bc_dominance_loss"], rel=1e-4)


def test_centralised_critic() -> None:
    assert parts("--policy.centralized_critic=true")["rl_loss"] != pytest.approx(parts()["rl_loss"], rel=1e-3)


def acting_critic(*flags: str) -> Tensor:
    made = model(*flags)
    observation = Observation((), torch.randn(50, P, generator=torch.Generator().manual_seed(3)))
    return made.act(observation)[0]


def test_online_or_target_critic_acts() -> None:
    assert not torch.equal(acting_critic("--policy.act_with=online"), acting_critic("--policy.act_with=target"))


@pytest.mark.parametrize("noise", [0.01, 0.1])
def test_exploration_noise(noise: float) -> None:
    made = model(f"--policy.exploration_noise={noise}", "--policy.levels=6")
    observation = Observation((), torch.randn(3000, P))
    greedy, explored = made.act(observation)[0], made.act(observation, explore=True)[0]
    inside = greedy.abs() < 0.6
    assert (explored - greedy)[inside].std().item() == pytest.approx(noise, rel=0.15)


def test_frame_stack_widens_what_the_network_sees() -> None:
    assert [
        model(f"--policy.frame_stack={s}").critic.value.low_dim_projection[0].in_features for s in (1, 2, 4, 8)
    ] == [P, 2 * P, 4 * P, 8 * P]


def test_n_step_and_next_action() -> None:
    assert settings("--policy.n_step=1").n_step == 1
    online, target = parts("--policy.next_action_from=online"), parts("--policy.next_action_from=target")
    assert online["rl_loss"] != pytest.approx(target["rl_loss"], rel=1e-4)


def test_action_scaling() -> None:
    assert run().recipe.action_bounds == "data"
    assert run("--action_bounds=environment").recipe.action_bounds == "environment"  # seen in test_drqv2.py


@pytest.mark.parametrize("scale", [0.0, 0.5])
def test_a_margin_widens_the_action_bounds(scale: float) -> None:
    config = run(f"--policy.action_margin={scale}").policy
    assert isinstance(config, CQNConfig)
    config.output_features = {"action": PolicyFeature(FeatureType.ACTION, (D,))}
    _, post = make_processors(config, {"action": {"min": [-1.0, 0.0], "max": [1.0, 2.0]}})
    assert post(torch.ones(1, D))[0].tolist() == pytest.approx([1 + 2 * scale, 2 + 2 * scale])
