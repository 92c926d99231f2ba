"""Registration of a thermogram to the table plan by disc fiducials, with the uncertainty of every plan position."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from thermography._typing import Array
from thermography.registration.consensus import fit_agreeing
from thermography.registration.discs import LocatedDisc, Spot, detect_discs, locate_disc
from thermography.registration.evidence import (
    RegistrationError,
    area_ratio,
    contradicted_hints,
    refuse_chance,
    refuse_picks,
    refuse_scatter,
    refuse_sizes,
    size_contradiction,
)
from thermography.registration.lens import Lens
from thermography.registration.markers import identify_plan
from thermography.registration.matching import SPOT_U_PX, MatchError, match_by_arrangement, match_by_hints
from thermography.registration.plan import Fiducial, PlanGrid
from thermography.registration.projection import (
    LENS_MODELS,
    LENS_SPREAD,
    DiscObservations,
    Projection,
    leave_one_out_mm,
    parameter_covariance,
    parameter_jacobian,
    prediction_errors_px,
    variance_factor,
)

_MODEL_NAMES = {count: name for name, count in LENS_MODELS}

#: Standard uncertainty of a centroid beyond noise (pixel response, cut of the disc), px; 0.006 px are observed without noise.
_CENTROID_FLOOR_PX = 0.01
#: Standard uncertainty of a point picked by hand, px.
_PICKED_U_PX = 0.5
#: Standard uncertainty, in diameters, with which the others must predict a disc for its place to be checked by them: a place that is
#: wrong by a diameter is then missed by four standard deviations.
_LARGEST_PREDICTION_U = 0.25
#: What serves as diameter of a point, px: a pick that is wrong by that much is noticed.
_POINT_PX = 20.0
#: Scatter of the places above which an assignment by hints is compared with one by arrangement, mm: as good as a calliper.
_PLAIN_SCATTER_MM = 0.3
#: Distance within which a disc is looked for where a first fit to detected spots expects it, px.
_REACH_PX = 5.0


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
        Root mean square of `residual_mm`; NaN where four fiducials determine the plan exactly, which tells nothing.
    scatter_mm, scatter_px : float, mm and px
        Standard deviation of the places along either coordinate, on the plan and on the sensor, from the residuals and their degrees
        of freedom; not below the uncertainty of the centroids.
    area_ratio : float
        Median ratio of the imaged to the listed area of the discs; NaN for points.
    unchecked : tuple of str
        Fiducials whose place the others predict too badly to notice if it were wrong by a disc's diameter; all of four.
    left_out : dict of str to str
        Reason, by name, for every listed fiducial that was not used.
    masked : tuple of Fiducial
        Every fiducial on the table, used or not: their pixels do not show the table's temperature.
    shape : (int, int)
        (rows, columns) of the frames.
    lens : Lens or None
        The calibrated lens that was given.
    covariance : (p, p) ndarray
        Of the homography and of the distortion, p = 8 with a calibrated lens, else 12: coefficients that were not fitted are not
        known to be zero. See `thermography.registration.projection.parameter_covariance`.
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
    scatter_mm: float
    scatter_px: float
    area_ratio: float
    unchecked: tuple[str, ...]
    left_out: dict[str, str]
    masked: tuple[Fiducial, ...]
    shape: tuple[int, int]
    lens: Lens | None
    covariance: Array = field(repr=False)

    @property
    def is_picture(self) -> bool:
        """Whether the picture itself is the plan, with lengths in px: see `thermography.registration.picture`."""
        return not self.fiducials

    @property
    def mirrored(self) -> bool:
        """Whether the plan appears as in a mirror: what turns clockwise on it turns anticlockwise in the frame."""
        if self.is_picture:
            return False
        centre = np.mean([(disc.x_mm, disc.y_mm) for disc in self.fiducials.values()], axis=0)
        return bool(np.linalg.det(self.projection.jacobian(centre)) < 0)

    @property
    def contradicted_hints(self) -> list[str]:
        """Names of the fiducials in use that lie far from their hints."""
        return [name.removesuffix(" (hint)") for name in self.left_out if name.endswith(" (hint)")]

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
        if self.is_picture:
            return np.zeros((*points_mm.shape, 2))
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
        As listed in the plan. Pixel hints may be wrong by 20 px, or missing. Markers serve as hints and are masked. Points are
        taken where they were picked, see `register_points`.
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
        The temperature is neither a frame nor a stack, fewer than four disc fiducials are listed or located, they lie on a line,
        their arrangement is ambiguous or may be chance, or their places contradict one another or their diameters.
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
    if any(fiducial.is_point for fiducial in fiducials):
        return register_points(None, fiducials, _shape(frame), lens=lens)
    listed, left_out = _without_duplicates(identify_plan(frame, fiducials))
    if len(listed) < 4:
        raise RegistrationError(
            f"fiducials lists {len(listed)} different discs; a plan is located by at least 4"
            + (f" ({_reasons(left_out)})" if left_out else "")
        )
    if not use_hints:
        listed = [replace(disc, column_px=None, row_px=None) for disc in listed]
    spots = detect_discs(frame)
    registration = _by_hints_or_arrangement(frame, listed, left_out, spots, grid, lens)
    markers = tuple(fiducial for fiducial in fiducials if fiducial.marker is not None)
    return replace(registration, masked=registration.masked + markers)


def _by_hints_or_arrangement(
    frame: Array,
    listed: list[Fiducial],
    left_out: dict[str, str],
    spots: list[Spot],
    grid: PlanGrid | None,
    lens: Lens | None,
) -> Registration:
    """Register with the discs matched by hints; where these fail or do not agree to a few tenths of a millimetre, by arrangement."""
    found: list[Registration] = []
    refusals: list[str] = []
    matched = match_by_hints(spots, listed)
    if len(matched) >= 4:
        try:
            found.append(_by_spots(frame, listed, left_out, spots, matched, 1, grid, lens))
        except RegistrationError as error:
            refusals.append(str(error))
    # Hints of the mirrored or turned picture lead to a plausible but wrong assignment on a nearly symmetric plan.
    if not found or found[0].scatter_mm > _PLAIN_SCATTER_MM or len(found[0].located) < min(6, len(listed)):
        try:
            arrangement = match_by_arrangement(spots, listed, shape=_shape(frame))
            found.append(
                _by_spots(frame, listed, left_out, spots, arrangement.spots, arrangement.hypotheses, grid, lens)
            )
        except (MatchError, RegistrationError) as error:
            refusals.append(str(error))
    if not found:
        raise RegistrationError(f"the table cannot be located: {size_contradiction(spots, listed) or refusals[0]}")
    return max(found, key=lambda registration: (len(registration.located), -registration.scatter_mm))


def _by_spots(
    frame: Array,
    listed: list[Fiducial],
    left_out: dict[str, str],
    spots: list[Spot],
    matched: dict[str, Spot],
    hypotheses: int,
    grid: PlanGrid | None,
    lens: Lens | None,
) -> Registration:
    """Locate all discs from those that are matched with spots, fit those that agree, and refuse what nothing proves."""
    places = {
        name: LocatedDisc(spot.column_px, spot.row_px, SPOT_U_PX, spot.area_px, spot.contrast_K)
        for name, spot in matched.items()
    }
    located = places
    for _ in range(2):
        discs = [disc for disc in listed if disc.name in located]
        projection, _, _ = _fit(_observations(located, discs), _shape(frame), lens)
        located, missed = locate_fiducials(frame, listed, projection, grid=grid, reach_px=_REACH_PX)
        if len(located) < 4:
            raise RegistrationError(
                f"only {len(located)} of {len(listed)} fiducials are located, a plan needs 4: {_reasons(missed)}"
            )
    apart = {name: place for name, place in places.items() if name not in located}
    registration = _registration(located, listed, left_out | missed, _shape(frame), lens, apart=apart)
    discs = list(registration.fiducials.values())
    missed_mm = np.array([registration.leave_one_out_mm[disc.name] for disc in discs])
    magnification = np.sqrt(np.abs(np.linalg.det(registration.projection.jacobian(_geometry(discs)[0]))))
    refuse_chance(
        registration.located,
        listed,
        spots,
        missed_mm * magnification,
        hypotheses=hypotheses,
        coefficients=0 if lens is not None else dict(LENS_MODELS)[registration.model],
        shape=_shape(frame),
    )
    refuse_sizes(registration.area_ratio, discs)
    refuse_scatter(registration.scatter_mm, registration.leave_one_out_mm, discs)
    return replace(registration, left_out=registration.left_out | contradicted_hints(registration.located, discs))


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
        With a standard uncertainty of 0.5 px for every picked coordinate, or what their scatter says where that is more.

    Raises
    ------
    RegistrationError
        A name is not listed, fewer than four points are given, they lie on a line, or contradict one another.
    """
    listed, left_out = _without_duplicates([fiducial for fiducial in fiducials if fiducial.marker is None])
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
    registration = _registration(located, listed, left_out | missed, shape, lens)
    refuse_picks(registration.scatter_px, registration.leave_one_out_mm)
    return registration


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
        if disc.is_point:
            missed[disc.name] = "is a point without a disc"
            continue
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
    *,
    apart: Mapping[str, LocatedDisc] | None = None,
) -> Registration:
    """Fit the fiducials that agree; leave out the others, with where they are (`apart`: those that were detected but not located)."""
    discs = [disc for disc in listed if disc.name in located]
    observations = _observations(located, discs)
    projection, coefficients, agree = _fit(observations, shape, lens)
    misplaced = dict(apart or {})
    misplaced |= {disc.name: located[disc.name] for disc, agrees in zip(discs, agree, strict=True) if not agrees}
    observed, left_out = _misplaced(misplaced, listed, projection, left_out)
    discs = [disc for disc, agrees in zip(discs, agree, strict=True) if agrees]
    observations = observations.select(agree)
    residual = np.linalg.norm(observations.residuals_mm(projection), axis=1)
    factor, freedom = variance_factor(observations, projection, coefficients)
    unchecked = _unchecked(observations, projection, coefficients, discs, factor)
    factor_u = factor * _student_factor(freedom)
    names = [disc.name for disc in discs]
    leave_one_out = leave_one_out_mm(observations, projection, coefficients)
    magnification = np.sqrt(np.abs(np.linalg.det(projection.jacobian(observations.centres_mm))))
    return Registration(
        homography=np.linalg.inv(projection.plan_to_sensor),
        distortion=projection.distortion,
        model=_MODEL_NAMES[coefficients] if lens is None else "calibrated lens + homography",
        projection=projection,
        fiducials={disc.name: disc for disc in discs},
        located={name: located[name] for name in names},
        residual_mm=dict(zip(names, residual.tolist(), strict=True)),
        leave_one_out_mm=dict(zip(names, leave_one_out.tolist(), strict=True)),
        rms_mm=float(np.sqrt(np.mean(residual**2))) if freedom > 0 else float("nan"),
        scatter_mm=float(np.sqrt(factor) * np.median(observations.u_px / magnification)),
        scatter_px=float(np.sqrt(factor) * np.median(observations.u_px)),
        area_ratio=area_ratio(located, discs, projection),
        unchecked=unchecked,
        left_out=left_out,
        masked=tuple(observed.get(disc.name, disc) for disc in listed),
        shape=shape,
        lens=lens,
        covariance=parameter_covariance(
            _with_places_unchecked(observations, projection, discs, unchecked, factor_u),
            projection,
            len(LENS_SPREAD) if lens is None else 0,
            factor=factor_u,
        ),
    )


