"""Inputs of the uncertainty budget."""

from __future__ import annotations

import pytest

from interferometry.iso230.budget import CONTRIBUTIONS, SAMPLING, Iso230Budget


def test_a_negative_uncertainty_is_refused() -> None:
    with pytest.raises(ValueError, match="device_ppm=-1 is negative"):
        Iso230Budget(device_ppm=-1)
    with pytest.raises(ValueError, match=r"environmental_variation_um=-0\.1 is negative"):
        Iso230Budget(environmental_variation_um=-0.1)


def test_a_temperature_below_20_degC_is_no_negative_uncertainty() -> None:
    assert Iso230Budget(difference_from_20_degC_K=-2.0).difference_from_20_degC_K == -2.0


def test_the_sampling_closes_the_budget() -> None:
    assert CONTRIBUTIONS[-len(SAMPLING) :] == SAMPLING
