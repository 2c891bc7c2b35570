"""Corrections of a policy that one already has: what it does, and what is added to it.

A frozen LeRobot policy, the *base*, acts with its own processors on the observation as it comes. Its action is one more
part of what ours sees; ours chooses a correction, which is added to it. Two steps around the policy do this in every
command of LeRobot: one asks the base, the other adds.

Shapes: K rows, D action dimensions.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.processor import EnvTransition, ProcessorStep, ProcessorStepRegistry, TransitionKey
from lerobot.utils.constants import OBS_STATE
from lerobot.utils.import_utils import register_third_party_plugins
from torch import Tensor

from .errors import DataError
from .schema import BASE_ACTION

__all__ = ["AddBaseActionProcessorStep", "Base", "BaseActionProcessorStep", "base_of"]

OBSERVATION = "observation."


class Base:
    """A frozen policy of any type that LeRobot knows, with its processors, in evaluation mode.

    Attributes:
        action: what it did last, [K, D] in its own units; None before the first frame of an episode.
    """

    def __init__(self, path: str, revision: str | None = None) -> None:
        """Load it, on its own device where there is one. Raises DataError, in one line, where that cannot be."""
        # It takes seconds, and settings are refused without it.
        from lerobot.policies.factory import get_policy_class, make_pre_post_processors

        register_third_party_plugins()  # it may be of a type that somebody else made
        try:
            config = PreTrainedConfig.from_pretrained(path, revision=revision)
            policy = get_policy_class(config.type).from_pretrained(path, config=config, revision=revision)
            self._pre, self._post = make_pre_post_processors(
                config, pretrained_path=path, pretrained_revision=revision,
                preprocessor_overrides={"device_processor": {"device": config.device}},
            )  # fmt: skip
        except Exception as error:  # each policy type raises kinds of its own
            reason = " ".join(str(error).split())[:160] or type(error).__name__
            raise DataError(
                f"No policy to correct at --policy.base_path={path}: expected a `pretrained_model` folder, or a name on"
                f" the Hub ({reason})."
            ) from error
        self.path, self.config, self.policy = path, config, policy.eval()
        self.action: Tensor | None = None

    def reset(self) -> None:
        """Forget the episode before."""
        self.action = None
        self.forget()

    def forget(self) -> None:
        """Forget what was seen and planned: another course was taken. What it did in this step stays."""
        self.policy.reset()
        self._pre.reset()
        self._post.reset()

    def act(self, frame: dict[str, Any]) -> Tensor:
        """Action [K, D] in the base's units for a frame under LeRobot's names, values as the environment gives them.

        Raises DataError for a feature that the base needs and the frame has not.
        """
        missing = [key for key in self.config.input_features or {} if key not in frame]
        if missing:
            found = sorted(key for key in frame if key.startswith(OBSERVATION))
            raise DataError(f"The base policy needs '{missing[0]}', and the observation has {found}.")
        for key, feature in (self.config.input_features or {}).items():
            size = tuple(frame[key].shape[1:])
            if len(feature.shape) == 1 and size != tuple(feature.shape):
                raise DataError(f"The base policy needs '{key}' of shape {tuple(feature.shape)}, and gets {size}.")
        given = {key: _as_lerobot_gives(value) for key, value in frame.items()}
        with torch.inference_mode():
            action = self._post(self.policy.select_action(self._pre(given)))
        if action.ndim != 2:
            raise DataError(f"The base policy gave an action of shape {tuple(action.shape)}: expected one row a scene.")
        self.action = action.detach().clone().float().cpu()
        return self.action

    def act_apart(self, frames: dict[str, Any]) -> Tensor:
        """The same for frames that do not follow one another: in each the base begins anew."""
        self.reset()
        action = self.act(frames)
        self.reset()
        return action


def _refuse_another_arm(base: Tensor, ours: Tensor) -> None:
    """Raises DataError where actions of the base and ours, [K, D] each, differ in their dimensions."""
    if base.shape[-1] != ours.shape[-1]:
        raise DataError(
            f"The base policy's actions have {base.shape[-1]} dimensions, the demonstrations' {ours.shape[-1]}: give"
            " demonstrations of what the base does."
        )


def _as_lerobot_gives(value: Any) -> Any:
    """Pictures as LeRobot's commands hand them to a policy: floats in [0, 1]."""
    return value.float() / 255 if isinstance(value, Tensor) and value.dtype == torch.uint8 else value


