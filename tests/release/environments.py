"""Empty virtual environments, made and removed again, and commands run in them from a folder that is not ours."""

import os
import shutil
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from .build import ROOT

UV = ROOT / ".ci/uv"  # knows where packages come from
INSTALL_S, RUN_S = 900, 180
VARIABLES = {
    "HF_HUB_OFFLINE": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "DISPLAY": "",
    "TERM": "dumb",
    "COLUMNS": "200",
    "PYTHONPATH": "",
    "PYTHONDONTWRITEBYTECODE": "",
    "WANDB_MODE": "offline",
}


class FailureError(Exception):
    """Something that was tried did not do what it should; the message is for the table."""


@dataclass(frozen=True)
class Done:
    """A command that has ended.

    Attributes:
        code: exit status; 124 where it was stopped because of its time limit.
        said: everything printed, errors included.
        seconds: that it took.
    """

    code: int
    said: str
    seconds: float

    @property
    def last_line(self) -> str:
        """The last line printed that says something."""
        return next((line.strip() for line in reversed(self.said.splitlines()) if line.strip()), "")


def uv(*arguments: str, timeout: float = INSTALL_S) -> str:
    """Run uv; returns what it prints. Raises FailureError with what it complains about."""
    done = subprocess.run([str(UV), *arguments], capture_output=True, text=True, check=False, timeout=timeout)
    if done.returncode:
        raise FailureError((done.stderr or done.stdout).strip())
    return done.stdout


def run(command: Sequence[str], cwd: Path, variables: Mapping[str, str], timeout: float = RUN_S) -> Done:
    """Run a command with nobody at its keyboard."""
    began = time.monotonic()
    environment = {**os.environ, **VARIABLES, "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl"), **variables}
    try:
        done = subprocess.run(
            list(command), cwd=cwd, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, errors="replace", check=False, timeout=timeout,
        )  # fmt: skip
    except subprocess.TimeoutExpired as error:
        said = error.stdout if isinstance(error.stdout, str) else (error.stdout or b"").decode(errors="replace")
        return Done(124, said, time.monotonic() - began)
    return Done(done.returncode, done.stdout, time.monotonic() - began)


class Environment:
    """A virtual environment in `folder/environment`, and a working folder `folder/user` beside it.

    All environments of one `folder` lie at the same place, so that bytecode is compiled once for all of them.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.place = folder / "environment"
        self.user = folder / "user"
        self.variables = {
            "PYTHONPYCACHEPREFIX": str(folder / "bytecode"),
            "HF_HOME": str(folder / "huggingface"),
            "HF_LEROBOT_HOME": str(folder / "huggingface/lerobot"),
        }

    def make(self, python: str, requirements: Sequence[str], *more: str) -> None:
        """Make it anew, with `requirements` installed; `more`: options of uv."""
        self.remove()
        self.user.mkdir(parents=True)
        uv("venv", "--quiet", "--no-python-downloads", "--python", python, str(self.place))
        uv("pip", "install", "--quiet", "--python", str(self.python), *more, *requirements)

    def remove(self) -> None:
        """Free its disk space, and what the commands left in the working folder."""
        shutil.rmtree(self.place, ignore_errors=True)
        shutil.rmtree(self.user, ignore_errors=True)

    @property
    def python(self) -> Path:
        """Its interpreter."""
        return self.place / "bin/python"

    def run(self, *command: str, timeout: float = RUN_S) -> Done:
        """Run one of its commands, by name, in the working folder."""
        name, *arguments = command
        return run([str(self.place / "bin" / name), *arguments], self.user, self.variables, timeout)

    def succeed(self, *command: str, timeout: float = RUN_S) -> str:
        """The same; returns what it said. Raises FailureError unless it succeeds."""
        done = self.run(*command, timeout=timeout)
        if done.code:
            raise FailureError(f"`{' '.join(command[:2])}` ends with {done.code}: {done.last_line}")
        return done.said

    def inside(self, script: str, *arguments: str) -> str:
        """Run a script of the folder `inside`; returns its last line. Raises FailureError unless it succeeds."""
        said = self.succeed("python", "-P", str(Path(__file__).parent / "inside" / script), *arguments)
        return said.strip().splitlines()[-1] if said.strip() else ""

    def check(self) -> str:
        """`pip check`: do all installed packages fit one another? Raises FailureError where they do not."""
        return uv("pip", "check", "--python", str(self.python)) or "clean"

    def versions(self) -> dict[str, str]:
        """Installed packages and their versions."""
        lines = uv("pip", "freeze", "--python", str(self.python)).splitlines()
        return dict(line.split("==", 1) for line in lines if "==" in line)
