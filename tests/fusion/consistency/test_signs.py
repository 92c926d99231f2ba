"""Order and sign of the readings: exchanged labels and inverted signs are named, sound readings and step cycles pass."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr

from fusion.consistency.checks import Check
from fusion.consistency.signs import check_signs
from tests.fusion.consistency.test_readings import TARGETS, sound, with_deviation


def failed(deviations: xr.Dataset) -> dict[str, Check]:
    return {check.code: check for check in check_signs(deviations) if not check.passed}


def sloped(seed: int = 5) -> xr.Dataset:
    """Sound readings of an axis with a pitch error, which gives them a shape that has a sign."""
    test = sound(seed)
    return with_deviation(test, test["deviation"].values + 0.8 * np.arange(TARGETS))


def inverted(place: tuple) -> xr.Dataset:
    test = sloped()
    values = test["deviation"].values.copy()
    values[place] *= -1.0
    return with_deviation(test, values)


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("make", [sound, sloped])
def test_sound_readings_pass(make: Callable[[int], xr.Dataset], seed: int) -> None:
    assert failed(make(seed)) == {}


@pytest.mark.parametrize(
    ("place", "words"),
    [
        (np.s_[20:], "from cycle 21 on"),
        (np.s_[:, 1], "approach in negative direction against approach in positive direction"),
        (np.s_[:, :, 9], "target 10"),
    ],
)
def test_inverted_signs_are_named_with_their_place(place: tuple, words: str) -> None:
    found = failed(inverted(place))
    assert list(found) == ["mirrored_readings"]
    assert words in found["mirrored_readings"].evidence


def test_targets_of_one_approach_numbered_from_the_other_end_are_named() -> None:
    test = sloped()
    values = test["deviation"].values.copy()
    values[:, 1] = values[:, 1, ::-1]
    found = failed(with_deviation(test, values))
    assert list(found) == ["target_order"]
    assert "with the targets of one approach read from the other end" in found["target_order"].evidence
    assert "ISO 230-2 values" in found["target_order"].endangers


def test_exchanged_labels_contradict_the_travel() -> None:
    labelled = sloped().assign_coords(direction=["negative", "positive"]).sel(direction=["positive", "negative"])
    check = failed(labelled)["travel_order"]
    assert check.value == 1.0
    assert (
        "In 40 of 40 cycles, first in cycle 1, the readings labelled positive were taken at falling" in check.evidence
    )


def test_a_step_cycle_and_readings_without_times_are_no_contradiction() -> None:
    test = sloped()
    up = test["time"].isel(direction=[0, 0]).values + np.array([0, 4], "m8[s]")[:, None]
    assert failed(test.assign(time=test["time"].copy(data=up))) == {}
    nothing = np.full(test["time"].shape, np.datetime64("NaT", "ns"))
    assert failed(test.assign(time=test["time"].copy(data=nothing))) == {}


def test_cycles_that_lack_readings_take_no_part() -> None:
    test = inverted(np.s_[20:])
    values = test["deviation"].values.copy()
    values[5, 0, 3] = np.nan
    assert "from cycle 21 on" in failed(with_deviation(test, values))["mirrored_readings"].evidence
    values[:, 0, 3] = np.nan
    assert failed(with_deviation(test, values)) == {}
