"""``cqn-data convert``: other formats as a LeRobotDataset v3.

Each format is one file in ``formats``. Every episode's numbers are read and checked before anything is written;
pictures are read one at a time while writing.
"""

import dataclasses
import importlib
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_cqn.errors import ConfigError, DataError, one_of

from ..disk.folders import local_root, refuse_existing, refuse_inside
from ..terminal.console import load_lerobot, note, progress, result, table
from ..terminal.options import help_page, option, parse

if TYPE_CHECKING:
    from .common import Episode, Reader

__all__ = ["FORMATS", "ConvertConfig", "convert_dataset", "help", "main"]

LEROBOT_V21 = "lerobot_v21"
# Format -> one line for --help. Each lives in the module of its name in `formats`.
FORMATS = {
    "rlbench": "folders variationN/episodes/episodeN with low_dim_obs.pkl and PNG pictures; 20 fps",
    "robomimic": "one HDF5 file with data/demo_N/{actions,obs,rewards,dones}",
    "aloha": "episode_N.hdf5 files as ACT reads them, pictures raw or JPEG; 50 fps",
    "diffusion_policy": "replay_buffer.zarr, folder or .zarr.zip; needs --fps",
    "npz": "episodes as NumPy archives with LeRobot's column names; needs --fps or an array fps",
    LEROBOT_V21: "a LeRobot dataset of format v2.1, by LeRobot's own converter",
}
EXAMPLE = """
cqn-data convert --from=rlbench --input=rlbench_data/open_drawer \\
    --new_repo_id=local/open_drawer --new_root=data/open_drawer --dry_run=true
cqn-data convert --from=robomimic --input=lift/image.hdf5 --new_repo_id=local/lift --new_root=data/lift
"""
SMALLEST_VIDEO = 32  # pixels; LeRobot's default encoder ends the whole process on pictures much smaller
CHOICE_OF_ACTIONS = ("robomimic", "aloha", "diffusion_policy")
SHARED = ("from_", "input", "new_repo_id", "new_root", "dry_run")  # options that every format knows


@dataclasses.dataclass
class ConvertConfig:
    """Settings of ``cqn-data convert``."""

    from_: str = option(help=f"Format of the input: {', '.join(FORMATS)}.")
    input: str = option(help="File or folder to read; it is never changed.")
    new_repo_id: str = option(help="Name of the new dataset, as user/name.")
    new_root: str | None = option(
        None, help="Its folder, which must not exist; by default LeRobot's home and the name."
    )
    fps: int | None = option(None, help="Frames per second; by default what the input says. Nothing is resampled.")
    task: str | None = option(None, help="Sentence for every episode; by default the input's own, else its name.")
    image_keys: list[str] = dataclasses.field(
        default_factory=list,
        metadata={"help": "Cameras to take, by their name in the input, e.g. '[front_rgb]'; '[none]' for no pictures."},
    )
    state_keys: list[str] = dataclasses.field(
        default_factory=list,
        metadata={"help": "What observation.state is put together from, in this order, e.g. '[qpos, qvel]'."},
    )
    action_keys: list[str] = dataclasses.field(
        default_factory=list,
        metadata={
            "help": "What action is put together from, e.g. '[actions_abs]'; of robomimic, aloha, diffusion_policy."
        },
    )
    rewards: bool = option(True, help="Keep rewards, ends and successes where the input has them.")
    video: bool = option(True, help="Store pictures as video; false stores every picture without loss.")
    swap_colors: bool = option(False, help="Exchange red and blue, e.g. where OpenCV wrote JPEGs from RGB arrays.")
    skip_bad_episodes: bool = option(False, help="Leave out episodes that are damaged, and say why.")
    dry_run: bool = option(False, help="Read and check all numbers, show what would be written, write nothing.")

    def validate(self) -> None:
        """Check names and ranges; raises ConfigError naming the option, and what is valid."""
        if self.from_ not in FORMATS:
            raise ConfigError(one_of("--from", self.from_, FORMATS))
        if self.fps is not None and self.fps < 1:
            raise ConfigError(f"Expected --fps >= 1, got {self.fps}.")
        if self.task is not None and not self.task.strip():
            raise ConfigError("Expected a sentence in --task, got an empty one.")
        if self.action_keys and self.from_ not in CHOICE_OF_ACTIONS:
            raise ConfigError(
                f"--action_keys chooses among the arrays of {', '.join(CHOICE_OF_ACTIONS)}; --from={self.from_} has one"
                " action: leave it out."
            )
        if self.from_ == LEROBOT_V21:
            changed = [f.name for f in dataclasses.fields(self) if f.name not in SHARED and not _is_default(self, f)]
            if changed:
                raise ConfigError(f"--from={LEROBOT_V21} keeps the data as it is: leave out --{', --'.join(changed)}.")


