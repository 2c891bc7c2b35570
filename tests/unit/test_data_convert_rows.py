"""Rows that stay on disk, and the ways in which formats store pictures."""

import zipfile

import numpy as np
import pytest

from cqn_data.formats.common import Pictures, in_natural_order
from cqn_data.formats.disk_arrays import BLOCK_ROWS, NpyRows, Rows


class Counted:
    """An array that counts how often it is read."""

    def __init__(self, array):
        self.array, self.dtype, self.shape, self.reads, self.longest = array, array.dtype, array.shape, 0, 0

    def __len__(self):
        return len(self.array)

    def __getitem__(self, rows):
        got = self.array[rows]
        self.reads += len(got) > 0
        self.longest = max(self.longest, len(got))
        return got


def test_rows_are_those_of_the_slice_and_read_in_blocks():
    array = Counted(np.arange(600).reshape(300, 2))
    rows = Rows(array, 50, 250)
    assert [rows[i].tolist() for i in range(len(rows))] == array.array[50:250].tolist()
    assert array.reads == -(-200 // BLOCK_ROWS)
    assert rows[3].tolist() == [106, 107]
    with pytest.raises(IndexError):
        rows[200]
    large = Counted(np.zeros((9, 8 * 2**20), np.uint8))
    rows = Rows(large)
    assert [len(rows[i]) for i in range(9)] == [8 * 2**20] * 9
    assert large.longest == 2


@pytest.fixture
def archive(tmp_path):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, a=np.arange(12.0).reshape(4, 3), column=np.asfortranarray(np.eye(3)), s=np.float32(2))
    with zipfile.ZipFile(path) as opened:
        yield opened


def test_npz_rows_in_any_order(archive):
    rows = NpyRows(archive, "a.npy")
    assert (len(rows), rows.shape, rows.dtype) == (4, (4, 3), np.float64)
    for step in (1, 3, 0, 0, 2):
        assert rows[step].tolist() == [3 * step, 3 * step + 1, 3 * step + 2]
    rows.close()
    assert rows[1].tolist() == [3, 4, 5]
    assert rows.everything().shape == (4, 3)
    assert float(NpyRows(archive, "s.npy").everything()) == 2
    with pytest.raises(IndexError):
        rows[4]
    with pytest.raises(ValueError, match="column by column"):
        NpyRows(archive, "column.npy")


@pytest.mark.parametrize(("dtype", "divisor"), [(np.float32, 255), (np.float64, 255), (np.float16, 1), (np.float32, 1)])
def test_every_colour_survives_as_a_float(dtype, divisor):
    colours = np.arange(256).reshape(16, 16, 1).repeat(3, axis=2)
    black = np.zeros((1, 16, 16, 3))
    pictures = Pictures(np.concatenate([black, colours[None] / divisor]).astype(dtype))
    assert pictures[0].max() == 0
    np.testing.assert_array_equal(pictures[1], colours)
    assert pictures[1].dtype == np.uint8


def test_axes_and_channels():
    picture = np.arange(4 * 5 * 3, dtype=np.uint8).reshape(4, 5, 3)
    alpha = np.concatenate([picture, picture[:, :, :1]], axis=2)
    for row in (picture, np.moveaxis(picture, 2, 0), alpha):
        np.testing.assert_array_equal(Pictures(row[None])[0], picture)
    for row in (picture[:, :, 0], picture[:, :, :1]):
        np.testing.assert_array_equal(Pictures(row[None])[0], picture[:, :, :1].repeat(3, axis=2))


@pytest.mark.parametrize(
    "row",
    [
        np.full((4, 4, 3), 256.0), np.full((4, 4, 3), -0.1), np.full((4, 4, 3), np.nan), np.zeros((4, 4, 3), np.uint16),
        np.zeros((5, 6, 7), np.uint8), np.zeros(9, np.uint8), np.zeros((2, 4, 4, 3), np.uint8),
    ],
)  # fmt: skip
def test_what_is_no_picture_is_refused(row):
    with pytest.raises((ValueError, OSError)):
        Pictures(row[None])[0]


def test_a_scale_once_found_is_kept():
    rows = np.stack([np.full((2, 2, 3), 0.5), np.full((2, 2, 3), 1.5)])
    pictures = Pictures(rows)
    assert pictures[0].max() == 128
    with pytest.raises(ValueError, match="expected colours from 0 to 1, found"):
        pictures[1]


def test_natural_order():
    assert in_natural_order(["b/e10", "b/e9", "a/e11", "b/e9x"]) == ["a/e11", "b/e9", "b/e9x", "b/e10"]
