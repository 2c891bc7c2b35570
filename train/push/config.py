"""Settings of `cqn-push`."""

from dataclasses import dataclass

from cqn_data.hub.options import HubTarget, check_repo_id
from cqn_data.terminal.options import option
from lerobot_cqn.errors import ConfigError

__all__ = ["TOOL", "PushConfig"]

TOOL = "cqn-push"


@dataclass(kw_only=True)
class PushConfig(HubTarget):
    """Settings of `cqn-push`."""

    run: str = option(help="Folder of a run of cqn-train or lerobot-train, or a `pretrained_model` folder.")
    checkpoint: str = option("last", help="Which checkpoint of the run, by its step.")
    dataset: str | None = option(None, help="Name of the demonstrations on the Hub, where it is not that of the run.")
    films: int = option(3, help="At most so many films of its last evaluation.")

    def validate(self) -> None:
        """Check forms; raises ConfigError naming the option, what was expected and what was found."""
        super().validate()
        if self.films < 0:
            raise ConfigError(f"Expected --films of at least 0, got {self.films}.")
        if self.dataset is not None:
            check_repo_id(self.dataset, "--dataset")
