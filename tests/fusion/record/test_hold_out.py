"""Hold-out set and declared model of a record."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.record.blocks import RecordError, reduce_record
from fusion.record.hold_out import declare, hold_out
from tests.fusion.record_tables import record_of, runs_table, twin_table


def test_what_a_record_cannot_declare_is_refused():
    record = reduce_record(twin_table(seed=44))
    with pytest.raises(RecordError) as refused:
        declare(["dead_path"], record)
    assert str(refused.value) == (
        "declared effect 'dead_path' cannot be computed from a record; declare \"quasi_static\" (every displacement linear in the "
        "temperatures), the search tries the rest of the library"
    )


def test_the_last_fifth_of_the_time_is_held_out():
    record = record_of(np.zeros((101, 1)), np.zeros((101, 1)), block_s=360.0)
    train, description = hold_out(record)
    # Blocks from 180 s to 36180 s: four fifths of the way between lie at 28980 s, the middle of block 80.
    np.testing.assert_array_equal(train, np.arange(101) < 80)
    assert description.startswith("8.1 h to 10.1 h held out; coefficients from the time before, nothing re-zeroed")


def test_time_counts_and_not_the_number_of_blocks():
    record = record_of(np.zeros((100, 1)), np.zeros((100, 1)))
    record.seconds[50:] += 100 * 300.0
    train, _ = hold_out(record)
    # A pause of 100 blocks in the middle: the last fifth of the time holds forty of the blocks.
    assert train.sum() == 60


def test_every_displacement_is_declared_linear_in_the_temperatures():
    record = record_of(np.zeros((3, 1)), np.array([[20.0, 30.0], [21.0, 33.0], [22.0, 36.0]]))
    (term,) = declare(["quasi_static"], record)
    np.testing.assert_array_equal(term.candidate.columns, [[0.0, 0.0], [1.0, 3.0], [2.0, 6.0]])
    assert (term.effect, term.candidate.units) == ("quasi_static", ("um/K", "um/K"))
    assert declare([], record) == []


def test_runs_are_held_out_as_a_whole():
    train, description = hold_out(reduce_record(runs_table(0.0, 1.0, 2.0)))
    np.testing.assert_array_equal(train, np.arange(180) < 120)
    assert description.startswith(
        "run r3.csv held out; coefficients from runs r1.csv, r2.csv, every run from its own zero"
    )


def test_a_hold_out_set_without_a_displacement_is_refused():
    displacement = np.zeros((100, 1))
    displacement[70:] = np.nan
    with pytest.raises(RecordError, match="no displacement was measured in what is held out"):
        hold_out(record_of(displacement, np.zeros((100, 1))))
