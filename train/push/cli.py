"""`cqn-push`: a run's policy to the Hugging Face Hub, with a card that says what it is and how good it is."""

import sys
from collections.abc import Sequence

from cqn_data.terminal.console import Interrupted, explain, note, quiet, result
from cqn_data.terminal.options import help_page, parse

from .config import TOOL, PushConfig

__all__ = ["main"]

SUMMARY = "upload a run's policy to the Hugging Face Hub, with a card that says what it is and how good it is"
EXAMPLE = """
cqn-push --run=outputs/click --repo_id=user/click --dry_run
cqn-push --run=outputs/click --repo_id=user/click --private --tags='[ur5e]'
"""
NOTES = """
Log in first: hf auth login. Sent are the weights for inference, the processors, the settings without folders of this
machine, the run's tables, its learning curve, films of its last evaluation and the card of its dataset; never the
optimiser or the replay buffer. The run is never changed. One commit makes all files visible together, and a push that
broke off goes on where it was. README.md on the Hub: what you wrote there stays; the part between two marks is written
anew. Load it with --policy.path=user/name in lerobot-eval, lerobot-rollout and cqn-train.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `cqn-push`; returns 0, 1 for an unexpected failure, 2 for an error of the user's, 130 after an interrupt."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in arguments
    arguments = [a for a in arguments if a != "--debug"]
    if not arguments or "-h" in arguments or "--help" in arguments:
        result(help_page(TOOL, SUMMARY, PushConfig, EXAMPLE, NOTES))
        return 0
    if not debug:
        quiet()
    try:
        config = parse(PushConfig, arguments)
        from .send import push  # what it needs of LeRobot takes seconds

        push(config)
        return 0
    except KeyboardInterrupt as error:
        note(str(error) if isinstance(error, Interrupted) else "Interrupted: nothing was sent.")
        return 130
    except Exception as error:
        return int(explain(TOOL, error, debug=debug))


if __name__ == "__main__":
    sys.exit(main())
