"""Registration of a thermogram to the table plan by disc fiducials, with the uncertainty of every plan position."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, permutations
from math import comb, inf, log10

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from thermography.common import Array, ThermographyError
from thermography.registration.discs import (
    SPOT_U_PX,
    UNKNOWN_OPTICS,
    DiscOptics,
    LocatedDisc,
    detect_discs,
    disc_weights,
    identify_plan,
    locate_disc,
    pooled_optics,
)
from thermography.registration.plan import Fiducial, PlanGrid
from thermography.registration.projection import (
    LENS_MODELS,
    DiscFit,
    DiscObservations,
    Lens,
    Projection,
    fit_homography,
    fit_projection,
    parameter_jacobian,
    select_lens_model,
)

# Quadruples of points, and the homographies that map four points exactly: the smallest sets that locate a plan.

#: Largest number of quadruples that are compared: all of 24 points, a random part of more.
_MOST_QUADRUPLES = 10_626
#: Triangles of a quadruple.
_TRIANGLES = np.array(list(combinations(range(4), 3)))


def spread_quadruples(points: Array, *, limit: int = 500) -> NDArray[np.intp]:
    """Choose quadruples of points, those first whose smallest triangle is largest, so that no three lie near a line."""
    count = len(points)
    quads = (
        np.array(list(combinations(range(count), 4)), np.intp).reshape(-1, 4)
        if count <= 24
        else np.argsort(np.random.default_rng(0).random((_MOST_QUADRUPLES, count)), axis=1)[:, :4]
    )
    smallest = np.abs(corner_triangles(points[quads])).min(axis=1)
    order = np.argsort(-smallest, kind="stable")[:limit]
    return quads[order[smallest[order] > 1e-6 * float(np.ptp(points)) ** 2]]


def corner_triangles(corners: Array) -> Array:
    """Twice the signed areas of the triangles of quadruples."""
    a, b, c = (corners[..., _TRIANGLES[:, i], :] for i in range(3))
    ab, ac = b - a, c - a
    return ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0]


def exact_homographies(plan: Array, image: Array) -> Array:
    """Homographies that map four plan points exactly to four image points."""
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


# Which discs agree on one projection: a start that wrong places cannot bend, and a test of every disc against the
# others.

#: Values of k1 among which the start is searched, for coordinates divided by the width of the frame: twice `projection.LENS_SPREAD`.
_RADIAL_STEPS = np.linspace(-0.4, 0.4, 17)
#: Number of the best starts that are refined.
_REFINED = 3
#: Twice the area of a triangle of discs on the sensor below which they lie on a line or on one spot, px2.
_LEAST_TRIANGLE_PX2 = 10.0
#: Discs from which a wrong one can be identified: each of the others must be left out once and five remain.
_LEAST_FOR_TEST = 6
#: Probability that a right disc is called wrong, for the whole list.
_FALSE_ALARM = 1e-3
#: Degrees of freedom below which a fit has nothing left that could contradict it.
_LEAST_FREEDOM = 0.5
#: A place that the others miss by less is as good as a calliper measures it, mm.
_MISPLACED_MM = 0.2


def fit_agreeing(
    observations: DiscObservations, ideal: Projection, *, calibrated: bool
) -> tuple[DiscFit, NDArray[np.bool_]]:
    """Fit one plane behind one lens to the discs whose listed places agree with it."""
    count = len(observations.u_px)
    agreeing = np.ones(count, bool)
    if count < _LEAST_FOR_TEST:
        return _fit_lens(observations, ideal, calibrated=calibrated), agreeing
    agreeing = _robust_start(observations, ideal, calibrated=calibrated)
    for _ in range(count):
        fit = _fit_lens(observations.select(agreeing), ideal, calibrated=calibrated)
        tested = _passes(observations, agreeing, fit)
        if tested.sum() < 4 or (tested == agreeing).all():
            break
        agreeing = tested
    else:
        fit = _fit_lens(observations.select(agreeing), ideal, calibrated=calibrated)
    return fit, agreeing


def _fit_lens(observations: DiscObservations, ideal: Projection, *, calibrated: bool) -> DiscFit:
    """Homography and distortion fitted to discs that agree."""
    start = fit_homography(observations, ideal)
    if calibrated:
        return DiscFit(observations, fit_projection(observations, start, 0), 0)
    return select_lens_model(observations, start)


def _passes(observations: DiscObservations, agreeing: NDArray[np.bool_], fit: DiscFit) -> NDArray[np.bool_]:
    """Discs whose prediction by the agreeing ones (the others among them) is as good as that of the rest."""
    factor, freedom = fit.variance_factor()
    errors, covariances = replace(fit, observations=observations).prediction_errors_px(fitted=agreeing)
    weighted = (errors / observations.u_px[:, None])[..., None]
    squares = (np.swapaxes(weighted, 1, 2) @ np.linalg.solve(covariances, weighted))[:, 0, 0]
    # An agreeing disc is held against the scatter of the others: its own share of the chi-square is taken out.
    others = np.where(agreeing, np.maximum((factor * freedom - squares) / max(freedom - 2, 1), 1.0), factor)
    degrees = np.where(agreeing, max(freedom - 2, 1), max(freedom, 1))
    unlikely = squares / 2 / others > scipy.special.fdtri(2, degrees, 1.0 - _FALSE_ALARM / len(squares))
    missed = np.linalg.solve(fit.projection.jacobian(observations.centres_mm), errors[..., None])[..., 0]
    missed_mm = np.linalg.norm(missed, axis=1)
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
        raise ThermographyError("the fiducials are collinear or coincide; spread at least four over the whole plan")
    return [projection for _, projection in candidates[:_REFINED]]


# What speaks for a registration: more discs than chance would place, hints, sizes and places that agree with one
# plan.

#: Largest expected number of agreements as good as the one at hand among spots that have nothing to do with the plan: one list of
#: another table in a thousand is accepted.
_LARGEST_CHANCE = 1e-3
#: A hint farther than this from its disc contradicts it, px; hints are read off a screen and may be wrong by 20 px.
WRONG_HINT_PX = 25.0
#: Standard deviation of the listed places, as a share of the discs' diameter, beyond which the list was not measured on these discs:
#: a rule laid on a disc of 14 mm errs by 0.5 mm.
_LARGEST_SCATTER = 0.1
#: Standard deviation of picked points beyond which some are picked or listed amiss, px: a hand errs by 0.5 to 1 px.
_LARGEST_PICK_SCATTER_PX = 3.0
#: Ratio of imaged to listed area beyond which diameters and places contradict each other: 15 % of the diameter, five times what blur
#: and noise do to a disc of 10 px, and more than paint does.
_LARGEST_AREA_RATIO = 1.3
#: Share of the discs that must show about the same ratio of areas for it to be a fault of the list.
_ALIKE = 0.75
#: Area of a point above half its height, px, by which every spot is larger: a focused lens and the smoothing before the search blur it.
_SPOT_PX = 4.9
#: Distance within which a spot belongs to a hint in `size_contradiction`, px.
_EVIDENCE_REACH_PX = 30.0


class RegistrationError(ThermographyError):
    """The table cannot be located in the frame; the message says which fiducials were located and what to do."""


def chance_of_arrangement(
    listed: int, spots: int, missed_px: Array, *, hypotheses: int, coefficients: int, area_px: float
) -> float:
    """Expected number of arrangements as good by chance, from spots that are scattered over the frame."""
    agreeing = len(missed_px)
    free = agreeing - 4 - (coefficients + 1) // 2
    if free < 1 or not np.isfinite(missed_px).all():
        return inf
    single = min(1.0, spots * np.pi * float(missed_px.max()) ** 2 / area_px)
    return float(hypotheses) * comb(listed - 4, agreeing - 4) * single**free


def chance_of_hints(distances_px: Array, listed: int, spots: int, *, area_px: float) -> float:
    """Expected number of hints that have a spot as near by chance."""
    nearest = np.sort(distances_px)
    chances = [
        comb(listed, count) * min(1.0, spots * np.pi * max(float(nearest[count - 1]), 1.0) ** 2 / area_px) ** count
        for count in range(4, len(nearest) + 1)
    ]
    return min(chances, default=inf)


def refuse_chance(
    located: Mapping[str, LocatedDisc],
    listed: Sequence[Fiducial],
    spots: Sequence[LocatedDisc],
    missed_px: Array,
    *,
    hypotheses: int,
    coefficients: int,
    shape: tuple[int, int],
) -> None:
    """Refuse discs whose agreement with list or hints is no better than chance would have it."""
    area = float(shape[0] * shape[1])
    by_arrangement = chance_of_arrangement(
        len(listed), len(spots), missed_px, hypotheses=hypotheses, coefficients=coefficients, area_px=area
    )
    hinted = [disc for disc in listed if disc.hint_px is not None]
    distances = np.array([_from_hint(disc, located[disc.name]) for disc in hinted if disc.name in located])
    typical = float(np.median([place.area_px for place in located.values()]))
    fitting = sum(typical / 2 < spot.area_px < 2 * typical for spot in spots)
    by_hints = chance_of_hints(distances, len(hinted), fitting, area_px=area)
    if (expected := min(by_arrangement, by_hints)) <= _LARGEST_CHANCE:
        return
    chance, hints = "nothing else confirms them", ""
    if expected < inf:
        chance = f"chance alone would do so 10^{log10(expected):.1f} times"
    if len(distances):
        hints = f"; {int((distances > WRONG_HINT_PX).sum())} of their {len(distances)} hints contradict them"
    raise RegistrationError(
        f"{len(located)} of {len(listed)} fiducials fit the spots in view, and {chance}{hints}; check that this is the list of "
        "this table, that all its discs are in view with contrast, and give column_px,row_px for at least 4"
    )


def refuse_scatter(scatter_mm: float, missed_mm: Mapping[str, float], fiducials: Sequence[Fiducial]) -> None:
    """Refuse discs whose places contradict one another by more than a list that was measured on them could."""
    limit = float(np.median([max(_LARGEST_SCATTER * disc.diameter_mm, 2 * disc.u_mm) for disc in fiducials]))
    if scatter_mm > limit:
        raise RegistrationError(
            f"the places of the fiducials contradict one another by {scatter_mm:.1f} mm (standard deviation; up to {limit:.1f} mm, a tenth "
            f"of their diameter or twice fiducials_u, are measuring errors, more means another list): {_worst(missed_mm)}; "
            "check x_mm, y_mm of these and of their neighbours"
        )


def refuse_picks(scatter_px: float, missed_mm: Mapping[str, float]) -> None:
    """Refuse points picked by hand that contradict one another."""
    if scatter_px > _LARGEST_PICK_SCATTER_PX:
        raise RegistrationError(
            f"the picked points contradict one another by {scatter_px:.1f} px (standard deviation; picking by hand is accurate to 1 px): "
            f"{_worst(missed_mm)}; check their column_px, row_px and their x_mm, y_mm"
        )


def _worst(missed_mm: Mapping[str, float]) -> str:
    """The three points that the others miss by most, in words."""
    names = sorted(missed_mm, key=lambda name: -missed_mm[name])[:3]
    return ", ".join(f"{name} is missed by the others by {missed_mm[name]:.1f} mm" for name in names)


def refuse_sizes(ratio: float, fiducials: Sequence[Fiducial]) -> None:
    """Refuse a plan whose places say another scale than the diameters of its discs."""
    if abs(np.log(ratio)) > np.log(_LARGEST_AREA_RATIO):
        raise RegistrationError(_size_message(float(np.sqrt(ratio)), fiducials))


def area_ratio(located: Mapping[str, LocatedDisc], fiducials: Sequence[Fiducial], projection: Projection) -> float:
    """Median ratio of the imaged to the listed area of the discs."""
    if any(disc.is_point for disc in fiducials):
        return np.nan
    centres, _ = _geometry(fiducials)
    listed_mm2 = np.pi / 4 * np.array([disc.diameter_mm**2 for disc in fiducials])
    listed_px = listed_mm2 * np.abs(np.linalg.det(projection.jacobian(centres)))
    return float(np.median([located[disc.name].area_px for disc in fiducials] / listed_px))


def size_contradiction(spots: Sequence[LocatedDisc], fiducials: Sequence[Fiducial]) -> str:
    """Why discs were not found where the hints point: spots of another size lie there."""
    hinted = [disc for disc in fiducials if disc.hint_px is not None]
    if len(hinted) < 4:
        return ""
    plan = np.array([(disc.x_mm, disc.y_mm) for disc in hinted])
    hints = np.array([disc.hint_px for disc in hinted], float)
    homography, _ = cv2.findHomography(plan, hints, cv2.RANSAC, _EVIDENCE_REACH_PX)
    if homography is None:
        return ""
    projection = Projection(homography, np.zeros(4), 1.0, (0.0, 0.0))
    magnification = np.abs(np.linalg.det(projection.jacobian(plan)))
    ratios = []
    for disc, scale in zip(hinted, magnification, strict=True):
        near = [(_from_hint(disc, spot), spot.area_px) for spot in spots]
        distance, area = min(near, default=(inf, 0.0))
        if distance < _EVIDENCE_REACH_PX:
            ratios.append((area - _SPOT_PX) / (np.pi / 4 * disc.diameter_mm**2 * scale))
    if len(ratios) < 4:
        return ""
    off = np.log(ratios) - np.log(np.median(ratios))
    alike = np.mean(np.abs(off) < np.log(_LARGEST_AREA_RATIO)) >= _ALIKE
    if not alike or abs(np.log(np.median(ratios))) < np.log(_LARGEST_AREA_RATIO):
        return ""
    return _size_message(float(np.sqrt(np.median(ratios))), hinted)


def _size_message(factor: float, fiducials: Sequence[Fiducial]) -> str:
    diameter = float(np.median([disc.diameter_mm for disc in fiducials]))
    return (
        f"places and diameters of the fiducials contradict each other: by the scale of x_mm, y_mm the discs in view measure "
        f"{factor * diameter:.1f} mm, diameter_mm says {diameter:g} mm; correct diameter_mm, or the unit of x_mm and y_mm"
    )


def contradicted_hints(located: Mapping[str, LocatedDisc], fiducials: Sequence[Fiducial]) -> dict[str, str]:
    """Hints far from their disc, by a key that says that only the hint is left out: the fiducial itself is used.

    Hints that are all off alike, and on no other disc, were read in another view and agree about the names: they have one key together.
    """
    wrong = {}
    hints = {disc.name: np.array(disc.hint_px) for disc in fiducials if disc.hint_px is not None}
    places = {name: np.array([place.column_px, place.row_px]) for name, place in located.items()}
    off = np.array([hint - places[name] for name, hint in hints.items()]).reshape(-1, 2)
    if len(off) >= 4:
        shift = np.median(off, axis=0)
        alike = np.hypot(*(off - shift).T).max() <= WRONG_HINT_PX < np.hypot(*shift)
        on_another = [
            min(np.hypot(*(hint - place)) for other, place in places.items() if other != name) <= WRONG_HINT_PX
            for name, hint in hints.items()
        ]
        if alike and np.mean(on_another) <= 0.5:
            said = f"all lie by the same ({shift[0]:+.0f}, {shift[1]:+.0f}) px from their discs, as in another view; they were not used"
            return {"column_px, row_px": said}
    for disc in fiducials:
        if disc.hint_px is not None and (distance := _from_hint(disc, located[disc.name])) > WRONG_HINT_PX:
            wrong[f"{disc.name} (hint)"] = (
                f"the hint ({disc.hint_px[0]:g}, {disc.hint_px[1]:g}) px is {distance:.0f} px from the disc; it was not used"
            )
    return wrong


def _from_hint(disc: Fiducial, place: LocatedDisc) -> float:
    """Distance of a place in the frame from the hint of a disc, px."""
    assert disc.hint_px is not None
    return float(np.hypot(disc.hint_px[0] - place.column_px, disc.hint_px[1] - place.row_px))


# Assignment of detected spots to fiducials: by pixel hints, or by the arrangement of the discs alone.

#: An assignment is clear if every other one is this many times as likely to arise by chance.
_CLEAR_ODDS = 1e3
#: Root mean square distance below which assignments fit equally well, px: spots are centred no better.
_LEAST_MISFIT_PX = 0.05
#: A hint farther than this from the position predicted by the other hints is an outlier.
_HINT_TOLERANCE_PX = 30.0
#: Largest distance of a spot from the position that a homography through four others predicts: the lens distorts the corners.
_ARRANGEMENT_TOLERANCE_PX = 16.0
#: Largest number of spots tried; the number of quadruples grows with its fourth power.
_LARGEST_ARRANGEMENT = 22
#: Quadruples of fiducials that are tried.
_QUADRUPLES = 8
#: What tells spots apart that their arrangement does not.
_REMEDY = "give column_px,row_px for at least 4"
#: Hypotheses compared at once: all distances of all hypotheses would take gigabytes.
_HYPOTHESES_AT_ONCE = 4096


class MatchError(ThermographyError):
    """The spots cannot be assigned to the fiducials; the message gives the reason and what to add."""


def match_by_hints(spots: Sequence[LocatedDisc], fiducials: Sequence[Fiducial]) -> dict[str, LocatedDisc]:
    """Match spots to fiducials by their pixel hints, of which outliers are ignored."""
    hinted = [disc for disc in fiducials if disc.hint_px is not None]
    if len(hinted) < 4:
        return {}
    plan = np.array([(disc.x_mm, disc.y_mm) for disc in hinted])
    hints = np.array([disc.hint_px for disc in hinted], float)
    homography, _ = cv2.findHomography(plan, hints, cv2.RANSAC, _HINT_TOLERANCE_PX, maxIters=2000)
    if homography is None:
        return {}
    matched = _nearest(homography, spots, fiducials, _HINT_TOLERANCE_PX)
    return _grow(matched, spots, fiducials) if len(matched) >= 4 else {}


def match_by_arrangement(
    spots: Sequence[LocatedDisc], fiducials: Sequence[Fiducial], *, shape: tuple[int, int]
) -> tuple[dict[str, LocatedDisc], int]:
    """Match spots to fiducials by their arrangement and sizes alone: the homography that most discs agree with.

    The number of assignments of four spots of fitting size that were tried goes with it: each might have met the others by chance.
    """
    if len(fiducials) < 6:
        raise MatchError(f"{len(fiducials)} fiducials cannot be told apart by arrangement, which needs 6; {_REMEDY}")
    tried = list(spots)[:_LARGEST_ARRANGEMENT]
    if len(tried) < 6:
        raise MatchError(
            f"only {len(tried)} disc-shaped spots are in view where {len(fiducials)} fiducials are listed; "
            "give column_px,row_px, or a frame with more contrast"
        )
    plan = np.array([(disc.x_mm, disc.y_mm) for disc in fiducials], float)
    solutions: dict[tuple[tuple[str, LocatedDisc], ...], float] = {}
    hypotheses = 0
    for quad in spread_quadruples(plan, limit=_QUADRUPLES):
        candidates, fitting = _candidates(quad, tried, fiducials)
        hypotheses += fitting
        for homography in candidates:
            matched = _grow(_nearest(homography, tried, fiducials, _ARRANGEMENT_TOLERANCE_PX), tried, fiducials)
            if len(matched) >= 6:
                key = tuple(sorted(matched.items(), key=lambda item: item[0]))
                if key not in solutions:
                    solutions[key] = _chance(matched, fiducials, len(tried), shape)
        best = max((len(key) for key in solutions), default=0)
        if best >= min(len(fiducials), len(tried)) - 1:
            break
    if not solutions:
        raise MatchError(f"no arrangement of {len(tried)} spots in view fits the {len(fiducials)} fiducials; {_REMEDY}")
    ranked = sorted(solutions.items(), key=lambda item: item[1])
    best_match, chance = ranked[0]
    for match, rival in ranked[1:]:
        if rival < _CLEAR_ODDS * max(chance, np.finfo(float).tiny):
            raise MatchError(_ambiguity(dict(best_match), dict(match), len(fiducials)))
    return dict(best_match), hypotheses


def _ambiguity(best: dict[str, LocatedDisc], rival: dict[str, LocatedDisc], count: int) -> str:
    """Why two assignments cannot be distinguished: the plan maps to itself, or too few of its discs are in view."""
    if {id(spot) for spot in best.values()} == {id(spot) for spot in rival.values()}:
        return f"the arrangement of the fiducials is symmetric and fits in two ways; {_REMEDY}"
    return (
        f"{len(best)} of {count} fiducials fit the spots in view in two ways, and neither need be right; check that this is the "
        f"list of this table, and {_REMEDY}"
    )


def _candidates(
    quad: NDArray[np.intp], spots: Sequence[LocatedDisc], fiducials: Sequence[Fiducial]
) -> tuple[list[Array], int]:
    """Homographies from the quad of fiducials to four spots of the same or of mirrored handedness, best supported first."""
    plan = np.array([(disc.x_mm, disc.y_mm) for disc in fiducials])
    image = np.array([(spot.column_px, spot.row_px) for spot in spots])
    chosen = np.array(list(permutations(range(len(spots)), 4)))
    turns = np.sign(corner_triangles(plan[quad]))
    image_turns = np.sign(corner_triangles(image[chosen]))
    same, mirrored = (image_turns == turns).all(axis=1), (image_turns == -turns).all(axis=1)
    chosen = chosen[same | mirrored]
    matrices = exact_homographies(plan[quad][None], image[chosen])
    support, sizes = _support(matrices, plan, image, fiducials, spots)
    areas = np.array([spot.area_px for spot in spots])[chosen]
    with np.errstate(divide="ignore", invalid="ignore"):
        fitting = (np.abs(np.log(areas / sizes[:, quad])) < np.log(2)).all(axis=1)
    order = np.argsort(-support)[:24]
    return [matrices[i] for i in order if support[i] > 0], int(fitting.sum())


def _support(
    matrices: Array, plan: Array, image: Array, fiducials: Sequence[Fiducial], spots: Sequence[LocatedDisc]
) -> tuple[Array, Array]:
    """Number of fiducials near a spot of fitting size under every homography (k, 3, 3), weighted by closeness, (k,); areas (k, n) px."""
    projected = np.einsum("kij,nj->kni", matrices, np.column_stack([plan, np.ones(len(plan))]))
    scale = projected[..., 2]
    squares = np.array([disc.diameter_mm**2 for disc in fiducials])
    with np.errstate(divide="ignore", invalid="ignore"):
        places = projected[..., :2] / projected[..., 2:]
        # Local magnification of a homography H at homogeneous scale w: |det H| / |w|^3.
        expected = np.pi / 4 * squares * np.abs(np.linalg.det(matrices)[:, None] / scale**3)
    in_front = (np.sign(scale) == np.sign(scale[:, :1])).all(axis=1)
    areas = np.array([spot.area_px for spot in spots])
    support = np.zeros(len(matrices))
    # The size is part of the evidence: without it a homography that shrinks the plan to one spot is supported by every disc.
    for start in range(0, len(matrices), _HYPOTHESES_AT_ONCE):
        part = slice(start, start + _HYPOTHESES_AT_ONCE)
        distance = np.linalg.norm(places[part, :, None, :] - image[None, None, :, :], axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            fits = np.abs(np.log(areas / expected[part, :, None])) < np.log(2)
        relative = np.where(fits, distance, np.inf) / _ARRANGEMENT_TOLERANCE_PX
        support[part] = (1 - np.minimum(relative, 1).min(axis=2)).sum(axis=1)
    support[~in_front] = 0
    return support, expected


def _nearest(
    homography: Array, spots: Sequence[LocatedDisc], fiducials: Sequence[Fiducial], tolerance_px: float
) -> dict[str, LocatedDisc]:
    """Pair every fiducial with the nearest spot of fitting size, each spot once, nearest pairs first."""
    plan = np.array([(disc.x_mm, disc.y_mm) for disc in fiducials], float)
    places = cv2.perspectiveTransform(plan[None], homography)[0]
    aside = cv2.perspectiveTransform(plan[None] + [[[1.0, 0.0]]], homography)[0] - places
    below = cv2.perspectiveTransform(plan[None] + [[[0.0, 1.0]]], homography)[0] - places
    magnification = np.abs(aside[:, 0] * below[:, 1] - aside[:, 1] * below[:, 0])
    pairs = []
    for i, disc in enumerate(fiducials):
        expected = np.pi / 4 * disc.diameter_mm**2 * magnification[i] + _SPOT_PX
        for j, spot in enumerate(spots):
            distance = np.hypot(spot.column_px - places[i, 0], spot.row_px - places[i, 1])
            if distance < tolerance_px and expected / 2 < spot.area_px < 2 * expected:
                pairs.append((distance, i, j))
    spot_of: dict[int, int] = {}
    for _, i, j in sorted(pairs):
        if i not in spot_of and j not in spot_of.values():
            spot_of[i] = j
    return {fiducials[i].name: spots[j] for i, j in spot_of.items()}


def _grow(
    matched: dict[str, LocatedDisc], spots: Sequence[LocatedDisc], fiducials: Sequence[Fiducial]
) -> dict[str, LocatedDisc]:
    """Refit the homography to the matched pairs and match again, until nothing changes."""
    for _ in range(6):
        if len(matched) < 4:
            break
        plan, image = _pairs(matched, fiducials)
        homography, kept = cv2.findHomography(plan, image, cv2.RANSAC, _ARRANGEMENT_TOLERANCE_PX / 2)
        if homography is None or kept.sum() < 4:
            break
        again = _nearest(homography, spots, fiducials, _ARRANGEMENT_TOLERANCE_PX)
        if again == matched:
            break
        matched = again
    return matched


def _chance(
    matched: dict[str, LocatedDisc], fiducials: Sequence[Fiducial], spots: int, shape: tuple[int, int]
) -> float:
    """Chance of the agreement of the matched spots on a plane seen through a lens, one hypothesis."""
    plan, image = _pairs(matched, fiducials)
    observations = DiscObservations(image, plan, np.ones(len(plan)), np.full(len(plan), SPOT_U_PX))
    try:
        fit, agreeing = fit_agreeing(observations, Projection.ideal(shape), calibrated=False)
    except ThermographyError:
        return np.inf
    distance = np.linalg.norm(fit.projection.to_sensor(plan) - image, axis=1)[agreeing]
    misfit = max(float(np.sqrt(np.mean(distance**2))), _LEAST_MISFIT_PX)
    missed, area = np.full(len(distance), misfit), float(shape[0] * shape[1])
    return chance_of_arrangement(
        len(fiducials), spots, missed, hypotheses=1, coefficients=fit.coefficients, area_px=area
    )


def _pairs(matched: dict[str, LocatedDisc], fiducials: Sequence[Fiducial]) -> tuple[Array, Array]:
    """Plan points (n, 2) mm and sensor points (n, 2) px of the matched fiducials."""
    discs = [disc for disc in fiducials if disc.name in matched]
    plan = np.array([(disc.x_mm, disc.y_mm) for disc in discs], float)
    return plan, np.array([(matched[disc.name].column_px, matched[disc.name].row_px) for disc in discs])


_MODEL_NAMES = {count: name for name, count in LENS_MODELS}

#: Standard uncertainty of a centroid beyond noise (pixel response, curvature of the field), px; 0.003 px are observed without noise.
_CENTROID_FLOOR_PX = 0.004
#: Least margin around discs and along the plan's edge, px: the registration's own error, and a lens that is not quite Gaussian.
_LEAST_MARGIN_PX = 2.0
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
    homography : (3, 3), from undistorted sensor px (column, row) to plan mm (x, y)
    distortion : (4,), (k1, k2, p1, p2) of image coordinates divided by the projection's focal length; zeros without distortion
    model : name of the lens model, see `thermography.registration.projection.LENS_MODELS`
    projection : plan to sensor
    fiducials : fiducials used, by name, as listed in the plan
    located : their centroids on the sensor with contrast and uncertainty
    residual_mm, leave_one_out_mm
        Registration residual, mm: distance on the plan between the observed and the listed position of each fiducial, with the
        fiducial in the fit and without it (NaN where the others do not determine the fit)
    rms_mm : mm, root mean square of `residual_mm`; NaN where four fiducials determine the plan exactly, which tells nothing
    scatter_mm, scatter_px
        Standard deviation of the places along either coordinate, on the plan in mm and on the sensor in px, from the residuals and
        their degrees of freedom; not below the uncertainty of the centroids
    area_ratio : median ratio of the imaged to the listed area of the discs; NaN for points
    unchecked : fiducials whose place the others predict too badly to notice if it were wrong by a disc's diameter; all of four
    left_out : reason, by name, for every listed fiducial that was not used
    masked : every fiducial on the table, used or not: their pixels do not show the table's temperature
    shape : (rows, columns) of the frames
    lens : the calibrated lens that was given
    optics : edge spread of lens and pixel that the discs show, px, see `thermography.registration.discs.DiscOptics`; for points that
        of a focused lens
    covariance
        (p, p), of the homography and of the distortion, p = 8 with a calibrated lens, else 12: coefficients that were not fitted are
        not known to be zero. See `thermography.registration.projection.DiscFit.covariance`.
    """

    homography: Array
    distortion: Array
    model: str
    projection: Projection
    shape: tuple[int, int]
    covariance: Array = field(repr=False)
    fiducials: dict[str, Fiducial] = field(default_factory=dict)
    located: dict[str, LocatedDisc] = field(default_factory=dict)
    residual_mm: dict[str, float] = field(default_factory=dict)
    leave_one_out_mm: dict[str, float] = field(default_factory=dict)
    rms_mm: float = math.nan
    scatter_mm: float = math.nan
    scatter_px: float = math.nan
    area_ratio: float = math.nan
    unchecked: tuple[str, ...] = ()
    left_out: dict[str, str] = field(default_factory=dict)
    masked: tuple[Fiducial, ...] = ()
    lens: Lens | None = None
    optics: DiscOptics = UNKNOWN_OPTICS

    def __str__(self) -> str:
        """Return in one line how well the plan was located."""
        unused = "".join(f"; {name} not used: {reason}" for name, reason in self.left_out.items())
        return f"{len(self.located)} fiducials, {self.rms_mm:.3g} mm rms, {self.model}{unused}"

    @property
    def is_picture(self) -> bool:
        """Whether the picture itself is the plan, with lengths in px: see `thermography.registration.register`."""
        return not self.fiducials

    @property
    def margin_px(self) -> float:
        """Distance from discs and from the plan's edge within which a pixel does not show the table alone, px: three edge spreads."""
        # The edge of a picture that is its own plan is the edge of nothing that could be blurred into it.
        return 0.0 if self.is_picture else max(_LEAST_MARGIN_PX, 3.0 * self.optics.spread_px)

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
        """Covariance of the plan positions that the registration assigns."""
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
        # No residual shows a scale that all places of the list share: it moves the typical disc by the u of its place.
        off = flat - centres.mean(axis=0)
        squares = np.mean([disc.u_mm**2 for disc in self.fiducials.values()])
        scale2 = squares / np.mean(np.sum((centres - centres.mean(axis=0)) ** 2, axis=1))
        covariance = plan @ self.covariance @ np.swapaxes(plan, 1, 2) + scale2 * off[:, :, None] * off[:, None, :]
        return np.asarray(covariance.reshape(*points_mm.shape[:-1], 2, 2))

    def position_u(self, points_mm: Array) -> Array:
        """Standard uncertainty of plan positions, (...) mm, for points (..., 2) mm: root of the summed variances along x and y."""
        return np.sqrt(np.trace(self.position_covariance(points_mm), axis1=-2, axis2=-1))


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
        raise RegistrationError(f"temperature has shape {frame.shape}; give one frame or a stack (time, row, column)")
    frame = frame.mean(axis=0) if frame.ndim == 3 else frame
    shape = frame.shape[0], frame.shape[1]
    if any(fiducial.is_point for fiducial in fiducials):
        return register_points(None, fiducials, shape, lens=lens)
    listed, left_out = _without_duplicates(identify_plan(frame, fiducials))
    if len(listed) < 4:
        reasons = f" ({_reasons(left_out)})" if left_out else ""
        raise RegistrationError(f"fiducials lists {len(listed)} different discs; a plan needs at least 4{reasons}")
    if not use_hints:
        listed = [replace(disc, column_px=None, row_px=None) for disc in listed]
    spots = detect_discs(frame)

    def by_spots(matched: dict[str, LocatedDisc], hypotheses: int) -> Registration:
        """Locate all discs from those that are matched with spots, fit those that agree, and refuse what may be chance."""
        located, optics = matched, UNKNOWN_OPTICS
        for _ in range(2):
            discs = [disc for disc in listed if disc.name in located]
            fit, _ = _fit(_observations(located, discs), shape, lens)
            located, missed = locate_fiducials(
                frame, listed, fit.projection, grid=grid, reach_px=_REACH_PX, optics=optics
            )
            if len(located) < 4:
                raise RegistrationError(
                    f"only {len(located)} of {len(listed)} fiducials are located, a plan needs 4: {_reasons(missed)}"
                )
            optics = pooled_optics(located.values())
        apart = {name: place for name, place in matched.items() if name not in located}
        registration = _registration(located, listed, left_out | missed, shape, lens, apart=apart, optics=optics)
        judge(registration, listed, spots, hypotheses)
        wrong_hints = contradicted_hints(registration.located, list(registration.fiducials.values()))
        return replace(registration, left_out=registration.left_out | wrong_hints)

    found: list[Registration] = []
    refusals: list[str] = []
    matched = match_by_hints(spots, listed)
    if len(matched) >= 4:
        try:
            found.append(by_spots(matched, 1))
        except RegistrationError as error:
            refusals.append(str(error))
    # Hints of the mirrored or turned picture lead to a plausible but wrong assignment on a nearly symmetric plan.
    if not found or found[0].scatter_mm > _PLAIN_SCATTER_MM or len(found[0].located) < min(6, len(listed)):
        try:
            found.append(by_spots(*match_by_arrangement(spots, listed, shape=shape)))
        except (MatchError, RegistrationError) as error:
            refusals.append(str(error))
    if not found:
        raise RegistrationError(f"the table cannot be located: {size_contradiction(spots, listed) or refusals[0]}")
    registration = max(found, key=lambda each: (len(each.located), -each.scatter_mm))
    markers = tuple(fiducial for fiducial in fiducials if fiducial.marker is not None)
    return replace(registration, masked=registration.masked + markers)


