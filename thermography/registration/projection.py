"""How a plane is seen through a lens: homography and radial-tangential distortion, fitted to disc centroids.

Points through a lens, compiled: the projection of `thermography.registration.projection` for kernels and for many points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numba
import numpy as np
from scipy.optimize import least_squares

from thermography._typing import Array
from thermography.errors import ThermographyError

#: The ladder of lens models: name and number of distortion coefficients (k1, k2, p1, p2) that it leaves free.
LADDER: tuple[tuple[str, int], ...] = (("homography", 0), ("homography+k1", 1), ("homography+k1,k2,p1,p2", 4))

#: A richer lens model is taken only if it lowers the leave-one-out error to less than this part.
LADDER_GAIN = 0.75

#: Points on the rim of a disc whose image polygon's centroid predicts the disc's centroid; 24 err by less than 0.1 % of the bias.
RIM = np.exp(2j * np.pi * np.arange(24) / 24)


@dataclass(frozen=True)
class Projection:
    """Plan to sensor: ``pixel = distort(plan_to_sensor @ plan)``.

    Attributes
    ----------
    plan_to_sensor
        Homography (3, 3) from plan mm to undistorted px.
    distortion
        (k1, k2, p1, p2) in OpenCV's convention, for image coordinates divided by `focal_length_px`.
    focal_length_px, principal_point_px
        Unit and centre of the distortion; a plane seen once fixes only k1 / focal_length_px**2.
    """

    plan_to_sensor: Array
    distortion: Array
    focal_length_px: float
    principal_point_px: tuple[float, float]

    @cached_property
    def as_array(self) -> Array:
        """One array for the kernels: 9 of the homography, focal length, principal point, k1, k2, p1, p2."""
        return np.concatenate(
            [self.plan_to_sensor.ravel(), [self.focal_length_px], self.principal_point_px, self.distortion], dtype=float
        )

    def to_sensor(self, points_mm: Array) -> Array:
        """Project plan points, shape (..., 2) mm, to the sensor, shape (..., 2) px (column, row)."""
        return _each(project, points_mm, self.as_array)

    def to_plan(self, points_px: Array) -> Array:
        """Locate sensor points, shape (..., 2) px (column, row), on the plan, shape (..., 2) mm."""
        return _each(transform, self.undistort(points_px), np.linalg.inv(self.plan_to_sensor))

    def undistort(self, points_px: Array) -> Array:
        """Move sensor points, shape (..., 2) px, to where a lens without distortion would show them."""
        if not self.distortion.any():
            return np.asarray(points_px, float)
        return _each(undistort, points_px, self.as_array)

    def jacobian(self, points_mm: Array) -> Array:
        """Derivative of the sensor position by the plan position, shape (..., 2, 2), px/mm."""
        step = 1e-3
        columns = [
            (self.to_sensor(points_mm + d) - self.to_sensor(points_mm - d)) / (2 * step) for d in step * np.eye(2)
        ]
        return np.stack(columns, axis=-1)

    def disc_centroids(self, centres_mm: Array, radii_mm: Array) -> Array:
        """Centroids, shape (n, 2) px, of the images of discs; perspective shifts them from the image of the centre."""
        rim_mm = centres_mm[:, None, :] + radii_mm[:, None, None] * np.stack([RIM.real, RIM.imag], axis=-1)
        rim = self.to_sensor(rim_mm)
        origin = rim[:, :1]
        a, b = rim - origin, np.roll(rim, -1, axis=1) - origin
        cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
        centroid: Array = origin[:, 0] + ((a + b) * cross[..., None]).sum(axis=1) / (3 * cross.sum(axis=1))[:, None]
        return centroid


@dataclass(frozen=True)
class Sightings:
    """Disc centroids seen on the sensor and what they are on the plan.

    Attributes
    ----------
    points_px
        Centroids (n, 2), px (column, row).
    centres_mm, radii_mm
        The discs on the plan, (n, 2) and (n,), mm.
    u_px
        Standard uncertainty of the centroids, (n,): discs of low contrast count less.
    """

    points_px: Array
    centres_mm: Array
    radii_mm: Array
    u_px: Array

    def without(self, index: int) -> Sightings:
        """The sightings but one."""
        return Sightings(
            *(
                np.delete(values, index, axis=0)
                for values in (self.points_px, self.centres_mm, self.radii_mm, self.u_px)
            )
        )

    def plan_error(self, projection: Projection) -> Array:
        """Seen minus listed place on the plan, shape (n, 2) mm; the perspective shift of a disc's centroid is not an error."""
        misses = self.points_px - projection.disc_centroids(self.centres_mm, self.radii_mm)
        error: Array = np.linalg.solve(projection.jacobian(self.centres_mm), misses[..., None])[..., 0]
        return error


