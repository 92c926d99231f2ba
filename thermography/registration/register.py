"""Sensor to table plan: disc fiducials located, a lens model chosen by leave-one-out error, its uncertainty in mm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from thermography._typing import Array
from thermography.errors import ThermographyError
from thermography.registration.discs import LocatedDisc, detect_discs, locate_disc
from thermography.registration.markers import identify
from thermography.registration.matching import MatchError, match_by_arrangement, match_by_hints
from thermography.registration.plan import Fiducial, FiducialError, PlanGrid, mask_discs, read_fiducials
from thermography.registration.projection import (
    LADDER,
    Projection,
    Sightings,
    climb_ladder,
    fit_homography,
    fit_projection,
    leave_one_out,
    parameter_covariance,
    parameter_jacobian,
)

__all__ = [
    "Fiducial",
    "FiducialError",
    "Lens",
    "PlanGrid",
    "Registration",
    "RegistrationError",
    "locate_fiducials",
    "mask_discs",
    "read_fiducials",
    "register",
    "register_points",
]

MODEL_NAMES = {count: name for name, count in LADDER}

#: What a centroid errs by beyond its noise (pixel response, cut of the disc), px; conservative against 0.006 px seen without noise.
CENTROID_FLOOR_PX = 0.01
#: What a point picked by hand errs by, px.
PICKED_U_PX = 0.5
#: A fiducial off by more than this, and by five times the median of the others, is left out as misplaced.
MISPLACED_MM = 1.0


class RegistrationError(ThermographyError):
    """The table cannot be located in the image; the message says which fiducials were found and what to do."""


@dataclass(frozen=True)
class Lens:
    """Intrinsics from a calibration: unit and centre of the distortion, and (k1, k2, p1, p2) in OpenCV's convention."""

    focal_length_px: float
    principal_point_px: tuple[float, float]
    distortion: tuple[float, float, float, float]


@dataclass(frozen=True)
class Registration:
    """Where every pixel lies on the table plan.

    Attributes
    ----------
    homography
        (3, 3), undistorted sensor px (column, row) to plan mm.
    distortion
        (k1, k2, p1, p2) for image coordinates divided by the projection's focal length; zeros without distortion.
    model
        Name of the rung of the ladder.
    fiducials
        Fiducials used, by name, as listed in the plan.
    located
        Their centroids on the sensor with contrast and uncertainty.
    residual_mm, leave_one_out_mm
        Distance on the plan between each located fiducial and its listed place, with it in the fit, and without it.
    rms_mm
        Root mean square of `residual_mm`.
    left_out
        Reason by name for every listed fiducial that was not used.
    masked
        Every disc that lies on the table, used or not: their pixels do not show the table's temperature.
    shape
        (rows, columns) of the frames.
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
        """Covariance in mm2, shape (..., 2, 2), of where the registration puts plan points, shape (..., 2) mm.

        From the fit's parameter covariance, scaled by the residuals of the fiducials (GUM 5.2.2).
        """
        points_mm = np.asarray(points_mm, float)
        flat = points_mm.reshape(-1, 2)
        centres, _ = _geometry(list(self.fiducials.values()))
        sensor = parameter_jacobian(self.projection, centres, len(self.covariance) - 8)(flat)
        # Inverted by hand: a solver called for every cell takes ten times as long.
        (a, b), (c, d) = np.moveaxis(self.projection.jacobian(flat), 0, -1)
        inverse = np.moveaxis(np.array([[d, -b], [-c, a]]) / (a * d - b * c), -1, 0)
        plan = np.ascontiguousarray(inverse) @ sensor
        covariance: Array = (plan @ self.covariance @ np.swapaxes(plan, 1, 2)).reshape(*points_mm.shape[:-1], 2, 2)
        return covariance

    def position_u(self, points_mm: Array) -> Array:
        """Standard uncertainty in mm, shape (...), of a plan point's position: root of the summed variances along x and y."""
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
    """Register a frame to the table plan by the disc fiducials that it shows.

    Parameters
    ----------
    temperature
        One frame (row, column) in degC, or a stack (time, row, column), whose mean is used: averaging lifts discs whose contrast is low.
    fiducials
        As listed in the plan; pixel hints may be wrong by 20 px, or missing. Markers among them serve as hints and are masked.
    grid
        The plan, whose edge bounds the table; without it the discs are taken to lie far from any edge.
    lens
        Intrinsics from a calibration; without them the distortion is fitted as far as the fiducials determine it.
    use_hints
        False ignores the pixel hints.

    Returns
    -------
    Registration
        With every fiducial either in `located` or, with the reason, in `left_out`.

    Raises
    ------
    RegistrationError
        Fewer than four fiducials are found, they lie on a line, or their arrangement is ambiguous.
    MarkerError
        The markers in view are those of another plan.
    """
    frame = np.asarray(temperature, float)
    frame = frame.mean(axis=0) if frame.ndim == 3 else frame
    listed, left_out = _without_duplicates(identify(frame, fiducials))
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
    known = [disc for disc in listed if disc.name in matched]
    rough = {
        disc.name: LocatedDisc(matched[disc.name].column_px, matched[disc.name].row_px, 0.2, np.nan, np.nan)
        for disc in known
    }
    projection, _ = _fit(_sightings(rough, known), _shape(frame), lens)
    for _ in range(2):
        located, missed = locate_fiducials(frame, listed, projection, grid=grid, reach_px=5.0)
        if len(located) < 4:
            raise RegistrationError(
                f"only {len(located)} of {len(listed)} fiducials are located, a plan needs 4: {_reasons(missed)}"
            )
        known = [disc for disc in listed if disc.name in located]
        projection, _ = _fit(_sightings(located, known), _shape(frame), lens)
    registration = _registration(located, listed, left_out | missed | _wrong_hints(located, known), _shape(frame), lens)
    return replace(registration, masked=(*registration.masked, *(one for one in fiducials if one.marker is not None)))


