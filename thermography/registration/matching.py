"""Assignment of detected spots to fiducials: by pixel hints, or by the arrangement of the discs alone."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, permutations

import cv2
import numpy as np

from thermography._typing import Array
from thermography.errors import ThermographyError
from thermography.registration.discs import Spot
from thermography.registration.plan import Fiducial
from thermography.registration.projection import DiscObservations, Projection, fit_homography, fit_projection

#: A hint farther than this from the position predicted by the other hints is an outlier.
_HINT_TOLERANCE_PX = 30.0
#: Largest distance of a spot from the position that a homography through four others predicts: the lens distorts the corners.
_ARRANGEMENT_TOLERANCE_PX = 16.0
#: Largest number of spots tried; the number of quadruples grows with its fourth power.
_LARGEST_ARRANGEMENT = 22
#: Hypotheses compared at once: all distances of all hypotheses would take gigabytes.
_HYPOTHESES_AT_ONCE = 4096


class MatchError(ThermographyError):
    """The spots cannot be assigned to the fiducials; the message gives the reason and what to add."""


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
) -> dict[str, Spot]:
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
    dict of str to Spot
        By fiducial name.

    Raises
    ------
    MatchError
        Fewer than six discs agree, or two assignments fit about equally well (a symmetric plan).
    """
    if len(fiducials) < 6:
        raise MatchError(
            f"{len(fiducials)} fiducials cannot be told apart by their arrangement, which takes 6; give column_px,row_px for at least 4"
        )
    tried = list(spots)[:_LARGEST_ARRANGEMENT]
    if len(tried) < 6:
        raise MatchError(
            f"only {len(tried)} disc-shaped spots are seen where {len(fiducials)} fiducials are listed; "
            "give column_px,row_px, or a frame with more contrast"
        )
    solutions: dict[tuple[tuple[str, Spot], ...], float] = {}
    for quad in _spread_quads(fiducials)[:8]:
        for homography in _candidates(quad, tried, fiducials):
            matched = _grow(_nearest(homography, tried, fiducials, _ARRANGEMENT_TOLERANCE_PX), tried, fiducials)
            if len(matched) >= 6:
                key = tuple(sorted(matched.items(), key=lambda item: item[0]))
                solutions[key] = _misfit(matched, fiducials, shape)
        best = max((len(key) for key in solutions), default=0)
        if best >= min(len(fiducials), len(tried)) - 1:
            break
    if not solutions:
        raise MatchError(
            f"no arrangement of the {len(tried)} spots seen fits the {len(fiducials)} fiducials; give column_px,row_px for at least 4"
        )
    ranked = sorted(solutions.items(), key=lambda item: (-len(item[0]), item[1]))
    best_match, misfit = ranked[0]
    rivals = [rival_misfit for match, rival_misfit in ranked[1:] if len(match) == len(best_match)]
    if rivals and rivals[0] < 2 * max(misfit, 0.05):
        raise MatchError(
            "the arrangement of the fiducials is symmetric and fits in two ways; give column_px,row_px for at least 4"
        )
    return dict(best_match)


def _spread_quads(fiducials: Sequence[Fiducial]) -> list[tuple[int, ...]]:
    """Quadruples of fiducials, those first whose smallest triangle is largest, so that no three lie near a line."""
    plan = np.array([(disc.x_mm, disc.y_mm) for disc in fiducials])
    quads = []
    for quad in combinations(range(len(fiducials)), 4):
        areas = [abs(float(_signed_area(plan, three))) for three in combinations(quad, 3)]
        quads.append((min(areas), quad))
    return [quad for _, quad in sorted(quads, reverse=True)]


