"""Flags: bits that do not collide; readings in measuring order, and the order of a pass."""

import numpy as np
import pytest

from interferometry.common import InterferometryError
from interferometry.deviations import (
    DUPLICATE,
    OUTLIER,
    REGISTRY,
    build_deviations,
    detect_out_of_order,
    resolution,
    resolution_um,
    set_flag,
    sort_readings,
)
from tests.interferometry.simulated_campaigns import simulate


def test_bits_are_distinct_and_explained(rng):
    masks = [flag.mask for flag in REGISTRY]
    assert sorted(masks) == [1 << at for at in range(len(masks))]
    attributes = simulate(rng, cycles=2)[0]["quality_flag"].attrs
    assert str(attributes["flag_meanings"]).split() == [flag.name for flag in REGISTRY]


def test_setting_a_flag_keeps_the_others_and_the_input(rng):
    deviations, _ = simulate(rng, cycles=2)
    where = np.zeros(deviations["deviation"].shape, dtype=bool)
    where[0, 0, 0] = True
    once = set_flag(deviations, OUTLIER, where)
    twice = set_flag(once, DUPLICATE, where)
    assert twice["quality_flag"].values[0, 0, 0] == OUTLIER.mask | DUPLICATE.mask
    assert not deviations["quality_flag"].any()
    assert not twice["quality_flag"].values[~where].any()


@pytest.mark.parametrize("direction", [0, 1])
def test_one_wrong_time_marks_itself_and_not_its_neighbours(rng, direction):
    deviations, _ = simulate(rng, cycles=2)
    deviations["time"].values[1, direction, 6] += np.timedelta64(20, "s")
    assert np.argwhere(detect_out_of_order(deviations)).tolist() == [[1, direction, 6]]


def test_readings_without_a_time_have_no_order(rng):
    deviations, _ = simulate(rng, cycles=2)
    deviations["time"].values[:] = np.datetime64("NaT")
    assert not detect_out_of_order(deviations).any()


def test_readings_are_sorted_by_time_and_those_without_value_or_time_left_out():
    deviation = np.array([[[1.0, 2.0], [4.0, 3.0]], [[np.nan, 5.0], [7.0, 6.0]]])
    time = np.datetime64("2026-03-09T06:30", "ns") + np.array(
        [[[0, 6], [20, 14]], [[30, 36], [50, 44]]], "timedelta64[s]"
    )
    time[1, 1, 0] = np.datetime64("NaT")
    readings = sort_readings(build_deviations([1, 2], [1, 2], np.array([0.0, 100.0]), deviation, time))
    assert readings["deviation"].values.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert readings["seconds"].values.tolist() == [0.0, 6.0, 14.0, 20.0, 36.0, 44.0]
    assert readings["sign"].values.tolist() == [1, 1, -1, -1, 1, -1]
    assert readings["position"].values.tolist() == [0.0, 100.0, 100.0, 0.0, 100.0, 100.0]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("position_mm", r"position_mm has shape \(4,\); 2 cycles, 2 directions and 3 targets need \(3,\)"),
        ("deviation_um", r"deviation_um has shape \(2, 2, 4\); .* need \(2, 2, 3\)"),
        ("time", r"time has shape \(2, 2, 4\); .* need \(2, 2, 3\)"),
    ],
)
def test_arrays_of_other_sizes_are_refused_with_their_shapes(name, message):
    def arrays(targets):
        shape = (2, 2, targets)
        time = np.full(shape, np.datetime64("NaT", "ns"))
        return {"position_mm": np.arange(float(targets)), "deviation_um": np.zeros(shape), "time": time}

    with pytest.raises(InterferometryError, match=message):
        build_deviations([1, 2], [1, 2, 3], **{**arrays(3), name: arrays(4)[name]})


@pytest.mark.parametrize("unit", [1.0, 1e-3, 25.4, 1e4])
@pytest.mark.parametrize(("step", "expected"), [(1.0, 1.0), (0.1, 0.1), (0.5, 0.5), (0.001, 0.001), (None, 0.0)])
def test_the_step_of_the_readings_is_found_in_every_unit(rng, unit, step, expected):
    """Also behind an offset, with gaps, and where no two differ by a single step."""
    values = rng.normal(40.0, 3.0, (20, 2, 5))
    values = values if step is None else step * np.rint(values / step)
    values[3:6, 1, 2] = np.nan
    # Numbers in another unit are rounded once more: 2e-16 of 50 in steps of 0.001.
    assert resolution(unit * values) == pytest.approx(unit * expected, rel=1e-9)
    assert resolution(unit * np.array([3.0, np.nan, 3.0])) == 0.0


def test_a_correction_does_not_change_in_what_steps_readings_were_recorded(rng):
    time = np.datetime64("2026-03-09T06:30", "ns") + np.arange(40).reshape(10, 2, 2) * np.timedelta64(1, "s")
    read = build_deviations(range(10), [1, 2], np.array([0.0, 9.0]), np.rint(rng.normal(0, 3, (10, 2, 2))), time)
    corrected = read.assign(deviation=read["deviation"] + rng.normal(0, 0.1, (10, 2, 2)))
    assert resolution_um(read) == resolution_um(corrected) == resolution_um(read.drop_vars("resolution")) == 1.0
    assert resolution_um(corrected.drop_vars("resolution")) == 0.0


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"cycles": [1, 1]}, r"cycles holds a value twice: \[1, 1\]"),
        ({"targets": [2, 2]}, "targets holds a value twice"),
        ({"position_mm": [10.0, 10.0]}, "position_mm holds a value twice"),
        ({"position_mm": [0.0, np.nan]}, "must be finite"),
        ({"deviation_um": np.full((2, 2, 2), np.inf)}, "must be finite"),
        ({"deviation_um": np.full((2, 2, 2), "1.5 um")}, "deviation_um holds what is no number"),
    ],
)
def test_arrays_that_make_no_test_are_refused(given, message):
    arrays = {"cycles": [1, 2], "targets": [1, 2], "position_mm": [0, 10], "deviation_um": np.zeros((2, 2, 2)).tolist()}
    time = np.full((2, 2, 2), "2026-03-09T06:30").tolist()
    assert build_deviations(**arrays, time=time)["time"].dtype == "datetime64[ns]"
    with pytest.raises(InterferometryError, match=message):
        build_deviations(**(arrays | given), time=time)
