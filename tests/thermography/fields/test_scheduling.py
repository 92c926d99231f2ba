"""The same reduction on a cluster, bit for bit, and the errors of one that is not there."""

import numpy as np
import pytest

from tests.thermography.plan_scene import DISCS, GRID, START, Scene, record
from thermography.fields.scheduling import SchedulerError, in_order, open_pool
from thermography.fields.still import reduce_frames
from thermography.registration.register import register


# The cluster's own event loop leaves sockets to the garbage collector after it has been closed.
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_cluster_of_two_workers_gives_the_same_fields_bit_for_bit(rng, tmp_path):
    distributed = pytest.importorskip("distributed")
    image = Scene(disc_K=-4.0).render()
    registration = register(image, DISCS, grid=GRID)
    frames = record(tmp_path / "a.seq", (image + rng.normal(0, 0.05, image.shape) for _ in range(24)))
    bounds = START + np.array([0, 9, 17, 24]) * np.timedelta64(1, "s")
    alone = reduce_frames(frames, registration, GRID, bounds, block_s=4)
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50
    ) as cluster:
        together = reduce_frames(frames, registration, GRID, bounds, block_s=4, scheduler=cluster.scheduler_address)
    for name in alone.variables:
        assert alone[name].values.tobytes() == together[name].values.tobytes(), name
    assert alone.attrs == together.attrs


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
