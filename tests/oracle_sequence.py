"""CQN-AS line by line: `tests.oracle` with a stream that goes along the steps of a sequence, one gate at a time."""

import torch
import torch.nn.functional as F
from torch import Tensor

from lerobot_cqn.sequence import CQNASModel
from tests.oracle import Features, Oracle


class SequenceOracle(Oracle):
    """The oracle on T*D entries, entry t*D + d being dimension d of step t."""

    def __init__(self, model: CQNASModel, dtype: torch.dtype = torch.float32) -> None:
        super().__init__(model, dtype)
        self.dims, self.of_one_step = model.critic.shape.entries, model.critic.shape.dims
        self.steps, self.model_settings = model.settings.action_sequence, model.settings

    def gru(self, name: str, inputs: list[Tensor]) -> list[Tensor]:
        """PyTorch's convention: the reset gate multiplies what comes of the state, bias included."""
        for layer in range(self.model_settings.gru_layers):
            w_in, w_state, b_in, b_state = (
                self.weights[f"{name}.gru.{kind}_l{layer}"] for kind in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
            )
            state = torch.zeros_like(inputs[0])
            outputs = []
            for x in inputs:
                reset_in, update_in, new_in = (x @ w_in.T + b_in).chunk(3, dim=1)
                reset_state, update_state, new_state = (state @ w_state.T + b_state).chunk(3, dim=1)
                reset, update = torch.sigmoid(reset_in + reset_state), torch.sigmoid(update_in + update_state)
                state = (1 - update) * torch.tanh(new_in + reset * new_state) + update * state
                outputs.append(state)
            inputs = outputs
        return inputs

    def projections(self, name: str, features: Features) -> list[Tensor]:
        """What of an observation enters the trunk."""
        pixels, low_dim = features
        parts = []
        if pixels is not None:
            layers = self.model_settings.pixel_projection_layers
            for layer in range(layers + 1):
                at = 3 * layer
                pixels = pixels @ self.weights[f"{name}.pixel_projection.{at}.weight"].T
                pixels = self.layer_norm(pixels, f"{name}.pixel_projection.{at + 1}")
                pixels = torch.tanh(pixels) if layer == layers else F.silu(pixels)
            parts.append(pixels)
        if low_dim is not None and self.model_settings.project_state:
            low_dim = low_dim @ self.weights[f"{name}.low_dim_projection.0.weight"].T
            low_dim = torch.tanh(self.layer_norm(low_dim, f"{name}.low_dim_projection.1"))
        return [*parts, *([] if low_dim is None else [low_dim])]

    def stream_at(self, name: str, features: Features, level: int, step: int, previous: Tensor) -> Tensor:
        """What the head of a stream sees for one step: previous [B, T*D] -> [B, H]."""
        inputs = []
        for t in range(step + 1):
            action = previous[:, t * self.of_one_step : (t + 1) * self.of_one_step]
            one_hots = torch.zeros(len(previous), self.steps + self.settings.levels, dtype=self.dtype)
            one_hots[:, t] = 1
            one_hots[:, self.steps + level] = 1
            hidden = torch.cat([*self.projections(name, features), action, one_hots], dim=1)
            for layer in ("first", "second"):
                hidden = hidden @ self.weights[f"{name}.{layer}.weight"].T
                hidden = F.silu(self.layer_norm(hidden, f"{name}.{layer}_norm"))
            inputs.append(hidden)
        return self.gru(name, inputs)[-1]

    def network(self, critic: str, features: Features, level: int, n: int, previous: Tensor) -> Tensor:
        """Q^{l,n} of entry n: logits [B, N, A]."""
        bins, atoms = self.settings.bins, self.settings.critic_atoms
        step, d = divmod(n, self.of_one_step)

        def head(stream: str, size: int) -> Tensor:
            hidden = self.stream_at(f"{critic}.{stream}", features, level, step, previous)
            here = slice(d * size, (d + 1) * size)
            name = f"{critic}.{stream}.head"
            return hidden @ self.weights[f"{name}.weight"][here].T + self.weights[f"{name}.bias"][here]

        advantage = head("advantage", bins * atoms).reshape(-1, bins, atoms)
        if not self.model_settings.dueling:
            return advantage
        value = head("value", atoms)
        return torch.stack([value + advantage[:, i] - advantage.mean(1) for i in range(bins)], dim=1)
