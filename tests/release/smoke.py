"""The first things that somebody does who has installed the package."""

import configparser
import subprocess
import sys
import zipfile
from pathlib import Path

from .build import INSTALLED
from .environments import Environment, FailureError

TINY = (
    "--policy.type=cqn", "--policy.preset=laptop_state", "--policy.device=cpu", "--policy.hidden_dim=16",
    "--policy.feature_dim=8",
)  # fmt: skip
STATION = ("--env.type=ur5e_station", "--env.task=click_button", "--env.obs_type=state", "--env.episode_length=10")
DATA = ("--dataset.repo_id=local/clean", "--dataset.root=clean")
USER_FILE = """from lerobot_cqn.configuration_cqn import CQNConfig
config = CQNConfig(preset="laptop_state")
number: int = config.preset
"""
MISTAKE = 'user.py:3: error: Incompatible types in assignment (expression has type "str", variable has type "int")'


def commands(wheel: Path) -> list[str]:
    """The commands that the wheel installs."""
    with zipfile.ZipFile(wheel) as archive:
        (name,) = [name for name in archive.namelist() if name.endswith(".dist-info/entry_points.txt")]
        parser = configparser.ConfigParser()
        parser.read_string(archive.read(name).decode())
    return sorted(parser["console_scripts"])


def discovery(environment: Environment) -> str:
    """LeRobot finds policy, environments and arm from a foreign folder, and all packages are the installed ones."""
    script = (Path(__file__).parent / "inside/discovery.py").read_text(encoding="utf-8")
    said = environment.succeed("python", "-c", script)
    found = dict(line.split(" ", 1) for line in said.splitlines() if " " in line)
    lost = [name for name in ("policy", "env", "robot") if found.get(name) != "True"]
    strangers = [name for name in INSTALLED if not Path(found.get(name, "/")).is_relative_to(environment.place)]
    if lost or strangers:
        raise FailureError(f"not found by LeRobot: {lost}; not from the environment: {strangers}")
    return "policy, environments, arm"


def helps(environment: Environment, wheel: Path) -> str:
    """Every command of the wheel answers `--help`, with a line that begins with its name."""
    names = commands(wheel)
    for name in names:
        if f"{name} " not in environment.succeed(name, "--help"):
            raise FailureError(f"{name} --help shows no example")
    return ", ".join(names)


def types(environment: Environment) -> str:
    """Type information is shipped: mypy reports a deliberate mistake in a user's file, and nothing else."""
    (environment.user / "user.py").write_text(USER_FILE, encoding="utf-8")
    command = [
        sys.executable, "-m", "mypy", f"--python-executable={environment.python}", "--follow-imports=silent",
        f"--cache-dir={environment.folder / 'mypy'}", "user.py",
    ]  # fmt: skip
    done = subprocess.run(command, cwd=environment.user, capture_output=True, text=True, check=False, timeout=300)
    errors = [line for line in done.stdout.splitlines() if ": error:" in line]
    if len(errors) != 1 or not errors[0].startswith(MISTAKE):
        raise FailureError(f"mypy: expected one error about `number`, got {errors or done.stdout + done.stderr}")
    return "mypy finds the mistake"


def bare_policy(environment: Environment) -> str:
    """Without extras: a tiny policy, one update of the learner, saved, loaded with LeRobot's factory."""
    return environment.inside("policy.py", str(environment.user / "policy"))


def sim_smoke(environment: Environment) -> str:
    """With `[sim]`: record, recipe, lerobot-train, cqn-train, lerobot-eval."""
    named = ("--repo_id=local/demos", "--root=demos")
    environment.succeed(
        "cqn-data", "record", *STATION[:2], *named, "--episodes=2", "--pause_share=0.3", "--env.obs_type=state"
    )
    environment.succeed("cqn-data", "run", "simulation", *named, "--new_repo_id=local/clean", "--new_root=clean")
    environment.succeed(
        "lerobot-train", *TINY, *DATA, "--policy.push_to_hub=false", "--batch_size=4", "--num_workers=0", "--steps=3",
        "--wandb.enable=false", "--output_dir=offline",
    )  # fmt: skip
    environment.succeed(
        "cqn-train", *TINY, *STATION, *DATA, "--batch_size=4", "--demo_batch_size=4", "--offline_updates=5",
        "--steps=20", "--eval.freq=0", "--eval.final_n_episodes=1", "--threads=1", "--output_dir=online",
    )  # fmt: skip
    for run in ("offline", "online"):
        environment.succeed(
            "lerobot-eval", f"--policy.path={run}/checkpoints/last/pretrained_model", *STATION, "--eval.n_episodes=1",
            "--eval.batch_size=1", "--policy.device=cpu", f"--output_dir=evaluated_{run}",
        )  # fmt: skip
        if not (environment.user / f"evaluated_{run}/eval_info.json").exists():
            raise FailureError(f"lerobot-eval of the {run} checkpoint wrote no result")
    return "record, recipe, lerobot-train, cqn-train, lerobot-eval"
