"""The same reduction by threads and on a cluster, bit for bit; arrays in pieces, on disk and in memory."""

import errno
import os
import signal
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from tests.thermography.plan_scene import GRID, Scene, assert_equal_bits, edges, record, registered
from thermography import large_arrays
from thermography.fields import still
from thermography.fields.scheduling import SchedulerError, in_order, open_pool, open_stored
from thermography.fields.still import reduce_frames
from thermography.large_arrays import (
    Spool,
    copy_to_disk,
    empty_array,
    empty_arrays,
    fill_array,
    give_back,
    in_pieces,
    median_of_pieces,
    piece_slices,
)

pytestmark = pytest.mark.long

# The cluster's own event loop leaves sockets to the garbage collector after it has been closed.
ends_late = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")


@pytest.fixture(scope="module")
def cluster():
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None, "silence_logs": 50}
    with distributed.LocalCluster(**options) as started:
        yield started


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    rng = np.random.default_rng(4)
    image = Scene(disc_K=-4.0).render()
    registration = registered()
    images = (image + rng.normal(0, 0.05, image.shape) for _ in range(24))
    return record(tmp_path_factory.mktemp("film") / "a.seq", images), registration


BOUNDS = edges(0, 9, 17, 24)
in_memory_or_not = pytest.mark.parametrize("in_memory", [1 << 24, 10])


@pytest.mark.parametrize("cores", [1, 3, 64])
def test_any_number_of_threads_gives_the_same_fields_bit_for_bit(cores, film, monkeypatch):
    frames, registration = film
    monkeypatch.setattr(still, "STRETCH_FRAMES", 2)
    alone = reduce_frames(frames, registration, GRID, BOUNDS, block_s=1)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(cores)), raising=False)
    assert_equal_bits(alone, reduce_frames(frames, registration, GRID, BOUNDS, block_s=1))


@ends_late
def test_a_worker_that_is_killed_in_the_middle_loses_nothing(cluster, film, monkeypatch, tmp_path):
    frames, registration = film
    monkeypatch.setattr(still, "STRETCH_FRAMES", 2)
    alone = reduce_frames(frames, registration, GRID, BOUNDS, block_s=1)
    killed = []

    def kill_one(count):
        if not killed:
            killed.append(next(iter(cluster.workers.values())).pid)
            os.kill(killed[0], signal.SIGKILL)

    options = {"block_s": 1, "scheduler": cluster.scheduler_address, "checkpoint": tmp_path / "cp"}
    together = reduce_frames(frames, registration, GRID, BOUNDS, progress=kill_one, **options)
    assert killed
    assert_equal_bits(alone, together)


@ends_late
def test_a_file_that_workers_do_not_see_is_named(cluster, film):
    frames, registration = film
    elsewhere = [replace(frame, path=Path("/elsewhere/a.seq")) for frame in frames]
    with pytest.raises(SchedulerError, match=r"/elsewhere/a\.seq: a worker of tcp://.* does not find this file; all"):
        reduce_frames(elsewhere, registration, GRID, BOUNDS, scheduler=cluster.scheduler_address)


def test_a_scheduler_that_does_not_answer_is_named():
    pytest.importorskip("distributed")
    message = r"scheduler nowhere does not answer \(.*\); check or omit its address"
    with pytest.raises(SchedulerError, match=message), open_pool("nowhere"):
        pass


def test_results_come_in_order_and_leaving_early_cancels_the_rest():
    started = []

    def work(n):
        started.append(n)
        return n * n

    with open_pool() as pool:
        assert [r for _, r in in_order(pool, ((n, (work, n)) for n in range(20)))] == [n * n for n in range(20)]
        started.clear()
        results = in_order(pool, ((n, (work, n)) for n in range(1000)))
        assert next(results) == (0, 0)
        results.close()
    assert len(started) <= pool.in_flight


def test_the_pieces_are_the_array(monkeypatch, tmp_path, rng):
    monkeypatch.setattr(large_arrays, "PIECE_BYTES", 3 * 4 * 8)
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


@in_memory_or_not
def test_what_is_filled_or_copied_in_pieces_is_the_same_on_disk_and_in_memory(monkeypatch, tmp_path, in_memory, rng):
    monkeypatch.setattr(large_arrays, "PIECE_BYTES", 2 * 3 * 8)
    monkeypatch.setattr(large_arrays, "IN_MEMORY_BYTES", in_memory)
    values = rng.normal(size=(7, 3))
    filled = fill_array(values.shape, float, lambda some: values[some], tmp_path)
    assert filled.tobytes() == values.tobytes() and (fill_array((4, 2), np.uint8, lambda _: 5) == 5).all()
    halves = copy_to_disk(np.array_split(values, 2, axis=1))
    assert all(half.flags.c_contiguous for half in halves) and (np.hstack(halves) == values).all()


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


