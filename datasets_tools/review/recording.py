"""A recording as the page shows it: its episodes in numbers, the steps that go, films and pictures as they are.

Shapes: T steps of an episode, S state dimensions.
"""

import threading
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import DataError
from lerobot_cqn.schema import ACTION, NEXT_REWARD, NEXT_SUCCESS, STATE, dimension_names

from ..decisions.pause_threshold import Suggestion, suggest
from ..decisions.pauses import Rule, keep_mask, pause_runs
from ..decisions.rewards import carries_reward, demonstration_end
from ..disk.pictures import picture_size, shaped
from ..disk.source import Source
from ..operations.filter import Filter
from ..views.episode import Camera
from ..views.selected import Selected
from .decided import Decided

__all__ = ["Looked", "Recording"]

MOST_SHOWN = 2000  # points of a curve
NEAREST = 5  # significant digits are enough to draw


@dataclass(frozen=True)
class Looked:
    """What becomes of one episode: steps before `start` and from `stop` on are cut off, `runs` (first, length) go."""

    start: int
    stop: int
    runs: tuple[tuple[int, int], ...]

    @property
    def kept(self) -> int:
        """Steps that are left."""
        return self.stop - self.start - sum(length for _, length in self.runs)


class Recording:
    """An opened dataset for several readers at once; numbers and pictures are read one at a time.

    Raises DataError where an episode cannot be read.
    """

    def __init__(self, source: Source) -> None:
        self.source = source
        self._lock = threading.Lock()
        self._looked: dict[tuple[Any, ...], Looked] = {}
        judged = {NEXT_SUCCESS, NEXT_REWARD} & set(source.features)
        self.recorded: dict[int, bool | None] = {}
        self.lengths: list[int] = []
        for index in source.episodes:
            episode = source.episode(index)
            self.lengths.append(len(episode))
            self.recorded[index] = demonstration_end(episode.columns, len(episode))[1] if judged else None
        self.suggestion = self._suggest()

    def _suggest(self) -> Suggestion | None:
        """A pause threshold; None where there are no states and actions to see pauses in."""
        try:
            joints = list(Filter().rule_at(self.source, 1.0).joints)
        except DataError:
            return None
        if not joints:
            return None
        return suggest(self.source.episode(i).columns[STATE][:, joints] for i in self.source.episodes)

    def summary(self) -> dict[str, Any]:
        """What the page needs to know once."""
        source, found = self.source, self.suggestion
        cameras = [
            {"key": key, "height": height, "width": width, "film": key in source.meta.video_keys}
            for key in source.cameras
            for height, width in [picture_size(source.features[key])]
        ]
        return {
            "fps": float(source.fps),
            "cameras": cameras,
            "state_names": dimension_names(source.features[STATE]) if STATE in source.features else [],
            "episodes": [
                {"steps": length, "success": self.recorded[i], "task": self.source.episode(i).tasks[0]}
                for i, length in enumerate(self.lengths)
            ],
            "pauses": None
            if found is None
            else {
                "suggested": found.threshold,
                "reason": found.reason,
                "clear": found.clear,
                "low": float(10 ** found.edges[0]),
                "high": float(10 ** found.edges[-1]),
            },
        }

    def curves(self, index: int) -> dict[str, Any]:
        """The states of an episode over its steps, and where its films begin and end, in seconds of their files."""
        with self._lock:
            episode = self.source.episode(index)
        every = -(-len(episode) // MOST_SHOWN)
        states = np.asarray(episode.columns[STATE], np.float64) if STATE in episode.columns else np.zeros((0, 0))
        shown = states[::every].T if states.size else states
        films = {key: self.source.span(index, key) for key in self.source.cameras if key in self.source.meta.video_keys}
        curves = [[float(f"{v:.{NEAREST}g}") for v in row] for row in shown]
        return {"every": every, "states": curves, "films": films}

    def look_at(self, indices: Iterable[int], decided: Decided, threshold: float | None = None) -> dict[int, Looked]:
        """What becomes of episodes by the decisions; `threshold` in place of the common one, while it is moved."""
        common = decided.threshold if threshold is None else threshold
        if common is None or self.suggestion is None:
            return {i: Looked(*self._ends(decided, i), ()) for i in indices}
        with self._lock:
            # As the recipe's filter has it: after what is dropped and cut off, which decides how fast is driving.
            left = [i for i in self.recorded if not decided.of(i).drop]
            view = Selected(self.source, rows={i: np.arange(*self._ends(decided, i), dtype=np.int64) for i in left})
            setting = Filter(threshold=common)
            rule = setting.rule_at(view, common)
            relabelled = any("label" in step for step in decided.recipe(self.recorded))
            looked = {}
            for index in indices:
                own = decided.of(index).threshold
                ends, one = self._ends(decided, index), rule if own is None else setting.rule_with(view, rule, own)
                key = (index, ends, one, relabelled)
                if key not in self._looked:
                    self._looked[key] = self._decide(index, *ends, one, relabelled=relabelled)
                looked[index] = self._looked[key]
            return looked

    def _ends(self, decided: Decided, index: int) -> tuple[int, int]:
        """Steps from and to which an episode stays."""
        decision = decided.of(index)
        return decision.head, self.lengths[index] - decision.tail

    def _decide(self, index: int, start: int, stop: int, rule: Rule, *, relabelled: bool) -> Looked:
        episode = self.source.episode(index)
        always: NDArray[np.bool_] | None = None
        if not relabelled:
            always = carries_reward(episode.columns, len(episode))[start:stop]
        state, action = (np.asarray(episode.columns[key])[start:stop] for key in (STATE, ACTION))
        keep = keep_mask(state, action, rule, always)
        return Looked(start, stop, tuple((start + first, length) for first, length in pause_runs(keep)))

    def film(self, index: int, key: str) -> Path | None:
        """The file with an episode's film of a camera; None where there is none."""
        path = self.source.video_path(index, key) if key in self.source.meta.video_keys else None
        return path if path is not None and path.is_file() else None

    def missing_films(self) -> list[Path]:
        """Files of videos that are not there."""
        source = self.source
        paths = {source.video_path(i, key) for key in source.meta.video_keys for i in source.episodes}
        return sorted(path for path in paths if not path.is_file())

    def pictures(self, index: int, key: str, frames: NDArray[np.int64], height: int) -> list[NDArray[np.uint8]]:
        """Pictures (H, W, 3) of ascending frames, scaled to a height; raises DataError for what cannot be read."""
        tall, wide = picture_size(self.source.features[key])
        height = min(height, tall)
        camera = Camera(size=(height, max(1, round(wide * height / tall))))
        with self._lock:
            episode = self.source.episode(index)
            whole = {key: Camera()}
            read = (
                next(iter(self.source.camera_frames(episode, frames[i : i + 1], whole))) for i in range(len(frames))
            )
            return [shaped(picture[key], camera) for picture in read]
