"""Pre- and post-processing: LeRobot's steps with statistics that are safe online, and a bound on the state."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.processor import (
    AddBatchDimensionProcessorStep,
    DeviceProcessorStep,
    NormalizerProcessorStep,
    ObservationProcessorStep,
    PolicyAction,
    PolicyProcessorPipeline,
    ProcessorStep,
    ProcessorStepRegistry,
    RenameObservationsProcessorStep,
    UnnormalizerProcessorStep,
)
from lerobot.processor.converters import policy_action_to_transition, transition_to_policy_action
from lerobot.utils.constants import (
    ACTION,
    OBS_ENV_STATE,
    OBS_STATE,
    POLICY_POSTPROCESSOR_DEFAULT_NAME,
    POLICY_PREPROCESSOR_DEFAULT_NAME,
)

from .base_config import RLConfig
from .correction import AddBaseActionProcessorStep, BaseActionProcessorStep
from .errors import ConfigError, DataError
from .fit_pictures import FitPicturesProcessorStep
from .joint_goals import (
    DeltaToGoalProcessorStep,
    GoalToDeltaProcessorStep,
    RememberJointsProcessorStep,
    converted_deltas,
    undone_deltas,
)
from .rows_check import check_rows
from .scaling_check import check_scaling
from .schema import BASE_ACTION, BOUND_PROCESSOR, dimension_names, opens_and_closes
from .settings import CQNASSettings, CQNSettings

__all__ = ["BoundObservationProcessorStep", "Stats", "make_processors", "scaling_stats"]

Stats = dict[str, dict[str, Any]]


@ProcessorStepRegistry.register(name=BOUND_PROCESSOR)
@dataclass
class BoundObservationProcessorStep(ObservationProcessorStep):
    """Cut normalised state to [-bound, bound]: a joint outside the demonstrations must not blow up the network.

    Raises DataError for a state that is not finite.
    """

    bound: float = 2.0

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Cut robot and environment state of an observation."""
        bounded = dict(observation)
        for key in (OBS_STATE, OBS_ENV_STATE, BASE_ACTION):
            if key in bounded:
                value = torch.as_tensor(bounded[key])
                if not torch.isfinite(value).all():
                    raise DataError(
                        f"'{key}' holds NaN or infinite values: expected finite numbers; check the sensor or the "
                        "dataset (`cqn-data filter` names the episode and frame)."
                    )
                bounded[key] = value.clamp(-self.bound, self.bound)
        return bounded

    def get_config(self) -> dict[str, Any]:
        """Settings that are saved with the checkpoint."""
        return {"bound": self.bound}

    def transform_features(self, features: Any) -> Any:
        """Shapes and types stay."""
        return features


def scaling_stats(stats: Stats, margin: float, *, inverse: bool, bound_margin: float = 0.0) -> Stats:
    """Statistics made safe for MIN_MAX scaling of state and action.

    A constant dimension (min == max) maps to 0; with `inverse`, any value maps back to the constant.
    margin widens the bounds of the action on both sides by this share of their range, bound_margin by this share of
    each bound's absolute value, as the authors' code does.
    """
    safe: Stats = {}
    for key, entry in stats.items():
        safe[key] = dict(entry)
        if key not in (ACTION, OBS_STATE, OBS_ENV_STATE, BASE_ACTION) or "min" not in entry:
            continue
        low, high = np.asarray(entry["min"], dtype=np.float64), np.asarray(entry["max"], dtype=np.float64)
        widen = margin * (high - low) if key == ACTION else 0.0
        own = bound_margin if key == ACTION else 0.0
        constant = high - low <= 1e-8 * np.maximum(1.0, np.abs(low))
        spread = np.where(constant, 0.0 if inverse else 1.0, widen)
        below, above = (np.where(constant, spread, widen + own * np.abs(end)) for end in (low, high))
        safe[key]["min"], safe[key]["max"] = low - below, high + above
        if inverse:  # exactly equal, so that LeRobot's inverse returns the constant
            safe[key]["max"] = np.where(constant, safe[key]["min"], safe[key]["max"])
    return safe


