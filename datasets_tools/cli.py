"""Entry point of ``cqn-data``: finds the operation, turns errors into one line and an exit code.

Exit codes: 0 done, 1 unexpected failure or errors that inspect --strict found, 2 a mistake that can be mended by the
caller, 130 interrupted.
Nothing heavy is imported here, so that ``--help`` answers at once.
"""

import signal
import sys
import threading
from collections.abc import Sequence
from functools import partial
from types import FrameType

from lerobot_cqn.errors import ConfigError, one_of

from .operations.job import help_for, main_for
from .operations.registry import OPERATIONS, module_of, step_class
from .terminal.console import Interrupted, explain, note, quiet, result

__all__ = ["main"]


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
        raise ConfigError(one_of("operation", name, OPERATIONS))
    operation = OPERATIONS[name]
    if operation.step:
        step = step_class(name)
        show, run = partial(help_for, step), partial(main_for, step)
    else:
        module = module_of(name)
        show, run = module.help, module.main
    if "-h" in args or "--help" in args:
        result(show(operation.summary))
        return 0
    return run(args) or 0


def _overview() -> str:
    width = max(map(len, OPERATIONS))
    return "\n".join(
        [
            "cqn-data: prepare LeRobot datasets for CQN. Sources are never changed; nothing is overwritten.",
            "",
            "Usage: cqn-data OPERATION --name=value ...",
            "",
            *(f"  {name:<{width}}  {operation.summary}" for name, operation in OPERATIONS.items()),
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
