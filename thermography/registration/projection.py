"""Projection of the table plan through a lens onto the sensor: homography and radial-tangential distortion, and their fit to discs.

A plan point (x, y) is mapped by a homography to undistorted pixels; divided by the focal length about the principal point these
are the normalised coordinates (u, v), which the lens distorts with r2 = u^2 + v^2 (D. C. Brown, Close-range camera calibration,
Photogrammetric Engineering 37 (1971) 855-866, in OpenCV's convention)::

    u' = u (1 + k1 r2 + k2 r2^2) + 2 p1 u v + p2 (r2 + 2 u^2)
    v' = v (1 + k1 r2 + k2 r2^2) + p1 (r2 + 2 v^2) + 2 p2 u v
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import scipy
import yaml
from numpy.typing import NDArray

from thermofuse.compiled import njit
from thermography.common import Array, ThermographyError

# Intrinsic parameters of a lens from a calibration, and the file in which OpenCV writes them.

#: Names that a file may give to the camera matrix and to the coefficients: those of OpenCV's calibration samples, and short ones.
_MATRIX_NAMES = ("camera_matrix", "cameraMatrix", "K")
_COEFFICIENT_NAMES = ("distortion_coefficients", "dist_coeffs", "distCoeffs", "D")
#: Largest relative difference of the focal lengths along columns and rows: the pixels of a sensor are square.
_SQUARE = 0.01
#: A calibration is a page of text, with the views that it was made from a hundred.
_MOST_BYTES = 200_000


class LensError(ThermographyError):
    """A lens file does not hold a calibration that can be used; the message names file, entry and remedy."""


@dataclass(frozen=True)
class Lens:
    """Intrinsic parameters from a lens calibration, in OpenCV's convention.

    Attributes
    ----------
    focal_length_px : px, unit of the normalised image coordinates
    principal_point_px : (column, row), px, centre of the distortion
    distortion : (k1, k2, p1, p2), of the normalised image coordinates
    size_px : (columns, rows) of the frames that the calibration was made with; None where it is not stated
    """

    focal_length_px: float
    principal_point_px: tuple[float, float]
    distortion: tuple[float, float, float, float]
    size_px: tuple[int, int] | None = None


def read_lens(path: str | Path) -> Lens:
    """Read a lens calibration as OpenCV writes it."""
    path = Path(path)
    entries = _read_entries(path)
    matrix = _entry(entries, path, _MATRIX_NAMES, 9).reshape(3, 3)
    coefficients = _entry(entries, path, _COEFFICIENT_NAMES, None)
    size = None
    if {"image_width", "image_height"} <= entries.keys():
        width, height = (_entry(entries, path, (name,), 1)[0] for name in ("image_width", "image_height"))
        if not (1 <= width <= 1e6 and 1 <= height <= 1e6):
            raise LensError(f"{path}: image_width {width:g}, image_height {height:g} px: no frame size; correct them")
        size = (int(width), int(height))
    along, across = float(matrix[0, 0]), float(matrix[1, 1])
    if not (np.isfinite(matrix).all() and min(along, across) > 0 and abs(along / across - 1) < _SQUARE):
        raise LensError(
            f"{path}: camera_matrix has focal lengths {along:g} and {across:g} px; the pixels of a sensor are square: both are positive "
            f"and agree to {_SQUARE:.0%} in a calibration that succeeded"
        )
    if len(coefficients) < 4 or not np.isfinite(coefficients).all() or coefficients[4:].any():
        raise LensError(
            f"{path}: distortion_coefficients = {coefficients.tolist()}; give k1, k2, p1, p2, and calibrate without more (CALIB_FIX_K3)"
        )
    k1, k2, p1, p2 = coefficients[:4].tolist()
    return Lens(float(np.sqrt(along * across)), (float(matrix[0, 2]), float(matrix[1, 2])), (k1, k2, p1, p2), size)


class _MatrixLoader(yaml.CSafeLoader if yaml.__with_libyaml__ else yaml.SafeLoader):  # type: ignore[misc]
    """Builds plain values only; a matrix of OpenCV is a mapping."""


_MatrixLoader.add_constructor(
    "tag:yaml.org,2002:opencv-matrix", lambda loader, node: loader.construct_mapping(node, deep=True)
)


def _read_entries(path: Path) -> dict[str, Any]:
    """Names and values of a file. OpenCV's own parser ends the process on some damaged files."""
    content = path.read_bytes() if path.stat().st_size <= _MOST_BYTES else b""
    if not content or b"\0" in content or b"<!DOCTYPE" in content:
        raise LensError(
            f"{path}: not a calibration: plain text of at most {_MOST_BYTES} bytes is expected; write it as OpenCV's YAML, XML or JSON"
        )
    try:
        text = content.decode().lstrip()
        if text.startswith("<"):
            entries = {child.tag: _plain(child) for child in ElementTree.fromstring(text)}
        elif text.startswith("{"):
            entries = json.loads(text)
        else:
            # OpenCV writes the version of YAML as no other does.
            text = text.removeprefix("%YAML:1.0")
            if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, _MatrixLoader)):
                raise ValueError(
                    "it repeats entries by aliases (*name), which may stand for any number of them; write them out"
                )
            entries = yaml.load(text, _MatrixLoader)
    except (ValueError, TypeError, RecursionError, yaml.YAMLError, ElementTree.ParseError) as error:
        raise LensError(f"{path}: cannot be parsed ({error}); write it as OpenCV's YAML, XML or JSON") from None
    if not isinstance(entries, dict):
        raise LensError(f"{path}: holds no named entries; write the calibration as OpenCV's YAML, XML or JSON")
    return entries


