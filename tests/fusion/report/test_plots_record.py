"""Charts of a record show measured and predicted displacements; the hold-out is shaded."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.report import plots_record


@pytest.fixture
def record(rng: np.random.Generator) -> xr.Dataset:
    time = np.datetime64("2026-01-05T06:00", "ns") + np.arange(10) * np.timedelta64(1, "h")
    both = ("time", "channel")
    return xr.Dataset(
        {
            "displacement": (both, rng.normal(size=(10, 1))),
            "predicted_declared": (both, rng.normal(size=(10, 1))),
            "predicted_final": (both, rng.normal(size=(10, 1))),
            "predicted_u": ("channel", [0.1]),
            "contribution": (("effect", *both), rng.normal(size=(2, 10, 1))),
            "temperature": (("time", "sensor"), np.outer(np.arange(10.0), np.arange(1.0, 7.0))),
            "driver": (("time", "driver_name"), np.ones((10, 1))),
            "sealed": ("time", np.arange(10) >= 8),
        },
        coords={
            "time": time,
            "channel": ["X"],
            "sensor": [f"t{k}" for k in range(6)],
            "driver_name": ["speed"],
            "effect": ["a_b", "c"],
        },
    )


def test_the_prediction_stands_beside_the_measurement(record: xr.Dataset) -> None:
    ax = plots_record.plot_prediction(record, "X")
    np.testing.assert_array_equal(ax.lines[-1].get_ydata(), record["displacement"].sel(channel="X"))
    (shade,) = ax.patches
    assert (shade.get_x(), shade.get_width()) == (8.0, 1.0)


def test_residuals_and_contributions_have_their_lines(record: xr.Dataset) -> None:
    residual = plots_record.plot_residuals(record, "X").lines[-1].get_ydata()
    np.testing.assert_allclose(residual, (record["displacement"] - record["predicted_final"]).sel(channel="X"))
    labels = [line.get_label() for line in plots_record.plot_contributions(record, "X").lines]
    assert labels == ["a b", "c"]


def test_only_the_sensors_that_move_most_are_named(record: xr.Dataset) -> None:
    legend = plots_record.plot_temperatures(record).get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == ["t5", "t4", "t3", "t2"]
    assert len(plots_record.plot_drivers(record).lines) == 1
