"""The options that send a result to the Hub, for all that write a dataset."""

import dataclasses
from pathlib import Path

from lerobot_cqn.errors import ConfigError

from ..hub.options import check_repo_id
from ..terminal.options import option

__all__ = ["Sharing"]


@dataclasses.dataclass(kw_only=True)
class Sharing:
    """Whether the result goes to the Hub."""

    push_to_hub: bool = option(False, help="Send the result to the Hub under its name, as cqn-data push does.")
    private: bool = option(False, help="Make its new repository private; with --push_to_hub.")

    def check(self, new_repo_id: str) -> None:
        """Make sure that the result can be sent, before work starts.

        Raises:
            ConfigError: a name that the Hub does not take, or --private without --push_to_hub.
            HubError: offline, or nobody is logged in.
        """
        if self.private and not self.push_to_hub:
            raise ConfigError("--private makes a repository on the Hub private: give it with --push_to_hub.")
        if self.push_to_hub:
            from lerobot_cqn.hub_retry import refuse_to_start

            check_repo_id(new_repo_id, "--new_repo_id")
            refuse_to_start()

    def share(self, repo_id: str, root: Path) -> None:
        """Send a dataset, where that was asked for; raises HubError whose message has the command that goes on."""
        if self.push_to_hub:
            from ..hub.push import main

            main([f"--repo_id={repo_id}", f"--root={root}", *(["--private"] if self.private else [])])