@dataclasses.dataclass
class _Plan:
    """An episode that was found good."""

    index: int
    name: str
    steps: int
    task: str
    facts: dict[str, int]


class _Skipped(list[tuple[str, str]]):
    """Names of the episodes that are left out, and why."""

    def add(self, config: ConvertConfig, name: str, error: Exception) -> None:
        """Note one, or raise the error when damage is not to be passed over."""
        if not config.skip_bad_episodes:
            raise error
        self.append((name, str(error)))
        note(f"Skipped {name}: {error}")


def help(summary: str) -> str:
    """Help page."""
    lines = [f"  {name:<17} {text}" for name, text in FORMATS.items()]
    formats = "\n".join(["Formats:", *lines, "More on each: docs/datasets.md."])
    page = help_page("cqn-data convert", summary, ConvertConfig, EXAMPLE, formats)
    return page.replace("--from_", "--from")


def main(args: list[str]) -> None:
    """Run from the command line; errors as in :func:`convert_dataset`."""
    try:
        config = parse(ConvertConfig, [_python_name(a) for a in args])
    except ConfigError as error:
        raise ConfigError(str(error).replace("--from_", "--from")) from error
    convert_dataset(config)


def convert_dataset(config: ConvertConfig) -> None:
    """Convert and report.

    Raises:
        ConfigError: an unknown format or key, a missing package, or no frame rate anywhere.
        DataError: the input is missing, empty, or damaged; names the file, the episode and the frame.
        OutputExistsError: the new folder exists already.
    """
    config.validate()
    source = Path(config.input).expanduser()
    if not source.exists():
        raise DataError(f"Nothing found at --input={config.input}; expected a file or folder.")
    load_lerobot()

    root = local_root(config.new_repo_id, config.new_root)
    if not config.dry_run:
        refuse_existing(root)
        refuse_inside(source, root)
    if config.from_ == LEROBOT_V21:
        _convert_lerobot(config, source, root)
    else:
        with _open_reader(config, source) as reader:
            _convert(config, reader, source, root)
    result("Dry run: nothing was written." if config.dry_run else f"Wrote {config.new_repo_id} to {root}")


def _open_reader(config: ConvertConfig, source: Path) -> "AbstractContextManager[Reader]":
    from .common import Request

    request = Request(
        input=source,
        fps=config.fps,
        task=config.task,
        image_keys=tuple(config.image_keys),
        state_keys=tuple(config.state_keys),
        action_keys=tuple(config.action_keys),
        rewards=config.rewards,
    )
    module = importlib.import_module(f".{config.from_}", __package__)
    opened: AbstractContextManager[Reader] = module.open_reader(request)
    return opened


def _convert(config: ConvertConfig, reader: "Reader", source: Path, root: Path) -> None:
    skipped = _Skipped()
    for sentence in reader.notes:
        note(sentence)
    plans, features = _plan(config, reader, skipped)
    _show(reader, plans, features)
    if config.dry_run:
        return
    _write(config, reader, plans, features, skipped, source, root)


