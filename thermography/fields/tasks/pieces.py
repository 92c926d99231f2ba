"""Arrays that grow with a recording, gone through piece by piece: no more than a piece of them is in memory."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thermography._typing import Array
from thermography.fields.tasks.spool import give_back

if TYPE_CHECKING:
    import xarray as xr

#: Size of a piece in double precision, bytes: what is computed from one takes ten times as much.
PIECE_BYTES = 1 << 22
#: Leading bits of a positive number that sort it into a bin: 11 of the exponent and 5 of the digits, so that bins are 3 % wide.
_BIN_BITS = 16


def piece_slices(shape: Sequence[int]) -> Iterator[slice]:
    """Yield the pieces of an array along its first dimension, each of at most 4 MB in double precision.

    Parameters
    ----------
    shape : sequence of int
        Of the array. One of usual length is a single piece.
    """
    step = max(PIECE_BYTES // (8 * max(math.prod(shape[1:]), 1)), 1)
    return (slice(first, min(first + step, shape[0])) for first in range(0, shape[0], step))


def in_pieces(array: Array | xr.DataArray) -> Iterator[tuple[slice, Array]]:
    """Go through an array piece by piece along its first dimension.

    Parameters
    ----------
    array : ndarray or DataArray
        In memory, in a file that is mapped, or in a product that is read when it is asked for.

    Yields
    ------
    (slice, (some, ...) ndarray)
        Place and values of every piece, see `piece_slices`.
    """
    for some in piece_slices(array.shape):
        piece = np.asarray(array[some])
        yield some, piece
        give_back(piece)


def median_of_pieces(pieces: Callable[[], Iterable[Array]]) -> float:
    """Return the median of values that are never in memory together, the same as of all at once.

    Parameters
    ----------
    pieces : callable
        Gives the values, 0 or larger, piece by piece; NaN does not count. It is called twice: the values are counted by size first, then
        those near the middle are sorted.

    Returns
    -------
    float
        NaN where there is no value.
    """
    counts = np.zeros(1 << _BIN_BITS, np.int64)
    for piece in pieces():
        counts += np.bincount(_bins(piece[~np.isnan(piece)]), minlength=counts.size)
    total = int(counts.sum())
    if not total:
        return float("nan")
    below = np.concatenate([[0], np.cumsum(counts)])
    middle = np.array([(total - 1) // 2, total // 2])
    low, high = np.searchsorted(below, middle, side="right") - 1
    near = [piece[(low <= (at := _bins(piece))) & (at <= high) & ~np.isnan(piece)] for piece in pieces()]
    return float(np.mean(np.sort(np.concatenate(near))[middle - below[low]]))


def _bins(values: Array) -> NDArray[np.int64]:
    """Bin of every value, in the order of the values: the leading bits of a positive number in double precision, without its sign."""
    return np.ascontiguousarray(values, float).view(np.int64) >> (63 - _BIN_BITS)
