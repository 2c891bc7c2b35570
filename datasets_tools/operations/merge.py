"""``cqn-data merge``: several recordings of one arm as one dataset, after a look whether they belong together."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_cqn.errors import ConfigError, DataError
from lerobot_cqn.schema import ACTION, STATE, dimension_names

from ..disk.folders import local_root, new_folder, refuse_existing, refuse_inside
from ..terminal.console import load_lerobot, note, result, table
from ..terminal.options import help_page, option, parse
from .sharing import Sharing

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..disk.source import Source

__all__ = ["MergeConfig", "help", "main"]

EXAMPLE = """
cqn-data merge --repo_ids='[local/pick, local/pick_more]' --roots='[data/pick, data/pick_more]' \\
    --new_repo_id=local/all_picks --new_root=data/all_picks
"""
NOTES = """
Refused by name: other columns, names or sizes of pictures, rates or robots, actions that are differences in one and
goals in the other, and ranges that look like other units. Videos are copied as they are, by LeRobot's own merge.
"""
OTHER_UNITS = 10.0  # times the range: degrees are 57 radians, percent 100 shares


@dataclasses.dataclass
class MergeConfig(Sharing):
    """Settings of ``cqn-data merge``."""

    repo_ids: list[str] = dataclasses.field(
        default_factory=list, metadata={"help": "Datasets to put together, in this order, e.g. '[me/one, me/two]'."}
    )
    roots: list[str] = dataclasses.field(
        default_factory=list, metadata={"help": "Their folders; by default LeRobot's home and the names."}
    )
    new_repo_id: str = option("", help="Name of the new dataset, as user/name; needed.")
    new_root: str | None = option(
        None, help="Its folder, which must not exist; by default LeRobot's home and the name."
    )
    dry_run: bool = option(False, help="Only check whether they belong together.")

    def validate(self) -> None:
        """Check that there are several; raises ConfigError."""
        if len(self.repo_ids) < 2:
            raise ConfigError(f"Expected at least two datasets in --repo_ids, got {len(self.repo_ids)}.")
        if self.roots and len(self.roots) != len(self.repo_ids):
            raise ConfigError(f"Expected a folder in --roots for each of {len(self.repo_ids)}, got {len(self.roots)}.")
        if not self.new_repo_id:
            raise ConfigError("Missing --new_repo_id=…; --help shows an example.")
        self.check(self.new_repo_id)


def help(summary: str) -> str:
    """Help page."""
    return help_page("cqn-data merge", summary, MergeConfig, EXAMPLE, NOTES)


def main(args: list[str]) -> None:
    """Run from the command line.

    Raises:
        ConfigError: a bad option.
        DataError: a dataset is missing or damaged, or they do not belong together.
        OutputExistsError: the new folder exists already.
    """
    config = parse(MergeConfig, args)
    config.validate()
    root = local_root(config.new_repo_id, config.new_root)
    if not config.dry_run:
        refuse_existing(root)
    load_lerobot()
    from ..disk.source import open_source

    roots: Sequence[str | None] = config.roots or [None] * len(config.repo_ids)
    sources = [open_source(name, where) for name, where in zip(config.repo_ids, roots, strict=True)]
    for source in sources:
        refuse_inside(source.root, root)
    _check_together(sources)
    rows = [[s.meta.repo_id, str(len(s.episodes)), str(s.meta.total_frames)] for s in sources]
    total = [str(sum(int(row[i]) for row in rows)) for i in (1, 2)]
    table(["dataset", "episodes", "steps"], rows, ["total", *total])
    if config.dry_run:
        result("Dry run: nothing was written.")
        return
    _write(sources, config.new_repo_id, root)
    result(f"Wrote {config.new_repo_id} to {root}: {total[0]} episodes, {total[1]} steps; videos copied as they were.")
    config.share(config.new_repo_id, root)


def _check_together(sources: "Sequence[Source]") -> None:
    """Raise DataError for the first thing in which a dataset is not like the first one."""
    from ..disk.whole import refuse_damaged

    first = sources[0]
    if len({s.root.resolve() for s in sources}) < len(sources):
        raise DataError("A dataset is named twice; its episodes would be in the result twice.")
    for source in sources[1:]:
        for what, own, other in _facts(first, source):
            if own != other:
                raise DataError(f"{source.root}: expected {what} {own}, as of {first.root}, found {other}.")
        _check_units(first, source)
    for source in sources:
        refuse_damaged(source)


def _facts(first: "Source", other: "Source") -> list[tuple[str, Any, Any]]:
    """What must agree: its name, and how it is in both."""
    from lerobot_cqn.delta_actions import description, recorded_deltas

    def deltas(source: "Source") -> Any:
        found = source.deltas
        return "absolute" if found is None else description(found, source.features)

    def recorded(source: "Source") -> Any:
        return recorded_deltas(source.history()) or "goals"

    facts: list[tuple[str, Any, Any]] = [
        ("frames a second", first.fps, other.fps),
        ("the robot", first.meta.robot_type, other.meta.robot_type),
        ("actions that are", deltas(first), deltas(other)),
        ("actions recorded as", recorded(first), recorded(other)),
        ("the columns", ", ".join(sorted(first.features)), ", ".join(sorted(other.features))),
    ]
    for key in first.features.keys() & other.features.keys():
        mine, theirs = first.features[key], other.features[key]
        facts += [(f"'{key}' with {k}", mine[k], theirs[k]) for k in ("dtype", "shape")]
        facts.append((f"'{key}' with the names", mine.get("names"), theirs.get("names")))
    return facts


def _check_units(first: "Source", other: "Source") -> None:
    """Raise DataError where most dimensions have a range many times as large: degrees and radians, for example."""
    import numpy as np

    for key in (STATE, ACTION):
        if key not in first.features:
            continue
        spans = []
        for source in (first, other):
            values = np.concatenate([np.asarray(source.episode(i).columns[key], np.float64) for i in source.episodes])
            spans.append(np.ptp(values.reshape(len(values), -1), axis=0))
        moves = (spans[0] > 0) & (spans[1] > 0)
        far = moves & (
            np.abs(np.log(np.where(moves, spans[1] / np.where(moves, spans[0], 1), 1))) > np.log(OTHER_UNITS)
        )
        if moves.any() and far.sum() > moves.sum() / 2:
            place = int(np.flatnonzero(far)[0])
            name = dimension_names(first.features[key])[place]
            raise DataError(
                f"{other.root}: '{name}' of {key} spans {spans[1][place]:.3g}, in {first.root} {spans[0][place]:.3g},"
                " and so it is with most: these look like other units. Bring both to one unit first."
            )


def _write(sources: "Sequence[Source]", repo_id: str, root: Path) -> None:
    from lerobot.datasets.aggregate import aggregate_datasets

    from lerobot_cqn.delta_actions import current_description

    from ..disk.target import write_history

    names, roots = [s.meta.repo_id for s in sources], [s.root for s in sources]
    if any(source.bounds is not None for source in sources):
        note("Action bounds of the sources do not hold for the result; set them again with bounds.")
    with new_folder(root) as folder:
        aggregate_datasets(repo_ids=names, aggr_repo_id=repo_id, roots=roots, aggr_root=folder)
        parts = [
            {
                "source": s.meta.repo_id,
                "episodes": len(s.episodes),
                "steps": s.meta.total_frames,
                "history": s.history(),
            }
            for s in sources
        ]
        listed = " and ".join(f"{p['source']} ({p['episodes']} episodes)" for p in parts)
        entry = {"operation": "merge", "target": repo_id, "sources": parts, "told": f"Put together {listed}."}
        described = current_description(sources[0].history())
        write_history(folder, [entry | ({"deltas": described} if described else {})])