def _plan(config: ConvertConfig, reader: "Reader", skipped: _Skipped) -> tuple[list[_Plan], dict[str, dict[str, Any]]]:
    """Plans of the good episodes, after a look at all numbers and first pictures; the first one tells the features.

    Raises:
        DataError: a damaged episode, or one of other columns than the first; with ``skip_bad_episodes`` only when
            nothing is left.
    """
    plans: list[_Plan] = []
    features: dict[str, dict[str, Any]] = {}
    with progress() as bar:
        for index, name in enumerate(bar.track(reader.episodes, description="Checking episodes")):
            try:
                with reader.episode(name) as episode:
                    episode.check()
                    found = _features(config, episode)
                    _compare(episode, found, features or found)
                    plans.append(_Plan(index, name, len(episode), episode.task, episode.facts))
            except DataError as error:
                skipped.add(config, name, error)
                continue
            features = features or found
    if not plans:
        raise DataError(f"No episode of {config.input} can be read; the first: {skipped[0][1]}")
    return plans, features


def _features(config: ConvertConfig, episode: "Episode") -> dict[str, dict[str, Any]]:
    """LeRobot features of one episode, without the columns that say where a step is from.

    Raises:
        ConfigError: pictures too small for video.
        DataError: the first pictures cannot be read.
    """
    features: dict[str, dict[str, Any]] = {
        key: {"dtype": str(values.dtype), "shape": values.shape[1:], "names": episode.names.get(key)}
        for key, values in episode.columns.items()
    }
    axes = ["height", "width", "channels"]
    dtype = "video" if config.video else "image"
    for key, picture in episode.pictures(0).items():
        if config.video and min(picture.shape[:2]) < SMALLEST_VIDEO:
            size = "x".join(map(str, picture.shape[:2]))
            raise ConfigError(
                f"{episode.where}: '{key}' has {size} pixels, too few for video ({SMALLEST_VIDEO} a side); use"
                " --video=false."
            )
        features[key] = {"dtype": dtype, "shape": picture.shape, "names": axes}
    return features


def _compare(episode: "Episode", found: dict[str, dict[str, Any]], expected: dict[str, dict[str, Any]]) -> None:
    """Raise DataError where an episode has other columns or shapes than the first one."""
    for key in {**expected, **found}:
        first, here = expected.get(key, {}).get("shape"), found.get(key, {}).get("shape")
        if first != here:
            raise DataError(
                f"{episode.where}: expected '{key}' of shape {first}, as in the first episode, found {here};"
                " convert such episodes to a dataset of their own."
            )
        if found[key]["dtype"] != expected[key]["dtype"]:
            raise DataError(
                f"{episode.where}: expected '{key}' as {expected[key]['dtype']}, as in the first episode, found"
                f" {found[key]['dtype']}."
            )


def _show(reader: "Reader", plans: list[_Plan], features: dict[str, dict[str, Any]]) -> None:
    fps, origin = reader.fps
    steps, facts = sum(p.steps for p in plans), _totals(plans)
    rows = [[str(i), p.name, str(p.steps), p.task[:60]] for i, p in enumerate(plans)]
    table(["episode", "from", "steps", "task"], rows, ["total", str(len(plans)), str(steps), ""])
    for key, feature in features.items():
        names = feature["names"] if feature["dtype"] not in ("video", "image") else None
        listed = f": {', '.join(names)}" if names and len(names) <= 20 else ""
        result(f"{key} {feature['dtype']} {'x'.join(map(str, feature['shape']))}{listed}")
    result(f"{fps} frames a second ({origin}), {steps / fps:.1f} s in all.")
    if facts:
        result(", ".join(f"{count} {name.replace('_', ' ')}" for name, count in facts.items()) + ".")


def _totals(plans: list[_Plan]) -> dict[str, int]:
    return {name: sum(p.facts.get(name, 0) for p in plans) for name in plans[0].facts}


def _write(
    config: ConvertConfig,
    reader: "Reader",
    plans: list[_Plan],
    features: dict[str, dict[str, Any]],
    skipped: _Skipped,
    source: Path,
    root: Path,
) -> None:

    from ..disk.target import append_history, new_dataset
    from ..views.episode import SOURCE_EPISODE, SOURCE_FRAME

    index_feature = {"dtype": "int64", "shape": (1,), "names": None}
    declared = {**features, SOURCE_EPISODE: index_feature, SOURCE_FRAME: index_feature}
    written: list[_Plan] = []
    writer = new_dataset(config.new_repo_id, root, fps=reader.fps[0], features=declared, robot_type=reader.robot_type)
    with writer as target, progress() as bar:
        for plan in bar.track(plans, description="Writing episodes"):
            try:
                with reader.episode(plan.name) as episode:
                    _add(target, episode, plan, config.swap_colors)
            except DataError as error:  # a picture that cannot be read; failures of writing are no DataErrors
                target.drop_episode()
                skipped.add(config, plan.name, error)
                continue
            target.save_episode()
            written.append(plan)
        if not written:
            raise DataError(f"No episode of {config.input} can be read; the first: {skipped[0][1]}")
        append_history(target.folder, None, _history_entry(config, reader, written, skipped, source))
    if skipped:
        result(f"Skipped {len(skipped)} of {len(reader.episodes)} episodes: {', '.join(name for name, _ in skipped)}.")


