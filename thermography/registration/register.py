"""Registration of a thermogram to the table plan by disc fiducials, with the uncertainty of every plan position."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from thermography._typing import Array
from thermography.errors import ThermographyError
from thermography.registration.discs import LocatedDisc, detect_discs, locate_disc
from thermography.registration.markers import identify_plan
from thermography.registration.matching import MatchError, match_by_arrangement, match_by_hints
from thermography.registration.plan import Fiducial, PlanGrid
from thermography.registration.projection import (
    LENS_MODELS,
    DiscObservations,
    Projection,
    fit_homography,
    fit_projection,
    leave_one_out_mm,
    parameter_covariance,
    parameter_jacobian,
    select_lens_model,
)

_MODEL_NAMES = {count: name for name, count in LENS_MODELS}

#: Standard uncertainty of a centroid beyond noise (pixel response, cut of the disc), px; 0.006 px are observed without noise.
_CENTROID_FLOOR_PX = 0.01
#: Standard uncertainty of a point picked by hand, px.
_PICKED_U_PX = 0.5
#: Standard uncertainty of the centroid of a detected spot, before the disc is located, px.
_SPOT_U_PX = 0.2
#: A fiducial missed by more than this, and by five times the median of the others, is left out as misplaced, mm.
_MISPLACED_MM = 1.0
#: A hint farther than this from the located disc is reported, px.
_WRONG_HINT_PX = 25


class RegistrationError(ThermographyError):
    """The table cannot be located in the frame; the message says which fiducials were located and what to do."""


@dataclass(frozen=True)
class Lens:
    """Intrinsic parameters from a lens calibration, in OpenCV's convention.

    Attributes
    ----------
    focal_length_px : float, px
        Unit of the normalised image coordinates.
    principal_point_px : (column, row), px
        Centre of the distortion.
    distortion : (k1, k2, p1, p2)
        Of the normalised image coordinates.
    """

    focal_length_px: float
    principal_point_px: tuple[float, float]
    distortion: tuple[float, float, float, float]


@dataclass(frozen=True)
class Registration:
    """Position of every pixel on the table plan.

    Attributes
    ----------
    homography : (3, 3) ndarray
        From undistorted sensor px (column, row) to plan mm (x, y).
    distortion : (4,) ndarray
        (k1, k2, p1, p2) of image coordinates divided by the projection's focal length; zeros without distortion.
    model : str
        Name of the lens model, see `thermography.registration.projection.LENS_MODELS`.
    projection : Projection
        Plan to sensor.
    fiducials : dict of str to Fiducial
        Fiducials used, by name, as listed in the plan.
    located : dict of str to LocatedDisc
        Their centroids on the sensor with contrast and uncertainty.
    residual_mm, leave_one_out_mm : dict of str to float, mm
        Registration residual: distance on the plan between the observed and the listed position of each fiducial, with the
        fiducial in the fit and without it (NaN where the others do not determine the fit).
    rms_mm : float, mm
        Root mean square of `residual_mm`.
    left_out : dict of str to str
        Reason, by name, for every listed fiducial that was not used.
    masked : tuple of Fiducial
        Every fiducial on the table, used or not: their pixels do not show the table's temperature.
    shape : (int, int)
        (rows, columns) of the frames.
    covariance : (p, p) ndarray
        Of the fitted parameters, p = 8 + number of distortion coefficients, see
        `thermography.registration.projection.parameter_covariance`.
    """

    homography: Array
    distortion: Array
    model: str
    projection: Projection
    fiducials: dict[str, Fiducial]
    located: dict[str, LocatedDisc]
    residual_mm: dict[str, float]
    leave_one_out_mm: dict[str, float]
    rms_mm: float
    left_out: dict[str, str]
    masked: tuple[Fiducial, ...]
    shape: tuple[int, int]
    covariance: Array = field(repr=False)

    def to_plan(self, points_px: Array) -> Array:
        """Locate sensor points, shape (..., 2) px (column, row), on the plan, shape (..., 2) mm (x, y)."""
        return self.projection.to_plan(np.asarray(points_px, float))

    def to_sensor(self, points_mm: Array) -> Array:
        """Project plan points, shape (..., 2) mm (x, y), to the sensor, shape (..., 2) px (column, row)."""
        return self.projection.to_sensor(np.asarray(points_mm, float))

    def position_covariance(self, points_mm: Array) -> Array:
        """Covariance of the plan positions that the registration assigns.

        Parameters
        ----------
        points_mm : (..., 2) ndarray, mm
            Plan points (x, y).

        Returns
        -------
        (..., 2, 2) ndarray, mm2
            The covariance of the fitted parameters propagated to the plan (law of propagation, JCGM 100:2008, 5.2.2).
        """
        points_mm = np.asarray(points_mm, float)
        flat = points_mm.reshape(-1, 2)
        centres, _ = _geometry(list(self.fiducials.values()))
        sensor = parameter_jacobian(self.projection, centres, len(self.covariance) - 8)(flat)
        # The 2 x 2 inverse in closed form: a solver called for every cell takes ten times as long.
        (a, b), (c, d) = np.moveaxis(self.projection.jacobian(flat), 0, -1)
        inverse = np.moveaxis(np.array([[d, -b], [-c, a]]) / (a * d - b * c), -1, 0)
        plan = np.ascontiguousarray(inverse) @ sensor
        covariance: Array = (plan @ self.covariance @ np.swapaxes(plan, 1, 2)).reshape(*points_mm.shape[:-1], 2, 2)
        return covariance

    def position_u(self, points_mm: Array) -> Array:
        """Standard uncertainty of plan positions, (...) mm, for points (..., 2) mm: root of the summed variances along x and y."""
        u: Array = np.sqrt(np.trace(self.position_covariance(points_mm), axis1=-2, axis2=-1))
        return u


def register(
    temperature: NDArray[np.floating],
    fiducials: Sequence[Fiducial],
    *,
    grid: PlanGrid | None = None,
    lens: Lens | None = None,
    use_hints: bool = True,
) -> Registration:
    """Register a thermogram to the table plan by the disc fiducials that it shows.

    Parameters
    ----------
    temperature : (row, column) or (time, row, column) ndarray, degC
        One frame, or a stack, of which the mean is used: averaging raises the contrast of discs above the noise.
    fiducials : sequence of Fiducial
        As listed in the plan. Pixel hints may be wrong by 20 px, or missing. Markers serve as hints and are masked.
    grid : PlanGrid or None
        The plan, whose edge bounds the table; None takes all discs to lie far from any edge.
    lens : Lens or None
        Intrinsic parameters from a calibration; None fits the distortion as far as the fiducials determine it.
    use_hints : bool
        False ignores the pixel hints.

    Returns
    -------
    Registration
        With every fiducial either in `located` or, with the reason, in `left_out`.

    Raises
    ------
    RegistrationError
        The temperature is neither a frame nor a stack, fewer than four disc fiducials are listed or located, they lie on a line, or
        their arrangement is ambiguous.
    MarkerError
        The markers in view are those of another plan.

    Notes
    -----
    Planar calibration after Z. Zhang, A flexible new technique for camera calibration, IEEE Trans. PAMI 22 (2000) 1330-1334, with
    the lens model chosen by leave-one-out error; see ``docs/method/registration.md``.

    Examples
    --------
    Seven cold discs of 12 mm on a plan of 200 mm x 100 mm, imaged at 2 px/mm:

    >>> places = [(20, 20), (100, 15), (180, 25), (25, 80), (110, 85), (180, 78), (60, 50)]
    >>> row, column = np.mgrid[0:200, 0:400]
    >>> frame = np.full((200, 400), 22.0)
    >>> for x, y in places:
    ...     frame[np.hypot(column - 2 * x, row - 2 * y) < 12] = 18.0
    >>> fiducials = [Fiducial(f"F{i}", x, y, 12.0) for i, (x, y) in enumerate(places)]
    >>> registration = register(frame, fiducials, grid=PlanGrid(200, 100, 5))
    >>> registration.model, [round(float(mm)) for mm in registration.to_plan(np.array([200, 100]))]
    ('homography', [100, 50])
    """
    frame = np.asarray(temperature, float)
    if frame.ndim not in (2, 3) or frame.size == 0:
        raise RegistrationError(
            f"temperature has shape {frame.shape}; give one frame (row, column) or a stack (time, row, column)"
        )
    frame = frame.mean(axis=0) if frame.ndim == 3 else frame
    listed, left_out = _without_duplicates(identify_plan(frame, fiducials))
    if len(listed) < 4:
        raise RegistrationError(
            f"fiducials lists {len(listed)} different discs; a plan is located by at least 4"
            + (f" ({_reasons(left_out)})" if left_out else "")
        )
    if not use_hints:
        listed = [replace(disc, column_px=None, row_px=None) for disc in listed]
    spots = detect_discs(frame)
    matched = match_by_hints(spots, listed)
    if len(matched) < min(6, len(listed)):
        try:
            matched = max(matched, match_by_arrangement(spots, listed, shape=_shape(frame)), key=len)
        except MatchError as error:
            if len(matched) < 4:
                raise RegistrationError(f"the table cannot be located: {error}") from error
    discs = [disc for disc in listed if disc.name in matched]
    spot_positions = {
        name: LocatedDisc(spot.column_px, spot.row_px, _SPOT_U_PX, np.nan, np.nan) for name, spot in matched.items()
    }
    projection, _ = _fit(_observations(spot_positions, discs), _shape(frame), lens)
    for _ in range(2):
        located, missed = locate_fiducials(frame, listed, projection, grid=grid, reach_px=5.0)
        if len(located) < 4:
            raise RegistrationError(
                f"only {len(located)} of {len(listed)} fiducials are located, a plan needs 4: {_reasons(missed)}"
            )
        discs = [disc for disc in listed if disc.name in located]
        projection, _ = _fit(_observations(located, discs), _shape(frame), lens)
    registration = _registration(located, listed, left_out | missed | _wrong_hints(located, discs), _shape(frame), lens)
    markers = tuple(fiducial for fiducial in fiducials if fiducial.marker is not None)
    return replace(registration, masked=registration.masked + markers)


def register_points(
    points_px: Mapping[str, tuple[float, float]] | None,
    fiducials: Sequence[Fiducial],
    shape: tuple[int, int],
    *,
    lens: Lens | None = None,
) -> Registration:
    """Register by points picked by hand instead of discs located in a frame.

    Parameters
    ----------
    points_px : mapping of str to (column, row), px, or None
        Centres of the discs by fiducial name; None takes the pixel hints of the fiducials as picked.
    fiducials : sequence of Fiducial
        As listed in the plan.
    shape : (int, int)
        (rows, columns) of the frames.
    lens : Lens or None
        Intrinsic parameters from a calibration; None fits the distortion as far as the points determine it.

    Returns
    -------
    Registration
        With a standard uncertainty of 0.5 px for every picked coordinate.

    Raises
    ------
    RegistrationError
        A name is not listed, fewer than four points are given, or they lie on a line.
    """
    listed, left_out = _without_duplicates(fiducials)
    if points_px is None:
        points_px = {disc.name: disc.hint_px for disc in listed if disc.hint_px is not None}
    unknown = sorted(set(points_px) - {disc.name for disc in listed})
    if unknown:
        raise RegistrationError(
            f"picked points {', '.join(unknown)} are not in the list of fiducials; use the names of its first column"
        )
    discs = [disc for disc in listed if disc.name in points_px]
    if len(discs) < 4:
        raise RegistrationError(f"{len(discs)} points are picked; a plan needs at least 4")
    located = {disc.name: LocatedDisc(*points_px[disc.name], _PICKED_U_PX, np.nan, np.nan) for disc in discs}
    missed = {disc.name: "was not picked" for disc in listed if disc.name not in points_px}
    return _registration(located, listed, left_out | missed, shape, lens)


def locate_fiducials(
    temperature: NDArray[np.floating],
    fiducials: Sequence[Fiducial],
    projection: Projection,
    *,
    grid: PlanGrid | None = None,
    reach_px: float = 3.0,
) -> tuple[dict[str, LocatedDisc], dict[str, str]]:
    """Locate every fiducial near its projection.

    Parameters
    ----------
    temperature : (row, column) ndarray, degC
        One frame.
    fiducials : sequence of Fiducial
        Discs of the plan.
    projection : Projection
        Predicts where they are.
    grid : PlanGrid or None
        The plan, whose edge bounds the table; None takes all discs to lie far from any edge.
    reach_px : float, px
        Largest distance from the prediction.

    Returns
    -------
    located : dict of str to LocatedDisc
        By fiducial name.
    missed : dict of str to str
        The reason for every fiducial that was not located, by name.
    """
    # Without a plan, the discs are moved to the middle of one of a square kilometre.
    bounds = grid or PlanGrid(1e6, 1e6, 1e6)
    shift = np.zeros(2) if grid else np.array([5e5, 5e5])
    centres, radii = _geometry(fiducials)
    predicted, jacobians = projection.disc_centroids(centres, radii), projection.jacobian(centres)
    located: dict[str, LocatedDisc] = {}
    missed: dict[str, str] = {}
    for disc, place, jacobian in zip(fiducials, predicted, jacobians, strict=True):
        moved = replace(disc, x_mm=disc.x_mm + shift[0], y_mm=disc.y_mm + shift[1])
        result = locate_disc(temperature, moved, bounds, place, jacobian, reach_px=reach_px)
        if isinstance(result, str):
            missed[disc.name] = result
        else:
            located[disc.name] = result
    return located, missed


def _registration(
    located: dict[str, LocatedDisc],
    listed: list[Fiducial],
    left_out: dict[str, str],
    shape: tuple[int, int],
    lens: Lens | None,
) -> Registration:
    """Choose the lens model, leave out misplaced fiducials one by one, and evaluate residuals and covariance."""
    located, left_out = dict(located), dict(left_out)
    discs = [disc for disc in listed if disc.name in located]
    misplaced: dict[str, tuple[Fiducial, LocatedDisc]] = {}
    while True:
        observations = _observations(located, discs)
        projection, coefficients = _fit(observations, shape, lens)
        leave_one_out = leave_one_out_mm(observations, projection, coefficients)
        worst = _misplaced(leave_one_out, observations, projection)
        if worst is None:
            break
        disc = discs.pop(worst)
        left_out[disc.name] = f"misplaced by {leave_one_out[worst]:.2f} mm against the others; check its x_mm, y_mm"
        misplaced[disc.name] = (disc, located.pop(disc.name))
    # A misplaced disc masks the table where it is observed, not where it is listed.
    observed = {}
    for name, (disc, place) in misplaced.items():
        x_mm, y_mm = projection.to_plan(np.array([place.column_px, place.row_px]))
        observed[name] = replace(disc, x_mm=float(x_mm), y_mm=float(y_mm))
    residual = np.linalg.norm(observations.residuals_mm(projection), axis=1)
    names = [disc.name for disc in discs]
    return Registration(
        homography=np.linalg.inv(projection.plan_to_sensor),
        distortion=projection.distortion,
        model=_MODEL_NAMES[coefficients] if lens is None else "calibrated lens + homography",
        projection=projection,
        fiducials={disc.name: disc for disc in discs},
        located=located,
        residual_mm=dict(zip(names, residual.tolist(), strict=True)),
        leave_one_out_mm=dict(zip(names, leave_one_out.tolist(), strict=True)),
        rms_mm=float(np.sqrt(np.mean(residual**2))),
        left_out=left_out,
        masked=tuple(observed.get(disc.name, disc) for disc in listed),
        shape=shape,
        covariance=parameter_covariance(observations, projection, coefficients),
    )


def _misplaced(leave_one_out: Array, observations: DiscObservations, projection: Projection) -> int | None:
    """Index of the fiducial whose error exceeds its own uncertainty and the errors of the others by far; None if there is none."""
    if len(leave_one_out) < 6 or not np.isfinite(leave_one_out).all():
        return None
    worst = int(np.argmax(leave_one_out))
    magnification = float(np.sqrt(abs(np.linalg.det(projection.jacobian(observations.centres_mm[worst])))))
    u_mm = observations.u_px[worst] / magnification
    limit = max(_MISPLACED_MM, 5 * float(np.median(np.delete(leave_one_out, worst))), 5 * u_mm)
    return worst if leave_one_out[worst] > limit else None


def _fit(observations: DiscObservations, shape: tuple[int, int], lens: Lens | None) -> tuple[Projection, int]:
    """Projection and its number of fitted distortion coefficients."""
    try:
        if lens is not None:
            ideal = Projection(np.eye(3), np.array(lens.distortion), lens.focal_length_px, lens.principal_point_px)
            return fit_projection(observations, fit_homography(observations, ideal), 0), 0
        # Only k1 over the squared focal length is determined: the frame's width serves as focal length, its middle as centre.
        ideal = Projection(np.eye(3), np.zeros(4), float(shape[1]), ((shape[1] - 1) / 2, (shape[0] - 1) / 2))
        return select_lens_model(observations, fit_homography(observations, ideal))
    except ValueError as error:
        raise RegistrationError(str(error)) from error


def _observations(located: dict[str, LocatedDisc], fiducials: Sequence[Fiducial]) -> DiscObservations:
    places = [located[disc.name] for disc in fiducials]
    u_px = np.hypot([place.u_px for place in places], _CENTROID_FLOOR_PX)
    points_px = np.array([(place.column_px, place.row_px) for place in places])
    return DiscObservations(points_px, *_geometry(fiducials), u_px)


def _without_duplicates(fiducials: Sequence[Fiducial]) -> tuple[list[Fiducial], dict[str, str]]:
    """The first of fiducials that share a name or a position, and the reason by name for leaving out the others."""
    kept: list[Fiducial] = []
    left_out: dict[str, str] = {}
    for disc in fiducials:
        for other in kept:
            if (
                disc.name == other.name
                or np.hypot(disc.x_mm - other.x_mm, disc.y_mm - other.y_mm) < disc.diameter_mm / 2
            ):
                again = disc.name if disc.name != other.name else f"{disc.name} (second)"
                left_out[again] = (
                    f"listed twice: ({disc.x_mm:g}, {disc.y_mm:g}) mm beside {other.name} ({other.x_mm:g}, {other.y_mm:g}) mm"
                )
                break
        else:
            kept.append(disc)
    return kept, left_out


def _wrong_hints(located: dict[str, LocatedDisc], fiducials: Sequence[Fiducial]) -> dict[str, str]:
    """Hints far from their fiducial, by a key that says that only the hint is left out: the fiducial itself is used."""
    wrong = {}
    for disc in fiducials:
        if disc.hint_px is not None:
            place = located[disc.name]
            distance = np.hypot(disc.hint_px[0] - place.column_px, disc.hint_px[1] - place.row_px)
            if distance > _WRONG_HINT_PX:
                wrong[f"{disc.name} (hint)"] = (
                    f"the hint ({disc.hint_px[0]:g}, {disc.hint_px[1]:g}) px is {distance:.0f} px from the disc; it was not used"
                )
    return wrong


def _geometry(fiducials: Sequence[Fiducial]) -> tuple[Array, Array]:
    """Centres (n, 2) and radii (n,), mm."""
    centres = np.array([(disc.x_mm, disc.y_mm) for disc in fiducials], float)
    return centres, np.array([disc.diameter_mm / 2 for disc in fiducials])


def _shape(frame: NDArray[np.floating]) -> tuple[int, int]:
    return frame.shape[0], frame.shape[1]


def _reasons(missed: dict[str, str]) -> str:
    return "; ".join(f"{name} {reason}" for name, reason in missed.items())
