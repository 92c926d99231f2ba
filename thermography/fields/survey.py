"""Survey of a series of frames in one pass: damaged frames, the level of every block of pixels, and frames that were written twice.

Pixels are compared with their CRC-32 where one is stored. Where none is, they are held against the frames before and after: what is
damaged, or covered for one frame, lies far off both. The levels show what the camera adds to all pixels alike, see
`thermography.radiometry.camera`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import compress

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from thermofuse.compiled import njit
from thermography.common import MAD_TO_SIGMA, Array, ThermographyError
from thermography.fields.scheduling import in_order, open_pool
from thermography.io.frame import CameraParameters, FrameReference, RejectedFrame
from thermography.radiometry.camera import Detector, examine_detector
from thermography.radiometry.planck import (
    ZERO_CELSIUS_K,
    count_line,
    counts_from_temperature,
    signal_slope,
    temperature_from_counts,
)
from thermography.registration.plan import PlanGrid
from thermography.registration.register import Registration, fiducial_weights

#: Blocks along a row: large enough that noise averages out, small enough that many lie outside the table.
_BLOCKS_ACROSS = 24
#: A pixel is off where it lies beyond both neighbours in time by this multiple of the noise, ...
_OFF_SIGMAS = 10.0
#: ... also beyond all pixels within this distance, so that an edge that moves with a vibration is none, px.
_EDGE_PX = 4
#: A frame is left out from this number of pixels on, the size of 32 bytes of damage; ...
_LEAST_PIXELS = 16
#: ... where frames differ so in most of the series, from this multiple of the upper quartile on.
_ORDINARY_MULTIPLE = 5.0
#: A frame is of another series from this excess of its table over both neighbours on, K: no table warms and cools by as much from one frame
#: to the next, ...
_STRAY_K = 0.2
#: ... and this share of the difference between its neighbours, so that the bend of a steep course is none.
_STRAY_SHARE = 0.5
#: Frames that follow one another are reported in turn, the outermost last.
_STRAY_PASSES = 5
#: Fewest frames that show what is ordinary.
_LEAST_FRAMES = 8
#: Beyond the ends of a series a course goes on by this multiple of its last change.
_END_STRETCH = 2
#: About this number of pixels gives noise (to 3 %) and common shift of two frames.
_SAMPLE_PX = 1200
#: Fewest blocks outside the table that tell the camera from the table.
LEAST_SURROUNDING_BLOCKS = 4
#: Frames, evenly spaced, that represent a series for `examine_detector`.
_DETECTOR_FRAMES = 48
#: Width of the lens's blur at the table's edge, px.
_MARGIN_PX = 4


@dataclass(frozen=True, eq=False)
class Survey:
    """Frames of a series whose pixels are intact, and what one pass over them shows: mean of every block of pixels (n, rows, columns),
    degC, and of a patch where one was asked for, frames that equal the one before, pixels outside the calibrated range, pixels of every
    block that are off the frames before and after, by frame, the damaged frames, and bad pixels and clipped counts of the detector.
    """

    frames: list[FrameReference]
    levels: NDArray[np.float32]
    edge_px: int
    patch: Array | None
    repeated: NDArray[np.bool_]
    outside: NDArray[np.int64]
    off: dict[int, NDArray[np.int64]]
    damaged: list[RejectedFrame]
    detector: Detector


def survey_frames(
    references: Sequence[FrameReference],
    override: Callable[[FrameReference], CameraParameters] = lambda frame: frame.parameters,
    *,
    still: bool = True,
    patch: tuple[slice, slice] | None = None,
    progress: Callable[[int], None] | None = None,
) -> Survey:
    """Read every frame of a series once."""
    spread = np.linspace(0, len(references) - 1, min(len(references), _DETECTOR_FRAMES)).round().astype(int)
    chosen = {id(references[i]) for i in spread}
    representative = []
    rows, columns = references[0].shape
    edge_px = max(columns // _BLOCKS_ACROSS, 1)
    frames: list[FrameReference] = []
    damaged: list[RejectedFrame] = []
    levels, patches, repeated, outside = [], [], [], []
    neighbours = _Neighbours(edge_px)
    previous: NDArray[np.uint16] | None = None
    with open_pool() as pool:
        for reference, counts in in_order(pool, ((reference, (_read_counts, reference)) for reference in references)):
            if progress is not None:
                progress(1)
            if isinstance(counts, str):
                damaged.append(RejectedFrame(reference.path, reference.index, counts))
                continue
            frames.append(reference)
            if id(reference) in chosen:
                representative.append(counts)
            parameters, limits = override(reference), reference.limits
            means = _block_sums(counts, edge_px) / edge_px**2
            levels.append(temperature_from_counts(means, parameters).astype(np.float32))
            if patch is not None:
                patches.append(float(temperature_from_counts(counts[patch].mean(), parameters)))
            repeated.append(previous is not None and np.array_equal(counts, previous))
            highest = limits.raw_maximum or 65535
            outside.append(int(np.count_nonzero((counts < limits.raw_minimum) | (counts > highest))))
            if still and not repeated[-1]:
                neighbours.add(len(frames) - 1, counts)
            previous = counts
    neighbours.finish()
    return Survey(
        frames=frames,
        levels=np.array(levels, np.float32).reshape(len(frames), rows // edge_px, columns // edge_px),
        edge_px=edge_px,
        patch=None if patch is None else np.array(patches),
        repeated=np.array(repeated, bool),
        outside=np.array(outside, np.int64),
        off=neighbours.off,
        damaged=damaged,
        detector=examine_detector(np.stack(representative)) if representative else Detector.sound((rows, columns)),
    )


def _read_counts(reference: FrameReference) -> NDArray[np.uint16] | str:
    """Counts of a frame; the reason where they cannot be read."""
    try:
        return reference.read_counts()
    except (ThermographyError, OSError) as error:
        return str(error)


class _Neighbours:
    """Comparison of every frame with the nearest frames before and after that are not off themselves; `off` holds, by index of the frame,
    the pixels of every block that are.
    """

    def __init__(self, edge_px: int) -> None:
        self.off: dict[int, NDArray[np.int64]] = {}
        self._edge_px = edge_px
        self._window: list[tuple[int, NDArray[np.uint16]]] = []
        self._first_judged = False

    def add(self, index: int, counts: NDArray[np.uint16]) -> None:
        """Add the next frame, and judge the one before it by its neighbours."""
        self._window = [*self._window[-2:], (index, counts)]
        if len(self._window) < 3:
            return
        if not self._first_judged:
            # No frame precedes the first one: it is held against the two that follow.
            self._first_judged = True
            self._judge(0, (1, 2), end=True)
        if len(self._window) == 3:
            self._judge(1, (0, 2), end=False)

    def finish(self) -> None:
        """Judge the last frame, by the two before it."""
        if len(self._window) == 3:
            self._judge(2, (0, 1), end=True)

    def _judge(self, place: int, others: tuple[int, int], *, end: bool) -> None:
        """Note the pixels of a frame of the window that are off two others, and take it out of the window if there are many."""
        index, counts = self._window[place]
        before, after = (self._window[other][1] for other in others)
        # Limit in counts beyond which a pixel is off, and the shift that all pixels have in common (a flat-field correction).
        stride = max(int(np.sqrt(counts.size / _SAMPLE_PX)), 1)
        some = (slice(None, None, stride), slice(None, None, stride))
        x, b, a = (image[some].astype(np.int32) for image in (counts, before, after))
        shift = int(np.median(x - np.clip(x, np.minimum(a, b), np.maximum(a, b))))
        change = x - b
        noise = MAD_TO_SIGMA * float(np.median(np.abs(change - np.median(change)))) / np.sqrt(2.0)
        limit = int(np.ceil(_OFF_SIGMAS * max(noise, 1.0)))
        # The change between the two others goes on beyond the ends of the series.
        stretch = _END_STRETCH if end else 0
        flat = (counts.reshape(-1), before.reshape(-1), after.reshape(-1))
        if _count_off(*flat, limit, shift, stretch) < _LEAST_PIXELS:
            return
        # Smallest and largest count of the two within the reach of a vibration.
        reach = np.ones((2 * _EDGE_PX + 1, 2 * _EDGE_PX + 1), np.uint8)
        lower = cv2.erode(np.minimum(before, after), reach).astype(np.int32)
        upper = cv2.dilate(np.maximum(before, after), reach).astype(np.int32)
        beyond = stretch * (upper - lower)
        level = counts.astype(np.int32) - shift
        off = (level > upper + beyond + limit) | (level < lower - beyond - limit)
        if np.count_nonzero(off) >= _LEAST_PIXELS:
            self.off[index] = _block_sums(off.view(np.uint8), self._edge_px)
            del self._window[place]


@njit(nogil=True)
def _count_off(counts: Array, before: Array, after: Array, limit: int, shift: int, stretch: int) -> int:
    """Number of pixels beyond those of both other frames by more than the limit; flat images."""
    off = np.int32(0)
    # In 32 bits a processor handles twice as many pixels at once as in 64.
    moved, allowed, factor = np.int32(shift), np.int32(limit), np.int32(stretch)
    for i in range(len(counts)):
        x, a, b = np.int32(counts[i]) - moved, np.int32(after[i]), np.int32(before[i])
        low, high = min(a, b), max(a, b)
        beyond = factor * (high - low) + allowed
        off += np.int32((x > high + beyond) | (x < low - beyond))
    return int(off)


def _block_sums(image: Array, edge_px: int) -> Array:
    """Sum over every block of pixels; what is left at the right and lower edge takes no part."""
    rows, columns = image.shape[0] // edge_px, image.shape[1] // edge_px
    kept = np.ascontiguousarray(image[: rows * edge_px, : columns * edge_px])
    return _sum_blocks(kept.reshape(rows, edge_px, columns, edge_px))


@njit(nogil=True)
def _sum_blocks(image: Array) -> Array:
    """Sum over the second and fourth dimension."""
    rows, height, columns, width = image.shape
    sums = np.zeros((rows, columns), np.int64)
    for row in range(rows):
        for line in range(height):
            for block in range(columns):
                pixels = image[row, line, block]
                total = np.uint32(0)
                for i in range(width):
                    total += np.uint32(pixels[i])
                sums[row, block] += total
    return sums


@dataclass(frozen=True, eq=False)
class Blocks:
    """Blocks (rows, columns) that the plan covers, blocks that show nothing of the table in any frame, and pixels that show a part of the
    plan in some frame.
    """

    table: NDArray[np.bool_]
    surroundings: NDArray[np.bool_]
    plan_px: NDArray[np.bool_]


def locate_blocks(survey: Survey, registration: Registration, grid: PlanGrid, shifts_mm: Array) -> Blocks:
    """Tell which blocks show the table."""
    rest = np.zeros(registration.shape, np.uint8)
    outline = grid.outline_mm(25)

    def fill(image: NDArray[np.uint8], points_mm: Array) -> None:
        # A part of the plan may lie far outside the view.
        corners = np.clip(np.rint(registration.to_sensor(points_mm)), -10_000, 10_000).astype(np.int32)
        cv2.fillPoly(image, [corners], 1)

    fill(rest, outline)
    anywhere = rest.copy()
    for shift in shifts_mm:
        fill(anywhere, outline + shift)
    margin = np.ones((2 * _MARGIN_PX + 1, 2 * _MARGIN_PX + 1), np.uint8)
    on_table = _block_sums(cv2.erode(rest, margin), survey.edge_px)
    touched = _block_sums(cv2.dilate(anywhere, margin), survey.edge_px)
    return Blocks(on_table == survey.edge_px**2, touched == 0, anywhere.astype(bool))


def stray_frames(levels: Array, *, ends: bool) -> dict[int, float]:
    """Frames whose table is warmer or colder than in the frames before and after: of another series, or taken with another setting."""
    kept, found = np.arange(len(levels)), dict[int, float]()
    for _ in range(_STRAY_PASSES):
        if kept.size < _LEAST_FRAMES:
            break
        beyond, change = _beyond(levels[kept], ends=ends)
        limit = np.maximum(max(_STRAY_K, _ORDINARY_MULTIPLE * float(np.quantile(beyond, 0.75))), _STRAY_SHARE * change)
        around = np.pad(beyond, 1)
        stray = (beyond > limit) & (beyond >= np.maximum(around[:-2], around[2:]))
        if not stray.any():
            break
        found.update({int(i): float(b) for i, b in zip(kept[stray], beyond[stray], strict=True)})
        kept = kept[~stray]
    return dict(sorted(found.items()))


def _beyond(levels: Array, *, ends: bool) -> tuple[Array, Array]:
    """By how much every frame lies beyond its two neighbours, and by how much these differ, (n,) K root mean square over the blocks."""
    n = len(levels)
    before, after = np.r_[1, : n - 2, n - 3], np.r_[2, 2:n, n - 2]
    lower, upper = np.minimum(levels[before], levels[after]), np.maximum(levels[before], levels[after])
    # The change between the two others goes on beyond the ends of the series.
    stretch = np.zeros((n, 1))
    stretch[[0, -1]] = _END_STRETCH
    reach = stretch * (upper - lower)
    excess = np.maximum(levels - upper - reach, 0.0) + np.maximum(lower - levels - reach, 0.0)
    beyond, change = (np.sqrt(np.mean(values**2, axis=1)) for values in (excess, upper - lower))
    if not ends:
        beyond[[0, -1]] = 0.0
    return beyond, change


def disturbed_frames(survey: Survey, blocks: Blocks, *, still: bool) -> dict[int, str]:
    """Frames that the table tells from the frames before and after, or whose pixels leave the camera's range."""
    n = len(survey.frames)
    off = np.zeros(n, np.int64)
    for index, pixels in survey.off.items():
        off[index] = int(pixels[blocks.table].sum())
    found = {}
    for numbers, text in (
        (survey.outside, "{} pixels are outside the range in which the camera is calibrated"),
        (off, "{} pixels of the table differ from the frames before and after it"),
    ):
        limit = max(_LEAST_PIXELS, _ORDINARY_MULTIPLE * float(np.quantile(numbers, 0.75)))
        for i in np.flatnonzero(numbers >= limit).tolist():
            found[i] = f"{text.format(numbers[i])}: damaged, covered, or from another series"
    if still:
        found.update(_strays(survey, blocks, np.array([i for i in range(n) if i not in found], int)))
    return dict(sorted(found.items()))


