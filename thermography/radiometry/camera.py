"""Correction of the camera's zero: flat-field steps and drift with the temperature of its housing, estimated from the frames.

The surroundings change with the room, slowly; what the camera adds to it changes suddenly (a flat-field correction, FFC) or
with the temperatures inside the camera. The level of the background is divided into these parts by generalised least squares on its
changes from frame to frame. What none of them explains may be the room or the camera: it is not corrected but enters the uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray
from scipy import linalg, special

from thermofuse.compiled import njit
from thermography.common import MAD_TO_SIGMA, Array
from thermography.io.frame import FrameReference

# Detects artefacts of the camera in a series of frames: repeated frames, frozen output, bad pixels and clipped counts.

#: More repeats in a row than this mean that the camera output was frozen, not that a frame was written twice.
_MAX_REPEATS = 2

#: Flags of `find_bad_pixels`.
DEAD, OFFSET, NOISY = 1, 2, 4
#: Place of the 90th percentile among the 24 pixels that surround a pixel.
_RING_RANK = 21
#: Pixels that share the highest or lowest count are clipped from this number on, ...
_LEAST_CLIPPED = 30
#: ... where they are this multiple of those at any of the counts next to it: noise makes the ends of a histogram thin, ...
_CLIPPED_MULTIPLE = 5
#: ... as long as its standard deviation is at least this share of the step between counts.
_LEAST_NOISE_STEPS = 0.5


def find_repeats(repeated: NDArray[np.bool_]) -> list[tuple[int, str]]:
    """Find frames that were written twice and intervals in which the camera output was frozen: the first frame of each, and words."""
    found = []
    labels, count = scipy.ndimage.label(repeated)
    for (run,) in scipy.ndimage.find_objects(labels)[:count]:
        length = run.stop - run.start
        text = f"{length} {'frame repeats' if length == 1 else 'frames repeat'} the counts of frame {run.start - 1}"
        found.append((run.start, text + (": the camera output was frozen" if length > _MAX_REPEATS else "")))
    return found


@dataclass(frozen=True, eq=False)
class Detector:
    """What is wrong with the pixels of a series: flags (row, column) of those that do not follow their neighbours, and the counts at and
    below which, at and above which the camera or a conversion has clipped them.
    """

    flags: NDArray[np.uint8]
    lowest: int = -1
    highest: int = 65536

    @classmethod
    def sound(cls, shape: tuple[int, int]) -> Detector:
        """Return a detector of (rows, columns) without a fault."""
        return cls(np.zeros(shape, np.uint8))

    @cached_property
    def bad(self) -> NDArray[np.bool_]:
        """Pixels that do not follow their neighbours, (row, column)."""
        return self.flags > 0

    @property
    def clips(self) -> bool:
        """Whether counts are clipped."""
        return self.lowest >= 0 or self.highest <= 65535

    def clipped(self, counts: Array) -> NDArray[np.bool_]:
        """Tell which counts are clipped."""
        return np.asarray((counts <= self.lowest) | (counts >= self.highest))

    def read(self, frame: FrameReference) -> NDArray[np.uint16]:
        """Read the counts of a frame, bad pixels repaired."""
        counts = frame.read_counts()
        return self.repair(counts.copy()[None])[0] if self.bad.any() else counts

    def repair(
        self, counts: NDArray[np.uint16], window: tuple[slice, slice] = (slice(None), slice(None))
    ) -> NDArray[np.uint16]:
        """Give bad pixels of a window of frames (time, row, column) the mean of their sound neighbours, in place."""
        bad = self.bad[window]
        rows, columns = np.nonzero(bad)
        if rows.size:
            _repair(counts, rows, columns, bad)
        return counts


@njit(nogil=True)
def _repair(counts: Array, rows: Array, columns: Array, bad: Array) -> None:
    """As `Detector.repair`; a pixel without a sound neighbour keeps its count."""
    for k in range(len(rows)):
        top, bottom = max(rows[k] - 1, 0), min(rows[k] + 2, bad.shape[0])
        left, right = max(columns[k] - 1, 0), min(columns[k] + 2, bad.shape[1])
        for frame in range(len(counts)):
            total, sound = 0, 0
            for i in range(top, bottom):
                for j in range(left, right):
                    if not bad[i, j]:
                        total, sound = total + counts[frame, i, j], sound + 1
            if sound > 0:
                counts[frame, rows[k], columns[k]] = np.uint16(total / sound + 0.5)


def examine_detector(counts: NDArray[np.uint16]) -> Detector:
    """Find bad pixels and clipped counts in frames (time, row, column) that represent a series."""
    detector = Detector(find_bad_pixels(counts))
    sound = ~detector.bad
    lowest, highest = int(counts[:, sound].min()), int(counts[:, sound].max())
    clips_low, clips_high = False, False
    for frame in counts:
        numbers = np.bincount(frame[sound])
        values = np.flatnonzero(numbers)
        numbers = numbers[values]
        if values.size < 4 or not (values[0] == lowest or values[-1] == highest):
            # Of a picture that is one value nothing is seen: so is a shutter, or a lens that is covered.
            clips_high |= values.size < 4 and numbers.max() >= _LEAST_CLIPPED and values[-1] == highest
            continue
        low = values[0] == lowest and _piled(numbers)
        high = values[-1] == highest and _piled(numbers[::-1])
        if not (low or high):
            continue
        step = int(np.diff(values).min())
        down = np.diff(frame.astype(np.int32), 2, axis=0)
        noise = MAD_TO_SIGMA * float(np.median(np.abs(np.diff(down, 2, axis=1)))) / 6.0
        if noise >= _LEAST_NOISE_STEPS * step:
            clips_low, clips_high = clips_low or low, clips_high or high
    return replace(detector, lowest=lowest if clips_low else -1, highest=highest if clips_high else 65536)


def _piled(numbers: NDArray[np.intp]) -> bool:
    """Whether far more pixels share the outermost count than any of those next to it."""
    return bool(numbers[0] >= max(_LEAST_CLIPPED, _CLIPPED_MULTIPLE * int(numbers[1:4].max())))


def find_bad_pixels(counts: NDArray[np.uint16], *, threshold: float = 8.0) -> NDArray[np.uint8]:
    """Find pixels whose mean or noise differs from that of their neighbours in frames (time, row, column) that represent a series."""
    stack = counts.astype(np.float32)
    step = np.float32(np.diff(np.unique(counts[0])).min(initial=65535)) if np.ptp(counts[0]) else np.float32(1.0)
    flags = np.where(_outliers(stack.mean(axis=0), threshold, step), OFFSET, 0).astype(np.uint8)
    if len(stack) >= 8:
        still = np.ptp(counts, axis=0) == 0
        # Against its neighbours, so that neither the warming nor the motion of what is seen counts as noise.
        for image in stack:
            image -= cv2.medianBlur(image, 3)
        # Of successive frames: at an edge the contrast grows as the table warms, and that is no noise.
        noise = np.diff(stack, axis=0).std(axis=0) / np.float32(np.sqrt(2.0))
        # Where all pixels around stand still too they are clipped, or show what does not change.
        flags |= np.where(still & (cv2.medianBlur(noise, 5) > step), DEAD, 0).astype(np.uint8)
        flags |= np.where(_outliers(noise, threshold, step) & (noise > np.median(noise)), NOISY, 0).astype(np.uint8)
    return flags


def _outliers(image: NDArray[np.float32], threshold: float, step: np.float32) -> NDArray[np.bool_]:
    """Return which pixels deviate from their neighbours much further than the pixels of their surroundings do."""
    rows, columns = image.shape
    padded = np.pad(image, 1, mode="reflect")
    shifts = [(row, column) for row in range(3) for column in range(3) if (row, column) != (1, 1)]
    differences = [np.abs(image - padded[row : row + rows, column : column + columns]) for row, column in shifts]
    deviation = np.partition(differences, 2, axis=0)[2]
    typical = max(np.median(deviation), step)
    # Few pixels deviate further than those of the whole picture do: of these alone the surroundings are looked at.
    outlying = deviation > threshold * typical
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(deviation, 2, mode="symmetric"), (5, 5))[outlying]
    rings = np.delete(windows.reshape(-1, 25), 12, axis=1)
    outlying[outlying] = deviation[outlying] > threshold * np.partition(rings, _RING_RANK, axis=1)[:, _RING_RANK]
    return outlying


#: Probability that a sound camera is corrected for a step (family-wise), and for a drift.
_SIGNIFICANCE = 1e-3
#: Smallest step that is corrected, K: less moves no field by more than its noise.
_LEAST_STEP_K = 0.02
#: The table must follow a step of the background within this share of it, or within this multiple of its own scatter.
_SHARED, _SHARED_SIGMAS = 0.5, 4.0
#: Largest drift of a camera, K per K of its housing: what changes by more does not follow the housing but the room, as the housing does.
_LARGEST_DRIFT = 0.5
#: Changes on either side of a step by which the rate of the table is judged.
_NEIGHBOURS = 3
#: Principal components with less than this share of the first one's amplitude would only fit noise.
_LEAST_COMPONENT = 0.01
#: Largest number of frames in the fit; of more, frames at even distances represent the series.
_FITTED_FRAMES = 1000
#: Changes beyond this multiple of their robust standard deviation are taken for steps before the first fit.
_OUTLYING = 4.0
#: With more steps than this share of the changes there is no ordinary change to hold them against.
_MOST_STEPS = 0.4
#: Fewest frames beyond the unknown values.
_LEAST_FRAMES = 6
#: Standard deviation of what walls hold from before the log, as a share of the range of the air: half of them lag, anywhere within it.
_START_SHARE = 0.5 / 12.0**0.5
#: Time constants with which thin and thick walls follow the air, s.
ROOM_LAGS_S = (600.0, 3600.0)


@dataclass(frozen=True, eq=False)
class LevelSeries:
    """Levels of n frames: of the surroundings of the table and of the table, degC; temperatures inside the camera (n, k), K, and those that
    the background follows, of the air and of it through lags (n, m), degC, where they were logged, `logged_s` s before the first frame on.
    """

    seconds: Array
    background: Array
    table: Array
    housing: Array
    room: Array
    logged_s: float = 0.0

    def thinned(self, kept: NDArray[np.intp]) -> LevelSeries:
        """The series of some frames."""
        return replace(self, **{name: one[kept] for name, one in vars(self).items() if name != "logged_s"})


@dataclass(frozen=True)
class CameraStep:
    """A step of the camera's zero: the first frame after it, its size and standard uncertainty, K."""

    index: int
    value_K: float
    u_K: float