def fiducial_weights(registration: Registration, grid: PlanGrid) -> dict[str, tuple[tuple[slice, slice], Array]]:
    """Window and weights of `thermography.registration.discs.disc_weights` of every located disc that has pixels enough, by name."""
    discs = {name: disc for name, disc in registration.fiducials.items() if not disc.is_point}
    jacobians = registration.projection.jacobian(_geometry(list(discs.values()))[0].reshape(-1, 2))
    spread_px, located = registration.optics.spread_px, registration.located
    weights = {
        name: disc_weights(registration.shape, disc, grid, located[name], jacobian, spread_px)
        for (name, disc), jacobian in zip(discs.items(), jacobians, strict=True)
    }
    return {name: found for name, found in weights.items() if found is not None}


def with_optics_of(temperature: Array, registration: Registration, grid: PlanGrid) -> Registration:
    """The registration with the edge spread of another frame, (row, column) degC, where that is surely wider there."""
    listed, before = list(registration.fiducials.values()), registration.optics
    located, _ = locate_fiducials(temperature, listed, registration.projection, grid=grid, reach_px=_REACH_PX)
    if 2 * len(located) < len(listed):
        return registration
    optics = pooled_optics(located.values())
    wider = optics.spread_px - before.spread_px > 3.0 * np.hypot(optics.spread_u_px, before.spread_u_px)
    return replace(registration, optics=optics) if wider else registration


