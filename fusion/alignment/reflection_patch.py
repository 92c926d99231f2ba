"""Find patches of the field that switch as a reflection does, faster than heat can flow.

Heat needs minutes to cross a few centimetres of iron (diffusivity 1.6e-5 m2/s: 1 cm in 6 s, 5 cm in 160 s, 20 cm in 40 min), and a
source under the table changes the slope of a temperature, not its value. A patch that jumps between two frames, and jumps back, is
radiation from elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg, stats

from fusion._typing import Array

#: A change counts as a jump where it exceeds the usual change of its patch this many times (robust sigma).
_JUMP_SIGMAS = 8.0
#: A patch stands out where its jump is this much larger than the same jump averaged over the table; a camera offset has 1.
_LOCAL_RATIO = 3.0
_MIN_FRAMES = 9


@dataclass(frozen=True)
class SwitchingPatch:
    """A patch of the plan whose apparent temperature switches.

    Attributes
    ----------
    pattern : (y, x) ndarray
        Relative size of the jump, about 1 on the patch, 0 where the plan is not seen.
    course : (time,) ndarray, K
        Sum of all jumps up to each frame, on the patch.
    """

    pattern: Array
    course: Array


def find_switching_patch(rise: Array) -> SwitchingPatch | None:
    """Find the patch whose switching explains most of the sudden changes of a field.

    Parameters
    ----------
    rise : (time, y, x) ndarray, K
        Temperature rise on the plan, NaN where the plan is not seen.

    Returns
    -------
    SwitchingPatch or None
        None where nothing jumps, where the whole table jumps alike (a camera offset), or with fewer than 9 frames.

    Notes
    -----
    Sudden changes are differences of neighbouring frames minus the median of the differences around them. Their first principal
    component is the patch; its scores beyond 8 robust standard deviations are the jumps.
    """
    if rise.shape[0] < _MIN_FRAMES:
        return None
    seen = np.isfinite(rise).all(axis=0)
    sudden = _sudden_changes(rise[:, seen])
    if not sudden.any():
        return None
    component = _leading_component(sudden)
    score = sudden @ component / (component @ component)
    scatter = stats.median_abs_deviation(score, scale="normal")
    jumps = np.where(np.abs(score) > _JUMP_SIGMAS * max(scatter, 1e-9), score, 0.0)
    # The upper percent stands for the patch's own height, so that one noisy cell does not make a pattern local.
    height = float(np.quantile(component, 0.99))
    if not jumps.any() or height < _LOCAL_RATIO * abs(float(component.mean())):
        return None
    pattern = np.zeros(seen.shape)
    pattern[seen] = component / height
    return SwitchingPatch(pattern, np.concatenate([[0.0], np.cumsum(jumps)]) * height)


def _leading_component(changes: Array) -> Array:
    """First principal component of changes (time, cell), of unit length and positive where it is largest, (cell,).

    From the products of times or of cells, whichever are fewer: all components of very many frames would take hours.
    """
    by_cell = changes.shape[0] > changes.shape[1]
    products = changes.T @ changes if by_cell else changes @ changes.T
    last = products.shape[0] - 1
    _, vectors = linalg.eigh(products, subset_by_index=(last, last), overwrite_a=True)
    component = vectors[:, 0] if by_cell else changes.T @ vectors[:, 0]
    return np.asarray(component / np.linalg.norm(component) * np.sign(component[np.argmax(np.abs(component))]))


def _sudden_changes(values: Array) -> Array:
    """Change between neighbouring frames beyond the median of the changes around it, (time - 1, cell)."""
    changes = np.diff(values, axis=0)
    sudden = np.empty_like(changes)
    for k in range(changes.shape[0]):
        low, high = max(0, k - 3), min(changes.shape[0], k + 4)
        sudden[k] = changes[k] - np.median(np.delete(changes[low:high], k - low, axis=0), axis=0)
    return sudden
