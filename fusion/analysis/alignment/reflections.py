"""Find patches of the field that switch as a reflection does, faster than heat can flow.

Heat needs minutes to cross a few centimetres of iron (diffusivity 1.6e-5 m2/s: 1 cm in 6 s, 5 cm in 160 s, 20 cm in 40 min), and a
source under the table changes the slope of a temperature, not its value. A patch that jumps between two frames, and jumps back, is
radiation from elsewhere.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import scipy
import xarray as xr
from numpy.typing import NDArray

from fusion.common import Array
from thermography.common import scatter_by_median
from thermography.large_arrays import in_pieces, piece_slices

#: A change counts as a jump where it exceeds the usual change of its patch this many times (robust sigma).
_JUMP_SIGMAS = 8.0
#: ... and next to another one this many times: a source that is switched while a frame is taken jumps twice.
_PART_SIGMAS = 3.0
#: A patch stands out where its jump is this much larger than the same jump averaged over the table; a camera offset has 1.
_LOCAL_RATIO = 3.0
_MIN_FRAMES = 9
#: Variance of the independent part of a source's levels, over that by which they wander from change to change: none to nothing else.
_LEVELS_OVER_WANDER = (0.0, *np.logspace(-2.0, 6.0, 33).tolist())
#: Changes of a long test among which the patch is looked for.
_MOST_CHANGES = 1000


@dataclass(frozen=True)
class SwitchingPatch:
    """A patch of the plan whose apparent temperature switches: `pattern` (y, x) of the jump, about 1 on the patch, 0 where the plan is not
    seen; `course` (time,), how much warmer than at first each frame shows it by its jumps, K.
    """

    pattern: Array
    course: Array


def seen_throughout(frames: Array | xr.DataArray) -> NDArray[np.bool_]:
    """Return which cells every frame shows."""
    seen = np.ones(frames.shape[1:], bool)
    for _, some in in_pieces(frames):
        seen &= np.isfinite(some).all(axis=0)
    return seen


def find_switching_patch(frames: Array | xr.DataArray) -> SwitchingPatch | None:
    """Find the patch whose switching explains most of the sudden changes of a field."""
    if frames.shape[0] < _MIN_FRAMES:
        return None
    seen = seen_throughout(frames)
    largest = _largest(_sudden_changes(frames, seen))
    if not largest.any():
        return None
    component = _leading_component(largest)
    if len(largest) == len(frames) - 1:
        score = largest @ component
    else:
        along_all = np.sum([sudden.T @ (sudden @ component) for sudden in _sudden_changes(frames, seen)], axis=0)
        component = np.asarray(along_all / np.linalg.norm(along_all))
        score = np.concatenate([sudden @ component for sudden in _sudden_changes(frames, seen)])
    score /= component @ component
    scatter = max(scatter_by_median(score), 1e-9)
    jumps = np.abs(score) > _JUMP_SIGMAS * scatter
    # The upper percent stands for the patch's own height, so that one noisy cell does not make a pattern local.
    height = float(np.quantile(component, 0.99))
    if not jumps.any() or height < _LOCAL_RATIO * abs(float(component.mean())):
        return None
    pattern = np.zeros(seen.shape)
    pattern[seen] = component / height
    return SwitchingPatch(pattern, _course(score, jumps, scatter) * height)


def _course(score: Array, jumps: NDArray[np.bool_], scatter: float) -> Array:
    """Levels of a switching source, (time,), from its changes (time - 1,), of which some are jumps; the first level is zero."""
    adjacent = np.convolve(jumps, [1, 1, 1], mode="same") > 0
    switched = jumps | (adjacent & (np.abs(score) > _PART_SIGMAS * scatter))
    changes = score[switched]
    likelihood, error = -np.inf, np.zeros_like(changes)
    for ratio in _LEVELS_OVER_WANDER:
        bands = np.full((2, changes.size), -ratio)
        bands[1] = 1.0 + 2.0 * ratio
        factor = scipy.linalg.cholesky_banded(bands)
        wander = scipy.linalg.cho_solve_banded((factor, False), changes)
        square = float(changes @ wander)
        variance = max(square / changes.size, scatter**2)
        found = -0.5 * (changes.size * np.log(variance) + square / variance) - float(np.log(factor[1]).sum())
        if found > likelihood:
            likelihood, error = found, scatter**2 / variance * wander
    levels = np.concatenate([[0.0], np.cumsum(changes - error)])
    return np.asarray(levels[np.concatenate([[0], np.cumsum(switched)])])


def _largest(changes: Iterable[Array]) -> Array:
    """The largest changes (at most a thousand, cell) of those that come some at a time, in the order of time."""
    kept, sizes = np.empty((0, 0)), np.empty(0)
    for some in changes:
        size = np.concatenate([sizes, np.einsum("tc,tc->t", some, some)])
        chosen = np.sort(np.argsort(size)[-_MOST_CHANGES:])
        before = chosen[chosen < len(kept)]
        new = some[chosen[len(before) :] - len(kept)]
        # Those before stay as they are where none of them is left out.
        old = kept if len(before) == len(kept) else kept[before]
        kept, sizes = np.concatenate([old, new]) if len(old) else new, size[chosen]
    return kept


def _leading_component(changes: Array) -> Array:
    """First principal component of changes (time, cell), of unit length and positive where it is largest, (cell,)."""
    by_cell = changes.shape[0] > changes.shape[1]
    products = changes.T @ changes if by_cell else changes @ changes.T
    last = products.shape[0] - 1
    _, vectors = scipy.linalg.eigh(products, subset_by_index=(last, last), overwrite_a=True)
    component = vectors[:, 0] if by_cell else changes.T @ vectors[:, 0]
    return np.asarray(component / np.linalg.norm(component) * np.sign(component[np.argmax(np.abs(component))]))


def _sudden_changes(frames: Array | xr.DataArray, seen: NDArray[np.bool_]) -> Iterator[Array]:
    """Change between neighbouring frames beyond the median of the changes around it, (some, cell), some at a time."""
    count = len(frames) - 1
    for some in piece_slices((count, *seen.shape)):
        start, stop = some.start, some.stop
        first = max(0, start - 3)
        changes = np.diff(np.asarray(frames[first : min(count, stop + 3) + 1]).astype(float)[:, seen], axis=0)
        sudden = np.empty((stop - start, changes.shape[1]))
        for k in range(start, stop):
            low, high = max(0, k - 3) - first, min(count, k + 4) - first
            around = np.delete(changes[low:high], k - first - low, axis=0)
            sudden[k - start] = changes[k - first] - np.median(around, axis=0)
        yield sudden
