"""Production code against the plain version of the pseudocode, over a grid of shapes and settings.

Both start from the same weights and see the same augmented batch; the plain version computes in float64.
Tolerances: losses 1e-5 and gradients 2e-5, relative to the largest entry of each tensor (float32 rounding).
Weights after updates: 1e-5 absolute for all but one entry in a thousand. AdamW divides a gradient by its own
size, so an entry whose gradient is rounding noise may move by `lr` either way; no entry may be off by more.
"""

import pytest
import torch
from torch import Tensor

from lerobot_cqn.critic import CQNModel
from lerobot_cqn.learner import Learner
from lerobot_cqn.schema import Batch, Observation
from lerobot_cqn.sequence import CQNASModel
from lerobot_cqn.settings import CQNASSettings, CQNSettings
from tests.oracle import Oracle, largest_share
from tests.oracle_sequence import SequenceOracle

SIDE, P = 20, 3
SMALL = {
    "encoder_channels": (4, 6), "feature_dim": 8, "hidden_dim": 16, "atoms": 21, "shift_pixels": 0, "lr": 1e-3,
    "frame_stack": 1, "rl_loss_scale": 0.7, "bc_loss_scale": 1.3,
}  # fmt: skip


def build(views: int, low_dim: int, dims: int, **changes: object) -> CQNModel:
    """A model with random heads and a target that differs from the online critic; with a sequence it is CQN-AS's."""
    torch.manual_seed(0)
    cameras = {str(view): (3, SIDE, SIDE + 4 * view) for view in range(views)}
    model: CQNModel
    if "action_sequence" in changes:
        settings = CQNASSettings(**(SMALL | changes))  # type: ignore[arg-type]
        model = CQNASModel(cameras, low_dim, dims, settings)
    else:
        model = CQNModel(cameras, low_dim, dims, CQNSettings(**(SMALL | changes)))  # type: ignore[arg-type]
    with torch.no_grad():
        for critic in (model.critic, model.target_critic):
            for name, weight in critic.named_parameters():
                if "head" in name:
                    weight.normal_(0, 0.5)
                else:
                    weight.add_(0.05 * torch.randn_like(weight))
    return model


def plain(model: CQNModel, dtype: torch.dtype = torch.float32) -> Oracle:
    return SequenceOracle(model, dtype) if isinstance(model, CQNASModel) else Oracle(model, dtype)


def random_batch(model: CQNModel, views: int, low_dim: int, demo: str = "some", size: int = 6) -> Batch:
    stack = model.settings.frame_stack

    def observation() -> Observation:
        pixels = [torch.randint(256, (size, 3 * stack, SIDE, SIDE + 4 * v), dtype=torch.uint8) for v in range(views)]
        return Observation(tuple(pixels), torch.randn(size, low_dim * stack) if low_dim else None)

    flags = {"some": [1.0, 0.0, 1.0, 0.0, 0.0, 1.0], "none": [0.0] * size, "all": [1.0] * size}[demo]
    discount = torch.tensor([0.9, 0.0, 0.97, 0.97, 0.0, 1.0])[:, None]
    action = 2 * torch.rand(size, model.critic.shape.entries) - 1
    return Batch(
        observation=observation(),
        action=action,
        reward=torch.randn(size, 1),
        discount=discount,
        next_observation=observation(),
        demo=torch.tensor(flags)[:, None],
    )


def compare(views: int, low_dim: int, dims: int, demo: str = "some", updates: int = 3, **changes: object) -> None:
    model = build(views, low_dim, dims, **changes)
    exact = plain(model, torch.float64)
    learner = Learner(model)
    batch = random_batch(model, views, low_dim, demo)

    # One loss and its gradients
    loss, parts = model.loss(batch)
    loss.backward()  # type: ignore[no-untyped-call]
    expected, expected_parts = exact.loss(batch)
    expected.backward()  # type: ignore[no-untyped-call]
    assert float(loss) == pytest.approx(float(expected), rel=1e-5, abs=1e-6)
    for name, value in expected_parts.items():
        assert float(parts.get(name, torch.zeros(()))) == pytest.approx(float(value), rel=1e-5, abs=1e-6), name
    assert_gradients(model, exact)

    # Several updates
    for update in range(updates):
        batch = random_batch(model, views, low_dim, demo)
        stats = learner.update(batch)
        expected_parts = exact.update_augmented(batch)
        for name, value in stats.items():
            assert float(value) == pytest.approx(float(expected_parts[name]), rel=2e-4, abs=1e-5), name
        assert_weights(model, exact, update + 1)


def assert_gradients(model: CQNModel, oracle: Oracle) -> None:
    for name, weight in model.named_parameters():
        expected = oracle.weights[name].grad
        if not weight.requires_grad:
            assert weight.grad is None, name
        elif weight.grad is None:  # nothing depends on it
            assert expected is None or not expected.any(), name
        else:
            assert expected is not None, name
            assert largest_share(weight.grad, expected) < 2e-5, name


def assert_weights(model: CQNModel, oracle: Oracle, updates: int) -> None:
    deviations = []
    for name, weight in model.state_dict().items():
        deviation = (weight.double() - oracle.weights[name].double()).abs().flatten()
        assert deviation.max() <= 2 * updates * model.settings.lr, name
        deviations.append(deviation)
    assert (torch.cat(deviations) > 1e-5).double().mean() < 1e-3