def judge(
    registration: Registration, listed: Sequence[Fiducial], spots: Sequence[LocatedDisc], hypotheses: int
) -> None:
    """Refuse a registration that may be chance, or whose discs contradict one another or their diameters."""
    discs = list(registration.fiducials.values())
    missed_mm = np.array([registration.leave_one_out_mm[disc.name] for disc in discs])
    refuse_chance(
        registration.located,
        listed,
        spots,
        missed_mm * registration.projection.px_per_mm(_geometry(discs)[0]),
        hypotheses=hypotheses,
        coefficients=0 if registration.lens is not None else dict(LENS_MODELS)[registration.model],
        shape=registration.shape,
    )
    refuse_sizes(registration.area_ratio, discs)
    refuse_scatter(registration.scatter_mm, registration.leave_one_out_mm, discs)


def register_points(
    points_px: Mapping[str, tuple[float, float]] | None,
    fiducials: Sequence[Fiducial],
    shape: tuple[int, int],
    *,
    lens: Lens | None = None,
) -> Registration:
    """Register by points picked by hand instead of discs located in a frame."""
    listed, left_out = _without_duplicates([fiducial for fiducial in fiducials if fiducial.marker is None])
    if points_px is None:
        points_px = {disc.name: disc.hint_px for disc in listed if disc.hint_px is not None}
    unknown = sorted(set(points_px) - {disc.name for disc in listed})
    if unknown:
        raise RegistrationError(f"picked points {', '.join(unknown)} are not in the list of fiducials; use its names")
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
    optics: DiscOptics = UNKNOWN_OPTICS,
) -> tuple[dict[str, LocatedDisc], dict[str, str]]:
    """Locate every fiducial near its projection."""
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
        result = locate_disc(temperature, moved, bounds, place, jacobian, reach_px=reach_px, optics=optics)
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
    optics: DiscOptics = UNKNOWN_OPTICS,
) -> Registration:
    """Fit the fiducials that agree; leave out the others, with where they are (`apart`: those that were detected but not located)."""
    discs = [disc for disc in listed if disc.name in located]
    fit, agree = _fit(_observations(located, discs), shape, lens)
    observations, projection = fit.observations, fit.projection
    left_out, observed = dict(left_out), {}
    misplaced = {disc.name: located[disc.name] for disc, agrees in zip(discs, agree, strict=True) if not agrees}
    for disc in listed:
        if (place := misplaced.get(disc.name) or (apart or {}).get(disc.name)) is not None:
            x_mm, y_mm = projection.to_plan(np.array([place.column_px, place.row_px])).tolist()
            observed[disc.name] = replace(disc, x_mm=x_mm, y_mm=y_mm)
            left_out[disc.name] = (
                f"misplaced by {np.hypot(x_mm - disc.x_mm, y_mm - disc.y_mm):.2f} mm against the others, which see it at "
                f"({x_mm:.1f}, {y_mm:.1f}) mm; check its x_mm, y_mm, and that nothing covers a part of it"
            )
    discs = [disc for disc in discs if disc.name not in misplaced]
    names = [disc.name for disc in discs]
    residual = np.linalg.norm(observations.residuals_mm(projection), axis=1)
    factor, freedom = fit.variance_factor()
    # Half-width of Student's t that holds 68 %: few residuals tell their scatter badly (JCGM 100:2008, annex G).
    factor_u = factor * (float(scipy.special.stdtrit(freedom, scipy.special.ndtr(1.0))) ** 2 if freedom >= 1.0 else 1.0)
    px_per_mm = projection.px_per_mm(observations.centres_mm)
    # Four places have nothing that checks them: each may err unnoticed by up to its diameter, rectangular (JCGM 100:2008, 4.3.7).
    reach_mm = np.array([disc.diameter_mm if len(discs) == 4 else 0.0 for disc in discs])
    hidden = replace(observations, u_px=np.hypot(observations.u_px, reach_mm * px_per_mm / np.sqrt(3.0 * factor_u)))
    fit_of_u = replace(fit, observations=hidden)
    return Registration(
        homography=np.linalg.inv(projection.plan_to_sensor),
        distortion=projection.distortion,
        model=_MODEL_NAMES[fit.coefficients] if lens is None else "calibrated lens + homography",
        projection=projection,
        fiducials=dict(zip(names, discs, strict=True)),
        located={name: located[name] for name in names},
        residual_mm=dict(zip(names, residual.tolist(), strict=True)),
        leave_one_out_mm=dict(zip(names, fit.leave_one_out_mm().tolist(), strict=True)),
        rms_mm=float(np.sqrt(np.mean(residual**2))) if freedom > 0 else float("nan"),
        scatter_mm=float(np.sqrt(factor) * np.median(observations.u_px / px_per_mm)),
        scatter_px=float(np.sqrt(factor) * np.median(observations.u_px)),
        area_ratio=area_ratio(located, discs, projection),
        unchecked=_unchecked(fit, discs, factor),
        left_out=left_out,
        masked=tuple(observed.get(disc.name, disc) for disc in listed),
        shape=shape,
        lens=lens,
        optics=optics,
        covariance=(fit_of_u if lens is not None else fit_of_u.with_unfitted(factor_u)).covariance(factor_u),
    )