def _plain(element: ElementTree.Element) -> Any:
    """Value of an XML element: a mapping of its children, or the words of its text."""
    if len(element):
        return {child.tag: _plain(child) for child in element}
    return (element.text or "").split()


def _entry(entries: dict[str, Any], path: Path, names: tuple[str, ...], count: int | None) -> Array:
    """The first entry of these names that the file holds, as numbers (n,)."""
    name = next((name for name in names if name in entries), None)
    if name is None:
        raise LensError(f"{path}: no entry {names[0]}; write the calibration as OpenCV's samples do")
    try:
        values = _numbers(entries[name])
    except (TypeError, ValueError) as error:
        raise LensError(f"{path}: {name} is damaged ({error}); write the calibration again") from None
    if count is not None and values.size != count:
        raise LensError(f"{path}: {name} holds {values.size} numbers instead of {count}; write the calibration again")
    return values


def _numbers(value: Any) -> Array:
    """All numbers (n,) of a value: a matrix of OpenCV, lists of lists, or one number."""
    if not isinstance(value, dict):
        return np.array(value, float).ravel()
    rows, columns, numbers = (_numbers(value.get(key, [])) for key in ("rows", "cols", "data"))
    if rows.size != 1 or columns.size != 1 or rows[0] * columns[0] != numbers.size:
        raise ValueError(f"{numbers.size} numbers do not fill its rows and columns")
    return numbers


#: Lens models in ascending order: name, and number of the distortion coefficients (k1, k2, p1, p2) that are fitted.
LENS_MODELS: tuple[tuple[str, int], ...] = (("homography", 0), ("homography+k1", 1), ("homography+k1,k2,p1,p2", 4))
#: A model with more coefficients is chosen only if it lowers the leave-one-out error below this share.
_REQUIRED_GAIN = 0.75
#: Standard deviations of k1, k2, p1, p2 about zero among lenses that are not calibrated, for coordinates divided by the width of the
#: frame. A k1 of 0.2 moves a corner of a 4:3 frame by 8 % of its distance from the centre, as wide-angle thermal lenses do; k2 adds up
#: to half of that there, p1 and p2 of 0.002 about one pixel of 640 at the edge (decentred by some tenths of a degree).
LENS_SPREAD = np.array([0.2, 0.1, 0.002, 0.002])
#: A lens whose k1 is smaller has less of the others, in proportion (a principal point off the middle shows as k1 times its distance, and
#: higher orders go with the first), but not less than this share of their spread: 0.25 px of decentring at the edge.
_LEAST_SHARE = 0.25
#: Fewest discs whose residuals can tell whether k1 is needed; with fewer it is fitted against its spread alone.
_LEAST_FOR_CHOICE = 7
#: Points on the rim of a disc, as unit circle. The centroid of their image polygon shows 98.9 % of the perspective shift of the disc's
#: centroid: the second moment of an inscribed 24-gon over that of its circle, (2 + cos(2 pi / 24)) / 3.
_RIM = np.exp(2j * np.pi * np.arange(24) / 24)
#: Largest number of iterations of the undistortion, and its tolerance in units of the focal length.
_UNDISTORTION_STEPS, _UNDISTORTION_TOLERANCE = 40, 1e-11


