"""What a FLIR file holds, and a warning for each thing that is wrong in it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.thermography.flir_mutations import CAMERA, HOUSEKEEPING, LIMITS, PARAMETERS, TIME, frame, jpeg, sequence
from thermography.inspection import inspect, inspect_file, is_flir_file, thumbnail
from thermography.io.flir_writer import write_jpeg, write_sequence
from thermography.io.frame import CalibratedRange, FlirFormatError
from thermography.radiometry.planck import override


def _codes(path: Path) -> set[str]:
    return {each.code for each in inspect(path).warnings}


def _write(path: Path, *, counts: np.ndarray | None = None, time: object = TIME, limits=LIMITS, **parameters) -> Path:
    values = frame().counts if counts is None else counts
    write_jpeg(path, values, replace(PARAMETERS, **parameters), time, camera=CAMERA, limits=limits)  # type: ignore[arg-type]
    return path


def test_a_good_file_has_facts_and_no_warnings(tmp_path: Path) -> None:
    sequence(tmp_path / "a.seq", frames=3)
    found = inspect(tmp_path / "a.seq")
    assert found.warnings == () and len(found.frames) == found.looked_at == 3
    assert 22 < found.lowest_degC < found.mean_degC < found.highest_degC < 28
    lines = inspect_file(tmp_path / "a.seq")
    assert lines == found.lines()
    text = "\n".join(lines)
    assert "FLIR, 3 frames of 16 x 12, samples raw" in lines[0]
    for part in (
        "camera FLIR SC660, serial 404003980, lens FOL38",
        "time 2026-03-09T06:33:47.125 to 2026-03-09T06:33:49.125 UTC (camera set to +1 h)",
        "emissivity 0.95, distance 1 m, reflected 20.00 degC, air 20.00 degC, relative humidity 50%, window transmission 1",
        "R1 21106.7695, B 1501, F 1, O -7340, R2 0.012545258",
        "(3 of 3 frames read)",
        "inside the camera, degC: TSLens 26.1, TSShutter 27.4",
    ):
        assert part in text


def test_a_long_sequence_is_sampled(tmp_path: Path) -> None:
    sequence(tmp_path / "a.seq", frames=100)
    found = inspect(tmp_path / "a.seq")
    assert len(found.frames) == 100 and found.looked_at == 32


@pytest.mark.parametrize(
    ("parameters", "code", "message"),
    [
        (
            {"reflected_temperature_K": 22.0},
            "celsius_as_kelvin",
            "reflected temperature 22 K looks like degC stored as K",
        ),
        (
            {"reflected_temperature_K": 571.0},
            "kelvin_as_celsius",
            "reflected temperature 298 degC looks like K stored as",
        ),
        ({"atmospheric_temperature_K": 24.0}, "celsius_as_kelvin", "atmospheric temperature 24 K looks like degC"),
        ({"relative_humidity": 45.0}, "humidity_percent", "relative humidity was stored in percent"),
        ({"relative_humidity": 0.0}, "humidity", "relative humidity 0"),
        ({"object_distance_m": 0.0}, "distance_zero", "distance 0 m: no air is corrected"),
        ({"emissivity": 1.0}, "emissivity", "emissivity 1 is no real surface's"),
        ({"planck_r1": 0.0}, "not_calibrated", "the Planck constants are not positive"),
        (
            {"stored_transmission": 0.5},
            "stored_transmission",
            "the file stores a transmission of 0.5000 where distance",
        ),
    ],
)
def test_nonsense_parameters_are_warned_of(tmp_path: Path, parameters: dict, code: str, message: str) -> None:
    path = _write(tmp_path / "a.jpg", **parameters)
    found = {each.code: each for each in inspect(path).warnings}
    assert set(found) == {code}
    assert message in found[code].message and found[code].remedy
    assert f"  warning: {found[code].message} {found[code].remedy}" in inspect_file(path)


def test_pixels_outside_the_calibrated_range_are_warned_of(tmp_path: Path) -> None:
    hot = frame().counts.copy()
    hot[:3] = 60000
    assert _codes(_write(tmp_path / "a.jpg", counts=hot)) == {"saturated", "outside_range"}
    cold = frame().counts.copy()
    cold[0, 0] = 8000
    found = inspect(_write(tmp_path / "b.jpg", counts=cold)).warnings
    assert {each.code for each in found} == {"under_range", "outside_range"}
    assert "up to 0.52% of the pixels lie" in found[0].message
    silent = CalibratedRange(0.0, 0.0, 0, 0)
    assert _codes(_write(tmp_path / "c.jpg", counts=hot, limits=silent)) == set()


def test_pictures_without_content_and_clocks_never_set_are_warned_of(tmp_path: Path) -> None:
    flat = np.full((12, 16), 18000, np.uint16)
    assert _codes(_write(tmp_path / "a.jpg", counts=flat)) == {"no_content"}
    assert _codes(_write(tmp_path / "b.jpg", time="2000-01-04T04:43:58")) == {"clock_not_set"}
    assert _codes(_write(tmp_path / "c.jpg", time=np.datetime64("NaT"))) == {"no_time"}


def test_changes_within_a_file_are_warned_of(tmp_path: Path) -> None:
    first = frame()
    second = replace(frame(seconds=1), parameters=override(PARAMETERS, emissivity=0.5))
    other = replace(frame(seconds=2), camera=replace(CAMERA, serial="1"))
    write_sequence(tmp_path / "a.seq", [first, second, other])
    found = {each.code: each.message for each in inspect(tmp_path / "a.seq").warnings}
    assert set(found) == {"parameters_vary", "several_cameras"}
    assert found["parameters_vary"] == "not the same in all frames: emissivity."


def test_damage_is_warned_of(tmp_path: Path) -> None:
    path = tmp_path / "a.seq"
    sequence(path, frames=2)
    data = bytearray(path.read_bytes())
    data[0x200 + 2476 + 0x20 + 9] ^= 1
    path.write_bytes(data[:-10])
    found = {each.code: each.message for each in inspect(path).warnings}
    assert set(found) == {"checksum", "frame_left_out"}
    assert found["checksum"] == "frame 0: records 0x01 differ from their checksum."
    assert "the frame is cut short" in found["frame_left_out"]


def test_a_damaged_picture_in_a_sound_file_is_left_out_and_said(tmp_path: Path) -> None:
    path = tmp_path / "a.seq"
    sequence(path, "jpegls", frames=2)
    data = bytearray(path.read_bytes())
    at = data.rindex(b"\xff\xd8\xff\xf7")
    data[at + 25 : at + 60] = bytes(35)
    path.write_bytes(data)
    found = inspect(path)
    assert found.looked_at == 1
    assert {each.code for each in found.warnings} == {"checksum", "frame_left_out"}


def test_a_file_without_a_frame_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"\xff\xd8\xff\xd9")
    with pytest.raises(FlirFormatError, match="the JPEG is not radiometric"):
        inspect(tmp_path / "a.jpg")


def test_files_are_told_apart_by_their_start(tmp_path: Path) -> None:
    jpeg(tmp_path / "a.jpg")
    sequence(tmp_path / "a.seq")
    (tmp_path / "laser.csv").write_text("cycle,direction\n", encoding="utf-8")
    assert [is_flir_file(tmp_path / name) for name in ("a.jpg", "a.seq", "laser.csv")] == [True, True, False]


def test_thumbnail_is_a_small_picture(tmp_path: Path) -> None:
    jpeg(tmp_path / "a.jpg", rows=480, columns=640)
    picture = cv2.imdecode(np.frombuffer(thumbnail(tmp_path / "a.jpg"), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (240, 320, 3)
    # Counts grow to the right, and so does the brightness of the colour map.
    assert picture[:, -20:].mean() > picture[:, :20].mean() + 50


def test_sensors_at_zero_degc_are_placeholders(tmp_path: Path) -> None:
    each = replace(frame(), housekeeping={**HOUSEKEEPING, "Internal": 273.15})
    write_sequence(tmp_path / "a.seq", [each])
    assert "Internal" not in "\n".join(inspect_file(tmp_path / "a.seq"))


@pytest.mark.real_data
def test_real_files_are_warned_of_what_is_known_to_be_wrong(real_file) -> None:
    expected = {
        "gtatters__Thermimage/inst/extdata/IR_2412.jpg": set(),
        "VladimirSinitsin__flir_extractor/bin/examples/frame.fff": {"clock_not_set", "outside_range"},
        "LJMUAstroecology__flirpy/test/test_data/test.seq": {"stored_transmission"},
        "LJMUAstroecology__flirpy/test/test_data/frame_000000_le.fff": {"distance_zero"},
        "SanNianYiSi__thermal_parser/images/DJI_XT2.jpg": {"stored_transmission", "emissivity"},
    }
    assert {name: _codes(real_file(name)) for name in expected} == expected
