"""Columns of one episode from a table on disk, checked: sizes, missing and infinite numbers, even times."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from lerobot_cqn.errors import DataError
from lerobot_cqn.schema import ACTION, STATE

from ..views.episode import Episode

__all__ = ["places", "read_column", "refuse_disorder", "refuse_infinite", "refuse_uneven", "tasks_by_index"]

TRAINED = (ACTION, STATE, "observation.environment_state")
JITTER = 0.2  # share of a step by which a timestamp may be off


def places(numbers: NDArray[np.int64]) -> dict[int, tuple[int, int]]:
    """Episode -> first row and the one after its last, by (N,) numbers of episodes; (0, 0) where it is in pieces."""
    edges = np.flatnonzero(np.diff(numbers)) + 1
    found: dict[int, tuple[int, int]] = {}
    for start, stop in zip([0, *edges], [*edges, len(numbers)], strict=True):
        if stop > start:
            index = int(numbers[start])
            found[index] = (0, 0) if index in found else (int(start), int(stop))
    return found


def tasks_by_index(root: Path, tasks: Any) -> dict[int, str]:
    """Task sentences by number, in the order of LeRobot's table of them; raises DataError for one number twice."""
    numbers = [int(number) for number in tasks["task_index"]]
    if len(set(numbers)) != len(numbers):
        raise DataError(f"{root}/meta/tasks.parquet has a task_index twice; give every task one of its own.")
    return dict(zip(numbers, (str(task) for task in tasks.index), strict=True))


def refuse_disorder(episode: int, frames: NDArray[np.int64]) -> None:
    """Raise DataError where (T,) frame numbers are not 0, 1, 2, …: rows are lost, twice, or in another order."""
    wrong = np.flatnonzero(frames != np.arange(len(frames)))
    if len(wrong):
        raise DataError(
            f"Episode {episode}: frame_index is {int(frames[wrong[0]])} in its row {int(wrong[0])}, expected 0, 1, 2"
            " and so on; rows are lost or out of order: restore or drop this episode."
        )


def refuse_infinite(episode: Episode) -> None:
    """Raise DataError where a number that training reads (state, action, next.*) is NaN or infinite."""
    for key, values in episode.columns.items():
        if (key in TRAINED or key.startswith("next.")) and np.issubdtype(np.asarray(values).dtype, np.floating):
            bad = np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))
            if len(bad):
                frame = int(episode.frames[bad[0]])
                raise DataError(
                    f"Episode {episode.index}, frame {frame}: '{key}' is not finite; cut it off (cqn-data trim), or"
                    " drop or mend this episode."
                )


def read_column(episode: int, key: str, feature: dict[str, Any], values: Any) -> Any:
    """(T, …) array of one column, or list of T strings."""
    if feature["dtype"] == "string":
        return values.to_pylist()
    flat = values.combine_chunks() if isinstance(values, pa.ChunkedArray) else values
    if isinstance(flat, pa.ChunkedArray):  # some versions keep an empty or extension column in chunks
        flat = pa.concat_arrays(flat.chunks)
    if pa.types.is_list(flat.type) or pa.types.is_fixed_size_list(flat.type):
        flat = flat.flatten()
    if isinstance(flat, pa.ExtensionArray):  # matrices
        array = np.asarray(values.to_pylist(), dtype=feature["dtype"])
    else:
        array = flat.to_numpy(zero_copy_only=False)
    try:
        array = np.asarray(array).reshape(len(values), *feature["shape"])
        missing = array.dtype == object
    except ValueError:
        missing = True
    if missing:
        raise DataError(f"Episode {episode}: '{key}' has missing values or another size than {feature['shape']}.")
    return array.astype(feature["dtype"])  # a copy that outlives the table


def refuse_uneven(episode: int, times: NDArray[np.float64], fps: float) -> None:
    """Raise DataError where one step is much longer or shorter than the rate says; (T,) seconds."""
    uneven = np.flatnonzero(np.abs(np.diff(times) * fps - 1) > JITTER)
    if len(uneven):
        frame = int(uneven[0]) + 1
        raise DataError(
            f"Episode {episode}, frame {frame}: {times[frame] - times[frame - 1]:.4f} s after the frame before it, not"
            f" {1 / fps:.4f} s at {fps:g} fps; record at one rate, or drop this episode."
        )