def register_points(
    points_px: Mapping[str, tuple[float, float]] | None,
    fiducials: Sequence[Fiducial],
    shape: tuple[int, int],
    *,
    lens: Lens | None = None,
) -> Registration:
    """Register by points picked by hand in place of discs found in the image.

    Parameters
    ----------
    points_px
        (column, row) px by fiducial name; None takes the pixel positions of the fiducial file as picked.
    fiducials
        As listed in the plan.
    shape
        (rows, columns) of the frames.
    lens
        Intrinsics from a calibration.

    Raises
    ------
    RegistrationError
        A name is not listed, or fewer than four points are given.
    """
    listed, left_out = _without_duplicates(fiducials)
    if points_px is None:
        points_px = {disc.name: disc.hint_px for disc in listed if disc.hint_px is not None}
    unknown = sorted(set(points_px) - {disc.name for disc in listed})
    if unknown:
        raise RegistrationError(
            f"picked points {', '.join(unknown)} are not in the list of fiducials; use the names of its first column"
        )
    known = [disc for disc in listed if disc.name in points_px]
    if len(known) < 4:
        raise RegistrationError(f"{len(known)} points are picked; a plan needs at least 4")
    located = {disc.name: LocatedDisc(*points_px[disc.name], PICKED_U_PX, np.nan, np.nan) for disc in known}
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
    """Locate every fiducial near where a projection puts it; return those located, and for the others the reason, by name."""
    bounds = grid or PlanGrid(1e6, 1e6, 1e6)
    shift = np.zeros(2) if grid else np.array([5e5, 5e5])
    centres, radii = _geometry(fiducials)
    predicted, jacobians = projection.disc_centroids(centres, radii), projection.jacobian(centres)
    located: dict[str, LocatedDisc] = {}
    missed: dict[str, str] = {}
    for disc, place, jacobian in zip(fiducials, predicted, jacobians, strict=True):
        moved = replace(disc, x_mm=disc.x_mm + shift[0], y_mm=disc.y_mm + shift[1])
        found = locate_disc(temperature, moved, bounds, place, jacobian, reach_px=reach_px)
        if isinstance(found, str):
            missed[disc.name] = found
        else:
            located[disc.name] = found
    return located, missed


