"""Tests of what a small campaign lacks: said once, with the numbers that it would need."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.pipeline.sizes import MOST_TARGETS, average_cycles, choose_targets, lacks_for_correlation, lacks_for_model


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


def test_cycles_and_frames_of_a_very_long_test_are_averaged(monkeypatch: pytest.MonkeyPatch) -> None:
    start = np.datetime64("2026-03-09T06:30", "ns")
    seconds = 10.0 * np.arange(24.0).reshape(12, 1, 2)
    deviation = seconds / 10.0
    deviation[0, 0, 1], deviation[3:6, 0, 0] = np.nan, np.nan
    fused = xr.Dataset(
        {
            "deviation": (("cycle", "direction", "target"), deviation, {"units": "um"}),
            "time": (("cycle", "direction", "target"), start + (1e9 * seconds).astype("timedelta64[ns]")),
            "position": ("target", [0.0, 50.0]),
        },
        coords={"cycle": np.arange(1, 13), "direction": ["positive"], "target": [1, 2]},
    )
    field = xr.DataArray(
        np.arange(24.0)[:, None, None],
        dims=("time", "y", "x"),
        coords={"time": start + np.arange(24) * np.timedelta64(10, "s")},
    )
    same, frames, none = average_cycles(fused, field)
    assert same is fused and frames is field and none == []
    monkeypatch.setattr("fusion.pipeline.sizes.MOST_CYCLES", 4)
    means, frames, (notice,) = average_cycles(fused, field)
    # Readings count at their own times: of the first three cycles the second target misses one.
    np.testing.assert_allclose(means["deviation"][0, 0], [2.0, 4.0])
    assert means["time"].values[0, 0, 1] == start + np.timedelta64(40, "s")
    assert np.isnan(means["deviation"].values[1, 0, 0]) and np.isnat(means["time"].values[1, 0, 0])
    assert means["cycle"].values.tolist() == [2, 5, 8, 11] and means["position"].values.tolist() == [0.0, 50.0]
    np.testing.assert_allclose(frames.values.ravel(), [2.5, 8.5, 14.5, 20.5])
    assert frames["time"].values[0] == start + np.timedelta64(25, "s")
    assert "means of 3 successive cycles (4 of 12)" in notice.message
