"""The same files in four readers: ours, flyr, flirpy, exiftool. Where another reader reads a file, it must agree with ours."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import flyr
import numpy as np
import pytest
from flirpy.io.seq import Seq

from tests.thermography.flir_mutations import jpeg, sequence
from thermography.io.flir import FrameReference, index_frames, read_frame
from thermography.radiometry.planck import ZERO_CELSIUS_K, calibrate, override

#: File -> frames, and what flyr, flirpy and exiftool make of it: frames whose counts (exiftool: parameters) equal ours.
FILES: dict[str, tuple[int, int, int, int]] = {
    "gtatters__Thermimage/inst/extdata/IR_2412.jpg": (1, 1, 0, 1),
    "gtatters__Thermimage/inst/extdata/SampleSEQ.seq": (2, 0, 2, 1),
    "gtatters__Thermimage/inst/extdata/SampleCSQ.csq": (8, 0, 0, 1),
    "gpereyrairujo__IRimage/Windows/IRimage/test/test_image.jpg": (1, 1, 0, 1),
    "gpereyrairujo__IRimage/Windows/IRimage/sample_images/07 - BillHotFlashThermography.jpg": (1, 0, 0, 1),
    "gpereyrairujo__IRimage/Windows/IRimage/sample_images/16 - Man_in_water_-_IR_image.jpg": (1, 1, 0, 1),
    "LJMUAstroecology__flirpy/test/test_data/frame_000000_le.fff": (1, 0, 1, 1),
    "LJMUAstroecology__flirpy/test/test_data/test.seq": (7, 0, 7, 1),
    "SanNianYiSi__thermal_parser/images/FLIR_E40.jpg": (1, 1, 0, 1),
    "SanNianYiSi__thermal_parser/images/DJI_XT2.jpg": (1, 0, 0, 1),
    "VladimirSinitsin__flir_extractor/bin/examples/frame.fff": (1, 0, 1, 1),
    **{f"frkatona__ThermalImageFitter/Nov19/FLIR{number}.jpg": (1, 1, 0, 1) for number in range(2167, 2216, 2)},
}


def _by_flyr(frame: FrameReference) -> bool | None:
    """Whether flyr's counts equal ours; None where it does not read the file."""
    if frame.path.name == "DJI_XT2.jpg":
        # It takes the little-endian directory for a big-endian one and walks 33 million slots before it gives up.
        return None
    try:
        counts = flyr.unpack(str(frame.path))._FlyrThermogram__thermal
    except Exception:
        return None
    return bool(np.array_equal(counts, frame.read_counts()))


def _by_flirpy(frame: FrameReference) -> bool | None:
    """Whether flirpy's counts equal ours; None where it offers no reader or gives no finite temperature."""
    if frame.path.suffix.lower() == ".jpg":
        return None
    theirs = Seq(str(frame.path))[frame.index]
    # It takes compressed samples for counts: of these it says nothing, so its own temperatures must judge.
    with np.errstate(all="ignore"):
        if frame.samples.encoding != "raw" or not np.isfinite(theirs.get_radiometric_image()).any():
            return None
    return bool(np.array_equal(theirs.get_image(), frame.read_counts()))


def _exiftool(paths: Sequence[Path]) -> list[dict[str, object]]:
    """Return what exiftool prints for the first frame of each file, as numbers."""
    program = shutil.which("exiftool")
    if program is None:
        pytest.skip("exiftool is not installed (Debian: libimage-exiftool-perl)")
    command = [program, "-n", "-j", "-FLIR:all", *map(str, paths)]
    printed: list[dict[str, object]] = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    assert [each["SourceFile"] for each in printed] == [str(path) for path in paths]
    return printed


