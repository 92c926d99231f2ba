"""Speeds of reading and calibrating, as ratios to named readers measured in the same run, on one core.

Reproduces figures of docs/measured.csv, on reading and calibrating.
"""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import flyr
import numpy as np
import pytest
import xarray as xr
from flirpy.io.seq import Seq

from tests.benchmarks.test_speed_fields import median_of, take_turns
from tests.thermography.flir_mutations import frame
from thermography.io.flir import index_frames, read_frame
from thermography.io.flir_writer import write_jpeg, write_sequence
from thermography.io.frame import FrameReference
from thermography.io.sequence import FlirFrameReference, call_by_threads, usable_threads
from thermography.io.xarray_backend import FlirBackendEntrypoint
from thermography.radiometry.planck import calibrate

pytestmark = pytest.mark.slow

SC660 = "gtatters__Thermimage/inst/extdata/IR_2412.jpg"
C3X = "frkatona__ThermalImageFitter/Nov19/FLIR2167.jpg"


@pytest.fixture(autouse=True)
def one_core():
    import cv2

    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    yield
    cv2.setNumThreads(threads)


def _seconds(work: Callable[[], object], repeats: int) -> float:
    """Return the time of one call, from a few calls in a row."""
    start = time.perf_counter()
    for _ in range(repeats):
        work()
    return (time.perf_counter() - start) / repeats


def _compare(
    what: str, ours: Callable[[], object], theirs: Callable[[], object], *, peer: str, repeats: int = 1, frames: int = 1
) -> None:
    """Print frames per second and their ratio: the median over rounds in which both take turns, for the machine may be shared."""
    times = np.array([(_seconds(ours, repeats), _seconds(theirs, 1)) for _ in range(9)]) / frames
    ratio = np.median(times[:, 1] / times[:, 0])
    a, b = 1 / np.median(times, axis=0)
    print(f"\n{what}: {a:.0f} frames/s, {peer} {b:.1f} frames/s, ratio {ratio:.1f}")


def _ours(path: Path) -> np.ndarray:
    read = read_frame(path)
    return calibrate(read.counts, read.parameters)


@pytest.mark.real_data
@pytest.mark.parametrize("payload", ["raw", "png 640 x 480", "png 128 x 96"])
def test_jpeg_to_temperature_against_flyr(real_file, tmp_path: Path, payload: str) -> None:
    path = real_file(C3X if payload.endswith("96") else SC660)
    if payload == "png 640 x 480":
        original = read_frame(path)
        path = tmp_path / "a.jpg"
        write_jpeg(path, original.counts, original.parameters, original.time, encoding="png")
    # The two agree to what the half-path formula errs, 0.1 K near ambient and 0.2 K at 97 degC: both do the whole work.
    np.testing.assert_allclose(_ours(path), flyr.unpack(str(path)).celsius, atol=0.1, rtol=0.003)
    _compare(f"R-JPEG {payload}", lambda: _ours(path), lambda: flyr.unpack(str(path)).celsius, peer="flyr", repeats=30)


@pytest.mark.real_data
@pytest.mark.parametrize("payload", ["raw", "png 640 x 480", "png 128 x 96"])
def test_folder_of_jpegs_to_temperature_against_flyr(real_file, tmp_path: Path, payload: str) -> None:
    """From a list of files to the warmest pixel of each, by threads, and to one array of temperatures; flyr reads ten of the files."""
    files, theirs = 100, 10
    original = read_frame(real_file(C3X if payload.endswith("96") else SC660))
    paths = [tmp_path / f"{number:03}.jpg" for number in range(files)]
    for second, path in enumerate(paths):
        time_then = original.time + np.timedelta64(second, "s")
        write_jpeg(path, original.counts, original.parameters, time_then, encoding=payload[:3])  # type: ignore[arg-type]
    threads = usable_threads()

    def warmest(reference: FrameReference) -> float:
        return float(calibrate(reference.read_counts(), reference.parameters).max())

    works: list[Callable[[], object]] = [
        lambda: list(call_by_threads(warmest, index_frames(paths)[0], threads)),
        lambda: xr.open_dataset(paths, engine=FlirBackendEntrypoint)["temperature"].load(),
        lambda: index_frames(paths),
        lambda: [flyr.unpack(str(path)).celsius.max() for path in paths[:theirs]],
    ]
    wall, processor = take_turns(*works, rounds=7)
    ratios, of_processor = (times[3] / theirs * files / times[:2] for times in (wall, processor))
    each, whole = (f"{median_of(ratios[i])} x flyr, by processor time {median_of(of_processor[i])} x" for i in range(2))
    print(
        f"\n{files} R-JPEG {payload}, {threads} threads: {median_of(files / wall[0])} frames/s, {each}; "
        f"as one array {whole}; headers {1e6 * np.median(processor[2]) / files:.0f} us of processor a file"
    )


