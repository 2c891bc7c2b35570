"""Columns of one episode from a table on disk, checked: sizes, missing and infinite numbers, even times."""

from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from lerobot_cqn.errors import DataError

__all__ = ["read_column", "refuse_uneven"]

JITTER = 0.2  # share of a step by which a timestamp may be off


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
    array = array.astype(feature["dtype"])  # a copy that outlives the table
    if np.issubdtype(array.dtype, np.floating):
        bad = ~np.isfinite(array.reshape(len(array), -1)).all(axis=1)
        if bad.any():
            frame = int(np.flatnonzero(bad)[0])
            raise DataError(f"Episode {episode}, frame {frame}: '{key}' is not finite; drop or mend this episode.")
    return array


def refuse_uneven(episode: int, times: NDArray[np.float64], fps: float) -> None:
    """Raise DataError where one step is much longer or shorter than the rate says; (T,) seconds."""
    uneven = np.flatnonzero(np.abs(np.diff(times) * fps - 1) > JITTER)
    if len(uneven):
        frame = int(uneven[0]) + 1
        raise DataError(
            f"Episode {episode}, frame {frame}: {times[frame] - times[frame - 1]:.4f} s after the frame before it, not"
            f" {1 / fps:.4f} s at {fps:g} fps; record at one rate, or drop this episode."
        )
