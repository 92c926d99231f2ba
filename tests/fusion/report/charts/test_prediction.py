"""Errors of blocks that are left out: those of the results, and nothing where nothing was left out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from fusion.products.grouped import group
from fusion.products.results import read_results
from fusion.report.charts.prediction import plot_block_errors
from fusion.report.wording import alike


def test_the_errors_of_blocks_are_those_of_the_results(fused: xr.DataTree, results_folder: Path) -> None:
    loop, quoted = group(fused.to_dataset(), "loop"), read_results(results_folder).loop
    assert quoted is not None
    step = quoted.steps[0]
    errors = xr.Dataset({name: loop[f"block_error_{name}"].isel(step=0) for name in ("before", "after")})
    chart = plot_block_errors(errors, np.arange(24.0), "cycle")
    before, after = alike((step.cross_rmse_before_um, step.cross_rmse_after_um))
    assert f"{before} µm rms without the effect, {after} µm with it" in chart.seen
    drawn = chart.columns["with it / µm"]
    told = errors["after"].notnull().any(["direction", "target"]).values
    np.testing.assert_array_equal(np.isfinite(drawn), told)
    assert not told.all()


def test_of_a_record_the_channels_are_taken_together() -> None:
    values = np.array([[3.0, 4.0], [np.nan, np.nan]])
    errors = xr.Dataset(dict.fromkeys(("before", "after"), (("time", "channel"), values)), coords={"time": [0, 1]})
    chart = plot_block_errors(errors, np.array([0.0, 1.0]), "time")
    np.testing.assert_allclose(chart.columns["without the effect / µm"], [np.sqrt(12.5), np.nan])
    assert "in 1 blocks of time" in chart.seen and chart.figure.y_range.end == pytest.approx(1.05 * np.sqrt(12.5))
