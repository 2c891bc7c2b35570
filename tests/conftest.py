"""Surroundings of every test: offline, one thread per process, no access to the user's own datasets.

All are environment variables, set before torch, LeRobot or MuJoCo is imported: these read them once.
"""

import ctypes
import functools
import operator
import os
import random
import shutil
import signal
import sys
import tempfile

import draccus.wrappers.docstring
import hypothesis
import pytest

# `make test` draws the same examples every time, `make slow` new ones, and says how to draw them again. No deadline:
# a busy machine is no failure.
hypothesis.settings.register_profile("same", deadline=None, derandomize=True)
hypothesis.settings.register_profile("random", deadline=None, print_blob=True)
hypothesis.settings.load_profile(os.environ.get("CQN_EXAMPLES", "same"))

# It reads the sources of all options at each parse, half a second; the tests parse hundreds of times.
draccus.wrappers.docstring.get_attribute_docstring = functools.cache(draccus.wrappers.docstring.get_attribute_docstring)

# Started in the background of a shell, this process and all it starts would ignore Ctrl-C, which tests press.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

_WORKER = "PYTEST_XDIST_WORKER" in os.environ  # a worker inherits the folder of the process that started it
_HOME = os.environ["HF_HOME"] if _WORKER else tempfile.mkdtemp(prefix="cqn-tests-")

os.environ.update(
    HF_HUB_OFFLINE="1",
    HF_HOME=_HOME,
    HF_LEROBOT_HOME=os.path.join(_HOME, "lerobot"),
    OMP_NUM_THREADS="1",
    MKL_NUM_THREADS="1",
)


def _has_library(name: str) -> bool:
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


if sys.platform == "linux" and not os.environ.get("DISPLAY") and not os.environ.get("MUJOCO_GL"):
    only_software = _has_library("libOSMesa.so.8") and not _has_library("libEGL.so.1")
    os.environ["MUJOCO_GL"] = "osmesa" if only_software else "egl"


@pytest.fixture(autouse=True)
def _same_chance() -> None:
    """A test that draws without a generator of its own draws the same numbers, whichever test ran before it."""
    random.seed(0)
    for name, seed in (("numpy", "random.seed"), ("torch", "manual_seed")):
        if name in sys.modules:
            operator.attrgetter(seed)(sys.modules[name])(0)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Try again, at most twice, what is marked `real_time`: on a busy machine it may be late."""
    for item in items:
        if (mark := item.get_closest_marker("real_time")) is not None:
            assert mark.kwargs.get("reason"), f"{item.nodeid}: say why it needs real time"
            item.add_marker(pytest.mark.flaky(reruns=2))


def pytest_unconfigure(config: pytest.Config) -> None:
    """Remove the folder that stood in for the user's."""
    if not _WORKER:
        shutil.rmtree(_HOME, ignore_errors=True)
