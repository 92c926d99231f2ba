"""Projection of the table plan through a lens onto the sensor: homography and radial-tangential distortion, and their fit to discs.

A plan point (x, y) is mapped by a homography to undistorted pixels; divided by the focal length about the principal point these
are the normalised coordinates (u, v), which the lens distorts with r2 = u^2 + v^2 (D. C. Brown, Close-range camera calibration,
Photogrammetric Engineering 37 (1971) 855-866, in OpenCV's convention)::

    u' = u (1 + k1 r2 + k2 r2^2) + 2 p1 u v + p2 (r2 + 2 u^2)
    v' = v (1 + k1 r2 + k2 r2^2) + p1 (r2 + 2 v^2) + 2 p2 u v
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numba
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from thermography._typing import Array
from thermography.errors import ThermographyError

#: Lens models in ascending order: name, and number of the distortion coefficients (k1, k2, p1, p2) that are fitted.
LENS_MODELS: tuple[tuple[str, int], ...] = (("homography", 0), ("homography+k1", 1), ("homography+k1,k2,p1,p2", 4))
#: A model with more coefficients is chosen only if it lowers the leave-one-out error below this share.
_REQUIRED_GAIN = 0.75
#: Standard deviations of k1, k2, p1, p2 about zero among lenses that are not calibrated, for coordinates divided by the width of the
#: frame. A k1 of 0.2 moves a corner of a 4:3 frame by 8 % of its distance from the centre, as wide-angle thermal lenses do; k2 adds up
#: to half of that there, p1 and p2 of 0.002 about one pixel of 640 at the edge (decentred by some tenths of a degree).
LENS_SPREAD = np.array([0.2, 0.1, 0.002, 0.002])
#: Fewest discs whose residuals can tell whether k1 is needed; with fewer it is fitted against its spread alone.
_LEAST_FOR_CHOICE = 7
#: Points on the rim of a disc, as unit circle. The centroid of their image polygon shows 98.9 % of the perspective shift of the disc's
#: centroid: the second moment of an inscribed 24-gon over that of its circle, (2 + cos(2 pi / 24)) / 3.
_RIM = np.exp(2j * np.pi * np.arange(24) / 24)
#: Largest number of iterations of the undistortion, and its tolerance in units of the focal length.
_UNDISTORTION_STEPS, _UNDISTORTION_TOLERANCE = 40, 1e-11


@numba.njit(cache=True, nogil=True, error_model="numpy")
def project_point(x: float, y: float, lens: Array) -> tuple[float, float]:
    """Project one plan point to the sensor; for compiled loops.

    Parameters
    ----------
    x, y : float, mm
        Plan point.
    lens : (16,) ndarray
        `Projection.as_array`.

    Returns
    -------
    column, row : float, px
    """
    w = lens[6] * x + lens[7] * y + lens[8]
    u = ((lens[0] * x + lens[1] * y + lens[2]) / w - lens[10]) / lens[9]
    v = ((lens[3] * x + lens[4] * y + lens[5]) / w - lens[11]) / lens[9]
    du, dv = _distort(u, v, lens)
    return lens[10] + lens[9] * du, lens[11] + lens[9] * dv


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _distort(u: float, v: float, lens: Array) -> tuple[float, float]:
    """Distorted normalised coordinates."""
    r2 = u * u + v * v
    radial = 1 + r2 * (lens[12] + lens[13] * r2)
    return (
        u * radial + 2 * lens[14] * u * v + lens[15] * (r2 + 2 * u * u),
        v * radial + lens[14] * (r2 + 2 * v * v) + 2 * lens[15] * u * v,
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _project(points: Array, lens: Array) -> Array:
    """Sensor column and row of plan points, (n, 2)."""
    projected = np.empty(points.shape)
    for i in range(len(points)):
        projected[i, 0], projected[i, 1] = project_point(points[i, 0], points[i, 1], lens)
    return projected


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _undistort_point(column: float, row: float, lens: Array) -> tuple[float, float]:
    """A sensor point, px, as a lens without distortion would show it, by fixed-point iteration."""
    u0, v0 = (column - lens[10]) / lens[9], (row - lens[11]) / lens[9]
    u, v = u0, v0
    for _ in range(_UNDISTORTION_STEPS):
        du, dv = _distort(u, v, lens)
        u, v = u + u0 - du, v + v0 - dv
        if not max(abs(u0 - du), abs(v0 - dv)) >= _UNDISTORTION_TOLERANCE:
            break
    return lens[10] + lens[9] * u, lens[11] + lens[9] * v


@numba.njit(cache=True, nogil=True, error_model="numpy")
def locate_point(column: float, row: float, lens: Array, sensor_to_plan: Array) -> tuple[float, float]:
    """Locate one sensor point on the plan; for compiled loops.

    Parameters
    ----------
    column, row : float, px
        Sensor point.
    lens : (16,) ndarray
        `Projection.as_array`.
    sensor_to_plan : (3, 3) ndarray
        `Projection.sensor_to_plan`.

    Returns
    -------
    x, y : float, mm
    """
    u, v = _undistort_point(column, row, lens)
    m = sensor_to_plan
    w = m[2, 0] * u + m[2, 1] * v + m[2, 2]
    return (m[0, 0] * u + m[0, 1] * v + m[0, 2]) / w, (m[1, 0] * u + m[1, 1] * v + m[1, 2]) / w


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _undistort(points: Array, lens: Array) -> Array:
    """Sensor points, (n, 2) px, as a lens without distortion would show them."""
    undistorted = np.empty(points.shape)
    for i in range(len(points)):
        undistorted[i, 0], undistorted[i, 1] = _undistort_point(points[i, 0], points[i, 1], lens)
    return undistorted


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _transform(points: Array, matrix: Array) -> Array:
    """Points, (n, 2), mapped by a homography (3, 3)."""
    mapped = np.empty(points.shape)
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        w = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2]
        mapped[i, 0] = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2]) / w
        mapped[i, 1] = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2]) / w
    return mapped


def _each(kernel: Callable[[Array, Array], Array], points: Array, parameters: Array) -> Array:
    """Send points of shape (..., 2) through a kernel for (n, 2)."""
    points = np.ascontiguousarray(points, float)
    return kernel(points.reshape(-1, 2), parameters).reshape(points.shape)


@dataclass(frozen=True)
class Projection:
    """Map from the table plan to the sensor: ``pixel = distort(plan_to_sensor @ plan)``.

    Attributes
    ----------
    plan_to_sensor : (3, 3) ndarray
        Homography from plan mm to undistorted px.
    distortion : (4,) ndarray
        k1, k2, p1, p2 of the normalised coordinates.
    focal_length_px : float, px
        Unit of the normalised coordinates; a plane in one position determines k1 / focal_length_px**2 only.
    principal_point_px : (column, row), px
        Centre of the distortion.
    """

    plan_to_sensor: Array
    distortion: Array
    focal_length_px: float
    principal_point_px: tuple[float, float]

    @cached_property
    def as_array(self) -> Array:
        """Parameters for the kernels, (16,): homography by rows, focal length, principal point, k1, k2, p1, p2."""
        return np.concatenate(
            [self.plan_to_sensor.ravel(), [self.focal_length_px], self.principal_point_px, self.distortion], dtype=float
        )

    @cached_property
    def sensor_to_plan(self) -> Array:
        """Homography from undistorted px to plan mm, (3, 3)."""
        return np.linalg.inv(self.plan_to_sensor)

    def to_sensor(self, points_mm: Array) -> Array:
        """Project plan points (x, y), shape (..., 2) mm, to sensor points (column, row), shape (..., 2) px."""
        return _each(_project, points_mm, self.as_array)

    def to_plan(self, points_px: Array) -> Array:
        """Locate sensor points (column, row), shape (..., 2) px, on the plan, shape (..., 2) mm."""
        return _each(_transform, self.undistort(points_px), self.sensor_to_plan)

    def undistort(self, points_px: Array) -> Array:
        """Move sensor points, shape (..., 2) px, to where a lens without distortion would show them."""
        if not self.distortion.any():
            return np.asarray(points_px, float)
        return _each(_undistort, points_px, self.as_array)

    def jacobian(self, points_mm: Array) -> Array:
        """Derivative of the sensor position by the plan position, shape (..., 2, 2), px/mm, by central differences of 1 um."""
        step = 1e-3
        columns = [
            (self.to_sensor(points_mm + d) - self.to_sensor(points_mm - d)) / (2 * step) for d in step * np.eye(2)
        ]
        return np.stack(columns, axis=-1)

    def disc_centroids(self, centres_mm: Array, radii_mm: Array) -> Array:
        """Centroids of the images of discs, which perspective shifts from the images of their centres.

        Parameters
        ----------
        centres_mm : (n, 2) ndarray, mm
        radii_mm : (n,) ndarray, mm

        Returns
        -------
        (n, 2) ndarray, px
            Centroid (column, row) of the polygon through the images of 24 points on the rim.
        """
        rim_mm = centres_mm[:, None, :] + radii_mm[:, None, None] * np.stack([_RIM.real, _RIM.imag], axis=-1)
        rim = self.to_sensor(rim_mm)
        origin = rim[:, :1]
        a, b = rim - origin, np.roll(rim, -1, axis=1) - origin
        cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
        moment, area = ((a + b) * cross[..., None]).sum(axis=1), 3 * cross.sum(axis=1)[:, None]
        # A disc of no diameter is a point, and has no perspective shift.
        centroid: Array = origin[:, 0] + np.divide(moment, area, out=np.zeros_like(moment), where=area != 0)
        return centroid


@dataclass(frozen=True)
class DiscObservations:
    """Disc centroids observed on the sensor, and the discs on the plan.

    Attributes
    ----------
    points_px : (n, 2) ndarray, px
        Observed centroids (column, row).
    centres_mm, radii_mm : (n, 2) and (n,) ndarray, mm
        The discs on the plan.
    u_px : (n,) ndarray, px
        Standard uncertainty of either coordinate of a centroid: weights of the fit.
    """

    points_px: Array
    centres_mm: Array
    radii_mm: Array
    u_px: Array

    def without(self, index: int) -> DiscObservations:
        """All observations but the one at `index`."""
        return DiscObservations(
            *(
                np.delete(values, index, axis=0)
                for values in (self.points_px, self.centres_mm, self.radii_mm, self.u_px)
            )
        )

    def select(self, chosen: NDArray[np.bool_]) -> DiscObservations:
        """The observations that are True in `chosen`, (n,)."""
        return DiscObservations(
            self.points_px[chosen], self.centres_mm[chosen], self.radii_mm[chosen], self.u_px[chosen]
        )

    def residuals_px(self, projection: Projection) -> Array:
        """Observed minus projected centroids, (n, 2) px."""
        residuals: Array = self.points_px - projection.disc_centroids(self.centres_mm, self.radii_mm)
        return residuals

    def residuals_mm(self, projection: Projection) -> Array:
        """Observed minus listed positions on the plan, (n, 2) mm; the perspective shift of a centroid is no residual."""
        residuals: Array = np.linalg.solve(
            projection.jacobian(self.centres_mm), self.residuals_px(projection)[..., None]
        )[..., 0]
        return residuals


def fit_homography(observations: DiscObservations, ideal: Projection) -> Projection:
    """Fit a homography to four or more discs behind a given distortion: the start of `fit_projection`.

    Parameters
    ----------
    observations : DiscObservations
        Four or more discs, not on one line.
    ideal : Projection
        Gives distortion, focal length and principal point; its homography is ignored.

    Returns
    -------
    Projection
        `ideal` with the homography of least squares on the sensor, unweighted.

    Raises
    ------
    ThermographyError
        The discs lie on one line, so that no homography is determined.

    Notes
    -----
    R. Hartley, A. Zisserman, Multiple View Geometry in Computer Vision, 2nd ed. (2004), ch. 4, as implemented in OpenCV.
    """
    undistorted_px = ideal.undistort(observations.points_px).astype(float)
    matrix, _ = cv2.findHomography(observations.centres_mm.astype(float), undistorted_px, 0)
    if matrix is None or not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-9:
        raise ThermographyError(
            "the fiducials lie on a line or on one spot; spread at least four over both sides of the plan"
        )
    return replace(ideal, plan_to_sensor=matrix)


def fit_projection(observations: DiscObservations, start: Projection, coefficients: int) -> Projection:
    """Fit homography and distortion to discs by weighted least squares on the sensor (Levenberg-Marquardt).

    Parameters
    ----------
    observations : DiscObservations
    start : Projection
        Start of the iteration; its focal length, its principal point and its distortion beyond `coefficients` are kept.
    coefficients : int
        Number of distortion coefficients to fit: 0, 1 (k1) or 4 (k1, k2, p1, p2).

    Returns
    -------
    Projection

    Notes
    -----
    A fitted coefficient takes part as one more observation, zero with a standard uncertainty of `LENS_SPREAD` (Bayesian least squares;
    JCGM 101:2008, 4.11.2): with many discs it decides nothing, with four or five it keeps the fit determined.
    """
    pack, unpack = _parameters(start, observations.centres_mm, coefficients)
    # The perspective shift of the centroids hardly changes during the fit and is held fixed.
    shift = start.disc_centroids(observations.centres_mm, observations.radii_mm) - start.to_sensor(
        observations.centres_mm
    )

    def residuals(parameters: Array) -> Array:
        residuals_px = unpack(parameters).to_sensor(observations.centres_mm) + shift - observations.points_px
        weighted = (residuals_px / observations.u_px[:, None]).ravel()
        return np.concatenate([weighted, parameters[8:] / LENS_SPREAD[:coefficients]])

    return unpack(least_squares(residuals, pack(start), method="lm", xtol=1e-9, ftol=1e-9).x)


def select_lens_model(observations: DiscObservations, start: Projection) -> tuple[Projection, int]:
    """Fit every lens model that the discs determine, and choose the simplest that no richer one clearly improves on.

    A richer model is chosen if it lowers the leave-one-out error, weighted by the uncertainties of the discs, below 75 %. Six discs or
    fewer cannot tell, and k1 is fitted against its spread among lenses.

    Parameters
    ----------
    observations : DiscObservations
    start : Projection
        From `fit_homography`.

    Returns
    -------
    projection : Projection
        The fit of the chosen model.
    coefficients : int
        Its number of distortion coefficients, see `LENS_MODELS`.
    """
    best, best_count, best_error = fit_projection(observations, fit_projection(observations, start, 0), 0), 0, np.inf
    if len(observations.u_px) < _LEAST_FOR_CHOICE:
        return fit_projection(observations, best, 1), 1
    for _, count in LENS_MODELS:
        if count > 0 and 2 * (len(observations.u_px) - 2) < 8 + count:
            break
        projection = fit_projection(observations, best, count)
        weighted = leave_one_out_mm(observations, projection, count) / observations.u_px
        error = float(np.sqrt(np.mean(weighted**2)))
        if error < _REQUIRED_GAIN * best_error:
            best, best_count, best_error = projection, count, error
    return best, best_count


def leave_one_out_mm(observations: DiscObservations, projection: Projection, coefficients: int) -> Array:
    """Distance by which each disc is missed by the fit to all other discs.

    Parameters
    ----------
    observations : DiscObservations
    projection : Projection
        The fit to all discs.
    coefficients : int
        Number of its fitted distortion coefficients.

    Returns
    -------
    (n,) ndarray, mm
        On the plan; NaN where the other discs would not determine the fit.

    Notes
    -----
    The PRESS residual ``(I - H_ii)^-1 r_i`` from the leverage H_ii of each disc (D. M. Allen, Technometrics 16 (1974) 125-127). It
    equals n repeated fits as long as the projection is linear over the residuals, which are hundredths of a pixel.
    """
    count = len(observations.u_px)
    if 2 * (count - 1) < 8:
        return np.full(count, np.nan)
    missed_px = prediction_errors_px(observations, projection, coefficients)[0][..., None]
    missed_mm = np.linalg.solve(projection.jacobian(observations.centres_mm), missed_px)[..., 0]
    return np.asarray(np.linalg.norm(missed_mm, axis=1))


def prediction_errors_px(
    observations: DiscObservations,
    projection: Projection,
    coefficients: int,
    *,
    fitted: NDArray[np.bool_] | None = None,
) -> tuple[Array, Array]:
    """Error by which each disc is missed by a fit that it takes no part in, and the covariance of that error.

    Parameters
    ----------
    observations : DiscObservations
        Discs of the fit, and others.
    projection : Projection
        The fit.
    coefficients : int
        Number of its fitted distortion coefficients.
    fitted : (n,) ndarray of bool or None
        Which discs took part in the fit; None for all. Of these, the fit to the others is taken.

    Returns
    -------
    errors_px : (n, 2) ndarray, px
        Observed minus predicted centroid.
    covariances : (n, 2, 2) ndarray
        Of the errors divided by the uncertainty of their disc.
    """
    fitted = np.ones(len(observations.u_px), bool) if fitted is None else fitted
    jacobian = _weighted_jacobian(observations, projection, coefficients)
    part = jacobian[fitted].reshape(2 * int(fitted.sum()), -1)
    parameters = np.linalg.pinv(part.T @ part + _prior_information(coefficients))
    leverage = jacobian @ parameters @ np.swapaxes(jacobian, 1, 2)
    covariances = np.where(fitted[:, None, None], np.eye(2) - leverage, np.eye(2) + leverage)
    errors = observations.residuals_px(projection)
    covariances[fitted] = np.linalg.inv(covariances[fitted])
    errors[fitted] = (covariances[fitted] @ errors[fitted, :, None])[..., 0]
    return errors, covariances


def parameter_jacobian(projection: Projection, centres_mm: Array, coefficients: int) -> Callable[[Array], Array]:
    """Derivative of the sensor position by the fitted parameters, as a function of the plan point.

    Parameters
    ----------
    projection : Projection
        Where to take the derivative.
    centres_mm : (n, 2) ndarray, mm
        The discs of the fit; their mean and extent normalise the homography.
    coefficients : int
        Number of fitted distortion coefficients.

    Returns
    -------
    callable
        From plan points (m, 2) mm to (m, 2, 8 + coefficients) px per unit of the parameters, by central differences.
    """
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


def variance_factor(observations: DiscObservations, projection: Projection, coefficients: int) -> tuple[float, float]:
    """Reduced chi-square of the residuals, and its degrees of freedom.

    Parameters
    ----------
    observations : DiscObservations
    projection : Projection
        The fit.
    coefficients : int
        Number of its fitted distortion coefficients.

    Returns
    -------
    factor : float
        1 at least: residuals smaller than the centroids' uncertainty prove nothing about the list of places.
    freedom : float
        Two per disc, less the trace of the leverage; 0 where the discs only just determine the fit.
    """
    jacobian = _weighted_jacobian(observations, projection, coefficients).reshape(2 * len(observations.u_px), -1)
    information = jacobian.T @ jacobian
    used = float(np.trace(np.linalg.pinv(information + _prior_information(coefficients)) @ information))
    freedom = 2 * len(observations.u_px) - used
    if freedom < 0.5:
        return 1.0, 0.0
    weighted = observations.residuals_px(projection) / observations.u_px[:, None]
    return max(float((weighted**2).sum()) / freedom, 1.0), freedom


def parameter_covariance(
    observations: DiscObservations, projection: Projection, coefficients: int, *, factor: float
) -> Array:
    """Covariance of the parameters.

    Parameters
    ----------
    observations : DiscObservations
    projection : Projection
        The fit.
    coefficients : int
        Number of distortion coefficients that are uncertain: those fitted, and those that were taken as zero.
    factor : float
        `variance_factor` of the residuals (Birge ratio squared; R. T. Birge, Phys. Rev. 40 (1932) 207-227).

    Returns
    -------
    (8 + coefficients, 8 + coefficients) ndarray
        In the units of `parameter_jacobian`: ``(J^T J / factor + P)^-1`` with rows of J divided by the uncertainty of the discs and P
        the inverse squares of `LENS_SPREAD`.
    """
    jacobian = _weighted_jacobian(observations, projection, coefficients).reshape(2 * len(observations.u_px), -1)
    covariance: Array = np.linalg.pinv(jacobian.T @ jacobian / factor + _prior_information(coefficients))
    return covariance


def _prior_information(coefficients: int) -> Array:
    """Inverse covariance of the parameters before any disc: nothing is known of the homography."""
    return np.diag(np.concatenate([np.zeros(8), LENS_SPREAD[:coefficients] ** -2.0]))


def _weighted_jacobian(observations: DiscObservations, projection: Projection, coefficients: int) -> Array:
    """Derivative of the discs' sensor positions by the parameters over their uncertainty, (n, 2, parameters)."""
    derivative = parameter_jacobian(projection, observations.centres_mm, coefficients)(observations.centres_mm)
    weighted: Array = derivative / observations.u_px[:, None, None]
    return weighted


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