def fit_homography(seen: Sightings, ideal: Projection) -> Projection:
    """Fit a plain homography to four or more discs behind the distortion of `ideal`, as the start of `fit_projection`.

    Raises
    ------
    ThermographyError
        The points lie on a line, so that no homography is determined.
    """
    matrix, _ = cv2.findHomography(seen.centres_mm.astype(float), ideal.undistort(seen.points_px).astype(float), 0)
    if matrix is None or not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-9:
        raise ThermographyError(
            "the fiducials lie on a line or on one spot; spread at least four over both sides of the plan"
        )
    return replace(ideal, plan_to_sensor=matrix)


def fit_projection(seen: Sightings, start: Projection, coefficients: int) -> Projection:
    """Fit homography and the first `coefficients` (0, 1 or 4) distortion coefficients by weighted least squares on the sensor.

    The distortion of `start` beyond `coefficients` is kept.
    """
    pack, unpack = _parameters(start, seen.centres_mm, coefficients)

    # The shift of a disc's centroid by perspective hardly moves with the fit, so it is held fixed within one.
    shift = start.disc_centroids(seen.centres_mm, seen.radii_mm) - start.to_sensor(seen.centres_mm)

    def residuals(parameters: Array) -> Array:
        misses = unpack(parameters).to_sensor(seen.centres_mm) + shift - seen.points_px
        return (misses / seen.u_px[:, None]).ravel()

    return unpack(least_squares(residuals, pack(start), method="lm", xtol=1e-9, ftol=1e-9).x)


def climb_ladder(seen: Sightings, start: Projection) -> tuple[Projection, int]:
    """Fit every rung of the ladder that the discs determine; keep the lowest that no richer one clearly beats.

    Judged by the leave-one-out error, each disc weighted by its own uncertainty.

    Returns
    -------
    Projection, int
        The fit and its number of distortion coefficients.
    """
    best, best_count, best_error = fit_projection(seen, fit_projection(seen, start, 0), 0), 0, np.inf
    for _, count in LADDER:
        if count > 0 and 2 * (len(seen.u_px) - 2) < 8 + count:
            break
        projection = fit_projection(seen, best, count)
        error = float(np.sqrt(np.mean((leave_one_out(seen, projection, count) / seen.u_px) ** 2)))
        if error < LADDER_GAIN * best_error:
            best, best_count, best_error = projection, count, error
    return best, best_count


def leave_one_out(seen: Sightings, projection: Projection, coefficients: int) -> Array:
    """Distance in mm, shape (n,), by which each disc is missed when the others alone are fitted; NaN where they cannot be.

    From the leverage of each disc in the one fit of all (Allen 1974), which equals fitting n times as long as the projection is
    linear over the residuals; they are hundredths of a pixel.
    """
    count = len(seen.u_px)
    if 2 * (count - 1) < 8 + coefficients:
        return np.full(count, np.nan)
    jacobian = parameter_jacobian(projection, seen.centres_mm, coefficients)(seen.centres_mm) / seen.u_px[:, None, None]
    flat = jacobian.reshape(2 * count, -1)
    leverage = jacobian @ np.linalg.pinv(flat.T @ flat) @ np.swapaxes(jacobian, 1, 2)
    misses = (seen.points_px - projection.disc_centroids(seen.centres_mm, seen.radii_mm)) / seen.u_px[:, None]
    missed_px = np.linalg.solve(np.eye(2) - leverage, misses[..., None]) * seen.u_px[:, None, None]
    missed_mm = np.linalg.solve(projection.jacobian(seen.centres_mm), missed_px)[..., 0]
    return np.asarray(np.linalg.norm(missed_mm, axis=1))


