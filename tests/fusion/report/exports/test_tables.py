"""Tables: every reading once, and ISO 230-2 values equal to an own calculation."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.products.results import read_results
from fusion.products.store import read_dataset
from fusion.report.exports import tables
from tests.fusion.report.exports.small_run import write_fields


def test_readings_and_profile_are_complete(small_run) -> None:
    deviations = read_dataset(small_run / "deviations.nc")
    readings = tables.readings_table(deviations)
    assert len(readings) == 12 * 2 * 8 and readings["deviation_um"].notna().all()
    gap = deviations.assign(deviation=deviations["deviation"].where(deviations["cycle"] != 4))
    assert len(tables.readings_table(gap)) == 11 * 2 * 8
    profile = tables.profile_table(deviations)
    assert len(profile) == 16 and set(profile["direction"]) == {"positive", "negative"}


def test_iso230_values_are_those_of_the_standard(small_run) -> None:
    deviations = read_dataset(small_run / "deviations.nc")
    x = deviations["deviation"].values[:5]
    mean, s = x.mean(axis=0), x.std(axis=0, ddof=1)
    axis = tables.iso230_axis_table(deviations).set_index(["window", "quantity", "direction"])
    first = axis.index[0][0]
    assert axis.loc[(first, "B", "both"), "value_um"] == pytest.approx(np.abs(mean[0] - mean[1]).max())
    assert axis.loc[(first, "E", "positive"), "value_um"] == pytest.approx(np.ptp(mean[0]))
    assert axis.loc[(first, "A", "both"), "value_um"] == pytest.approx((mean + 2 * s).max() - (mean - 2 * s).min())
    assert (axis["u_um"] > 0).all()


def test_positions_are_of_the_window_that_the_results_state(small_run) -> None:
    deviations, results = read_dataset(small_run / "deviations.nc"), read_results(small_run)
    assert results.iso230 is not None and results.iso230.settled is not None
    assert results.iso230.settled.window == "cycles 6 to 10"
    positions = tables.iso230_position_table(deviations, results)
    assert (positions["count_positive"] == 5).all()
    np.testing.assert_allclose(positions["mean_positive_um"], deviations["deviation"].values[5:10, 0].mean(axis=0))
    assert set(positions["window"]) == {"cycles 6 to 10"}
    whole = tables.iso230_position_table(deviations, results.model_copy(update={"iso230": None}))
    assert (whole["count_positive"] == 12).all()


def test_fields_are_tabulated_on_request(tmp_path) -> None:
    write_fields(tmp_path)
    frame = tables.fields_table(tmp_path)
    assert list(frame) == ["cycle", "y_mm", "x_mm", "temperature_degC", "rise_K", "rise_u_K"]
    assert len(frame) == 10
    assert tables.fields_megabytes(tmp_path) == pytest.approx(12 * 38e-6)


def test_a_run_without_fields_has_no_size(small_run) -> None:
    assert tables.fields_megabytes(small_run) is None
