"""The station's tasks by name; a new task is one file and one entry here."""

from .click_button import ClickButton
from .flip_cup import FlipCup
from .open_drawer_put_teddy import OpenDrawerPutTeddy
from .take_lid_off_saucepan import TakeLidOffSaucepan
from .task import Task

__all__ = ["TASKS"]

TASKS: dict[str, type[Task]] = {
    task.name: task for task in (ClickButton, FlipCup, OpenDrawerPutTeddy, TakeLidOffSaucepan)
}