def _student_factor(freedom: float) -> float:
    """Square of the half-width of Student's t that holds 68 %: few residuals tell their scatter badly (JCGM 100:2008, annex G)."""
    return float(special.stdtrit(freedom, special.ndtr(1.0))) ** 2 if freedom >= 1.0 else 1.0


def _with_places_unchecked(
    observations: DiscObservations,
    projection: Projection,
    discs: Sequence[Fiducial],
    unchecked: Sequence[str],
    factor: float,
) -> DiscObservations:
    """The observations with what the place of a disc may err by unnoticed: up to its diameter, rectangular (JCGM 100:2008, 4.3.7).

    What is hidden is not part of the scatter, so that the variance factor leaves it as it is.
    """
    px_per_mm = np.sqrt(np.abs(np.linalg.det(projection.jacobian(observations.centres_mm))))
    reach_mm = np.array([disc.diameter_mm if disc.name in unchecked else 0.0 for disc in discs])
    hidden_px = reach_mm * px_per_mm / np.sqrt(3.0 * factor)
    return replace(observations, u_px=np.hypot(observations.u_px, hidden_px))


def _unchecked(
    observations: DiscObservations, projection: Projection, coefficients: int, discs: Sequence[Fiducial], factor: float
) -> tuple[str, ...]:
    """Fiducials whose place the others predict with a standard uncertainty above a quarter of their diameter."""
    if len(discs) == 4:
        return tuple(disc.name for disc in discs)
    _, covariances = prediction_errors_px(observations, projection, coefficients)
    to_mm = np.linalg.inv(projection.jacobian(observations.centres_mm)) * observations.u_px[:, None, None]
    variances = factor * np.trace(to_mm @ covariances @ np.swapaxes(to_mm, 1, 2), axis1=1, axis2=2)
    pixel_mm = np.sqrt(np.abs(np.linalg.det(projection.jacobian(observations.centres_mm)))) ** -1.0
    limits = _LARGEST_PREDICTION_U * np.array(
        [disc.diameter_mm or _POINT_PX * size for disc, size in zip(discs, pixel_mm, strict=True)]
    )
    # Where the others lie on a line, rounding decides the sign of what has no bound.
    return tuple(
        disc.name
        for disc, variance, limit in zip(discs, variances, limits, strict=True)
        if not 0 <= variance <= limit**2
    )


