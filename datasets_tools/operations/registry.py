"""The one table of what ``cqn-data`` can do; an operation is imported when it is asked for."""

from dataclasses import dataclass
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .job import Step

__all__ = ["OPERATIONS", "STEPS", "Operation", "module_of", "step_class"]

PACKAGE = __package__.rpartition(".")[0]


@dataclass(frozen=True)
class Operation:
    """An operation by its name on the command line.

    Attributes:
        summary: one line for ``--help``.
        module: where it is in this package; one without a step offers help(summary) and main(args), and an int that
            main returns is the exit code.
        step: its ``Step`` there, where it may be a step of a recipe; else "".
    """

    summary: str
    module: str
    step: str = ""


OPERATIONS = {
    "convert": Operation(
        "turn RLBench, robomimic, ALOHA, diffusion_policy, NPZ or LeRobot v2.1 data into a LeRobotDataset v3",
        "formats.convert",
    ),
    "inspect": Operation(
        "look at a dataset before training: pauses, cameras, outliers, what is missing", "inspection.inspect"
    ),
    "review": Operation(
        "look at a recording on a page: cut, label, drop and name episodes, see which pauses go", "review.review"
    ),
    "record": Operation("record scripted demonstrations in an environment, as teleoperation would", "record"),
    "filter": Operation("leave out the time steps in which nothing moves", "operations.filter", "Filter"),
    "trim": Operation("cut heads and tails of episodes", "operations.trim", "Trim"),
    "delta": Operation("turn absolute joint actions into delta joint actions, or back", "operations.delta", "Delta"),
    "resample": Operation("take fewer steps a second", "operations.resample", "Resample"),
    "resize": Operation("scale the pictures, and cut them out first where asked", "operations.resize", "Resize"),
    "label": Operation("write sparse rewards: 1 on the last step of successful episodes", "operations.label", "Label"),
    "task": Operation("say in words what the episodes show", "operations.task", "Task"),
    "bounds": Operation("set the action bounds that training scales by", "operations.bounds", "SetBounds"),
    "drop": Operation("leave out whole episodes, by number or by rule", "operations.drop", "Drop"),
    "merge": Operation("put several recordings of one arm together, after a look whether they fit", "operations.merge"),
    "run": Operation("run several of these as one pass over the videos, from a recipe", "operations.recipe"),
    "push": Operation("upload a dataset to the Hugging Face Hub, with a card that tells how it came about", "hub.push"),
}
STEPS = tuple(name for name, operation in OPERATIONS.items() if operation.step)


def module_of(name: str) -> ModuleType:
    """The module of an operation."""
    return import_module(f"{PACKAGE}.{OPERATIONS[name].module}")


def step_class(name: str) -> "type[Step]":
    """The class of an operation that may be a step of a recipe."""
    found: Any = getattr(module_of(name), OPERATIONS[name].step)
    return found  # type: ignore[no-any-return]
