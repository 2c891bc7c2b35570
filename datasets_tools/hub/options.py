"""Place and manner of a push: the options that pushing a dataset and pushing a policy share."""

import dataclasses
import re

from lerobot_cqn.errors import ConfigError

from ..terminal.options import option

__all__ = ["HubTarget", "check_repo_id"]

NAME = re.compile(r"[A-Za-z0-9](?:[\w.-]{0,94}[A-Za-z0-9])?", re.ASCII)
LICENSE = re.compile(r"[a-z0-9][a-z0-9.-]*")
BRANCH = re.compile(r"(?![/.-])(?!.*(?:\.\.|//|@\{))[\w./-]+(?<![/.])", re.ASCII)


@dataclasses.dataclass(kw_only=True)
class HubTarget:
    """A repository, and what its card and its commit are to say."""

    repo_id: str = option(help="Name on the Hub, as user/name.")
    private: bool = option(False, help="Make a new repository private; refused where it is there already and public.")
    license: str | None = option(None, help="Licence for the card; by default the card's own, else apache-2.0.")
    tags: list[str] = dataclasses.field(
        default_factory=list,
        metadata={"help": "Further tags for the card, e.g. '[ur5e, click]'."},
    )
    branch: str | None = option(None, help="Branch to push to, made where it is missing; by default main.")
    message: str | None = option(None, help="Message of the commit.")
    dry_run: bool = option(False, help="Show the card and what would be uploaded; needs neither network nor login.")

    def validate(self) -> None:
        """Check forms; raises ConfigError naming the option, what was expected and what was found."""
        check_repo_id(self.repo_id, "--repo_id")
        if self.license is not None and not LICENSE.fullmatch(self.license):
            raise ConfigError(f"Expected --license as on the Hub, e.g. apache-2.0 or cc-by-4.0, got '{self.license}'.")
        for tag in self.tags:
            if not tag.strip() or len(tag) > 100 or not tag.isprintable():
                raise ConfigError(f"Expected --tags of 1 to 100 printable characters each, got {tag!r}.")
        if self.branch is not None and not BRANCH.fullmatch(self.branch):
            raise ConfigError(f"Expected --branch as git allows it, e.g. filtered, got '{self.branch}'.")
        if self.message is not None and not self.message.strip():
            raise ConfigError("Expected --message with some text; leave it out for the usual one.")


def check_repo_id(repo_id: str, option_name: str) -> None:
    """Check of a name; raises ConfigError where the Hub would not take it. option_name: of who gave it."""
    parts = repo_id.split("/")
    if len(parts) != 2 or not all(NAME.fullmatch(p) and "--" not in p and ".." not in p for p in parts):
        raise ConfigError(
            f"Expected {option_name}=user/name of letters, digits, '-', '_' and '.' (not doubled, not at the ends), got"
            f" '{repo_id}'."
        )
