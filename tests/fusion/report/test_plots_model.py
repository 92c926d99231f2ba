"""Charts of joint estimate and closed loop show the numbers of the products."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from fusion.products.grouped import group
from fusion.products.store import read_dataset
from fusion.report import plots_model


@pytest.fixture
def deviations(results_folder: Path) -> xr.Dataset:
    return read_dataset(results_folder / "deviations.nc")


@pytest.fixture
def loop(results_folder: Path) -> xr.Dataset:
    return group(read_dataset(results_folder / "fusion.nc"), "loop")


def test_reversal_is_that_of_the_joint_estimate(deviations: xr.Dataset) -> None:
    drift = group(deviations, "drift")
    ax = plots_model.plot_reversal(drift, deviations["position"])
    np.testing.assert_array_equal(ax.lines[0].get_ydata(), drift["reversal"])


def test_flagged_positions_are_shaded(deviations: xr.Dataset) -> None:
    ax = plots_model.plot_position_scatter(group(deviations, "drift"), {2, 5})
    assert len(ax.patches) == 2


def test_the_residual_is_drawn_before_and_after(loop: xr.Dataset, deviations: xr.Dataset) -> None:
    ax = plots_model.plot_residual_time(loop, deviations)
    mean = loop["residual_final"].mean(["direction", "target"])
    np.testing.assert_allclose(ax.lines[3].get_ydata(), mean)
    odd = plots_model.plot_residual_direction(loop, deviations).lines[0].get_ydata()
    both = loop["residual_declared"].mean("target")
    np.testing.assert_allclose(odd, (both.sel(direction="positive") - both.sel(direction="negative")) / 2, atol=1e-12)
    assert len(plots_model.plot_residual_position(loop, deviations).lines) == 5
    assert len(plots_model.plot_contributions(loop, deviations).lines) == loop.sizes["effect"]


def test_spectrum_and_events_come_from_the_innovations(loop: xr.Dataset, deviations: xr.Dataset) -> None:
    spectrum = plots_model.plot_residual_spectrum(loop)
    np.testing.assert_array_equal(spectrum.lines[0].get_ydata(), loop["periodogram_declared"])
    assert spectrum.lines[-1].get_ydata()[0] == loop["periodogram_final"].attrs["limit"]
    walk = plots_model.plot_residual_events(loop, deviations).lines[0].get_ydata()
    assert walk[-1] == pytest.approx(float(loop["innovation_declared"].sum()) / np.sqrt(walk.size))


def test_windows_end_with_the_whole_test(deviations: xr.Dataset) -> None:
    windows = group(deviations, "iso")
    ax = plots_model.plot_windows(windows)
    whole = [line.get_ydata()[0] for line in ax.lines if line.get_linestyle() == ":"]
    np.testing.assert_allclose(whole, [float(windows[name][-1]) for name in ("A", "R", "B")])
