"""What a camera sees in place of the table: whoever stands before it, objects laid on it or taken away, surfaces of another emissivity."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
import xarray as xr
from numpy.typing import NDArray

from thermography.common import MAD_TO_SIGMA, ZERO_CELSIUS_K, Array
from thermography.fields.cycle_fields import OBJECT, reference_cycle
from thermography.io.frame import CameraParameters
from thermography.io.sequence import WindowReader
from thermography.large_arrays import median_of_pieces, piece_slices
from thermography.radiometry.planck import black_body_signal, calibrate

if TYPE_CHECKING:
    from thermography.fields.blocks import Block, BlockResult, FrameSeries, Registrations

#: A cell jumps if its change from one frame to the next exceeds its changes before and after by more than this, K, ...
JUMP_K = 0.3
#: ... and by more than this many standard deviations of its noise.
_JUMP_SIGMAS = 8.0
#: At the ends of a series a change may exceed the only one beside it by this factor, as the course of a table that begins to warm.
_END_STRETCH = 2.0
#: Fewest connected cells that are a part of the table.
_LEAST_CELLS = 4
#: A jump whose edge takes more than `_SHARP` of its size within this distance, mm, is no heat: in steel it spreads 100 mm in four minutes.
EDGE_MM, _SHARP = 10.0, 0.5
#: Share of the table from which a jump without such an edge is named: a reflection.
_LEAST_SHARE = 0.02
#: Largest share of the table that is left out; beyond it no field would remain.
_LARGEST_SHARE = 0.25
#: Smaller width, mm, up to which a surface is told from the table around it.
_WIDEST_MM = 150.0
#: Fewest standard deviations of the noise of its step, and those by which noise alone makes neighbouring cells differ.
_SURFACE_SIGMAS, _RANGE_SIGMAS = 12.0, 4.0
#: Neighbours of a cell, corner to corner too.
_EIGHT = np.ones((3, 3), bool)
#: What is empty where an object lies.
_LEFT_EMPTY = (
    "temperature", "temperature_noise_u", "temperature_rise", "temperature_rise_noise_u", "temperature_rate", "temperature_spread"
)  # fmt: skip


@dataclass(eq=False)
class AbruptPart:
    """Connected cells (y, x) that differ by `step_K` from frame `first` on, up to before `stop` (None: to the end); objects are `sharp`."""

    cells: NDArray[np.bool_]
    step_K: float
    sharp: bool
    first: int
    stop: int | None = None

    def ended_by(self, later: AbruptPart) -> bool:
        """Whether a later jump takes this one back."""
        common = np.count_nonzero(self.cells & later.cells)
        smaller = min(np.count_nonzero(self.cells), np.count_nonzero(later.cells))
        return bool(self.stop is None and self.step_K * later.step_K < 0 and common >= smaller / 2)


def find_abrupt_parts(frames: xr.DataArray) -> list[AbruptPart]:
    """Find the parts of a still table that change abruptly in frames (time, y, x), degC; NaN where the table is not seen."""
    found: list[AbruptPart] = []
    if len(frames) < 4:
        return found
    seconds = np.diff(frames["time"].values) / np.timedelta64(1, "s")
    cell_mm = abs(float(frames["x"][1] - frames["x"][0]))
    least_K = _least_jump(frames)
    for some in piece_slices((len(seconds), *frames.shape[1:])):
        change, excess = _excess(frames, seconds, some)
        for at, (changed, beyond) in enumerate(zip(change, excess, strict=True)):
            if np.count_nonzero(beyond > least_K) < _LEAST_CELLS:
                continue
            for sign in (1.0, -1.0):
                labels, count = scipy.ndimage.label((beyond > least_K) & (sign * changed > 0), _EIGHT)
                for label in range(1, count + 1):
                    cells = labels == label
                    sharp = bool(np.count_nonzero(cells) >= _LEAST_CELLS and _is_sharp(changed, cells, cell_mm))
                    if not sharp and np.count_nonzero(cells) < _LEAST_SHARE * np.count_nonzero(np.isfinite(changed)):
                        continue
                    part = AbruptPart(cells, float(np.median(changed[cells])), sharp, some.start + at + 1)
                    before = next((one for one in reversed(found) if one.ended_by(part)), None)
                    if before is None and _stood_before(frames[part.first - 1 : part.first + 1].values, cells):
                        found.append(AbruptPart(cells, -part.step_K, sharp, 0, part.first))
                    elif before is None:
                        found.append(part)
                    else:
                        before.stop = part.first
                        before.cells = before.cells | cells
    return found


def _stood_before(pair: Array, cells: NDArray[np.bool_]) -> bool:
    """Whether cells differ from those around them more in the first of two frames than in the second: something was taken away."""
    around = _ring(cells, 2)
    if not np.isfinite(pair[:, around]).any(axis=1).all():
        return False
    before, after = (abs(np.nanmedian(frame[cells]) - np.nanmedian(frame[around])) for frame in pair)
    return bool(before > after)


def _ring(cells: NDArray[np.bool_], width: int) -> NDArray[np.bool_]:
    """The cells around some, beyond as many between them as the ring is wide."""
    inner = scipy.ndimage.binary_dilation(cells, _EIGHT, iterations=width)
    return np.asarray(scipy.ndimage.binary_dilation(inner, _EIGHT, iterations=width) & ~inner)


def _is_sharp(changed: Array, cells: NDArray[np.bool_], cell_mm: float) -> bool:
    """Whether a change takes most of its size within `EDGE_MM` along a row or a column of the cells."""
    far = max(round(EDGE_MM / cell_mm), 1)
    near = scipy.ndimage.binary_dilation(cells, _EIGHT, iterations=far)
    values = np.where(near, changed, np.nan)
    steps = [np.abs(values[far:] - values[:-far]), np.abs(values[:, far:] - values[:, :-far])]
    largest = max((float(np.nanmax(step)) for step in steps if np.isfinite(step).any()), default=0.0)
    return largest > _SHARP * float(np.abs(changed[cells]).max())


def _changes(frames: xr.DataArray, first: int, stop: int) -> Array:
    """Changes from frame to frame, those from `first` up to `stop`, beyond the one that most of the table makes, (changes, y, x) K."""
    change = np.diff(frames[first : stop + 1].values.astype(float), axis=0)
    return np.asarray(change - np.nanmedian(change, axis=(1, 2), keepdims=True))


def _least_jump(frames: xr.DataArray) -> float:
    """Excess of a change beyond which it is a jump, K: large against the noise of the changes."""
    pairs = (len(frames) - 2, *frames.shape[1:])

    def differences() -> Iterator[Array]:
        return (np.abs(np.diff(_changes(frames, some.start, some.stop + 1), axis=0)) for some in piece_slices(pairs))

    return max(JUMP_K, _JUMP_SIGMAS * MAD_TO_SIGMA * median_of_pieces(differences) / np.sqrt(6.0))


def _excess(frames: xr.DataArray, seconds: Array, some: slice) -> tuple[Array, Array]:
    """Some changes, and their excess over what those before and after them allow, (changes, y, x) K."""
    first, stop = max(some.start - 1, 0), min(some.stop + 1, len(seconds))
    change, lasted = _changes(frames, first, stop), seconds[first:stop, None, None]
    rate = np.abs(change) / lasted
    before, after = np.roll(rate, 1, axis=0), np.roll(rate, -1, axis=0)
    if first == 0:
        before[0] = _END_STRETCH * after[0]
    if stop == len(seconds):
        after[-1] = _END_STRETCH * before[-1]
    # A source that is switched on bends the temperature, so that the change exceeds only the one before, or only the one after.
    excess = np.abs(change) - lasted * np.maximum(before, after)
    inner = slice(some.start - first, some.stop - first)
    return change[inner], excess[inner]


def leave_out_objects(fields: xr.Dataset) -> xr.Dataset:
    """Leave the cells of objects empty and flagged in every frame and cycle that shows them; attribute `abrupt_parts` names all parts."""
    frames = fields["frame_temperature"]
    parts = find_abrupt_parts(frames)
    fields = fields.assign_attrs(abrupt_parts=json.dumps([describe_part(part, fields) for part in parts]))
    # The lens blurs the rim of an object over its neighbours.
    covered = [
        (slice(part.first, part.stop), scipy.ndimage.binary_dilation(part.cells, _EIGHT))
        for part in parts
        if part.sharp
    ]
    shown = np.isfinite(frames[0].values)
    union = np.any([cells for _, cells in covered], axis=0) if covered else np.zeros(shown.shape, bool)
    if not covered or np.count_nonzero(union & shown) > _LARGEST_SHARE * np.count_nonzero(shown):
        return fields
    hidden = np.zeros(fields["temperature"].shape, bool)
    stack = frames.values.copy()
    for during, cells in covered:
        stack[during, cells] = np.nan
        of_cycles = fields["frame_cycle"].values[during]
        hidden[np.unique(of_cycles[of_cycles > 0]) - 1] |= cells
    changed = {"frame_temperature": frames.copy(data=stack)}
    start = int(np.flatnonzero(np.isfinite(fields["temperature"].values).any(axis=(1, 2)))[0])
    for name in _LEFT_EMPTY:
        # A rise counts from a cycle that must show the table too.
        empty = hidden | hidden[start] if name.startswith("temperature_rise") else hidden
        changed[name] = fields[name].where(~empty)
    flags = fields["quality_flag"]
    changed["quality_flag"] = flags.copy(data=flags.values | np.where(hidden, OBJECT, 0).astype(np.uint8))
    return fields.assign(changed)


def describe_part(part: AbruptPart, fields: xr.Dataset) -> dict[str, Any]:
    """Place, length and width, mm, step, K, share of the table, and times of a part."""
    times = fields["time"].values
    until = None if part.stop is None else np.datetime_as_string(times[part.stop], unit="s")
    return _describe_place(part.cells, fields) | {
        "step_K": part.step_K,
        "share": np.count_nonzero(part.cells)
        / max(int(np.isfinite(fields["frame_temperature"][part.first].values).sum()), 1),
        "sharp": part.sharp,
        "since": np.datetime_as_string(times[part.first], unit="s"),
        "until": until,
    }


def _describe_place(cells: NDArray[np.bool_], fields: xr.Dataset) -> dict[str, Any]:
    """Centre, length and width of cells, mm."""
    rows, columns = np.nonzero(cells)
    x, y = fields["x"].values[columns], fields["y"].values[rows]
    # Of an ellipse with the same second moments.
    size_mm = sorted(4.0 * np.sqrt(np.linalg.eigvalsh(np.cov(x, y)).clip(0.0)), reverse=True)
    return {"x_mm": float(x.mean()), "y_mm": float(y.mean()), "size_mm": size_mm}


def describe_unnamed_surfaces(fields: xr.Dataset, parameters: CameraParameters) -> list[dict[str, Any]]:
    """Places that differ in the first cycle from the table around them with an edge that no heat has: centre, length and width, mm,
    step, K, and the emissivity that explains it, None if none does.
    """
    first = fields.isel(cycle=reference_cycle(fields["temperature"]))
    celsius, cell_mm = first["temperature"].values.astype(float), abs(float(fields["x"][1] - fields["x"][0]))
    empty, far = np.isnan(celsius), max(round(EDGE_MM / cell_mm), 1)
    nearest = scipy.ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    filled, size = celsius[tuple(nearest)], 2 * round(_WIDEST_MM / cell_mm / 2) + 1
    # Beside empty cells, as those of discs, objects and edges of named surfaces, the lens mixes what they show into the table.
    beside = scipy.ndimage.binary_dilation(empty, _EIGHT, iterations=far)
    noise_K = float(first["temperature_noise_u"].median())
    within = scipy.ndimage.maximum_filter(filled, far + 1) - scipy.ndimage.minimum_filter(filled, far + 1)
    reflected = black_body_signal(parameters.reflected_temperature_K, parameters)
    found = []
    for sign, smooth in ((1.0, scipy.ndimage.grey_opening), (-1.0, scipy.ndimage.grey_closing)):
        step_K = np.where(beside, 0.0, sign * (filled - smooth(filled, size=(size, size), mode="nearest")))
        labels, count = scipy.ndimage.label(step_K > max(JUMP_K, _SURFACE_SIGMAS * noise_K), _EIGHT)
        for label in range(1, count + 1):
            height = np.where(labels == label, step_K, 0.0)
            # The edge of a blurred surface is where half of its step is.
            parts, _ = scipy.ndimage.label(height > height.max() / 2, _EIGHT)
            cells = parts == parts.ravel()[height.argmax()]
            rim, ring = cells & ~scipy.ndimage.binary_erosion(cells, _EIGHT), _ring(cells, far) & ~empty
            sharp = within[rim] > _SHARP * height.max() + _RANGE_SIGMAS * noise_K
            if np.count_nonzero(cells) < _LEAST_CELLS or not ring.any() or sharp.mean() < 0.5:
                continue
            core = cells & (height >= np.median(height[cells]))
            shown, around = np.median(celsius[core]), np.median(celsius[ring])
            if sign * (shown - around) < _SHARP * height.max():
                continue
            surface, table = black_body_signal(np.array([shown, around]) + ZERO_CELSIUS_K, parameters)
            explained = parameters.emissivity * (surface - reflected) / (table - reflected)
            emissivity = float(explained) if 0.0 < explained <= 1.0 else None
            found.append(_describe_place(cells, fields) | {"step_K": float(shown - around), "emissivity": emissivity})
    return found


# Frames in which something stands before the table.

#: A sampled pixel is off if it differs by more than this, K, ...
_OFF_K = 0.5
#: ... and by more than this many standard deviations of its noise.
_OFF_SIGMAS = 8.0
#: ... and by more than this many standard deviations of what most pixels change by: columns may have a noise of their own.
_OFF_SPREADS = 4.0
#: A frame is obstructed if more than this share of the sampled pixels is off, beyond single bad pixels.
_OFF_SHARE = 0.02
#: An obstruction passes within this time, s, or this number of frames; what stays longer is a change of the scene.
_PASSING_S, _PASSING_FRAMES = 900.0, 5
#: Number of frames whose median is the first state of the table.
_FIRST_FRAMES = 5
#: Least number of sampled pixels for the comparison.
_LEAST_PIXELS = 30


def pixels_off(values: Array, lowest: Array, highest: Array, noise_K: float) -> Array:
    """Share of the pixels of every frame that lie outside a range, apart from a change that all pixels share."""
    change = values - (lowest + highest) / 2
    change -= np.nanmedian(change, axis=1, keepdims=True)
    spread = MAD_TO_SIGMA * np.nanmedian(np.abs(change), axis=1, keepdims=True)
    limit = np.fmax(np.nanmax([_OFF_K, _OFF_SIGMAS * noise_K]), _OFF_SPREADS * spread)
    off = np.abs(change) - (highest - lowest) / 2 > limit
    return off.mean(axis=1)


class Obstructions:
    """Frames of a series in which something stands before the table."""

    def __init__(self, frames: FrameSeries, registrations: Registrations) -> None:
        self.frames, self.registrations = frames, registrations
        self.found: set[int] = set()
        self._span = -1
        self._state = np.empty(0)
        self._until = 0

    def examine(self, block: Block, result: BlockResult) -> None:
        """Compare the frames of a block with the last frame that shows the table, and with later ones where they differ."""
        if result.samples.shape[1] < _LEAST_PIXELS:
            return
        if block.span != self._span:
            # Median of the first frames of a registration span, of which less than half may be obstructed.
            stop = self.registrations.stop_frame(block.span) or len(self.frames)
            more = range(block.stop, min(block.first + _FIRST_FRAMES, stop))
            state: Array = np.median(
                [*result.samples[:_FIRST_FRAMES], *(self._sample(i, block.span) for i in more)], axis=0
            )
            self._span, self._state = block.span, state
        # Whether frames surely show the same as one before: `pixels_off` without medians, ten times as fast, by a stricter limit.
        change = result.samples - self._state
        change -= change.mean(axis=1, keepdims=True)
        if bool(((np.abs(change) <= 0.8 * _OFF_K).mean(axis=1) >= 1 - _OFF_SHARE).all()):
            self._state = result.samples[-1]
            return
        for i, values in zip(range(block.first, block.stop), result.samples, strict=True):
            if pixels_off(values[None], self._state, self._state, result.noise_K)[0] > _OFF_SHARE and (
                i < self._until or self._passes(i, values, block, result.noise_K)
            ):
                self.found.add(i)
            else:
                self._state = values

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
            counts = reader.read([reference], buffer)
        sensor.detector.repair(counts, sensor.weights.window)
        return calibrate(counts.ravel()[sensor.sampled], self.frames.override(reference))
