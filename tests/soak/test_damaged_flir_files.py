"""Robustness of the FLIR reader: quoted in docs/measured.csv."""

from __future__ import annotations

import resource
from pathlib import Path

import pytest

from tests.thermography.flir_mutations import fuzz

pytestmark = pytest.mark.slow


def test_two_hundred_thousand_damaged_files(tmp_path: Path) -> None:
    fuzz(tmp_path, 1000, seed=13)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    read, refused = fuzz(tmp_path, 200_000, seed=12)
    growth = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    print(f"200000 inputs: {read} frames read, {refused} refused, memory peak grew by {growth:.1f} MB")
    assert read > 50_000 and refused > 50_000
    # The reader refuses more than 2**24 pixels (34 MB) before it reads them; no small file may cost more.
    assert growth < 70
