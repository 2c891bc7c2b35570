"""Demonstrations of a LeRobotDataset as replay episodes: every column read once, every frame decoded once."""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, HF_LEROBOT_HOME, OBS_STATE
from lerobot.utils.feature_utils import dataset_to_policy_features
from numpy.typing import NDArray

from cqn_data.decisions.rewards import REWARD_FEATURES, demonstration_end
from cqn_data.disk.source import open_source
from cqn_data.disk.whole import refuse_damaged
from lerobot_cqn.errors import DataError
from lerobot_cqn.schema import BASE_ACTION, NEXT_REWARD, NEXT_SUCCESS

from ..agent import Agent
from ..config import DatasetSettings, Recipe
from .episode import Episode, spans

__all__ = ["Demonstrations", "Recorded", "counts_as_demonstration", "load_metadata"]

logger = logging.getLogger(__name__)

PICTURES = ("video", "image")
AT_A_TIME = 32  # rows with pictures
REACHED = 1.001  # a correction of this size is still within the range, but for rounding
KEPT = 0.5  # of the steps; where fewer come before the ends of their episodes, a line says so


def counts_as_demonstration(recipe: Recipe, *, success: bool) -> bool:
    """Whether an online episode counts as a demonstration: a success does, where the recipe relabels (section 3.3)."""
    return recipe.relabel and success


def load_metadata(settings: DatasetSettings) -> LeRobotDatasetMetadata:
    """Features and statistics. Raises DataError when the dataset is missing, damaged or empty."""
    root = Path(settings.root) if settings.root else HF_LEROBOT_HOME / settings.repo_id
    if settings.root and not (root / "meta" / "info.json").is_file():
        raise DataError(
            f"No dataset at {root}: expected meta/info.json of a LeRobotDataset v3; check --dataset.root, "
            "or make one with `cqn-data record`."
        )
    try:
        meta = LeRobotDatasetMetadata(settings.repo_id, root=settings.root)
    except Exception as error:
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise DataError(
            f"No readable LeRobotDataset v3 '{settings.repo_id}' at {root}: give --dataset.root=DIR for a local one, "
            f"or check --dataset.repo_id ({reason})."
        ) from error
    if not meta.total_episodes or not meta.total_frames:
        raise DataError(f"The dataset at {root} is empty: expected at least one episode; record some first.")
    chosen = range(meta.total_episodes) if settings.episodes is None else settings.episodes
    if not chosen or min(chosen) < 0 or max(chosen) >= meta.total_episodes:
        raise DataError(
            f"--dataset.episodes={settings.episodes}: expected at least one of the episodes 0 to "
            f"{meta.total_episodes - 1} that the dataset at {root} holds."
        )
    return meta


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """What an arm is to know of the demonstrations: it may be on another machine than they.

    fps: their frames a second; names: of the numbers of each feature that has some; first_states: where their episodes
    began, [K, P], None where no state was recorded.
    """

    fps: float
    names: dict[str, list[str]]
    first_states: NDArray[Any] | None