@njit(nogil=True, error_model="numpy")
def project_point(x: float, y: float, lens: Array) -> tuple[float, float]:
    """Project one plan point to the sensor; for compiled loops."""
    w = lens[6] * x + lens[7] * y + lens[8]
    u = ((lens[0] * x + lens[1] * y + lens[2]) / w - lens[10]) / lens[9]
    v = ((lens[3] * x + lens[4] * y + lens[5]) / w - lens[11]) / lens[9]
    du, dv = _distort(u, v, lens)
    return lens[10] + lens[9] * du, lens[11] + lens[9] * dv


@njit(nogil=True, error_model="numpy")
def _distort(u: float, v: float, lens: Array) -> tuple[float, float]:
    """Distorted normalised coordinates."""
    r2 = u * u + v * v
    radial = 1 + r2 * (lens[12] + lens[13] * r2)
    return (
        u * radial + 2 * lens[14] * u * v + lens[15] * (r2 + 2 * u * u),
        v * radial + lens[14] * (r2 + 2 * v * v) + 2 * lens[15] * u * v,
    )


@njit(nogil=True, error_model="numpy")
def _project(points: Array, lens: Array) -> Array:
    """Sensor column and row of plan points, (n, 2)."""
    projected = np.empty(points.shape)
    for i in range(len(points)):
        projected[i, 0], projected[i, 1] = project_point(points[i, 0], points[i, 1], lens)
    return projected


@njit(nogil=True, error_model="numpy")
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


@njit(nogil=True, error_model="numpy")
def locate_point(column: float, row: float, lens: Array, sensor_to_plan: Array) -> tuple[float, float]:
    """Locate one sensor point on the plan; for compiled loops."""
    u, v = _undistort_point(column, row, lens)
    m = sensor_to_plan
    w = m[2, 0] * u + m[2, 1] * v + m[2, 2]
    return (m[0, 0] * u + m[0, 1] * v + m[0, 2]) / w, (m[1, 0] * u + m[1, 1] * v + m[1, 2]) / w


@njit(nogil=True, error_model="numpy")
def _undistort(points: Array, lens: Array) -> Array:
    """Sensor points, (n, 2) px, as a lens without distortion would show them."""
    undistorted = np.empty(points.shape)
    for i in range(len(points)):
        undistorted[i, 0], undistorted[i, 1] = _undistort_point(points[i, 0], points[i, 1], lens)
    return undistorted


@njit(nogil=True, error_model="numpy")
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
    """Map from the table plan to the sensor: ``pixel = distort(plan_to_sensor @ plan)``, with k1, k2, p1, p2 of coordinates divided by the
    focal length about the principal point, px; a plane in one position determines k1 / focal_length_px**2 only.
    """

    plan_to_sensor: Array
    distortion: Array
    focal_length_px: float
    principal_point_px: tuple[float, float]

    @classmethod
    def ideal(cls, shape: tuple[int, int]) -> Projection:
        """Projection by a lens without distortion, whose focal length is the width of the frame: only k1 over its square is determined."""
        return cls(np.eye(3), np.zeros(4), float(shape[1]), ((shape[1] - 1) / 2, (shape[0] - 1) / 2))

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

    def px_per_mm(self, points_mm: Array) -> Array:
        """Scale of the image at plan points, (...) px/mm: root of the ratio of areas."""
        return np.sqrt(np.abs(np.linalg.det(self.jacobian(points_mm))))

    def disc_centroids(self, centres_mm: Array, radii_mm: Array) -> Array:
        """Centroids of the images of discs, which perspective shifts from the images of their centres."""
        rim_mm = centres_mm[:, None, :] + radii_mm[:, None, None] * np.stack([_RIM.real, _RIM.imag], axis=-1)
        rim = self.to_sensor(rim_mm)
        origin = rim[:, :1]
        a, b = rim - origin, np.roll(rim, -1, axis=1) - origin
        cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
        moment, area = ((a + b) * cross[..., None]).sum(axis=1), 3 * cross.sum(axis=1)[:, None]
        # A disc of no diameter is a point, and has no perspective shift.
        return origin[:, 0] + np.divide(moment, area, out=np.zeros_like(moment), where=area != 0)


