"""Speed and memory of file to fields, as ratios against named peers measured in the same run on the same file.

Reproduces figures of docs/measured.csv, on file to fields.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import imagecodecs
import numpy as np
import psutil
import pytest
import xarray as xr

from tests.thermography.fields.test_still import simulated
from tests.thermography.plan_scene import GRID, SC660, START, Scene, registered
from thermography.fields.blocks import cut_blocks
from thermography.fields.moving import reduce_moving_frames
from thermography.fields.still import cut_stretches, gather_frames, reduce_frames
from thermography.io.flir import index_frames
from thermography.io.flir_writer import write_sequence
from thermography.io.frame import CameraIdentity, Frame, FrameReference
from thermography.io.sequence import FlirFrameReference
from thermography.radiometry.planck import counts_from_temperature
from thermography.registration.displacement import RegistrationSpan

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
    return registered()


def take_turns(*works: Callable[[], object], rounds: int = 9) -> np.ndarray:
    """Wall and processor times, (2, works, rounds), s: all take turns, because the machine may be shared; ratios are taken by rounds."""
    for work in works:
        work()
    times = np.empty((2, len(works), rounds))
    for turn in range(rounds):
        for i, work in enumerate(works):
            wall, processor = time.perf_counter(), time.process_time()
            work()
            times[:, i, turn] = time.perf_counter() - wall, time.process_time() - processor
    return times


def median_of(values: np.ndarray) -> str:
    """Median, with the quartiles over the rounds."""
    low, middle, high = np.percentile(values, (25, 50, 75))
    return f"{middle:.3g} ({low:.3g} to {high:.3g})"


def processor_line(ours: np.ndarray, peer: np.ndarray) -> str:
    """Processor time of a frame of the whole film and of 60 that the peer reads: with two threads, half of it passes on two free cores."""
    return f"by processor time {1e3 * np.median(ours) / FRAMES:.3f} ms a frame, {median_of(peer / 60 * FRAMES / ours)} x on one core"


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

    references, _ = index_frames([film])

    def set_up() -> None:
        reduce_frames(references[:2], registration, GRID, bounds)

    (ours, start, peer, limit), (ours_cpu, _, peer_cpu, _) = take_turns(
        reduce, set_up, lambda: flirpy_reads(film, 60), lambda: map_and_sum(film)
    )
    print(
        f"\nstill: {median_of(FRAMES / ours)} frames/s with index and set-up ({np.median(start):.3f} s); "
        f"against flirpy Seq to temperature ({median_of(60 / peer)} frames/s): {median_of(peer / 60 * FRAMES / ours)} x; "
        f"against summing the mapped file ({median_of(FRAMES / limit)} frames/s): {median_of(limit / ours)}, "
        f"without set-up {median_of(limit / (ours - start))}; {processor_line(ours_cpu, peer_cpu)}"
    )


def test_file_to_cycle_fields_against_means_by_xarray(film: Path, registration) -> None:
    """The peer only takes the means of pictures that are in memory as float32; ours opens, decodes, registers and calibrates them."""
    bounds, frames = bounds_of(FRAMES, 2), 100
    pictures = xr.DataArray(np.full((frames, 480, 640), 300.0, np.float32), dims=("time", "y", "x"))
    pictures = pictures.assign_coords(cycle=("time", np.arange(frames) * 2 // frames))

    def reduce() -> None:
        reduce_frames(index_frames([film])[0], registration, GRID, bounds)

    ours, peer = take_turns(reduce, lambda: pictures.groupby("cycle").mean(), rounds=5)[0]
    print(
        f"\nfile to cycle fields {median_of(FRAMES / ours)} frames/s, xarray groupby.mean of pictures in memory "
        f"{median_of(frames / peer)} frames/s: {median_of(peer / frames * FRAMES / ours)} x"
    )


@pytest.mark.filterwarnings("ignore")
def test_moving_table(film: Path, registration) -> None:
    references, _ = index_frames([film])
    bounds = bounds_of(FRAMES, 2)

    def reduce() -> None:
        reduce_moving_frames(references, registration, GRID, bounds, direction=(-1, 0))

    (ours, peer), (ours_cpu, peer_cpu) = take_turns(reduce, lambda: flirpy_reads(film, 60), rounds=5)
    print(
        f"\nmoving: {median_of(FRAMES / ours)} frames/s; "
        f"against flirpy Seq to temperature: {median_of(peer / 60 * FRAMES / ours)} x; {processor_line(ours_cpu, peer_cpu)}"
    )


@pytest.mark.filterwarnings("ignore")
def test_film_of_three_minutes(film: Path, registration) -> None:
    """5,000 frames in 20 cycles: what the set-up costs is spread over ten times as many frames."""
    references = played_again(index_frames([film])[0], 10)
    frames = len(references)
    bounds = bounds_of(frames, 20)
    still, moving, peer, limit = take_turns(
        lambda: reduce_frames(references, registration, GRID, bounds),
        lambda: reduce_moving_frames(references, registration, GRID, bounds, direction=(-1, 0)),
        lambda: flirpy_reads(film, 60),
        lambda: map_and_sum(film),
        rounds=5,
    )[0]
    print(
        f"\n{frames} frames: still {median_of(frames / still)} frames/s, {median_of(peer / 60 * frames / still)} x flirpy, "
        f"{median_of(limit / FRAMES * frames / still)} of summing the mapped file; moving {median_of(frames / moving)} frames/s, "
        f"{median_of(peer / 60 * frames / moving)} x"
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

    ours, reader = take_turns(reduce, plain)[0]
    print(
        f"\ncold: {median_of(FRAMES / ours)} frames/s, plain reader {median_of(FRAMES / reader)}: "
        f"{median_of(reader / ours)} of its speed"
    )


def test_jpegls_film_against_its_decoder_alone(film: Path, registration, tmp_path: Path) -> None:
    """By processor time: that of a bare loop over the streams in memory is the limit, whatever the number of cores."""
    frames = 120
    path = tmp_path / "a.csq"
    write_sequence(path, (reference.read() for reference in index_frames([film])[0][:frames]), encoding="jpegls")
    references, _ = index_frames([path])
    data = path.read_bytes()
    streams = [data[start : start + length] for start, length in map(samples_in_file, references)]
    assert (imagecodecs.jpegls_decode(streams[-1]) == references[-1].read_counts()).all()
    bounds = bounds_of(frames, 2)

    def reduce() -> None:
        index_frames([path])
        reduce_frames(references, registration, GRID, bounds)

    ours, bare, start = take_turns(
        reduce,
        lambda: [imagecodecs.jpegls_decode(stream) for stream in streams],
        lambda: reduce_frames(references[:2], registration, GRID, bounds),
        rounds=5,
    )[1]
    print(
        f"\nJPEG-LS: {1e3 * np.median(ours) / frames:.2f} ms of processor a frame with index and set-up; of the rate of imagecodecs alone "
        f"{median_of(bare / ours)}, without set-up {median_of(bare / (ours - start))}"
    )


def samples_in_file(reference: FrameReference) -> tuple[int, int]:
    """Place and length of the packed pixels of a frame in its file, bytes."""
    assert isinstance(reference, FlirFrameReference)
    return reference.segments[0][0] + reference.samples.offset, reference.samples.length


PEAK = """
import re, sys
from pathlib import Path
import numpy as np
from tests.benchmarks.test_speed_fields import bounds_of
from tests.thermography.plan_scene import DISCS, GRID
from thermography.fields.still import reduce_frames
from thermography.io.flir import index_frames
from thermography.radiometry.planck import calibrate
from thermography.registration.register import register
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