class Demonstrations:
    """Demonstrations of a LeRobotDataset: metadata is read when this is made, rows and pictures when asked for.

    Raises DataError as `load_metadata`.

    Attributes:
        meta: LeRobot's metadata of the dataset.
    """

    def __init__(self, settings: DatasetSettings) -> None:
        self.settings, self.meta = settings, load_metadata(settings)

    @cached_property
    def dataset(self) -> LeRobotDataset:
        """The dataset, with the chosen episodes only. Raises DataError for what LeRobot's loader would stumble over."""
        here = (self.meta.root / "data").is_dir()  # else it is downloaded first
        if here:
            self._refuse_damaged(self.meta.root)
        found = LeRobotDataset(self.settings.repo_id, root=self.settings.root, episodes=self.settings.episodes)
        if not here:
            self._refuse_damaged(found.root)
        return found

    def _refuse_damaged(self, root: Path) -> None:
        refuse_damaged(open_source(self.settings.repo_id, str(root)), self.settings.episodes)

    def recorded(self) -> Recorded:
        """What an arm is to know of them."""
        named = {key: feature.get("names") for key, feature in self.meta.features.items()}
        names = {key: list(given) for key, given in named.items() if isinstance(given, list | tuple)}
        return Recorded(fps=self.meta.fps, names=names, first_states=self.first_states())

    def first_states(self) -> NDArray[Any] | None:
        """The state at the start of each episode, [K, P]; None where none was recorded."""
        if OBS_STATE not in self.dataset.features:
            return None
        columns = self.dataset.hf_dataset.with_format("numpy")
        first = np.unique(np.asarray(columns["episode_index"]), return_index=True)[1]
        return np.stack([columns[int(row)][OBS_STATE] for row in first])

    def episodes(self, agent: Agent, on_episode: Callable[[int, int], None] = lambda _i, _n: None) -> list[Episode]:
        """Episodes, in the policy's normalised units, cut where they end (`demonstration_end`).

        Without a reward column the last step of each episode counts as the success (reward 1), and a line says so; one
        says so, too, where most steps come after the ends.
        Datasets do not store what came after the last action: the last observation stands in for it.
        Raises DataError for a missing feature, another size, values that are not finite, or a damaged dataset.
        """
        dataset, policy = self.dataset, agent.policy
        vectors_of = [key for key in policy.low_dim_keys if key != BASE_ACTION]
        needed = [
            *policy.view_keys,
            *vectors_of,
            ACTION,
            *(agent.base.config.input_features or {} if agent.base else ()),
        ]
        missing = [key for key in needed if key not in dataset.features]
        if missing:
            raise DataError(
                f"The dataset has no '{missing[0]}', which the policy needs; it has {sorted(dataset.features)}."
            )
        found = dataset_to_policy_features(dataset.features)
        for key, feature in {**(policy.config.input_features or {}), ACTION: policy.config.action_feature}.items():
            if key == BASE_ACTION:
                continue
            if tuple(found[key].shape) != tuple(feature.shape):
                raise DataError(
                    f"'{key}' has shape {tuple(found[key].shape)} in the dataset, but {tuple(feature.shape)} in the "
                    "policy: train a new policy, or give the dataset this one was trained on."
                )
        rewarded = NEXT_REWARD in dataset.features
        judged = [key for key in REWARD_FEATURES if key in dataset.features]
        columns = dataset.hf_dataset.with_format("numpy")
        numbers = np.asarray(columns["episode_index"])
        plain = [key for key in needed if dataset.features[key]["dtype"] not in PICTURES]
        raw = {key: _column(columns, key) for key in dict.fromkeys((*plain, *judged))}
        _check_finite(raw, numbers)
        if not rewarded:
            logger.warning("No '%s' column: the last step of each episode counts as the success.", NEXT_REWARD)
        if NEXT_SUCCESS in raw and rewarded and not raw[NEXT_SUCCESS].any() and (raw[NEXT_REWARD] > 0).any():
            logger.warning("'%s' is never true, though rewards are positive: it is not looked at.", NEXT_SUCCESS)
            judged.remove(NEXT_SUCCESS)
        vectors = {key: torch.from_numpy(value).float() for key, value in raw.items() if key not in REWARD_FEATURES}
        if not policy.low_dim_keys:  # LeRobot's steps insist on an observation; pictures are decoded below
            vectors[policy.view_keys[0]] = torch.zeros(1, 3, 1, 1)
        low_dim, action = _prepared(agent, dataset, vectors)
        imitable = None if agent.base is None else _within_reach(agent, action)
        if imitable is not None and not imitable.all():
            logger.warning(
                "%d of %d demonstrated steps lie beyond --policy.correction_range of what the base does: they are not "
                "imitated.", (~imitable).sum(), len(imitable),
            )  # fmt: skip
        episodes = []
        ids = np.unique(numbers)
        for count, number in enumerate(ids):
            rows = np.flatnonzero(numbers == number)
            last, success = demonstration_end({key: raw[key][rows] for key in judged}, len(rows))
            reward = raw[NEXT_REWARD][rows].reshape(-1) if rewarded else np.zeros(len(rows), np.float32)
            if not rewarded:
                reward[last] = float(success)
            rows = rows[: last + 1]
            observed = np.append(rows, rows[-1])
            pixels = tuple(
                view[np.append(np.arange(len(rows)), len(rows) - 1)] for view in _decode(dataset, agent, rows)
            )
            episodes.append(
                Episode(
                    low_dim=None if low_dim is None else low_dim[observed],
                    pixels=pixels,
                    action=action[rows].clip(-1, 1),
                    reward=reward[: len(rows)].astype(np.float32),
                    terminated=success,
                    success=success,
                    taught=() if imitable is None or imitable[rows].all() else spans(imitable[rows].tolist()),
                )
            )
            on_episode(count + 1, len(ids))
        kept = sum(len(episode.action) for episode in episodes)
        if kept < KEPT * len(numbers):
            logger.warning(
                "Only %d of %d demonstrated steps come before the ends that %s gives them; the others are left out. If "
                "that is wrong, say where episodes end: `cqn-data label`.",
                kept, len(numbers), " and ".join(judged),
            )  # fmt: skip
        return episodes


