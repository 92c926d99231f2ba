"""How a recording is divided into work, whatever its length, and that a portion is the sum of its blocks."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from tests.thermography.plan_scene import DISCS, GRID, SC660, START, Scene, record
from thermography.fields.blocks import RegisteredSensor, cut_blocks
from thermography.fields.checkpoint import describe_reduction
from thermography.fields.inputs import NO_CYCLE, FrameSeries, make_frame_series
from thermography.fields.resampling import plan_weights
from thermography.fields.tasks.stretches import (
    STRETCH_FRAMES,
    choose_frames,
    cut_stretches,
    gather_frames,
    reduce_portion,
    reduce_stretch,
)
from thermography.io.frame import PlainSamples
from thermography.radiometry.planck import calibrate
from thermography.registration.displacement import RegistrationSpan, monitor_fiducials
from thermography.registration.register import register

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


def test_a_day_of_video_of_464_gb_is_some_hundreds_of_tasks():
    series = simulated(756_000, cycles=100)
    stretches = cut(series)
    frames = [sum(portion.frames for portion in stretch) for stretch in stretches]
    assert sum(frames) == 756_000
    assert max(frames) <= STRETCH_FRAMES
    # Cycles of 7,560 frames are two tasks each; with 5,000 frames/s, none takes less than half a second or more than one.
    assert len(stretches) == 200
    assert min(frames) > 2500


def test_what_a_resumed_run_has_to_find_is_described_the_same_for_equal_parameters():
    series = simulated(50, cycles=2)
    copies = FrameSeries(
        series.references,
        series.times,
        series.bounds,
        series.cycles,
        series.correction_K,
        lambda frame: replace(frame.parameters),
    )
    assert describe_reduction(series, GRID, [], block_s=10) == describe_reduction(copies, GRID, [], block_s=10)


def test_short_recordings_are_divided_between_workers_but_not_their_cycles():
    stretches = cut(simulated(4000, cycles=100))
    assert len(stretches) >= 14
    assert all(portion.whole for stretch in stretches for portion in stretch)
    assert all(len(stretch) <= 8 for stretch in stretches)


def test_stretches_end_at_registrations_and_know_what_was_begun():
    series = simulated(3000, cycles=2)
    knocked = cut(series, [RegistrationSpan(0, None), RegistrationSpan(700, None)])
    assert all(len({portion.first.span for portion in stretch}) == 1 for stretch in knocked)
    tail = cut_stretches(cut_blocks(series, WHOLE, block_s=10, first=1400), total=3000, begun=(0, 0))
    assert tail[0][0].first.first == 1400
    assert not tail[0][0].whole


def test_many_single_frames_are_held_in_limited_numbers():
    stretches = cut(simulated(20_000, cycles=2, interval_ms=60_000))
    assert max(sum(len(portion.blocks) for portion in stretch) for stretch in stretches) == 256


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    rng = np.random.default_rng(3)
    image = Scene(disc_K=-4.0).render()
    registration = register(image, DISCS, grid=GRID)
    images = [image + 0.2 * i + rng.normal(0, 0.05, image.shape) for i in range(9)]
    frames = record(tmp_path_factory.mktemp("stretches") / "a.seq", images)
    weights = plan_weights(registration, GRID)
    sensor = RegisteredSensor(weights, monitor_fiducials(registration, GRID, weights.window))
    return frames, sensor


def test_a_portion_is_the_mean_of_its_frames(film):
    frames, sensor = film
    series = make_frame_series(
        frames,
        START + np.array([0, 6]) * np.timedelta64(1, "s"),
        shape=(480, 640),
        override=lambda frame: frame.parameters,
        correction_K=np.full(9, 0.25),
    )
    blocks = cut_blocks(series, WHOLE, block_s=2)
    [stretch] = cut_stretches(blocks, total=len(series))[:1]
    tasks = [(gather_frames(series, portion.blocks), portion.whole) for portion in stretch]
    [result, *_] = reduce_stretch(tasks, sensor, True)
    assert stretch[0].whole
    truth = sensor.weights.resample(
        np.mean([calibrate(f.read_counts(), SC660)[sensor.weights.window] for f in frames[:6]], 0)
    )
    np.testing.assert_allclose(result.part.mean, truth + 0.25, atol=1e-4)
    assert result.part.frames == 6
    assert result.part.seconds == pytest.approx(15.0)
    assert result.sums[0].statistics.frames == 6
    assert [view.cells.dtype for view in result.views] == [np.dtype("f4")] * 3
    # Of frames that belong to no cycle only the fields of their blocks are wanted.
    outside = [block for block in blocks if block.cycle == NO_CYCLE]
    assert reduce_portion(gather_frames(series, outside), sensor, True, whole=False).part is None


def test_frames_left_out_take_no_part(film):
    frames, sensor = film
    series = make_frame_series(
        frames, START + np.array([0, 9]) * np.timedelta64(1, "s"), shape=(480, 640), override=lambda f: f.parameters
    )
    [block] = cut_blocks(series, WHOLE, block_s=60)
    some = reduce_portion([choose_frames(series, block, np.array([0, 2]))], sensor, False, whole=False)
    assert some.part.frames == 2
    assert some.part.seconds == pytest.approx(2.0)
    assert some.sums == ()