def make_processors(
    config: RLConfig, dataset_stats: Stats | None = None, dataset_meta: Any = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Pipelines around the policy, under the step names LeRobot overrides by.

    dataset_stats: LeRobot's statistics (`min`, `max`, `mean`, `std` per feature); None leaves values as they are.
    dataset_meta: LeRobot's metadata of the dataset; where its actions are no longer what was recorded, goals or
        differences, the pipelines turn the policy's back into those. By default the one the policy was made for.
    Raises DataError where the dataset's history is damaged, or statistics are missing or not those of its data.
    """
    # lerobot-train hands the metadata to `make_policy` only, which leaves it here.
    meta = getattr(config, "_runtime_dataset_meta", None) if dataset_meta is None else dataset_meta
    remember, to_goal = _goal_steps(meta)
    stats = _tensors_to_numpy(dataset_stats or {})
    margin, own = config.settings.action_margin, config.settings.bound_margin
    features: dict[str, PolicyFeature] = {**(config.input_features or {}), **(config.output_features or {})}
    if meta is not None and ACTION in meta.features:
        bound = config.settings.state_bound if OBS_STATE in features else None
        check_rows(meta)
        check_scaling(stats, meta, margin=margin, state_bound=bound)
    ask: list[ProcessorStep] = []
    add: list[ProcessorStep] = []
    if config.base_path is not None:
        ask, add, stats = _correction_steps(config, stats, meta)
        margin, own, to_goal = 0.0, 0.0, []
    norm_map = {FeatureType(k): NormalizationMode(v) for k, v in config.normalization_mapping.items()}
    pre = PolicyProcessorPipeline[dict[str, Any], dict[str, Any]](
        steps=[
            RenameObservationsProcessorStep(rename_map={}),
            AddBatchDimensionProcessorStep(),
            *ask,
            *remember,
            *_picture_steps(features),
            DeviceProcessorStep(device=config.device),
            NormalizerProcessorStep(
                features=features,
                norm_map=norm_map,
                stats=scaling_stats(stats, margin, inverse=False, bound_margin=own),
                device=config.device,
            ),
            BoundObservationProcessorStep(bound=config.settings.state_bound),
        ],
        name=POLICY_PREPROCESSOR_DEFAULT_NAME,
    )
    post = PolicyProcessorPipeline[PolicyAction, PolicyAction](
        steps=[
            UnnormalizerProcessorStep(
                features=config.output_features or {},
                norm_map=norm_map,
                stats=scaling_stats(stats, margin, inverse=True, bound_margin=own),
            ),
            *add,
            *to_goal,
            DeviceProcessorStep(device="cpu"),
        ],
        name=POLICY_POSTPROCESSOR_DEFAULT_NAME,
        to_transition=policy_action_to_transition,
        to_output=transition_to_policy_action,
    )
    return pre, post


def _correction_steps(
    config: RLConfig, stats: Stats, meta: Any
) -> tuple[list[ProcessorStep], list[ProcessorStep], Stats]:
    """Steps that ask the base and add to it, and statistics in which -1..1 is the range of a correction.

    Raises ConfigError without action bounds, and where the dataset's actions are differences that `cqn-data delta` made
    or undid: the base's are what the robot takes.
    """
    s, path = config.settings, str(config.base_path)
    if not isinstance(s, CQNSettings) or isinstance(s, CQNASSettings):
        raise ConfigError("Corrections are for --policy.type=cqn: leave out --policy.base_path, or change the type.")
    if converted_deltas(meta) is not None or undone_deltas(meta) is not None:
        raise ConfigError(
            "The base's actions are what the robot takes, the dataset's were changed by `cqn-data delta`: give the "
            "dataset as it was before."
        )
    if "min" not in stats.get(ACTION, {}):
        raise ConfigError("Corrections are shares of the actions' range: give a dataset, or its statistics.")
    low, high = (np.asarray(stats[ACTION][end], np.float64).reshape(-1) for end in ("min", "max"))
    names = dimension_names(meta.features[ACTION]) if meta is not None else [str(i) for i in range(len(low))]
    held = np.array([opens_and_closes(name) for name in names])
    reach = np.where(held, s.correction_gripper, s.correction_range) * (high - low)
    changed = {**stats, BASE_ACTION: stats[ACTION], ACTION: {"min": -reach, "max": reach}}
    ask = BaseActionProcessorStep(path, config.base_revision)
    return [ask], [AddBaseActionProcessorStep(path, low.tolist(), high.tolist(), config.base_revision)], changed


def _goal_steps(dataset_meta: Any) -> tuple[list[ProcessorStep], list[ProcessorStep]]:
    made, undone = converted_deltas(dataset_meta), undone_deltas(dataset_meta)
    deltas = made or undone
    if deltas is None:
        return [], []
    remember = RememberJointsProcessorStep()
    step = DeltaToGoalProcessorStep if made is not None else GoalToDeltaProcessorStep
    return [remember], [step(deltas.kind, deltas.action_dims, deltas.state_dims, remember)]


def _picture_steps(features: dict[str, PolicyFeature]) -> list[ProcessorStep]:
    shapes = {key: f.shape for key, f in features.items() if f.type is FeatureType.VISUAL and len(f.shape) == 3}
    return [FitPicturesProcessorStep(shapes)] if shapes else []


def _tensors_to_numpy(stats: Stats) -> Stats:
    return {
        key: {n: v.cpu().numpy() if isinstance(v, torch.Tensor) else v for n, v in entry.items()}
        for key, entry in stats.items()
    }
