"""Damaged files give an error that names file and place, or a frame of the declared size, and nothing else."""

from __future__ import annotations

from pathlib import Path

from tests.thermography.flir_mutations import fuzz


def test_damaged_files_are_refused_or_read_but_never_crash(tmp_path: Path) -> None:
    read, refused = fuzz(tmp_path, 2000, seed=11)
    assert read > 700 and refused > 700
