"""The map on films of known truth: a source that drives the axis, fields that drive nothing, and one warm-up."""

import numpy as np
import pytest
import xarray as xr

from fusion.attribution.attribute import ATTRIBUTABLE, NOT_SEPARABLE, CorrelationError, correlate
from tests.fusion import field_simulator as simulator


def peak(maps, channel="joint"):
    chosen = maps["statistic"].sel(channel=channel).values
    return np.unravel_index(int(np.nanargmax(chosen)), chosen.shape)


def thin(field):
    """Every second cell: the films are smooth over five, so nothing but time is saved."""
    return field[:, ::2, ::2]


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


def test_a_field_that_drives_nothing_is_not_blamed_though_every_plain_map_is_red(rng):
    made = simulator.null_session("rw", rng)
    maps = correlate(made.fused, thin(made.field), draws=99, checks=50)
    assert maps.attrs["verdict"] == "not attributable"
    assert float(np.abs(maps["naive_correlation"]).max()) > 2 * simulator.NAIVE_LIMIT


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


def test_the_map_says_what_it_could_have_found(rng):
    made = simulator.null_session("rw", rng)
    maps = correlate(made.fused, thin(made.field), draws=99, checks=99)
    assert 0.0 <= float(maps["false_alarm_rate"]) <= 0.2
    assert maps["unexplained_drift"].attrs["units"] == "um"
    # The drift that was put in: unit random walks of 100 steps scaled to 3 um rms; a walk's rms fixes its hourly size to a factor of 2-3.
    common = float(maps["unexplained_drift"].sel(channel="common"))
    assert 0.4 < common < 8.0
    detectable = maps["detectable_sensitivity"].sel(channel="common").values
    assert (detectable[np.isfinite(detectable)] > 3 * maps["sensitivity_u"].sel(channel="common").values.min()).all()


def test_an_effect_of_the_detectable_size_is_found_in_most_sessions():
    found = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        made = simulator.driven_session(rng, source=0, um_per_unit=0.0)
        coarse = made.field[:, ::4, ::4]
        quiet = correlate(made.fused, coarse, draws=99, checks=1)
        row, column = 1, 2
        size = float(quiet["detectable_sensitivity"].sel(channel="common")[row, column])
        rise = coarse[:, row, column].values
        loud = made.fused.copy()
        loud["deviation"] = loud["deviation"] + xr.DataArray(size * rise, dims="cycle")
        again = correlate(loud, coarse, draws=99, checks=1)
        found += bool((again["p_value"].sel(channel="common") <= 0.05).any())
    # Promised: 80 %. Fewer than 4 of 8 has probability 0.01 then.
    assert found >= 4


def test_masked_cells_stay_blank_and_short_gaps_are_bridged(rng):
    made = simulator.null_session("rw", rng)
    field = thin(made.field).copy()
    field[:, 0, 0] = np.nan
    field[10:13, 1, 1] = np.nan
    maps = correlate(made.fused, field, draws=19, checks=1)
    assert np.isnan(maps["statistic"][:, 0, 0]).all()
    assert np.isfinite(maps["statistic"][:, 1, 1]).all()


def test_every_target_can_be_mapped_by_itself(rng):
    made = simulator.driven_session(rng, source=0)
    few = made.fused.isel(target=slice(0, 16, 8))
    maps = correlate(few, thin(made.field)[:, ::2, ::2], draws=39, checks=1, per_target=True)
    assert list(maps["targets/series"].values) == ["positive 1", "positive 9", "negative 1", "negative 9"]
    # Target 1 has -1 of the slope: common and proportional cancel there, target 9 sees the common part.
    assert float(maps["targets/p_value"].sel(series="positive 9").min()) <= 0.05
    assert float(maps["targets/statistic"].sel(series="positive 1").max()) < float(
        maps["targets/statistic"].sel(series="positive 9").max()
    )


def test_heavy_tails_do_not_raise_false_alarms(rng):
    temperatures = simulator.film("rw", rng)
    drift = 3.0 * simulator.smooth_series("rw", rng)
    made = simulator.session(temperatures, drift, 0.5 * drift, rng, heavy_tails=True)
    assert correlate(made.fused, thin(made.field), draws=99, checks=1).attrs["verdict"] == "not attributable"


def test_progress_ends_at_one(rng):
    made = simulator.null_session("rw", rng)
    seen: list[float] = []
    correlate(made.fused, thin(made.field), draws=9, checks=1, progress=seen.append)
    assert seen[-1] == 1.0


def test_wrong_dims_are_refused(rng):
    made = simulator.null_session("rw", rng)
    with pytest.raises(CorrelationError, match=r"field has dims \('y', 'x', 'time'\); expected \('time', 'y', 'x'\)"):
        correlate(made.fused, made.field.transpose("y", "x", "time"))


def test_a_film_without_seen_cells_is_refused(rng):
    made = simulator.null_session("rw", rng)
    with pytest.raises(CorrelationError, match="no plan cell is seen in at least 80 % of the frames"):
        correlate(made.fused, made.field * np.nan)
