"""``cqn-data inspect``: a look at a dataset before anything is trained on it. Nothing in it is changed.

``inspection`` has what it measures (numbers, follow, cameras), judges (checks) and draws (page, svg).
"""

import dataclasses
import itertools
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_cqn.errors import DataError, OutputExistsError
from lerobot_cqn.schema import STATE

from ..disk.folders import refuse_existing
from ..terminal.console import load_lerobot, note, progress, result, table
from ..terminal.options import REVISION, ROOT, help_page, option, parse

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..disk.source import Source
    from .cameras import CameraLook
    from .checks import Dataset
    from .finding import Finding
    from .history import History
    from .numbers import Numbers
    from .sequences import Sequences

__all__ = ["InspectConfig", "Inspection", "help", "inspect_dataset", "main"]

PAGE = "inspect.html"
MAX_ROWS = 40
EXAMPLE = """
cqn-data inspect --repo_id=local/click --root=data/click
cqn-data inspect --repo_id=local/click --root=data/click --json --strict > inspect.json
"""
NOTES = """
Findings are errors (training fails, or learns nothing from this), warnings (it suffers) and notes. Numbers are read of
every step, pictures of 30 steps a camera.
Exit code: 0, or 1 with --strict where there is an error, or 2 where there is no dataset to look at.
"""


@dataclasses.dataclass
class InspectConfig:
    """Settings of ``cqn-data inspect``."""

    repo_id: str = option(help="Dataset to look at, as user/name.")
    root: str | None = option(None, help=ROOT)
    revision: str | None = option(None, help=REVISION)
    html: str | None = option(
        None, help=f"Write the page to this file, which must not exist; by default {PAGE}, with --json none."
    )
    json: bool = option(False, help="Print one JSON object to stdout, and nothing else.")
    value_probe: bool = option(
        False, help="Also fit the return on one action and on several: which of CQN and CQN-AS suits; some seconds."
    )
    strict: bool = option(False, help="Exit with code 1 where there is an error.")

    @property
    def page(self) -> Path | None:
        """File of the page; None where none is written."""
        if self.html:
            return Path(self.html).expanduser()
        numbered = (Path(PAGE if n == 1 else f"{Path(PAGE).stem}_{n}.html") for n in itertools.count(1))
        return None if self.json else next(path for path in numbered if not path.exists())


@dataclasses.dataclass
class Inspection:
    """All that was measured and found. ``numbers`` and ``dataset`` are None where it could not be opened."""

    findings: "list[Finding]"
    dataset: "Dataset | None" = None
    numbers: "Numbers | None" = None
    cameras: "Sequence[CameraLook]" = ()
    history: "History | None" = None
    sequences: "Sequences | None" = None

    @property
    def ok(self) -> bool:
        """Without an error."""
        return not any(f.level == "error" for f in self.findings)


def help(summary: str) -> str:
    """Help page."""
    return help_page("cqn-data inspect", summary, InspectConfig, EXAMPLE, NOTES)


def main(args: list[str]) -> int:
    """Run from the command line and return the exit code.

    Raises:
        ConfigError: an unknown option.
        DataError: the dataset cannot be opened; with ``--strict`` the exit code is 1 instead.
        OutputExistsError: the page's file exists already.
    """
    config = parse(InspectConfig, args)
    load_lerobot()
    from ..disk.source import open_source
    from .finding import Finding

    page = config.page  # once: after it is written, the next free name is another one
    if page is not None:
        refuse_existing(page)
    try:
        source = open_source(config.repo_id, config.root, config.revision)
    except DataError as error:
        found = Inspection([Finding("error", "unreadable", "dataset", str(error))])
        if config.json:
            _print_json(config, found)
        if not config.strict:
            raise
        note(str(error))
        return 1
    inspection = inspect_dataset(config.repo_id, source, value_probe=config.value_probe)
    if page is not None:
        try:
            _write_page(page, inspection)
        except OSError as error:
            if isinstance(error, OutputExistsError) or config.html:  # asked for by name
                raise
            note(f"No page was written here ({error.strerror}); --html=FILE names another place.")
            page = None
    if config.json:
        _print_json(config, inspection)
    else:
        _show(inspection)
    if page is not None:
        (note if config.json else result)(f"Report: {page}")
    return int(config.strict and not inspection.ok)


