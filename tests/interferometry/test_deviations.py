"""Flags: bits that do not collide, and the order of a pass."""

from __future__ import annotations

import numpy as np
import pytest

from interferometry.deviations import (
    DUPLICATE,
    OUTLIER,
    REGISTRY,
    count_flags,
    detect_out_of_order,
    flag_attributes,
    set_flag,
)
from tests.interferometry.simulated_campaigns import simulate


def test_bits_are_distinct_and_explained() -> None:
    masks = [flag.mask for flag in REGISTRY]
    assert sorted(masks) == [1 << at for at in range(len(masks))]
    attributes = flag_attributes()
    assert str(attributes["flag_meanings"]).split() == [flag.name for flag in REGISTRY]
    assert all(flag.meaning.endswith(".") for flag in REGISTRY)


def test_setting_a_flag_keeps_the_others_and_the_input(rng: np.random.Generator) -> None:
    deviations, _ = simulate(rng, cycles=2)
    where = np.zeros(deviations["deviation"].shape, dtype=bool)
    where[0, 0, 0] = True
    once = set_flag(deviations, OUTLIER, where)
    twice = set_flag(once, DUPLICATE, where)
    assert twice["quality_flag"].values[0, 0, 0] == OUTLIER.mask | DUPLICATE.mask
    assert not deviations["quality_flag"].any()
    assert count_flags(twice) == {"missing": 0, "unreadable": 0, "duplicate": 1, "out_of_order": 0, "outlier": 1}


@pytest.mark.parametrize("direction", [0, 1])
def test_one_wrong_time_marks_itself_and_not_its_neighbours(rng: np.random.Generator, direction: int) -> None:
    deviations, _ = simulate(rng, cycles=2)
    deviations["time"].values[1, direction, 6] += np.timedelta64(20, "s")
    assert np.argwhere(detect_out_of_order(deviations)).tolist() == [[1, direction, 6]]


def test_readings_without_a_time_have_no_order(rng: np.random.Generator) -> None:
    deviations, _ = simulate(rng, cycles=2)
    deviations["time"].values[:] = np.datetime64("NaT")
    assert not detect_out_of_order(deviations).any()
