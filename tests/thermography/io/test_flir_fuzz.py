"""Damaged files give an error that names file and place, or a frame of the declared size, and nothing else."""

from __future__ import annotations

import resource
from pathlib import Path

import numpy as np
import pytest

from tests.thermography.flir_mutations import mutate, seeds
from thermography.io.flir import index_frames, read_frame
from thermography.io.frame import FlirFormatError


def _read_everything(path: Path) -> tuple[int, int]:
    """Read a file in both ways; return how many frames were read and how many refused."""
    read = refused = 0
    try:
        assert read_frame(path).counts.ndim == 2
        read += 1
    except FlirFormatError as error:
        assert str(path) in str(error) and "at 0x" in str(error) and "expected" in str(error), str(error)
        refused += 1
    frames, rejected = index_frames([path])
    refused += len(rejected)
    assert all(str(path) in each.reason for each in rejected)
    for frame in frames:
        try:
            counts = frame.read().counts
        except FlirFormatError:
            refused += 1
            continue
        assert counts.dtype == np.uint16 and counts.shape == frame.shape
        read += 1
    return read, refused


def _fuzz(folder: Path, inputs: int, seed: int) -> tuple[int, int]:
    """Read damaged copies of intact files, and every tenth time random bytes; return frames read and refused."""
    rng = np.random.default_rng(seed)
    intact = seeds(folder)
    path = folder / "damaged"
    totals = np.zeros(2, int)
    for index in range(inputs):
        data = mutate(intact[index % len(intact)], rng) if index % 10 else rng.bytes(int(rng.integers(2000)))
        path.write_bytes(data)
        totals += _read_everything(path)
    return int(totals[0]), int(totals[1])


def test_damaged_files_are_refused_or_read_but_never_crash(tmp_path: Path) -> None:
    read, refused = _fuzz(tmp_path, 2000, seed=11)
    assert read > 700 and refused > 700


@pytest.mark.slow
def test_two_hundred_thousand_damaged_files(tmp_path: Path) -> None:
    _fuzz(tmp_path, 1000, seed=13)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    read, refused = _fuzz(tmp_path, 200_000, seed=12)
    growth = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    print(f"200000 inputs: {read} frames read, {refused} refused, memory peak grew by {growth:.1f} MB")
    assert read > 50_000 and refused > 50_000
    # The reader refuses more than 2**24 pixels (34 MB) before it reads them; no small file may cost more.
    assert growth < 70