def _unchecked(fit: DiscFit, discs: Sequence[Fiducial], factor: float) -> tuple[str, ...]:
    """Fiducials whose place the others predict with a standard uncertainty above a quarter of their diameter."""
    if len(discs) == 4:
        return tuple(disc.name for disc in discs)
    _, covariances = fit.prediction_errors_px()
    centres_mm, projection = fit.observations.centres_mm, fit.projection
    to_mm = np.linalg.inv(projection.jacobian(centres_mm)) * fit.observations.u_px[:, None, None]
    variances = factor * np.trace(to_mm @ covariances @ np.swapaxes(to_mm, 1, 2), axis1=1, axis2=2)
    px_per_mm = projection.px_per_mm(centres_mm)
    # Where the others lie on a line, rounding decides the sign of what has no bound.
    return tuple(
        disc.name
        for disc, variance, scale in zip(discs, variances, px_per_mm, strict=True)
        if not 0 <= variance <= (_LARGEST_PREDICTION_U * (disc.diameter_mm or _POINT_PX * scale**-1.0)) ** 2
    )


def _fit(
    observations: DiscObservations, shape: tuple[int, int], lens: Lens | None
) -> tuple[DiscFit, NDArray[np.bool_]]:
    """Projection fitted to the discs that agree, and which these are."""
    if lens is not None:
        if lens.size_px is not None and lens.size_px != shape[::-1]:
            sizes = "calibrated with frames of {} x {} pixels, these have {} x {}".format(*lens.size_px, *shape[::-1])
            raise RegistrationError(f"the lens was {sizes}; calibrate with frames of this size")
        ideal = Projection(np.eye(3), np.array(lens.distortion), lens.focal_length_px, lens.principal_point_px)
    else:
        ideal = Projection.ideal(shape)
    try:
        return fit_agreeing(observations, ideal, calibrated=lens is not None)
    except ValueError as error:
        # Also a fit that cannot be solved.
        raise RegistrationError(str(error)) from error