@dataclass(frozen=True)
class DiscObservations:
    """Disc centroids observed on the sensor (n, 2) with the standard uncertainty of either coordinate (n,), px, and the discs on the plan,
    mm.
    """

    points_px: Array
    centres_mm: Array
    radii_mm: Array
    u_px: Array

    def select(self, chosen: NDArray[np.bool_]) -> DiscObservations:
        """The observations that are True in `chosen`, (n,)."""
        return DiscObservations(**{name: values[chosen] for name, values in vars(self).items()})

    def residuals_px(self, projection: Projection) -> Array:
        """Observed minus projected centroids, (n, 2) px."""
        return self.points_px - projection.disc_centroids(self.centres_mm, self.radii_mm)

    def residuals_mm(self, projection: Projection) -> Array:
        """Observed minus listed positions on the plan, (n, 2) mm; the perspective shift of a centroid is no residual."""
        return np.linalg.solve(projection.jacobian(self.centres_mm), self.residuals_px(projection)[..., None])[..., 0]


def fit_homography(observations: DiscObservations, ideal: Projection) -> Projection:
    """Fit a homography to four or more discs behind a given distortion: the start of `fit_projection`."""
    undistorted_px = ideal.undistort(observations.points_px).astype(float)
    matrix, _ = cv2.findHomography(observations.centres_mm.astype(float), undistorted_px, 0)
    if matrix is None or not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-9:
        raise ThermographyError("the fiducials are collinear or coincide; spread at least four over the whole plan")
    return replace(ideal, plan_to_sensor=matrix)


def fit_projection(observations: DiscObservations, start: Projection, coefficients: int) -> Projection:
    """Fit homography and distortion to discs by weighted least squares on the sensor (Levenberg-Marquardt)."""
    centres_mm, u_px = observations.centres_mm, observations.u_px[:, None]
    parametrisation = _Parametrisation.of(start, centres_mm, coefficients)
    # The perspective shift of the centroids hardly changes during the fit and is held fixed.
    shift = start.disc_centroids(centres_mm, observations.radii_mm) - start.to_sensor(centres_mm)
    of_lens = np.eye(8 + coefficients)[8:] / LENS_SPREAD[:coefficients, None]

    def residuals(parameters: Array) -> Array:
        residuals_px = parametrisation.unpack(parameters).to_sensor(centres_mm) + shift - observations.points_px
        return np.concatenate([(residuals_px / u_px).ravel(), of_lens @ parameters])

    def jacobian(parameters: Array) -> Array:
        weighted = parametrisation.jacobian(parameters, centres_mm) / u_px[..., None]
        return np.concatenate([weighted.reshape(-1, parameters.size), of_lens])

    found = scipy.optimize.least_squares(
        residuals, parametrisation.pack(start), jacobian, method="lm", xtol=1e-9, ftol=1e-9
    )
    return parametrisation.unpack(found.x)


