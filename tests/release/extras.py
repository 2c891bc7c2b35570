"""What each extra is for, tried: a probe that needs its packages, and the line that names it where they are missing.

The extras are read from pyproject.toml; tests/contract/test_packaging.py compares them with the table PROBES.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from .build import SETTINGS
from .environments import Environment, FailureError
from .smoke import sim_smoke

EXTRAS: dict[str, list[str]] = SETTINGS["project"]["optional-dependencies"]

Probe = Callable[[Environment, Path], str]  # (environment, folder of small inputs) -> what was done, in a few words
Command = Callable[[Path], tuple[str, ...]]


@dataclass(frozen=True)
class Extra:
    """How an extra is tried.

    Attributes:
        works: uses what it is for; raises FailureError.
        missing: a command that must fail without it by one line that names it; None where nothing can.
        why_never: why nothing can, in a few words.
    """

    works: Probe
    missing: Command | None = None
    why_never: str = ""


def _script(name: str, *arguments: str) -> Probe:
    return lambda environment, inputs: environment.inside(name, *arguments)


def _missing_script(name: str, *arguments: str) -> Command:
    path = str(Path(__file__).parent / "inside" / name)
    return lambda inputs: ("python", "-P", path, *arguments)


def _record(kind: str, task: str) -> tuple[str, ...]:
    return (
        "cqn-data",
        "record",
        f"--env.type={kind}",
        f"--env.task={task}",
        "--repo_id=local/probe",
        f"--root={kind}",
        "--episodes=1",
    )


def _recording(kind: str, task: str) -> Extra:
    """An environment with a scripted operator: one demonstration."""

    def works(environment: Environment, inputs: Path) -> str:
        said = environment.succeed(*_record(kind, task), "--pause_share=0")
        if not (environment.user / kind / "meta/info.json").exists():
            raise FailureError(f"cqn-data record --env.type={kind} wrote no dataset")
        return next(line for line in said.splitlines() if line.startswith("Recorded")).split(" to ")[0]

    return Extra(works, lambda inputs: _record(kind, task))


def _stepping(kind: str, *task: str) -> Extra:
    """An environment without one: made by LeRobot's factory and stepped."""
    return Extra(_script("step.py", kind, *task), _missing_script("step.py", kind, *task))


def _curves(inputs: Path) -> tuple[str, ...]:
    named = ("--repo_id=local/toy", f"--root={inputs / 'toy'}", "--new_repo_id=local/out", "--new_root=out")
    return ("cqn-data", "filter", *named, "--threshold=0.01", "--dry_run", "--preview=curves.png")


def _draw(environment: Environment, inputs: Path) -> str:
    environment.succeed(*_curves(inputs))
    picture = environment.user / "curves.png"
    if not picture.read_bytes().startswith(b"\x89PNG"):
        raise FailureError("cqn-data filter --preview wrote no picture")
    return f"a figure of {picture.stat().st_size // 1024} KiB"


def _conversion(kind: str, inputs: Path) -> tuple[str, ...]:
    source = inputs / {"robomimic": "small.hdf5", "diffusion_policy": "small.zarr"}[kind]
    options = ("--new_repo_id=local/out", f"--new_root={kind}", "--video=false", "--fps=10")
    return ("cqn-data", "convert", f"--from={kind}", f"--input={source}", *options)


def _convert(environment: Environment, inputs: Path) -> str:
    for kind in ("robomimic", "diffusion_policy"):
        environment.succeed(*_conversion(kind, inputs))
        if not (environment.user / kind / "meta/info.json").exists():
            raise FailureError(f"cqn-data convert --from={kind} wrote no dataset")
    return "an HDF5 file and a Zarr store converted"


def _gyms(environment: Environment, inputs: Path) -> str:
    tried = [environment.inside("step.py", *kind) for kind in GYMS]
    return f"{len(tried)} kinds of environments made and stepped"


def _develop(environment: Environment, inputs: Path) -> str:
    """The checks of a clean checkout, with the tools of this environment; it imports the installed wheel."""
    source = str(inputs / "source")
    environment.succeed("ruff", "check", source)
    environment.succeed("mypy", f"--config-file={source}/pyproject.toml", f"{source}/lerobot_cqn", timeout=400)
    tests = [f"{source}/tests/unit/test_{name}.py" for name in ("discretisation", "distributional", "losses")]
    environment.succeed("python", "-m", "pytest", "-q", "-p", "no:cacheprovider", *tests, timeout=300)
    return f"ruff, mypy, pytest on {len(tests)} files of a clean checkout"


def _document(environment: Environment, inputs: Path) -> str:
    """The site of a clean checkout."""
    source = inputs / "source"
    environment.succeed(
        "sphinx-build", "-q", "-b", "html", "-c", str(source / "docs"), str(source), "site", timeout=400
    )
    pages = list((environment.user / "site").rglob("*.html"))
    if not pages:
        raise FailureError("sphinx-build wrote no page")
    return f"a site of {len(pages)} pages"


GYMS = (
    ("ur5e_station", "click_button"), ("metaworld_sparse", "drawer-open"), ("hil_sim", "pick_cube"),
    ("dmc", "cartpole-swingup"), ("pusht_small",), ("aloha_small", "transfer_cube"), ("so101_sim", "pick_place"),
)  # fmt: skip

PROBES: dict[str, Extra] = {
    "sim": Extra(
        lambda environment, inputs: sim_smoke(environment), lambda inputs: _record("ur5e_station", "click_button")
    ),
    "report": Extra(_draw, _curves),
    "wandb": Extra(_script("weights_and_biases.py"), None, "LeRobot's extra `training` brings it"),
    "tensorboard": Extra(_script("tensorboard.py"), _missing_script("tensorboard.py")),
    "metaworld": _recording("metaworld_sparse", "drawer-open"),
    "hil": _recording("hil_sim", "pick_cube"),
    "pusht": _stepping("pusht_small"),
    "aloha": _stepping("aloha_small", "transfer_cube"),
    "dmc": _stepping("dmc", "cartpole-swingup"),
    "so101": _recording("so101_sim", "pick_place"),
    "virtual": Extra(_script("virtual.py"), lambda inputs: ("cqn-virtual-so101", "--task=press_button")),
    "gyms": Extra(_gyms, None, "each environment names its own extra"),
    "bench": Extra(_script("bench.py"), _missing_script("bench.py")),
    "ray": Extra(_script("ray_actor.py"), _missing_script("ray_actor.py")),
    "page": Extra(_script("page.py"), _missing_script("page.py")),
    "convert": Extra(_convert, lambda inputs: _conversion("robomimic", inputs)),
    "dev": Extra(_develop, None, "tools only"),
    "docs": Extra(_document, None, "tools only"),
}


def missing_line(environment: Environment, inputs: Path, name: str) -> str:
    """The line by which the command without the extra says what to install; raises FailureError for any other."""
    command = PROBES[name].missing
    if command is None:
        return f"no such line: {PROBES[name].why_never}"
    done = environment.run(*command(inputs))
    if not done.code:
        raise FailureError(f"works without the extra `{name}`")
    if "Traceback" in done.said or f"lerobot_policy_cqn[{name}]" not in done.last_line:
        raise FailureError(f"without the extra `{name}` it ends with: {done.last_line}")
    return "named in one line"
