"""What a person decided about a recording: kept on disk at each change, and said as a recipe for ``cqn-data run``."""

import copy
import dataclasses
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot_cqn.errors import ConfigError, DataError, OutputError

__all__ = ["Decided", "Decision", "Desk"]

VERSION = 1
MOST_UNDONE = 200


@dataclass
class Decision:
    """Of one episode.

    Attributes:
        success: whether it succeeded; None as the recording says.
        drop: leave it out.
        head, tail: steps cut off at start and end; >= 0.
        threshold: below which it is still; None as all, 0 keeps its pauses. Unit of the joints.
        task: what it shows; None as the recording says.
    """

    success: bool | None = None
    drop: bool = False
    head: int = 0
    tail: int = 0
    threshold: float | None = None
    task: str | None = None


@dataclass
class Decided:
    """Of the whole recording; `threshold` is None where pauses stay in. Episodes without a decision are not listed."""

    threshold: float | None = None
    episodes: dict[int, Decision] = field(default_factory=dict)

    def of(self, index: int) -> Decision:
        """The decision on an episode; a new one is not listed."""
        return self.episodes.get(index, Decision())

    def recipe(self, recorded: Mapping[int, bool | None]) -> list[dict[str, dict[str, Any]]]:
        """Steps of a recipe, in the order in which they must be done.

        recorded: of each episode whether it succeeded, by the recording; None where it does not say.
        """
        left = {i: self.of(i) for i in recorded if not self.of(i).drop}
        steps: list[dict[str, dict[str, Any]]] = []
        dropped = [i for i in recorded if i not in left]
        if dropped:
            steps.append({"drop": {"episodes": dropped, "reason": "seen in review"}})
        tasks = {i: d.task for i, d in left.items() if d.task is not None}
        if tasks:
            steps.append({"task": {"episode_tasks": tasks}})
        cuts = {i: [d.head, d.tail] for i, d in left.items() if d.head or d.tail}
        # Where the end moves the reward moves with it.
        labels = any(d.success is not None or (d.tail and recorded[i] is not None) for i, d in left.items())
        if cuts:
            steps.append({"trim": {"cuts": cuts, **({"cut_rewards": True} if labels else {})}})
        if labels:
            failed = [i for i, d in left.items() if (recorded[i] if d.success is None else d.success) is False]
            steps.append({"label": {"failed": failed} if failed else {"all": True}})
        own = {i: d.threshold for i, d in left.items() if d.threshold is not None}
        if self.threshold is not None:
            steps.append({"filter": {"threshold": self.threshold, **({"episode_thresholds": own} if own else {})}})
        return steps

    def as_json(self) -> dict[str, Any]:
        """Plain types."""
        listed = {str(i): dataclasses.asdict(d) for i, d in sorted(self.episodes.items()) if d != Decision()}
        return {"threshold": self.threshold, "episodes": listed}


class Desk:
    """Decisions with their files: `FILE.yaml`, the recipe, and `FILE.json` beside it, from which a review goes on.

    recipe: file of the recipe. repo_id: of the dataset. lengths: T of each episode, by which a changed dataset is
    noticed. recorded: whether each succeeded, by the recording. start: pause threshold before anything is decided.

    Raises:
        ConfigError: the recipe exists without its decisions, or the decisions are of another dataset.
        DataError: the decisions cannot be read.
    """

    def __init__(
        self,
        recipe: Path,
        repo_id: str,
        lengths: Sequence[int],
        recorded: Mapping[int, bool | None],
        start: float | None,
    ) -> None:
        self.recipe, self.file = recipe, recipe.with_suffix(".json")
        self._about: dict[str, Any] = {"version": VERSION, "repo_id": repo_id, "lengths": list(lengths)}
        self.recorded = recorded
        self.decided = Decided(threshold=start)
        self._before: list[Decided] = []
        if self.file.exists():
            self.decided = self._read()
        elif recipe.exists():
            raise ConfigError(f"{recipe} exists already and no review wrote it; choose another file with --recipe.")

    @property
    def undoable(self) -> int:
        """Changes that can be taken back."""
        return len(self._before)

    def change(self, index: int | None, **changes: Any) -> None:
        """Decide something about an episode, or with None about all (`threshold`), and write it to disk.

        Raises ConfigError for what does not fit the episode.
        """
        after = copy.deepcopy(self.decided)
        if index is None:
            after.threshold = changes["threshold"]
        else:
            decision = dataclasses.replace(after.of(index), **changes)
            self._check(index, decision)
            after.episodes[index] = decision
        if after != self.decided:
            before = self.decided
            self._keep(after)
            self._before = [*self._before, before][-MOST_UNDONE:]

    def undo(self) -> None:
        """Take the last change back, if there is one."""
        if self._before:
            self._keep(self._before[-1])
            self._before.pop()

    def steps(self) -> list[dict[str, dict[str, Any]]]:
        """Steps of the recipe."""
        return self.decided.recipe(self.recorded)

    def text(self, decided: Decided | None = None) -> str:
        """The recipe as YAML, of other decisions where they are given; "" where nothing is decided."""
        import yaml

        steps = (self.decided if decided is None else decided).recipe(self.recorded)
        if not steps:
            return ""
        body = yaml.safe_dump({"steps": steps}, sort_keys=False, allow_unicode=True, default_flow_style=None, width=100)
        return f"# Written by cqn-data review of {self._about['repo_id']}; the next change writes it anew.\n{body}"

    def _check(self, index: int, decision: Decision) -> None:
        length = int(self._about["lengths"][index])
        if decision.head < 0 or decision.tail < 0 or length - decision.head - decision.tail < 2:
            raise ConfigError(
                f"Episode {index} has {length} steps: expected at least 2 between its start and its end, got"
                f" {length - decision.head - decision.tail}."
            )

    def _keep(self, decided: Decided) -> None:
        _write(self.file, json.dumps({**self._about, **decided.as_json()}, indent=1) + "\n")
        _write(self.recipe, self.text(decided) or "# Nothing is decided yet.\n")
        self.decided = decided

    def _read(self) -> Decided:
        try:
            found = json.loads(self.file.read_text())
            about = {k: found[k] for k in self._about}
            episodes = {int(i): Decision(**d) for i, d in found["episodes"].items()}
            threshold = found["threshold"]
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise DataError(f"{self.file} is damaged ({error!r}): move it away to begin anew.") from error
        if about != self._about:
            raise ConfigError(
                f"{self.file} holds decisions about '{about['repo_id']}' with {len(about['lengths'])} episodes, not"
                f" about '{self._about['repo_id']}' as it is now; choose another file with --recipe."
            )
        return Decided(threshold, episodes)


def _write(path: Path, text: str) -> None:
    """In one piece: a reader, or a kill, never meets half of it."""
    part = path.with_name(f".{path.name}.tmp")
    try:
        part.write_text(text, encoding="utf-8")
        os.replace(part, path)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror}.") from error
