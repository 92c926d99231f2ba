"""A series of frames in about ten lines: camera, times, gaps, settings."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from fusion.starting.series import describe_series
from thermography.errors import ThermographyError
from thermography.io.flir_writer import write_jpeg
from thermography.io.frame import CameraIdentity, CameraParameters

SC660 = CameraParameters(
    0.95, 1.0, 293.15, 293.15, 293.15, 1.0, 0.0, 0.5, 21106.77, 1501.0, 1.0, -7340.0, 0.012545258, 0.006569, 0.01262, -0.002276,
    -0.00667, 1.9,
)  # fmt: skip


def test_a_sound_series_is_ten_lines_at_most(campaign_folder: Path) -> None:
    paths = sorted((campaign_folder / "thermal").iterdir())
    lines = describe_series(paths, label="thermal/*.jpg")
    assert lines[0] == f"thermal/*.jpg: thermal frames, {len(paths)} files, {len(paths)} frames of 640 x 480"
    assert len(lines) <= 10 and not any("warning" in line for line in lines)
    assert any("0 gaps" in line for line in lines) and any("the same in all frames" in line for line in lines)


def test_two_cameras_a_gap_and_other_settings_are_named(tmp_path: Path) -> None:
    counts = np.full((4, 6), 18_000, dtype=np.uint16)
    for k, minute in enumerate((0, 1, 2, 3, 4, 45, 46)):
        parameters = SC660 if k < 6 else SC660.__class__(**{**vars(SC660), "emissivity": 0.8})
        camera = CameraIdentity(model="SC660", serial="1" if k < 5 else "2")
        write_jpeg(tmp_path / f"{k}.jpg", counts, parameters, f"2026-03-09T06:{minute:02d}:00", camera=camera)
    (tmp_path / "9.jpg").write_bytes((tmp_path / "0.jpg").read_bytes()[:400])
    lines = describe_series(sorted(tmp_path.iterdir()), label="s")
    text = "\n".join(lines)
    assert "  camera 2: SC660, serial 1; SC660, serial 2" in lines
    assert "a frame every 60 s, 1 gap: 2026-03-09 06:04 UTC, 41 min" in text
    assert "of the first frame; not the same in all: emissivity" in text
    assert "  warning: 1 frame left out: 9.jpg: " in text


def test_a_series_without_a_frame_is_refused(tmp_path: Path, campaign_folder: Path) -> None:
    whole = sorted((campaign_folder / "thermal").iterdir())[0].read_bytes()
    for name in "ab":
        (tmp_path / f"{name}.jpg").write_bytes(whole[:500])
    with pytest.raises(ThermographyError, match="s: no frame can be read; "):
        describe_series(sorted(tmp_path.iterdir()), label="s")
    shutil.rmtree(tmp_path)