def inspect_dataset(repo_id: str, source: "Source", *, value_probe: bool = False) -> Inspection:
    """Measure and judge; what is damaged becomes a finding, and the rest is looked at all the same.

    value_probe: compare action sequences, too.
    """
    import numpy as np

    from .cameras import look, missing_videos
    from .checks import Dataset, findings
    from .finding import by_level
    from .history import history_finding, history_of
    from .numbers import measure
    from .places import order, timing
    from .regression import courses
    from .sequences import sequence_finding, sequences_of
    from .statistics import statistics

    missing = missing_videos(source)
    with progress() as bar:
        line = bar.add_task("Reading numbers", total=2 * len(source.episodes))
        numbers = measure(source, lambda: bar.advance(line))
        spans = np.array([max(d.high - d.low, 0.0) for d in numbers.of(STATE)])

        def moves(index: int, first: int, last: int) -> bool:
            """Whether a joint goes through a tenth of its range."""
            if STATE not in source.features:
                return False
            state = np.asarray(source.episode(index).columns[STATE], np.float64).reshape(-1, len(spans))
            return bool((np.ptp(state[first : last + 1], axis=0) > 0.1 * spans).any())

        line = bar.add_task("Looking at pictures", total=len(source.cameras))
        cameras = look(source, numbers.episodes, moves, lambda: bar.advance(line))
        line = bar.add_task("Comparing histories", total=1)
        seen = courses(source, numbers)
        history = history_of(seen) if seen is not None else None
        bar.advance(line)
        sequences = sequences_of(seen) if value_probe and seen is not None else None
    if value_probe and sequences is None:
        note("Sequences cannot be compared: too few episodes of more than 16 steps, or all of one length.")
    try:
        deltas = source.deltas is not None
    except Exception:  # a damaged history is not what is inspected here
        deltas = False
    dataset = Dataset(repo_id, source.fps, list(source.features), len(source.episodes), deltas)
    found = [
        *findings(dataset, numbers, cameras, missing),
        *statistics(source, numbers),
        *order(source),
        *timing(source, numbers),
        *history_finding(history),
        *sequence_finding(sequences),
    ]
    return Inspection(sorted(found, key=by_level), dataset, numbers, cameras, history, sequences)


def _write_page(path: Path, inspection: Inspection) -> None:

    from .page import page

    if inspection.dataset is None or inspection.numbers is None:
        return
    probes = (inspection.history, inspection.sequences)
    text = page(inspection.dataset, inspection.numbers, inspection.cameras, inspection.findings, *probes)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError as error:
        raise OutputExistsError(f"{path} exists already and is left as it is; choose another file.") from error


def _show(inspection: Inspection) -> None:
    from .checks import PAPER_SIZE, memory
    from .page import overview, sentence_of_actions, size_text, verdict

    dataset, numbers = inspection.dataset, inspection.numbers
    if dataset is None or numbers is None:
        return
    result(f"{dataset.repo_id}: {overview(dataset, numbers, inspection.cameras)}")
    if numbers.episodes:
        _show_episodes(dataset, numbers)
    found = numbers.threshold
    if found is not None and found.steps:
        result(f"Threshold {found.threshold:g}: {found.reason}")
        result("Still steps at " + ", ".join(f"{a.threshold:g}: {a.share:.0%}" for a in found.alternatives))
    probes = [probe.sentence() for probe in (inspection.history, inspection.sequences) if probe is not None]
    for line in filter(None, [sentence_of_actions(numbers), *probes]):
        result(line)
    needed = memory(numbers, inspection.cameras)
    pictures = (
        f", pictures {size_text(needed.pictures)}, or {size_text(needed.pictures_84)} at {PAPER_SIZE} x {PAPER_SIZE}"
    )
    result(f"Replay: numbers {size_text(needed.vectors)}{pictures if inspection.cameras else ''}")
    for finding in inspection.findings:
        result(f"{finding.level:<8} {finding.where}: {finding.text}")
        if finding.advice:
            result(f"         {finding.advice}")
    result(verdict(inspection.findings))


def _show_episodes(dataset: "Dataset", numbers: "Numbers") -> None:
    def outcome(success: bool | None) -> str:
        return "" if success is None else "success" if success else "failure"

    rows = [
        [
            str(e.index),
            str(e.steps),
            f"{e.steps / dataset.fps:.1f} s",
            f"{e.still:.0%}",
            f"{e.still_start / dataset.fps:.1f} s",
            f"{e.still_end / dataset.fps:.1f} s",
            "" if e.gripper_events is None else str(e.gripper_events),
            outcome(e.success),
        ]
        for e in numbers.episodes[:MAX_ROWS]
    ]
    still = sum(e.still * e.steps for e in numbers.episodes) / numbers.steps
    total = ["total", str(numbers.steps), f"{numbers.steps / dataset.fps:.0f} s", f"{still:.0%}", "", "", "", ""]
    table(["episode", "steps", "length", "still", "at start", "at end", "gripper", "outcome"], rows, total)
    if len(numbers.episodes) > MAX_ROWS:
        note(f"{len(numbers.episodes) - MAX_ROWS} more episodes are in --json.")


