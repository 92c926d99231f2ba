"""Patches of the field that switch faster than heat can flow: what a reflection does, and a warming table cannot.

Heat needs minutes to cross a few centimetres of iron (diffusivity 1.6e-5 m2/s: 1 cm in 6 s, 5 cm in 160 s, 20 cm in 40 min), and a
source under the table changes the slope of a temperature, not its value. A patch that jumps between two frames, and jumps back, is
light from elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion._typing import Array

#: A change counts as a jump where it exceeds the usual change of its patch this many times (robust sigma).
_JUMP_SIGMAS = 8.0
#: A patch stands out where its jump is this much larger than the same jump averaged over the table; a camera offset has 1.
_LOCAL_RATIO = 3.0
_LEAST_FRAMES = 9


@dataclass(frozen=True)
class SwitchingPatch:
    """A patch that switches.

    Attributes
    ----------
    pattern : (y, x) relative size of the jump, largest 1
    course : (time,) K, the sum of all jumps up to each frame
    """

    pattern: Array
    course: Array


def find_switching_patch(rise: Array) -> SwitchingPatch | None:
    """The patch whose switching explains most of the sudden changes of a field, or None.

    Parameters
    ----------
    rise : (time, y, x) K, NaN where the plan is not seen
    """
    if rise.shape[0] < _LEAST_FRAMES:
        return None
    seen = np.isfinite(rise).all(axis=0)
    sudden = _sudden_changes(rise[:, seen])
    _, _, modes = np.linalg.svd(sudden, full_matrices=False)
    mode = modes[0] * np.sign(modes[0][np.argmax(np.abs(modes[0]))])
    size = sudden @ mode / (mode @ mode)
    scatter = 1.4826 * np.median(np.abs(size - np.median(size)))
    jumps = np.where(np.abs(size) > _JUMP_SIGMAS * max(scatter, 1e-9), size, 0.0)
    # The upper percent stands for the patch's own height, so that one noisy cell does not make a pattern local.
    height = float(np.quantile(mode, 0.99))
    if not jumps.any() or height < _LOCAL_RATIO * abs(float(mode.mean())):
        return None
    pattern = np.zeros(seen.shape)
    pattern[seen] = mode / height
    return SwitchingPatch(pattern, np.concatenate([[0.0], np.cumsum(jumps)]) * height)


def _sudden_changes(values: Array) -> Array:
    """Change between neighbouring frames beyond the median of the changes around it, (time - 1, cell)."""
    changes = np.diff(values, axis=0)
    sudden = np.empty_like(changes)
    for k in range(changes.shape[0]):
        low, high = max(0, k - 3), min(changes.shape[0], k + 4)
        sudden[k] = changes[k] - np.median(np.delete(changes[low:high], k - low, axis=0), axis=0)
    return sudden
