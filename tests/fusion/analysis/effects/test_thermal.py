"""Effects of heat, column by column against the equation of each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.analysis.alignment.readings import Readings, Series
from fusion.analysis.effects.effect import LAGS_MIN, Candidate, Prior, thermal_states
from fusion.analysis.effects.thermal import (
    angular_growth,
    axis_expansion,
    hidden_leads_mm,
    logged_influence,
    needs_field,
    pitch_error,
    quasi_static,
    reversal_drift,
    table_offset,
    thermal_lag,
    unseen_heat_source,
)
from tests.fusion.small_campaign import campaign, logged

POSITIONS = np.array([100.0, 200.0, 300.0, 400.0])
#: A table that warms by 1 K in 30 s, a load that is on from the start, sampled for the whole campaign.
RISE = np.arange(60.0)


def seen(*, step_s: float = 30.0) -> Readings:
    series = {
        "mean_rise": logged(RISE, "K", step_s=step_s),
        "axis_integral": Series(step_s * np.arange(60), RISE[:, None] * POSITIONS, "K mm"),
        "duty": logged(np.ones(60), "1"),
    }
    return campaign(series=series, drivers=("duty",))


def test_a_uniform_rise_expands_the_axis_in_proportion_to_the_position():
    readings = seen()
    (candidate,) = axis_expansion.candidates(readings, {}, None)
    # 1 ppm/K times 1 K times 1 m is 1 um.
    np.testing.assert_allclose(candidate.columns[:, 0], readings.seconds / 30.0 * readings.position_mm * 1e-3)
    assert candidate.units == ("ppm/K",) and candidate.event_s is None
    assert axis_expansion.prior == Prior(11.7, 2.0)


def test_the_table_shifts_all_positions_alike():
    readings = seen()
    (candidate,) = table_offset.candidates(readings, {}, None)
    np.testing.assert_allclose(candidate.columns[:, 0], readings.seconds / 30.0)
    assert candidate.units == ("um/K",)


def test_a_lag_delays_the_field_flat_along_the_axis_or_both_or_bends_the_bed():
    readings = seen()
    candidates = list(thermal_lag.candidates(readings, {}, None))
    # Four shapes, each of one body or two.
    assert len(candidates) == 2 * 4 * len(LAGS_MIN)
    flat, linear, both, bending = candidates[8:12]
    assert [c.parameters["time_constant_min"] for c in (flat, linear, both, bending)] == [7.5] * 4
    # A ramp is followed late by the time constant, once the start has died away as an exponential.
    t, tau = readings.seconds, 7.5 * 60.0
    expected = (t - tau * (1.0 - np.exp(-t / tau))) / 30.0
    sampled = t % 30.0 == 0.0
    np.testing.assert_allclose(flat.columns[sampled, 0], expected[sampled], atol=1e-9)
    np.testing.assert_allclose(linear.columns[sampled, 0], (expected * readings.position_mm * 1e-3)[sampled], atol=1e-9)
    np.testing.assert_array_equal(both.columns, np.column_stack([flat.columns, linear.columns]))
    assert (flat.units, linear.units, both.units) == (("um/K",), ("ppm/K",), ("um/K", "ppm/K"))
    assert [c.parameters["shape"] for c in (flat, linear, both)] == ["flat", "linear", "flat and linear"]
    # The lower side of a bed is late by the time constant times the rate of the ramp.
    tilt = (t / 30.0 - expected) * readings.position_mm / readings.span_mm
    np.testing.assert_allclose(bending.columns[sampled, 0], tilt[sampled], atol=1e-9)
    assert bending.parameters["shape"] == "bending" and bending.units == ("um/K",)
    # Behind a second body of a quarter of the time constant a ramp is late by both.
    behind = candidates[12]
    assert behind.parameters == {"time_constant_min": 7.5, "second_time_constant_min": 1.875, "shape": "flat"}
    assert 30.0 * behind.columns[-1, 0] == pytest.approx(t[-1] - 1.25 * tau, abs=60.0 * 7.5 * 0.05)


@pytest.mark.parametrize(("step_s", "shortest"), [(150.0, 5.0), (151.0, 7.5)])
def test_a_lag_shorter_than_two_frames_is_not_in_the_data(step_s, shortest):
    candidates = thermal_lag.candidates(seen(step_s=step_s), {}, None)
    assert min(candidate.parameters["time_constant_min"] for candidate in candidates) == shortest


def test_a_source_follows_its_driver_settled_or_with_a_memory_that_dies_away():
    readings = seen()
    candidates = list(unseen_heat_source.candidates(readings, {}, None))
    # Ten time constants, each of one body or two; three shapes; two starts.
    assert len(candidates) == 10 * 2 * 3 * 2
    first = candidates[:6]
    assert [(c.parameters["shape"], c.parameters["start"], c.beside) for c in first] == [
        ("flat", "settled", 0),
        ("flat", "free", 1),
        ("linear", "settled", 0),
        ("linear", "free", 1),
        ("flat and linear", "settled", 0),
        ("flat and linear", "free", 2),
    ]
    memory = np.exp(-readings.seconds / 300.0)
    share = readings.position_mm / 400.0
    # The load is constant, and the body settled before: its state is one from the start.
    expected = [
        [np.ones_like(memory)],
        [np.ones_like(memory), memory],
        [share],
        [share, share * memory],
        [np.ones_like(memory), share],
        [np.ones_like(memory), share, memory, share * memory],
    ]
    for candidate, columns in zip(first, expected, strict=True):
        np.testing.assert_allclose(candidate.columns, np.column_stack(columns), rtol=1e-12)
        assert candidate.parameters["follows"] == "duty" and candidate.parameters["time_constant_min"] == 5.0
        assert candidate.units == ("um",) * len(columns)
    assert "second_time_constant_min" not in first[0].parameters
    assert candidates[6].parameters["second_time_constant_min"] == pytest.approx(1.25)


def test_a_driver_with_a_unit_gives_its_coefficient_one():
    readings = campaign(series={"speed": logged(np.ones(60), "1/min")}, drivers=("speed",))
    free = list(unseen_heat_source.candidates(readings, {}, None))[5]
    assert free.units == ("um/(1/min)", "um/(1/min)", "um", "um")


def test_a_quasi_static_response_has_a_column_for_every_sensor():
    series = {
        "mean_rise": logged(RISE, "K"),
        "temperature bed": logged(RISE, "K"),
        "temperature column": logged(-2.0 * RISE, "K"),
    }
    readings = campaign(series=series)
    (candidate,) = quasi_static.candidates(readings, {}, None)
    np.testing.assert_allclose(candidate.columns, np.outer(readings.seconds / 30.0, [1.0, -2.0]))
    assert candidate.units == ("um/K", "um/K")


def test_what_is_missing_is_said():
    empty = campaign()
    assert needs_field(seen()) is None and needs_field(empty) == "the campaign holds no temperature of the table"
    for effect in (axis_expansion, table_offset, thermal_lag):
        assert effect.needs(empty) == "the campaign holds no temperature of the table"
        assert effect.needs(seen()) is None
    assert unseen_heat_source.needs(seen()) is None
    assert unseen_heat_source.needs(empty) == (
        "nothing that drives a heat source was logged; log duty, speed or load as [drivers]"
    )


# Geometry that follows a thermal state: squares, signs, waves, and the leads that evenly spaced targets confuse.


EVEN = tuple(np.arange(7) * 50.0 + 50.0)
UNEVEN = (50.0, 101.0, 150.0, 200.0, 250.0, 300.0, 350.0)


def warmed(positions: tuple[float, ...] = EVEN) -> Readings:
    series = {"mean_rise": logged(np.arange(90.0), "K"), "duty": logged(np.ones(90), "1")}
    return campaign(positions_mm=positions, series=series, drivers=("duty",))


def test_bending_grows_with_the_square_of_the_position_and_with_the_state():
    readings = warmed()
    candidates = list(angular_growth.candidates(readings, {}, None))
    states = list(thermal_states(readings, None))
    assert len(candidates) == len(states) == 22
    for candidate, (state, parameters) in zip(candidates, states, strict=True):
        np.testing.assert_allclose(candidate.columns[:, 0], state * (readings.position_mm / 350.0) ** 2)
        assert candidate.parameters == parameters
    assert candidates[0].units == ("um/(K)",) and candidates[-1].units == ("um",)


def test_a_reversal_moves_both_directions_apart_by_the_state():
    readings = warmed()
    candidate = next(iter(reversal_drift.candidates(readings, {}, None)))
    np.testing.assert_allclose(
        candidate.columns[:, 0], np.where(readings.sign > 0, 0.5, -0.5) * readings.seconds / 30.0
    )


def test_in_a_test_of_one_approach_a_reversal_that_drifts_is_a_common_drift_and_tried_beside_the_others():
    readings = campaign(both_directions=False)
    assert reversal_drift.needs(readings) is None
    candidates, states = list(reversal_drift.candidates(readings, {}, None)), list(thermal_states(readings, None))
    assert len(candidates) == len(states) > 0
    for candidate, (state, _) in zip(candidates, states, strict=True):
        np.testing.assert_array_equal(candidate.columns[:, 0], 0.5 * state)


def test_a_pitch_error_is_a_wave_along_the_axis_times_a_state():
    readings = warmed()
    candidates = list(pitch_error.candidates(readings, {}, None))
    # Two periods over the travel of 300 mm up to one in two spacings, in steps of half a period.
    assert list(dict.fromkeys(c.parameters["period_mm"] for c in candidates)) == pytest.approx([150.0, 120.0, 100.0])
    followed = [
        (c.parameters["follows"], c.parameters.get("start"), c.parameters["time_constant_min"]) for c in candidates
    ]
    assert followed[:6] == [
        ("mean_rise", None, 0.0),
        ("mean_rise", None, 40.0),
        ("duty", "settled", 40.0),
        ("duty", "at rest", 40.0),
        ("warm_up", None, 60.0),
        ("mean_rise", None, 0.0),
    ]
    first = candidates[0]
    phase = 2.0 * np.pi * readings.position_mm / 150.0
    expected = np.column_stack([np.cos(phase), np.sin(phase)]) * (readings.seconds / 30.0)[:, None]
    np.testing.assert_allclose(first.columns, expected, atol=1e-9)
    assert first.units == ("um/(K)", "um/(K)")


def test_uneven_targets_tell_leads_apart_down_to_four_millimetres():
    readings = warmed(UNEVEN)
    candidates = list(pitch_error.candidates(readings, {}, None))
    periods = list(dict.fromkeys(c.parameters["period_mm"] for c in candidates))
    np.testing.assert_allclose(periods, 300.0 / np.arange(2.0, 75.001, 0.5))
    # Each follows one course of every kind only.
    assert [(c.parameters["follows"], c.parameters.get("start")) for c in candidates[:3]] == [
        ("mean_rise", None),
        ("duty", "settled"),
        ("warm_up", None),
    ]
    assert len(candidates) == 3 * len(periods)
    assert candidates[0].parameters["possible_leads"] == "150 mm (targets unevenly spaced: no alias)"


@pytest.mark.parametrize(("shift", "even"), [(0.20, True), (0.30, False)])
def test_spacings_within_a_hundredth_count_as_even(shift, even):
    """A target that is off by d makes one spacing longer and the next shorter: a range of 2 d."""
    positions = (50.0, 100.0, 150.0 + shift, 200.0, 250.0, 300.0, 350.0)
    first = next(iter(pitch_error.candidates(warmed(positions), {}, None)))
    assert ("no alias" in str(first.parameters["possible_leads"])) is not even


def test_targets_lacking_on_a_grid_hide_its_leads_all_the_same():
    """Distances of 30 and 40 mm are multiples of 10 mm, where a lead just below 10 mm looks like a wave as long as the axis."""
    readings = warmed((0.0, 30.0, 70.0, 100.0, 130.0, 170.0, 200.0))
    periods = [c.parameters["period_mm"] for c in pitch_error.candidates(readings, {}, None)]
    assert (min(periods), hidden_leads_mm(readings)) == (pytest.approx(20.0), "10, 5, 3.33, 2.5, 2 mm")


def test_leads_that_look_alike_on_even_targets_are_listed():
    """Targets every 50 mm see a wave of 150 mm where 1 / lead is a multiple of 1 / 50 plus or minus 1 / 150."""
    first = next(iter(pitch_error.candidates(warmed(), {}, None)))
    leads = [float(lead) for lead in str(first.parameters["possible_leads"]).removesuffix(" mm").split(", ")]
    expected = sorted(
        (1 / f for k in range(30) for f in (k / 50 - 1 / 150, k / 50 + 1 / 150) if 1 / 50 <= f <= 1 / 2), reverse=True
    )
    assert leads == pytest.approx(expected, rel=5e-3)
    assert leads[:2] == pytest.approx([37.5, 30.0], abs=0.05) and leads[-1] >= 2.0


def test_a_closer_look_at_a_wave_stays_within_the_search():
    readings = warmed()
    chosen = Candidate(
        np.empty((0, 2)), {"period_mm": 120.0, "follows": "warm_up", "time_constant_min": 60.0}, ("um", "um")
    )
    near = {c.parameters["period_mm"] for c in pitch_error.candidates(readings, {}, chosen)}
    assert sorted(near) == pytest.approx(sorted(300.0 / (2.5 + np.linspace(-0.25, 0.25, 5))))
    widest = Candidate(
        np.empty((0, 2)), {"period_mm": 150.0, "follows": "warm_up", "time_constant_min": 60.0}, ("um", "um")
    )
    near = {c.parameters["period_mm"] for c in pitch_error.candidates(readings, {}, widest)}
    assert sorted(near) == pytest.approx(sorted(300.0 / (2.0 + np.linspace(0.0, 0.25, 3))))


def test_even_targets_hide_the_leads_that_divide_their_spacing():
    assert hidden_leads_mm(
        warmed()
    ) == "50, 25, 16.7, 12.5, 10, 8.33, 7.14, 6.25, 5.56, 5, 4.55, 4.17, 3.85, 3.57, " + (
        "3.33, 3.12, 2.94, 2.78, 2.63, 2.5, 2.38, 2.27, 2.17, 2.08, 2 mm"
    )
    assert hidden_leads_mm(warmed(tuple(np.arange(1, 8) * 100.0))).startswith("50, 33.3, 25, ")
    # Leads longer than 50 mm are no screw's.
    assert hidden_leads_mm(warmed(tuple(np.arange(1, 8) * 52.0))).startswith("26, 17.3, ")
    assert hidden_leads_mm(warmed(UNEVEN)) == ""
    # Targets closer than the shortest lead hide none.
    assert hidden_leads_mm(warmed(tuple(np.arange(1, 8) * 1.5))) == ""


def test_every_log_beside_field_and_loads_may_be_followed_late():
    wave = np.sin(np.arange(60) / 7.0)
    series = {
        "mean_rise": logged(wave, "K"),
        "duty": logged(wave, "1"),
        "air_pressure": logged(wave, "hPa"),
        "relative_humidity": logged(wave, "percent"),
    }
    readings = campaign(cycles=14, series=series, drivers=("duty",))
    offered = list(logged_influence.candidates(readings, {}, None))
    assert {one.parameters["follows"] for one in offered} == {"relative_humidity"}
    assert {one.parameters["shape"] for one in offered} == {"flat", "linear", "flat and linear"}
    late = readings.at(series["relative_humidity"].lagged(300.0))
    linear = next(one for one in offered if one.parameters["shape"] == "linear")
    np.testing.assert_allclose(linear.columns[:, 0], (late - late.mean()) * readings.share)
    # At 1000 hPa and 20 degC as at 0: a level is no change.
    lifted = replace(
        readings, series={**series, "relative_humidity": replace(series["relative_humidity"], values=1e3 + wave)}
    )
    for one, other in zip(offered, logged_influence.candidates(lifted, {}, None), strict=True):
        np.testing.assert_allclose(one.columns, other.columns, atol=1e-9)
    bare = replace(readings, series={name: one for name, one in series.items() if name != "relative_humidity"})
    assert logged_influence.needs(bare) == "no room, coolant or humidity was logged"
