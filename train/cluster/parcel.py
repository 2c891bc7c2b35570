"""What goes from the learner to a collector: the policy once, as the files of a checkpoint, then only weights."""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from numpy.typing import NDArray

from lerobot_cqn.base_config import RLConfig
from lerobot_cqn.errors import ConfigError

from ..agent import Agent
from ..build import trained_agent

__all__ = ["Files", "Weights", "pack", "take_weights", "unpack", "weights_of"]

Files = Mapping[str, bytes]
Weights = Mapping[str, NDArray[Any]]


def pack(agent: Agent) -> Files:
    """Policy and processors as the files that a checkpoint has, by name."""
    with tempfile.TemporaryDirectory() as folder:
        for part in (agent.policy, agent.preprocessor, agent.postprocessor):
            part.save_pretrained(folder)
        return {path.name: path.read_bytes() for path in Path(folder).iterdir() if path.is_file()}


def unpack(files: Files, device: str) -> Agent:
    """The policy of `pack`, on `device`. Raises ConfigError where this machine cannot make it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, content in files.items():
            (folder / Path(file).name).write_bytes(content)
        config = PreTrainedConfig.from_pretrained(folder)
        if not isinstance(config, RLConfig):
            raise ConfigError(f"Expected a policy that cqn-train trains, got '{config.type}'.")
        config.device = device
        agent = trained_agent(config, folder)
    agent.policy.train()  # as the one that learns
    return agent


def weights_of(agent: Agent) -> Weights:
    """Weights of the networks that acting asks, by name, float as they are."""
    model = agent.policy.model
    wanted = tuple(f"{name}." for name in model.acting())
    state = {name: tensor for name, tensor in model.state_dict().items() if name.startswith(wanted)}
    return {name: tensor.detach().to("cpu", copy=True).numpy() for name, tensor in state.items()}


def take_weights(agent: Agent, weights: Weights) -> None:
    """Put weights of `weights_of` into a policy of the same shape."""
    # A copy: what lies in the object store may not be written to.
    state = {name: torch.from_numpy(np.array(value)) for name, value in weights.items()}
    agent.policy.model.load_state_dict(state, strict=False)
