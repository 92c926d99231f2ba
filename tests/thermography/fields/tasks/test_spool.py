"""Arrays on disk are the arrays that were put there, and a disk that is too small is named at once."""

import errno
import os

import numpy as np
import pytest

from thermography.fields.tasks import spool as spool_module
from thermography.fields.tasks.spool import Spool, empty_array, empty_arrays, give_back


@pytest.mark.parametrize("in_memory", [1 << 24, 100])
def test_a_spool_gives_back_what_was_appended(monkeypatch, tmp_path, in_memory):
    monkeypatch.setattr(spool_module, "IN_MEMORY_BYTES", in_memory)
    spool = Spool(tmp_path)
    arrays = [np.arange(6, dtype="f4").reshape(2, 3) + 10 * i for i in range(11)]
    for number, array in enumerate(arrays, 1):
        spool.append(array)
        assert len(spool) == number
        assert (spool[0] == arrays[0]).all() and (spool[number - 1] == array).all()
    assert (np.stack(spool[3:5]) == np.stack(arrays[3:5])).all()
    whole = spool.array()
    assert type(whole) is np.ndarray and whole.dtype == np.dtype("f4")
    assert (whole == np.stack(arrays)).all()
    with pytest.raises(IndexError):
        spool[11]
    # The files have no name: nothing is left of them, however the process ends.
    assert not list(tmp_path.iterdir())


def test_a_large_array_is_on_disk_and_lasts_as_long_as_it_is_used(monkeypatch, tmp_path):
    monkeypatch.setattr(spool_module, "IN_MEMORY_BYTES", 100)
    array = empty_array((5, 7, 3), np.float32, tmp_path)
    array[...] = 1.5
    view = array[2:4]
    del array
    assert type(view) is np.ndarray and (view == 1.5).all()
    assert empty_array((2, 3), np.uint8).shape == (2, 3)


def test_a_disk_that_is_too_small_is_named(monkeypatch, tmp_path):
    monkeypatch.setattr(spool_module, "IN_MEMORY_BYTES", 100)

    def full(*arguments):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(spool_module, "_take_room", full)
    with pytest.raises(OSError, match=str(tmp_path)) as refused:
        empty_array((100, 100), np.float64, tmp_path)
    assert refused.value.errno == errno.ENOSPC and refused.value.filename == str(tmp_path)


@pytest.mark.parametrize("mode", ["r+", "c"])
def test_memory_that_is_given_back_loses_nothing(tmp_path, mode):
    np.arange(5000.0).tofile(tmp_path / "array")
    array = np.asarray(np.memmap(tmp_path / "array", float, mode))
    array[7] = -1.0
    give_back(array[3:9], np.zeros(3))
    assert array[7] == -1.0 and array[4999] == 4999.0


@pytest.mark.parametrize("in_memory", [1 << 24, 100])
def test_arrays_that_lie_one_after_the_other_are_apart(monkeypatch, in_memory):
    monkeypatch.setattr(spool_module, "IN_MEMORY_BYTES", in_memory)
    parts = empty_arrays([(40, 3), (40, 2), (7,)], np.float32)
    for number, part in enumerate(parts):
        part[...] = number
        give_back(part)
    assert [part.shape for part in parts] == [(40, 3), (40, 2), (7,)]
    assert all(part.flags.c_contiguous and (part == number).all() for number, part in enumerate(parts))
