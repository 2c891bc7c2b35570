"""Metrics as CSV files, one row at a time, flushed; and, on request, to Weights & Biases (docs/metrics.md)."""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lerobot_cqn.errors import ConfigError

__all__ = ["COLUMNS", "Metrics"]

COLUMNS: dict[str, tuple[str, ...]] = {
    "updates": ("updates", "env_steps", "loss", "rl_loss", "bc_dominance_loss", "bc_margin_loss", "wall_s"),
    "episodes": (
        "episode", "env_steps", "updates", "length", "success", "return", "mean_q", "demonstrations", "wall_s",
    ),
    "evaluations": (
        "phase", "env_steps", "updates", "episodes", "n", "successes", "success_rate", "ci_low", "ci_high",
        "mean_length", "wall_s",
    ),
}  # fmt: skip


class Metrics:
    """Three tables in `output_dir`: updates.csv, episodes.csv, evaluations.csv."""

    def __init__(self, output_dir: Path, wandb: Any = None) -> None:
        self.output_dir, self._wandb = output_dir, wandb
        for table, columns in COLUMNS.items():
            path = output_dir / f"{table}.csv"
            if not path.exists():
                path.write_text(",".join(columns) + "\n")

    def write(self, table: str, row: Mapping[str, Any]) -> None:
        """Append a row; columns that do not apply stay empty."""
        with (self.output_dir / f"{table}.csv").open("a", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS[table], restval="", extrasaction="ignore")
            writer.writerow({name: _text(value) for name, value in row.items()})
        if self._wandb is not None:
            self._wandb.log({f"{table}/{k}": v for k, v in row.items() if isinstance(v, int | float)})

    def sizes(self) -> dict[str, int]:
        """Bytes of each table, for a checkpoint."""
        return {table: (self.output_dir / f"{table}.csv").stat().st_size for table in COLUMNS}

    def truncate(self, sizes: Mapping[str, int]) -> None:
        """Forget rows written after a checkpoint, so that a resumed run does not count them twice."""
        for table, size in sizes.items():
            with (self.output_dir / f"{table}.csv").open("r+b") as file:
                file.truncate(size)


def _text(value: Any) -> Any:
    return f"{value:.6g}" if isinstance(value, float) else value


def start_wandb(project: str, name: str, config: Mapping[str, Any], mode: Any) -> Any:
    """A Weights & Biases run. Raises ConfigError when the package is missing."""
    try:
        import wandb
    except ImportError as error:
        raise ConfigError("`--wandb.enable` needs the extra: pip install 'lerobot_policy_cqn[wandb]'.") from error
    return wandb.init(project=project, name=name, config=dict(config), mode=mode)
