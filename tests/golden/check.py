"""Compare the production code with tensors computed by the authors' implementation.

    python -m tests.golden.check DIR

runs every comparison on the npz files of DIR, prints the worst deviation of each quantity and exits with 1
when one is beyond its tolerance. File kinds are told apart by their names: discretisation_*, critic_*, encoder_*, and
of CQN-AS as_critic_*, as_scalar_*, as_ensemble_*, as_replay_*. Deviations of weights and actions are absolute, of
probabilities and losses relative to the largest reference value of that tensor.
"""

import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from cqn_train.replay.buffer import Replay
from cqn_train.replay.episode import Episode
from lerobot_cqn.critic import CQNModel
from lerobot_cqn.discretisation import decode, encode, snap
from lerobot_cqn.learner import Learner
from lerobot_cqn.losses import demo_mean, dominance_loss, margin_loss, q_learning_loss
from lerobot_cqn.model import Features
from lerobot_cqn.networks import CoarseToFineNetwork, ViewEncoder
from lerobot_cqn.schema import Batch, Observation
from lerobot_cqn.sequence import CQNASModel, TemporalEnsemble
from lerobot_cqn.settings import CQNASSettings, CQNSettings

PARTS = {
    "rgb_encoder.": "pixel_projection.", "low_dim_encoder.": "low_dim_projection.",
    "net.0.": "first.", "net.1.": "first_norm.", "net.3.": "second.", "net.4.": "second_norm.",
    "gru.": "gru.", "head.": "head.",
}  # fmt: skip
STREAMS = {"adv_": "advantage", "value_": "value", "": "advantage"}


class Deviation(NamedTuple):
    """Worst deviation of one quantity and what is allowed."""

    quantity: str
    worst: float
    tolerance: float

    @property
    def ok(self) -> bool:
        return self.worst <= self.tolerance


def encoded(observation: Observation) -> Features:
    """What an encoder makes of an observation whose `pixels` already are its features; none are."""
    return (observation.pixels[0] if observation.pixels else None), observation.low_dim


def network_weights(arrays: Mapping[str, np.ndarray], prefix: str) -> dict[str, Tensor]:
    """Weights under `prefix`/ renamed to those of CoarseToFineNetwork."""
    weights = {}
    for key, array in arrays.items():
        if match := re.fullmatch(rf"{prefix}/(adv_|value_|)({'|'.join(map(re.escape, PARTS))})(.+)", key):
            stream, part, rest = match.groups()
            weights[f"{STREAMS[stream]}.{PARTS[part]}{rest}"] = torch.from_numpy(array).float()
    return weights


# Names of settings under which the files keep them; the scalar critic's files have neither atoms nor losses to weigh.
NUMBERS = {
    "levels": "levels", "bins": "bins", "atoms": "atoms", "v_min": "v_min", "v_max": "v_max", "lr": "lr",
    "weight_decay": "weight_decay", "tau": "tau", "bc_margin": "bc_margin", "rl_scale": "rl_loss_scale",
    "bc_scale": "bc_loss_scale", "sequence": "action_sequence", "gru_layers": "gru_layers",
    "rgb_encoder_layers": "pixel_projection_layers", "target_interval": "target_interval",
}  # fmt: skip
SCALAR = {
    "distributional": False, "dueling": False, "project_state": False, "bc_loss_scale": 0.0, "rl_loss_scale": 1.0,
    "act_with": "online",
}  # fmt: skip


def golden_model(arrays: Mapping[str, np.ndarray]) -> CQNModel:
    """The model a file describes, with its online and target weights; with a `sequence` it is CQN-AS's."""
    given: dict[str, Any] = {name: arrays[key].item() for key, name in NUMBERS.items() if key in arrays}
    given |= {"frame_stack": 1, "shift_pixels": 0, "channels_last": False} | ({} if "atoms" in arrays else SCALAR)
    online = network_weights(arrays, "critic")
    low_dim_size, hidden_dim = arrays["low_dim"].shape[1], online["advantage.second.weight"].shape[0]
    given |= {"hidden_dim": hidden_dim}
    pixel_size = arrays["features"].shape[1] if "features" in arrays else 0
    if pixel_size:
        given["feature_dim"] = len(online["advantage.low_dim_projection.0.weight"])
    dims = int(arrays["dims"]) if "dims" in arrays else arrays["action"].shape[1]
    model = (
        CQNASModel({}, low_dim_size, dims, CQNASSettings(**given))
        if "sequence" in arrays
        else CQNModel({}, low_dim_size, dims, CQNSettings(**given))
    )
    model.encode = encoded  # type: ignore[method-assign]
    shape = replace(model.critic.shape, pixel_size=pixel_size)
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


