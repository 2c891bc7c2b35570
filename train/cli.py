"""`cqn-train`: read the command line, build the run, train; errors become one line and an exit code."""

import logging
import os
import sys
import warnings
from collections.abc import Sequence

from lerobot.configs import parser
from lerobot.utils.import_utils import register_third_party_plugins

from cqn_data.terminal.console import explain
from lerobot_cqn.errors import CQNError

from . import envs  # noqa: F401  # registers our environments
from .arguments import introduction, parse
from .arm.devices import register_devices
from .config import RunConfig, ValidRun
from .run.blame import plugin_at_fault
from .run.progress import ConsoleMonitor
from .run.stop import StopRequest

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `cqn-train`; returns 0, 2 for an error of the user's, 130 after an interrupt."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in arguments
    arguments = [a for a in arguments if a != "--debug"]
    set_up_logging(debug)
    register_third_party_plugins()
    if not arguments or "-h" in arguments or "--help" in arguments:
        register_devices()
        print(introduction())  # noqa: T201
        parser.print_scoped_help(RunConfig, arguments)
        return 0
    try:
        return run(parse(arguments).validate(), arguments)
    except KeyboardInterrupt as error:  # of a push it says what is on the Hub
        print(f"cqn-train: {error or 'stopped at once; the last checkpoint is untouched.'}", file=sys.stderr)  # noqa: T201
        return 130
    except Exception as error:
        plugin = plugin_at_fault(error, parser.parse_plugin_args(parser.PLUGIN_DISCOVERY_SUFFIX, arguments).values())
        if not isinstance(error, CQNError) and plugin is not None and not debug:
            text = " ".join(str(error).split())[:300]
            print(  # noqa: T201
                f"cqn-train: error: the plugin '{plugin}' failed: {type(error).__name__}: {text} (--debug shows where)",
                file=sys.stderr,
            )
            return 1
        if isinstance(error, CQNError | OSError):
            return int(explain("cqn-train", error, debug=debug))
        raise


def run(valid: ValidRun, arguments: Sequence[str] = ()) -> int:
    """Train; 0 when complete, 130 when stopped on request with a checkpoint saved.

    arguments: of the command line, for those processes of the run that are not this one.
    """
    with ConsoleMonitor() as monitor, StopRequest() as should_stop:
        if valid.config.ray.actors:
            from .cluster.launch import launch

            return launch(valid, arguments, monitor, should_stop)
        from .execute import execute  # LeRobot's policies, datasets and simulators: seconds that --help need not take

        return execute(valid, monitor, should_stop)


def set_up_logging(debug: bool) -> None:
    """Our notices on stderr, and of the libraries below only errors (all they say with --debug).

    LeRobot warns of missing accelerators and decoders on every start; a person could not find our line in between.
    """
    root, ours = logging.getLogger(), logging.getLogger(__package__)
    root.setLevel(logging.DEBUG if debug else logging.ERROR)
    if debug:
        logging.basicConfig()
    else:
        warnings.simplefilter("ignore")
        os.environ.setdefault("HF_DATASETS_DISABLE_PROGRESS_BARS", "1")
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(message)s"))
    ours.handlers, ours.propagate = [handler], False
    ours.setLevel(logging.INFO)


if __name__ == "__main__":
    sys.exit(main())
