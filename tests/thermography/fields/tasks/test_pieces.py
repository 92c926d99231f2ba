"""Long arrays gone through piece by piece: the pieces are the array, and their median is that of all."""

import numpy as np
import pytest
import xarray as xr

from thermography.fields.tasks import pieces
from thermography.fields.tasks.pieces import in_pieces, median_of_pieces, piece_slices


def test_the_pieces_are_the_array(monkeypatch, tmp_path, rng):
    monkeypatch.setattr(pieces, "PIECE_BYTES", 3 * 4 * 8)
    array = rng.normal(size=(8, 2, 2)).astype("f4")
    mapped = np.memmap(tmp_path / "array", "f4", "w+", shape=array.shape)
    mapped[:] = array
    for one in (array, xr.DataArray(array), mapped, np.asarray(mapped)):
        places, parts = zip(*in_pieces(one), strict=True)
        assert [(some.start, some.stop) for some in places] == [(0, 3), (3, 6), (6, 8)]
        assert np.concatenate(parts).tobytes() == array.tobytes()
    # What was given back is still in the file.
    assert (mapped == array).all()
    assert list(piece_slices((0, 4))) == []
    assert len(list(piece_slices((5, 1000)))) == 5


def test_an_array_of_usual_length_is_one_piece():
    assert list(piece_slices((60, 36, 140))) == [slice(0, 60)]


@pytest.mark.parametrize("count", [1, 2, 7, 1000, 1001])
def test_the_median_of_pieces_is_that_of_all_at_once(count, rng):
    values = np.abs(rng.normal(0, 10.0 ** rng.uniform(-6, 3, count)))
    values[: count // 5] = 0.0
    values = np.append(values, [np.nan, np.nan])
    rng.shuffle(values)
    assert median_of_pieces(lambda: np.array_split(values, 4)) == np.nanmedian(values)


def test_the_median_of_nothing_is_no_number():
    assert np.isnan(median_of_pieces(lambda: [np.array([np.nan]), np.empty(0)]))
    assert np.isnan(median_of_pieces(list))
