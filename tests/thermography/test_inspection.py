"""Content of a FLIR file, and one warning for everything in it that is implausible or damaged."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.thermography.flir_mutations import (
    CAMERA,
    HOUSEKEEPING,
    LIMITS,
    PARAMETERS,
    TIME,
    frame,
    patch,
    sequence,
)
from thermography.common import ThermographyError
from thermography.inspection import describe_stack, inspect_file
from thermography.io.flir_writer import write_jpeg, write_sequence
from thermography.io.frame import CalibratedRange
from thermography.io.other_cameras import read_stack
from thermography.radiometry.planck import override


def _codes(path: Path) -> set[str]:
    return {each.code for each in inspect_file(path).warnings}


def _write(path: Path, *, counts: np.ndarray | None = None, time: object = TIME, limits=LIMITS, **parameters) -> Path:
    values = frame().counts if counts is None else counts
    write_jpeg(path, values, replace(PARAMETERS, **parameters), time, camera=CAMERA, limits=limits)
    return path


def test_an_intact_file_gives_its_content_and_no_warnings(tmp_path):
    sequence(tmp_path / "a.seq", frames=3)
    inspection = inspect_file(tmp_path / "a.seq")
    whole = {name: values[:, 0] for name, values in inspection.evaluation.columns.items()}
    assert inspection.warnings == () and len(inspection.frames) == len(whole["mean"]) == 3
    assert 22 < whole["minimum"].min() < whole["mean"].mean() < whole["maximum"].max() < 28
    assert "FLIR, 3 frames of 16 x 12, samples raw" in inspection.lines()[0]
    for part in (
        "camera FLIR SC660, serial 404003980, lens FOL38",
        "time 2026-03-09T06:33:47.125 to 2026-03-09T06:33:49.125 UTC (camera set to +1 h)",
        "emissivity 0.95, distance 1 m, reflected 20.00 °C, air 20.00 °C, relative humidity 50%, window transmission 1",
        "R1 21106.7695, B 1501, F 1, O -7340, R2 0.012545258",
        "calibrated range -40 to 120 °C",
        "whole picture: maximum ",
        "inside the camera, °C: TSLens 26.1, TSShutter 27.4",
    ):
        assert part in str(inspection)


def test_the_hottest_frame_of_a_long_sequence_is_found_and_told_with_its_time(tmp_path):
    hot = frame(seconds=77).counts.copy()
    hot[3, 5] += 2000
    frames = (frame(seconds=n) if n != 77 else replace(frame(seconds=n), counts=hot) for n in range(100))
    write_sequence(tmp_path / "a.seq", frames)
    told = next(line for line in inspect_file(tmp_path / "a.seq").lines() if "whole picture" in line)
    assert "at 5,3 in frame 77, 2026-03-09T06:35:04 UTC" in told


@pytest.mark.parametrize(
    ("parameters", "code", "message"),
    [
        ({"reflected_temperature_K": 22.0}, "celsius_as_kelvin", "reflected temperature 22 K: probably degC stored as"),
        ({"reflected_temperature_K": 571.0}, "kelvin_as_celsius", "reflected temperature 298 degC: probably K stored"),
        ({"atmospheric_temperature_K": 24.0}, "celsius_as_kelvin", "atmospheric temperature 24 K: probably degC"),
        ({"relative_humidity": 45.0}, "humidity_percent", "relative humidity was stored in percent"),
        ({"relative_humidity": 0.0}, "humidity", "relative humidity 0"),
        ({"object_distance_m": 0.0}, "distance_zero", "distance 0 m: the atmosphere is not corrected"),
        ({"emissivity": 1.0}, "emissivity", "emissivity 1 is not physical"),
        ({"planck_r1": 0.0}, "not_calibrated", "the Planck constants are not positive"),
        ({"stored_transmission": 0.5}, "stored_transmission", "the file stores a transmission of 0.5000, but distance"),
    ],
)
def test_implausible_parameters_give_a_warning(tmp_path, parameters, code, message):
    path = _write(tmp_path / "a.jpg", **parameters)
    warnings = {each.code: each for each in inspect_file(path).warnings}
    assert set(warnings) == {code}
    assert message in warnings[code].message and warnings[code].remedy
    assert f"  warning: {warnings[code].message} {warnings[code].remedy}" in inspect_file(path).lines()


def test_pixels_outside_the_calibrated_range_give_a_warning(tmp_path):
    hot = frame().counts.copy()
    hot[:3] = 60000
    assert _codes(_write(tmp_path / "a.jpg", counts=hot)) == {"overrange"}
    cold = frame().counts.copy()
    cold[0, 0] = 8000
    warnings = inspect_file(_write(tmp_path / "b.jpg", counts=cold)).warnings
    assert {each.code for each in warnings} == {"underrange"}
    assert "below the calibrated range, up to 1 of 192;" in warnings[0].message
    silent = CalibratedRange(0.0, 0.0, 0, 0)
    assert _codes(_write(tmp_path / "c.jpg", counts=hot, limits=silent)) == set()


def test_constant_frames_and_clocks_never_set_give_a_warning(tmp_path):
    flat = np.full((12, 16), 18000, np.uint16)
    assert _codes(_write(tmp_path / "a.jpg", counts=flat)) == {"no_content"}
    assert _codes(_write(tmp_path / "b.jpg", time="2000-01-04T04:43:58")) == {"clock_not_set"}
    assert _codes(_write(tmp_path / "c.jpg", time=np.datetime64("NaT"))) == {"no_time"}


def test_changes_within_a_file_give_a_warning(tmp_path):
    first = frame()
    second = replace(frame(seconds=1), parameters=override(PARAMETERS, emissivity=0.5))
    other = replace(frame(seconds=2), camera=replace(CAMERA, serial="1"))
    write_sequence(tmp_path / "a.seq", [first, second, other])
    messages = {each.code: each.message for each in inspect_file(tmp_path / "a.seq").warnings}
    assert set(messages) == {"parameters_vary", "several_cameras"}
    assert messages["parameters_vary"] == "parameters differ between the frames: emissivity (0.5 to 0.95)."


def test_damage_gives_a_warning(tmp_path):
    path = tmp_path / "a.seq"
    sequence(path, frames=2)
    data = bytearray(path.read_bytes())
    # The frame rate, which no check of plausibility looks at.
    data[0x200 + 0x464] ^= 1
    path.write_bytes(data[:-10])
    messages = {each.code: each.message for each in inspect_file(path).warnings}
    assert set(messages) == {"checksum", "frame_left_out"}
    assert messages["checksum"] == "the headers of 1 frames, 0, differ from their checksums."
    assert "the frame is truncated" in messages["frame_left_out"]


def test_damaged_pixels_are_not_shown(tmp_path):
    path = tmp_path / "a.seq"
    sequence(path, frames=2)
    place = 0x200 + 2476 + 0x20 + 9
    patch(path, (place, bytes([path.read_bytes()[place] ^ 1])))
    inspection = inspect_file(path)
    (warning,) = inspection.warnings
    assert warning.code == "frame_left_out" and "damaged samples" in warning.message
    assert len(inspection.evaluation.headers) == 1


def test_sensors_at_zero_degc_are_placeholders(tmp_path):
    each = replace(frame(), housekeeping={**HOUSEKEEPING, "Internal": 273.15})
    write_sequence(tmp_path / "a.seq", [each])
    assert "Internal" not in "\n".join(inspect_file(tmp_path / "a.seq").lines())


@pytest.mark.real_data
def test_real_files_give_the_warnings_of_their_known_faults(real_file):
    expected = {
        "gtatters__Thermimage/inst/extdata/IR_2412.jpg": set(),
        "VladimirSinitsin__flir_extractor/bin/examples/frame.fff": {"clock_not_set", "underrange"},
        "LJMUAstroecology__flirpy/test/test_data/test.seq": {"stored_transmission"},
        "LJMUAstroecology__flirpy/test/test_data/frame_000000_le.fff": {"distance_zero"},
        "SanNianYiSi__thermal_parser/images/DJI_XT2.jpg": {"stored_transmission", "emissivity"},
    }
    assert {name: _codes(real_file(name)) for name in expected} == expected


def test_a_file_of_temperatures_is_described_with_what_must_be_stated(tmp_path):
    np.save(tmp_path / "a.npy", np.full((3, 8, 9), 7329, np.uint16))
    assert describe_stack(read_stack(tmp_path / "a.npy")) == [
        "NumPy array, 3 frames of 9 x 8",
        "values of the first frame 7329 to 7329",
        "state under [thermography.stack]: unit; time_in_name, times, or start and interval",
    ]
    (tmp_path / "b.npy").write_bytes(b"nothing\0")
    with pytest.raises(ThermographyError, match="not a known file of temperatures"):
        read_stack(tmp_path / "b.npy")


def test_what_no_camera_writes_is_told_and_not_made(tmp_path):
    """A few bytes may state any number of pixels and frames."""
    for shape, told in [
        ((1, 20_000, 20_000), "20000 x 20000 pixels are not a thermal frame"),
        ((3, 0, 5), "5 x 0 pixels are not a thermal frame"),
        ((2_000_000, 1, 1), r"2,000,000 frames; export parts of 1 to 1,000,000"),
    ]:
        np.lib.format.open_memmap(tmp_path / "a.npy", mode="w+", dtype=np.float32, shape=shape).flush()
        with pytest.raises(ThermographyError, match=told):
            read_stack(tmp_path / "a.npy")


@pytest.mark.parametrize(
    ("model", "calibrated"), [("Vue Pro 640 13mm", False), ("Vue Pro R 640 13mm", True), ("Duo Pro R 7", True)]
)
def test_a_model_without_calibration_is_doubted_by_name_and_its_temperatures_are_not_stated(
    tmp_path, model, calibrated
):
    path = tmp_path / "a.jpg"
    write_jpeg(path, frame().counts, PARAMETERS, TIME, camera=replace(CAMERA, model=model), limits=LIMITS)
    assert (_codes(path) == set()) == calibrated
    assert any("no temperature is stated" in line for line in inspect_file(path).lines()) != calibrated
