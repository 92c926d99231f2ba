"""Uncertainty of temperatures and rises, compared with Monte Carlo simulations of the measurement."""

import itertools
from dataclasses import asdict, replace

import numpy as np
import pytest

from tests.thermography.flir_mutations import PARAMETERS
from tests.thermography.rise_budget import temperature_rise_uncertainty
from thermography.common import ThermographyError
from thermography.io.frame import CameraParameters
from thermography.radiometry.planck import RadiometryError, counts_from_temperature, override, temperature_from_counts
from thermography.radiometry.uncertainty import (
    InputUncertainty,
    common_contributions,
    monte_carlo_ratio,
    rise_scale_contributions,
    temperature_uncertainty,
)

pytestmark = pytest.mark.long

DRAWS = 20_000
#: The Monte Carlo standard deviation of 20,000 draws scatters by 0.5 %; 3 % also holds what first order leaves out.
TOLERANCE = 0.03
INPUTS = InputUncertainty(emissivity=0.005, window_transmission=0.01, window_temperature_K=1.0)


def _scene(emissivity: float, window: bool) -> CameraParameters:
    changes = {"emissivity": emissivity, "object_distance_m": 1.2, "reflected_temperature_K": 295.15}
    if window:
        changes |= {"window_transmission": 0.85, "window_temperature_K": 296.0}
    return override(PARAMETERS, **changes)


def _inputs(window: bool) -> InputUncertainty:
    return INPUTS if window else replace(INPUTS, window_transmission=0.0, window_temperature_K=0.0)


