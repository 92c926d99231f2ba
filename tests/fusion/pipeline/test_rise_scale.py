"""The scale of the rise in coefficients, sensitivities and evidence."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from fusion.alignment.align import AxisGeometry
from fusion.consistency.coefficients import check_coefficients
from fusion.effects.library import library
from fusion.pipeline.rise_scale import (
    axis_scale_u,
    place_scale_u,
    plan_scale_u,
    scale_coefficients,
    scale_evidence,
    scaled,
)

X, Y = 5.0 + 10.0 * np.arange(30), 5.0 + 10.0 * np.arange(6)


def fields() -> xr.Dataset:
    """A plan whose left half warms by 3 K with a scale known to 1 %, its right half by 1 K with one known to 5 %."""
    left = np.broadcast_to(X < 150, (6, 30))
    rise = np.stack([np.zeros((6, 30)), np.where(left, 3.0, 1.0), np.full((6, 30), np.nan)])
    return xr.Dataset(
        {
            "temperature_rise": (("cycle", "y", "x"), rise),
            "rise_scale_u": (("y", "x"), np.where(left, 0.01, 0.05)),
        },
        coords={"cycle": [1, 2, 3], "y": Y, "x": X},
    )


def test_scales_are_weighted_by_the_rise() -> None:
    assert plan_scale_u(fields()) == pytest.approx((3 * 0.01 + 1 * 0.05) / 4)
    along = AxisGeometry((20.0, 30.0), (1.0, 0.0))
    assert axis_scale_u(fields(), along, np.array([0.0, 100.0])) == pytest.approx(0.01)
    assert place_scale_u(fields(), 250.0, 30.0) == pytest.approx(0.05)
    assert place_scale_u(fields(), np.nan, np.nan) == pytest.approx(plan_scale_u(fields()))
    cold = fields().assign(temperature_rise=fields()["temperature_rise"] * 0.0)
    assert plan_scale_u(cold) == pytest.approx(0.03)


def test_both_parts_are_stated_and_combined() -> None:
    both = scaled({"value": -10.0, "u": 0.3}, 0.04)
    assert (both["u_fit"], both["u_scale"], both["u"]) == pytest.approx((0.3, 0.4, 0.5))


def test_what_was_expected_does_not_depend_on_the_rise() -> None:
    """The weighted mean of readings and expectation is shifted by the readings' weight times their own shift."""
    alone, alone_u, expected, expected_u = 10.0, 1.0, 12.0, 2.0

    def mean(readings: float) -> float:
        weights = np.array([alone_u, expected_u]) ** -2.0
        return float(np.average([readings, expected], weights=weights))

    u = (alone_u**-2 + expected_u**-2) ** -0.5
    entry = {"value": mean(alone), "u": u, "prior": expected, "prior_u": expected_u}
    assert scaled(entry, 0.01)["u_scale"] == pytest.approx(abs(mean(alone * 1.01) - mean(alone)))
    declared = [{**scaled(entry, 0.1), "effect": "axis_expansion", "unit": "ppm/K"}]
    check = check_coefficients({"declared_coefficients": declared}, travel_mm=500.0)[0]
    # 10 against 12: with 1 of the readings, 10 % of 10 of the scale, and 2 of the expectation.
    assert check.value == pytest.approx(-2.0 / np.sqrt(1.0 + 1.0 + 4.0))


def test_only_coefficients_per_kelvin_of_the_rise_are_scaled() -> None:
    one = {"value": 2.0, "u": 0.1}
    loop = {
        "declared_coefficients": [
            {"effect": "axis_expansion", "unit": "ppm/K", **one},
            {"effect": "table_offset", "unit": "um/K", **one},
            {"effect": "material_compensation", "unit": "ppm/K", **one},
        ],
        "steps": [
            {"effect": "angular_growth", "parameters": {"follows": "mean_rise"}, "coefficients": [{"unit": "um/(K)", **one}]},
            {"effect": "step_event", "parameters": {"time_s": 3.0}, "coefficients": [{"unit": "um", **one}]},
        ],
    }  # fmt: skip
    before = json.dumps(loop)
    done = scale_coefficients(loop, library(), axis_u=0.02, plan_u=0.03)
    assert [entry.get("u_scale") for entry in done["declared_coefficients"]] == [0.04, 0.06, None]
    assert [step["coefficients"][0].get("u_scale") for step in done["steps"]] == [0.06, None]
    assert json.dumps(loop) == before


def test_the_local_temperature_of_an_anomaly_carries_the_scale_of_its_place() -> None:
    position = xr.DataArray([0.0, 200.0], dims="target", coords={"target": [1, 2]})
    axis = AxisGeometry((20.0, 30.0), (1.0, 0.0))
    anomaly = {"target": 2, "evidence": {"temperature_um_per_K": 2.0, "temperature_u_um_per_K": 0.1}}
    evidence = scale_evidence(anomaly, axis, fields(), position)["evidence"]
    assert evidence["temperature_scale_u_um_per_K"] == pytest.approx(0.1)
    assert evidence["temperature_u_um_per_K"] == pytest.approx(0.1 * np.sqrt(2.0))
    without = {"target": 2, "evidence": {}}
    assert scale_evidence(without, axis, fields(), position) is without


def test_results_carry_both_parts_of_every_coefficient(results_folder: Path) -> None:
    results = json.loads((results_folder / "results.json").read_text())
    expansion, offset = results["loop"]["declared_coefficients"]
    for entry in (expansion, offset, results["correlation"]["source"]["sensitivity_um_per_K"]):
        assert entry["u"] == pytest.approx(np.hypot(entry["u_fit"], entry["u_scale"]))
    assert expansion["u_scale"] == pytest.approx(results["radiometry"]["rise_scale_u"] * expansion["value"], rel=0.1)
    assert all(spot["peak_rise_u_K"] > 0.01 * spot["peak_rise_K"] for spot in results["hotspots"])
    assert "the scale of the rise ±" in (results_folder / "report.html").read_text()
