"""Effects of heat, column by column against the equation of each."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.alignment.readings import Readings, Series
from fusion.effects.effect import Candidate, Prior
from fusion.effects.states import LAGS_MIN
from fusion.effects.thermal import (
    AXIS_EXPANSION,
    QUASI_STATIC_RESPONSE,
    TABLE_OFFSET,
    THERMAL_LAG,
    UNSEEN_HEAT_SOURCE,
    needs_field,
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
    (candidate,) = AXIS_EXPANSION.candidates(readings, {}, None)
    # 1 ppm/K times 1 K times 1 m is 1 um.
    np.testing.assert_allclose(candidate.columns[:, 0], readings.seconds / 30.0 * readings.position_mm * 1e-3)
    assert candidate.units == ("ppm/K",) and candidate.event_s is None
    assert AXIS_EXPANSION.prior == Prior(11.7, 2.0)


def test_the_table_shifts_all_positions_alike():
    readings = seen()
    (candidate,) = TABLE_OFFSET.candidates(readings, {}, None)
    np.testing.assert_allclose(candidate.columns[:, 0], readings.seconds / 30.0)
    assert candidate.units == ("um/K",)


def test_a_lag_delays_the_field_flat_along_the_axis_or_both():
    readings = seen()
    candidates = list(THERMAL_LAG.candidates(readings, {}, None))
    assert len(candidates) == 3 * len(LAGS_MIN)
    flat, linear, both = candidates[3:6]
    assert [c.parameters["time_constant_min"] for c in (flat, linear, both)] == [7.5] * 3
    # A ramp is followed late by the time constant, once the start has died away as an exponential.
    t, tau = readings.seconds, 7.5 * 60.0
    expected = (t - tau * (1.0 - np.exp(-t / tau))) / 30.0
    sampled = t % 30.0 == 0.0
    np.testing.assert_allclose(flat.columns[sampled, 0], expected[sampled], atol=1e-9)
    np.testing.assert_allclose(linear.columns[sampled, 0], (expected * readings.position_mm * 1e-3)[sampled], atol=1e-9)
    np.testing.assert_array_equal(both.columns, np.column_stack([flat.columns, linear.columns]))
    assert (flat.units, linear.units, both.units) == (("um/K",), ("ppm/K",), ("um/K", "ppm/K"))
    assert [c.parameters["shape"] for c in (flat, linear, both)] == ["flat", "linear", "flat and linear"]


@pytest.mark.parametrize(("step_s", "shortest"), [(150.0, 5.0), (151.0, 7.5)])
def test_a_lag_shorter_than_two_frames_is_not_in_the_data(step_s, shortest):
    candidates = THERMAL_LAG.candidates(seen(step_s=step_s), {}, None)
    assert min(candidate.parameters["time_constant_min"] for candidate in candidates) == shortest


def test_a_closer_look_at_a_lag_reaches_half_as_far_again():
    chosen = Candidate(np.empty((0, 1)), {"time_constant_min": 25.0, "shape": "flat"}, ("um/K",))
    near = [c.parameters["time_constant_min"] for c in THERMAL_LAG.candidates(seen(), {}, chosen)]
    assert (min(near), max(near)) == (pytest.approx(25.0 / 1.5), pytest.approx(37.5))


def test_a_source_follows_its_driver_settled_or_with_a_memory_that_dies_away():
    readings = seen()
    candidates = list(UNSEEN_HEAT_SOURCE.candidates(readings, {}, None))
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
    free = list(UNSEEN_HEAT_SOURCE.candidates(readings, {}, None))[5]
    assert free.units == ("um/(1/min)", "um/(1/min)", "um", "um")


def test_a_quasi_static_response_has_a_column_for_every_sensor():
    series = {
        "mean_rise": logged(RISE, "K"),
        "temperature bed": logged(RISE, "K"),
        "temperature column": logged(-2.0 * RISE, "K"),
    }
    readings = campaign(series=series)
    (candidate,) = QUASI_STATIC_RESPONSE.candidates(readings, {}, None)
    np.testing.assert_allclose(candidate.columns, np.outer(readings.seconds / 30.0, [1.0, -2.0]))
    assert candidate.units == ("um/K", "um/K")


def test_what_is_missing_is_said():
    empty = campaign()
    assert needs_field(seen()) is None and needs_field(empty) == "the campaign holds no temperature of the table"
    for effect in (AXIS_EXPANSION, TABLE_OFFSET, THERMAL_LAG):
        assert effect.needs(empty) == "the campaign holds no temperature of the table"
        assert effect.needs(seen()) is None
    assert UNSEEN_HEAT_SOURCE.needs(seen()) is None
    assert UNSEEN_HEAT_SOURCE.needs(empty) == (
        "nothing that drives a heat source was logged; log duty, speed or load as [drivers]"
    )