def _strays(survey: Survey, blocks: Blocks, kept: NDArray[np.int64]) -> dict[int, str]:
    """Reason by index for those of the kept frames whose table is warmer or colder than in the frames before and after."""
    table, around = (survey.levels[kept][:, chosen].astype(float) for chosen in (blocks.table, blocks.surroundings))
    table, around = (levels[:, np.isfinite(levels).all(axis=0)] for levels in (table, around))
    if table.shape[1] == 0:
        return {}
    examined = around.shape[1] >= LEAST_SURROUNDING_BLOCKS
    if examined:
        table = table - np.median(around - np.median(around, axis=0), axis=1, keepdims=True)
    reason = "the table differs by {:.2g} K from the frames before and after it: from another series, or with another setting"
    return {int(kept[i]): reason.format(beyond) for i, beyond in stray_frames(table, ends=examined).items()}


# What the camera adds to a picture, by two surfaces at one place: a disc of low emissivity and the painted table around it share it whole,
# and share the temperature in proportion to their emissivities.

#: Frames that are compared, evenly spaced.
_COMPARED = 60
#: Discs that are painted, or so dull that they show little but their own temperature, tell nothing of the camera: largest share of the
#: table's change that they show.
_DULL = 0.6
#: Fewest discs that show a pattern beside a change that all share and the warming of the table.
_LEAST_DISCS = 5
#: Radius from which a disc shows more of itself than of the table, edge spreads.
_LEAST_RADIUS = 3.0
#: Frames over whose mean a course is judged: what the camera adds, and its focus, change slowly.
_SMOOTHED = 5
#: Growth of the edge spread beyond which it is measured again.
_WIDER = 0.1