@lru_cache(maxsize=4)
def base_of(path: str, revision: str | None = None) -> Base:
    """The base at a path, one for the whole process: LeRobot makes policy and processors apart from one another."""
    return Base(path, revision)


@ProcessorStepRegistry.register(name="cqn_base_action")
class BaseActionProcessorStep(ProcessorStep):
    """Asks the base, and puts its action [K, D] beside the observation, in the base's units.

    Where an action is there already (a demonstration's), what remains of it is the correction that leads from the
    base's action to it; such frames need not follow one another, and the base begins anew in each.
    """

    def __init__(self, path: str, revision: str | None = None) -> None:
        self.path, self.revision = path, revision

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Add the base's action to the observation. Raises DataError as `Base.act`."""
        observation = dict(transition.get(TransitionKey.OBSERVATION) or {})
        state, demonstrated = observation.get(OBS_STATE), transition.get(TransitionKey.ACTION)
        if isinstance(state, Tensor) and state.ndim != 2:
            raise DataError("A policy that corrects another one is trained by cqn-train, not by lerobot-train.")
        base = base_of(self.path, self.revision)
        frame = {**observation, **(transition.get(TransitionKey.COMPLEMENTARY_DATA) or {})}
        changed = transition.copy()
        if isinstance(demonstrated, Tensor):
            observation[BASE_ACTION] = base.act_apart(frame)
            _refuse_another_arm(observation[BASE_ACTION], demonstrated)
            changed[TransitionKey.ACTION] = demonstrated - observation[BASE_ACTION].to(demonstrated)
        else:
            observation[BASE_ACTION] = base.act(frame)
        changed[TransitionKey.OBSERVATION] = observation
        return changed

    def reset(self) -> None:
        """Let the base forget the episode."""
        base_of(self.path, self.revision).reset()

    def get_config(self) -> dict[str, Any]:
        """Where the base is, for a checkpoint."""
        return {"path": self.path, "revision": self.revision}

    def transform_features(self, features: Any) -> Any:
        """The base's action is among the policy's own features."""
        return features


@ProcessorStepRegistry.register(name="cqn_add_base_action")
class AddBaseActionProcessorStep(ProcessorStep):
    """Adds a correction [K, D] to what the base did last, inside the action bounds.

    Where the base itself goes beyond the bounds, its own action is the bound: no correction leaves it as it is.
    """

    def __init__(self, path: str, low: Sequence[float], high: Sequence[float], revision: str | None = None) -> None:
        self.path, self.revision, self.low, self.high = path, revision, list(low), list(high)

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """The action that is executed. Raises DataError before the base was asked."""
        correction = transition.get(TransitionKey.ACTION)
        if not isinstance(correction, Tensor):
            return transition
        base = self._acted().to(correction.dtype).to(correction.device)
        _refuse_another_arm(base, correction)
        low, high = (torch.tensor(end, dtype=base.dtype, device=base.device) for end in (self.low, self.high))
        changed = transition.copy()
        changed[TransitionKey.ACTION] = torch.clamp(
            base + correction, torch.minimum(low, base), torch.maximum(high, base)
        )
        return changed

    def action_of(self, executed: Tensor) -> Tensor:
        """The correction [K, D] that would have led to an action [K, D] in this step."""
        return executed - self._acted().to(executed)

    def sent(self, action: Tensor | None) -> None:
        """Nothing: what was sent does not change what the base sees next."""

    def _acted(self) -> Tensor:
        action = base_of(self.path, self.revision).action
        if action is None:
            raise DataError(
                "The base policy has not acted in this episode: run the preprocessor on an observation before the first"
                " action."
            )
        return action

    def get_config(self) -> dict[str, Any]:
        """Where the base is, and the bounds, for a checkpoint."""
        return {"path": self.path, "revision": self.revision, "low": self.low, "high": self.high}

    def transform_features(self, features: Any) -> Any:
        """Shapes and types stay."""
        return features
