"""What a user installs: the wheel holds all of it, LeRobot finds it, and the user's own files do not get in the way."""

import os
import subprocess
import sys
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

from ..release import build
from ..release.build import FOLDERS, INSTALLED, ROOT, SETTINGS, installed_name
from ..release.extras import EXTRAS, PROBES
from ..release.smoke import commands

DISCOVERY = (ROOT / "tests/release/inside/discovery.py").read_text(encoding="utf-8")


def run(*command: str, cwd: Path, path: str = "") -> "subprocess.CompletedProcess[str]":
    environment = {**os.environ, "PYTHONPATH": path}
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    """A clean copy, with folders that must not be picked up."""
    folder = build.clean_copy(tmp_path_factory.mktemp("source"))
    for name in ("outputs", "data"):
        (folder / name).mkdir(exist_ok=True)
        (folder / name / "__init__.py").touch()
    return folder


@pytest.fixture(scope="module")
def sdist(source, tmp_path_factory) -> Path:
    return build.build(source, "sdist", tmp_path_factory.mktemp("sdist") / "dist")


@pytest.fixture(scope="module")
def wheel(source, sdist, tmp_path_factory) -> Path:  # after the sdist, which setuptools would fill with build/
    return build.build(source, "wheel", tmp_path_factory.mktemp("wheel") / "dist")


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


def test_every_file_of_the_packages_is_packed(source):
    """Also what is not Python: type marker, recipes, static pages (package-data in pyproject.toml)."""
    files = {path for name in FOLDERS for path in (source / name).rglob("*") if path.is_file()}
    packed = build.packed_files(source)
    assert not sorted(str(path) for path in files if path.relative_to(source).as_posix() not in packed)
    assert {
        "datasets_tools/operations/recipes/simulation.yaml",
        "train/operator/page/static/index.html",
    } <= packed.keys()


def test_wheel_and_sdist_hold_that_and_nothing_else(wheel, sdist, source):
    assert build.wheel_problems(wheel, source) == []
    assert build.sdist_problems(sdist, source) == []


def test_what_is_too_much_or_too_little_is_found(wheel, source, tmp_path):
    spoilt = tmp_path / wheel.name
    with zipfile.ZipFile(wheel) as archive, zipfile.ZipFile(spoilt, "w") as other:
        for name in archive.namelist():
            if name != "cqn_data/py.typed":
                other.writestr(name, archive.read(name))
        other.writestr("tests/test_x.py", "")
        other.writestr("cqn_train/picture.png", "")
    assert [problem.split(" in")[0] for problem in build.wheel_problems(spoilt, source)] == [
        "cqn_data/py.typed is missing",
        "cqn_train/picture.png does not belong",
        "tests/test_x.py does not belong",
    ]
    assert build.different_files(wheel, spoilt) == ["cqn_data/py.typed", "cqn_train/picture.png", "tests/test_x.py"]


def test_the_sdist_builds_the_same_wheel(wheel, sdist, tmp_path):
    unpacked = build.unpack(sdist, tmp_path / "unpacked")
    assert build.different_files(wheel, build.build(unpacked, "wheel", tmp_path / "again")) == []


def test_every_extra_is_tried_before_a_release():
    assert PROBES.keys() == EXTRAS.keys(), "see tests/release/extras.py"
    for extra in PROBES.values():
        assert extra.missing is not None or extra.why_never


def test_metadata(wheel):
    (info,) = {name.split("/")[0] for name in build.wheel_content(wheel) if ".dist-info/" in name}
    with zipfile.ZipFile(wheel) as archive:
        metadata = Parser().parsestr(archive.read(f"{info}/METADATA").decode())
        licence = archive.read(f"{info}/licenses/LICENSE").decode()
    # LeRobot compares this very spelling: with dashes the plugin would be ignored.
    assert metadata["Name"] == "lerobot_policy_cqn"
    assert metadata["License-Expression"] == "Apache-2.0"
    assert "Apache License" in licence
    assert commands(wheel) == sorted(SETTINGS["project"]["scripts"])


def _discover(cwd: Path, path: str) -> dict[str, str]:
    done = run(sys.executable, "-c", DISCOVERY, cwd=cwd, path=path)
    found = dict(line.split(" ", 1) for line in done.stdout.splitlines() if " " in line)
    assert found["policy"] == "True", done.stderr
    assert found["env"] == "True", done.stderr
    assert found["robot"] == "True", done.stderr
    return found


def test_lerobot_finds_the_wheel(installed, hostile):
    found = _discover(hostile, f".{os.pathsep}{installed}")
    for name in INSTALLED:
        assert Path(found[name]).is_relative_to(installed), f"{name} does not come from the wheel: {found[name]}"


def test_lerobot_finds_the_editable_install(hostile):
    found = _discover(hostile, ".")
    for name in INSTALLED:
        assert Path(found[name]).resolve().is_relative_to(ROOT), f"{name} is not the checkout's: {found[name]}"


@pytest.mark.parametrize("command", sorted(SETTINGS["project"]["scripts"]))
def test_commands_of_the_wheel(installed, hostile, command):
    script = installed / "bin" / command
    done = run(sys.executable, str(script), "--help", cwd=hostile, path=f".{os.pathsep}{installed}")
    assert f"{command} " in done.stdout
