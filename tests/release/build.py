"""The wheel and the source distribution of this checkout, and what they must and must not hold."""

import hashlib
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
SETTINGS: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
FOLDERS = ("lerobot_cqn", "datasets_tools", "train")
INSTALLED = ("lerobot_cqn", "lerobot_policy_cqn", "cqn_data", "cqn_train")
TYPED = ("lerobot_cqn", "lerobot_policy_cqn", "cqn_data", "cqn_train")
METADATA = {"METADATA", "RECORD", "WHEEL", "entry_points.txt", "top_level.txt", "licenses/LICENSE"}
ABOUT = {"LICENSE", "PKG-INFO", "README.md", "pyproject.toml", "setup.cfg"}  # beside the packages in the sdist
BUILD_S = 120


def checkout_files() -> list[Path]:
    """Files of the checkout, relative to it: tracked, or new and not ignored; without git, those of the packages."""
    if not (git := shutil.which("git")) or not (ROOT / ".git").exists():
        return _package_files()
    listed = subprocess.run(
        [git, "ls-files", "--cached", "--others", "--exclude-standard", "-z"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return [Path(name) for name in sorted(set(listed.stdout.split("\0"))) if name and (ROOT / name).is_file()]


def _package_files() -> list[Path]:
    names = [ROOT / name for name in ("pyproject.toml", "README.md", "LICENSE")]
    names += [path for folder in FOLDERS for path in (ROOT / folder).rglob("*") if path.is_file()]
    inside = [path.relative_to(ROOT) for path in names]
    return [path for path in inside if not any(part.startswith(".") or part == "__pycache__" for part in path.parts)]


def clean_copy(target: Path) -> Path:
    """Copy the checkout without what is ignored: setuptools packs whatever an earlier build left in build/."""
    for path in checkout_files():
        (target / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / path, target / path)
    return target


def build(source: Path, kind: str, target: Path) -> Path:
    """Build the `wheel` or the `sdist` of the folder `source` into `target`. Raises RuntimeError with what was said."""
    command = [sys.executable, "-m", "build", f"--{kind}", "--no-isolation", f"--outdir={target}", str(source)]
    done = subprocess.run(command, cwd=target.parent, capture_output=True, text=True, check=False, timeout=BUILD_S)
    if done.returncode:
        raise RuntimeError(done.stdout + done.stderr)
    (built,) = target.glob("*.whl" if kind == "wheel" else "*.tar.gz")
    return built


def unpack(sdist: Path, target: Path) -> Path:
    """Unpack the source distribution; returns the folder that it holds."""
    with tarfile.open(sdist) as archive:
        archive.extractall(target, filter="data")
    (folder,) = target.iterdir()
    return folder


def wheel_content(wheel: Path) -> dict[str, str]:
    """Name in the wheel -> SHA-256 of the file."""
    with zipfile.ZipFile(wheel) as archive:
        return {name: hashlib.sha256(archive.read(name)).hexdigest() for name in archive.namelist()}


def sdist_content(sdist: Path) -> set[str]:
    """Names of the files in the source distribution, without the folder that holds them all."""
    with tarfile.open(sdist) as archive:
        return {member.name.partition("/")[2] for member in archive.getmembers() if member.isfile()}


def installed_name(folder: str) -> str:
    """The package a source folder becomes: `train/envs` -> `cqn_train.envs`."""
    for package, source in sorted(SETTINGS["tool"]["setuptools"]["package-dir"].items(), key=lambda x: -len(x[1])):
        if folder == source or folder.startswith(source + "/"):
            return str(package) + folder.removeprefix(source).replace("/", ".")
    return folder.replace("/", ".")


def packed_files(source: Path) -> dict[str, str]:
    """What of `source` belongs into a distribution: name in the checkout -> name in the wheel."""
    settings = SETTINGS["tool"]["setuptools"]
    packed = {}
    for path in sorted(path for folder in FOLDERS for path in (source / folder).rglob("*") if path.is_file()):
        package = installed_name(path.parent.relative_to(source).as_posix())
        while package not in settings["packages"] and "." in package:  # recipes/ and static/ are no packages
            package = package.rpartition(".")[0]
        top = package.partition(".")[0]
        wheel_name = f"{installed_name(path.parent.relative_to(source).as_posix()).replace('.', '/')}/{path.name}"
        data = any(fnmatch(wheel_name, f"{top}/{pattern}") for pattern in settings["package-data"].get(top, []))
        if data or path.suffix == ".py":
            packed[path.relative_to(source).as_posix()] = wheel_name
    return packed


def wheel_problems(wheel: Path, source: Path) -> list[str]:
    """What the wheel of `source` lacks or holds too much, each in one line; pictures and tests would be too much."""
    content = set(wheel_content(wheel))
    name = f"{SETTINGS['project']['name']}-{SETTINGS['project']['version']}.dist-info"
    expected = {*packed_files(source).values(), *(f"{name}/{file}" for file in METADATA)}
    expected |= {f"{package}/py.typed" for package in TYPED}
    return _differences(content, expected, "the wheel")


def sdist_problems(sdist: Path, source: Path) -> list[str]:
    """The same for the source distribution."""
    content = {name for name in sdist_content(sdist) if ".egg-info/" not in name}
    return _differences(content, {*packed_files(source), *ABOUT}, "the sdist")


def _differences(content: set[str], expected: set[str], where: str) -> list[str]:
    missing = [f"{name} is missing in {where}" for name in sorted(expected - content)]
    return missing + [f"{name} does not belong into {where}" for name in sorted(content - expected)]


def different_files(one: Path, other: Path) -> list[str]:
    """Names whose content differs between two wheels, or that only one of them has."""
    first, second = wheel_content(one), wheel_content(other)
    return sorted(name for name in first.keys() | second.keys() if first.get(name) != second.get(name))
