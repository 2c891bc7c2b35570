"""Arrays that stay on disk: HDF5 files, and rows of HDF5, Zarr and NPY arrays read in short blocks."""

import contextlib
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import DataError

from .common import lacks, need, reading

__all__ = ["NpyRows", "Rows", "array_of", "open_hdf5"]

_npy: Any = np.lib.format  # has no types
BLOCK_ROWS = 64
BLOCK_BYTES = 16 * 2**20


class Rows(Sequence[Any]):
    """Rows ``start`` to ``stop`` of an array on disk; at most 64 rows or 16 MiB are in memory, and at least one."""

    def __init__(self, array: Any, start: int = 0, stop: int | None = None) -> None:
        self._array = array
        self._start, self._stop = start, len(array) if stop is None else stop
        row_bytes = max(1, array.dtype.itemsize * int(np.prod(array.shape[1:])))
        self._size = max(1, min(BLOCK_ROWS, BLOCK_BYTES // row_bytes))
        self._first, self._block = 0, array[:0]

    def __len__(self) -> int:
        return self._stop - self._start

    def __getitem__(self, step: Any) -> Any:
        """One row, without the first axis."""
        if not 0 <= step < len(self):
            raise IndexError(f"row {step} of {len(self)}")
        row = self._start + step
        if not self._first <= row < self._first + len(self._block):
            self._block = self._array[:0]  # let go before the next one comes
            self._block = self._array[row : min(row + self._size, self._stop)]
            self._first = row
        return self._block[row - self._first]


class NpyRows(Sequence[Any]):
    """Rows of one array in an NPZ file, read one after the other without unpacking the whole array.

    Raises:
        ValueError: the array holds Python objects or is stored column by column.
    """

    def __init__(self, archive: zipfile.ZipFile, member: str) -> None:
        self._archive, self._member = archive, member
        self._file: Any = None
        self._next = 0
        self.shape, self.dtype = self._rewind()

    def __len__(self) -> int:
        return int(self.shape[0]) if self.shape else 0

    def __getitem__(self, step: Any) -> Any:
        """One row; asking for an earlier row than the last starts over."""
        if not 0 <= step < len(self):
            raise IndexError(f"row {step} of {len(self)}")
        if self._file is None or step < self._next:
            self._rewind()
        size = self.dtype.itemsize * int(np.prod(self.shape[1:]))
        data = b""
        while self._next <= step:
            data = self._file.read(size)
            self._next += 1
        if len(data) < size:
            raise ValueError(f"{self._member} ends before row {step}")
        return np.frombuffer(data, self.dtype).reshape(self.shape[1:])

    def everything(self) -> NDArray[Any]:
        """The whole array."""
        with self._archive.open(self._member) as file:
            array: NDArray[Any] = _npy.read_array(file, allow_pickle=False)
        return array

    def _rewind(self) -> tuple[tuple[int, ...], np.dtype[Any]]:
        self.close()
        self._file = self._archive.open(self._member)
        self._next = 0
        version = _npy.read_magic(self._file)
        read = _npy.read_array_header_1_0 if version == (1, 0) else _npy.read_array_header_2_0
        shape, by_column, dtype = read(self._file)
        if dtype.hasobject:
            raise ValueError(f"{self._member} holds Python objects, which are not read; save plain numbers")
        if by_column and len(shape) > 1:
            raise ValueError(f"{self._member} is stored column by column; save numpy.ascontiguousarray of it")
        return shape, dtype

    def close(self) -> None:
        """Close the member; it is opened again when asked for a row."""
        if self._file is not None:
            self._file.close()
            self._file = None


@contextlib.contextmanager
def open_hdf5(path: Path) -> Iterator[Any]:
    """An ``h5py.File`` for reading.

    Raises:
        ConfigError: h5py is not installed.
        DataError: not a file, not HDF5, or cut short.
    """
    h5py = need("h5py")
    if not path.is_file():
        raise DataError(f"Expected an HDF5 file, found {'a folder' if path.is_dir() else 'nothing'} at {path}.")
    with reading(str(path)):
        file = h5py.File(path, "r")
    with file:
        yield file


def array_of(group: Any, key: str, where: str) -> Any:
    """The array ``key`` (may be a path) of an HDF5 or Zarr group, still on disk; raises DataError listing the keys."""
    parent, _, name = key.rpartition("/")
    with reading(where):
        folder = group[parent] if parent and parent in group else group if not parent else None
        names = list(folder.keys()) if folder is not None else list(group.keys())
        array = folder[name] if folder is not None and name in names else None
    if array is None or not hasattr(array, "shape"):
        raise lacks(where, key, names)
    return array
