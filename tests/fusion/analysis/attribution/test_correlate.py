"""The map on films of known truth: a source that drives the axis, fields that drive nothing, and one warm-up."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.attribution.correlate import (
    ATTRIBUTABLE,
    NOT_SEPARABLE,
    CorrelationError,
    area_of,
    correlate,
    find_source,
    mode_cells,
    piece_with_peak,
)
from fusion.results.parts import AreaPart
from tests.fusion import field_simulator as simulator


def peak(maps, channel="joint"):
    chosen = maps["statistic"].sel(channel=channel).values
    return np.unravel_index(int(np.nanargmax(chosen)), chosen.shape)


def thin(field):
    """Every second cell: the films are smooth over five, so nothing but time is saved."""
    return field[:, ::2, ::2]


@pytest.mark.long
def test_a_source_that_drives_the_axis_is_found_where_it_is(rng):
    made = simulator.driven_session(rng, source=0)
    before = made.fused.copy(deep=True), made.field.copy(deep=True)
    maps = correlate(made.fused, made.field, draws=99, checks=50)
    assert maps.attrs["verdict"] == "attributable"
    row, column = peak(maps)
    assert simulator.distance_cells(row, column, 0) <= 5
    assert float(maps["p_value"].sel(channel="joint")[row, column]) == pytest.approx(0.01)
    assert int(maps["verdict"].sel(channel="joint")[row, column]) == ATTRIBUTABLE
    # 3 um per unit of a source that warms its own place by 3 K: 1 um/K at its centre, more on the halo where the rise is smaller.
    assert float(maps["sensitivity"].sel(channel="common")[row, column]) > 0.8
    assert float(maps["p_value"].sel(channel="reversal").min()) > 0.05
    xr.testing.assert_identical(before[0], made.fused)
    xr.testing.assert_identical(before[1], made.field)


@pytest.fixture(scope="module")
def null_maps(null):
    return correlate(null.fused, thin(null.field), draws=99, checks=99)


def test_a_field_that_drives_nothing_is_not_blamed_though_every_plain_map_is_red(null_maps):
    assert null_maps.attrs["verdict"] == "not attributable"
    assert float(np.abs(null_maps["naive_correlation"]).max()) > 2 * simulator.NAIVE_LIMIT


def test_the_map_says_what_it_could_have_found(null_maps):
    assert 0.0 <= float(null_maps["false_alarm_rate"]) <= 0.2
    assert null_maps["unexplained_drift"].attrs["units"] == "um"
    # The drift that was put in: unit random walks of 100 steps scaled to 3 um rms; a walk's rms fixes its hourly size to a factor of 2-3.
    common = null_maps.to_dataset().sel(channel="common")
    assert 0.4 < float(common["unexplained_drift"]) < 8.0
    # Found four times of five is more than what can just be told from nothing.
    half = (common["sensitivity_high"] - common["sensitivity_low"]) / 2.0
    assert float(common["detectable_sensitivity"].median()) > float(half.median()) > 0.0


def test_one_warm_up_is_not_separable_whatever_the_drift(rng):
    made = simulator.null_session("warm", rng)
    maps = correlate(made.fused, thin(made.field), draws=99, checks=50)
    assert maps.attrs["verdict"] == "not separable"
    assert maps.attrs["excitation"] == "warm-up only"
    assert (maps["verdict"] == NOT_SEPARABLE).all()
    assert float(maps["warm_up_share"]) > 0.99


def test_a_small_switched_part_beside_a_warm_up_must_carry_the_evidence(rng):
    warm = simulator.source_responses("warm", rng)[1]
    switched = simulator.source_responses("duty", rng)[1]
    temperatures = simulator.film("duty", rng, warm + 0.4 * switched)
    made = simulator.session(temperatures, 3.0 * warm[:, 0] + 1.2 * switched[:, 0], 2.0 * warm[:, 0], rng)
    maps = correlate(made.fused, thin(made.field), draws=99, checks=1)
    assert maps.attrs["excitation"] == "mostly warm-up"
    assert maps.attrs["verdict"] == "attributable"
    row, column = peak(maps, "common")
    assert simulator.distance_cells(2 * row, 2 * column, 0) <= 7


def test_masked_cells_stay_blank_short_gaps_are_bridged_and_progress_ends_at_one(null):
    seen: list[float] = []
    field = thin(null.field).copy()
    field[:, 0, 0] = np.nan
    field[10:13, 1, 1] = np.nan
    maps = correlate(null.fused, field, draws=19, checks=1, progress=seen.append)
    assert seen[-1] == 1.0
    assert np.isnan(maps["statistic"][:, 0, 0]).all()
    assert np.isfinite(maps["statistic"][:, 1, 1]).all()


def test_every_target_is_mapped_by_itself(maps):
    assert maps["targets/p_value"].sizes["series"] == 32
    assert float(maps["targets/p_value"].sel(series="positive 16").min()) <= 0.05
    # Target 1 has -1 of the slope: common and proportional cancel there and add up at target 16.
    largest = maps["targets/statistic"].max(["y", "x"])
    assert float(largest.sel(series="positive 1")) < float(largest.sel(series="positive 16"))


def test_wrong_dims_and_a_film_without_seen_cells_are_refused(null):
    with pytest.raises(CorrelationError, match=r"fields has 'frame_temperature' over \(time, y\) instead of"):
        correlate(null.fused, null.field.isel(x=0, drop=True))
    with pytest.raises(CorrelationError, match="no plan cell is seen in at least 80 % of the frames"):
        correlate(null.fused, null.field * np.nan)


# Places as areas: the piece of cells with the peak, and the rectangle around it.


@pytest.fixture
def plan():
    return xr.Dataset(coords={"y": [5.0, 15.0, 25.0], "x": [5.0, 15.0, 25.0, 35.0]})


def test_the_rectangle_ends_at_the_edges_of_the_outermost_cells(plan):
    cells = np.zeros((3, 4), bool)
    cells[1, 1] = cells[2, 2] = True
    assert area_of(cells, plan) == AreaPart(x_low_mm=10.0, x_high_mm=30.0, y_low_mm=10.0, y_high_mm=30.0)
    assert area_of(np.zeros((3, 4), bool), plan) is None


def test_only_cells_that_are_connected_to_the_peak_belong_to_it():
    strength = np.array([[1.0, 0.6, 0.0, 0.9], [0.0, 0.0, 0.7, 0.0]])
    piece = piece_with_peak(strength, strength > 0.5)
    # Cells that touch at a corner are connected: all but none here.
    assert piece.sum() == 4
    apart = np.array([[1.0, 0.6, 0.0, 0.9]])
    np.testing.assert_array_equal(piece_with_peak(apart, apart > 0.5), [[True, True, False, False]])


def test_a_mode_reaches_to_half_of_its_peak_and_cells_that_were_not_seen_are_outside():
    pattern = np.array([[0.4, -1.0, -0.5, np.nan, 0.8]])
    np.testing.assert_array_equal(mode_cells(pattern), [[False, True, True, False, False]])


# The leading source of fields of known truth, and what is recommended next.


def test_the_answer_comes_from_the_mode_of_the_right_source(maps):
    source = find_source(maps)
    assert (maps.attrs["verdict"], source.kind) == ("attributable", "mode")
    assert simulator.distance_cells(source.y_mm / 10 - 0.5, source.x_mm / 10 - 0.5, 1) <= 5
    assert source.equivalent_places_mm == ()
    assert (
        40.0
        < np.hypot(source.area.x_high_mm - source.area.x_low_mm, source.area.y_high_mm - source.area.y_low_mm)
        < 240.0
    )
    assert float(np.nanmax(maps["modes/pattern"])) == pytest.approx(1.0)


def test_places_that_warm_alike_are_named_as_equal(rng):
    """Two halos of one switched source: nothing can tell which of them drives the axis."""
    course = simulator.source_responses("duty", rng)[1][:, 1]
    row, column = np.mgrid[: simulator.ROWS, : simulator.COLUMNS]
    halos = sum(np.exp(-((row - r) ** 2 + (column - c) ** 2) / 50.0) for r, c in simulator.SOURCES[1:])
    film = 3.0 * np.multiply.outer(course, halos) + 0.03 * rng.standard_normal((simulator.CYCLES, *row.shape))
    made = simulator.session(film, 3 * course, 3 * course, rng)
    maps = correlate(made.fused, made.field[:, ::2, ::2], draws=99, checks=1)
    source = find_source(maps)
    assert maps.attrs["verdict"] == "attributable"
    places = [(source.x_mm, source.y_mm), *source.equivalent_places_mm]
    for r, c in simulator.SOURCES[1:]:
        assert min(np.hypot(x - (10 * c + 5), y - (10 * r + 5)) for x, y in places) <= 50.0


# Attribution and diagnosis on the twin, whose heat, drift and readings share nothing with the analysis.
