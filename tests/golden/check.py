"""Compare the production code with tensors computed by the authors' implementation.

    python -m tests.golden.check DIR

runs every comparison on the npz files of DIR, prints the worst deviation of each quantity and exits with 1
when one is beyond its tolerance. File kinds are told apart by their names: discretisation_*, critic_*,
encoder_*. Deviations of weights and actions are absolute, of probabilities and losses relative to the
largest reference value of that tensor.
"""

import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lerobot_cqn.critic import CQNModel, Features
from lerobot_cqn.discretisation import decode, encode
from lerobot_cqn.learner import Learner
from lerobot_cqn.losses import demo_mean, dominance_loss, margin_loss, q_learning_loss
from lerobot_cqn.networks import CoarseToFineNetwork, NetworkShape, ViewEncoder
from lerobot_cqn.schema import Batch, Observation
from lerobot_cqn.settings import CQNSettings

PARTS = {
    "rgb_encoder.0": "pixel_projection.0", "rgb_encoder.1": "pixel_projection.1",
    "low_dim_encoder.0": "low_dim_projection.0", "low_dim_encoder.1": "low_dim_projection.1",
    "net.0": "first", "net.1": "first_norm", "net.3": "second", "net.4": "second_norm", "head": "head",
}  # fmt: skip
STREAMS = {"adv": "advantage", "value": "value"}


class Deviation(NamedTuple):
    """Worst deviation of one quantity and what is allowed."""

    quantity: str
    worst: float
    tolerance: float

    @property
    def ok(self) -> bool:
        return self.worst <= self.tolerance


class GoldenModel(CQNModel):
    """A model whose `pixels` already are the encoder's features, as the golden critics expect."""

    def encode(self, observation: Observation) -> Features:
        return observation.pixels[0], observation.low_dim


def network_weights(arrays: Mapping[str, np.ndarray], prefix: str) -> dict[str, Tensor]:
    """Weights under `prefix`/ renamed to those of CoarseToFineNetwork."""
    weights = {}
    for key, array in arrays.items():
        if match := re.fullmatch(rf"{prefix}/(adv|value)_(.+)\.(weight|bias)", key):
            stream, part, kind = match.groups()
            weights[f"{STREAMS[stream]}.{PARTS[part]}.{kind}"] = torch.from_numpy(array).float()
    return weights


def golden_model(arrays: Mapping[str, np.ndarray]) -> GoldenModel:
    """The model a critic_* file describes, with its online and target weights."""
    settings = CQNSettings(
        frame_stack=1, shift_pixels=0, levels=int(arrays["levels"]), bins=int(arrays["bins"]),
        atoms=int(arrays["atoms"]), v_min=float(arrays["v_min"]), v_max=float(arrays["v_max"]),
        lr=float(arrays["lr"]), weight_decay=float(arrays["weight_decay"]), tau=float(arrays["tau"]),
        bc_margin=float(arrays["bc_margin"]), rl_loss_scale=float(arrays["rl_scale"]),
        bc_loss_scale=float(arrays["bc_scale"]), channels_last=False,
    )  # fmt: skip
    online = network_weights(arrays, "critic")
    feature_dim, pixel_size = online["advantage.pixel_projection.0.weight"].shape
    low_dim_size = online["advantage.low_dim_projection.0.weight"].shape[1]
    hidden_dim, dims = online["advantage.second.weight"].shape[0], arrays["action"].shape[1]
    model = GoldenModel({}, low_dim_size, dims, settings)
    shape = NetworkShape(
        pixel_size=pixel_size, low_dim_size=low_dim_size, feature_dim=feature_dim, hidden_dim=hidden_dim, dims=dims,
        levels=settings.levels, bins=settings.bins, atoms=settings.atoms,
    )  # fmt: skip
    for name, weights in (("critic", online), ("target_critic", network_weights(arrays, "target"))):
        network = CoarseToFineNetwork(shape)
        network.load_state_dict(weights)
        setattr(model, name, network)
    model.target_critic.requires_grad_(False)
    return model


def _absolute(got: Tensor, expected: np.ndarray) -> float:
    return float((got.detach() - torch.from_numpy(np.asarray(expected))).abs().max())


def _relative(got: Tensor, expected: np.ndarray) -> float:
    return _absolute(got, expected) / max(float(np.abs(expected).max()), 1e-12)


def check_discretisation(arrays: Mapping[str, np.ndarray]) -> Iterator[Deviation]:
    """Indices exactly, decoded actions to rounding."""
    levels, bins = int(arrays["levels"]), int(arrays["bins"])
    indices = encode(torch.from_numpy(arrays["action"]), levels, bins)
    yield Deviation("indices that differ", float((indices != torch.from_numpy(arrays["indices"])).sum()), 0.0)
    yield Deviation("decoded action", _absolute(decode(indices, bins), arrays["decoded"]), 1e-6)


