"""The station's tasks by name; a new task is one file and one entry here."""

from .click_button import ClickButton
from .task import Task

__all__ = ["TASKS"]

TASKS: dict[str, type[Task]] = {task.name: task for task in (ClickButton,)}
