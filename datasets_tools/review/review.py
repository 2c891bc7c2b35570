"""``cqn-data review``: a page on this machine on which a person cuts, labels, names and drops episodes by looking."""

import dataclasses
import threading
import time
from pathlib import Path

from lerobot_cqn.errors import ConfigError

from ..terminal.console import load_lerobot, note, result
from ..terminal.options import REVISION, ROOT, help_page, option, parse

__all__ = ["ReviewConfig", "help", "main"]

EXAMPLE = """
cqn-data review --repo_id=local/click --root=data/click
cqn-data run click.yaml --repo_id=local/click --root=data/click --new_root=data/click_reviewed
"""
NOTES = """
The page shows films with the joints under them, and which steps go at which pause threshold. What you decide is kept in
FILE.yaml, a recipe, and FILE.json, from which the same command goes on; the dataset itself is never changed. The page
or `cqn-data run FILE.yaml` carries it out. Needs the extra: pip install 'lerobot_policy_cqn[page]'.
Keys: Space plays, S success, F failure, D drop, N next, P previous, [ and ] begin and end here, arrows step, U undo.
"""


@dataclasses.dataclass
class ReviewConfig:
    """Settings of ``cqn-data review``."""

    repo_id: str = option(help="Dataset to look at, as user/name.")
    root: str | None = option(None, help=ROOT)
    revision: str | None = option(None, help=REVISION)
    recipe: str | None = option(None, help="File for what you decide; by default the dataset's name and .yaml.")
    host: str = option("127.0.0.1", help="Address to listen on; 0.0.0.0 lets other machines reach the page.")
    port: int = option(0, help="Port of the page; 0 takes any free one.")
    token: str | None = option(None, help="What a visitor must bring, at least 8 characters; by default a new one.")

    def validate(self) -> None:
        """Check the file's name; raises ConfigError."""
        if not self.file.name.endswith((".yaml", ".yml")):
            raise ConfigError(f"Expected --recipe=FILE.yaml, got '{self.recipe}'.")
        if not self.file.parent.is_dir():
            raise ConfigError(f"--recipe={self.recipe}: there is no folder {self.file.parent}; make it first.")

    @property
    def file(self) -> Path:
        """File of the recipe."""
        return Path(self.recipe or f"{self.repo_id.rpartition('/')[2]}.yaml").expanduser()


def help(summary: str) -> str:
    """Help page."""
    return help_page("cqn-data review", summary, ReviewConfig, EXAMPLE, NOTES)


def main(args: list[str]) -> None:
    """Serve the page until Ctrl-C.

    Raises:
        ConfigError: a bad option, a port in use, the extra missing, or decisions about another dataset.
        DataError: the dataset cannot be read.
    """
    from ..web.routes import need_extra
    from ..web.server import PageServer

    config = parse(ReviewConfig, args)
    config.validate()
    need_extra("The review page")
    load_lerobot()
    from ..disk.source import open_source
    from .app import Review, make_app
    from .decided import Desk
    from .recording import Recording

    recording = Recording(open_source(config.repo_id, config.root, config.revision))
    found = recording.suggestion
    start = float(f"{found.threshold:.4g}") if found is not None and found.clear else None
    desk = Desk(config.file, config.repo_id, recording.lengths, recording.recorded, start)
    review = Review(recording, desk, config.repo_id, config.root, config.revision)
    server = PageServer(
        lambda token: make_app(review, token, config.host), "review page", config.host, config.port, config.token
    )
    missing = recording.missing_films()
    if missing:
        note(f"{len(missing)} video files are missing, the first: {missing[0]}.")
    with server:
        result(f"Review page: {server.url}")
        note(f"Decisions: {desk.recipe} and {desk.file.name}. Ctrl-C ends it; the same command goes on.")
        try:
            while threading.main_thread().is_alive():
                time.sleep(1.0)
        except KeyboardInterrupt:
            note(f"Ended. Decisions are in {desk.recipe}.")
        finally:
            review.errand.stop()
