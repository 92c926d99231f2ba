"""Parameters for all frames and over time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.thermography.flir_mutations import PARAMETERS, TIME, frame
from thermography.radiometry.overrides import Overrides, ParameterLog
from thermography.radiometry.planck import RadiometryError, override, transmission

TIMES = TIME + np.array([0, 100, 300]).astype("timedelta64[s]")


def test_constants_replace_what_the_file_says() -> None:
    changed = Overrides({"emissivity": 0.97, "object_distance_m": 1.2})(frame())
    assert (changed.emissivity, changed.object_distance_m) == (0.97, 1.2)
    assert changed.planck_r1 == PARAMETERS.planck_r1
    assert Overrides()(frame()) is PARAMETERS


def test_logged_conditions_are_interpolated_to_each_frame_and_win() -> None:
    air = ParameterLog(TIMES, np.array([293.0, 295.0, 294.0]))
    overrides = Overrides({"atmospheric_temperature_K": 300.0, "emissivity": 0.9}, {"atmospheric_temperature_K": air})
    assert overrides(frame(seconds=0)).atmospheric_temperature_K == 293.0
    assert overrides(frame(seconds=25)).atmospheric_temperature_K == pytest.approx(293.5)
    assert overrides(frame(seconds=200)).atmospheric_temperature_K == pytest.approx(294.5)
    assert overrides(frame(seconds=300)).emissivity == 0.9


def test_a_log_is_not_extrapolated() -> None:
    air = ParameterLog(TIMES.astype("datetime64[ns]"), np.array([293.0, 295.0, 294.0]))
    with pytest.raises(
        RadiometryError,
        match=r"frame at 2026-03-09T06:38:48\.125: the log reaches from 2026-03-09T06:33:47\S* to 2026-03-09T06:38:47\S* only; extend it",
    ):
        Overrides(logs={"atmospheric_temperature_K": air})(frame(seconds=301))


@pytest.mark.parametrize(
    ("times", "values", "message"),
    [
        (TIMES, [1.0, 2.0], r"expected as many times as values, got \(3,\) and \(2,\)"),
        (TIMES[::-1], [1.0, 2.0, 3.0], "expected increasing times and finite values; sort the log and remove gaps"),
        (TIMES, [1.0, np.nan, 3.0], "expected increasing times and finite values"),
        (TIMES[[0, 1, 1]], [1.0, 2.0, 3.0], "expected increasing times and finite values"),
        (TIMES[:2], [1.0, 2.0, 3.0], r"expected as many times as values, got \(2,\) and \(3,\)"),
        (TIMES[None], [[1.0, 2.0, 3.0]], r"expected as many times as values, got \(1, 3\) and \(1, 3\)"),
        (TIMES[:0], [], r"expected as many times as values, got \(0,\) and \(0,\)"),
    ],
)
def test_a_broken_log_is_refused(times: np.ndarray, values: list[float], message: str) -> None:
    with pytest.raises(RadiometryError, match=message):
        ParameterLog(times, np.array(values))


def test_a_log_of_one_reading_holds_at_its_instant_alone() -> None:
    air = ParameterLog(TIMES[:1], np.array([293.0]))
    assert air.interpolate(TIMES[0]) == 293.0
    with pytest.raises(RadiometryError, match="only; extend it"):
        air.interpolate(TIMES[1])


def test_an_unknown_parameter_is_refused() -> None:
    with pytest.raises(RadiometryError, match="parameter 'humidity' is unknown"):
        Overrides({"humidity": 0.4})(frame())


@pytest.mark.parametrize(
    ("changes", "stored"),
    [
        ({"relative_humidity": 0.9}, 0.0),
        ({"object_distance_m": 5.0}, 0.0),
        ({"atmospheric_temperature_K": 310.0}, 0.0),
        ({"emissivity": 0.9}, 0.98),
        ({"relative_humidity": 0.9, "stored_transmission": 0.95}, 0.95),
    ],
)
def test_a_stored_transmission_goes_with_the_air_that_it_was_stored_for(
    changes: dict[str, float], stored: float
) -> None:
    kept = replace(PARAMETERS, stored_transmission=0.98)
    changed = override(kept, **changes)
    assert changed.stored_transmission == stored
    # Without a stored one, the transmission follows from the changed air.
    recomputed = transmission(override(replace(kept, stored_transmission=0.0), **changes))
    assert transmission(changed) == (recomputed if stored == 0.0 else stored)
