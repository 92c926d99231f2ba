"""Logged tables whose times are text, with gaps, footers, second headers and clocks that go back: quoted in docs/measured.csv.

Every table is recognised, drafted and read, or refused with a message: rows that are read and rows that are named are all rows of the file,
each time is what its clock showed, and nothing takes longer or more memory than any other input (`test_damaged_inputs`).
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.soak.fuzz.timed_tables import kinds_of_timed_tables
from tests.soak.test_damaged_inputs import KEPT, judged

pytestmark = pytest.mark.long


def test_some_tables_whose_times_are_text(tmp_path: Path) -> None:
    """The quick form."""
    assert not judged(kinds_of_timed_tables(), tmp_path, inputs=60, seed=7)


@pytest.mark.slow
def test_twenty_thousand_tables_whose_times_are_text() -> None:
    inputs = int(os.environ.get("THERMOFUSE_FUZZ_INPUTS", "20000"))
    KEPT.mkdir(parents=True, exist_ok=True)
    assert not judged(
        kinds_of_timed_tables(), KEPT, inputs=inputs, seed=int(os.environ.get("THERMOFUSE_FUZZ_SEED", "2026"))
    )
