"""Fields against scenes whose temperature is known in every cell: what noise, masks, order of averaging and knocks do to them."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.thermography.plan_scene import DISCS, GRID, SC660, START, Scene, cell_truth, record, smooth_field
from thermography.contract import FIELDS
from thermography.fields.inputs import ReductionError
from thermography.fields.still import reduce_frames
from thermography.fields.total_uncertainty import evaluate_uncertainty
from thermography.radiometry.averaging import Accumulator, mean_temperature
from thermography.radiometry.planck import calibrate, override
from thermography.registration.displacement import RegistrationSpan
from thermography.registration.plan import mask_discs
from thermography.registration.register import register

SECOND = np.timedelta64(1, "s")


@pytest.fixture(scope="module")
def scene():
    """A still table with 4 K colder discs, its frame without noise, and its registration."""
    still = Scene(disc_K=-4.0)
    image = still.render()
    return image, register(image, DISCS, grid=GRID), still


def edges(*seconds):
    return START + np.array(seconds) * SECOND


def test_field_of_one_frame_per_cycle_is_true_within_its_noise(scene, rng, tmp_path):
    image, registration, _ = scene
    frames = record(tmp_path / "a.seq", (image + rng.normal(0, 0.05, image.shape) for _ in range(6)))
    fields = reduce_frames(frames, registration, GRID, edges(*range(7)))
    error = fields["temperature"].values - cell_truth()
    # A cell holds about 22 pixels of 50 mK: 10.7 mK; partly seen cells a little more.
    assert np.sqrt(np.nanmean(error**2)) < 0.012
    assert abs(np.nanmean(error)) < 0.002
    # The stated uncertainty is that error: 28,000 values fix the ratio to below 1 %, cells differ by their geometry.
    ratio = np.nanmean((error / fields["temperature_noise_u"].values) ** 2)
    assert ratio == pytest.approx(1, abs=0.15)


def test_field_without_noise_shows_no_bias_anywhere(scene, tmp_path):
    image, registration, _ = scene
    frames = record(tmp_path / "a.seq", [image])
    fields = reduce_frames(frames, registration, GRID, edges(0, 1))
    error = fields["temperature"].values[0] - cell_truth()
    # Counts are whole numbers of 6 mK; a cell averages 22 of them. Its field is curved by 0.3 mK over a cell.
    assert np.nanmax(np.abs(error)) < 0.010
    assert np.sqrt(np.nanmean(error**2)) < 0.002


def test_discs_do_not_leak_into_their_neighbours(scene, tmp_path):
    """The same table with discs 20 K colder gives the same field."""
    _, registration, _ = scene
    images = [Scene(disc_K=disc_K).render() for disc_K in (-4.0, -24.0)]
    frames = record(tmp_path / "a.seq", images)
    fields = reduce_frames(frames, registration, GRID, edges(0, 1, 2))
    assert np.nanmax(np.abs(np.diff(fields["temperature"].values, axis=0))) < 1e-3
    x, y = np.meshgrid(GRID.x_mm, GRID.y_mm)
    centres = mask_discs(np.stack([x, y], axis=-1), DISCS, margin_mm=0.0)
    assert np.isnan(fields["temperature"].values[0][centres]).mean() > 0.9


def test_dataset_keeps_its_contract(scene, tmp_path):
    image, registration, _ = scene
    frames = record(tmp_path / "a.seq", [image] * 3)
    fields = evaluate_uncertainty(
        reduce_frames(frames, registration, GRID, edges(0, 1, 2, 3)), [frames[0].parameters] * 3
    )
    for name, (dims, units, kind) in FIELDS.items():
        assert fields[name].dims == dims
        assert fields[name].dtype.kind == kind
        assert fields[name].attrs.get("units", "") == units
    assert fields["temperature"].attrs["units_metadata"] == "temperature: on_scale"
    assert fields["temperature_rise"].attrs["units_metadata"] == "temperature: difference"
    assert (fields["temperature_rise"].values[0][np.isfinite(fields["temperature"].values[0])] == 0).all()


def test_spread_and_rate_follow_a_known_ramp(scene, tmp_path):
    image, registration, _ = scene
    frames = record(tmp_path / "a.seq", [image + 0.1 * i for i in range(12)])
    fields = reduce_frames(frames, registration, GRID, edges(0, 4, 8, 12))
    # Four frames 0.1 K apart: standard deviation 0.1291 K; rounding to 6 mK counts adds 2 mK of noise.
    assert np.nanmedian(fields["temperature_spread"].values) == pytest.approx(0.1 * np.std(range(4), ddof=1), abs=1e-3)
    assert np.nanmedian(fields["temperature_rate"].values) == pytest.approx(0.1 * 3600, rel=1e-3)
    assert np.nanmedian(fields["temperature_rise"].values[2]) == pytest.approx(0.8, abs=1e-3)
    assert np.unique(fields["count"].values).tolist() == [0, 4]


def test_guard_calibrates_a_transient_frame_by_frame(scene, tmp_path):
    """A spark of 40 K in one of ten frames: the sums alone would err by tens of millikelvin."""
    image, registration, _ = scene

    def spark(x, y):
        return smooth_field(x, y) + 40.0 * ((np.abs(x - 250) < 15) & (np.abs(y - 90) < 15))

    images = [Scene(disc_K=-4.0, field=spark).render() if i == 4 else image for i in range(10)]
    frames = record(tmp_path / "a.seq", images)
    fields = reduce_frames(frames, registration, GRID, edges(0, 10))
    hot = fields.sel(x=slice(240, 260), y=slice(80, 100))
    truth = smooth_field(*np.meshgrid(hot["x"], hot["y"])) + 4.0
    np.testing.assert_allclose(hot["temperature"].values[0], truth, atol=0.010)
    assert (hot["quality_flag"].values & 2 == 2).all()
    assert (fields["quality_flag"].sel(x=slice(500, 600)).values & 2 == 0).all()
    counts = np.stack([frame.read().counts for frame in frames])
    sums = Accumulator(counts.shape[1:])
    sums.add(counts)
    alone = mean_temperature(sums.statistics(), SC660)
    error = np.abs(alone.mean - calibrate(counts, SC660).mean(axis=0, dtype=float))
    assert error.max() > 0.02
    assert (error <= alone.bound_K + 2e-6).all()


@pytest.mark.parametrize("block_s", [0.0, 10.0])
@pytest.mark.parametrize("per_cycle", [1, 4])
def test_a_pixel_without_a_temperature_in_one_frame_empties_nothing(scene, rng, tmp_path, per_cycle, block_s):
    """A count of zero lies below any temperature."""
    image, registration, _ = scene
    path = tmp_path / "a.seq"
    frames = record(path, (image + rng.normal(0, 0.05, image.shape) for _ in range(2 * per_cycle)))
    whole = reduce_frames(frames, registration, GRID, edges(0, per_cycle, 2 * per_cycle), block_s=block_s)
    column, row = np.rint(registration.to_sensor(np.array([[302.0, 92.0]]))[0]).astype(int)
    data = bytearray(path.read_bytes())
    place = frames[-1].segments[0][0] + frames[-1].samples.offset + 2 * (row * image.shape[1] + column)
    data[place : place + 2] = bytes(2)
    path.write_bytes(data)
    fields = reduce_frames(frames, registration, GRID, edges(0, per_cycle, 2 * per_cycle), block_s=block_s)
    for name in ("temperature", "temperature_rise", "temperature_noise_u", "count"):
        np.testing.assert_array_equal(np.isfinite(fields[name]), np.isfinite(whole[name]))
    difference = (fields["temperature"] - whole["temperature"]).values
    # One of 22 pixels of 50 mK takes no part, or a pixel has one frame less: a few millikelvin.
    assert np.nanmax(np.abs(difference)) < 0.015
    assert np.count_nonzero(np.nan_to_num(difference)) <= 9


def test_changing_parameters_and_corrections_are_applied_frame_by_frame(scene, tmp_path):
    image, registration, _ = scene
    frames = record(tmp_path / "a.seq", [image] * 4, interval_s=1)

    def dim(frame):
        return override(frame.parameters, emissivity=0.97 if frame.index < 2 else 0.90)

    fields = reduce_frames(
        frames, registration, GRID, edges(0, 4), override=dim, correction_K=np.array([0, 0, 1.0, 1.0])
    )
    one_by_one = reduce_frames(
        frames, registration, GRID, edges(0, 4), override=dim, correction_K=np.array([0, 0, 1.0, 1.0]), block_s=0
    )
    assert fields.sizes["time"] == 2
    assert one_by_one.sizes["time"] == 4
    np.testing.assert_allclose(fields["temperature"], one_by_one["temperature"], atol=1e-5)
    step = fields["frame_temperature"].isel(time=1) - fields["frame_temperature"].isel(time=0)
    bright = reduce_frames(
        frames[:1], registration, GRID, edges(0, 4), override=lambda f: replace(f.parameters, emissivity=0.9)
    )
    expected = bright["frame_temperature"].values[0] + 1.0 - fields["frame_temperature"].values[0]
    np.testing.assert_allclose(step, expected, atol=1e-4)


def test_knocked_camera_keeps_the_field_in_place(scene, tmp_path):
    image, registration, still = scene
    knocked = replace(still, shift_px=(3.0, -2.0))
    after = knocked.render()
    frames = record(tmp_path / "a.seq", [image, image, after, after])
    spans = [RegistrationSpan(0, registration), RegistrationSpan(2, register(after, DISCS, grid=GRID))]
    fields = reduce_frames(frames, spans, GRID, edges(0, 1, 3, 4))
    assert (fields["count"].max(("x", "y")) == [1, 2, 1]).all()
    assert (fields["quality_flag"].values[1] & 4 == 4).all()
    error = fields["temperature"].values - cell_truth()
    assert np.nanmax(np.abs(error)) < 0.010


def test_frames_outside_cycles_are_named_and_cycles_without_frames_are_flagged(scene, tmp_path):
    image, registration, _ = scene
    frames = record(tmp_path / "a.seq", [image] * 3, interval_s=10)
    bounds = np.array([[0, 5], [8, 9], [18, 22]]) * SECOND + START
    fields = reduce_frames(frames, registration, GRID, bounds)
    assert json.loads(fields.attrs["frames_outside_cycles"]) == ["a.seq#1"]
    assert fields["frame_cycle"].values.tolist() == [1, 0, 3]
    assert np.isnat(fields["cycle_time"].values[1])
    assert (fields["quality_flag"].values[1] == 16).all()
    assert np.isnan(fields["temperature"].values[1]).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cycle_bounds": edges(0, 5, 3)}, r"cycle 2 ends at .*, before it starts"),
        ({"cycle_bounds": np.stack([edges(0, 2), edges(1, 3)])}, r"cycle 2 starts at .*, before cycle 1 ends"),
        (
            {"cycle_bounds": edges(100, 200)},
            r"no frame lies within a cycle: .* check the time zones and the clock offset",
        ),
        (
            {"correction_K": np.zeros(3)},
            r"correction_K has shape \(3,\); it needs one finite value for each of 2 frames",
        ),
        ({"references": []}, "there is no frame to reduce"),
        ({"references": "reversed"}, r"frame 0 has the time .*, not after .*; sort the frames"),
        ({"references": "small"}, r"has \(8, 8\) pixels, the registered frames \(480, 640\)"),
        ({"registration": "late"}, r"registrations start at frames \[1\]; they must start at 0 and rise"),
    ],
)
def test_faults_are_named(scene, tmp_path, change, message):
    image, registration, _ = scene
    frames = record(tmp_path / "a.seq", [image] * 2)
    arguments = {"references": frames, "registration": registration, "cycle_bounds": edges(0, 1, 2)} | change
    if change.get("references") == "reversed":
        arguments["references"] = frames[::-1]
    if change.get("references") == "small":
        arguments["references"] = record(tmp_path / "b.seq", [image[:8, :8]])
    if change.get("registration") == "late":
        arguments["registration"] = [RegistrationSpan(1, registration)]
    with pytest.raises(ReductionError, match=message):
        reduce_frames(arguments.pop("references"), arguments.pop("registration"), GRID, **arguments)


def test_a_knock_of_3_px_at_frame_40_is_found_at_frame_40(scene, rng, tmp_path):
    image, registration, still = scene
    after = replace(still, shift_px=(2.5, -1.7)).render()
    frames = record(
        tmp_path / "a.seq", ((image if i < 40 else after) + rng.normal(0, 0.05, image.shape) for i in range(50))
    )
    fields = reduce_frames(frames, registration, GRID, edges(0, 25, 50))
    (knock,) = json.loads(fields.attrs["knocks"])
    assert (knock["frame"], knock["index"]) == ("a.seq#40", 40)
    assert knock["shift_px"] == pytest.approx([2.5, -1.7], abs=0.05)
    error = fields["temperature"].values - cell_truth()
    assert np.sqrt(np.nanmean(error**2)) < 0.005
    assert np.nanmax(fields["frame_shift"].values) < 0.2
    assert json.loads(fields.attrs["frames_shaken"]) == json.loads(fields.attrs["frames_unchecked"]) == []


def test_a_single_shaken_frame_is_reported_and_no_warm_up_is_taken_for_a_knock(scene, rng, tmp_path):
    image, registration, still = scene
    shaken = replace(still, shift_px=(1.5, 0.0)).render()

    hot = Scene(disc_K=-4.0, field=lambda x, y: smooth_field(x, y) + 0.015 * x).render()

    def warm(n):
        return (shaken if n == 3 else image + (hot - image) * n / 7) + rng.normal(0, 0.05, image.shape)

    frames = record(tmp_path / "a.seq", (warm(n) for n in range(7)))
    fields = reduce_frames(frames, registration, GRID, edges(0, 7))
    assert json.loads(fields.attrs["knocks"]) == []
    assert json.loads(fields.attrs["frames_shaken"]) == ["a.seq#3"]


def test_the_first_frame_is_unchecked_if_its_discs_have_no_contrast(scene, rng, tmp_path):
    _, registration, _ = scene
    plain = Scene(discs=()).render() + rng.normal(0, 0.05, (480, 640))
    frames = record(tmp_path / "a.seq", [plain] * 2)
    fields = reduce_frames(frames, registration, GRID, edges(0, 2))
    # The first one is what the others' picture of the table is compared with.
    assert json.loads(fields.attrs["frames_unchecked"]) == ["a.seq#0"]