@dataclass(frozen=True, eq=False)
class DiscLevels:
    """What frames `index` of a series show at k discs, (n, k) K: changes of the table at the centre and of the disc, by one calibration;
    (k,) their distance from the middle of the picture, px; and (n,) by how much the edges of most are wider than at first, as a share.
    """

    index: NDArray[np.intp]
    names: tuple[str, ...]
    table_K: Array
    disc_K: Array
    off_centre_px: Array
    wider: Array

    @property
    def blurred(self) -> tuple[int, int] | None:
        """First frame whose edges are wider, and that with the widest; None where none are."""
        beyond = np.flatnonzero(self.wider > _WIDER)
        return (int(self.index[beyond[0]]), int(self.index[self.wider.argmax()])) if beyond.size else None

    def compared(self, left_out: NDArray[np.bool_]) -> DiscCourses | None:
        """Compare the discs with the table around them in frames that are not left out; None where too few are of low emissivity."""
        kept = ~left_out[self.index]
        disc, table = self.disc_K[kept], self.table_K[kept]
        if len(self.names) < _LEAST_DISCS or np.count_nonzero(kept) < _LEAST_FRAMES:
            return None
        # The share of the table's change that a disc shows: from what differs between discs and frames, which no change of the zero does,
        # nor one that grows with the distance from the middle.
        alike = np.ones((len(self.names), 1))
        smooth = np.column_stack([alike, self.off_centre_px**2])
        own, around = (_beside(values, smooth) for values in (disc, table))
        share = float((own * around).sum() / max((around**2).sum(), np.finfo(float).tiny))
        if share > _DULL:
            return None
        added = (disc - max(share, 0.0) * table) / (1.0 - max(share, 0.0))
        courses = scipy.ndimage.uniform_filter1d(_beside(added, alike), _SMOOTHED, axis=0, mode="nearest")
        scores, sizes, places = np.linalg.svd(courses, full_matrices=False)
        return DiscCourses(
            self.index[kept],
            added.mean(axis=1) - added[0].mean(),
            # Noise makes a second pattern about as strong as the first.
            np.sqrt(sizes[0] ** 2 - sizes[1] ** 2) * np.outer(scores[:, 0], places[0]),
            float(np.ptp(table, axis=0).max()),
            self.names,
        )


