"""The temperature line: coefficients of an axis of known ones, a judgement on cycles left out, and setting data read back."""

from __future__ import annotations

import re

import numpy as np
import pytest

from fusion.products.store import read_dataset
from fusion.report.exports.errors import ExportError
from fusion.report.exports.temperature_line import fit_temperature_line, siemens_temperature
from tests.fusion.report.exports.small_run import SHIFT_UM_PER_K, STRETCH_PPM_PER_K, UNEVEN_MM, material_degC


def line_of(folder):
    material = read_dataset(folder / "fusion.nc")["material_temperature"]
    return fit_temperature_line(read_dataset(folder / "deviations.nc"), material, reference_mm=0.0)


def test_coefficients_are_those_of_the_axis(small_run) -> None:
    line = line_of(small_run)
    # 192 readings of 0.05 um noise over 2 K rms: some 0.003 um/K and 0.03 ppm/K; four times that.
    assert line.offset_um_per_K == pytest.approx(SHIFT_UM_PER_K, abs=0.02)
    assert line.gradient_ppm_per_K == pytest.approx(STRETCH_PPM_PER_K, abs=0.15)
    assert 0 < line.offset_u_um_per_K < 0.02 and 0 < line.gradient_u_ppm_per_K < 0.15
    assert line.after_um < 0.08 < 0.4 < line.before_um
    assert line.objections() == []


def test_setting_data_bring_the_drift_to_zero(small_run) -> None:
    """The control adds ABS_VALUE + SLOPE (P - REF) to the actual value, which moves the axis back by that much."""
    line = line_of(small_run)
    text = siemens_temperature(line, "X1", ["a header"])
    numbers = {name: float(value) for name, value in re.findall(r"^\$SA_TEMP_COMP_(\w+)\[X1\]=(\S+)$", text, re.M)}
    assert numbers == {"REF_POSITION": 0.0, "ABS_VALUE": 0.0, "SLOPE": 0.0}
    states = np.array([[float(word) for word in row] for row in re.findall(r"^; +([\d.]+) +(\S+) +(\S+)$", text, re.M)])
    assert states[0, 0] <= material_degC().min() and states[-1, 0] >= material_degC().max() - 1e-9
    for degC, absolute_mm, slope in states:
        rise = degC - line.mean_degC
        error_um = rise * (SHIFT_UM_PER_K + STRETCH_PPM_PER_K * UNEVEN_MM * 1e-3)
        np.testing.assert_allclose(error_um - 1e3 * (absolute_mm + slope * UNEVEN_MM), 0.0, atol=0.1)


def test_a_temperature_that_predicts_nothing_is_an_objection(small_run) -> None:
    """Temperatures without a relation to the drift: refused in nearly every case, for the one reason or the other."""
    deviations = read_dataset(small_run / "deviations.nc")
    rng = np.random.default_rng(3)
    reasons = []
    for _ in range(100):
        noise = np.broadcast_to(rng.standard_normal(12)[:, None, None], deviations["deviation"].shape)
        line = fit_temperature_line(deviations, deviations["deviation"].copy(data=noise), reference_mm=0.0)
        reasons += line.objections()
    # Two coefficients of a level of 0.01 each, of which some fail the prediction: at most 2 in 100 expected to pass.
    assert len(reasons) >= 94
    assert {reason.split(" ")[0] for reason in reasons} == {"the", "neither"}


def test_too_few_cycles_and_a_constant_temperature_are_refused(small_run) -> None:
    deviations = read_dataset(small_run / "deviations.nc")
    material = read_dataset(small_run / "fusion.nc")["material_temperature"]
    with pytest.raises(ExportError, match="6 cycles; a temperature line needs at least 10"):
        fit_temperature_line(deviations.isel(cycle=slice(6)), material, reference_mm=0.0)
    with pytest.raises(ExportError, match="the material temperature did not change"):
        fit_temperature_line(deviations, material * 0 + 20.0, reference_mm=0.0)