@dataclass(frozen=True, eq=False)
class CameraCorrection:
    """Correction of the camera's zero in n frames relative to the first, K: what is added to every temperature and its standard
    uncertainty, the steps and the drift with the housing that were corrected, and the slow change that neither room nor camera explains.
    """

    correction_K: Array
    u_K: Array
    steps: tuple[CameraStep, ...]
    drift_K: Array
    unexplained_K: Array

    @property
    def corrects(self) -> bool:
        """Whether anything is corrected."""
        return bool(self.correction_K.any())


def estimate_correction(series: LevelSeries) -> CameraCorrection:
    """Estimate steps and drift of the camera's zero."""
    n = len(series.seconds)
    kept = np.unique(np.linspace(0, n - 1, min(n, _FITTED_FRAMES)).round().astype(np.intp))
    thin = series.thinned(kept)
    room = _components(thin.room)
    housing = _beyond(_components(thin.housing), room)
    unknowns = room.shape[1] + housing.shape[1]
    if len(kept) < unknowns + _LEAST_FRAMES:
        change = series.background - series.background[0]
        return CameraCorrection(np.zeros(n), np.asarray(np.abs(change) / np.sqrt(3.0)), (), np.zeros(n), change)
    regressors = np.diff(np.column_stack([room, housing]), axis=0)
    places, fit = _find_steps(np.diff(thin.background), regressors, np.diff(thin.seconds))
    sizes, sizes_u = fit.values[unknowns:], np.sqrt(np.diag(fit.covariance)[unknowns:])
    shared = _shared_by_table(thin, places, sizes)
    of_housing = slice(room.shape[1], unknowns)
    of_room = slice(0, room.shape[1])
    of_start = np.zeros((unknowns - room.shape[1],) * 2)
    for lag_s in ROOM_LAGS_S if room.size else ():
        # When the log begins, walls may differ from the air by what it does later; that decays as a housing warms.
        decays = np.exp(-(thin.seconds - thin.seconds[0] + thin.logged_s) / lag_s) * np.ptp(thin.room[:, 0])
        shown_as = fit.operator[of_housing] @ np.diff(decays)
        of_start += np.outer(shown_as, shown_as) * _START_SHARE**2
    covariance = fit.covariance.copy()
    fit.covariance[of_housing, of_housing] += of_start
    drift_values, drift_covariance = fit.values[of_housing], fit.covariance[of_housing, of_housing]
    drifts = _significant(fit, of_room) and _significant(fit, of_housing)
    if drifts:
        # Noise of the log makes too little of the room, and the housing stands in for it; with the log as response it makes too much of
        # it. The truth lies between (R. Frisch, 1934; S. Klepper and E. E. Leamer, Econometrica 52 (1984) 163): a drift shows in both.
        reverse, drifts = _with_log_as_response(thin, housing, places)
        drift_values = (drift_values + reverse.values) / 2.0
        drift_covariance = (drift_covariance + reverse.covariance + of_start) / 2.0
        drifts &= np.ptp(housing @ drift_values) <= _LARGEST_DRIFT * np.ptp(np.nanmean(thin.housing, axis=1))
    # What camera and rest have added since the first frame, per unknown value.
    response = np.zeros((len(kept), len(fit.values)))
    response[:, :unknowns] = np.column_stack([room, housing]) - np.concatenate([room[0], housing[0]])
    response[:, unknowns:] = np.arange(len(kept))[:, None] > np.array(places, int)
    of_camera = np.zeros(len(fit.values), bool)
    of_camera[of_housing] = True
    of_camera[unknowns:] = shared
    if drifts:
        covariance[of_housing, of_housing] = drift_covariance
    variance = np.einsum("ij,jk,ik->i", response * of_camera, covariance, response * of_camera)
    variance += _missed_variance(sizes[shared], sizes_u[shared], fit.limit) * np.linspace(0.0, 1.0, len(kept))
    drift = response[:, of_housing] @ drift_values * drifts
    explained = fit.values.copy()
    explained[of_housing] = drift_values * drifts
    unexplained = thin.background - thin.background[0] - response @ explained

    def full(values: Array) -> Array:
        return np.asarray(np.interp(series.seconds, thin.seconds, values))

    steps = tuple(
        CameraStep(_first_after(series, kept, place), float(size), float(u))
        for place, size, u, camera in zip(places, sizes, sizes_u, shared, strict=True)
        if camera
    )
    correction = -full(drift)
    for step in steps:
        correction[step.index :] -= step.value_K
    u_K = full(np.sqrt(np.maximum(variance, 0.0) + unexplained**2 / 3.0))
    return CameraCorrection(correction + 0.0, u_K, steps, full(drift), full(unexplained))