def _candidates(quad: tuple[int, ...], spots: Sequence[Spot], fiducials: Sequence[Fiducial]) -> list[Array]:
    """Homographies that map the quad of fiducials to four spots of the same or of mirrored handedness, best supported first."""
    plan = np.array([(disc.x_mm, disc.y_mm) for disc in fiducials])
    image = np.array([(spot.column_px, spot.row_px) for spot in spots])
    chosen = np.array(list(permutations(range(len(spots)), 4)))
    turns = np.stack([_signed_area(plan[list(quad)], three) for three in combinations(range(4), 3)])
    image_turns = np.stack([_signed_area(image[chosen], three) for three in combinations(range(4), 3)], axis=-1)
    same = (np.sign(image_turns) == np.sign(turns)).all(axis=1)
    mirrored = (np.sign(image_turns) == -np.sign(turns)).all(axis=1)
    matrices = _homographies(plan[list(quad)], image[chosen[same | mirrored]])
    support = _support(matrices, plan, image, fiducials, spots)
    order = np.argsort(-support)[:24]
    return [matrices[i] for i in order if support[i] > 0]


def _support(matrices: Array, plan: Array, image: Array, fiducials: Sequence[Fiducial], spots: Sequence[Spot]) -> Array:
    """Number of fiducials that lie near a spot of fitting size under every homography (k, 3, 3), weighted by closeness, (k,)."""
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
    return support


def _homographies(plan: Array, image: Array) -> Array:
    """Homographies (k, 3, 3) that map four plan points (4, 2) exactly to the image points (k, 4, 2)."""
    middle, scale = plan.mean(axis=0), np.abs(plan - plan.mean(axis=0)).max()
    x, y = ((plan - middle) / scale).T
    u, v = image[..., 0], image[..., 1]
    system = np.zeros((len(image), 8, 8))
    system[:, :4, 0], system[:, :4, 1], system[:, :4, 2] = x, y, 1
    system[:, 4:, 3], system[:, 4:, 4], system[:, 4:, 5] = x, y, 1
    system[:, :4, 6], system[:, :4, 7] = -u * x, -u * y
    system[:, 4:, 6], system[:, 4:, 7] = -v * x, -v * y
    entries = np.linalg.solve(system, np.concatenate([u, v], axis=1)[..., None])[..., 0]
    matrices = np.concatenate([entries, np.ones((len(image), 1))], axis=1).reshape(-1, 3, 3)
    to_unit = np.array([[1 / scale, 0, -middle[0] / scale], [0, 1 / scale, -middle[1] / scale], [0, 0, 1]])
    return matrices @ to_unit


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


def _misfit(matched: dict[str, Spot], fiducials: Sequence[Fiducial], shape: tuple[int, int]) -> float:
    """Root mean square distance, px, of the matched spots from a plane seen through a lens, without the worst one of seven or more."""
    plan, image = _pairs(matched, fiducials)
    ideal = Projection(np.eye(3), np.zeros(4), float(shape[1]), ((shape[1] - 1) / 2, (shape[0] - 1) / 2))
    observations = DiscObservations(image, plan, np.ones(len(plan)), np.ones(len(plan)))
    distance = _distances(observations, ideal)
    if len(plan) > 6:
        distance = _distances(observations.without(int(np.argmax(distance))), ideal)
    return float(np.sqrt(np.mean(distance**2)))


def _distances(observations: DiscObservations, ideal: Projection) -> Array:
    """Distance of every disc from its projection by the fit, (n,) px; infinite where there is no fit."""
    count = len(observations.u_px)
    try:
        projection = fit_projection(observations, fit_homography(observations, ideal), 1 if count >= 7 else 0)
    except ValueError:
        return np.full(count, np.inf)
    distances: Array = np.linalg.norm(projection.to_sensor(observations.centres_mm) - observations.points_px, axis=1)
    return distances


def _pairs(matched: dict[str, Spot], fiducials: Sequence[Fiducial]) -> tuple[Array, Array]:
    """Plan points (n, 2) mm and sensor points (n, 2) px of the matched fiducials."""
    discs = [disc for disc in fiducials if disc.name in matched]
    plan = np.array([(disc.x_mm, disc.y_mm) for disc in discs], float)
    return plan, np.array([(matched[disc.name].column_px, matched[disc.name].row_px) for disc in discs])


def _signed_area(points: Array, three: tuple[int, ...]) -> Array:
    """Twice the area of the triangle of three of the points (..., n, 2), signed by its sense."""
    a, b, c = (points[..., i, :] for i in three)
    ab, ac = b - a, c - a
    area: Array = ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0]
    return area
