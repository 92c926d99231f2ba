"""Charts of the table show the fields that they are given."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fusion.products.store import read_dataset
from fusion.report import plots_plan


def test_fiducials_and_rise_are_those_of_the_fields(results_folder: Path) -> None:
    fields = read_dataset(results_folder / "fields.nc")
    ax = plots_plan.plot_registration(fields)
    assert [text.get_text() for text in ax.texts] == [str(name) for name in fields["fiducial_name"].values]
    history = plots_plan.plot_rise_history(fields)
    mean = np.nanmean(fields["temperature_rise"].values.reshape(fields.sizes["cycle"], -1), axis=1)
    np.testing.assert_allclose(history.lines[0].get_ydata(), mean)
    np.testing.assert_allclose(history.lines[0].get_xdata()[:2], [0.0, 180.0 / 3600.0])


def test_a_cycle_without_a_field_is_a_gap(results_folder: Path) -> None:
    fields = read_dataset(results_folder / "fields.nc")
    rise = fields["temperature_rise"].copy(deep=True)
    rise[5] = np.nan
    history = plots_plan.plot_rise_history(fields.assign(temperature_rise=rise))
    for line in history.lines[:2]:
        assert list(np.flatnonzero(np.isnan(line.get_ydata()))) == [5]
