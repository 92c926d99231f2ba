"""Emissivity from two known states: unbiased, with a valid uncertainty, and classified for reflecting surfaces."""

from __future__ import annotations

import numpy as np
import pytest

from tests.thermography.flir_mutations import PARAMETERS
from thermography.radiometry.emissivity import KnownState, estimate_emissivity
from thermography.radiometry.planck import RadiometryError, counts_from_temperature, override


def _states(emissivity: float, *, reflected_K: float = 297.0, window: float = 1.0, u: float = 0.2) -> list[KnownState]:
    parameters = override(
        PARAMETERS, emissivity=emissivity, reflected_temperature_K=reflected_K, window_transmission=window
    )
    return [KnownState(float(counts_from_temperature(t, parameters)), 2.0, t, u) for t in (22.0, 45.0)]


@pytest.mark.parametrize("emissivity", [0.3, 0.6, 0.85, 0.97])
@pytest.mark.parametrize("window", [1.0, 0.85])
def test_the_truth_comes_back_whatever_is_reflected(emissivity: float, window: float) -> None:
    parameters = override(PARAMETERS, window_transmission=window, emissivity=0.99)
    for reflected in (280.0, 297.0, 330.0):
        estimate = estimate_emissivity(*_states(emissivity, reflected_K=reflected, window=window), parameters)
        assert estimate.emissivity == pytest.approx(emissivity, abs=1e-12)
        assert estimate.reflected_temperature_degC == pytest.approx(reflected - 273.15, abs=1e-6)


def test_its_uncertainty_covers_repeated_experiments(rng: np.random.Generator) -> None:
    exact = _states(0.85)
    u = estimate_emissivity(*exact, PARAMETERS).emissivity_u
    estimates = []
    for _ in range(4000):
        drawn = [
            KnownState(s.counts + rng.normal(0, s.counts_u), s.counts_u, s.temperature_degC + rng.normal(0, 0.2), 0.2)
            for s in exact
        ]
        estimates.append(estimate_emissivity(*drawn, PARAMETERS).emissivity)
    # A standard deviation of 4000 draws scatters by 1.1 %.
    assert np.std(estimates, ddof=1) == pytest.approx(u, rel=0.05)
    assert np.mean(estimates) == pytest.approx(0.85, abs=4 * u / np.sqrt(4000) + 1e-3)


def test_classes() -> None:
    assert estimate_emissivity(*_states(0.95), PARAMETERS).quality == "usable"
    assert estimate_emissivity(*_states(0.2), PARAMETERS).quality == "too_reflective"
    assert estimate_emissivity(*_states(0.9, u=3.0), PARAMETERS).quality == "undetermined"
    cold, hot = _states(0.95)
    impossible = KnownState(2 * hot.counts, 2.0, hot.temperature_degC, 0.2)
    assert estimate_emissivity(cold, impossible, PARAMETERS).quality == "undetermined"


def test_equal_states_raise() -> None:
    state = _states(0.9)[0]
    with pytest.raises(RadiometryError, match="both states have 22 degC: heat the surface between them"):
        estimate_emissivity(state, state, PARAMETERS)


def test_the_reflected_temperature_of_a_black_surface_is_undetermined() -> None:
    assert np.isnan(estimate_emissivity(*_states(0.995), PARAMETERS).reflected_temperature_degC)