def _agrees_with_exiftool(frame: FrameReference, printed: dict[str, object]) -> bool | None:
    """Whether parameters, time and size equal exiftool's; None where it finds no camera information."""
    if "PlanckR1" not in printed:
        return None
    p = frame.parameters
    rows, columns = frame.shape
    expected = {
        "Emissivity": p.emissivity,
        "ObjectDistance": p.object_distance_m,
        "ReflectedApparentTemperature": p.reflected_temperature_K - ZERO_CELSIUS_K,
        "AtmosphericTemperature": p.atmospheric_temperature_K - ZERO_CELSIUS_K,
        "IRWindowTemperature": p.window_temperature_K - ZERO_CELSIUS_K,
        "IRWindowTransmission": p.window_transmission,
        "PlanckR1": p.planck_r1,
        "PlanckB": p.planck_b,
        "PlanckF": p.planck_f,
        "PlanckO": p.planck_o,
        "PlanckR2": p.planck_r2,
        "AtmosphericTransAlpha1": p.atmosphere_alpha1,
        "AtmosphericTransAlpha2": p.atmosphere_alpha2,
        "AtmosphericTransBeta1": p.atmosphere_beta1,
        "AtmosphericTransBeta2": p.atmosphere_beta2,
        "AtmosphericTransX": p.atmosphere_x,
        "RawThermalImageWidth": columns,
        "RawThermalImageHeight": rows,
        "RawValueRangeMin": frame.limits.raw_minimum,
        "RawValueRangeMax": frame.limits.raw_maximum,
    }
    # exiftool prints float32 with up to 15 digits after its own kelvin conversion.
    assert {key: float(str(printed[key])) for key in expected} == pytest.approx(expected, rel=1e-6, abs=1e-4)
    assert str(printed["CameraModel"]).strip() == frame.camera.model
    assert str(printed["CameraSerialNumber"]).strip() == frame.camera.serial
    local = frame.time + np.timedelta64(frame.utc_offset_minutes, "m")
    date, clock = str(local).split("T")
    assert str(printed["DateTimeOriginal"]).startswith(f"{date.replace('-', ':')} {clock}")
    return True


@pytest.mark.real_data
def test_file_by_reader_table(real_file) -> None:
    table = {}
    printed = _exiftool([real_file(name) for name in FILES])
    for (name, expected), by_exiftool in zip(FILES.items(), printed, strict=True):
        frames, rejected = index_frames([real_file(name)])
        assert rejected == []
        flyr_says = [_by_flyr(frame) for frame in frames[:1]]
        flirpy_says = [_by_flirpy(frame) for frame in frames]
        exiftool_says = [_agrees_with_exiftool(frames[0], by_exiftool)]
        assert False not in flyr_says + flirpy_says, f"{name}: another reader has other counts"
        table[name] = (len(frames), flyr_says.count(True), flirpy_says.count(True), exiftool_says.count(True))
        assert table[name] == expected, name
    print(f"{'frames':>8}{'flyr':>6}{'flirpy':>8}{'exiftool':>10}")
    for name, (ours, *others) in table.items():
        print(f"{ours:8d}{others[0]:6d}{others[1]:8d}{others[2]:10d}  {name}")


@pytest.mark.parametrize("encoding", ["raw", "png"])
def test_flyr_and_exiftool_read_our_jpeg(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "a.jpg"
    written = jpeg(path, encoding, rows=48, columns=64)
    (frame,), _ = index_frames([path])
    assert _by_flyr(frame) is True
    assert _agrees_with_exiftool(frame, *_exiftool([path])) is True
    metadata = flyr.unpack(str(path)).metadata
    assert metadata["planck_r2"] == written.parameters.planck_r2
    assert metadata["emissivity"] == written.parameters.emissivity


def test_flirpy_and_exiftool_read_our_sequence(tmp_path: Path) -> None:
    path = tmp_path / "a.seq"
    written = sequence(path, frames=4, rows=48, columns=64)
    frames, _ = index_frames([path])
    assert [_by_flirpy(frame) for frame in frames] == [True] * 4
    assert _agrees_with_exiftool(frames[0], *_exiftool([path])) is True
    seconds = [frame.time.astype("datetime64[s]").astype(int) for frame in written]
    assert [theirs.meta["Timestamp"] for theirs in Seq(str(path))] == seconds


def test_ordinary_viewers_open_our_jpeg(tmp_path: Path) -> None:
    from PIL import Image

    path = tmp_path / "a.jpg"
    written = jpeg(path, rows=48, columns=64)
    with Image.open(path) as picture:
        assert picture.size == (64, 48)
        assert picture.getexif()[0x0110] == "FLIR SC660"
        grey = np.asarray(picture.convert("L"), float)
    # Only the look is stored twice: bright where the counts are high.
    assert np.corrcoef(grey.ravel(), written.counts.ravel().astype(float))[0, 1] > 0.98


@pytest.mark.real_data
def test_all_readers_agree_where_there_is_no_air(real_file) -> None:
    path = real_file("gtatters__Thermimage/inst/extdata/IR_2412.jpg")
    frame = read_frame(path)
    ours = calibrate(frame.counts, override(frame.parameters, object_distance_m=0.0))
    theirs = flyr.unpack(str(path)).adjust_metadata(object_distance=0.0).celsius
    # float32 against float64 near 300 K: 2e-5 K.
    np.testing.assert_allclose(ours, theirs, atol=5e-5)
    with_air = np.abs(calibrate(frame.counts, frame.parameters) - flyr.unpack(str(path)).celsius).max()
    # The two-half-path form of the public readers is off by hundredths of a kelvin over 1 m.
    assert 0.03 < with_air < 0.06