def test_sequence_to_temperature_against_flirpy(tmp_path: Path) -> None:
    path = tmp_path / "a.seq"
    write_sequence(path, (frame(480, 640, seconds=second) for second in range(40)))
    references, _ = index_frames([path])
    theirs_open = Seq(str(path))

    def ours() -> None:
        for each in references:
            calibrate(each.read_counts(), each.parameters)

    def theirs() -> None:
        for index in range(len(theirs_open)):
            theirs_open[index].get_radiometric_image()

    _compare("SEQ to temperature", ours, theirs, peer="flirpy", frames=40)


def test_opening_ten_thousand_frames_against_flirpy(tmp_path: Path) -> None:
    path = tmp_path / "a.seq"
    small = frame(48, 64)
    write_sequence(path, (replace(small, time=small.time + np.timedelta64(second, "s")) for second in range(10_000)))
    _open(path)
    rounds = np.array(
        [
            (
                _seconds(lambda: _open(path), 3),
                _seconds(lambda: index_frames(path), 3),
                _seconds(lambda: Seq(str(path)), 1),
            )
            for _ in range(7)
        ]
    )
    opened, indexed, theirs = np.median(rounds, axis=0)
    ratios = np.median(rounds[:, 2:] / rounds[:, :2], axis=0)
    print(
        f"\nopening 10,000 frames: {opened:.3f} s as a Dataset, {indexed:.3f} s as a list with all headers, "
        f"flirpy {theirs:.2f} s with positions only: {ratios[0]:.1f} and {ratios[1]:.1f} times"
    )


OPENED = """
import re, sys, time
from pathlib import Path
from thermography.io.flir import index_frames
start = time.perf_counter()
frames, rejected = index_frames(sys.argv[1])
seconds = time.perf_counter() - start
assert len(frames) == int(sys.argv[2]) and not rejected
print(seconds, int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) / 1024)
"""


@pytest.mark.parametrize("frames", [10_000, 756_000])
def test_opening_a_day_of_video(tmp_path: Path, frames: int) -> None:
    """For the first time and again; cold, the headers are not in memory."""
    path = _sparse_video(tmp_path, frames)
    command = [sys.executable, "-c", OPENED, str(path), str(frames)]
    size = path.stat().st_size
    for cold, rounds in ((False, 3), (True, 1)):
        turns = []
        for turn in range(rounds):
            for _ in ("for the first time", "again"):
                if cold:
                    _drop(path)
                kept = {**os.environ, "THERMOFUSE_CACHE": str(tmp_path / f"{cold} {turn}")}
                done = subprocess.run(command, capture_output=True, text=True, check=True, env=kept)
                turns.append(list(map(float, done.stdout.split())))
        first, again = np.median(np.array(turns).reshape(rounds, 2, 2), axis=0)
        print(
            f"\nopening {frames} frames, {size / 1e9:.0f} GB, {'cold' if cold else 'warm'}: {first[0]:.2f} s, again {again[0]:.2f} s, "
            f"peak memory {first[1]:.0f} and {again[1]:.0f} MB"
        )
        assert max(first[1], again[1]) < 600
    path.unlink()


def _drop(path: Path) -> None:
    """Drop a file from the system's memory."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def _sparse_video(folder: Path, frames: int) -> Path:
    """Write a sequence of 640 x 480 pixels at 30 Hz whose headers are there and whose pixels are holes, 7 kB per frame on the disk."""
    one = folder / "one.seq"
    write_sequence(one, [replace(frame(1, 1), counts=np.zeros((480, 640), np.uint16))])
    reference = index_frames(one)[0][0]
    assert isinstance(reference, FlirFrameReference)
    data = one.read_bytes()
    head, seconds_at = bytearray(data[: reference.samples.offset]), reference.camera_info_place[0] + 0x384
    # The checksum of the pixels stays that of zeros, which holes are.
    begin = int(reference.time.astype("datetime64[ms]").astype(int))
    path = folder / "day.seq"
    with path.open("wb") as file:
        file.truncate(frames * len(data))
        for number in range(frames):
            seconds, milliseconds = divmod(begin + number * 1000 // 30, 1000)
            struct.pack_into("<2I", head, seconds_at, seconds, milliseconds)
            file.seek(number * len(data))
            file.write(head)
    return path


def _open(path: Path) -> xr.Dataset:
    return xr.open_dataset(path, engine=FlirBackendEntrypoint)


def test_calibration_against_reading_the_counts() -> None:
    counts = frame(480, 640).counts
    parameters = frame(1, 1).parameters
    _compare(
        "counts to temperature",
        lambda: calibrate(counts, parameters),
        counts.copy,
        peer="copy of the counts",
        repeats=20,
    )
