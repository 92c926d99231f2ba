"""Speed and memory of file to fields, as ratios against named peers measured in the same run on the same file."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.thermography.plan_scene import DISCS, GRID, SC660, START, Scene
from thermography.checkpoint import recalibrate
from thermography.fields import RegisteredFrom, reduce_frames
from thermography.flir import CameraIdentity, Frame, index_frames, write_sequence
from thermography.moving import reduce_moving_frames
from thermography.radiometry import counts_from_temperature, override
from thermography.registration import register

pytestmark = pytest.mark.slow

FRAMES = 500
INTERVAL_MS = 33


def write_film(path: Path, frames: int) -> Path:
    """Frames of 640 x 480 at 30 Hz with SC660 parameters and 50 mK of noise."""
    rng = np.random.default_rng(0)
    image = Scene(disc_K=-4.0).render()
    noisy = [
        np.round(counts_from_temperature(image + rng.normal(0, 0.05, image.shape), SC660)).astype(np.uint16)
        for _ in range(8)
    ]
    camera = CameraIdentity(model="FLIR SC660")
    times = (START + np.timedelta64(INTERVAL_MS * i, "ms") for i in range(frames))
    write_sequence(
        path, (Frame(counts=noisy[i % 8], parameters=SC660, time=t, camera=camera) for i, t in enumerate(times))
    )
    return path


def bounds_of(frames: int, cycles: int):
    return START + np.linspace(0, INTERVAL_MS * frames, cycles + 1).round().astype("m8[ms]")


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_film(tmp_path_factory.mktemp("film") / "a.seq", FRAMES)


@pytest.fixture(scope="module")
def registration():
    return register(Scene(disc_K=-4.0).render(), DISCS, grid=GRID)


def seconds(work: Callable[[], object], repeat: int = 5) -> tuple[float, float]:
    """Smallest wall time and smallest processor time of a few calls, s; the machine may be shared."""
    wall, cpu = np.inf, np.inf
    for _ in range(repeat):
        start, used = time.perf_counter(), time.process_time()
        work()
        wall, cpu = min(wall, time.perf_counter() - start), min(cpu, time.process_time() - used)
    return wall, cpu


def flirpy_reads(path: Path, frames: int) -> None:
    from flirpy.io.seq import Seq

    for number, frame in enumerate(Seq(str(path)), 1):
        frame.get_radiometric_image()
        if number == frames:
            return


def map_and_sum(path: Path) -> None:
    data = np.memmap(path, np.uint8, "r")
    data[: len(data) // 8 * 8].view(np.uint64).sum()


@pytest.mark.filterwarnings("ignore")
def test_still_table_file_to_cycle_fields(film: Path, registration) -> None:
    bounds = bounds_of(FRAMES, 2)

    def reduce() -> None:
        references, _ = index_frames([film])
        reduce_frames(references, registration, GRID, bounds)

    two, _ = index_frames([film])
    del two[2:]

    def set_up() -> None:
        reduce_frames(two, registration, GRID, bounds)

    reduce()
    ours, once = seconds(reduce), seconds(set_up)
    peer = seconds(lambda: flirpy_reads(film, 60), 2)
    limit = seconds(lambda: map_and_sum(film))
    for clock, name in enumerate(("wall", "processor")):
        rate = FRAMES / ours[clock]
        streaming = (FRAMES - 2) / max(ours[clock] - once[clock], 1e-9)
        flirpy, mapped = 60 / peer[clock], FRAMES / limit[clock]
        print(
            f"\nstill, {name} time: {rate:.0f} frames/s with set-up, {streaming:.0f} without (set-up {once[clock]:.3f} s); flirpy Seq "
            f"{flirpy:.0f}: {rate / flirpy:.1f} x and {streaming / flirpy:.1f} x; summing the mapped file {mapped:.0f}: "
            f"{rate / mapped:.2f} and {streaming / mapped:.2f}"
        )


def test_moving_table(film: Path, registration) -> None:
    references, _ = index_frames([film])
    bounds = bounds_of(FRAMES, 2)

    def reduce() -> None:
        reduce_moving_frames(references, registration, GRID, bounds, direction=(-1, 0))

    reduce()
    wall, cpu = seconds(reduce, 3)
    print(
        f"\nmoving: {FRAMES / wall:.0f} frames/s; {FRAMES / cpu:.0f} per second of processor time (two cores: twice that at most)"
    )


def test_cold_file(film: Path, registration) -> None:
    references, _ = index_frames([film])

    def drop() -> None:
        with film.open("rb") as file:
            os.fsync(file.fileno())
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)

    def plain() -> None:
        drop()
        with film.open("rb", buffering=0) as file:
            while file.read(1 << 24):
                pass

    def reduce() -> None:
        drop()
        reduce_frames(references, registration, GRID, bounds_of(FRAMES, 2))

    ours, reader = seconds(reduce, 3)[0], seconds(plain, 3)[0]
    print(f"\ncold: {FRAMES / ours:.0f} frames/s, plain reader {FRAMES / reader:.0f}: {reader / ours:.2f}")


def test_recalibration_of_100_cycles(film: Path, registration, tmp_path: Path) -> None:
    references, _ = index_frames([film])
    reduce_frames(references, registration, GRID, bounds_of(FRAMES, 100), checkpoint=tmp_path)
    wall, cpu = seconds(
        lambda: recalibrate(
            tmp_path,
            [RegisteredFrom(0, registration)],
            GRID,
            100,
            lambda parameters: override(parameters, emissivity=0.9),
        ),
        3,
    )
    print(f"\nrecalibrating 100 cycles: {wall:.2f} s, {cpu:.2f} s of processor time")


PEAK = """
import re, sys
from pathlib import Path
import numpy as np
from tests.benchmarks.test_speed_fields import bounds_of
from tests.thermography.plan_scene import DISCS, GRID
from thermography.fields import reduce_frames
from thermography.flir import index_frames
from thermography.radiometry import calibrate
from thermography.registration import register
references, _ = index_frames([sys.argv[1]])
registration = register(calibrate(references[0].read().counts, references[0].parameters), DISCS, grid=GRID)
reduce_frames(references, registration, GRID, bounds_of(len(references), 5))
print(int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) / 1024)
"""


def test_peak_memory_does_not_grow_with_the_frames(film: Path, tmp_path: Path) -> None:
    long = write_film(tmp_path / "long.seq", 10 * FRAMES)
    peak = []
    for path in (film, long):
        done = subprocess.run([sys.executable, "-c", PEAK, str(path)], capture_output=True, text=True, check=True)
        peak.append(float(done.stdout))
    print(f"\npeak memory: {peak[0]:.0f} MB for {FRAMES} frames, {peak[1]:.0f} MB for {10 * FRAMES}")
    assert peak[1] < 1.2 * peak[0]
    assert max(peak) < 600


@pytest.mark.filterwarnings("ignore")
def test_overhead_of_a_cluster(film: Path, registration) -> None:
    distributed = pytest.importorskip("distributed")
    references, _ = index_frames([film])
    bounds = bounds_of(FRAMES, 2)
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50
    ) as cluster:
        address = cluster.scheduler_address
        clustered = seconds(lambda: reduce_frames(references, registration, GRID, bounds, scheduler=address), 3)[0]
    alone = seconds(lambda: reduce_frames(references, registration, GRID, bounds), 3)[0]
    more = (clustered - alone) / FRAMES * 1000
    print(f"\ncluster of two workers: {clustered:.2f} s, threads {alone:.2f} s: {more:.2f} s per 1000 frames more")