@dataclass(frozen=True)
class DiscFit:
    """A projection fitted to discs, with the number of distortion coefficients among its parameters and their spread before any disc."""

    observations: DiscObservations
    projection: Projection
    coefficients: int
    spread: Array = field(default_factory=lambda: LENS_SPREAD)

    def with_unfitted(self, factor: float) -> DiscFit:
        """The fit with all coefficients among its parameters: those that were not fitted are not known to be zero. Against their spread
        they are as large as k1 is, or may be where the discs hardly determine it.
        """
        of_k1 = replace(self, coefficients=max(self.coefficients, 1))
        k1 = np.hypot(self.projection.distortion[0], np.sqrt(of_k1.covariance(factor)[8, 8]))
        share = np.where(np.arange(len(LENS_SPREAD)) < of_k1.coefficients, 1.0, max(k1 / LENS_SPREAD[0], _LEAST_SHARE))
        return replace(self, coefficients=len(LENS_SPREAD), spread=share * LENS_SPREAD)

    def leave_one_out_mm(self) -> Array:
        """Distance by which each disc is missed by the fit to all other discs, (n,) mm; NaN of four, which determine the fit."""
        count = len(self.observations.u_px)
        if 2 * (count - 1) < 8:
            return np.full(count, np.nan)
        missed_px = self.prediction_errors_px()[0][..., None]
        jacobian = self.projection.jacobian(self.observations.centres_mm)
        return np.asarray(np.linalg.norm(np.linalg.solve(jacobian, missed_px)[..., 0], axis=1))

    def prediction_errors_px(self, *, fitted: NDArray[np.bool_] | None = None) -> tuple[Array, Array]:
        """Error by which each disc is missed by a fit that it takes no part in, and the covariance of that error."""
        fitted = np.ones(len(self.observations.u_px), bool) if fitted is None else fitted
        jacobian = self._weighted_jacobian()
        part = jacobian[fitted].reshape(2 * int(fitted.sum()), -1)
        parameters = np.linalg.pinv(part.T @ part + self._prior_information())
        leverage = jacobian @ parameters @ np.swapaxes(jacobian, 1, 2)
        covariances = np.where(fitted[:, None, None], np.eye(2) - leverage, np.eye(2) + leverage)
        errors = self.observations.residuals_px(self.projection)
        covariances[fitted] = np.linalg.inv(covariances[fitted])
        errors[fitted] = (covariances[fitted] @ errors[fitted, :, None])[..., 0]
        return errors, covariances

    def variance_factor(self) -> tuple[float, float]:
        """Reduced chi-square of the residuals, and its degrees of freedom."""
        information = self._information()
        used = float(np.trace(np.linalg.pinv(information + self._prior_information()) @ information))
        freedom = 2 * len(self.observations.u_px) - used
        if freedom < 0.5:
            return 1.0, 0.0
        weighted = self.observations.residuals_px(self.projection) / self.observations.u_px[:, None]
        return max(float((weighted**2).sum()) / freedom, 1.0), freedom

    def covariance(self, factor: float) -> Array:
        """Covariance of the parameters."""
        return np.linalg.pinv(self._information() / factor + self._prior_information())

    def _information(self) -> Array:
        """Products of the weighted derivatives with one another, (parameters, parameters)."""
        jacobian = self._weighted_jacobian().reshape(2 * len(self.observations.u_px), -1)
        return np.asarray(jacobian.T @ jacobian)

    def _prior_information(self) -> Array:
        """Inverse covariance of the parameters before any disc: nothing is known of the homography."""
        return np.diag(np.concatenate([np.zeros(8), self.spread[: self.coefficients] ** -2.0]))

    def _weighted_jacobian(self) -> Array:
        """Derivative of the discs' sensor positions by the parameters over their uncertainty, (n, 2, parameters)."""
        centres_mm = self.observations.centres_mm
        derivative = parameter_jacobian(self.projection, centres_mm, self.coefficients)(centres_mm)
        return derivative / self.observations.u_px[:, None, None]


def select_lens_model(observations: DiscObservations, start: Projection) -> DiscFit:
    """Fit every lens model that the discs determine, and choose the simplest that no richer one clearly improves on."""
    plain = fit_projection(observations, fit_projection(observations, start, 0), 0)
    best, best_error = DiscFit(observations, plain, 0), np.inf
    if len(observations.u_px) < _LEAST_FOR_CHOICE:
        return DiscFit(observations, fit_projection(observations, plain, 1), 1)
    for _, count in LENS_MODELS:
        if count > 0 and 2 * (len(observations.u_px) - 2) < 8 + count:
            break
        fit = DiscFit(observations, fit_projection(observations, best.projection, count), count)
        error = float(np.sqrt(np.mean((fit.leave_one_out_mm() / observations.u_px) ** 2)))
        if error < _REQUIRED_GAIN * best_error:
            best, best_error = fit, error
    return best