def _misplaced(
    places: Mapping[str, LocatedDisc], listed: Sequence[Fiducial], projection: Projection, left_out: dict[str, str]
) -> tuple[dict[str, Fiducial], dict[str, str]]:
    """Fiducials that lie elsewhere than listed, at the place where they are observed, and the reasons for leaving out with theirs.

    A misplaced disc masks the table where it is observed, not where it is listed.
    """
    observed, left_out = {}, dict(left_out)
    for disc in listed:
        if disc.name in places:
            place = places[disc.name]
            x_mm, y_mm = projection.to_plan(np.array([place.column_px, place.row_px])).tolist()
            observed[disc.name] = replace(disc, x_mm=x_mm, y_mm=y_mm)
            left_out[disc.name] = (
                f"misplaced by {np.hypot(x_mm - disc.x_mm, y_mm - disc.y_mm):.2f} mm against the others, which see it at "
                f"({x_mm:.1f}, {y_mm:.1f}) mm; check its x_mm, y_mm, and that nothing covers a part of it"
            )
    return observed, left_out


def _fit(
    observations: DiscObservations, shape: tuple[int, int], lens: Lens | None
) -> tuple[Projection, int, NDArray[np.bool_]]:
    """Projection fitted to the discs that agree, its number of distortion coefficients, and which discs agree."""
    if lens is not None:
        if lens.size_px is not None and lens.size_px != shape[::-1]:
            raise RegistrationError(
                "the lens was calibrated with frames of {} x {} pixels, these have {} x {}; calibrate with frames of this size".format(
                    *lens.size_px, *shape[::-1]
                )
            )
        ideal = Projection(np.eye(3), np.array(lens.distortion), lens.focal_length_px, lens.principal_point_px)
    else:
        # Only k1 over the squared focal length is determined: the frame's width serves as focal length, its middle as centre.
        ideal = Projection(np.eye(3), np.zeros(4), float(shape[1]), ((shape[1] - 1) / 2, (shape[0] - 1) / 2))
    try:
        return fit_agreeing(observations, ideal, calibrated=lens is not None)
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
                or np.hypot(disc.x_mm - other.x_mm, disc.y_mm - other.y_mm) <= disc.diameter_mm / 2
            ):
                again = disc.name if disc.name != other.name else f"{disc.name} (second)"
                left_out[again] = (
                    f"listed twice: ({disc.x_mm:g}, {disc.y_mm:g}) mm beside {other.name} ({other.x_mm:g}, {other.y_mm:g}) mm"
                )
                break
        else:
            kept.append(disc)
    return kept, left_out


def _geometry(fiducials: Sequence[Fiducial]) -> tuple[Array, Array]:
    """Centres (n, 2) and radii (n,), mm."""
    centres = np.array([(disc.x_mm, disc.y_mm) for disc in fiducials], float)
    return centres, np.array([disc.diameter_mm / 2 for disc in fiducials])


def _shape(frame: NDArray[np.floating]) -> tuple[int, int]:
    return frame.shape[0], frame.shape[1]


def _reasons(missed: dict[str, str]) -> str:
    return "; ".join(f"{name} {reason}" for name, reason in missed.items())