def _prepared(
    agent: Agent, dataset: LeRobotDataset, vectors: dict[str, torch.Tensor]
) -> tuple[NDArray[Any] | None, NDArray[Any]]:
    """Normalised state [K, P] and action [K, D] of all rows; a base that needs pictures sees some rows at a time."""
    base, rows = agent.base, len(vectors[ACTION])
    views = [] if base is None else list(base.config.image_features)
    if not views:
        prepared = agent.prepare(vectors)
        return agent.low_dim(prepared), prepared[ACTION].cpu().numpy()
    parts = []
    for first in range(0, rows, AT_A_TIME):
        items = [dataset[row] for row in range(first, min(first + AT_A_TIME, rows))]
        seen = {key: torch.stack([item[key] for item in items]) for key in views}
        parts.append(agent.prepare({**{k: v[first : first + AT_A_TIME] for k, v in vectors.items()}, **seen}))
    low_dim = [agent.low_dim(part) for part in parts]
    action = np.concatenate([part[ACTION].cpu().numpy() for part in parts])
    return (None if low_dim[0] is None else np.concatenate(low_dim)), action  # type: ignore[arg-type]


def _within_reach(agent: Agent, action: NDArray[Any]) -> NDArray[np.bool_]:
    """Steps [K] whose corrections [K, D] can be made; a dimension that is left to the base is, in `action`, too."""
    bounds = agent.ranges(ACTION)
    assert bounds is not None  # noqa: S101  # the range of corrections is made with the policy
    action[:, bounds[1] == 0] = 0
    within: NDArray[np.bool_] = (np.abs(action) <= REACHED).all(axis=1)
    return within


def _column(columns: Any, key: str) -> NDArray[Any]:
    """[K, D] values of a column; LeRobot keeps a vector of one number as the number."""
    if not len(columns):
        return np.zeros((0, 1), np.float32)
    return np.stack(columns[key]).astype(np.float32).reshape(len(columns), -1)


def _check_finite(raw: dict[str, NDArray[Any]], episodes: NDArray[Any]) -> None:
    for key, values in raw.items():
        bad = np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))
        if len(bad):
            frame = int(bad[0] - np.flatnonzero(episodes == episodes[bad[0]])[0])
            raise DataError(
                f"'{key}' is NaN or infinite in episode {int(episodes[bad[0]])}, frame {frame} "
                f"({len(bad)} frames in all): expected finite numbers; drop or repair the episode."
            )


def _decode(dataset: LeRobotDataset, agent: Agent, rows: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Frames of each view, uint8 [T, 3, H, W]."""
    if not agent.policy.view_keys:
        return ()
    try:
        items = [dataset[int(row)] for row in rows]
    except Exception as error:  # each decoder raises kinds of its own
        episode, text = int(dataset.hf_dataset[int(rows[0])]["episode_index"]), " ".join(str(error).split())[:160]
        raise DataError(
            f"Pictures of episode {episode} cannot be read ({text}): look with `cqn-data inspect`, and leave the "
            "episode out with --dataset.episodes or `cqn-data drop`."
        ) from error
    frame = {key: torch.stack([item[key] for item in items]) for key in agent.policy.view_keys}
    return tuple(agent.pixels(frame))
