"""Exports: what a control would do with a table brings the profile to zero; signs follow each control's documentation."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from fusion.report import exports
from fusion.report.exports import ExportError, export_results

TABLE = pd.DataFrame(
    {"position": [0.0, 20.0, 40.0], "positive": [0.0, 0.004, 0.010], "negative": [-0.002, 0.002, 0.008]}
)


def test_linuxcnc_lists_true_positions() -> None:
    """Type 0: nominal, then where the axis really was by the forward and by the reverse approach."""
    rows = np.array([[float(value) for value in line.split()] for line in exports.linuxcnc(TABLE).splitlines()])
    np.testing.assert_allclose(rows[:, 1] - rows[:, 0], TABLE["positive"], atol=1e-9)
    np.testing.assert_allclose(rows[:, 2] - rows[:, 0], TABLE["negative"], atol=1e-9)


def test_siemens_adds_the_deviation_to_the_actual_value() -> None:
    """A positive value moves the axis in the negative direction, so a position that is too far gets a positive one."""
    text = exports.siemens840d(TABLE)
    values = [float(value) for value in re.findall(r"\$AA_ENC_COMP\[0,\d+,AX1\]=(\S+)", text)]
    np.testing.assert_allclose(values, [0.0, 0.004, 0.010], atol=1e-9)
    assert "$AA_ENC_COMP_STEP[0,AX1]=20.0000" in text and "$AA_ENC_COMP_MAX[0,AX1]=40.0000" in text
    assert "mean reversal 0.00200 mm" in text and text.endswith("M17\n")


def test_heidenhain_and_renishaw_carry_spacing_and_start() -> None:
    assert exports.heidenhain(TABLE).splitlines()[0] == "BEGIN AXIS-X.COM DATUM:+0.0000 DISTANCE:+20.0000"
    assert exports.heidenhain(TABLE).splitlines()[3] == "1 +0.004000 +0.002000"
    assert exports.renishaw(TABLE).splitlines()[4:] == [
        "1 0.0000 0.000 -2.000",
        "2 20.0000 4.000 2.000",
        "3 40.0000 10.000 8.000",
    ]


def test_unequal_spacing_and_too_many_points_are_refused() -> None:
    uneven = TABLE.assign(position=[0.0, 20.0, 45.0])
    for write in (exports.siemens840d, exports.heidenhain, exports.renishaw):
        with pytest.raises(
            ExportError,
            match=r"needs equally spaced positions; these are 20 to 25 mm apart, use the format linuxcnc or csv",
        ):
            write(uneven)
    long = pd.DataFrame({"position": np.arange(257.0), "positive": 0.0, "negative": 0.0})
    with pytest.raises(ExportError, match="257 positions; LinuxCNC reads at most 256 per joint"):
        exports.linuxcnc(long)


def test_results_are_exported_and_their_absence_is_told(results_folder: Path, tmp_path: Path) -> None:
    written = export_results(results_folder, "csv", tmp_path / "export")
    assert [path.name for path in written] == ["drift.csv", "profile.csv", "fields.csv"]
    drift = pd.read_csv(written[0])
    assert len(drift) == 288
    assert {"deviation_um", "drift_um", "drift_u_um", "time_utc"} <= set(drift)
    assert (drift["drift_u_um"] > 0).all()
    table = export_results(results_folder, "heidenhain", tmp_path / "export")[0].read_text()
    assert table.count("\n") == 6 + 3
    with pytest.raises(
        ExportError, match=r"there is no deviations.nc in it; name the results folder of a finished run"
    ):
        export_results(tmp_path, "csv", tmp_path)
