"""Charts of the closed loop show the errors that the results quote."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from fusion.products.grouped import group
from fusion.products.results import read_results
from fusion.report.charts import loop as charts
from fusion.report.wording import number


@pytest.fixture
def loop(fused: xr.DataTree) -> xr.Dataset:
    return group(fused.to_dataset(), "loop")


def test_the_held_out_errors_are_those_of_the_results(
    loop: xr.Dataset, deviations: xr.Dataset, results_folder: Path
) -> None:
    quoted = read_results(results_folder).loop
    assert quoted is not None
    chart = charts.plot_held_out_errors(loop, deviations)
    held = loop["held_out_error_final"].notnull().any(["direction", "target"]).values
    for variable, value in (("declared", quoted.rmse_declared_um), ("final", quoted.rmse_final_um)):
        dots = loop[f"held_out_error_{variable}"].values
        assert np.sqrt(np.nanmean(dots**2)) == pytest.approx(value)
    assert f"with the added effects {number(quoted.rmse_final_um)} µm rms" in chart.seen
    mean = chart.columns["with the added effects, mean of the cycle / µm"]
    assert np.isnan(mean[~held]).all() and np.isfinite(mean[held]).all()
    assert chart.figure.x_range.end > chart.figure.x_range.start >= 0.0


def test_errors_by_position_and_predicted_against_measured(loop: xr.Dataset, deviations: xr.Dataset) -> None:
    chart = charts.plot_held_out_positions(loop, deviations)
    expected = np.sqrt((loop["held_out_error_declared"].sel(target=3) ** 2).mean())
    assert chart.columns["declared model / µm"][2] == pytest.approx(float(expected))
    chart = charts.plot_predicted_measured(loop, deviations)
    read, predicted = (
        chart.columns[name] for name in ("measured deviation / µm", "predicted, with the added effects / µm")
    )
    error = loop["held_out_error_final"].values
    np.testing.assert_allclose(read - predicted, error[np.isfinite(error)], atol=1e-12)


def test_direction_spectrum_events_and_contributions(loop: xr.Dataset, deviations: xr.Dataset) -> None:
    odd = charts.plot_residual_direction(loop, deviations).columns["declared model / µm"]
    both = loop["residual_declared"].mean("target")
    np.testing.assert_allclose(odd, (both.sel(direction="positive") - both.sel(direction="negative")) / 2, atol=1e-12)
    spectrum = charts.plot_residual_spectrum(loop)
    np.testing.assert_array_equal(
        spectrum.columns["declared model, power over that of noise"], loop["periodogram_declared"]
    )
    assert spectrum.figure.xaxis.axis_label == "period / min (logarithmic)"
    assert spectrum.figure.renderers[-1].glyph.y == loop["periodogram_final"].attrs["limit"]
    walk = charts.plot_residual_events(loop, deviations).columns["declared model, sum of innovations / √n"]
    assert walk[-1] == pytest.approx(float(loop["innovation_declared"].sum()) / np.sqrt(walk.size))
    contributions = charts.plot_contributions(loop, deviations)
    assert len(contributions.columns) == 2 + loop.sizes["effect"]
    assert contributions.figure.title.text == "at 250 mm, positive approach"


def test_nothing_added_is_drawn_once(loop: xr.Dataset, deviations: xr.Dataset) -> None:
    same = loop.assign(residual_declared=loop["residual_final"])
    columns = charts.plot_residual_direction(same, deviations).columns
    assert list(columns)[2:] == ["declared model, nothing added / µm"]
