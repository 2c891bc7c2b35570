"""``cqn-data task``: say in words what the episodes show; all of them, or single ones."""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from lerobot_cqn.errors import ConfigError
from lerobot_cqn.history_text import numbered

from ..terminal.console import table
from ..terminal.options import option
from .job import Step, settings_of
from .parts import known_episodes

if TYPE_CHECKING:
    from ..views.view import DerivedView, View

__all__ = ["MAX_LENGTH", "Task"]

MAX_LENGTH = 500  # characters


@dataclasses.dataclass
class Task(Step):
    """Settings of ``cqn-data task``, named as in ``lerobot-edit-dataset``, which changes the dataset in its place."""

    name = "task"
    example = """
cqn-data task --repo_id=local/pick --root=data/pick --new_root=data/pick_named --new_task='Put the cube into the bowl.'
cqn-data task --repo_id=local/pick --root=data/pick --new_root=data/pick_named \\
    --episode_tasks='{"3": "Put the ball into the bowl."}'
"""
    notes = """
Videos are copied as they are. The policy is not told the task; it tells people and other policies what a dataset shows.
"""

    new_task: str | None = option(None, help="The task of every episode that --episode_tasks does not name.")
    episode_tasks: dict[int, str] = dataclasses.field(
        default_factory=dict, metadata={"help": """The tasks of single episodes, e.g. '{"3": "Put it down."}'."""}
    )

    def validate(self) -> None:
        """A task must be given, and be one line."""
        if self.new_task is None and not self.episode_tasks:
            raise ConfigError("No task: expected --new_task='…' or --episode_tasks='{…}'.")
        for text in filter(None.__ne__, [self.new_task, *self.episode_tasks.values()]):
            if not str(text).strip() or not str(text).isprintable() or len(str(text)) > MAX_LENGTH:
                raise ConfigError(f"Expected a task of one line and at most {MAX_LENGTH} characters, got {text!r}.")

    def reads_numbers(self) -> bool:
        """Only words are changed."""
        return False

    def on(self, view: "View") -> "DerivedView":
        """Name the episodes; raises ConfigError for a number that is not there."""
        from ..views.tasked import Tasked

        known_episodes(view, self.episode_tasks)
        named = {i: self.episode_tasks.get(i, self.new_task) for i in view.episodes}
        after = Tasked(view, named={i: text.strip() for i, text in named.items() if text is not None})
        groups: dict[str, list[int]] = {}
        for index, text in after.named.items():
            groups.setdefault(text, []).append(index)
        table(["task", "episodes"], [[text, numbered(episodes)] for text, episodes in groups.items()])
        after.entry.update(settings=settings_of(self), tasks=groups)
        return after

    @staticmethod
    def told(entry: Mapping[str, Any]) -> str:
        """The sentence for the history."""
        groups = entry["tasks"]
        return "Named the task: " + "; ".join(f"'{text}' of {numbered(episodes)}" for text, episodes in groups.items())