def _registration(
    located: dict[str, LocatedDisc],
    listed: list[Fiducial],
    left_out: dict[str, str],
    shape: tuple[int, int],
    lens: Lens | None,
) -> Registration:
    """Choose the model, leave out misplaced fiducials one by one, and gather the figures."""
    left_out = dict(left_out)
    known = [disc for disc in listed if disc.name in located]
    misplaced: dict[str, tuple[Fiducial, LocatedDisc]] = {}
    while True:
        seen = _sightings(located, known)
        projection, coefficients = _fit(seen, shape, lens)
        loo = leave_one_out(seen, projection, coefficients)
        worst = _misplaced(loo, seen, projection)
        if worst is None:
            break
        left_out[known[worst].name] = f"misplaced by {loo[worst]:.2f} mm against the others; check its x_mm, y_mm"
        disc = known.pop(worst)
        misplaced[disc.name] = (disc, located.pop(disc.name))
    # A misplaced disc hides the table where it is seen, not where it is listed.
    moved = {}
    for name, (disc, found) in misplaced.items():
        x_mm, y_mm = projection.to_plan(np.array([found.column_px, found.row_px]))
        moved[name] = replace(disc, x_mm=float(x_mm), y_mm=float(y_mm))
    residual = np.linalg.norm(seen.plan_error(projection), axis=1)
    names = [disc.name for disc in known]
    return Registration(
        homography=np.linalg.inv(projection.plan_to_sensor),
        distortion=projection.distortion,
        model=MODEL_NAMES[coefficients] if lens is None else "calibrated lens + homography",
        projection=projection,
        fiducials={disc.name: disc for disc in known},
        located=located,
        residual_mm=dict(zip(names, residual.tolist(), strict=True)),
        leave_one_out_mm=dict(zip(names, loo.tolist(), strict=True)),
        rms_mm=float(np.sqrt(np.mean(residual**2))),
        left_out=left_out,
        masked=tuple(moved.get(disc.name, disc) for disc in listed),
        shape=shape,
        covariance=parameter_covariance(seen, projection, coefficients),
    )


def _misplaced(loo: Array, seen: Sightings, projection: Projection) -> int | None:
    """Index of the fiducial that its own uncertainty and the others' errors cannot account for, if there is one."""
    if len(loo) < 6 or not np.isfinite(loo).all():
        return None
    worst = int(np.argmax(loo))
    u_mm = seen.u_px[worst] / float(np.sqrt(abs(np.linalg.det(projection.jacobian(seen.centres_mm[worst])))))
    limit = max(MISPLACED_MM, 5 * float(np.median(np.delete(loo, worst))), 5 * u_mm)
    return worst if loo[worst] > limit else None


def _fit(seen: Sightings, shape: tuple[int, int], lens: Lens | None) -> tuple[Projection, int]:
    try:
        if lens is not None:
            ideal = Projection(np.eye(3), np.array(lens.distortion), lens.focal_length_px, lens.principal_point_px)
            return fit_projection(seen, fit_homography(seen, ideal), 0), 0
        ideal = Projection(np.eye(3), np.zeros(4), float(shape[1]), ((shape[1] - 1) / 2, (shape[0] - 1) / 2))
        return climb_ladder(seen, fit_homography(seen, ideal))
    except ValueError as error:
        raise RegistrationError(str(error)) from error


def _sightings(located: dict[str, LocatedDisc], known: Sequence[Fiducial]) -> Sightings:
    discs = [located[disc.name] for disc in known]
    u_px = np.hypot([disc.u_px for disc in discs], CENTROID_FLOOR_PX)
    return Sightings(np.array([(disc.column_px, disc.row_px) for disc in discs]), *_geometry(known), u_px)


def _without_duplicates(fiducials: Sequence[Fiducial]) -> tuple[list[Fiducial], dict[str, str]]:
    """Keep the first of fiducials that share a name or a place; name the others."""
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


def _wrong_hints(located: dict[str, LocatedDisc], known: Sequence[Fiducial]) -> dict[str, str]:
    """Hints far from where their fiducial was found; the fiducial itself is used, so its key says that only the hint is left out."""
    wrong = {}
    for disc in known:
        if disc.hint_px is not None:
            found = located[disc.name]
            distance = np.hypot(disc.hint_px[0] - found.column_px, disc.hint_px[1] - found.row_px)
            if distance > 25:
                wrong[f"{disc.name} (hint)"] = (
                    f"the hint ({disc.hint_px[0]:g}, {disc.hint_px[1]:g}) px is {distance:.0f} px from the disc; it was not used"
                )
    return wrong


def _geometry(fiducials: Sequence[Fiducial]) -> tuple[Array, Array]:
    return np.array([(disc.x_mm, disc.y_mm) for disc in fiducials], float), np.array(
        [disc.diameter_mm / 2 for disc in fiducials]
    )


def _shape(frame: NDArray[np.floating]) -> tuple[int, int]:
    return frame.shape[0], frame.shape[1]


def _reasons(missed: dict[str, str]) -> str:
    return "; ".join(f"{name} {reason}" for name, reason in missed.items())
