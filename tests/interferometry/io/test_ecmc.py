"""Logs of the ecmc test tools: read, and refused where they contradict themselves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from interferometry.io.ecmc import is_ecmc_log, read_ecmc_log
from interferometry.io.faults import LaserFormatError
from interferometry.io.readers import read_deviations


def log(folder: Path, old: str = "", new: str = "") -> Path:
    lines = ["UNIT=mm", "CYCLES=2", "POSITIONS=2"]
    lines += [f"TGT_DATA[{t}]={10 * t}" for t in (1, 2)]
    lines += [f"REF_DATA_{d}[{t},{c}]={10 * t + c / 1000}" for d in ("FWD", "BWD") for t in (1, 2) for c in (1, 2)]
    text = "\n".join(lines)
    assert old in text
    path = folder / "log.dat"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    return path


def test_logs_of_assignments_are_read(tmp_path: Path) -> None:
    test = read_deviations(log(tmp_path))
    assert test["deviation"].values[:, 0, :] == pytest.approx(np.array([[1.0, 1.0], [2.0, 2.0]]))
    assert test["time"].attrs["origin"] == "none"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("UNIT=mm", "UNIT=inch", "UNIT=inch is not known; use one of mm, um, m"),
        ("CYCLES=2", "CYCLES=5", "CYCLES=5, but 2 were found"),
        ("TGT_DATA[2]", "TGT_DATA[3]", r"TGT_DATA gives targets \[1, 3\]"),
    ],
)
def test_logs_that_break_their_promises_are_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(LaserFormatError, match=message):
        read_ecmc_log(log(tmp_path, old, new))


def test_a_log_is_recognised_by_its_assignments(tmp_path: Path) -> None:
    assert is_ecmc_log(log(tmp_path).read_bytes())
    assert not is_ecmc_log(b"cycle,direction,target,position_mm,time,deviation_um")
