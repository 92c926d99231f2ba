"""Parameters for all frames, over time and per region."""

from __future__ import annotations

import numpy as np
import pytest

from tests.thermography.flir_mutations import PARAMETERS, TIME, frame
from thermography.radiometry.overrides import EmissivityRegion, Overrides, ParameterLog, emissivity_map
from thermography.radiometry.planck import RadiometryError

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
        RadiometryError, match=r"frame at 2026-03-09T06:38:48\.125: the log reaches from .* only; extend it"
    ):
        Overrides(logs={"atmospheric_temperature_K": air})(frame(seconds=301))


@pytest.mark.parametrize(
    ("times", "values", "message"),
    [
        (TIMES, [1.0, 2.0], r"expected as many times as values, got \(3,\) and \(2,\)"),
        (TIMES[::-1], [1.0, 2.0, 3.0], "expected increasing times and finite values; sort the log and remove gaps"),
        (TIMES, [1.0, np.nan, 3.0], "expected increasing times and finite values"),
    ],
)
def test_a_broken_log_is_refused(times: np.ndarray, values: list[float], message: str) -> None:
    with pytest.raises(RadiometryError, match=message):
        ParameterLog(times, np.array(values))


def test_an_unknown_parameter_is_refused() -> None:
    with pytest.raises(RadiometryError, match="parameter 'humidity' is unknown"):
        Overrides({"humidity": 0.4})(frame())


def test_regions_of_paint_foil_and_metal() -> None:
    x, y = np.meshgrid(np.arange(0.5, 10), np.arange(0.5, 5))
    foil = EmissivityRegion("foil", ((2, 1), (6, 1), (6, 4), (2, 4)), 0.1)
    patch = EmissivityRegion("paint on foil", ((3, 2), (4, 2), (4, 3), (3, 3)), 0.95)
    result = emissivity_map(x, y, [foil, patch], default=0.97)
    assert result.shape == (5, 10)
    assert (result == 0.1).sum() == 4 * 3 - 1
    assert result[2, 3] == 0.95 and result[0, 0] == 0.97
    np.testing.assert_array_equal(emissivity_map(x[0], y[:, :1], [foil, patch], default=0.97), result)


def test_impossible_regions_are_refused() -> None:
    with pytest.raises(RadiometryError, match=r"emissivity of foil: 97 is not a fraction above 0 and up to 1"):
        emissivity_map(0.0, 0.0, [EmissivityRegion("foil", ((0, 0), (1, 0), (0, 1)), 97.0)], default=0.9)
    with pytest.raises(RadiometryError, match="region line: expected at least 3 corners, got 2"):
        emissivity_map(0.0, 0.0, [EmissivityRegion("line", ((0, 0), (1, 0)), 0.9)], default=0.9)
