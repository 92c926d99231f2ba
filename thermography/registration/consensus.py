"""Which discs agree on one projection: a start that wrong places cannot bend, and a test of every disc against the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from thermography.errors import ThermographyError
from thermography.registration.projection import (
    DiscObservations,
    Projection,
    fit_homography,
    fit_projection,
    prediction_errors_px,
    select_lens_model,
    variance_factor,
)
from thermography.registration.quadruples import corner_triangles, exact_homographies, spread_quadruples

#: Values of k1 among which the start is searched, for coordinates divided by the width of the frame: twice `projection.LENS_SPREAD`.
_RADIAL_STEPS = np.linspace(-0.4, 0.4, 17)
#: Number of the best starts that are refined.
_REFINED = 3
#: Twice the area of a triangle of discs on the sensor below which they lie on a line or on one spot, px2.
_LEAST_TRIANGLE_PX2 = 10.0
#: Discs from which a wrong one can be told: each of the others must be left out once and five remain.
_LEAST_FOR_TEST = 6
#: Probability that a right disc is called wrong, for the whole list.
_FALSE_ALARM = 1e-3
#: Degrees of freedom below which a fit has nothing left that could contradict it.
_LEAST_FREEDOM = 0.5
#: A place that the others miss by less is as good as a calliper measures it, mm.
_MISPLACED_MM = 0.2


def fit_agreeing(
    observations: DiscObservations, ideal: Projection, *, calibrated: bool
) -> tuple[Projection, int, NDArray[np.bool_]]:
    """Fit one plane behind one lens to the discs whose listed places agree with it.

    Parameters
    ----------
    observations : DiscObservations
        Discs that are located, some of which may be listed at a wrong place or be confused with something else.
    ideal : Projection
        Gives focal length, principal point and, where `calibrated`, the distortion; its homography is ignored.
    calibrated : bool
        Whether the distortion is given.

    Returns
    -------
    projection : Projection
        The fit.
    coefficients : int
        Its number of distortion coefficients, 0 where `calibrated`.
    agreeing : (n,) ndarray of bool
        True for discs that agree: all of five or fewer, which cannot be told apart.

    Raises
    ------
    ThermographyError
        The discs lie on a line or on one spot.

    Notes
    -----
    Start: least quantile of squares over quadruples of discs and values of k1, with the quantile (n + 5) / 2 of the highest breakdown
    point, refined by concentration steps (P. J. Rousseeuw, J. Am. Stat. Assoc. 79 (1984) 871-880; P. J. Rousseeuw, K. Van Driessen,
    Data Min. Knowl. Disc. 12 (2006) 29-45). From there discs join and leave by an F test of their prediction error, with a probability
    of 0.001 that a list without fault loses any.
    """
    count = len(observations.u_px)
    agreeing = np.ones(count, bool)
    if count < _LEAST_FOR_TEST:
        return *_fit_lens(observations, ideal, calibrated=calibrated), agreeing
    agreeing = _robust_start(observations, ideal, calibrated=calibrated)
    for _ in range(count):
        projection, coefficients = _fit_lens(observations.select(agreeing), ideal, calibrated=calibrated)
        tested = _passes(observations, agreeing, projection, coefficients)
        if tested.sum() < 4 or (tested == agreeing).all():
            break
        agreeing = tested
    else:
        projection, coefficients = _fit_lens(observations.select(agreeing), ideal, calibrated=calibrated)
    return projection, coefficients, agreeing


def _fit_lens(observations: DiscObservations, ideal: Projection, *, calibrated: bool) -> tuple[Projection, int]:
    """Homography and distortion fitted to discs that agree, and the number of distortion coefficients."""
    start = fit_homography(observations, ideal)
    return (fit_projection(observations, start, 0), 0) if calibrated else select_lens_model(observations, start)


def _passes(
    observations: DiscObservations, agreeing: NDArray[np.bool_], projection: Projection, coefficients: int
) -> NDArray[np.bool_]:
    """Discs whose prediction by the agreeing ones (the others among them) is as good as that of the rest."""
    factor, freedom = variance_factor(observations.select(agreeing), projection, coefficients)
    errors, covariances = prediction_errors_px(observations, projection, coefficients, fitted=agreeing)
    weighted = (errors / observations.u_px[:, None])[..., None]
    squares = (np.swapaxes(weighted, 1, 2) @ np.linalg.solve(covariances, weighted))[:, 0, 0]
    # An agreeing disc is held against the scatter of the others: its own share of the chi-square is taken out.
    others = np.where(agreeing, np.maximum((factor * freedom - squares) / max(freedom - 2, 1), 1.0), factor)
    degrees = np.where(agreeing, max(freedom - 2, 1), max(freedom, 1))
    unlikely = squares / 2 / others > special.fdtri(2, degrees, 1.0 - _FALSE_ALARM / len(squares))
    missed_mm = np.linalg.norm(
        np.linalg.solve(projection.jacobian(observations.centres_mm), errors[..., None])[..., 0], axis=1
    )
    # Where the others alone determine the fit and no more, nothing tells whether an agreeing disc is wrong.
    untold = agreeing & (freedom - 2 < _LEAST_FREEDOM)
    return np.asarray(~unlikely | (missed_mm < _MISPLACED_MM) | untold)


def _robust_start(observations: DiscObservations, ideal: Projection, *, calibrated: bool) -> NDArray[np.bool_]:
    """The (n + 5) / 2 discs that agree best."""
    count = len(observations.u_px)
    wanted = (count + 5) // 2
    best, best_score = np.ones(count, bool), np.inf
    for projection in _starts(observations, ideal, wanted, calibrated=calibrated):
        chosen = np.zeros(count, bool)
        for _ in range(10):
            distance = np.linalg.norm(observations.residuals_px(projection) / observations.u_px[:, None], axis=1)
            nearest = np.isin(np.arange(count), np.argsort(distance)[:wanted])
            if (nearest == chosen).all():
                break
            chosen = nearest
            projection = fit_projection(observations.select(chosen), projection, 0 if calibrated else 1)
        score = float(np.sort(distance)[:wanted] @ np.sort(distance)[:wanted])
        if score < best_score:
            best, best_score = chosen, score
    return best


def _starts(observations: DiscObservations, ideal: Projection, wanted: int, *, calibrated: bool) -> list[Projection]:
    """Projections through four discs and with a k1 under which `wanted` discs agree best, best first."""
    quads = spread_quadruples(observations.centres_mm)
    quads = quads[np.abs(corner_triangles(observations.points_px[quads])).min(axis=1) > _LEAST_TRIANGLE_PX2]
    lenses = (
        [ideal] if calibrated else [replace(ideal, distortion=np.array([k1, 0.0, 0.0, 0.0])) for k1 in _RADIAL_STEPS]
    )
    homogeneous = np.column_stack([observations.centres_mm, np.ones(len(observations.u_px))])
    candidates: list[tuple[float, Projection]] = []
    for lens in lenses if len(quads) else []:
        straight = lens.undistort(observations.points_px)
        matrices = exact_homographies(observations.centres_mm[quads], straight[quads])
        projected = homogeneous @ np.swapaxes(matrices, 1, 2)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.linalg.norm(projected[..., :2] / projected[..., 2:] - straight, axis=-1)
        quantile = np.nan_to_num(np.partition(distance, wanted - 1, axis=1)[:, wanted - 1], nan=np.inf)
        for i in np.argsort(quantile)[:_REFINED]:
            candidates.append((float(quantile[i]), replace(lens, plan_to_sensor=matrices[i])))
    candidates.sort(key=lambda item: item[0])
    if not candidates or not np.isfinite(candidates[0][0]):
        raise ThermographyError(
            "the fiducials lie on a line or on one spot; spread at least four over both sides of the plan"
        )
    return [projection for _, projection in candidates[:_REFINED]]