def played_again(references, times: int):
    """The frames of a film over and over, each time later: a long recording of which few frames are on disk."""
    length = len(references) * np.timedelta64(INTERVAL_MS, "ms")
    return [
        replace(reference, time=reference.time + turn * length) for turn in range(times) for reference in references
    ]


@pytest.mark.filterwarnings("ignore")
def test_two_workers_against_two_threads(film: Path, registration) -> None:
    """20,000 frames in 10 cycles; processor time is that of this process and of the workers together."""
    distributed = pytest.importorskip("distributed")
    references, _ = index_frames([film])
    references = played_again(references, 40)
    frames = len(references)
    bounds = bounds_of(frames, 10)
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50
    ) as cluster:
        address = cluster.scheduler_address
        workers = [psutil.Process(worker.pid) for worker in cluster.workers.values()]
        works = {
            "threads": lambda: reduce_frames(references, registration, GRID, bounds),
            "workers": lambda: reduce_frames(references, registration, GRID, bounds, scheduler=address),
        }
        wall: dict[str, list[float]] = {name: [] for name in works}
        processor: dict[str, list[float]] = {name: [] for name in works}
        fields = {}
        for _ in range(4):
            for name, work in works.items():
                began, begun = time.perf_counter(), processor_s(workers)
                fields[name] = work()
                wall[name].append(time.perf_counter() - began)
                processor[name].append(processor_s(workers) - begun)
    # The first turn of each compiles and fills the page cache.
    ratios = {
        what: np.array(values["threads"][1:]) / values["workers"][1:]
        for what, values in {"wall": wall, "processor": processor}.items()
    }
    print(
        f"\n{frames} frames, two workers: {median_of(frames / np.array(wall['workers'][1:]))} frames/s; of the speed of two threads "
        f"{median_of(ratios['wall'])} by wall time, {median_of(ratios['processor'])} by processor time "
        f"({median_of(np.array(processor['workers'][1:]))} s)"
    )
    for name in fields["threads"].variables:
        assert fields["threads"][name].values.tobytes() == fields["workers"][name].values.tobytes(), name


def processor_s(workers) -> float:
    """Processor time of this process and of others so far, s."""
    return time.process_time() + sum(sum(worker.cpu_times()[:2]) for worker in workers)


def test_planning_a_day_of_video() -> None:
    """What the client does before the first and for every task, for 756,000 frames (464 GB) of which nothing is on disk."""
    began = time.process_time()
    series = simulated(756_000, cycles=100)
    simulate_s, began = time.process_time() - began, time.process_time()
    blocks = cut_blocks(series, [RegistrationSpan(0, None)], block_s=10)
    stretches = cut_stretches(blocks, total=len(series))
    plan_s, began = time.process_time() - began, time.process_time()
    sent = sum(len(pickle.dumps([gather_frames(series, p.blocks) for p in stretch])) for stretch in stretches)
    send_s = time.process_time() - began
    print(
        f"\n756,000 frames: {len(stretches)} tasks planned in {plan_s:.2f} s of processor, described in {send_s:.1f} s and "
        f"{sent / 1e6:.0f} MB (inputs made and checked in {simulate_s:.1f} s)"
    )
    assert len(stretches) < 1000
