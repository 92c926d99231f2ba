"""Frames assigned to cycles, and what is refused before a frame is read."""

import numpy as np
import pytest

from tests.thermography.plan_scene import START, record
from thermography.fields.inputs import NO_CYCLE, ReductionError, make_frame_series
from thermography.radiometry.planck import calibrate

SECOND = np.timedelta64(1, "s")


@pytest.fixture(scope="module")
def references(tmp_path_factory):
    return record(tmp_path_factory.mktemp("inputs") / "a.seq", [np.full((8, 8), 20.0 + i) for i in range(6)])


def series(references, bounds, **options):
    return make_frame_series(references, bounds, shape=(8, 8), override=lambda frame: frame.parameters, **options)


def test_the_start_of_a_cycle_belongs_to_it_and_its_end_does_not(references):
    bounds = START + np.array([[0, 2], [3, 5]]) * SECOND
    assert series(references, bounds).cycles.tolist() == [0, 0, NO_CYCLE, 1, 1, NO_CYCLE]
    assert series(references, START + np.array([1, 3, 4]) * SECOND).cycles.tolist() == [-1, 0, 0, 1, -1, -1]


def test_names_times_and_temperatures_of_frames(references):
    frames = series(references, START + np.array([0, 6]) * SECOND)
    assert len(frames) == 6
    assert frames.names(np.array([False, True, False, False, False, True])) == ["a.seq#1", "a.seq#5"]
    assert frames.mean_time(slice(1, 5)) == START + 2.5 * np.timedelta64(1000, "ms")
    np.testing.assert_array_equal(
        frames.temperature(3), calibrate(references[3].read().counts, references[3].parameters)
    )
    assert frames.correction_K.tolist() == [0.0] * 6


@pytest.mark.parametrize(
    ("bounds", "options", "message"),
    [
        ([], {}, "cycle_bounds is empty; give the start and end of at least one cycle"),
        ([0, 5, 3], {}, r"cycle 2 ends at .*, before it starts"),
        ([[0, 2], [1, 3]], {}, r"cycle 2 starts at .*, before cycle 1 ends"),
        ([0, 5], {"correction_K": np.full(6, np.nan)}, "it needs one finite value for each of 6 frames"),
    ],
)
def test_faults_are_named(references, bounds, options, message):
    with pytest.raises(ReductionError, match=message):
        series(references, START + np.array(bounds, int) * SECOND, **options)
