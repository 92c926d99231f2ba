"""The same reduction on a cluster, bit for bit, and the errors of one that is not there."""

import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.thermography.plan_scene import DISCS, GRID, START, Scene, record
from thermography.fields.scheduling import SchedulerError, in_order, open_pool
from thermography.fields.still import reduce_frames
from thermography.fields.tasks import stretches
from thermography.registration.register import register

# The cluster's own event loop leaves sockets to the garbage collector after it has been closed.
ends_late = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")


@pytest.fixture(scope="module")
def cluster():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50
    ) as started:
        yield started


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    rng = np.random.default_rng(4)
    image = Scene(disc_K=-4.0).render()
    registration = register(image, DISCS, grid=GRID)
    images = (image + rng.normal(0, 0.05, image.shape) for _ in range(24))
    return record(tmp_path_factory.mktemp("film") / "a.seq", images), registration


BOUNDS = START + np.array([0, 9, 17, 24]) * np.timedelta64(1, "s")


def assert_equal_bits(one, other):
    for name in one.variables:
        assert one[name].values.tobytes() == other[name].values.tobytes(), name
    assert one.attrs == other.attrs


@pytest.mark.parametrize("cores", [1, 3, 64])
def test_any_number_of_threads_gives_the_same_fields_bit_for_bit(cores, film, monkeypatch):
    frames, registration = film
    monkeypatch.setattr(stretches, "STRETCH_FRAMES", 2)
    alone = reduce_frames(frames, registration, GRID, BOUNDS, block_s=1)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(cores)), raising=False)
    assert_equal_bits(alone, reduce_frames(frames, registration, GRID, BOUNDS, block_s=1))


@ends_late
def test_a_cluster_of_two_workers_gives_the_same_fields_bit_for_bit(cluster, film):
    frames, registration = film
    alone = reduce_frames(frames, registration, GRID, BOUNDS, block_s=4)
    together = reduce_frames(frames, registration, GRID, BOUNDS, block_s=4, scheduler=cluster.scheduler_address)
    assert_equal_bits(alone, together)


@ends_late
def test_a_worker_that_is_killed_in_the_middle_loses_nothing(cluster, film, monkeypatch, tmp_path):
    frames, registration = film
    monkeypatch.setattr(stretches, "STRETCH_FRAMES", 2)
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
    with pytest.raises(
        SchedulerError, match=r"/elsewhere/a\.seq: a worker of tcp://.* does not find this file; all workers need"
    ):
        reduce_frames(elsewhere, registration, GRID, BOUNDS, scheduler=cluster.scheduler_address)


def test_a_scheduler_that_does_not_answer_is_named():
    pytest.importorskip("distributed")
    with (
        pytest.raises(
            SchedulerError, match=r"scheduler nowhere does not answer \(.*\); check the address, or leave it out"
        ),
        open_pool("nowhere"),
    ):
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
