"""Quadruples of points, and the homographies that map four points exactly: the smallest sets that locate a plan."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from thermography._typing import Array

#: Largest number of quadruples that are compared: all of 24 points, a random part of more.
_MOST_QUADRUPLES = 10_626
#: Triangles of a quadruple.
_TRIANGLES = np.array(list(combinations(range(4), 3)))


def spread_quadruples(points: Array, *, limit: int = 500) -> NDArray[np.intp]:
    """Choose quadruples of points, those first whose smallest triangle is largest, so that no three lie near a line.

    Parameters
    ----------
    points : (n, 2) ndarray
    limit : int
        Largest number of quadruples.

    Returns
    -------
    (m, 4) ndarray of int
        Indices of the points. Of more than 24 points a random part of the quadruples is compared, always the same.
    """
    count = len(points)
    quads = (
        np.array(list(combinations(range(count), 4)), np.intp).reshape(-1, 4)
        if count <= 24
        else np.argsort(np.random.default_rng(0).random((_MOST_QUADRUPLES, count)), axis=1)[:, :4]
    )
    smallest = np.abs(corner_triangles(points[quads])).min(axis=1)
    order = np.argsort(-smallest, kind="stable")[:limit]
    chosen: NDArray[np.intp] = quads[order[smallest[order] > 1e-6 * float(np.ptp(points)) ** 2]]
    return chosen


def corner_triangles(corners: Array) -> Array:
    """Twice the signed areas of the triangles of quadruples.

    Parameters
    ----------
    corners : (..., 4, 2) ndarray

    Returns
    -------
    (..., 4) ndarray
        Of the corners 012, 013, 023, 123; the sign tells the sense.
    """
    a, b, c = (corners[..., _TRIANGLES[:, i], :] for i in range(3))
    ab, ac = b - a, c - a
    area: Array = ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0]
    return area


def exact_homographies(plan: Array, image: Array) -> Array:
    """Homographies that map four plan points exactly to four image points.

    Parameters
    ----------
    plan, image : (k, 4, 2) ndarray
        Points, no three on a line; one quadruple of plan points, (1, 4, 2), serves all of the image.

    Returns
    -------
    (k, 3, 3) ndarray

    Notes
    -----
    R. Hartley, A. Zisserman, Multiple View Geometry in Computer Vision, 2nd ed. (2004), section 4.1.
    """
    middle = plan.mean(axis=(0, 1))
    scale = float(np.abs(plan - middle).max())
    x, y = np.moveaxis((plan - middle) / scale, -1, 0)
    u, v = image[..., 0], image[..., 1]
    system = np.zeros((len(image), 8, 8))
    system[:, :4, 0], system[:, :4, 1], system[:, :4, 2] = x, y, 1
    system[:, 4:, 3], system[:, 4:, 4], system[:, 4:, 5] = x, y, 1
    system[:, :4, 6], system[:, :4, 7] = -u * x, -u * y
    system[:, 4:, 6], system[:, 4:, 7] = -v * x, -v * y
    entries = np.linalg.solve(system, np.concatenate([u, v], axis=1)[..., None])[..., 0]
    matrices = np.concatenate([entries, np.ones((len(image), 1))], axis=1).reshape(-1, 3, 3)
    to_unit = np.array([[1 / scale, 0, -middle[0] / scale], [0, 1 / scale, -middle[1] / scale], [0, 0, 1]])
    return np.asarray(matrices @ to_unit)
