"""Statistics of regions in frames of known temperature, and what lies outside the calibrated range."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.thermography.flir_mutations import CAMERA, HEADER, LIMITS, PARAMETERS, TIME, frame, patch, sequence
from thermography.common import ThermographyError
from thermography.evaluation import (
    OVERRANGE,
    UNDERRANGE,
    calibrated_counts,
    count_temperatures,
    evaluate_regions,
    find_isotherm,
    read_profile,
    subtract_frames,
    thermogram,
)
from thermography.io.flir import index_frames, read_frame
from thermography.io.flir_writer import write_jpeg, write_sequence
from thermography.io.frame import CalibratedRange, Frame
from thermography.io.other_cameras import StackOptions, index_recordings
from thermography.io.region import Region
from thermography.radiometry.planck import (
    calibrate,
    counts_from_temperature,
    override,
    temperature_from_counts,
    temperature_of_signal,
)
from thermography.radiometry.uncertainty import InputUncertainty, temperature_uncertainty

#: Temperature of the simulated picture, degC: a plane.
ROWS, COLUMNS = np.mgrid[:48, :64]
PLANE = 25.0 + 0.5 * COLUMNS + 0.2 * ROWS
BOX = Region("box", "box", ((10, 20), (13, 22)))


def picture(celsius: np.ndarray, *, seconds: int = 0, **header: object) -> Frame:
    counts = np.rint(counts_from_temperature(celsius, PARAMETERS)).astype(np.uint16)
    time = TIME + np.timedelta64(seconds, "s")
    return Frame(counts=counts, parameters=PARAMETERS, time=time, **{**HEADER, **header})


def references(path, *frames):
    write_sequence(path, frames)
    return index_frames([path])[0]


@pytest.mark.parametrize(
    ("region", "pixels"),
    [
        (BOX, 12),
        (Region("s", "spot", ((10.4, 20.4),)), 1),
        (Region("e", "ellipse", ((0, 0), (62, 40))), round(np.pi * 31.5 * 20.5)),
        (Region("l", "line", ((0, 0), (30, 10), (30, 47))), 68),
        (Region("p", "polygon", ((0, 0), (20, 0), (0, 20))), 231),
        (Region("part", "box", ((60, 40), (90, 90))), 32),
    ],
    ids=lambda value: value.kind if isinstance(value, Region) else "",
)
def test_a_region_has_the_pixels_of_its_outline(region, pixels):
    rows, columns, mask = region.pixels((48, 64))
    assert int(mask.sum()) == pytest.approx(pixels, rel=0.005)
    assert mask.shape == PLANE[rows, columns].shape


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("x", "circle", ((0, 0),)), "give one of spot, box, ellipse, line, polygon"),
        (("x", "polygon", ((0, 0), (1, 1))), "a polygon of 2 points; it has 3 or more"),
        (("x", "box", ((0, 0), (1, np.nan))), "points"),
        (("x", "spot", ((0, 0),), 1.2), "emissivity = 1.2"),
    ],
)
def test_what_is_no_region_is_refused(arguments, told):
    with pytest.raises(ThermographyError, match=f"region 'x': .*{told}"):
        Region(*arguments)


def test_statistics_of_a_plane_are_those_of_its_formula(tmp_path):
    frames = references(tmp_path / "a.seq", picture(PLANE), picture(PLANE + 30.0, seconds=60))
    found = evaluate_regions(frames, [BOX, Region("spot", "spot", ((63, 47),))])
    inside = PLANE[20:23, 10:14]
    step_K = 0.02  # of a count
    assert found["region"].values.tolist() == ["whole picture", "box", "spot"]
    box = found.sel(region="box")
    for name, value in (("maximum", inside.max()), ("minimum", inside.min()), ("mean", inside.mean())):
        np.testing.assert_allclose(box[name], [value, value + 30.0], atol=step_K)
    np.testing.assert_allclose(box["standard_deviation"], inside.std(), atol=step_K)
    assert box["maximum_column"].values.tolist() == [13, 13] and box["maximum_row"].values.tolist() == [22, 22]
    assert box["minimum_column"].values.tolist() == [10, 10] and box["minimum_row"].values.tolist() == [20, 20]
    whole = found.sel(region="whole picture")
    assert whole["pixels"].values.tolist() == [48 * 64] * 2 and not whole["overrange"].any()
    np.testing.assert_allclose(whole["mean"], [PLANE.mean(), PLANE.mean() + 30.0], atol=step_K)
    np.testing.assert_allclose(found["maximum"][:, 0], found["maximum"][:, 2])


def test_uncertainty_is_that_of_a_pixel_for_extremes_and_averages_the_noise_of_a_mean(tmp_path):
    inputs = InputUncertainty(netd_K=2.0)
    found = evaluate_regions(references(tmp_path / "a.seq", picture(PLANE)), [BOX], inputs=inputs).sel(region="box")[
        {"time": 0}
    ]
    one = temperature_uncertainty(float(found["maximum"]), PARAMETERS, inputs)
    assert float(found["maximum_u"]) == pytest.approx(float(one.total_u))
    mean = temperature_uncertainty(float(found["mean"]), PARAMETERS, inputs)
    assert float(found["mean_u"]) == pytest.approx(np.hypot(mean.common_u, mean.per_frame_u / np.sqrt(12)))


def test_each_region_has_its_own_emissivity(tmp_path):
    frames = references(tmp_path / "a.seq", picture(PLANE))
    found = evaluate_regions(frames, [replace(BOX, name="bright", emissivity=0.5), BOX])[{"time": 0}]
    counts = frames[0].read_counts()[20:23, 10:14]
    expected = calibrate(counts, override(PARAMETERS, emissivity=0.5))
    assert float(found["mean"].sel(region="bright")) == pytest.approx(float(expected.mean()), abs=1e-3)
    assert found["emissivity"].values.tolist() == pytest.approx([0.95, 0.5, 0.95])


def test_a_difference_to_a_reference_keeps_only_what_does_not_cancel(tmp_path):
    level = np.full(PLANE.shape, 60.0)
    frames = references(tmp_path / "a.seq", picture(level))
    other = Region("other", "box", ((40, 20), (43, 22)))
    found = evaluate_regions(frames, [BOX, other], reference="other", inputs=InputUncertainty(netd_K=0.0))[{"time": 0}]
    assert float(found["difference"].sel(region="box")) == 0.0
    # Only the quantisation is left of an uncertainty of more than 1 K.
    assert float(found["mean_u"].sel(region="box")) > 1.0 and float(found["difference_u"].sel(region="box")) < 0.01
    painted = replace(other, emissivity=0.8)
    found = evaluate_regions(frames, [BOX, painted], reference="other")[{"time": 0}]
    assert float(found["difference_u"].sel(region="box")) > 0.3


def test_pixels_beyond_the_range_are_counted_and_in_no_mean_and_the_extreme_is_the_limit(tmp_path):
    hot = PLANE.copy()
    hot[5:7, 5:10] = 140.0
    hot[0, 0] = -60.0
    limits = CalibratedRange(233.15, 373.15, 8812, 65535)
    frames = references(tmp_path / "a.seq", picture(hot, limits=limits))
    found = evaluate_regions(frames, [Region("hot", "box", ((5, 5), (9, 6)))])[{"time": 0}]
    whole, region = found.sel(region="whole picture"), found.sel(region="hot")
    assert (int(whole["overrange"]), int(whole["underrange"])) == (10, 1)
    # The range ends at a reading of 100 degC; a surface of emissivity 0.95 that reads so is warmer.
    limit = calibrate(np.array([calibrated_counts(frames[0]).highest], np.uint16), PARAMETERS)[0]
    assert 100.0 < limit < 105.0
    assert float(temperature_of_signal(calibrated_counts(frames[0]).highest, PARAMETERS)) == pytest.approx(100.0)
    assert float(whole["maximum"]) == pytest.approx(limit, abs=0.01) and np.isnan(whole["maximum_u"])
    assert (int(whole["maximum_column"]), int(whole["maximum_row"])) == (5, 5)
    sound = (hot < 100) & (hot > -40)
    assert float(whole["mean"]) == pytest.approx(hot[sound].mean(), abs=0.01)
    assert np.isnan(region["mean"]) and float(region["maximum"]) == float(region["minimum"]) == float(whole["maximum"])
    marked = thermogram(frames[0])
    assert (marked["flag"].values == OVERRANGE).sum() == 10 and marked["flag"].values[0, 0] == UNDERRANGE
    assert float(marked["temperature"][5, 5]) == pytest.approx(140.0, abs=0.05)


def test_a_frame_that_cannot_be_read_is_left_out_and_named(tmp_path):
    path = tmp_path / "a.seq"
    sequence(path, frames=3)
    place = 0x200 + 2476 + 0x20 + 9
    patch(path, (place, bytes([path.read_bytes()[place] ^ 1])))
    found = evaluate_regions(index_frames([path])[0])
    assert found["frame"].values.tolist() == [1, 2]
    (left_out,) = json.loads(found.attrs["rejected"])
    assert left_out["index"] == 0 and "damaged samples" in left_out["reason"]


def test_regions_outside_the_picture_and_names_that_are_taken_are_refused(tmp_path):
    frames = references(tmp_path / "a.seq", picture(PLANE))
    with pytest.raises(ThermographyError, match="lies outside the picture of 64 x 48 pixels"):
        evaluate_regions(frames, [Region("far", "spot", ((64, 0),))])
    with pytest.raises(ThermographyError, match="give each its own name"):
        evaluate_regions(frames, [BOX, BOX])
    with pytest.raises(ThermographyError, match="reference = 'x': there are the regions whole picture, box"):
        evaluate_regions(frames, [BOX], reference="x")


def test_temperatures_of_other_cameras_are_evaluated_as_they_are_stored(tmp_path):
    celsius = PLANE + 300.0
    celsius[0, 0] = np.nan
    np.save(tmp_path / "a.npy", celsius)
    frames, _ = index_recordings([tmp_path / "a.npy"], StackOptions(unit="degC", start=TIME, emissivity=0.95))
    found = evaluate_regions(frames, [BOX, replace(BOX, name="bright", emissivity=0.5)])[{"time": 0}]
    stored = frames[0].parameters
    bright = temperature_from_counts(counts_from_temperature(335.9, stored), override(stored, emissivity=0.5))
    np.testing.assert_allclose(found["maximum"], [np.nanmax(celsius), 335.9, float(bright)])
    assert found["pixels"].values.tolist() == [48 * 64 - 1, 12, 12]


def test_profile_histogram_isotherm_and_difference(tmp_path):
    first, second = references(tmp_path / "a.seq", picture(PLANE), picture(PLANE + 5.0, seconds=60))
    marked = thermogram(first)
    along = read_profile(marked, Region("l", "line", ((0, 0), (30, 40))))
    assert float(along["distance"][-1]) == pytest.approx(50.0, rel=0.15)
    np.testing.assert_allclose(along, PLANE[along["row"], along["column"]], atol=0.05)
    counted = count_temperatures(marked, BOX, bins=4)
    assert int(counted.sum()) == 12 and PLANE.min() < float(counted["temperature"][0]) < PLANE[22, 13]
    area = find_isotherm(marked, above=40.0, below=45.0)
    assert int(area.sum()) == pytest.approx(((PLANE > 40) & (PLANE <= 45)).sum(), abs=15)
    change = subtract_frames(thermogram(second), marked)
    np.testing.assert_allclose(change, 5.0, atol=0.05)
    assert change.attrs["units"] == "K"
    other = replace(picture(PLANE), camera=replace(CAMERA, serial="2"))
    with pytest.raises(ThermographyError, match="SC660 2 with 64 x 48 pixels and by FLIR SC660 404003980"):
        subtract_frames(thermogram(other), marked)
    with pytest.raises(ThermographyError, match="a profile needs a line within the picture"):
        read_profile(marked, BOX)


def test_a_scene_range_stored_as_raw_limits_is_no_calibrated_range(tmp_path):
    """Some cameras store the extremes of the scene there; the range in kelvin decides where both are given."""
    one = frame()
    limits = replace(LIMITS, raw_minimum=int(one.counts.min()), raw_maximum=int(one.counts.max()))
    write_jpeg(tmp_path / "a.jpg", one.counts, PARAMETERS, TIME, camera=CAMERA, limits=limits)
    found = evaluate_regions(index_frames([tmp_path / "a.jpg"])[0])
    assert not found["overrange"].any() and not found["underrange"].any()


REAL = {
    "gpereyrairujo__IRimage/Windows/IRimage/test/test_image.jpg": (1, 37.44),
    "gtatters__Thermimage/inst/extdata/SampleSEQ.seq": (2, 38.23),
    "gtatters__Thermimage/inst/extdata/SampleCSQ.csq": (8, 35.41),
    "LJMUAstroecology__flirpy/test/test_data/frame_000000_le.fff": (1, 29.49),
}


@pytest.mark.real_data
@pytest.mark.parametrize("name", REAL)
def test_maxima_of_a_real_file_of_every_kind(real_file, name):
    count, maximum = REAL[name]
    found = evaluate_regions(index_frames([real_file(name)])[0])
    assert found.sizes["time"] == count and float(found["maximum"][:, 0].max()) == pytest.approx(maximum, abs=0.01)


@pytest.mark.real_data
def test_a_real_picture_has_the_extremes_that_the_vendor_exports(real_file):
    folder = "gpereyrairujo__IRimage/Windows/IRimage/test"
    exported = np.loadtxt(real_file(f"{folder}/csv/test_image.csv"), delimiter=",", encoding="utf-8-sig")
    whole = evaluate_regions(index_frames([real_file(f"{folder}/test_image.jpg")])[0])[{"time": 0, "region": 0}]
    for name, value in (("maximum", exported.max()), ("minimum", exported.min()), ("mean", exported.mean())):
        assert float(whole[name]) == pytest.approx(value, abs=0.005)
    assert exported[int(whole["maximum_row"]), int(whole["maximum_column"])] == exported.max()


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("name", "region", "printed"),
    [
        ("gpereyrairujo__IRimage/Windows/IRimage/test/test_image.jpg", "Sp1", 31.4),
        ("gpereyrairujo__IRimage/Windows/IRimage/test/test_image.jpg", "Sp2", 24.3),
        ("SanNianYiSi__thermal_parser/images/FLIR_E40.jpg", "spot 1", 20.9),
        ("gtatters__Thermimage/inst/extdata/IR_2412.jpg", "box 1", 28.1),
    ],
)
def test_stored_regions_have_the_means_that_the_camera_printed_into_its_picture(real_file, name, region, printed):
    found = evaluate_regions(index_frames([real_file(name)])[0]).sel(region=region)
    assert round(float(found["mean"][0]), 1) == printed


@pytest.mark.real_data
def test_a_part_heated_beyond_the_range_of_its_camera_is_given_at_least_the_limit(real_file):
    paths = [real_file(f"frkatona__ThermalImageFitter/Nov19/FLIR{number}.jpg") for number in range(2167, 2216, 2)]
    whole = evaluate_regions(index_frames(paths)[0]).sel(region="whole picture")
    beyond = whole["overrange"].values > 0
    assert beyond.any() and not beyond.all()
    limit = float(whole["maximum"].max())
    assert (whole["maximum"].values[beyond] == limit).all() and limit == pytest.approx(311.7, abs=0.1)
    assert read_frame(paths[0]).limits.maximum_K == pytest.approx(573.15)
