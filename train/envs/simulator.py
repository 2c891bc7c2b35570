"""MuJoCo, imported on first use: the package itself stays importable without a simulator."""

import contextlib
import importlib
import os
import sys
from collections.abc import Iterator
from typing import Any

from lerobot_cqn.errors import ConfigError

__all__ = ["load_mujoco", "needed"]

_CHOOSES = ("mujoco.rendering.classic.gl_context", "mujoco.gl_context")  # the second is all that MuJoCo 3.3 has


@contextlib.contextmanager
def needed(need: str, extra: str) -> Iterator[None]:
    """Name the extra that is to be installed where an import inside fails.

    Args:
        need: what needs which package, as "The environment 'hil_sim' needs gym_hil".
        extra: of this distribution.

    Raises:
        ConfigError: the package is not installed.
    """
    try:
        yield
    except (ImportError, ConfigError) as error:
        raise ConfigError(
            f"{need}, which is not installed: run `pip install 'lerobot_policy_cqn[{extra}]'`."
        ) from error


def load_mujoco() -> Any:
    """The mujoco module, set up to render without a screen where there is none.

    Raises:
        ConfigError: mujoco is not installed.
    """
    if sys.platform.startswith("linux") and not os.environ.get("DISPLAY") and not os.environ.get("MUJOCO_GL"):
        # MuJoCo chooses its GL backend at import; without a screen its default would fail at the first frame.
        os.environ["MUJOCO_GL"] = "egl"
        for chosen in (name for name in _CHOOSES if name in sys.modules):
            importlib.reload(sys.modules[chosen])  # somebody's plugin has imported it, before anybody had chosen
    with needed("Simulated environments need mujoco", "sim"):
        import mujoco
    return mujoco