@in_memory_or_not
def test_a_spool_gives_back_what_was_appended(monkeypatch, tmp_path, in_memory):
    monkeypatch.setattr(large_arrays, "IN_MEMORY_BYTES", in_memory)
    spool = Spool(tmp_path)
    arrays = [np.arange(6, dtype="f4").reshape(2, 3) + 10 * i for i in range(11)]
    for number, array in enumerate(arrays, 1):
        spool.append(array)
        assert len(spool) == number
        assert (spool[0] == arrays[0]).all() and (spool[-1] == array).all()
    assert np.stack(spool[3:5]).tobytes() == np.stack(arrays[3:5]).tobytes()
    assert np.stack(list(spool)).tobytes() == np.stack(arrays).tobytes()
    with pytest.raises(IndexError):
        spool[11]
    # The file has no name: nothing is left of it, however the process ends.
    assert not list(tmp_path.iterdir())


@in_memory_or_not
def test_arrays_are_apart_and_last_as_long_as_they_are_used(monkeypatch, tmp_path, in_memory):
    monkeypatch.setattr(large_arrays, "IN_MEMORY_BYTES", in_memory)
    shapes = [(40, 3), (40, 2), (7,)]
    for parts in (empty_arrays(shapes, np.float32), [empty_array(shape, np.float32, tmp_path) for shape in shapes]):
        for number, part in enumerate(parts):
            part[...] = number
            give_back(part)
        assert [part.shape for part in parts] == shapes
        view = parts[1][2:4]
        assert all(type(part) is np.ndarray and part.flags.c_contiguous for part in parts)
        assert all((part == k).all() for k, part in enumerate(parts))
        del parts, part
        assert type(view) is np.ndarray and (view == 1).all()


def test_a_disk_that_is_too_small_is_named(monkeypatch, tmp_path):
    monkeypatch.setattr(large_arrays, "IN_MEMORY_BYTES", 100)

    def full(*arguments):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(large_arrays, "_take_room", full)
    monkeypatch.setattr(large_arrays.pickle, "dump", full)
    for fill in (lambda: empty_array((100, 100), np.float64, tmp_path), lambda: Spool(tmp_path).append(0)):
        with pytest.raises(OSError, match=str(tmp_path)) as refused:
            fill()
        assert refused.value.errno == errno.ENOSPC and refused.value.filename == str(tmp_path)


@pytest.mark.parametrize("mode", ["r+", "c"])
def test_memory_that_is_given_back_loses_nothing(tmp_path, mode):
    np.arange(5000.0).tofile(tmp_path / "array")
    array = np.asarray(np.memmap(tmp_path / "array", float, mode))
    array[7] = -1.0
    give_back(array[3:9], np.zeros(3))
    assert array[7] == -1.0 and array[4999] == 4999.0


@pytest.fixture
def whole(rng):
    """A Dataset with gaps, times and text."""
    times = np.datetime64("2026-03-09T06:30", "ns") + np.arange(6) * np.timedelta64(90, "s")
    rise = rng.normal(size=(6, 4, 5)).astype("f4")
    rise[2, 1] = np.nan
    return xr.Dataset(
        {"rise": (("cycle", "y", "x"), rise, {"units": "K"}), "name": ("x", list("abcde"))},
        {"cycle": np.arange(1, 7), "time": ("cycle", times)},
    )


def test_what_is_read_is_the_same_as_in_memory(tmp_path, whole):
    whole.to_netcdf(tmp_path / "x.nc", engine="h5netcdf")
    stored = open_stored(tmp_path / "x.nc", nullcontext, 1 << 16)
    xr.testing.assert_identical(stored, whole)
    rise, held = stored["rise"], whole["rise"]
    some = xr.DataArray([0, 3, 1], dims="place")
    for read, expected in (
        (rise[-1, 2, 0], held[-1, 2, 0]),
        (rise.sel(cycle=slice(2, 5), drop=True), held.sel(cycle=slice(2, 5), drop=True)),
        (rise[::2, [3, 0], [1, 4]], held[::2, [3, 0], [1, 4]]),
        (rise.isel(x=some, y=some), held.isel(x=some, y=some)),
        (rise[1:][:, 1][2], held[1:][:, 1][2]),
    ):
        np.testing.assert_array_equal(read.values, expected.values)
    assert not rise.variable._in_memory
    stored.close()


def test_every_reading_has_its_context(tmp_path, whole):
    begun = []

    @contextmanager
    def noted():
        begun.append(0)
        yield

    whole.to_netcdf(tmp_path / "x.nc", engine="h5netcdf")
    stored = open_stored(tmp_path / "x.nc", noted, 1 << 16)
    assert len(begun) == 1
    for at in range(3):
        assert stored["rise"].variable[at].values.shape == (4, 5)
    assert len(begun) == 4
    stored.close()