def _print_json(config: InspectConfig, inspection: Inspection) -> None:
    text = json.dumps(as_json(config.repo_id, inspection), indent=2, allow_nan=False)
    sys.stdout.write(text + "\n")  # rich would take parts of it for markup or emoji


def as_json(repo_id: str, inspection: Inspection) -> dict[str, Any]:
    """Plain types; the shape is the same whatever was found, with None for what could not be measured."""
    from .checks import memory
    from .finding import LEVELS

    dataset, numbers, cameras = inspection.dataset, inspection.numbers, inspection.cameras
    report: dict[str, Any] = {
        "version": 1,
        "repo_id": repo_id,
        "ok": inspection.ok,
        "counts": {level: sum(f.level == level for f in inspection.findings) for level in LEVELS},
        "findings": [dataclasses.asdict(f) for f in inspection.findings],
        "dataset": None,
    }
    if dataset is None or numbers is None:
        return report
    found, follow = numbers.threshold, numbers.follow
    lag = follow.lag() if follow is not None and numbers.episodes else None
    return report | {
        "dataset": {"fps": dataset.fps, "episodes": dataset.episodes, "steps": numbers.steps, "tasks": numbers.tasks},
        "threshold": None
        if found is None
        else {
            "threshold": found.threshold,
            "reason": found.reason,
            "clear": found.clear,
            "share": _round(found.share),
            "unmoved": _round(found.unmoved),
            "alternatives": [{"threshold": a.threshold, "share": _round(a.share)} for a in found.alternatives],
            "log10_edges": [_round(e) for e in found.edges],
            "counts": found.counts.tolist(),
        },
        "actions": None
        if follow is None or not numbers.episodes
        else {
            "kind": follow.kind(),
            "lag_steps": lag[0] if lag else None,
            "lag_correlation": _round(lag[1]) if lag else None,
            "mean_gap": [_round(g) for g in follow.gap()],
        },
        "history": None
        if inspection.history is None
        else {
            "columns": list(inspection.history.columns),
            "advised_frames": inspection.history.advised(),
            "unexplained": [
                {
                    "frames": f,
                    "stride": s,
                    "mean": _round(inspection.history.mean(f, s)),
                    "each": [_round(float(v)) for v in shares],
                }
                for (f, s), shares in inspection.history.shares.items()
            ],
        },
        "sequences": None
        if inspection.sequences is None
        else {
            "advised_actions": inspection.sequences.advised,
            "told": inspection.sequences.told,
            "steps": inspection.sequences.steps,
            "unexplained": [
                {"actions": n, "share": _round(share)} for n, share in inspection.sequences.unexplained.items()
            ],
            "noise": {name: _round(share) for name, share in inspection.sequences.noise.items()},
        },
        "episodes": [
            {
                "episode": e.index,
                "steps": e.steps,
                "still": _round(e.still),
                "still_start": e.still_start,
                "still_end": e.still_end,
                "gripper_events": e.gripper_events,
                "jitter": _round(e.jitter),
                "first_reward": e.first_reward,
                "success": e.success,
            }
            for e in numbers.episodes
        ],
        "bad_episodes": [{"episode": i, "reason": reason} for i, reason in numbers.bad.items()],
        "dimensions": [
            {
                "column": d.column,
                "name": d.name,
                "gripper": d.gripper,
                "constant": d.constant,
                "low": _round(d.low),
                "percentile_1": _round(d.inner_low),
                "percentile_99": _round(d.inner_high),
                "high": _round(d.high),
            }
            for d in numbers.dimensions
            if numbers.episodes
        ],
        "jumps": [{k: _round(v) for k, v in dataclasses.asdict(j).items()} for j in numbers.jumps],
        "jump_count": numbers.jump_count,
        "cameras": [
            {
                "key": c.key,
                "height": c.height,
                "width": c.width,
                "looked": c.looked,
                "black": c.dark,
                "blank": c.flat,
                "frozen": c.frozen,
                "broken": c.broken,
            }
            for c in cameras
        ],
        "memory_bytes": dataclasses.asdict(memory(numbers, cameras)),
    }


def _round(value: Any) -> Any:
    return float(f"{float(value):.6g}") if isinstance(value, float) else value