def check_critic(arrays: Mapping[str, np.ndarray]) -> Iterator[Deviation]:
    """Probabilities, greedy actions, target, losses, and every weight after one update."""
    model = golden_model(arrays)
    t = {key: torch.from_numpy(value) for key, value in arrays.items() if "/" not in key and value.ndim}
    s = model.settings
    observation = Observation((t["features"],), t["low_dim"])
    next_observation = Observation((t["next_features"],), t["next_low_dim"])
    projected = model.precompute(model.critic, model.encode(observation))
    target_projected = model.precompute(model.target_critic, model.encode(observation))
    indices = encode(t["action"], s.levels, s.bins)
    logits = model.evaluate(model.critic, projected, indices)
    probs = logits.softmax(-1)
    index = indices[..., None, None].expand(*indices.shape, 1, s.atoms)
    taken, taken_logits = probs.gather(-2, index)[..., 0, :], logits.gather(-2, index)[..., 0, :]
    yield Deviation("q_probs", _relative(probs, arrays["q_probs"]), 1e-5)
    yield Deviation("q_probs_a", _relative(taken, arrays["q_probs_a"]), 1e-5)
    greedy = decode(model.greedy(model.critic, projected)[0], s.bins)
    yield Deviation("greedy_action", _absolute(greedy, arrays["greedy_action"]), 1e-6)
    target_greedy = decode(model.greedy(model.target_critic, target_projected)[0], s.bins)
    yield Deviation("target_greedy_action", _absolute(target_greedy, arrays["target_greedy_action"]), 1e-6)
    next_features = model.encode(next_observation)
    path, _ = model.greedy(model.critic, model.precompute(model.critic, next_features))
    yield Deviation("next_action", _absolute(decode(path, s.bins), arrays["next_action"]), 1e-6)
    target = model.td_target(next_features, t["reward"], t["discount"])
    yield Deviation("target_dist", _relative(target, arrays["target_dist"]), 1e-5)
    rl = q_learning_loss(taken_logits, target).mean()
    yield Deviation("rl_loss", _relative(rl, arrays["rl_loss"]), 1e-5)
    dominance = demo_mean(dominance_loss(probs, indices), t["demo"])
    yield Deviation("bc_fosd_loss", _relative(dominance, arrays["bc_fosd_loss"]), 1e-5)
    margin = demo_mean(margin_loss(probs @ model.support, indices, s.bc_margin), t["demo"])
    yield Deviation("bc_margin_loss", _relative(margin, arrays["bc_margin_loss"]), 1e-5)

    Learner(model).update(
        Batch(
            observation=observation,
            action=t["action"],
            reward=t["reward"],
            discount=t["discount"],
            next_observation=next_observation,
            demo=t["demo"],
        )
    )
    for name, network in (("critic_after", model.critic), ("target_after", model.target_critic)):
        state = network.state_dict()
        worst = max(_absolute(state[k], v.numpy()) for k, v in network_weights(arrays, name).items())
        yield Deviation(name, worst, 1e-5)


def check_encoder(arrays: Mapping[str, np.ndarray]) -> Iterator[Deviation]:
    """Features of all views, in both memory layouts."""
    pixels = torch.from_numpy(arrays["pixels"])
    views, channels, height, width = pixels.shape[1:]
    sizes = [len(arrays[f"w/conv_nets.0.{3 * layer}.bias"]) for layer in range(4)]
    features = []
    for view in range(views):
        encoder = ViewEncoder(channels, height, width, sizes)
        state = {}
        for layer in range(len(sizes)):
            for kind in ("weight", "bias"):
                for name, at in (("convolutions", 3 * layer), ("norms", 3 * layer + 1)):
                    array = arrays[f"w/conv_nets.{view}.{at}.{kind}"]
                    state[f"{name}.{layer}.{kind}"] = torch.from_numpy(array).float()
        encoder.load_state_dict(state)
        unit = pixels[:, view].float() / 255 - 0.5
        plain = encoder(unit)
        encoder.to(memory_format=torch.channels_last)
        last = encoder(unit.contiguous(memory_format=torch.channels_last))
        features.append((plain, last))
    for at, name in enumerate(("features", "features, channels-last")):
        got = torch.cat([pair[at] for pair in features], dim=-1)
        yield Deviation(name, _relative(got, arrays["features"]), 1e-5)


CHECKS = {"discretisation": check_discretisation, "critic": check_critic, "encoder": check_encoder}


def check_file(path: Path) -> list[Deviation]:
    """All deviations of one npz file; the file's kind is the first word of its name."""
    with np.load(path) as arrays:
        return list(CHECKS[path.stem.split("_")[0]](dict(arrays)))


def main(argv: list[str]) -> int:
    """Print one line per file and quantity; 0 when all are within tolerance."""
    if len(argv) != 1 or not Path(argv[0]).is_dir():
        print("usage: python -m tests.golden.check DIR   (a folder of golden npz files)", file=sys.stderr)
        return 2
    paths = [path for path in sorted(Path(argv[0]).glob("*.npz")) if path.stem.split("_")[0] in CHECKS]
    if not paths:
        print(
            f"{argv[0]}: expected npz files named {', '.join(f'{k}_*' for k in CHECKS)}, found none",
            file=sys.stderr,
        )
        return 2
    failed = 0
    for path in paths:
        for deviation in check_file(path):
            failed += not deviation.ok
            verdict = "ok" if deviation.ok else "BEYOND TOLERANCE"
            print(
                f"{path.stem:32} {deviation.quantity:26} {deviation.worst:9.2e}  (<= {deviation.tolerance:g}) {verdict}"
            )
    print(f"{len(paths)} files, {failed} quantities beyond tolerance")
    return int(failed > 0)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