@dataclass(frozen=True, eq=False)
class DiscCourses:
    """What n frames of a series show on k discs beyond the warming of the table, K: the change since the first that all discs share, what
    differs from disc to disc (n, k), and the largest change of the table at a disc.
    """

    index: NDArray[np.intp]
    common_K: Array
    pattern_K: Array
    warming_K: float
    names: tuple[str, ...]


def read_discs(
    frames: Sequence[FrameReference], registration: Registration, grid: PlanGrid, detector: Detector
) -> DiscLevels:
    """Read the discs of a still table, apart from those with clipped pixels, in frames that represent a series."""
    index = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), _COMPARED)).round().astype(np.intp))
    least_px, located = np.pi * (_LEAST_RADIUS * registration.optics.spread_px) ** 2, registration.located
    weights = {
        name: found for name, found in fiducial_weights(registration, grid).items() if located[name].area_px > least_px
    }
    parameters, sums, clipped = frames[0].parameters, [], np.zeros(registration.shape, bool)
    for i in index:
        read, taken = detector.read(frames[i]), frames[i].parameters
        clipped, picture = clipped | detector.clipped(read), read.astype(float)
        # Another range of the camera counts otherwise: what the first one would have counted.
        if (taken.planck_r1, taken.planck_o) != (parameters.planck_r1, parameters.planck_o):
            picture = counts_from_temperature(temperature_from_counts(picture, taken), parameters)
        sums.append([np.tensordot(one, picture[window], 2) for window, one in weights.values()])
    shown = np.array([not clipped[window][one.any(axis=0)].any() for window, one in weights.values()], bool)
    counts: Array = np.array(sums).reshape(len(index), -1, 5)[:, shown]
    names = tuple(compress(weights, shown))
    if not names:
        nothing = np.zeros((len(index), 0))
        return DiscLevels(index, names, nothing, nothing, np.zeros(0), np.zeros(len(index)))
    level, contrast, _, _, by_spread = np.moveaxis(counts, -1, 0)
    gain, _ = count_line(parameters)
    scale = gain * signal_slope(temperature_from_counts(level.mean(), parameters) + ZERO_CELSIUS_K, parameters)
    table = (level - level[0]) / scale
    wider = scipy.ndimage.uniform_filter1d(np.median(by_spread / contrast, axis=1), _SMOOTHED, mode="nearest")
    places = np.array([(located[name].column_px, located[name].row_px) for name in names])
    off_centre = np.hypot(*(places - (np.array(registration.shape[::-1]) - 1) / 2).T)
    return DiscLevels(index, names, table, table + (contrast - contrast[0]) / scale, off_centre, wider - wider[0])


def _beside(values: Array, over_discs: Array) -> Array:
    """What is neither constant on a disc nor, in a frame, a sum of columns (k, m) over the discs."""
    values = values - values.mean(axis=0)
    return np.asarray(values - values @ over_discs @ np.linalg.pinv(over_discs))