def _observations(located: dict[str, LocatedDisc], fiducials: Sequence[Fiducial]) -> DiscObservations:
    places = [located[disc.name] for disc in fiducials]
    points_px = np.array([(place.column_px, place.row_px) for place in places])
    centres_mm, radii_mm = _geometry(fiducials)
    px_per_mm = np.linalg.norm(points_px - points_px.mean(axis=0)) / np.linalg.norm(
        centres_mm - centres_mm.mean(axis=0)
    )
    listed_px = px_per_mm * np.array([disc.u_mm for disc in fiducials])
    u_px = np.sqrt(np.array([place.u_px for place in places]) ** 2 + _CENTROID_FLOOR_PX**2 + listed_px**2)
    return DiscObservations(points_px, centres_mm, radii_mm, u_px)


def _without_duplicates(fiducials: Sequence[Fiducial]) -> tuple[list[Fiducial], dict[str, str]]:
    """The first of fiducials that share a name or a position, and the reason by name for leaving out the others."""
    kept: list[Fiducial] = []
    left_out: dict[str, str] = {}
    for disc in fiducials:
        for other in kept:
            apart_mm = np.hypot(disc.x_mm - other.x_mm, disc.y_mm - other.y_mm)
            if disc.name == other.name or apart_mm <= disc.diameter_mm / 2:
                again = disc.name if disc.name != other.name else f"{disc.name} (second)"
                left_out[again] = (
                    f"listed twice: ({disc.x_mm:g}, {disc.y_mm:g}) mm, also as {other.name} ({other.x_mm:g}, {other.y_mm:g}) mm"
                )
                break
        else:
            kept.append(disc)
    return kept, left_out


