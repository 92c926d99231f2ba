"""Tests of what a small campaign lacks: said once, with the numbers that it would need."""

from __future__ import annotations

import numpy as np
import xarray as xr

from fusion.pipeline.sizes import MOST_TARGETS, choose_targets, lacks_for_correlation, lacks_for_model


def deviations(cycles: int, targets: int) -> xr.Dataset:
    return xr.Dataset(coords={"cycle": np.arange(cycles), "target": np.arange(targets)})


def test_a_test_of_twelve_cycles_at_three_targets_can_be_modelled() -> None:
    assert lacks_for_model(deviations(12, 3)) == []


def test_a_smaller_test_is_told_what_it_would_need() -> None:
    for size in ((5, 11), (12, 2)):
        (notice,) = lacks_for_model(deviations(*size))
        assert notice.message.startswith(
            f"{size[0]} cycles at {size[1]} targets: ISO 230-2, profile, scatter and drift"
        )
        assert "at least 12 cycles (better 50) at 3 targets" in notice.message


def test_a_dozen_frames_can_be_held_against_the_drift() -> None:
    few, enough = (xr.Dataset(coords={"time": np.arange(count)}) for count in (11, 12))
    assert lacks_for_correlation(few)[0].message.startswith("11 frames: fields and hotspots are evaluated")
    assert lacks_for_correlation(enough) == []


def test_very_many_targets_are_thinned_evenly_and_keep_both_ends() -> None:
    few = deviations(12, MOST_TARGETS).assign(position=("target", np.arange(MOST_TARGETS)))
    assert choose_targets(few) == (few, [])
    many = deviations(12, 400).assign(position=("target", np.arange(400.0)[::-1]))
    chosen, (notice,) = choose_targets(many)
    assert chosen.sizes["target"] == MOST_TARGETS
    assert chosen["position"].values.max() == 399.0 and chosen["position"].values.min() == 0.0
    assert np.abs(np.diff(chosen["position"].values)).max() <= 7.0
    assert "64 of the 400 positions" in notice.message