def hold_constant(level: Array) -> CameraCorrection:
    """Correct the camera so that a surface of constant temperature stays constant."""
    n, change = len(level), level - level[0]
    nothing = np.zeros(n)
    if n < _LEAST_FRAMES or not change.any():
        return CameraCorrection(nothing, nothing, (), nothing, change)
    ratio = float(np.mean(np.diff(level) ** 2) / 2.0 / np.var(level, ddof=1))
    limit = 1.0 + special.ndtri(_SIGNIFICANCE) * np.sqrt((n - 2) / (n**2 - 1))
    scatter = MAD_TO_SIGMA * float(np.median(np.abs(np.diff(level))))
    u_K = np.where(np.arange(n) == 0, 0.0, scatter)
    if ratio >= limit:
        return CameraCorrection(nothing, nothing, (), nothing, nothing)
    return CameraCorrection(-change, u_K, (), change, nothing)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Generalised least squares on the changes of the level; `operator` (values, n - 1) gives the values of any changes, `shocks` (n - 1,)
    are the ratios of the changes to their standard deviation, given all others, `limit` that from which one is a step.
    """

    values: Array
    covariance: Array
    operator: Array
    shocks: Array
    freedom: int
    limit: float


class _Drift(NamedTuple):
    """Drift of the camera per component of the housing, with its covariance."""

    values: Array
    covariance: Array


def _components(temperatures: Array) -> Array:
    """Leading principal components, (n, q), of n temperatures of q or more sensors."""
    complete = temperatures[:, np.isfinite(temperatures).all(axis=0)]
    if not complete.size:
        return np.zeros((len(temperatures), 0))
    scores, sizes, _ = np.linalg.svd(complete - complete.mean(axis=0), full_matrices=False)
    kept = sizes > max(_LEAST_COMPONENT * sizes[0], 1e-9)
    return (scores * sizes)[:, kept]


def _beyond(components: Array, known: Array) -> Array:
    """Components, (n, q), that are not nearly linear combinations of known ones."""
    centred = known - known.mean(axis=0)
    rest = components - centred @ np.linalg.lstsq(centred, components, rcond=None)[0] if known.size else components
    return components[:, np.linalg.norm(rest, axis=0) > _LEAST_COMPONENT * np.linalg.norm(components, axis=0)]


def _find_steps(change: Array, regressors: Array, seconds: Array) -> tuple[list[int], _Fit]:
    """Places of the steps among the changes, and the fit with them: one is added or dropped at a time until none is left to."""
    # Residual of the least absolute deviations, which steps do not bend, by iteratively reweighted least squares.
    residual = change
    for _ in range(50):
        weight = 1.0 / np.sqrt(np.maximum(np.abs(residual), 1e-5))
        values = np.linalg.lstsq(regressors * weight[:, None], change * weight, rcond=None)[0]
        residual = change - regressors @ values
    outlying = np.abs(residual) > _OUTLYING * MAD_TO_SIGMA * np.median(np.abs(residual))
    most = int(_MOST_STEPS * (len(change) - regressors.shape[1]))

    def usable(places: list[int]) -> bool:
        """Whether the changes without a step are enough, and still tell every regressor."""
        ordinary = np.delete(regressors, places, axis=0)
        return len(places) <= most and np.linalg.matrix_rank(ordinary) == regressors.shape[1]

    places = np.flatnonzero(outlying).tolist()
    if not usable(places):
        places = []
    fit = _fit(change, regressors, places, seconds)
    for _ in range(2 * len(change)):
        limit = fit.limit
        first = regressors.shape[1]
        ratios = np.abs(fit.values[first:]) / np.sqrt(np.diag(fit.covariance)[first:])
        shocks = np.abs(fit.shocks)
        shocks[places] = 0.0
        if places and ratios.min() < limit:
            del places[int(ratios.argmin())]
        elif shocks.max() > limit and usable(more := sorted([*places, int(shocks.argmax())])):
            places = more
        else:
            break
        fit = _fit(change, regressors, places, seconds)
    return places, fit


def _fit(change: Array, regressors: Array, places: list[int], seconds: Array) -> _Fit:
    """Fit regressors, and a step at every place, with the share of the white noise by restricted maximum likelihood."""
    n = len(change)
    freedom = n - regressors.shape[1] - len(places)

    def factorised(logit: float, kept: NDArray[np.intp]) -> Array:
        """Cholesky factor of the covariance of some changes, as bands."""
        white = 1.0 / (1.0 + np.exp(-logit))
        bands = np.zeros((2, kept.size))
        bands[0] = (1.0 - white) * seconds[kept] / seconds.mean() + 2.0 * white
        bands[1, :-1] = -white * (np.diff(kept) == 1)
        return np.asarray(linalg.cholesky_banded(bands, lower=True))

    # A change with a step of its own tells nothing of the others: without it the likelihood is the same, and has fewer columns.
    ordinary = np.delete(np.arange(n), places)
    level, columns = change[ordinary], regressors[ordinary]

    def deviance(logit: float) -> float:
        factor = factorised(logit, ordinary)
        _, information, squares, _ = _generalised(factor, level, columns)
        return float(2.0 * np.log(factor[0]).sum() + np.linalg.slogdet(information)[1] + freedom * np.log(squares))

    best = scipy.optimize.minimize_scalar(deviance, bounds=(-8.0, 8.0), method="bounded", options={"xatol": 0.05}).x
    steps = np.zeros((n, len(places)))
    steps[places, np.arange(len(places))] = 1.0
    factor, design = factorised(float(best), np.arange(n)), np.column_stack([regressors, steps])
    values, information, squares, solved = _generalised(factor, change, design)
    scale, unit, projected = squares / freedom, np.linalg.inv(information), solved[:, 1:]
    precision = _diagonal_of_inverse(factor) - ((projected @ unit) * projected).sum(axis=1)
    shocks = (solved[:, 0] - projected @ values) / np.sqrt(np.maximum(precision, 1e-12) * scale)
    limit = float(-special.stdtrit(freedom, _SIGNIFICANCE / (2 * n)))
    return _Fit(values, unit * scale, unit @ projected.T, shocks, freedom, limit)


def _generalised(factor: Array, change: Array, design: Array) -> tuple[Array, Array, float, Array]:
    """Values, information, sum of squares, and the inverse of the factorised covariance times change and design."""
    solved = linalg.cho_solve_banded((factor, True), np.column_stack([change, design]))
    information, moment = design.T @ solved[:, 1:], design.T @ solved[:, 0]
    values = np.linalg.solve(information, moment)
    squares = max(float(change @ solved[:, 0] - values @ moment), np.finfo(float).tiny)
    return values, information, squares, solved


def _diagonal_of_inverse(factor: Array) -> Array:
    """Diagonal of the inverse of a tridiagonal matrix by its Cholesky factor, from the last row back (Takahashi et al. 1973)."""
    diagonal = 1.0 / factor[0] ** 2
    passed_on = (factor[1] / factor[0]) ** 2
    for i in range(diagonal.size - 2, -1, -1):
        diagonal[i] += passed_on[i] * diagonal[i + 1]
    return np.asarray(diagonal)


def _shared_by_table(series: LevelSeries, places: list[int], sizes: Array) -> NDArray[np.bool_]:
    """Whether the table changes by each step of the background beyond its own rate, so that it is one of the camera."""
    seconds, change = np.diff(series.seconds), np.diff(series.table)
    ordinary = np.ones(len(change), bool)
    ordinary[places] = False

    def beyond_rate(place: int) -> float:
        near = np.arange(max(place - _NEIGHBOURS, 0), min(place + _NEIGHBOURS + 1, len(change)))
        near = near[ordinary[near] & (near != place)]
        rate = float(np.median(change[near] / seconds[near])) if near.size else 0.0
        return float(change[place]) - rate * float(seconds[place])

    scatter = MAD_TO_SIGMA * float(np.median(np.abs([beyond_rate(place) for place in np.flatnonzero(ordinary)])))
    off = np.array([abs(beyond_rate(place) - size) for place, size in zip(places, sizes, strict=True)])
    shared: NDArray[np.bool_] = off <= np.maximum(_SHARED * np.abs(sizes), _SHARED_SIGMAS * scatter)
    return shared & (np.abs(sizes) >= _LEAST_STEP_K)


def _missed_variance(sizes: Array, sizes_u: Array, limit: float) -> float:
    """Variance of the sum of the steps that are too small to be found, K2, if all steps have normal sizes."""
    if not sizes.size:
        return 0.0
    smallest = max(_LEAST_STEP_K, limit * float(np.median(sizes_u)))
    below = 2.0 * float(special.ndtr(smallest / np.sqrt(np.mean(sizes**2)))) - 1.0
    return float(sizes.size * below / (1.0 - below) * smallest**2 / 3.0)


def _significant(fit: _Fit, chosen: slice) -> bool:
    """Whether some of the fitted values differ from zero, by an F test."""
    values, covariance = fit.values[chosen], fit.covariance[chosen, chosen]
    if not values.size:
        return False
    ratio = float(values @ np.linalg.solve(covariance, values)) / values.size
    return bool(special.fdtrc(values.size, fit.freedom, ratio) < _SIGNIFICANCE)


def _with_log_as_response(series: LevelSeries, housing: Array, places: list[int]) -> tuple[_Drift, bool]:
    """The drift by the regression of the logged air on the background, which contains it, and whether it is significant."""
    columns = np.column_stack([series.background, _components(series.room[:, 1:]), housing])
    fit = _fit(np.diff(series.room[:, 0]), np.diff(columns, axis=0), places, np.diff(series.seconds))
    of_housing = slice(columns.shape[1] - housing.shape[1], columns.shape[1])
    share, values = fit.values[0], fit.values[of_housing]
    change = np.zeros((len(values), len(fit.values)))
    change[:, 0] = values / share**2
    change[:, of_housing] = -np.eye(len(values)) / share
    drift = _Drift(-values / share, change @ fit.covariance @ change.T)
    return drift, _significant(fit, slice(0, 1)) and _significant(fit, of_housing)


def _first_after(series: LevelSeries, kept: NDArray[np.intp], place: int) -> int:
    """First frame after a step between two frames of the thinned series: the largest change between them."""
    first, last = int(kept[place]), int(kept[place + 1])
    return first + 1 + int(np.abs(np.diff(series.background[first : last + 1])).argmax())


def room_temperatures(seconds: Array, logged_seconds: Array, air_degC: Array) -> Array:
    """Temperatures that surfaces of a room follow: that of the air, and it through first-order lags."""
    known = np.isfinite(air_degC)
    logged_seconds, air_degC = logged_seconds[known], air_degC[known]
    if len(air_degC) < 2:
        return np.zeros((len(seconds), 0))
    followed = [air_degC]
    for lag_s in ROOM_LAGS_S:
        kept = np.exp(-np.diff(logged_seconds) / lag_s)
        body = air_degC.astype(float)
        for k, share in enumerate(kept):
            body[k + 1] = share * body[k] + (1.0 - share) * air_degC[k]
        followed.append(body)
    return np.column_stack([np.interp(seconds, logged_seconds, values) for values in followed])
