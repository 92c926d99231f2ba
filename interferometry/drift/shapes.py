"""Shape along the axis of a drift that shift, stretch and bend do not describe, from the readings themselves.

A hot zone of the screw, or a nut that warms where it works, moves stretches of the axis in a shape of their own. What is left of every
cycle then moves together at several targets and depends on the cycles before; noise does neither, and a single position that moves by
itself does not do the first.
"""

from __future__ import annotations

import numpy as np

from interferometry._typing import Array

#: Level at which a common motion of the targets is a shape.
SHAPE_LEVEL = 0.01
#: Least number of targets that take part in a shape (inverse participation ratio): fewer are positions that move by themselves.
LEAST_TARGETS = 3.5
#: Fewest cycles in which a shape is looked for.
SHORTEST_TEST_CYCLES = 15
_PERMUTATIONS = 199
_SEED = 0


def common_shape(residual: Array, known: Array) -> Array | None:
    """Return the shape along the axis of a motion over the cycles that the known shapes leave.

    Parameters
    ----------
    residual : (cycle, target) ndarray
        Readings minus profile, both directions averaged, um; NaN where missing.
    known : (target, k) ndarray
        Shapes that the model holds already.

    Returns
    -------
    (target,) ndarray or None
        Largest entry 1, orthogonal to the known shapes; None where no common motion is significant or too few targets take part in it.

    Notes
    -----
    docs/method/drift-estimation.md. The known shapes are taken from every cycle by least squares. The shape is the first eigenvector of the
    symmetric covariance of successive cycles, in which independent noise has expectation zero. Memory that all targets have alike is
    taken out first by the median of their lag-one correlations, so that it makes no shape. The largest eigenvalue is compared with
    those after permutations of the cycles.
    """
    cycles, targets = residual.shape
    if cycles < SHORTEST_TEST_CYCLES or targets < known.shape[1] + 2:
        return None
    remainder = _without(residual, known)
    whitened = remainder[1:] - _memory(remainder) * remainder[:-1]
    value, shape = _first_mode(whitened)
    if 1.0 / float((shape**4).sum()) < LEAST_TARGETS:
        return None
    rng = np.random.default_rng(_SEED)
    permuted = [_first_mode(rng.permutation(whitened))[0] for _ in range(_PERMUTATIONS)]
    if (1 + np.count_nonzero(np.array(permuted) >= value)) / (_PERMUTATIONS + 1) > SHAPE_LEVEL:
        return None
    return np.asarray(shape / shape[np.argmax(np.abs(shape))])


def _without(residual: Array, known: Array) -> Array:
    """Take the known shapes from every cycle; a missing target is 0 after that."""
    remainder = np.zeros_like(residual)
    for row, values in zip(remainder, residual, strict=True):
        present = np.isfinite(values)
        if np.count_nonzero(present) > known.shape[1]:
            basis = known[present]
            row[present] = values[present] - basis @ np.linalg.lstsq(basis, values[present], rcond=None)[0]
    return remainder - remainder.mean(axis=0)


def _memory(remainder: Array) -> float:
    """Median over the targets of the lag-one correlation over the cycles, at least 0."""
    product = (remainder[1:] * remainder[:-1]).sum(axis=0)
    square = (remainder**2).sum(axis=0)
    return max(0.0, float(np.median(product[square > 0] / square[square > 0]))) if (square > 0).any() else 0.0


def _first_mode(series: Array) -> tuple[float, Array]:
    """Largest eigenvalue of the symmetric covariance of successive rows, and its eigenvector."""
    product = series[:-1].T @ series[1:]
    values, vectors = np.linalg.eigh(product + product.T)
    return float(values[-1]), vectors[:, -1]
