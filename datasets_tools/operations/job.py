"""One run over a dataset: open it, let each operation look at it, then write what is left of it once.

The only place where operations, source and target meet; ``cqn-data OPERATION`` is a job of one step.
"""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from lerobot_cqn.delta_actions import KINDS
from lerobot_cqn.errors import ConfigError, one_of

from ..disk.folders import local_root, refuse_existing, refuse_inside
from ..terminal.console import load_lerobot, note, progress, result
from ..terminal.options import REVISION, ROOT, help_page, option, parse_all
from .sharing import Sharing

if TYPE_CHECKING:
    from ..views.view import DerivedView, View

__all__ = ["Job", "Step", "help_for", "main_for", "run_job", "settings_of"]


@dataclasses.dataclass
class Job(Sharing):
    """Places to read and write; the same for every operation, named as in ``lerobot-edit-dataset``."""

    repo_id: str = option(help="Dataset to read, as user/name.")
    root: str | None = option(None, help=ROOT)
    revision: str | None = option(None, help=REVISION)
    new_repo_id: str | None = option(None, help="Name of the new dataset; by default the old one and the operation.")
    new_root: str | None = option(
        None, help="Its folder, which must not exist; by default LeRobot's home and the name."
    )
    dry_run: bool = option(False, help="Only show what would be done; needs no videos.")
    report: str | None = option(None, help="Write the report as JSON to this file.")
    skip_bad_episodes: bool = option(
        False, help="Leave out episodes that cannot be read, instead of stopping; each is named."
    )
    crf: int | None = option(
        None,
        help="Quality where videos are encoded anew, as the codec counts it: lower is better; by default as it was.",
    )
    actions: str = option(
        "auto",
        help="What the actions are where the dataset's own history does not say: absolute, or deltas of one kind "
        "(command, command_steps, state; see delta --help). auto: as the history says, else absolute.",
    )

    def validate(self) -> None:
        """Check choices; raises ConfigError naming the option and the valid values."""
        if self.crf is not None and not 0 <= self.crf <= 63:
            raise ConfigError(f"Expected --crf in [0, 63], got {self.crf}.")
        if self.actions not in (valid := ("auto", "absolute", *KINDS)):
            raise ConfigError(one_of("--actions", self.actions, valid))


class Step:
    """An operation with its settings: a dataclass whose fields are options."""

    name: ClassVar[str]
    example: ClassVar[str]
    notes: ClassVar[str] = ""

    def validate(self) -> None:
        """Check ranges; raises ConfigError naming the option, what was expected and what was found."""

    def suffix(self) -> str:
        """What the result is called after the source's name, where no name is given."""
        return self.name

    def reads_numbers(self) -> bool:
        """Whether states, actions and rewards decide what is done: then all of them must be finite before."""
        return True

    def on(self, view: "View") -> "DerivedView":
        """Look at all episodes, print what will be done, and return the view after this operation.

        Raises:
            ConfigError: a setting that does not fit this dataset.
            DataError: data with which the operation cannot be done.
        """
        raise NotImplementedError

    @staticmethod
    def told(entry: Mapping[str, Any]) -> str:
        """A sentence for people that says what was done, from the operation's own entry of the history; "" for none."""
        return ""


def main_for(step_class: type[Step], args: Sequence[str]) -> None:
    """Run one operation from its command line; errors as in :func:`run_job`."""
    job, step = parse_all((Job, step_class), args)
    run_job(job, [step])


def help_for(step_class: type[Step], summary: str) -> str:
    """Help page of an operation that its summary describes in one line."""
    s = step_class
    return help_page(f"cqn-data {s.name}", summary, (s, Job), s.example, s.notes)


def settings_of(step: Step) -> dict[str, Any]:
    """Settings for the history, without those that were left at None or empty."""
    settings = dataclasses.asdict(step)  # type: ignore[call-overload]
    return {k: v for k, v in settings.items() if v is not None and v not in ([], {}, "")}


def run_job(job: Job, steps: Sequence[Step], name: str | None = None) -> list[dict[str, Any]]:
    """Run operations in order, as one pass over the pictures.

    Args:
        job: where to read and write.
        steps: at least one operation.
        name: suffix of the new dataset's name where none is given; by default that of the only step.

    Returns:
        the history entries of this run, one for each step.

    Raises:
        ConfigError: a setting out of range or one that does not fit the dataset.
        DataError: the source is missing or damaged, or an operation cannot be done with it.
        OutputExistsError: the new folder or the report file exists already.
    """
    job.validate()
    for step in steps:
        step.validate()
    load_lerobot()
    from ..disk.columns import refuse_infinite
    from ..disk.encode import write
    from ..disk.readable import readable
    from ..disk.source import open_source

    new_repo_id = job.new_repo_id or f"{job.repo_id}_{name or steps[0].suffix()}"
    job.check(new_repo_id)
    new_root = local_root(new_repo_id, job.new_root)
    if not job.dry_run:
        refuse_existing(new_root)
        refuse_inside(local_root(job.repo_id, job.root), new_root)
    if job.report:
        refuse_existing(Path(job.report))
    source = open_source(job.repo_id, job.root, job.revision)
    before = len(source.history())
    view = readable(source, job.actions, skip_bad_episodes=job.skip_bad_episodes, needs_videos=not job.dry_run)
    for step in steps:
        if len(steps) > 1:
            result(f"[{step.name}]")
        if step.reads_numbers():
            for index in view.episodes:
                refuse_infinite(view.episode(index))
        view = step.on(view)
        view.entry.update({"operation": step.name, "source": job.repo_id, "target": new_repo_id})
        if sentence := step.told(view.entry):
            view.entry["told"] = sentence
    for index in view.episodes:
        refuse_infinite(view.episode(index))
    _check_bounds(steps, view, source.bounds is not None)
    entries = view.history()[before:]
    if job.report:
        Path(job.report).write_text(json.dumps(entries, indent=2) + "\n")
    if job.dry_run:
        result("Dry run: nothing was written.")
        return entries
    with progress() as bar:
        written = write(view, source, new_repo_id, new_root, bar, skip=job.skip_bad_episodes, crf=job.crf)
    for episode, reason in written.skipped.items():
        note(f"Left out episode {episode}: {reason}")
    how = "videos copied as they were" if written.copied else "videos encoded anew" if source.meta.video_keys else ""
    result(
        f"Wrote {new_repo_id} to {new_root}: {written.episodes} episodes, {written.frames} steps"
        + (how and f"; {how}.")
    )
    job.share(new_repo_id, new_root)
    return view.history()[before:]


def _check_bounds(steps: Sequence[Step], view: "View", had_bounds: bool) -> None:

    names = [step.name for step in steps]
    if "bounds" in names and view.bounds is None:
        after = ", ".join(names[names.index("bounds") + 1 :])
        raise ConfigError(f"bounds must come after the steps that change actions; here these follow it: {after}.")
    if had_bounds and view.bounds is None:
        note("The source's action bounds do not hold for the result; set them again with bounds.")
