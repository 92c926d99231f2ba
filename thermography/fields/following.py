"""A still table followed over the frames: their displacements, a registration for every time between knocks, and frames in which something
stands before the table.

A single frame that differs from those before and after it is left out by `thermography.fields.survey` where that has read the series; here,
several in a row are too.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from thermography._typing import Array
from thermography.fields.blocks import Block, BlockView, RegisteredSensor
from thermography.fields.cycle_fields import position_covariance
from thermography.fields.inputs import FrameSeries
from thermography.fields.resampling import plan_weights, plan_window
from thermography.io.window_reader import WindowReader
from thermography.radiometry.planck import calibrate
from thermography.registration.displacement import (
    KNOCK_PX,
    SUSPECT_PX,
    RegistrationSpan,
    fiducial_displacement,
    image_displacement,
    monitor_fiducials,
    register_after_knock,
    search_displacement,
    shift_registration,
)
from thermography.registration.plan import PlanGrid

#: Largest number of frames whose mean is registered after a knock, or examined where single frames have too little contrast.
_MEAN_FRAMES = 8
#: A displacement lasts if the first measurable one of this number of following frames shares it.
_FOLLOWING_FRAMES = 3
#: A sampled pixel is off if it differs by more than this, K, ...
_OFF_K = 0.5
#: ... and by more than this many standard deviations of its noise.
_OFF_SIGMAS = 8.0
#: A frame is obstructed if more than this share of the sampled pixels is off, beyond single bad pixels.
_OFF_SHARE = 0.02
#: An obstruction passes within this time, s, or this number of frames; what stays longer is a change of the scene.
_PASSING_S, _PASSING_FRAMES = 300.0, 3
#: Number of frames whose median is the first state of the table.
_FIRST_FRAMES = 5
#: Least number of sampled pixels for the comparison.
_LEAST_PIXELS = 30


@dataclass(frozen=True)
class Knock:
    """A lasting displacement from a frame on.

    Attributes
    ----------
    frame : int
        Index of the first displaced frame.
    span : int
        Registration span in which it occurs.
    displacement_px : (4,) ndarray, px
        (column, row, growth, turn), see `thermography.registration.displacement`.
    by_image : bool
        Whether the image of the table showed it, because the fiducials have no contrast.
    """

    frame: int
    span: int
    displacement_px: Array
    by_image: bool


class Registrations:
    """Registration spans in the order of time, and what is derived from each of them.

    Parameters
    ----------
    spans : sequence of RegistrationSpan
        In order, the first one from frame 0 on.
    grid : PlanGrid
        The plan.

    Attributes
    ----------
    spans : list of RegistrationSpan
    sensors : list of RegisteredSensor
        Weights and fiducial monitor for the reduction of blocks.
    covariances : list of (y, x, 2, 2) ndarray, mm2
        Of the position of every cell.
    """

    def __init__(self, spans: Sequence[RegistrationSpan], grid: PlanGrid) -> None:
        self.grid = grid
        self.spans: list[RegistrationSpan] = []
        self.sensors: list[RegisteredSensor] = []
        self.covariances: list[Array] = []
        for index, span in enumerate(spans):
            self.insert(index, span)

    def insert(self, index: int, span: RegistrationSpan) -> None:
        """Insert a span before the one at `index`."""
        registration, grid = span.registration, self.grid
        # In parallel: the weights are compiled loops over pixels, the others many small steps of the interpreter.
        with ThreadPoolExecutor(1) as executor:
            monitor = executor.submit(monitor_fiducials, registration, grid, plan_window(registration, grid))
            covariance = executor.submit(position_covariance, registration, grid)
            sensor = RegisteredSensor(plan_weights(registration, grid), monitor.result())
        self.spans.insert(index, span)
        self.sensors.insert(index, sensor)
        self.covariances.insert(index, covariance.result())

    def stop_frame(self, index: int) -> int | None:
        """First frame of the span after the one at `index`; None for the last."""
        return self.spans[index + 1].first_frame if index + 1 < len(self.spans) else None


@dataclass(frozen=True)
class UncheckedStretch:
    """Consecutive frames without contrast to check the registration, after which no frame shows that it held.

    Attributes
    ----------
    first, stop : int
        Frames `first` to ``stop - 1``.
    """

    first: int
    stop: int


class Displacements:
    """Displacement of every frame against its registration.

    Parameters
    ----------
    frames : FrameSeries
        All frames.
    registrations : Registrations
        Their registrations, which grow by one for every knock.

    Attributes
    ----------
    size_px : (frames,) ndarray, px
        Root mean square displacement of the fiducials in every frame; NaN where it is not measured.
    shaken : set of int
        Frames that are displaced alone.
    baseline_px : (4,) ndarray, px
        Bias of the fiducial monitor against the exact displacement, from temperature gradients on the table.
    """

    def __init__(self, frames: FrameSeries, registrations: Registrations) -> None:
        self.frames, self.registrations = frames, registrations
        self.size_px = np.full(len(frames), np.nan)
        self.shaken: set[int] = set()
        self.baseline_px = np.zeros(4)
        self._misses = 0

    def find_knock(self, block: Block, monitored_px: Array) -> Knock | None:
        """Measure the frames of a block up to the first one of a lasting displacement.

        Frames for which the monitor shows a displacement, (frames, 4) px, or nothing are measured exactly. A displacement that the
        next measurable frame shares is a knock; otherwise the frame is shaken. Where the picture is the plan, no frame is measured: its
        content may warm in one place, which cannot be told from a shift of a fraction of a pixel.
        """
        if self.registrations.spans[block.span].registration.is_picture:
            return None
        sizes = np.linalg.norm(monitored_px - self.baseline_px, axis=1)
        if (sizes <= SUSPECT_PX).all():
            self.size_px[block.first : block.stop] = sizes
            self._misses = 0
            return None
        for i, monitored in zip(range(block.first, block.stop), monitored_px, strict=True):
            displacement = monitored - self.baseline_px
            if not np.linalg.norm(displacement) <= SUSPECT_PX:
                displacement, by_image = self._measure(i, block.span)
                self._misses = self._misses + 1 if np.isnan(displacement).any() else 0
                if np.linalg.norm(displacement) > KNOCK_PX:
                    if self._lasts(i, block.span, displacement):
                        return Knock(i, block.span, displacement, by_image)
                    self.shaken.add(i)
                elif np.isfinite(displacement + monitored).all():
                    self.baseline_px = monitored - displacement
            self.size_px[i] = np.linalg.norm(displacement)
        return None

    def span_after(self, knock: Knock) -> RegistrationSpan:
        """Register the plan again on the mean of the frames after a knock; the baseline starts anew."""
        old, grid = self.registrations.spans[knock.span].registration, self.registrations.grid
        if knock.by_image:
            registration = shift_registration(old, knock.displacement_px[:2])
        else:
            temperature = self._mean(self._frames_after(knock))
            name = self.frames.name(knock.frame)
            registration = register_after_knock(temperature, old, knock.displacement_px, grid, frame_name=name)
        self.baseline_px = np.zeros(4)
        column, row, growth, turn = knock.displacement_px.tolist()
        return RegistrationSpan(knock.frame, registration, (column, row, growth, turn))

    def unchecked_stretches(self, left_out: Array) -> list[UncheckedStretch]:
        """Stretches of unmeasured frames at whose end neither a frame nor the mean of several shows that the registration held.

        A displacement within a stretch of low contrast shows in the next frame that can be measured. `left_out`, (frames,), marks
        frames that take no part.
        """
        stretches = []
        for index, span in enumerate(self.registrations.spans):
            if span.registration.is_picture:
                continue
            stop = self.registrations.stop_frame(index) or len(self.frames)
            chosen = [i for i in range(span.first_frame + 1, stop) if not left_out[i]]
            measured = [i for i in chosen if np.isfinite(self.size_px[i])]
            last = measured[-1] if measured else span.first_frame
            after = [i for i in chosen if i > last]
            if after and not self._holds(after[-_MEAN_FRAMES:], index):
                stretches.append(UncheckedStretch(after[0], stop))
        return stretches

    def _holds(self, chosen: list[int], span: int) -> bool:
        """Whether the mean of some frames shows the fiducials where they are registered."""
        registration = self.registrations.spans[span].registration
        displacement = fiducial_displacement(self._mean(chosen), registration, self.registrations.grid)
        return bool(np.linalg.norm(displacement) <= KNOCK_PX)

    def _frames_after(self, knock: Knock) -> list[int]:
        """The first displaced frame and those of the next few, up to the next span, that share its displacement."""
        stop = self.registrations.stop_frame(knock.span)
        stop = min(knock.frame + _MEAN_FRAMES, len(self.frames) if stop is None else stop)
        following = range(knock.frame + 1, stop)
        return [knock.frame, *(i for i in following if self._shares(i, knock.span, knock.displacement_px))]

    def _lasts(self, i: int, span: int, displacement_px: Array) -> bool:
        """Whether the first measurable one of the next few frames shares the displacement of a frame, or none can be measured."""
        for following in range(i + 1, min(i + 1 + _FOLLOWING_FRAMES, len(self.frames))):
            other, _ = self._measure(following, span)
            if np.isfinite(other).all():
                return _alike(other, displacement_px)
        return True

    def _shares(self, i: int, span: int, displacement_px: Array) -> bool:
        return _alike(self._measure(i, span)[0], displacement_px)

    def _measure(self, i: int, span: int) -> tuple[Array, bool]:
        """Displacement of a frame, (4,) px, and whether the image of the table showed it, because the fiducials have no contrast."""
        first, registration = self.registrations.spans[span].first_frame, self.registrations.spans[span].registration
        temperature, grid = self.frames.temperature(i), self.registrations.grid
        displacement = fiducial_displacement(temperature, registration, grid)
        # After frames in which nothing is located, the slow ways are tried at frames 1, 2, 4, 8, ... of the stretch.
        if np.isfinite(displacement).all() or i == first or self._misses & (self._misses - 1):
            return displacement, False
        reference = self.frames.temperature(first)
        displacement = search_displacement(reference, temperature, registration, grid)
        if np.isfinite(displacement).all():
            return displacement, False
        return image_displacement(reference, temperature, registration, grid), True

    def _mean(self, chosen: Sequence[int]) -> Array:
        """Mean temperature of some frames, (row, column) degC."""
        mean: Array = np.mean([self.frames.temperature(i) for i in chosen], axis=0, dtype=float)
        return mean


def _alike(displacement_px: Array, other_px: Array) -> bool:
    """Whether a displacement is a knock, and the same as another one."""
    size, other, difference = (
        float(np.linalg.norm(vector)) for vector in (displacement_px, other_px, displacement_px - other_px)
    )
    return size > KNOCK_PX and difference < max(KNOCK_PX, 0.3 * other)


def pixels_off(values: Array, lowest: Array, highest: Array, noise_K: float) -> Array:
    """Share of the pixels of every frame that lie outside a range, apart from a change that all pixels share.

    Parameters
    ----------
    values : (frames, pixels) ndarray, degC
        Temperature of the pixels in every frame; NaN where the camera gives none, which is not counted as off.
    lowest, highest : (pixels,) ndarray, degC
        Range of every pixel in the frames that it is compared with.
    noise_K : float, K
        Standard deviation of the noise of a pixel; NaN where it is not known.

    Returns
    -------
    (frames,) ndarray
        Share of the pixels, 0 to 1, that are off by more than 0.5 K and eight standard deviations of their noise.

    Notes
    -----
    A machine table cannot change so and change back between frames: 1 kW/m2 warms 40 mm of iron by 0.5 K in a minute, but then
    needs an hour to cool by convection. A hand, a tray or a closed shutter does.
    """
    middle = (lowest + highest) / 2
    level = np.nanmedian(values - middle, axis=1, keepdims=True)
    beyond = np.maximum(values - level - highest, lowest - values + level)
    off = beyond > np.nanmax([_OFF_K, _OFF_SIGMAS * noise_K])
    share: Array = off.mean(axis=1)
    return share


def _are_alike(values: Array, state: Array) -> bool:
    """Whether frames surely show the same as one before: `pixels_off` without medians, ten times as fast, by a stricter limit."""
    change = values - state
    change -= change.mean(axis=1, keepdims=True)
    return bool(((np.abs(change) <= 0.8 * _OFF_K).mean(axis=1) >= 1 - _OFF_SHARE).all())


class Obstructions:
    """Frames of a series in which something stands before the table.

    Parameters
    ----------
    frames : FrameSeries
        All frames.
    registrations : Registrations
        Their registrations.

    Attributes
    ----------
    found : set of int
        Those frames so far.
    """

    def __init__(self, frames: FrameSeries, registrations: Registrations) -> None:
        self.frames, self.registrations = frames, registrations
        self.found: set[int] = set()
        self._span = -1
        self._state = np.empty(0)
        self._until = 0

    def examine(self, block: Block, result: BlockView) -> None:
        """Compare the frames of a block with the last frame that shows the table, and with later ones where they differ.

        Of a picture nothing is known: what changes fast in it may be what was to be seen.
        """
        in_picture = self.registrations.spans[block.span].registration.is_picture
        if in_picture or result.samples.shape[1] < _LEAST_PIXELS:
            return
        if block.span != self._span:
            self._span, self._state = block.span, self._first_state(block, result.samples)
        if _are_alike(result.samples, self._state):
            self._state = result.samples[-1]
            return
        for i, values in zip(range(block.first, block.stop), result.samples, strict=True):
            if pixels_off(values[None], self._state, self._state, result.noise_K)[0] > _OFF_SHARE and (
                i < self._until or self._passes(i, values, block, result.noise_K)
            ):
                self.found.add(i)
            else:
                self._state = values

    def _first_state(self, block: Block, samples: Array) -> Array:
        """Median of the first frames of a registration span, of which less than half may be obstructed."""
        stop = self.registrations.stop_frame(block.span) or len(self.frames)
        more = range(block.stop, min(block.first + _FIRST_FRAMES, stop))
        state: Array = np.median([*samples[:_FIRST_FRAMES], *(self._sample(i, block.span) for i in more)], axis=0)
        return state

    def _passes(self, i: int, values: Array, block: Block, noise_K: float) -> bool:
        """Whether a later frame shows the table as before, and this one lies outside what both show."""
        ahead = 1
        while i + ahead < (self.registrations.stop_frame(block.span) or len(self.frames)):
            seconds = (self.frames.times[i + ahead] - self.frames.times[i]) / np.timedelta64(1, "s")
            if ahead > _PASSING_FRAMES and seconds > _PASSING_S:
                break
            later = self._sample(i + ahead, block.span)
            if pixels_off(later[None], self._state, self._state, noise_K)[0] <= _OFF_SHARE:
                lowest, highest = np.minimum(self._state, later), np.maximum(self._state, later)
                self._until = i + ahead
                return bool(pixels_off(values[None], lowest, highest, noise_K)[0] > _OFF_SHARE)
            ahead = ahead + 1 if ahead < _PASSING_FRAMES else 2 * ahead
        return False

    def _sample(self, i: int, span: int) -> Array:
        """Temperature of the sampled pixels in a frame, (points,) degC."""
        sensor, reference = self.registrations.sensors[span], self.frames.references[i]
        buffer = np.empty((1, *sensor.weights.used.shape), np.uint16)
        with WindowReader(sensor.weights.window) as reader:
            counts = reader.read([reference], buffer).ravel()[sensor.sampled]
        return calibrate(counts, self.frames.override(reference))
