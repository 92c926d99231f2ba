"""Temperatures as counts of a black-body scale, and the times of frames that their files do not hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from thermography.io.frame_readers import index_recordings
from thermography.io.temperature_frames import StackError, StackOptions, encode
from thermography.radiometry.planck import calibrate, counts_from_temperature, override

START = np.datetime64("2026-03-09T06:30:00", "ns")


def test_the_scale_is_the_inverse_of_the_calibration() -> None:
    temperature = np.linspace(-40.0, 159.0, 2000)
    parameters = StackOptions().parameters
    back = calibrate(encode(temperature, parameters), parameters)
    # Half a step: 17 mK at -40, 2.4 mK at 20 degC and 1.1 mK at 100 degC.
    step = 0.5 / np.gradient(counts_from_temperature(temperature, parameters), temperature)
    assert (np.abs(back - temperature) <= step + 1e-4).all()
    near = (temperature > 15) & (temperature < 40)
    assert np.std(back[near] - temperature[near]) < 1.6e-3


def test_pixels_without_temperature_have_none_afterwards_and_hot_ones_are_outside_the_range() -> None:
    for parameters in (StackOptions().parameters, StackOptions(emissivity=0.9).parameters):
        counts = encode(np.array([np.nan, -300.0, 400.0, np.inf]), parameters)
        assert counts.tolist() == [0, 0, 65535, 65535]
        assert np.isnan(calibrate(counts[:1], parameters)).all()


def test_another_emissivity_is_calculated_as_for_counts() -> None:
    options = StackOptions(emissivity=0.95, reflected_temperature_K=295.15)
    given = options.parameters
    truth = np.array([25.0, 30.0, 35.0])
    wrong = calibrate(np.rint(counts_from_temperature(truth, override(given, emissivity=0.9))).astype(np.uint16), given)
    right = calibrate(encode(wrong, given), override(given, emissivity=0.9))
    assert right == pytest.approx(truth, abs=6e-3)


def frames(folder: Path, options: StackOptions, *, name: str = "IR_20260309_063000.npy", count: int = 1) -> list[str]:
    np.save(folder / name, np.full((count, 4, 5), 20.0) + np.arange(count)[:, None, None])
    found, rejected = index_recordings([folder / name], options)
    assert rejected == []
    return [str(frame.time) for frame in found]


def test_times_from_the_name(tmp_path: Path) -> None:
    options = StackOptions(unit="degC", time_in_name="%Y%m%d_%H%M%S", time_zone="Europe/Vienna", interval_s=0.5)
    assert frames(tmp_path, options) == ["2026-03-09T05:30:00.000"]
    assert frames(tmp_path, options, count=2) == ["2026-03-09T05:30:00.000", "2026-03-09T05:30:00.500"]
    with pytest.raises(StackError, match=r"the name 'b.npy' holds no time of the form '%Y%m%d_%H%M%S'"):
        frames(tmp_path, options, name="b.npy")
    with pytest.raises(StackError, match=r"20261025_023000.npy: .* occurs twice or not at all in Europe/Vienna"):
        frames(tmp_path, options, name="20261025_023000.npy")


def test_times_from_a_table_or_a_start(tmp_path: Path) -> None:
    listed = {("IR_20260309_063000.npy", 1): START}
    assert frames(tmp_path, StackOptions(unit="degC", times=listed), count=2) == ["2026-03-09T06:30:00.000", "NaT"]
    with pytest.raises(StackError, match=r"the table of times has no line for c.npy; add one per frame"):
        frames(tmp_path, StackOptions(unit="degC", times=listed), name="c.npy")
    with pytest.raises(StackError, match='2 frames and one time; write interval = "10 s"'):
        frames(tmp_path, StackOptions(unit="degC", start=START), count=2)


def test_scale_offset_and_kelvin(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.full((4, 5), 7329, np.uint16))
    options = StackOptions(unit="K", scale=0.04, start=START)
    (frame,), _ = index_recordings([tmp_path / "a.npy"], options)
    assert frame.read_temperature() == pytest.approx(np.full((4, 5), 20.01))  # type: ignore[attr-defined]
    with pytest.raises(
        StackError, match=r'whole numbers of 16 bits; write the scale of a count .* scale = 0.04 and unit = "K"'
    ):
        index_recordings([tmp_path / "a.npy"], StackOptions(unit="K", start=START))