def _batch(arrays: Mapping[str, np.ndarray]) -> Batch:
    """The file's batch; the scalar critic's has neither features nor demonstrations."""
    t = {key: torch.from_numpy(value) for key, value in arrays.items() if "/" not in key and value.ndim}
    pixels, later = ((t[key],) if key in t else () for key in ("features", "next_features"))
    return Batch(
        observation=Observation(pixels, t["low_dim"]),
        action=t["action"],
        reward=t["reward"],
        discount=t["discount"],
        next_observation=Observation(later, t["next_low_dim"]),
        demo=t.get("demo", torch.zeros_like(t["reward"])),
    )


def _after_an_update(model: CQNModel, batch: Batch, arrays: Mapping[str, np.ndarray]) -> Iterator[Deviation]:
    """Every weight after one update."""
    Learner(model).update(batch)
    for name, network in (("critic_after", model.critic), ("target_after", model.target_critic)):
        state = network.state_dict()
        weights = network_weights(arrays, name)
        assert weights.keys() == state.keys()
        yield Deviation(name, max(_absolute(state[k], v.numpy()) for k, v in weights.items()), 1e-5)


def check_critic(arrays: Mapping[str, np.ndarray]) -> Iterator[Deviation]:
    """Probabilities, greedy actions, target, losses, and every weight after one update."""
    model, t = golden_model(arrays), _batch(arrays)
    s, observation = model.settings, t.observation
    projected = model.precompute(model.critic, model.encode(observation))
    target_projected = model.precompute(model.target_critic, model.encode(observation))
    indices = encode(t.action, s.levels, s.bins)
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
    next_features = model.encode(t.next_observation)
    path, _ = model.greedy(model.critic, model.precompute(model.critic, next_features))
    yield Deviation("next_action", _absolute(decode(path, s.bins), arrays["next_action"]), 1e-6)
    target = model.td_target(next_features, t.reward, t.discount)
    yield Deviation("target_dist", _relative(target, arrays["target_dist"]), 1e-5)
    rl = q_learning_loss(taken_logits, target).mean()
    yield Deviation("rl_loss", _relative(rl, arrays["rl_loss"]), 1e-5)
    dominance = demo_mean(dominance_loss(probs, indices), t.demo)
    yield Deviation("bc_fosd_loss", _relative(dominance, arrays["bc_fosd_loss"]), 1e-5)
    margin = demo_mean(margin_loss(probs @ model.support, indices, s.bc_margin), t.demo)
    yield Deviation("bc_margin_loss", _relative(margin, arrays["bc_margin_loss"]), 1e-5)
    yield from _after_an_update(model, t, arrays)


def check_sequence_critic(arrays: Mapping[str, np.ndarray]) -> Iterator[Deviation]:
    """CQN-AS: projections, logits of the first level, the chosen sequence, and all that is CQN's."""
    model, t = golden_model(arrays), _batch(arrays)
    features = model.encode(t.observation)
    for name in ("advantage", "value"):
        stream = getattr(model.critic, name)
        parts = [stream.pixel_projection(features[0]), stream.low_dim_projection(features[1])]
        yield Deviation(f"{name}_features", _relative(torch.cat(parts, -1), arrays[f"{name}_features"]), 1e-5)
    projected = model.precompute(model.critic, features)
    first = model.critic(projected, torch.zeros_like(t.action)[:, None], torch.tensor([0]))[:, 0]
    yield Deviation("q_logits_level1", _relative(first, arrays["q_logits_level1"]), 1e-5)
    s = model.settings
    yield Deviation("snapped", _absolute(snap(t.action, s.levels, s.bins), arrays["snapped"]), 1e-6)
    chosen, _ = model.act(t.observation)
    yield Deviation("act", _absolute(chosen, arrays["target_greedy_action"]), 1e-6)
    yield from check_critic(arrays)


