"""``cqn-data push``: a dataset and a card that tells its history, to the Hugging Face Hub."""

import dataclasses
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_cqn.errors import DataError

from ..terminal.console import load_lerobot, note, result
from ..terminal.options import help_page, option, parse
from .options import HubTarget

if TYPE_CHECKING:
    from .card import Facts, Labels
    from .client import Hub, Sent

__all__ = ["PushConfig", "help", "main"]

EXAMPLE = """
cqn-data push --repo_id=user/pick --root=data/pick_cqn --dry_run
cqn-data push --repo_id=user/pick --root=data/pick_cqn --private --tags='[ur5e, click]'
"""
NOTES = """
Log in first: hf auth login. The folder is never changed. One commit makes all files visible together, and a run that
broke off goes on where it was. README.md: what you wrote there stays; the part between two marks is written anew.
Files of data/, meta/ and videos/ on the Hub that the folder does not have are removed; the repository's history keeps
them. The tag of the format (v3.0), which LeRobot loads by default, moves along, but not with --branch.
"""
README = "README.md"


@dataclasses.dataclass(kw_only=True)
class PushConfig(HubTarget):
    """Settings of ``cqn-data push``."""

    root: str | None = option(None, help="Folder of the dataset; by default LeRobot's home and the repo_id.")


def help(summary: str) -> str:
    """Help page."""
    return help_page("cqn-data push", summary, PushConfig, EXAMPLE, NOTES)


def main(args: list[str]) -> None:
    """Run from the command line.

    Raises:
        ConfigError: an option is unknown or has a wrong form.
        DataError: the dataset is missing, damaged or not complete, or its README.md cannot be read.
        HubError: nobody is logged in, or the Hub refused or could not be reached.
        Interrupted: Ctrl-C while sending.
    """
    config = parse(PushConfig, args)
    config.validate()
    if not config.dry_run:
        from lerobot_cqn.hub_retry import refuse_to_start

        refuse_to_start()
    load_lerobot()
    from ..disk.source import open_source
    from .card import Labels, look, write_card
    from .report import megabytes, show_dry

    source = open_source(config.repo_id, config.root)
    source.check_videos()
    facts = look(source)
    branch = None if config.branch == "main" else config.branch
    labels = Labels(config.repo_id, config.license, tuple(config.tags), branch, config.private)
    files = _files(source.root)
    own = _own_card(source.root)
    _warn_of_folders(source.root)
    card = write_card(facts, labels, own)
    if config.dry_run:
        show_dry({**files, README: card.encode()}, card, config.repo_id)
        return
    from .client import Hub

    hub = Hub(config.repo_id, shlex.join(["cqn-data", "push", *args]), branch)
    hub.prepare(private=config.private)
    card = _merged_card(hub, facts, labels, own)
    hub.check_card(card)
    size = sum(path.stat().st_size for path in files.values())
    note(f"Sending {len(files)} files, {megabytes(size)}, and the card to {config.repo_id} ({hub.branch}).")
    episodes = f"{len(facts.lengths)} episodes, {sum(facts.lengths)} steps"
    sent = hub.send({**files, README: card.encode()}, config.message or f"cqn-data push: {episodes}")
    version = str(source.meta.info.codebase_version)
    sent.tagged = branch is None and hub.tag(version)
    _report(sent, config.repo_id, branch, version)


def _files(root: Path) -> "dict[str, Path]":
    """Path in the repository -> file: everything but the card, hidden files and pictures left over from recording."""
    found: dict[str, Path] = {}
    for path in sorted(root.rglob("*")):
        inside = path.relative_to(root)
        hidden = any(part.startswith(".") for part in inside.parts)
        if path.is_file() and not hidden and inside.parts[0] != "images" and str(inside) != README:
            found[inside.as_posix()] = path
    return found


def _own_card(root: Path) -> str | None:

    path = root / README
    if not path.is_file():
        return None
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path} cannot be read as UTF-8 text: {error}") from error


def _merged_card(hub: "Hub", facts: "Facts", labels: "Labels", own: str | None) -> str:
    """The card from what lies in the folder or else on the Hub; says what it does to a card of a person."""
    from .card import TOOL, write_card
    from .readme import Readme, start_mark

    there = hub.text(README)
    if own is None:
        if there is not None and start_mark(TOOL) not in there:
            note("The README.md on the Hub keeps its text; what the dataset is and its history are added below it.")
        try:
            return write_card(facts, labels, there)
        except DataError as error:
            raise DataError(f"On the Hub: {error} Mend it there, or put a README.md into the folder.") from error
    if start_mark(TOOL) not in own:
        note("README.md keeps its text; what the dataset is and its history are added below it, on the Hub only.")
    card = write_card(facts, labels, own)
    try:
        replaced = there is not None and Readme.read(there, TOOL).own_text != Readme.read(card, TOOL).own_text
    except DataError:  # it was not readable
        replaced = True
    if replaced:
        note("The README.md on the Hub is replaced by the folder's; its old text stays in the repository's history.")
    return card


def _warn_of_folders(root: Path) -> None:
    """Say when the history that goes along names folders of this machine."""
    from ..disk.target import HISTORY

    path = root / HISTORY
    if not path.is_file():
        return
    text = path.read_text(encoding="utf-8")
    named = [folder for folder in (str(root.resolve()), str(Path.home())) if len(folder) > 1 and folder in text]
    if named:
        note(f"{HISTORY} names a folder of this machine ({named[0]}), and goes to the Hub as it is.")


def _report(sent: "Sent", repo_id: str, branch: str | None, version: str) -> None:
    from .report import show_sent

    show_sent(sent, repo_id, "dataset")
    if branch is not None:
        result(f'Load it with LeRobotDataset("{repo_id}", revision="{branch}"). The tag {version} was left alone.')
    else:
        moved = f"The tag {version} names this state" + ("" if sent.tagged else " already")
        result(f'{moved}: LeRobotDataset("{repo_id}") loads it.')
    result(sent.url)