@pytest.mark.parametrize("dims", [1, 4, 7])
@pytest.mark.parametrize("bins", [3, 5, 17])
@pytest.mark.parametrize("levels", [1, 2, 3, 4])
def test_levels_bins_and_dimensions(levels: int, bins: int, dims: int) -> None:
    compare(0, P, dims, levels=levels, bins=bins, atoms=5, updates=1)


@pytest.mark.parametrize("stack", [1, 2])
@pytest.mark.parametrize(("views", "low_dim"), [(0, P), (1, 0), (2, 0), (2, P)])
@pytest.mark.parametrize("distributional", [True, False])
def test_observations(views: int, low_dim: int, stack: int, distributional: bool) -> None:
    compare(views, low_dim, 2, levels=2, bins=3, frame_stack=stack, distributional=distributional)


@pytest.mark.parametrize("next_action_from", ["online", "target"])
@pytest.mark.parametrize("distributional", [True, False])
@pytest.mark.parametrize("demo", ["some", "none", "all"])
def test_targets_and_demonstrations(next_action_from: str, distributional: bool, demo: str) -> None:
    compare(0, P, 3, demo, next_action_from=next_action_from, distributional=distributional)


@pytest.mark.parametrize(
    "changes",
    [
        {"bc_loss_scale": 0.0},
        {"rl_loss_scale": 0.0},  # the CBC baseline
        {"bc_dominance": False},
        {"bc_margin": 0.3, "distributional": False},
        {"v_min": 0.0, "v_max": 3.0, "tau": 0.5},
        {"atoms": 2},
        {"channels_last": False},
    ],
    ids=str,
)
def test_ablations(changes: dict[str, object]) -> None:
    compare(1, P, 2, levels=2, **changes)


@pytest.mark.parametrize("steps", [1, 2, 4])
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"levels": 1, "bins": 3},
        {"gru_layers": 2, "distributional": False},
        {"dueling": False, "project_state": False, "distributional": False, "bc_loss_scale": 0.0},
        {"pixel_projection_layers": 2, "frame_stack": 2, "rl_loss_scale": 0.0},
        {"next_action_from": "target", "dueling": False},
    ],
    ids=str,
)
def test_sequences(steps: int, changes: dict[str, object]) -> None:
    views = 1 if "pixel_projection_layers" in changes else 0
    compare(views, P, 2, updates=2, action_sequence=steps, **({"levels": 2, "atoms": 5} | changes))


@pytest.mark.parametrize("distributional", [True, False])
def test_new_critic_with_tied_bins(distributional: bool) -> None:
    """Zero heads: every bin ties, where subgradients and argmax could be taken differently."""
    settings = CQNSettings(**(SMALL | {"distributional": distributional}))  # type: ignore[arg-type]
    model = CQNModel({}, P, 2, settings)
    oracle = Oracle(model)
    batch = random_batch(model, 0, P)
    loss, _ = model.loss(batch)
    loss.backward()  # type: ignore[no-untyped-call]
    expected, _ = oracle.loss(batch)
    expected.backward()  # type: ignore[no-untyped-call]
    assert_gradients(model, oracle)
    assert model.critic.advantage.head.weight.grad is not None
    assert model.critic.advantage.head.weight.grad.abs().max() > 1e-4


def test_without_demonstrations_the_imitation_terms_are_exactly_zero() -> None:
    model = build(0, P, 2)
    batch = random_batch(model, 0, P, "none")
    loss, parts = model.loss(batch)
    assert parts["bc_margin_loss"] == 0
    assert parts["bc_dominance_loss"] == 0
    assert loss == model.settings.rl_loss_scale * parts["rl_loss"]


@pytest.mark.parametrize("act_with", ["online", "target"])
def test_greedy_sequence(act_with: str) -> None:
    model = build(0, P, 2, act_with=act_with, action_sequence=3)
    oracle, observation = plain(model), random_batch(model, 0, P).observation
    sequence, _ = model.act(observation)
    critic = "critic" if act_with == "online" else "target_critic"
    assert torch.allclose(sequence, oracle.inference(critic, oracle.encode(observation))[0], atol=1e-6)


@pytest.mark.parametrize("act_with", ["online", "target"])
@pytest.mark.parametrize("distributional", [True, False])
def test_greedy_action(act_with: str, distributional: bool) -> None:
    model = build(1, P, 4, act_with=act_with, distributional=distributional)
    oracle = plain(model)
    observation = random_batch(model, 1, P).observation
    action, q = model.act(observation)
    features = oracle.encode(observation)
    critic = "critic" if act_with == "online" else "target_critic"
    expected, chosen, logits = oracle.inference(critic, features)
    assert torch.allclose(action, expected, atol=1e-6)
    rows = torch.arange(len(action))
    values: list[Tensor] = [
        oracle.mean_value(logits[level][n][rows, chosen[level][n]]) for level in range(len(chosen)) for n in range(4)
    ]
    assert torch.allclose(q, torch.stack(values).mean(0), atol=1e-5)
