"""LeRobot's own robots, teleoperators and cameras by their names; plugins register themselves."""

import contextlib
import importlib
import pkgutil

__all__ = ["register_devices"]


def register_devices() -> None:
    """Import what LeRobot ships, so that `--robot.type`, `--teleop.type` and camera types are known.

    A device whose driver's package is missing is left out.
    """
    for family in ("robots", "teleoperators", "cameras"):
        package = importlib.import_module(f"lerobot.{family}")
        for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
            if module.ispkg:
                with contextlib.suppress(ImportError):
                    importlib.import_module(module.name)
