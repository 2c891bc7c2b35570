"""Metrics as CSV files, one row at a time, flushed; on request to TensorBoard and Weights & Biases, too."""

import csv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_cqn.errors import ConfigError

__all__ = ["COLUMNS", "FORCES", "KINDS", "Log", "Metrics", "read_rows", "start_tensorboard", "start_wandb"]

Log = Callable[[Mapping[str, float]], Any]

KINDS = ("demonstrations", "successes", "failures")  # of transitions: the dataset's, and the run's own episodes'
FORCES = ("td_error", "rl_gradient", "imitation_gradient")  # on them
COURSE = ("standing", "at_bounds", "distance", "q_begin", "q_middle", "q_end")  # of an episode
COLUMNS: dict[str, tuple[str, ...]] = {
    "updates": (
        "updates", "env_steps", "loss", "rl_loss", "td_error", "bc_dominance_loss", "bc_margin_loss", "actor_loss",
        "bc_action_loss", "wall_s",
    ),
    "episodes": (
        "episode", "env_steps", "updates", "length", "success", "return", "mean_q", *COURSE, "taught", "demonstrations",
        "wall_s",
    ),
    "evaluations": (
        "phase", "env_steps", "updates", "episodes", "n", "successes", "success_rate", "ci_low", "ci_high",
        "mean_length", "mean_return", "standing_failures", "wall_s",
    ),
    "evaluation_episodes": (
        "phase", "env_steps", "updates", "scene", "success", "how", "length", "return", *COURSE,
    ),
    "diagnosis": (
        "phase", "env_steps", "updates",
        *(f"{name}_{kind}" for kind in KINDS for name in FORCES),
    ),
}  # fmt: skip


class Metrics:
    """Tables in `output_dir`, one for each of `COLUMNS` (docs/metrics.md).

    also: called with a row's numbers as `{"<table>/<column>": value}`, but for single evaluation episodes.
    """

    def __init__(self, output_dir: Path, also: Sequence[Log] = ()) -> None:
        self.output_dir, self._also = output_dir, also
        for table, columns in COLUMNS.items():
            path = output_dir / f"{table}.csv"
            if not path.exists():
                path.write_text(",".join(columns) + "\n")

    def write(self, table: str, row: Mapping[str, Any]) -> None:
        """Append a row; columns that do not apply stay empty."""
        with (self.output_dir / f"{table}.csv").open("a", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS[table], restval="", extrasaction="ignore")
            writer.writerow({name: _text(value) for name, value in row.items()})
        numbers = {f"{table}/{k}": v for k, v in row.items() if isinstance(v, int | float)}
        for log in self._also if table != "evaluation_episodes" else ():
            log(numbers)

    def sizes(self) -> dict[str, int]:
        """Bytes of each table, for a checkpoint."""
        return {table: (self.output_dir / f"{table}.csv").stat().st_size for table in COLUMNS}

    def truncate(self, sizes: Mapping[str, int]) -> None:
        """Forget rows written after a checkpoint, so that a resumed run does not count them twice."""
        for table, size in sizes.items():
            with (self.output_dir / f"{table}.csv").open("r+b") as file:
                file.truncate(size)


def read_rows(path: Path) -> list[dict[str, str]]:
    """Rows of a table that `Metrics` wrote, as text by column; none while it does not exist."""
    if not path.exists():
        return []
    with path.open() as file:
        return list(csv.DictReader(file))


def _text(value: Any) -> Any:
    return f"{value:.6g}" if isinstance(value, float) else value


def start_wandb(project: str, name: str, config: Mapping[str, Any], mode: Any) -> Log:
    """A Weights & Biases run. Raises ConfigError when the package is missing or the run does not start."""
    try:
        import wandb
    except ImportError as error:
        raise ConfigError("`--wandb.enable` needs the extra: pip install 'lerobot_policy_cqn[wandb]'.") from error
    try:
        run = wandb.init(project=project, name=name, config=dict(config), mode=mode)
    except Exception as error:  # wandb raises many kinds
        raise ConfigError(
            f"Weights & Biases does not start: {error} Log in with `wandb login`, or give --wandb.mode=offline."
        ) from error
    return lambda numbers: run.log(dict(numbers))


def start_tensorboard(folder: Path) -> Log:
    """TensorBoard events in `folder`, over environment steps. Raises ConfigError when the package is missing."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise ConfigError("`--tensorboard` needs the extra: pip install 'lerobot_policy_cqn[tensorboard]'.") from error
    writer = SummaryWriter(str(folder))

    def log(numbers: Mapping[str, float]) -> None:
        table = next(iter(numbers)).partition("/")[0]
        # Offline updates all happen at step 0: what is logged with each update goes over updates.
        step = int(numbers.get(f"{table}/{'updates' if table == 'updates' else 'env_steps'}", 0))
        for name, value in numbers.items():
            writer.add_scalar(name, value, step)
        writer.flush()

    return log
