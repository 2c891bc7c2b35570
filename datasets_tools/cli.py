"""Entry point of ``cqn-data``: finds the operation, turns errors into one line and an exit code.

Exit codes: 0 done, 1 unexpected failure or errors that inspect --strict found, 2 a mistake that can be mended by the
caller, 130 interrupted.
Nothing heavy is imported here, so that ``--help`` answers at once.
"""

import importlib
import signal
import sys
import threading
from collections.abc import Sequence
from types import FrameType, ModuleType

from .terminal.console import Interrupted, explain, note, quiet, result

__all__ = ["OPERATIONS", "main", "module_of"]

# Operation -> one line for --help. Its module offers help() and main(args); an int that main returns is the exit code.
OPERATIONS = {
    "convert": "turn RLBench, robomimic, ALOHA, diffusion_policy, NPZ or LeRobot v2.1 data into a LeRobotDataset v3",
    "inspect": "look at a dataset before training: pauses, cameras, outliers, what is missing",
    "record": "record scripted demonstrations in an environment, as teleoperation would",
    "filter": "leave out the time steps in which nothing moves",
    "trim": "cut heads and tails of episodes",
    "delta": "turn absolute joint actions into delta joint actions, or back",
    "resample": "take fewer steps a second",
    "resize": "scale the pictures, and cut them out first where asked",
    "label": "write sparse rewards: 1 on the last step of successful episodes",
    "bounds": "set the action bounds that training scales by",
    "drop": "leave out whole episodes, by number or by rule",
    "run": "run several of these as one pass over the videos, from a recipe",
    "push": "upload a dataset to the Hugging Face Hub, with a card that tells how it came about",
}

MODULES = {
    "convert": "formats.convert",
    "inspect": "inspection.inspect",
    "record": "record",
    "run": "operations.recipe",
    "push": "hub.push",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``cqn-data OPERATION --name=value ...`` and return the exit code; ``--debug`` shows tracebacks.

    Args:
        argv: arguments after the program name; those of the process by default.
    """
    args = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in args
    args = [a for a in args if a != "--debug"]
    if not args or args[0] in ("-h", "--help", "help"):
        result(_overview())
        return 0
    name, rest = args[0], args[1:]
    if not debug:
        quiet()
    main_thread = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGTERM, _terminate) if main_thread else None
    try:
        return _run(name, rest)
    except KeyboardInterrupt as error:
        note(str(error) if isinstance(error, Interrupted) else "Interrupted: nothing was written.")
        return 130
    except Exception as error:
        return explain(f"cqn-data {name}", error, debug=debug)
    finally:
        if main_thread:
            signal.signal(signal.SIGTERM, before)


def _run(name: str, args: list[str]) -> int:
    if name not in OPERATIONS:
        from lerobot_cqn.errors import ConfigError, one_of

        raise ConfigError(one_of("operation", name, OPERATIONS))
    module = module_of(name)
    if "-h" in args or "--help" in args:
        result(module.help())
        return 0
    code = module.main(args)
    return code if isinstance(code, int) else 0


def module_of(name: str) -> ModuleType:
    """The module of an operation."""
    return importlib.import_module(f".{MODULES.get(name, f'operations.{name}')}", __package__)


def _overview() -> str:
    width = max(map(len, OPERATIONS))
    return "\n".join(
        [
            "cqn-data: prepare LeRobot datasets for CQN. Sources are never changed; nothing is overwritten.",
            "",
            "Usage: cqn-data OPERATION --name=value ...",
            "",
            *(f"  {name:<{width}}  {text}" for name, text in OPERATIONS.items()),
            "",
            "Example:",
            "  cqn-data filter --repo_id=local/click --root=data/click --dry_run=true",
            "",
            "cqn-data OPERATION --help explains its options.",
        ]
    )


def _terminate(signum: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