def check_scalar(arrays: Mapping[str, np.ndarray]) -> Iterator[Deviation]:
    """CQN-AS without distributions: values, sequences, target, loss, and every weight after one update."""
    model, t = golden_model(arrays), _batch(arrays)
    s = model.settings
    indices = encode(t.action, s.levels, s.bins)
    q = model.evaluate(model.critic, model.precompute(model.critic, model.encode(t.observation)), indices)[..., 0]
    yield Deviation("q", _relative(q, arrays["q"]), 1e-5)
    yield Deviation("q_a", _relative(q.gather(-1, indices[..., None])[..., 0], arrays["q_a"]), 1e-5)
    yield Deviation("greedy_action", _absolute(model.act(t.observation)[0], arrays["greedy_action"]), 1e-6)
    next_features = model.encode(t.next_observation)
    path, _ = model.greedy(model.critic, model.precompute(model.critic, next_features))
    yield Deviation("next_action", _absolute(decode(path, s.bins), arrays["next_action"]), 1e-6)
    target = model.td_target(next_features, t.reward, t.discount)
    yield Deviation("target_q", _relative(target, arrays["target_q"]), 1e-5)
    yield Deviation("loss", _relative(model.loss(t)[0], arrays["loss"]), 1e-5)
    yield from _after_an_update(model, t, arrays)


def check_ensemble(arrays: Mapping[str, np.ndarray]) -> Iterator[Deviation]:
    """One action a step from the sequences of all steps before it."""
    ensemble = TemporalEnsemble(int(arrays["sequence"]), float(arrays["gain"]))
    actions = []
    for sequence in torch.from_numpy(arrays["plain_chunks"]):
        ensemble.plan(sequence[None])
        actions.append(ensemble.step()[0])
    yield Deviation("actions", _absolute(torch.stack(actions), arrays["plain_actions"]), 1e-6)


def check_replay(arrays: Mapping[str, np.ndarray]) -> Iterator[Deviation]:
    """Every transition that the reference can draw of an episode, with both fills of its sequences."""
    episode = {key.removeprefix("episode/"): value for key, value in arrays.items() if key.startswith("episode/")}
    count = len(arrays["reward"])
    for fill in ("zero", "last"):
        replay = Replay(
            int(arrays["frame_stack"]), int(arrays["n_step"]), float(arrays["discount_per_step"]),
            sequence=int(arrays["sequence"]), fill={"zero": "zeros"}.get(fill, fill),
        )  # fmt: skip
        ended = bool(episode["discount"][-1, 0] == 0)
        replay.add(
            Episode(
                low_dim=episode["low_dim_obs"],
                pixels=tuple(episode["rgb_obs"].swapaxes(0, 1)),
                action=episode["action"][1:],  # the row before holds what led to an observation
                reward=episode["reward"][1:, 0],
                terminated=ended,
                success=ended,
            ),
            demo=bool(episode["demo"][-1, 0]),
        )
        got = replay.transitions(np.zeros(count, np.int64), np.arange(count))
        for name, value, expected in (
            ("action", got.action, arrays[f"{fill}_action/action"]),
            ("reward", got.reward, arrays["reward"]),
            ("discount", got.discount, arrays["discount"]),
            ("demo", got.demo, arrays["demo"]),
            ("low_dim", got.observation.low_dim, arrays["low_dim_obs"]),
            ("next low_dim", got.next_observation.low_dim, arrays["next_low_dim_obs"]),
            ("pixels", torch.stack(got.observation.pixels, 1).float(), arrays["rgb_obs"]),
            ("next pixels", torch.stack(got.next_observation.pixels, 1).float(), arrays["next_rgb_obs"]),
        ):
            assert value is not None
            yield Deviation(f"{name}, {fill}", _relative(value, expected), 1e-6)


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


CHECKS = {
    "discretisation": check_discretisation, "critic": check_critic, "encoder": check_encoder,
    "as_critic": check_sequence_critic, "as_scalar": check_scalar, "as_ensemble": check_ensemble,
    "as_replay": check_replay,
}  # fmt: skip


def kind(path: Path) -> str:
    """The words that a file's name begins with."""
    words = path.stem.split("_")
    return "_".join(words[:2] if words[0] == "as" else words[:1])


def check_file(path: Path) -> list[Deviation]:
    """All deviations of one npz file."""
    with np.load(path) as arrays:
        return list(CHECKS[kind(path)](dict(arrays)))


def main(argv: list[str]) -> int:
    """Print one line per file and quantity; 0 when all are within tolerance."""
    if len(argv) != 1 or not Path(argv[0]).is_dir():
        print("usage: python -m tests.golden.check DIR   (a folder of golden npz files)", file=sys.stderr)
        return 2
    paths = [path for path in sorted(Path(argv[0]).glob("*.npz")) if kind(path) in CHECKS]
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
