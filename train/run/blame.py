"""Whose code failed: an error in somebody else's environment, robot or camera is theirs, and a person should know."""

import re
import traceback
from collections.abc import Collection

__all__ = ["plugin_at_fault"]

PLUGIN = re.compile(r"lerobot_(?:env|robot|camera|teleoperator)_\w+")  # names by which LeRobot discovers them


def plugin_at_fault(error: BaseException, discovered: Collection[str] = ()) -> str | None:
    """The package of the innermost frame that is a plugin's; None where no plugin was at work.

    discovered: packages named by `--env.discover_packages_path` and the like.
    """
    for frame, _ in reversed(list(traceback.walk_tb(error.__traceback__))):
        package = str(frame.f_globals.get("__name__", "")).partition(".")[0]
        if PLUGIN.fullmatch(package) or package in discovered:
            return package
    return None
