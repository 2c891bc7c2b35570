"""Statistics that scale actions and states, compared with the recording they are to scale: missing or stale ones stop.

Shapes: K rows of a dataset, D dimensions of a column.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import DataError
from .schema import ACTION, STATE, dimension_names, read_history

__all__ = ["ENDS", "MOST_CUT", "REMEDY", "check_scaling", "cut_share", "rows_of"]

MOST_CUT = 0.1  # of the values of one dimension that may lie outside what is scaled to [-1, 1]
ROUNDING = 1e-4  # of the range
ENDS = ("min", "max")

type Array = NDArray[np.float64]

REMEDY = "write them anew: lerobot-edit-dataset --operation.type=recompute_stats, or any operation of cqn-data"


def check_scaling(stats: Mapping[str, Any], meta: Any, *, margin: float, state_bound: float | None) -> None:
    """Compare the statistics that a policy is to be trained with, and the rows of its dataset.

    Args:
        stats: LeRobot's statistics by feature, with `min` and `max`; what is not the dataset's own is not looked at.
        meta: LeRobot's metadata of the dataset; rows that are not on this disk are not looked at.
        margin: share of the range by which action bounds are widened at either end, >= 0.
        state_bound: normalised states beyond +- this are cut, > 0; None: the policy does not look at the state.

    Raises:
        DataError: statistics of the action or the state are missing, or cut more than `MOST_CUT` of a dimension's
            values, or more than was asked for with `cqn-data bounds --quantile`.
    """
    place = Path(meta.root) / "meta" / "stats.json"
    looked_at = {ACTION: margin} if state_bound is None else {ACTION: margin, STATE: (state_bound - 1) / 2}
    for key, beyond in looked_at.items():
        feature, given, own = meta.features.get(key), stats.get(key) or {}, (meta.stats or {}).get(key) or {}
        if feature is None or any(end in given and not np.array_equal(given[end], own.get(end, ())) for end in ENDS):
            continue  # bounds from elsewhere, such as the environment's
        if not set(ENDS) <= set(given):
            raise DataError(f"{place} has no smallest and largest '{key}', which scale it to [-1, 1]: {REMEDY}.")
        low, high = (np.asarray(given[end], np.float64).reshape(-1) for end in ENDS)
        names = dimension_names(feature)
        if not len(low) == len(high) == len(names):
            found = min(len(low), len(high))
            raise DataError(f"{place} has {found} values of '{key}', which has {len(names)} dimensions: {REMEDY}.")
        spread = beyond * (high - low)
        share = cut_share(rows_of(meta.root, key), low - spread, high + spread)
        worst = int(np.argmax(share))
        if share[worst] > (_asked_for(meta.root, low, high) if key == ACTION else MOST_CUT):
            raise DataError(
                f"{share[worst]:.0%} of the values of '{key}' in '{names[worst]}' lie outside {low[worst]:.4g} to"
                f" {high[worst]:.4g}, which {place} says of them, more than {MOST_CUT:.0%}: these statistics are of"
                f" other data; {REMEDY}."
            )


def cut_share(rows: Iterator[Array], low: Array, high: Array) -> Array:
    """Share of the values in `rows`, (K, D) each, that lie outside (D,) bounds: (D,) in [0, 1]."""
    outside, count, slack = np.zeros(len(low)), 0, ROUNDING * np.maximum(high - low, np.abs(high)) + 1e-9
    for values in rows:
        if values.shape[1] == len(low):
            outside += ((values < low - slack) | (values > high + slack)).sum(axis=0)
            count += len(values)
    return outside / max(count, 1)


def rows_of(root: Path, key: str) -> Iterator[Array]:
    """The (K, D) values of a column, one data file after the other; none where no file is on this disk.

    Raises DataError for a file that cannot be read, or without the column.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    for path in sorted((Path(root) / "data").rglob("*.parquet")):
        try:
            column = pq.read_table(path, columns=[key])[key]
        except (pa.ArrowException, OSError, KeyError) as error:
            raise DataError(
                f"{path} cannot be read ({' '.join(str(error).split())[-120:]}): it may be cut short; copy or download"
                " it again."
            ) from error
        flat = column.combine_chunks()
        while pa.types.is_list(flat.type) or pa.types.is_fixed_size_list(flat.type):
            flat = flat.flatten()
        yield np.asarray(flat.to_numpy(zero_copy_only=False), np.float64).reshape(len(column), -1)


def _asked_for(root: Path, low: Array, high: Array) -> float:
    """Share that may be cut: what `cqn-data bounds` was asked to leave out, where these are its bounds."""
    for entry in reversed(read_history(Path(root))):
        if "bounds" in entry:
            same = all(np.allclose(entry["bounds"][k], v) for k, v in (("low", low), ("high", high)))
            return max(MOST_CUT, 2 * float(entry["settings"].get("quantile", 0)) + 0.01) if same else MOST_CUT
    return MOST_CUT
