"""What a user installs: the wheel holds all of it, LeRobot finds it, and the user's own files do not get in the way."""

import os
import shutil
import subprocess
import sys
import tomllib
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
FOLDERS = ("lerobot_cqn", "datasets_tools", "train")
INSTALLED = ("lerobot_cqn", "lerobot_policy_cqn", "cqn_data", "cqn_train")
LEFTOVERS = shutil.ignore_patterns(".*", "__pycache__", "*.egg-info")

DISCOVERY = """
import sys
from lerobot.utils.import_utils import register_third_party_plugins
register_third_party_plugins()
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
print("policy", "cqn" in PreTrainedConfig.get_known_choices())
print("env", "ur5e_station" in EnvConfig.get_known_choices())
for name in ("lerobot_cqn", "lerobot_policy_cqn", "cqn_data", "cqn_train"):
    module = __import__(name)
    print(name, module.__file__)
"""


def installed_name(folder: str) -> str:
    """The package a source folder becomes: `train/envs` -> `cqn_train.envs`."""
    for package, source in sorted(SETTINGS["tool"]["setuptools"]["package-dir"].items(), key=lambda x: -len(x[1])):
        if folder == source or folder.startswith(source + "/"):
            return package + folder.removeprefix(source).replace("/", ".")
    return folder.replace("/", ".")


def run(*command: str, cwd: Path, path: str = "") -> "subprocess.CompletedProcess[str]":
    environment = {**os.environ, "PYTHONPATH": path}
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Built from a copy, because setuptools packs whatever an earlier build left in build/."""
    source = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in FOLDERS:
        shutil.copytree(ROOT / name, source / name, ignore=LEFTOVERS)
    for name in ("tests", "outputs"):  # must not be picked up
        (source / name).mkdir()
        (source / name / "__init__.py").touch()
    run(sys.executable, "-m", "build", "--wheel", "--no-isolation", cwd=source)
    (built,) = (source / "dist").glob("*.whl")
    return built


@pytest.fixture(scope="module")
def content(wheel) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory) -> Path:
    target = tmp_path_factory.mktemp("installed")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target"]
    run(*pip, str(target), str(wheel), cwd=target)
    return target


@pytest.fixture
def hostile(tmp_path) -> Path:
    """A working folder with files of the user's own that are called like our folders."""
    for name in ("train.py", "datasets_tools.py", "tests.py"):
        (tmp_path / name).write_text("raise RuntimeError('the user\\'s own file was imported')\n", encoding="utf-8")
    return tmp_path


def test_every_package_folder_is_listed():
    folders = {path.parent.relative_to(ROOT).as_posix() for name in FOLDERS for path in (ROOT / name).rglob("*.py")}
    listed = set(SETTINGS["tool"]["setuptools"]["packages"])
    assert {installed_name(folder) for folder in folders} == listed, "see [tool.setuptools] packages in pyproject.toml"


def test_every_source_file_is_in_the_wheel(content):
    """Also what is not Python: type marker, models, static pages (package-data in pyproject.toml)."""
    missing = []
    for path in sorted(path for name in FOLDERS for path in (ROOT / name).rglob("*") if path.is_file()):
        inside = path.relative_to(ROOT)
        if not any(part.startswith(".") or part == "__pycache__" for part in inside.parts):
            package = installed_name(inside.parent.as_posix()).replace(".", "/")
            missing += [] if f"{package}/{path.name}" in content else [str(inside)]
    assert not missing


def test_wheel_holds_nothing_else(content):
    tops = {name.split("/")[0] for name in content}
    assert tops == {*INSTALLED, f"lerobot_policy_cqn-{SETTINGS['project']['version']}.dist-info"}
    assert {f"{name}/py.typed" for name in ("lerobot_cqn", "cqn_data", "cqn_train")} <= content


def test_metadata(wheel, content):
    (info,) = {name.split("/")[0] for name in content if ".dist-info/" in name}
    with zipfile.ZipFile(wheel) as archive:
        metadata = Parser().parsestr(archive.read(f"{info}/METADATA").decode())
        entry_points = archive.read(f"{info}/entry_points.txt").decode()
        licence = archive.read(f"{info}/licenses/LICENSE").decode()
    # LeRobot compares this very spelling: with dashes the plugin would be ignored.
    assert metadata["Name"] == "lerobot_policy_cqn"
    assert metadata["License-Expression"] == "Apache-2.0"
    assert "Apache License" in licence
    assert "cqn-data = cqn_data.cli:main" in entry_points
    assert "cqn-train = cqn_train.cli:main" in entry_points


def _discover(cwd: Path, path: str) -> dict[str, str]:
    done = run(sys.executable, "-c", DISCOVERY, cwd=cwd, path=path)
    found = dict(line.split(" ", 1) for line in done.stdout.splitlines() if " " in line)
    assert found["policy"] == "True", done.stderr
    assert found["env"] == "True", done.stderr
    return found


def test_lerobot_finds_the_wheel(installed, hostile):
    found = _discover(hostile, f".{os.pathsep}{installed}")
    for name in INSTALLED:
        assert Path(found[name]).is_relative_to(installed), f"{name} does not come from the wheel: {found[name]}"


def test_lerobot_finds_the_editable_install(hostile):
    found = _discover(hostile, ".")
    for name in INSTALLED:
        assert Path(found[name]).resolve().is_relative_to(ROOT), f"{name} is not the checkout's: {found[name]}"


@pytest.mark.parametrize("command", ["cqn-train", "cqn-data"])
def test_commands_of_the_wheel(installed, hostile, command):
    script = installed / "bin" / command
    done = run(sys.executable, str(script), "--help", cwd=hostile, path=f".{os.pathsep}{installed}")
    assert "usage" in done.stdout.lower()