def _geometry(fiducials: Sequence[Fiducial]) -> tuple[Array, Array]:
    """Centres (n, 2) and radii (n,), mm."""
    centres = np.array([(disc.x_mm, disc.y_mm) for disc in fiducials], float)
    return centres, np.array([disc.diameter_mm / 2 for disc in fiducials])


def _reasons(missed: dict[str, str]) -> str:
    return "; ".join(f"{name} {reason}" for name, reason in missed.items())


# The picture as the plan: where no place on the table is known in millimetres, lengths are counted in pixels of the
# frames.

#: Name of this registration, in the place of a lens model.
PICTURE = "picture"
#: Largest number of cells along the longer side: cells finer than a screen shows are only slow.
_MOST_CELLS = 160


def picture_grid(shape: tuple[int, int]) -> PlanGrid:
    """Return the grid of a plan that is the picture itself: the smallest cells that divide both sides, at most 160 along the longer one.

    Where no such cell divides both, the last row and column of cells end within half a cell of the picture's edge.
    """
    rows, columns = shape
    common, least = math.gcd(rows, columns), math.ceil(max(shape) / _MOST_CELLS)
    size = next((size for size in range(least, common + 1) if common % size == 0), least)
    width, height = (float(size * max(1, round(pixels / size))) for pixels in (columns, rows))
    return PlanGrid(width, height, size)


def register_picture(shape: tuple[int, int]) -> Registration:
    """Return the registration of a plan that is the picture itself."""
    rows, columns = shape
    to_sensor = np.array([[1.0, 0.0, -0.5], [0.0, 1.0, -0.5], [0.0, 0.0, 1.0]])
    centre = ((columns - 1) / 2, (rows - 1) / 2)
    return Registration(
        homography=np.linalg.inv(to_sensor),
        distortion=np.zeros(4),
        model=PICTURE,
        projection=Projection(to_sensor, np.zeros(4), float(max(shape)), centre),
        shape=shape,
        covariance=np.zeros((8, 8)),
    )
