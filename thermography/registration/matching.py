"""Assignment of detected spots to fiducials: by pixel hints, or by the arrangement of the discs alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import cv2
import numpy as np
from numpy.typing import NDArray

from thermography._typing import Array
from thermography.errors import ThermographyError
from thermography.registration.consensus import fit_agreeing
from thermography.registration.discs import Spot
from thermography.registration.evidence import chance_of_arrangement
from thermography.registration.plan import Fiducial
from thermography.registration.projection import DiscObservations, Projection
from thermography.registration.quadruples import corner_triangles, exact_homographies, spread_quadruples

#: Standard uncertainty of the centroid of a detected spot, before the disc is located, px.
SPOT_U_PX = 0.2
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
#: Hypotheses compared at once: all distances of all hypotheses would take gigabytes.
_HYPOTHESES_AT_ONCE = 4096


class MatchError(ThermographyError):
    """The spots cannot be assigned to the fiducials; the message gives the reason and what to add."""


@dataclass(frozen=True)
class Arrangement:
    """Assignment of spots to fiducials by their arrangement.

    Attributes
    ----------
    spots : dict of str to Spot
        By fiducial name.
    hypotheses : int
        Number of assignments of four spots of fitting size that were tried: each might have met the other discs by chance.
    """

    spots: dict[str, Spot]
    hypotheses: int


def match_by_hints(spots: Sequence[Spot], fiducials: Sequence[Fiducial]) -> dict[str, Spot]:
    """Match spots to fiducials by their pixel hints, of which outliers are ignored.

    Parameters
    ----------
    spots : sequence of Spot
        From `thermography.registration.discs.detect_discs`.
    fiducials : sequence of Fiducial
        Discs of the plan, four or more of them with a hint.

    Returns
    -------
    dict of str to Spot
        By fiducial name; empty where fewer than four hints agree or fewer than four spots lie near them.

    Notes
    -----
    Random sample consensus on the homography from plan to hints (M. A. Fischler, R. C. Bolles, Comm. ACM 24 (1981) 381-395).
    """
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
    spots: Sequence[Spot], fiducials: Sequence[Fiducial], *, shape: tuple[int, int]
) -> Arrangement:
    """Match spots to fiducials by their arrangement and sizes alone: the homography that most discs agree with.

    Parameters
    ----------
    spots : sequence of Spot
        From `thermography.registration.discs.detect_discs`, strongest contrast first; the first 22 are tried.
    fiducials : sequence of Fiducial
        Discs of the plan, six or more.
    shape : (int, int)
        (rows, columns) of the frame; its middle is taken as centre of the distortion.

    Returns
    -------
    Arrangement

    Raises
    ------
    MatchError
        Fewer than six discs agree, or two assignments fit about equally well (a symmetric plan, or spots that are no discs).
    """
    if len(fiducials) < 6:
        raise MatchError(
            f"{len(fiducials)} fiducials cannot be told apart by their arrangement, which takes 6; give column_px,row_px for at least 4"
        )
    tried = list(spots)[:_LARGEST_ARRANGEMENT]
    if len(tried) < 6:
        raise MatchError(
            f"only {len(tried)} disc-shaped spots are in view where {len(fiducials)} fiducials are listed; "
            "give column_px,row_px, or a frame with more contrast"
        )
    plan = np.array([(disc.x_mm, disc.y_mm) for disc in fiducials], float)
    solutions: dict[tuple[tuple[str, Spot], ...], float] = {}
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
        raise MatchError(
            f"no arrangement of the {len(tried)} spots in view fits the {len(fiducials)} fiducials; give column_px,row_px for at least 4"
        )
    ranked = sorted(solutions.items(), key=lambda item: item[1])
    best_match, chance = ranked[0]
    for match, rival in ranked[1:]:
        if rival < _CLEAR_ODDS * max(chance, np.finfo(float).tiny):
            raise MatchError(_ambiguity(dict(best_match), dict(match), len(fiducials)))
    return Arrangement(dict(best_match), hypotheses)


def _ambiguity(best: dict[str, Spot], rival: dict[str, Spot], count: int) -> str:
    """Why two assignments cannot be told apart: the plan maps to itself, or too few of its discs are in view."""
    if {id(spot) for spot in best.values()} == {id(spot) for spot in rival.values()}:
        return (
            "the arrangement of the fiducials is symmetric and fits in two ways; give column_px,row_px for at least 4"
        )
    return (
        f"{len(best)} of {count} fiducials fit the spots in view in two ways, neither of which need be right; check that this is the "
        "list of this table, and give column_px,row_px for at least 4"
    )


def _candidates(
    quad: NDArray[np.intp], spots: Sequence[Spot], fiducials: Sequence[Fiducial]
) -> tuple[list[Array], int]:
    """Homographies from the quad of fiducials to four spots of the same or of mirrored handedness, best supported first.

    Also the number of them under which the four spots have the size of their discs.
    """
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
    matrices: Array, plan: Array, image: Array, fiducials: Sequence[Fiducial], spots: Sequence[Spot]
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
    homography: Array, spots: Sequence[Spot], fiducials: Sequence[Fiducial], tolerance_px: float
) -> dict[str, Spot]:
    """Pair every fiducial with the nearest spot of fitting size, each spot once, nearest pairs first."""
    plan = np.array([(disc.x_mm, disc.y_mm) for disc in fiducials], float)
    places = cv2.perspectiveTransform(plan[None], homography)[0]
    aside = cv2.perspectiveTransform(plan[None] + [[[1.0, 0.0]]], homography)[0] - places
    below = cv2.perspectiveTransform(plan[None] + [[[0.0, 1.0]]], homography)[0] - places
    magnification = np.abs(aside[:, 0] * below[:, 1] - aside[:, 1] * below[:, 0])
    pairs = []
    for i, disc in enumerate(fiducials):
        expected = np.pi / 4 * disc.diameter_mm**2 * magnification[i]
        for j, spot in enumerate(spots):
            distance = np.hypot(spot.column_px - places[i, 0], spot.row_px - places[i, 1])
            if distance < tolerance_px and expected / 2 < spot.area_px < 2 * expected:
                pairs.append((distance, i, j))
    matched: dict[str, Spot] = {}
    used_discs: set[int] = set()
    used_spots: set[int] = set()
    for _, i, j in sorted(pairs):
        if i not in used_discs and j not in used_spots:
            matched[fiducials[i].name] = spots[j]
            used_discs.add(i)
            used_spots.add(j)
    return matched


def _grow(matched: dict[str, Spot], spots: Sequence[Spot], fiducials: Sequence[Fiducial]) -> dict[str, Spot]:
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


def _chance(matched: dict[str, Spot], fiducials: Sequence[Fiducial], spots: int, shape: tuple[int, int]) -> float:
    """Chance of the agreement of the matched spots on a plane seen through a lens, one hypothesis."""
    plan, image = _pairs(matched, fiducials)
    ideal = Projection(np.eye(3), np.zeros(4), float(shape[1]), ((shape[1] - 1) / 2, (shape[0] - 1) / 2))
    observations = DiscObservations(image, plan, np.ones(len(plan)), np.full(len(plan), SPOT_U_PX))
    try:
        projection, coefficients, agreeing = fit_agreeing(observations, ideal, calibrated=False)
    except ThermographyError:
        return np.inf
    distance = np.linalg.norm(projection.to_sensor(plan) - image, axis=1)[agreeing]
    misfit = max(float(np.sqrt(np.mean(distance**2))), _LEAST_MISFIT_PX)
    return chance_of_arrangement(
        len(fiducials),
        spots,
        np.full(len(distance), misfit),
        hypotheses=1,
        coefficients=coefficients,
        area_px=float(shape[0] * shape[1]),
    )


def _pairs(matched: dict[str, Spot], fiducials: Sequence[Fiducial]) -> tuple[Array, Array]:
    """Plan points (n, 2) mm and sensor points (n, 2) px of the matched fiducials."""
    discs = [disc for disc in fiducials if disc.name in matched]
    plan = np.array([(disc.x_mm, disc.y_mm) for disc in discs], float)
    return plan, np.array([(matched[disc.name].column_px, matched[disc.name].row_px) for disc in discs])
