"""MuJoCo, imported on first use: the package itself stays importable without a simulator."""

import os
import sys
from typing import Any

from lerobot_cqn.errors import ConfigError

__all__ = ["load_mujoco"]


def load_mujoco() -> Any:
    """The mujoco module, set up to render without a screen where there is none.

    Raises:
        ConfigError: mujoco is not installed.
    """
    if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        # MuJoCo chooses its GL backend at import; without a screen its default would fail at the first frame.
        os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        import mujoco
    except ImportError as error:
        raise ConfigError(
            "Simulated environments need mujoco, which is not installed: run `pip install 'lerobot_policy_cqn[sim]'`."
        ) from error
    return mujoco
