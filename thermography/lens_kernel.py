"""L2 - Points through a lens, compiled: the projection of `thermography.lens` for kernels and for many points."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

#: Steps of the undistortion at most, and what it has to reach, in units of the focal length.
STEPS, REACHED = 40, 1e-11


@numba.njit(cache=True, nogil=True, error_model="numpy")
def projected(x: float, y: float, lens: Array) -> tuple[float, float]:
    """Sensor column and row of a plan point; `lens` as `thermography.lens.Projection.as_array` gives it."""
    w = lens[6] * x + lens[7] * y + lens[8]
    u = ((lens[0] * x + lens[1] * y + lens[2]) / w - lens[10]) / lens[9]
    v = ((lens[3] * x + lens[4] * y + lens[5]) / w - lens[11]) / lens[9]
    du, dv = _distorted(u, v, lens)
    return lens[10] + lens[9] * du, lens[11] + lens[9] * dv


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _distorted(u: float, v: float, lens: Array) -> tuple[float, float]:
    r2 = u * u + v * v
    radial = 1 + r2 * (lens[12] + lens[13] * r2)
    return (
        u * radial + 2 * lens[14] * u * v + lens[15] * (r2 + 2 * u * u),
        v * radial + lens[14] * (r2 + 2 * v * v) + 2 * lens[15] * u * v,
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def project(points: Array, lens: Array) -> Array:
    """Sensor column and row of plan points, (n, 2)."""
    found = np.empty(points.shape)
    for i in range(len(points)):
        found[i, 0], found[i, 1] = projected(points[i, 0], points[i, 1], lens)
    return found


@numba.njit(cache=True, nogil=True, error_model="numpy")
def undistort(points: Array, lens: Array) -> Array:
    """Where a lens without distortion would show sensor points, (n, 2) px."""
    found = np.empty(points.shape)
    for i in range(len(points)):
        u0, v0 = (points[i, 0] - lens[10]) / lens[9], (points[i, 1] - lens[11]) / lens[9]
        u, v = u0, v0
        for _ in range(STEPS):
            du, dv = _distorted(u, v, lens)
            u, v = u + u0 - du, v + v0 - dv
            if not max(abs(u0 - du), abs(v0 - dv)) >= REACHED:
                break
        found[i, 0], found[i, 1] = lens[10] + lens[9] * u, lens[11] + lens[9] * v
    return found


@numba.njit(cache=True, nogil=True, error_model="numpy")
def transform(points: Array, matrix: Array) -> Array:
    """Points, (n, 2), moved by a homography."""
    found = np.empty(points.shape)
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        w = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2]
        found[i, 0] = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2]) / w
        found[i, 1] = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2]) / w
    return found