def parameter_jacobian(projection: Projection, centres_mm: Array, coefficients: int) -> Callable[[Array], Array]:
    """Derivative of the sensor position by the fitted parameters, as a function of the plan point."""
    parametrisation = _Parametrisation.of(projection, centres_mm, coefficients)
    return partial(parametrisation.jacobian, parametrisation.pack(projection))


@dataclass(frozen=True)
class _Parametrisation:
    """Well-conditioned parameters: eight homography entries between centred unit coordinates (`to_unit` leads to them from the plan,
    `to_pixels` from them to the sensor), then the distortion coefficients that are fitted; the others are those of `start`.
    """

    start: Projection
    to_unit: Array
    to_pixels: Array
    coefficients: int

    @classmethod
    def of(cls, start: Projection, centres_mm: Array, coefficients: int) -> _Parametrisation:
        """Parameters for discs at these places, (n, 2) mm."""
        middle = centres_mm.mean(axis=0)
        scale = float(np.abs(centres_mm - middle).max())
        f, (cx, cy) = start.focal_length_px, start.principal_point_px
        to_unit = np.linalg.inv(np.array([[scale, 0, middle[0]], [0, scale, middle[1]], [0, 0, 1]]))
        return cls(start, to_unit, np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]]), coefficients)

    def pack(self, projection: Projection) -> Array:
        """Parameters of a projection."""
        unit = np.linalg.inv(self.to_pixels) @ projection.plan_to_sensor @ np.linalg.inv(self.to_unit)
        return np.concatenate([(unit / unit[2, 2]).ravel()[:8], projection.distortion[: self.coefficients]])

    def unpack(self, parameters: Array) -> Projection:
        """The projection with these parameters."""
        homography, distortion = self._split(parameters)
        matrix = self.to_pixels @ homography @ self.to_unit
        return replace(self.start, plan_to_sensor=matrix / matrix[2, 2], distortion=distortion)

    def _split(self, parameters: Array) -> tuple[Array, Array]:
        """Homography (3, 3) from unit to normalised coordinates, and distortion (4,)."""
        distortion = np.concatenate([parameters[8:], self.start.distortion[self.coefficients :]])
        return np.append(parameters[:8], 1.0).reshape(3, 3), distortion

    def jacobian(self, parameters: Array, points_mm: Array) -> Array:
        """Derivative of the sensor position by the parameters at plan points (..., 2) mm, (..., 2, parameters), px."""
        homography, (k1, k2, p1, p2) = self._split(parameters)
        unit = np.concatenate([points_mm, np.ones_like(points_mm[..., :1])], axis=-1) @ self.to_unit.T
        mapped = unit @ homography.T
        u, v = mapped[..., 0] / mapped[..., 2], mapped[..., 1] / mapped[..., 2]
        by_row, nothing = unit / mapped[..., 2:], np.zeros_like(unit)
        of_u = np.concatenate([by_row, nothing, -u[..., None] * by_row[..., :2]], axis=-1)
        of_v = np.concatenate([nothing, by_row, -v[..., None] * by_row[..., :2]], axis=-1)
        r2 = u * u + v * v
        radial, steeper = 1 + r2 * (k1 + k2 * r2), 2 * (k1 + 2 * k2 * r2)
        crossed = steeper * u * v + 2 * (p1 * u + p2 * v)
        by_u = np.stack([radial + steeper * u * u + 2 * p1 * v + 6 * p2 * u, crossed], axis=-1)
        by_v = np.stack([crossed, radial + steeper * v * v + 6 * p1 * v + 2 * p2 * u], axis=-1)
        of_lens = np.stack(
            [u * r2, u * r2 * r2, 2 * u * v, r2 + 2 * u * u, v * r2, v * r2 * r2, r2 + 2 * v * v, 2 * u * v], axis=-1
        )
        of_lens = of_lens.reshape(*u.shape, 2, 4)[..., : self.coefficients]
        of_homography = by_u[..., None] * of_u[..., None, :] + by_v[..., None] * of_v[..., None, :]
        return np.asarray(self.start.focal_length_px * np.concatenate([of_homography, of_lens], axis=-1))
