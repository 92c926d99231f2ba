"""The thermal state: cycles of equal weight, and what was not logged is said to be so."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.products.store import read_dataset
from fusion.report.exports.thermal_state import read_thermal_state
from tests.fusion.report.exports.small_run import material_degC


def test_material_and_air_are_means_over_cycles(small_run) -> None:
    state = read_thermal_state(small_run, read_dataset(small_run / "deviations.nc"))
    assert state.temperatures_degC["material"][0] == pytest.approx(material_degC().mean())
    assert state.sentence() == (
        "mean of cycles 1 to 12: material 22.04 degC (20.04 to 23.99), air 21.04 degC (19.04 to 22.99)"
    )
    assert state.period() == "2026-03-09 06:30 UTC to 2026-03-09 07:26 UTC"


def test_what_is_not_recorded_is_said(small_run, tmp_path) -> None:
    deviations = read_dataset(small_run / "deviations.nc")
    untimed = deviations.assign(
        time=deviations["time"].copy(data=np.full(deviations["time"].shape, np.datetime64("NaT", "ns")))
    )
    state = read_thermal_state(tmp_path, untimed)
    assert state.sentence() == "mean of cycles 1 to 12: material not recorded, air not recorded"
    assert state.period() == "not recorded"
