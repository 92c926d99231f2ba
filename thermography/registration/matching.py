"""Which spot is which fiducial: by pixel hints, or by the arrangement of the discs alone."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, permutations

import cv2
import numpy as np

from thermography._typing import Array
from thermography.errors import ThermographyError
from thermography.registration.discs import Spot
from thermography.registration.plan import Fiducial
from thermography.registration.projection import Projection, Sightings, fit_homography, fit_projection

#: A hint farther than this from the place that the other hints agree on is called wrong.
HINT_TOLERANCE_PX = 30.0
#: How far a disc may be from where four others put it: lens distortion bends the plane by tens of pixels at the corners.
ARRANGEMENT_TOLERANCE_PX = 16.0
#: Spots tried for the arrangement; the number of quadruples grows with its fourth power.
LARGEST_ARRANGEMENT = 22


class MatchError(ThermographyError):
    """The spots in the image cannot be told apart; the message says why and what to add."""


def match_by_hints(spots: Sequence[Spot], fiducials: Sequence[Fiducial]) -> dict[str, Spot]:
    """Match spots to fiducials by the hints that agree with one homography, however wrong the others are.

    Returns
    -------
    dict[str, Spot]
        By fiducial name; empty where fewer than four hints agree or fewer than four spots answer them.
    """
    hinted = [disc for disc in fiducials if disc.hint_px is not None]
    if len(hinted) < 4:
        return {}
    plan = np.array([(disc.x_mm, disc.y_mm) for disc in hinted])
    hints = np.array([disc.hint_px for disc in hinted], float)
    homography, _ = cv2.findHomography(plan, hints, cv2.RANSAC, HINT_TOLERANCE_PX, maxIters=2000)
    if homography is None:
        return {}
    matched = _nearest(homography, spots, fiducials, HINT_TOLERANCE_PX)
    return _grow(matched, spots, fiducials) if len(matched) >= 4 else {}


def match_by_arrangement(
    spots: Sequence[Spot], fiducials: Sequence[Fiducial], *, shape: tuple[int, int]
) -> dict[str, Spot]:
    """Match spots to fiducials by their arrangement and sizes alone: the homography that the most discs agree with.

    Parameters
    ----------
    spots, fiducials
        What is seen and what is listed.
    shape
        (rows, columns) of the frame, whose middle the lens distorts around.

    Returns
    -------
    dict[str, Spot]
        By fiducial name.

    Raises
    ------
    MatchError
        Fewer than six discs agree, or two arrangements agree about as well (a symmetric plan).
    """
    if len(fiducials) < 6:
        raise MatchError(
            f"{len(fiducials)} fiducials cannot be told apart by their arrangement, which takes 6; give column_px,row_px for at least 4"
        )
    tried = list(spots)[:LARGEST_ARRANGEMENT]
    if len(tried) < 6:
        raise MatchError(
            f"only {len(tried)} disc-shaped spots are seen where {len(fiducials)} fiducials are listed; "
            "give column_px,row_px, or a frame with more contrast"
        )
    solutions: dict[tuple[tuple[str, Spot], ...], float] = {}
    for quad in _spread_quads(fiducials)[:8]:
        for homography in _candidates(quad, tried, fiducials):
            matched = _grow(_nearest(homography, tried, fiducials, ARRANGEMENT_TOLERANCE_PX), tried, fiducials)
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
    (first, misfit), rivals = ranked[0], [item for item in ranked[1:] if len(item[0]) == len(ranked[0][0])]
    if rivals and rivals[0][1] < 2 * max(misfit, 0.05):
        raise MatchError(
            "the arrangement of the fiducials is symmetric and fits in two ways; give column_px,row_px for at least 4"
        )
    return dict(first)


def _spread_quads(fiducials: Sequence[Fiducial]) -> list[tuple[int, ...]]:
    """Quadruples of fiducials in the order of the area that they span, no three of them near a line."""
    plan = np.array([(disc.x_mm, disc.y_mm) for disc in fiducials])
    quads = []
    for quad in combinations(range(len(fiducials)), 4):
        areas = [_twice_area(plan[list(three)]) for three in combinations(quad, 3)]
        quads.append((min(areas), quad))
    return [quad for _, quad in sorted(quads, reverse=True)]


def _candidates(quad: tuple[int, ...], spots: Sequence[Spot], fiducials: Sequence[Fiducial]) -> list[Array]:
    """Homographies that put the quad on four spots, keep its handedness throughout, and are supported by the most others."""
    plan = np.array([(disc.x_mm, disc.y_mm) for disc in fiducials])
    image = np.array([(spot.column_px, spot.row_px) for spot in spots])
    chosen = np.array(list(permutations(range(len(spots)), 4)))
    turns = np.stack([_signed(plan[list(quad)], three) for three in combinations(range(4), 3)])
    seen = np.stack([_signed(image[chosen], three) for three in combinations(range(4), 3)], axis=-1)
    same = (np.sign(seen) == np.sign(turns)).all(axis=1)
    mirrored = (np.sign(seen) == -np.sign(turns)).all(axis=1)
    chosen = chosen[same | mirrored]
    matrices = _homographies(plan[list(quad)], image[chosen])
    projected = np.einsum("kij,nj->kni", matrices, np.column_stack([plan, np.ones(len(plan))]))
    with np.errstate(divide="ignore", invalid="ignore"):
        places = projected[..., :2] / projected[..., 2:]
    scale = projected[..., 2]
    in_front = (np.sign(scale) == np.sign(scale[:, :1])).all(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        expected = (
            np.pi
            / 4
            * np.array([disc.diameter_mm**2 for disc in fiducials])
            * np.abs(np.linalg.det(matrices)[:, None] / scale**3)
        )
    areas = np.array([spot.area_px for spot in spots])
    support = np.zeros(len(matrices))
    # In slices, because all distances of all hypotheses at once would take gigabytes. The size of the disc is part of the
    # evidence: without it a homography that shrinks the plan to one spot is supported by every disc.
    for start in range(0, len(matrices), 4096):
        part = slice(start, start + 4096)
        distance = np.linalg.norm(places[part, :, None, :] - image[None, None, :, :], axis=-1)
        fits = np.abs(np.log(areas / expected[part, :, None])) < np.log(2)
        support[part] = (
            1 - np.minimum(np.where(fits, distance, np.inf) / ARRANGEMENT_TOLERANCE_PX, 1).min(axis=2)
        ).sum(axis=1)
    support[~in_front] = 0
    order = np.argsort(-support)[:24]
    return [matrices[i] for i in order if support[i] > 0]


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
    """Refit the homography to what is matched and match again, until nothing changes."""
    for _ in range(6):
        if len(matched) < 4:
            break
        plan, image = _pairs(matched, fiducials)
        homography, kept = cv2.findHomography(plan, image, cv2.RANSAC, ARRANGEMENT_TOLERANCE_PX / 2)
        if homography is None or kept.sum() < 4:
            break
        again = _nearest(homography, spots, fiducials, ARRANGEMENT_TOLERANCE_PX)
        if again == matched:
            break
        matched = again
    return matched


def _misfit(matched: dict[str, Spot], fiducials: Sequence[Fiducial], shape: tuple[int, int]) -> float:
    """Rms distance in px between the matched spots and a plane seen through a lens, one misplaced disc allowed for."""
    plan, image = _pairs(matched, fiducials)
    ideal = Projection(np.eye(3), np.zeros(4), float(shape[1]), ((shape[1] - 1) / 2, (shape[0] - 1) / 2))
    seen = Sightings(image, plan, np.ones(len(plan)), np.ones(len(plan)))
    distance = _distances(seen, ideal)
    if len(plan) > 6:
        distance = _distances(seen.without(int(np.argmax(distance))), ideal)
    return float(np.sqrt(np.mean(distance**2)))


def _distances(seen: Sightings, ideal: Projection) -> Array:
    try:
        projection = fit_projection(seen, fit_homography(seen, ideal), 1 if len(seen.u_px) >= 7 else 0)
    except ValueError:
        return np.full(len(seen.u_px), np.inf)
    distances: Array = np.linalg.norm(projection.to_sensor(seen.centres_mm) - seen.points_px, axis=1)
    return distances


def _pairs(matched: dict[str, Spot], fiducials: Sequence[Fiducial]) -> tuple[Array, Array]:
    known = [disc for disc in fiducials if disc.name in matched]
    plan = np.array([(disc.x_mm, disc.y_mm) for disc in known], float)
    return plan, np.array([(matched[disc.name].column_px, matched[disc.name].row_px) for disc in known])


def _signed(points: Array, three: tuple[int, ...]) -> Array:
    a, b, c = (points[..., i, :] for i in three)
    signed: Array = (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (
        c[..., 0] - a[..., 0]
    )
    return signed


def _twice_area(triangle: Array) -> float:
    return abs(float(_signed(triangle, (0, 1, 2))))