def _add(target: Any, episode: "Episode", plan: _Plan, swap_colors: bool) -> None:
    """All steps of one episode."""
    import numpy as np

    from ..views.episode import SOURCE_EPISODE, SOURCE_FRAME

    for step, frame in enumerate(episode.frames()):
        if swap_colors:
            frame |= {key: np.ascontiguousarray(frame[key][:, :, ::-1]) for key in episode.cameras}
        trace = {SOURCE_EPISODE: np.array([plan.index]), SOURCE_FRAME: np.array([step])}
        target.add({**frame, **trace}, episode.task)


def _history_entry(
    config: ConvertConfig, reader: "Reader", written: list[_Plan], skipped: _Skipped, source: Path
) -> dict[str, Any]:
    """Entry of the history; folders of this machine stay out of it."""
    local = (*SHARED, "task")
    settings = {k: v for k, v in dataclasses.asdict(config).items() if k not in local}
    entry = _entry(config, source, settings | {"fps": reader.fps[0], "fps_from": reader.fps[1]})
    entry |= {
        "total": {"episodes": len(written), "steps": sum(p.steps for p in written), **_totals(written)},
        "notes": reader.notes,
        "skipped": [{"source": name, "reason": why.replace(str(source), source.name)} for name, why in skipped],
        "episodes": [
            {"episode": i, "source": p.name, "source_episode": p.index, "steps": p.steps, "task": p.task, **p.facts}
            for i, p in enumerate(written)
        ],
    }
    return entry | {"told": told(entry)}


def told(entry: Mapping[str, Any]) -> str:
    """The sentence for the history, from the entry of a conversion."""
    total, skipped = entry["total"], entry.get("skipped")
    said = f"Converted {entry['source']} from {entry['format']}: {total['episodes']} episodes, {total['steps']} steps"
    return said + (f"; {len(skipped)} could not be taken over." if skipped else ".")


def _entry(config: ConvertConfig, source: Path, settings: dict[str, Any]) -> dict[str, Any]:
    return {
        "operation": "convert",
        "format": config.from_,
        "source": source.resolve().name,
        "target": config.new_repo_id,
        "settings": settings,
    }


def _convert_lerobot(config: ConvertConfig, source: Path, root: Path) -> None:
    from lerobot.utils.constants import DEFAULT_FEATURES

    from ..disk.target import append_history
    from .lerobot_v21 import converted_copy, look

    summary = look(source)
    for key, feature in ((k, f) for k, f in summary.features.items() if k not in DEFAULT_FEATURES):
        result(f"{key} {feature['dtype']} {'x'.join(map(str, feature['shape']))}")
    result(f"{summary.episodes} episodes, {summary.frames} steps at {summary.fps:g} frames a second.")
    if config.dry_run:
        return
    with converted_copy(source, root, config.new_repo_id) as folder:
        total = {"episodes": summary.episodes, "steps": summary.frames}
        entry = _entry(config, source, {}) | {"total": total}
        append_history(folder, source, entry | {"told": told(entry)})


def _python_name(arg: str) -> str:
    """``from`` is a word of Python, so the field is called ``from_``."""
    return "--from_" + arg.removeprefix("--from") if arg == "--from" or arg.startswith("--from=") else arg


def _is_default(config: ConvertConfig, field: "dataclasses.Field[Any]") -> bool:
    value = getattr(config, field.name)
    return bool(value == field.default or (isinstance(value, list) and not value))
