"""The rooms keep their rules (docs/architecture.md); the rules themselves are the tables in rules.py."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from . import rules

ROOT = Path(__file__).resolve().parents[2]
SOURCES = rules.read_rooms(ROOT)
OTHERS = [
    rules.read(path, ROOT) for folder in ("tests", "benchmarks") for path in sorted((ROOT / folder).rglob("*.py"))
]


def _problems(checks: tuple, sources: list[rules.Source]) -> list[str]:
    return [problem for source in sources for check in checks for problem in check(source)]


def test_the_three_packages_are_found():
    assert {source.module.split(".")[0] for source in SOURCES} == set(rules.ROOMS)


@pytest.mark.parametrize("check", rules.ROOM_CHECKS, ids=lambda check: check.__name__)
def test_rooms(check):
    assert not _problems((check,), SOURCES)


@pytest.mark.parametrize("check", rules.EVERYWHERE_CHECKS, ids=lambda check: check.__name__)
def test_everywhere(check):
    assert not _problems((check,), SOURCES + OTHERS)


def test_no_modules_import_one_another():
    assert rules.circles(SOURCES) == []


def test_circles_are_found(tmp_path):
    texts = {
        "train/a.py": "def f():\n    from . import b",
        "train/b.py": "from .c import x",
        "train/c.py": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from .a import f",
        "train/d.py": "from . import a",
    }
    sources = [_source(tmp_path, name, text) for name, text in texts.items()]
    assert rules.circles(sources) == [["train.a", "train.b", "train.c"]]


def test_every_floor_is_there():
    for room, floors in rules.FLOORS.items():
        there = {source.module.split(".")[1] for source in SOURCES if source.module.startswith(f"{room}.")}
        assert there - {"_plugin"} == set(floors.replace("|", " ").split()), f"see FLOORS of {room}"


def test_plugin_import_is_light():
    """Discovery runs at the start of every LeRobot command: it must not load what only an extra provides."""
    loaded = subprocess.run(
        [sys.executable, "-c", "import lerobot_policy_cqn, sys; print(*sys.modules)"],
        check=True,
        capture_output=True,
        text=True,
        cwd=ROOT,
    ).stdout.split()
    assert "lerobot_cqn" in loaded
    assert {"lerobot_cqn.configuration_cqn", "lerobot_cqn.configuration_drqv2", "lerobot_cqn.processors"} <= set(loaded)
    assert not rules.OPTIONAL & set(loaded)


def test_constraints_are_plain_pins():
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [line for line in lines if line and not line.startswith("#")]
    assert pins
    assert not [pin for pin in pins if not re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.+!]+( ; .+)?", pin)]
    assert not [line for line in lines if "://" in line or "/" in line]


OFFENCES = [
    ("check_rooms", "lerobot_cqn/critic.py", "import cqn_train.loop"),
    ("check_rooms", "lerobot_cqn/critic.py", "def f():\n    from cqn_data import cli"),
    ("check_rooms", "lerobot_cqn/_plugin/__init__.py", "import cqn_train.loop.trainer"),
    ("check_rooms", "lerobot_cqn/__init__.py", "from . import _plugin"),
    ("check_rooms", "datasets_tools/operations/trim.py", "import cqn_train"),
    ("check_rooms", "datasets_tools/operations/trim.py", "from lerobot_cqn import learner"),
    ("check_rooms", "train/loop/trainer.py", "import lerobot_policy_cqn"),
    ("check_relative", "train/loop/trainer.py", "from cqn_train.replay.buffer import Replay"),
    ("check_relative", "datasets_tools/cli.py", "import datasets_tools.trim"),
    ("check_installed_names", "train/cli.py", "from datasets_tools import trim"),
    ("check_installed_names", "tests/unit/test_x.py", "import train.replay"),
    ("check_floors", "lerobot_cqn/discretisation.py", "from .configuration_cqn import CQNConfig"),
    ("check_floors", "lerobot_cqn/losses.py", "from lerobot_cqn.networks import Stream"),
    ("check_floors", "lerobot_cqn/critic.py", "from . import learner"),
    ("check_floors", "lerobot_cqn/critic.py", "import lerobot_cqn"),
    ("check_floors", "lerobot_cqn/novelty.py", ""),
    ("check_floors", "datasets_tools/views/x.py", "def f():\n    from ..disk.source import Source"),
    ("check_floors", "datasets_tools/hub/card.py", "from ..inspection.numbers import measure"),
    (
        "check_floors",
        "train/replay/x.py",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from .. import build",
    ),
    ("check_floors", "train/run/x.py", "from ..loop.trainer import Trainer"),
    ("check_floors", "train/envs/ur5e_station/station.py", "from ...loop.trainer import run"),
    ("check_floors", "train/robot/arm.py", "from .. import envs"),
    ("check_floors", "train/operator/web.py", "def f():\n    from ..robot import arm"),
    ("check_optional", "train/loop/trainer.py", "try:\n    import wandb\nexcept ImportError:\n    wandb = None"),
    ("check_optional", "train/demo/report.py", "class A:\n    from matplotlib import pyplot"),
    ("check_forbidden", "train/run/checkpoint.py", "x = eval('1')"),
    ("check_forbidden", "train/run/checkpoint.py", "def f(p):\n    return pickle.load(p)"),
    ("check_forbidden", "train/run/checkpoint.py", "torch.load(p, weights_only=False)"),
    ("check_forbidden", "train/run/checkpoint.py", "subprocess.run('ls', shell=True)"),
    ("check_length", "train/loop/trainer.py", "x = 1\n" * (rules.MAX_LINES + 1)),
]
FINE = [
    (
        "lerobot_cqn/critic.py",
        "from .networks import Stream\nfrom lerobot_cqn.schema import Batch",
    ),
    ("lerobot_cqn/_plugin/__init__.py", "import cqn_train.envs\nimport lerobot_cqn"),
    ("datasets_tools/operations/trim.py", "from lerobot_cqn.errors import DataError\nfrom lerobot_cqn import schema"),
    ("datasets_tools/operations/trim.py", "from .reading import episodes\nfrom ..views import view"),
    (
        "train/loop/trainer.py",
        "from cqn_data import cli\nfrom lerobot_cqn import learner\nfrom .envs import x",
    ),
    ("train/envs/ur5e_station/station.py", "from ...interfaces import Task\nfrom .task import Goal"),
    ("train/envs/ur5e_station/station.py", "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import mujoco"),
    ("train/demo/report.py", "def draw():\n    import matplotlib.pyplot as plt"),
    ("train/loop/trainer.py", "critic.eval()\ntorch.load(p, weights_only=True)"),
]


def _source(root: Path, name: str, text: str) -> rules.Source:
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return rules.read(path, root)


@pytest.mark.parametrize(("check", "name", "text"), OFFENCES)
def test_offences_are_found(tmp_path, check, name, text):
    source = _source(tmp_path, name, text)
    found = _problems((getattr(rules, check),), [source])
    assert len(found) == 1, found
    assert re.match(rf"{re.escape(str(source.path))}:\d+ ", found[0])


@pytest.mark.parametrize(("name", "text"), FINE)
def test_what_is_allowed_passes(tmp_path, name, text):
    assert not _problems(rules.ROOM_CHECKS + rules.EVERYWHERE_CHECKS, [_source(tmp_path, name, text)])


@pytest.mark.parametrize(
    "text", ["from .envs.ur5e_station import station", "from .envs.ur5e_station.station import Station"]
)
def test_module_that_needs_an_extra_is_imported_on_use(tmp_path, monkeypatch, text):
    monkeypatch.setattr(rules, "IMPORTED_ON_USE", frozenset({"train.envs.ur5e_station.station"}))
    station = _source(tmp_path, "train/envs/ur5e_station/station.py", "import mujoco")
    assert not _problems((rules.check_optional,), [station])
    user = _source(tmp_path / "other", "train/build.py", text)
    assert len(_problems((rules.check_optional,), [user])) == 1