def _draw(parameters: CameraParameters, inputs: InputUncertainty, rng: np.random.Generator) -> list[CameraParameters]:
    """Draw possible true parameters, uniformly distributed; fractions stay between 0 and 1."""
    names = [name for name in asdict(inputs) if name in asdict(parameters)]
    drawn = []
    for _ in range(DRAWS // 10):
        changes = {}
        for name in names:
            u, value = getattr(inputs, name), getattr(parameters, name)
            changes[name] = float(np.clip(value + u * rng.uniform(-1, 1) * 3**0.5, 0, 1 if 0 < value < 1 else np.inf))
        drawn.append(override(parameters, **changes))
    return drawn


def _simulate(
    temperatures: np.ndarray, parameters: CameraParameters, inputs: InputUncertainty, rng: np.random.Generator
) -> np.ndarray:
    """Return the standard deviation of simulated temperatures: wrong parameters, noise, rounding, offset of the camera."""
    black = override(parameters, emissivity=1.0, object_distance_m=0.0, window_transmission=1.0)
    counts_per_kelvin = np.diff(counts_from_temperature([30.0, 30.001], black))[0] / 0.001
    true = counts_from_temperature(temperatures, parameters)
    measured = []
    for drawn in _draw(parameters, inputs, rng):
        noise = rng.normal(size=(10, len(temperatures)))
        offset, scale = rng.normal(size=(2, 10, 1))
        # The camera errs in what it reads of a black body.
        reading = temperature_from_counts(true, black)
        read = reading + inputs.camera_offset_K * offset + inputs.camera_scale * scale * reading
        counts = np.rint(counts_from_temperature(read, black) + inputs.netd_K * counts_per_kelvin * noise)
        measured.append(temperature_from_counts(counts, drawn))
    return np.concatenate(measured).std(axis=0, ddof=1)


@pytest.mark.parametrize(
    ("emissivity", "window", "camera_offset_K"),
    [
        *itertools.product([0.5, 0.95], [False, True], [0.0]),
        *((emissivity, emissivity < 0.9, 2 / 3**0.5) for emissivity in (0.5, 0.95)),
    ],
)
def test_standard_uncertainty_equals_monte_carlo(rng, emissivity, window, camera_offset_K):
    """Also without the accuracy of the camera, which dominates the total and would hide a wrong sensitivity."""
    parameters = _scene(emissivity, window)
    inputs = replace(_inputs(window), camera_offset_K=camera_offset_K)
    temperatures = np.array([0.0, 15.0, 30.0, 45.0, 60.0])
    expected = _simulate(temperatures, parameters, inputs, rng)
    budget = temperature_uncertainty(temperatures, parameters, inputs)
    np.testing.assert_allclose(budget.total_u, expected, rtol=TOLERANCE)


def test_rise_uncertainty_equals_monte_carlo_and_not_twice_the_level(rng):
    parameters = _scene(0.95, window=False)
    inputs = InputUncertainty(emissivity=0.01, camera_scale=0.0, reflected_change_K=0.0)
    before, after = 22.0, 27.0
    counts = [counts_from_temperature(t, parameters) for t in (before, after)]
    rises = []
    for drawn in _draw(parameters, inputs, rng):
        # One wrong set of parameters, one offset of the camera: both frames share them.
        low, high = (temperature_from_counts(count, drawn) for count in counts)
        rises.append(float(high - low))
    budget = temperature_rise_uncertainty(after, before, parameters, inputs)
    assert float(budget.common_u) == pytest.approx(np.std(rises, ddof=1), rel=TOLERANCE)
    level = float(temperature_uncertainty(after, parameters, inputs).common_u)
    assert float(budget.common_u) < 0.06 < 1.0 < level
    # Noise of two frames: sqrt(2) of one, within the 0.6 % that its sensitivity changes over 5 K.
    single = float(temperature_uncertainty(after, parameters, inputs).per_frame_u)
    assert float(budget.per_frame_u) == pytest.approx(np.sqrt(2) * single, rel=0.05)


def test_the_budget_names_its_parts_and_adds_them_up():
    single = temperature_uncertainty(25.0, PARAMETERS)
    hundred = temperature_uncertainty(25.0, PARAMETERS, frames=100)
    assert float(hundred.common_u) == float(single.common_u)
    assert float(hundred.per_frame_u) == pytest.approx(float(single.per_frame_u) / 10)
    temperature = np.array([[10.0, 20.0], [30.0, 40.0]])
    before = temperature.copy()
    budget = temperature_uncertainty(temperature, PARAMETERS, InputUncertainty(camera_scale=0.02))
    assert set(budget.common) == {
        "emissivity", "reflected_temperature_K", "atmospheric_temperature_K", "relative_humidity",
        "object_distance_m", "camera_offset_K", "camera_scale",
    }  # fmt: skip
    assert set(budget.per_frame) == {"noise", "quantisation"}
    parts = [*budget.common.values(), *budget.per_frame.values()]
    np.testing.assert_allclose(budget.total_u**2, np.sum(np.square(parts), axis=0), rtol=1e-12)
    np.testing.assert_array_equal(temperature, before)
    # A surface as warm as its surroundings radiates the same whatever its emissivity.
    at_ambient = temperature_uncertainty(20.0, override(PARAMETERS, reflected_temperature_K=293.15))
    assert abs(float(at_ambient.common["emissivity"])) < 1e-3
    black = override(PARAMETERS, emissivity=1.0, object_distance_m=0.0)
    budget = temperature_uncertainty(30.0, black, InputUncertainty(netd_K=0.04, netd_temperature_degC=30.0))
    assert float(budget.per_frame["noise"]) == pytest.approx(0.04, rel=1e-9)
    # One count of an SC660 is about 6 mK near 20 degC; rounding to it has a standard uncertainty of a twelfth's root.
    budget = temperature_uncertainty(20.0, PARAMETERS)
    assert float(budget.per_frame["quantisation"]) == pytest.approx(0.006 / 12**0.5, rel=0.1)
    budget = temperature_uncertainty(50.0, override(PARAMETERS, object_distance_m=0.0))
    assert 0 < abs(float(budget.common["object_distance_m"])) < 0.1


def test_what_has_no_meaning_is_refused_and_empty_cells_need_no_frames():
    with pytest.raises(ValueError, match=r"uncertainty of emissivity = -0\.1: expected 0 or more"):
        InputUncertainty(emissivity=-0.1)
    budget = temperature_uncertainty(np.array([25.0, np.nan]), PARAMETERS, frames=np.array([4, 0]))
    assert np.isfinite(budget.total_u).tolist() == [True, False]
    with pytest.raises(RadiometryError, match=r"emissivity 0\.15 with a standard uncertainty of 0\.08: .*paint the"):
        monte_carlo_ratio([30.0], (25.0, 30.0), _scene(0.15, window=False), InputUncertainty(emissivity=0.08))


@pytest.mark.parametrize("frames", [0, -1, np.nan, np.array([4, 0])])
def test_a_temperature_averaged_over_no_frame_is_refused(frames):
    with pytest.raises(ThermographyError, match=r"frames=.* for a temperature; give the number of frames"):
        temperature_uncertainty(np.array([25.0, 26.0]), PARAMETERS, frames=frames)


def test_errors_of_camera_and_emissivity_have_the_size_of_their_definition():
    black = override(PARAMETERS, emissivity=1.0, object_distance_m=0.0)
    inputs = InputUncertainty(camera_offset_K=0.0, camera_scale=0.02)
    parts = common_contributions([25.0, 300.0, 400.0], black, inputs)
    np.testing.assert_allclose(parts["camera_scale"], [0.5, 6.0, 8.0], rtol=1e-6)
    inputs = InputUncertainty(camera_offset_K=1.0, camera_scale=0.0)
    for emissivity in (0.97, 0.35):
        parameters = override(PARAMETERS, emissivity=emissivity, object_distance_m=0.0, reflected_temperature_K=298.15)
        # At the temperature of its surroundings the surface looks like a black body.
        part = common_contributions(25.0, parameters, inputs)["camera_offset_K"]
        assert float(part) == pytest.approx(1 / emissivity, rel=1e-6)
    parameters = override(PARAMETERS, emissivity=0.97, object_distance_m=0.0)
    share = rise_scale_contributions(25.0, parameters, InputUncertainty(emissivity=0.0097))["emissivity"]
    counts = counts_from_temperature([24.5, 25.5], parameters)
    wrong = temperature_from_counts(counts, override(parameters, emissivity=0.9797))
    assert float(share) == pytest.approx(np.diff(wrong)[0] - 1.0, rel=0.02)
    assert float(share) == pytest.approx(-0.01, rel=0.1)
    inputs = InputUncertainty(camera_drift_K=0.2)
    budget = temperature_rise_uncertainty(27.0, 22.0, black, inputs)
    assert float(budget.common["camera_drift_K"]) == pytest.approx(0.2, rel=1e-6)


@pytest.mark.parametrize(("emissivity", "u", "low", "high"), [(0.97, 0.01, 0.95, 1.05), (0.15, 0.04, 1.15, 1.7)])
def test_first_order_is_compared_with_drawn_distributions(emissivity, u, low, high):
    inputs = InputUncertainty(emissivity=u)
    of_temperature, of_rise = monte_carlo_ratio([25.0, 30.0], (25.0, 30.0), _scene(emissivity, window=False), inputs)
    assert of_temperature.shape == (2,)
    assert low < of_rise < high