def parameter_jacobian(projection: Projection, centres_mm: Array, coefficients: int) -> Callable[[Array], Array]:
    """Return a function from plan points (n, 2) to the sensor's derivative by the fitted parameters (n, 2, parameters), px."""
    pack, unpack = _parameters(projection, centres_mm, coefficients)
    parameters = pack(projection)
    steps = 1e-6 * np.maximum(np.abs(parameters), 1e-2)

    def derivative(points_mm: Array) -> Array:
        columns = []
        for step, unit in zip(steps, np.eye(len(parameters)), strict=True):
            plus, minus = unpack(parameters + step * unit), unpack(parameters - step * unit)
            columns.append((plus.to_sensor(points_mm) - minus.to_sensor(points_mm)) / (2 * step))
        return np.stack(columns, axis=-1)

    return derivative


def parameter_covariance(seen: Sightings, projection: Projection, coefficients: int) -> Array:
    """Covariance of the fitted parameters, scaled up by the discs' misfit where that exceeds their stated uncertainty."""
    jacobian = parameter_jacobian(projection, seen.centres_mm, coefficients)(seen.centres_mm) / seen.u_px[:, None, None]
    jacobian = jacobian.reshape(2 * len(seen.u_px), -1)
    misses = (seen.points_px - projection.disc_centroids(seen.centres_mm, seen.radii_mm)) / seen.u_px[:, None]
    freedom = 2 * len(seen.u_px) - jacobian.shape[1]
    # Four discs leave no residual: then the centroids' own uncertainty is all that is known, and never less than that.
    scale = max(float((misses**2).sum()) / freedom, 1.0) if freedom > 0 else 1.0
    covariance: Array = scale * np.linalg.pinv(jacobian.T @ jacobian)
    return covariance


def _parameters(
    start: Projection, centres_mm: Array, coefficients: int
) -> tuple[Callable[[Projection], Array], Callable[[Array], Projection]]:
    """Well-conditioned parameters: eight homography entries between centred unit coordinates, then the distortion."""
    middle, scale = centres_mm.mean(axis=0), float(np.abs(centres_mm - centres_mm.mean(axis=0)).max())
    f, (cx, cy) = start.focal_length_px, start.principal_point_px
    to_unit = np.linalg.inv(np.array([[scale, 0, middle[0]], [0, scale, middle[1]], [0, 0, 1]]))
    to_pixels = np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]])

    def pack(projection: Projection) -> Array:
        unit = np.linalg.inv(to_pixels) @ projection.plan_to_sensor @ np.linalg.inv(to_unit)
        return np.concatenate([(unit / unit[2, 2]).ravel()[:8], projection.distortion[:coefficients]])

    def unpack(parameters: Array) -> Projection:
        unit = np.append(parameters[:8], 1.0).reshape(3, 3)
        distortion = np.concatenate([parameters[8:], start.distortion[coefficients:]])
        matrix = to_pixels @ unit @ to_unit
        return replace(start, plan_to_sensor=matrix / matrix[2, 2], distortion=distortion)

    return pack, unpack


def _each(kernel: Callable[[Array, Array], Array], points: Array, parameters: Array) -> Array:
    """Send points of shape (..., 2) through a kernel for (n, 2)."""
    points = np.ascontiguousarray(points, float)
    return kernel(points.reshape(-1, 2), parameters).reshape(points.shape)


#: Steps of the undistortion at most, and what it has to reach, in units of the focal length.
STEPS, REACHED = 40, 1e-11


@numba.njit(cache=True, nogil=True, error_model="numpy")
def projected(x: float, y: float, lens: Array) -> tuple[float, float]:
    """Sensor column and row of a plan point; `lens` as `thermography.registration.projection.Projection.as_array` gives it."""
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
