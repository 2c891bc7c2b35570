"""CQNASPolicy: CQN over action sequences as a LeRobot policy."""

from typing import Any

import torch
from torch import Tensor

from .base_policy import RLPolicy
from .configuration_cqn_as import CQNASConfig
from .schema import ACTION
from .sequence import CQNASModel, OpenLoop, TemporalEnsemble, filled

__all__ = ["CQNASPolicy"]


class CQNASPolicy(RLPolicy):
    """CQN-AS: sequences from the critic, one action a step."""

    config_class = CQNASConfig
    name = "cqn_as"
    config: CQNASConfig
    model: CQNASModel
    model_class = CQNASModel

    def __init__(self, config: CQNASConfig, dataset_stats: Any = None, dataset_meta: Any = None, **more: Any) -> None:
        super().__init__(config, dataset_stats, dataset_meta, **more)
        s = config.settings
        ensemble = TemporalEnsemble(s.action_sequence, s.ensemble_gain) if s.temporal_ensemble else None
        self._player: TemporalEnsemble | OpenLoop = ensemble or OpenLoop()
        self._q: Tensor | None = None  # of the newest sequence

    def forget_plan(self) -> None:
        """Forget sequences that were chosen for a course which the episode did not take."""
        self._player.reset()

    @torch.no_grad()
    def act(self, batch: dict[str, Tensor], *, explore: bool = False) -> tuple[Tensor, Tensor]:
        """Action [B, D] of this step in [-1, 1], and the mean Q [B] of the newest sequence.

        explore: with Gaussian noise on the one action, not snapped to a representable one (the authors' code).
        """
        observation = self.observe(batch)
        if self._player.due:
            sequence, self._q = self.model.act(observation, explore)
            self._player.plan(self.model.steps(sequence))
        action, noise = self._player.step(), self.config.settings.exploration_noise
        if explore and noise > 0:
            action = (action + noise * torch.randn_like(action)).clamp(-1, 1)
        assert self._q is not None  # noqa: S101  # a sequence was due in the first step
        return action, self._q

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """The sequence [B, T, D] that is chosen from this frame alone, without the ensemble."""
        return self.model.steps(self.model.act(self.observe(batch))[0])

    def actions_of(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor | None]:
        """Sequences of LeRobot's batch, which repeats the last action beyond an episode's end and says so."""
        s = self.config.settings
        actions = batch[ACTION].reshape(-1, s.action_sequence, self.action_dims)
        inside = ~batch[f"{ACTION}_is_pad"].reshape(-1, s.action_sequence).bool()
        return filled(actions, inside, s.sequence_fill)
