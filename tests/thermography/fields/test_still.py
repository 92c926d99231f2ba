"""Fields of a still table: noise, masks and knocks against scenes known in every cell; resumed reductions; how a recording is divided."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.thermography.plan_scene import (
    DISCS,
    GRID,
    SC660,
    START,
    Scene,
    assert_equal_bits,
    cell_truth,
    edges,
    record,
    registered,
    smooth_field,
)
from thermography.common import FIELDS
from thermography.fields import still
from thermography.fields.blocks import NO_CYCLE, ReductionError, RegisteredSensor, cut_blocks, make_frame_series
from thermography.fields.objects import pixels_off
from thermography.fields.resampling import plan_weights
from thermography.fields.still import (
    STRETCH_FRAMES,
    CheckpointError,
    choose_frames,
    cut_stretches,
    describe_reduction,
    gather_frames,
    reduce_frames,
    reduce_portion,
    reduce_stretch,
)
from thermography.fields.total_uncertainty import evaluate_uncertainty
from thermography.io.frame import PlainSamples
from thermography.radiometry.averaging import Accumulator, mean_temperature
from thermography.radiometry.camera import Detector
from thermography.radiometry.planck import calibrate, override
from thermography.registration.displacement import RegistrationSpan, monitor_fiducials
from thermography.registration.plan import mask_discs

pytestmark = pytest.mark.long

SECOND = np.timedelta64(1, "s")


#: A still table with 4 K colder discs, and its frame without noise.
SCENE = Scene(disc_K=-4.0)
STILL = SCENE.render()


def test_field_of_one_frame_per_cycle_is_true_within_its_noise(rng, tmp_path):
    frames = record(tmp_path / "a.seq", (STILL + rng.normal(0, 0.05, STILL.shape) for _ in range(6)))
    fields = reduce_frames(frames, registered(), GRID, edges(*range(7)))
    error = fields["temperature"].values - cell_truth()
    # A cell holds about 22 pixels of 50 mK: 10.7 mK; partly seen cells a little more.
    assert np.sqrt(np.nanmean(error**2)) < 0.012
    assert abs(np.nanmean(error)) < 0.002
    # The stated uncertainty is that error: 28,000 values fix the ratio to below 1 %, cells differ by their geometry.
    ratio = np.nanmean((error / fields["temperature_noise_u"].values) ** 2)
    assert ratio == pytest.approx(1, abs=0.15)


def test_field_without_noise_shows_no_bias_anywhere(tmp_path):
    frames = record(tmp_path / "a.seq", [STILL])
    fields = reduce_frames(frames, registered(), GRID, edges(0, 1))
    error = fields["temperature"].values[0] - cell_truth()
    # Counts are whole numbers of 6 mK; a cell averages 22 of them. Its field is curved by 0.3 mK over a cell.
    assert np.nanmax(np.abs(error)) < 0.010
    assert np.sqrt(np.nanmean(error**2)) < 0.002


def test_discs_do_not_leak_into_their_neighbours(tmp_path):
    """The same table with discs 20 K colder gives the same field."""
    images = [Scene(disc_K=disc_K).render() for disc_K in (-4.0, -24.0)]
    frames = record(tmp_path / "a.seq", images)
    fields = reduce_frames(frames, registered(), GRID, edges(0, 1, 2))
    assert np.nanmax(np.abs(np.diff(fields["temperature"].values, axis=0))) < 1e-3
    centres = mask_discs(GRID.centres_mm, DISCS, margin_mm=0.0)
    assert np.isnan(fields["temperature"].values[0][centres]).mean() > 0.9


def test_dataset_keeps_its_contract(tmp_path):
    frames = record(tmp_path / "a.seq", [STILL] * 3)
    reduced_alone = reduce_frames(frames, registered(), GRID, edges(0, 1, 2, 3))
    fields = evaluate_uncertainty(reduced_alone, [frames[0].parameters] * 3)
    for name, (dims, units, kind) in FIELDS.items():
        assert fields[name].dims == dims
        assert fields[name].dtype.kind == kind
        assert fields[name].attrs.get("units", "") == units
    assert fields["temperature"].attrs["units_metadata"] == "temperature: on_scale"
    assert fields["temperature_rise"].attrs["units_metadata"] == "temperature: difference"
    assert (fields["temperature_rise"].values[0][np.isfinite(fields["temperature"].values[0])] == 0).all()


def test_spread_and_rate_follow_a_known_ramp(tmp_path):
    frames = record(tmp_path / "a.seq", [STILL + 0.1 * i for i in range(12)])
    fields = reduce_frames(frames, registered(), GRID, edges(0, 4, 8, 12))
    # Four frames 0.1 K apart: standard deviation 0.1291 K; rounding to 6 mK counts adds 2 mK of noise.
    assert np.nanmedian(fields["temperature_spread"].values) == pytest.approx(0.1 * np.std(range(4), ddof=1), abs=1e-3)
    assert np.nanmedian(fields["temperature_rate"].values) == pytest.approx(0.1 * 3600, rel=1e-3)
    assert np.nanmedian(fields["temperature_rise"].values[2]) == pytest.approx(0.8, abs=1e-3)
    assert np.unique(fields["count"].values).tolist() == [0, 4]


def test_guard_calibrates_a_transient_frame_by_frame(tmp_path):
    """A spark of 40 K in one of ten frames: the sums alone would err by tens of millikelvin."""

    def spark(x, y):
        return smooth_field(x, y) + 40.0 * ((np.abs(x - 250) < 15) & (np.abs(y - 90) < 15))

    images = [Scene(disc_K=-4.0, field=spark).render() if i == 4 else STILL for i in range(10)]
    frames = record(tmp_path / "a.seq", images)
    fields = reduce_frames(frames, registered(), GRID, edges(0, 10))
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
def test_a_pixel_without_a_temperature_in_one_frame_empties_nothing(rng, tmp_path, per_cycle, block_s):
    """A count of zero lies below any temperature."""
    path = tmp_path / "a.seq"
    frames = record(path, (STILL + rng.normal(0, 0.05, STILL.shape) for _ in range(2 * per_cycle)))
    whole = reduce_frames(frames, registered(), GRID, edges(0, per_cycle, 2 * per_cycle), block_s=block_s)
    column, row = np.rint(registered().to_sensor(np.array([[302.0, 92.0]]))[0]).astype(int)
    data = bytearray(path.read_bytes())
    place = frames[-1].segments[0][0] + frames[-1].samples.offset + 2 * (row * STILL.shape[1] + column)
    data[place : place + 2] = bytes(2)
    path.write_bytes(data)
    fields = reduce_frames(frames, registered(), GRID, edges(0, per_cycle, 2 * per_cycle), block_s=block_s)
    for name in ("temperature", "temperature_rise", "temperature_noise_u", "count"):
        np.testing.assert_array_equal(np.isfinite(fields[name]), np.isfinite(whole[name]))
    difference = (fields["temperature"] - whole["temperature"]).values
    # One of 22 pixels of 50 mK takes no part, or a pixel has one frame less: a few millikelvin.
    assert np.nanmax(np.abs(difference)) < 0.015
    assert np.count_nonzero(np.nan_to_num(difference)) <= 9


def test_changing_parameters_and_corrections_are_applied_frame_by_frame(tmp_path):
    frames = record(tmp_path / "a.seq", [STILL] * 4, interval_s=1)

    def dim(frame):
        return override(frame.parameters, emissivity=0.97 if frame.index < 2 else 0.90)

    options = {"override": dim, "correction_K": np.array([0, 0, 1.0, 1.0])}
    fields = reduce_frames(frames, registered(), GRID, edges(0, 4), **options)
    one_by_one = reduce_frames(frames, registered(), GRID, edges(0, 4), block_s=0, **options)
    assert fields.sizes["time"] == 2
    assert one_by_one.sizes["time"] == 4
    np.testing.assert_allclose(fields["temperature"], one_by_one["temperature"], atol=1e-5)
    step = fields["frame_temperature"].isel(time=1) - fields["frame_temperature"].isel(time=0)
    bright = reduce_frames(
        frames[:1], registered(), GRID, edges(0, 4), override=lambda f: replace(f.parameters, emissivity=0.9)
    )
    expected = bright["frame_temperature"].values[0] + 1.0 - fields["frame_temperature"].values[0]
    np.testing.assert_allclose(step, expected, atol=1e-4)


def test_knocked_camera_keeps_the_field_in_place(tmp_path):
    knocked = replace(SCENE, shift_px=(3.0, -2.0))
    after = knocked.render()
    frames = record(tmp_path / "a.seq", [STILL, STILL, after, after])
    spans = [RegistrationSpan(0, registered()), RegistrationSpan(2, registered(knocked))]
    fields = reduce_frames(frames, spans, GRID, edges(0, 1, 3, 4))
    assert (fields["count"].max(("x", "y")) == [1, 2, 1]).all()
    assert (fields["quality_flag"].values[1] & 4 == 4).all()
    error = fields["temperature"].values - cell_truth()
    assert np.nanmax(np.abs(error)) < 0.010


def test_frames_outside_cycles_are_named_and_cycles_without_frames_are_flagged(tmp_path):
    frames = record(tmp_path / "a.seq", [STILL] * 3, interval_s=10)
    bounds = np.array([[0, 5], [8, 9], [18, 22]]) * SECOND + START
    fields = reduce_frames(frames, registered(), GRID, bounds)
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
        ({"cycle_bounds": edges(100, 200)}, r"no frame is within a cycle: frames 2026-03-09T06:30:00\.000000000 to 20"),
        ({"correction_K": np.zeros(3)}, r"correction_K has shape \(3,\); give a finite value per frame, 2"),
        ({"cycle_bounds": edges()}, "cycle_bounds is empty; give the start and end of at least one cycle"),
        ({"correction_K": np.full(2, np.nan)}, "give a finite value per frame, 2"),
        ({"references": []}, "there is no frame to reduce"),
        ({"references": "reversed"}, r"frame 0 has the time .*, not after .*; sort the frames"),
        ({"references": "small"}, r"has \(8, 8\) pixels, the registered frames \(480, 640\)"),
        ({"registration": "late"}, r"registrations start at frames \[1\]; they must start at 0 and rise"),
    ],
)
def test_faults_are_named(tmp_path, change, message):
    frames = record(tmp_path / "a.seq", [STILL] * 2)
    arguments = {"references": frames, "registration": registered(), "cycle_bounds": edges(0, 1, 2)} | change
    if change.get("references") == "reversed":
        arguments["references"] = frames[::-1]
    if change.get("references") == "small":
        arguments["references"] = record(tmp_path / "b.seq", [STILL[:8, :8]])
    if change.get("registration") == "late":
        arguments["registration"] = [RegistrationSpan(1, registered())]
    with pytest.raises(ReductionError, match=message):
        reduce_frames(arguments.pop("references"), arguments.pop("registration"), GRID, **arguments)


def test_a_single_shaken_frame_is_reported_and_no_warm_up_is_taken_for_a_knock(rng, tmp_path):
    shaken = replace(SCENE, shift_px=(1.5, 0.0)).render()

    hot = Scene(disc_K=-4.0, field=lambda x, y: smooth_field(x, y) + 0.015 * x).render()

    def warm(n):
        return (shaken if n == 3 else STILL + (hot - STILL) * n / 7) + rng.normal(0, 0.05, STILL.shape)

    frames = record(tmp_path / "a.seq", (warm(n) for n in range(7)))
    fields = reduce_frames(frames, registered(), GRID, edges(0, 7))
    assert json.loads(fields.attrs["knocks"]) == []
    assert json.loads(fields.attrs["frames_shaken"]) == ["a.seq#3"]


BOUNDS = edges(0, 4, 8, 11, 14)


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """Fourteen frames in four cycles with a knock in the third; registered on the first."""
    rng = np.random.default_rng(11)
    table = Scene(disc_K=-4.0)
    before, after = table.render(), replace(table, shift_px=(3.0, -2.0)).render()
    images = ((before if i < 9 else after) + 0.05 * i + rng.normal(0, 0.05, before.shape) for i in range(14))
    return record(tmp_path_factory.mktemp("film") / "a.seq", images), registered()


class BrokenOffError(Exception):
    pass


def broken_off(film, bounds, checkpoint, frames_done):
    """A whole reduction, one that goes on where another broke off, and the numbers of frames that it reported."""
    done, seen = [], []

    def break_off(count):
        done.append(count)
        if sum(done) >= frames_done:
            raise BrokenOffError

    whole = reduce_frames(*film, GRID, bounds, block_s=2)
    with pytest.raises(BrokenOffError):
        reduce_frames(*film, GRID, bounds, block_s=2, checkpoint=checkpoint, progress=break_off)
    return whole, reduce_frames(*film, GRID, bounds, block_s=2, checkpoint=checkpoint, progress=seen.append), seen


def test_a_broken_run_goes_on_and_ends_the_same(film, tmp_path, monkeypatch):
    whole, again, seen = broken_off(film, BOUNDS, tmp_path / "cp", 11)
    # Two cycles, and both parts of the third, before the knock and after it, were finished.
    assert seen[0] == 11
    assert sum(seen) == 14
    assert_equal_bits(whole, again)
    # A third run finds everything done but the last cycle's end, and reads no block.
    monkeypatch.setattr(still, "reduce_stretch", None)
    third = reduce_frames(*film, GRID, BOUNDS, block_s=2, checkpoint=tmp_path / "cp")
    assert whole["temperature"].values.tobytes() == third["temperature"].values.tobytes()


def test_a_long_cycle_goes_on_within_it(film, tmp_path, monkeypatch):
    """One cycle over all frames: what was done of it is kept whenever it has grown by some frames."""
    monkeypatch.setattr(still, "STORED_FRAMES", 4)
    monkeypatch.setattr(still, "STRETCH_FRAMES", 4)
    whole, again, seen = broken_off((film[0][:9], film[1]), BOUNDS[0] + SECOND * np.array([0, 9]), tmp_path / "cp", 6)
    assert seen[0] == 8
    assert_equal_bits(whole, again)


def test_a_checkpoint_of_another_reduction_is_refused(film, tmp_path):
    arguments = (film[0][:4], film[1], GRID, BOUNDS)
    reduce_frames(*arguments, checkpoint=tmp_path)
    with pytest.raises(CheckpointError, match=r"holds cycles of another reduction \(other frames\); remove the folder"):
        reduce_frames(*arguments, checkpoint=tmp_path, override=lambda f: override(f.parameters, emissivity=0.9))
    with pytest.raises(CheckpointError, match=r"other block_s"):
        reduce_frames(*arguments, checkpoint=tmp_path, block_s=1)


ZOOM = 1.05


def reduced(tmp_path, rng, images, *, interval_s=60.0, cycles=None):
    noisy = [image + rng.normal(0.0, 0.05, image.shape) for image in images]
    frames = record(tmp_path / "a.seq", noisy, interval_s=interval_s)
    seconds = np.linspace(0.0, interval_s * len(images), (cycles or len(images)) + 1)
    return reduce_frames(frames, registered(), GRID, START + np.round(1e3 * seconds).astype("m8[ms]"))


def rms_K(fields) -> float:
    return float(np.sqrt(np.nanmean((fields["temperature"].values - cell_truth()) ** 2)))


@pytest.mark.parametrize("shift_px", [(40.0, -25.0), (0.7, 0.0)])
def test_a_knock_of_any_size_is_followed(tmp_path, rng, shift_px):
    fields = reduced(tmp_path, rng, [STILL] * 3 + [replace(SCENE, shift_px=shift_px).render()] * 3)
    (knock,) = json.loads(fields.attrs["knocks"])
    assert (knock["index"], knock["crept"]) == (3, False)
    assert knock["shift_px"] == pytest.approx(shift_px, abs=0.05)
    assert knock["zoom"] == pytest.approx(1.0, abs=3e-4)
    # 50 mK of noise and 17 pixels per cell.
    assert rms_K(fields) < 0.02
    assert np.nanmax(fields["frame_shift"].values) < 0.2
    for remark in ("unchecked_stretches", "frames_shaken", "frames_unchecked"):
        assert json.loads(fields.attrs[remark]) == []


def test_a_camera_that_creeps_is_no_knock(tmp_path, rng):
    fields = reduced(tmp_path, rng, [replace(SCENE, shift_px=(0.15 * k, 0.0)).render() for k in range(5)])
    (creep,) = json.loads(fields.attrs["knocks"])
    assert (creep["index"], creep["crept"]) == (4, True)


def test_a_zoom_is_followed(tmp_path, rng):
    # Zoomed about a corner, so that the table stays within the image.
    warp = np.array([[ZOOM, 0.0, -20.0], [0.0, ZOOM, -10.0]])
    zoomed = cv2.warpAffine(STILL, warp, (640, 480), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    fields = reduced(tmp_path, rng, [STILL] * 3 + [zoomed] * 3)
    (knock,) = json.loads(fields.attrs["knocks"])
    assert (knock["index"], knock["zoom"]) == (3, pytest.approx(ZOOM, abs=1e-3))
    assert rms_K(fields) < 0.02


def test_a_frame_displaced_alone_is_left_out(tmp_path, rng):
    shaken = replace(SCENE, shift_px=(8.0, 3.0)).render()
    fields = reduced(tmp_path, rng, [STILL, STILL, shaken, STILL, STILL])
    assert json.loads(fields.attrs["frames_shaken"]) == ["a.seq#2"]
    assert np.isnan(fields["temperature"].values[2]).all()
    assert fields["frame_count"].values.tolist() == [1, 1, 1, 1]


def test_low_contrast_is_no_open_stretch_if_a_later_frame_shows_the_registration(tmp_path, rng):
    uniform = Scene(disc_K=-4.0, field=lambda x, y: 23.0 + 0.0 * x, outside=23.0)
    # Discs as warm as the table, and the table as warm as what surrounds it.
    shown, hidden = uniform.render(), replace(uniform, discs=()).render()
    closed = reduced(tmp_path, rng, [shown, hidden, shown])
    assert json.loads(closed.attrs["frames_unchecked"]) == ["a.seq#1"]
    assert json.loads(closed.attrs["unchecked_stretches"]) == []
    opened = reduced(tmp_path, rng, [shown, hidden, hidden])
    assert json.loads(opened.attrs["unchecked_stretches"]) == [{"first": "a.seq#1", "last": "a.seq#2", "frames": 2}]


def covered(above_K: float) -> np.ndarray:
    """An object of uniform temperature over a seventh of the table."""
    image = STILL.copy()
    image[130:300, 250:330] = 24.0 + above_K
    return image


@pytest.mark.parametrize("above_K", [7.0, -3.0])
def test_frames_with_an_object_are_left_out_and_named(tmp_path, rng, above_K):
    images = [covered(above_K) if i in (2, 5) else STILL for i in range(8)]
    fields = reduced(tmp_path, rng, images)
    assert json.loads(fields.attrs["frames_obstructed"]) == ["a.seq#2", "a.seq#5"]
    assert np.isnan(fields["temperature"].values[[2, 5]]).all()
    assert rms_K(fields) < 0.02


def test_the_other_frames_of_a_block_are_kept(tmp_path, rng):
    images = [covered(7.0) if i in (0, 6, 7) else STILL for i in range(10)]
    fields = reduced(tmp_path, rng, images, interval_s=0.5, cycles=2)
    assert json.loads(fields.attrs["frames_obstructed"]) == ["a.seq#0", "a.seq#6", "a.seq#7"]
    assert fields["frame_count"].values.tolist() == [4, 3]
    assert rms_K(fields) < 0.015


def test_an_object_that_stays_is_no_passing_one(tmp_path, rng):
    fields = reduced(tmp_path, rng, [STILL] * 3 + [covered(7.0)] * 7, interval_s=200.0)
    assert json.loads(fields.attrs["frames_obstructed"]) == []


def test_a_common_change_is_no_object_and_limits_grow_with_the_noise():
    base = np.linspace(20.0, 24.0, 200)
    part = np.where(np.arange(200) < 20, 1.0, 0.0)
    values = np.stack([base + 2.0, base + part])
    np.testing.assert_allclose(pixels_off(values, base, base, 0.05), [0.0, 0.1])
    gap = values.copy()
    gap[:, 150] = np.nan
    np.testing.assert_allclose(pixels_off(gap, base, base, 0.05), [0.0, 0.1])
    # Eight standard deviations of 0.2 K are more than 1 K.
    np.testing.assert_allclose(pixels_off(values, base, base, 0.2), [0.0, 0.0])


def test_noise_that_columns_share_obstructs_nothing(rng):
    base = np.linspace(20.0, 24.0, 2000)
    values = base + np.repeat(rng.normal(0, 0.3, (5, 200)), 10, axis=1)
    assert (np.abs(values - base) > 0.5).mean() > 0.05
    # Four robust standard deviations of 200 columns: none, or one.
    assert pixels_off(values, base, base, 0.05).max() <= 0.005


WHOLE = [RegistrationSpan(0, None)]


@dataclass(frozen=True)
class SimulatedFrame:
    """What planning needs of a frame."""

    path: Path
    index: int
    time: np.datetime64
    parameters: object = SC660
    shape: tuple[int, int] = (480, 640)

    @property
    def plain_samples(self) -> PlainSamples:
        return PlainSamples(1000 + 620_000 * self.index, True)


def simulated(frames, *, cycles, interval_ms=33, files=24):
    """A recording of which nothing is on disk."""
    times = START + np.arange(frames) * np.timedelta64(interval_ms, "ms")
    paths = [Path(f"hour{n}.seq") for n in range(files)]
    references = [SimulatedFrame(paths[i * files // frames], i, time) for i, time in enumerate(times)]
    bounds = START + np.linspace(0, interval_ms * frames, cycles + 1).round().astype("m8[ms]")
    return make_frame_series(references, bounds, shape=(480, 640), override=lambda frame: frame.parameters)


def cut(series, spans=WHOLE, **options):
    return cut_stretches(cut_blocks(series, spans, block_s=10), total=len(series), **options)


def test_stretches_divide_short_and_long_recordings_and_end_at_registrations():
    series = simulated(151_200, cycles=20)
    stretches = cut(series)
    frames = [sum(portion.frames for portion in stretch) for stretch in stretches]
    assert sum(frames) == 151_200
    assert max(frames) <= STRETCH_FRAMES
    # Cycles of 7,560 frames are two tasks each; with 5,000 frames/s, none takes less than half a second or more than one.
    assert len(stretches) == 40
    assert min(frames) > 2500
    stretches = cut(simulated(4000, cycles=100))
    assert len(stretches) >= 14
    assert all(portion.whole for stretch in stretches for portion in stretch)
    assert all(len(stretch) <= 8 for stretch in stretches)
    series = simulated(3000, cycles=2)
    knocked = cut(series, [RegistrationSpan(0, None), RegistrationSpan(700, None)])
    assert all(len({portion.first.span for portion in stretch}) == 1 for stretch in knocked)
    tail = cut_stretches(cut_blocks(series, WHOLE, block_s=10, first=1400), total=3000, begun=(0, 0))
    assert tail[0][0].first.first == 1400
    assert not tail[0][0].whole
    stretches = cut(simulated(20_000, cycles=2, interval_ms=60_000))
    assert max(sum(len(portion.blocks) for portion in stretch) for stretch in stretches) == 256


def test_what_a_resumed_run_has_to_find_is_described_the_same_for_equal_parameters():
    series = simulated(50, cycles=2)
    copies = replace(series, override=lambda frame: replace(frame.parameters))
    assert describe_reduction(series, GRID, [], block_s=10) == describe_reduction(copies, GRID, [], block_s=10)


@pytest.fixture(scope="module")
def short_film(tmp_path_factory):
    rng = np.random.default_rng(3)
    image = Scene(disc_K=-4.0).render()
    registration = registered()
    images = [image + 0.2 * i + rng.normal(0, 0.05, image.shape) for i in range(9)]
    frames = record(tmp_path_factory.mktemp("stretches") / "a.seq", images)
    weights = plan_weights(registration, GRID)
    sensor = RegisteredSensor(
        weights, monitor_fiducials(registration, GRID, weights.window), Detector.sound(registration.shape)
    )
    return frames, sensor


def series_until(stop_s, frames, **options):
    return make_frame_series(frames, edges(0, stop_s), shape=(480, 640), override=lambda f: f.parameters, **options)


def test_a_portion_is_the_mean_of_its_frames(short_film):
    frames, sensor = short_film
    series = series_until(6, frames, correction_K=np.full(9, 0.25))
    blocks = cut_blocks(series, WHOLE, block_s=2)
    [stretch] = cut_stretches(blocks, total=len(series))[:1]
    tasks = [(gather_frames(series, portion.blocks), portion.whole) for portion in stretch]
    [result, *_] = reduce_stretch(tasks, sensor)
    assert stretch[0].whole
    images = [calibrate(frame.read_counts(), SC660)[sensor.weights.window] for frame in frames[:6]]
    truth = sensor.weights.resample(np.mean(images, 0))
    np.testing.assert_allclose(result.part.mean, truth + 0.25, atol=1e-4)
    assert result.part.frames == 6
    assert result.part.seconds == pytest.approx(15.0)
    assert [view.cells.dtype for view in result.blocks] == [np.dtype("f4")] * 3
    # Of frames that belong to no cycle only the fields of their blocks are wanted.
    outside = [block for block in blocks if block.cycle == NO_CYCLE]
    assert reduce_portion(gather_frames(series, outside), sensor, whole=False).part is None


def test_frames_left_out_take_no_part(short_film):
    frames, sensor = short_film
    series = series_until(9, frames)
    [block] = cut_blocks(series, WHOLE, block_s=60)
    some = reduce_portion([choose_frames(series, block, np.array([0, 2]))], sensor, whole=False)
    assert some.part.frames == 2
    assert some.part.seconds == pytest.approx(2.0)
