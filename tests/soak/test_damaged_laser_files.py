"""Robustness of the laser readers: quoted in docs/measured.csv."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.interferometry.laser_mutations import fuzz

pytestmark = pytest.mark.slow


def test_twenty_thousand_damaged_files(tmp_path: Path) -> None:
    counts = fuzz(tmp_path, 20_000, seed=29)
    print(counts)
    # Every kind of file is both read and refused: the mutations neither spare nor destroy them all.
    assert all(taken > 50 and refused > 50 for taken, refused in counts.values())
