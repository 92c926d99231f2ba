"""What speaks for a registration: more discs than chance would place, hints, sizes and places that agree with one plan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import comb, inf, log10

import cv2
import numpy as np

from thermography._typing import Array
from thermography.errors import ThermographyError
from thermography.registration.discs import LocatedDisc, Spot
from thermography.registration.plan import Fiducial
from thermography.registration.projection import Projection

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
#: Distance within which a spot belongs to a hint in `size_contradiction`, px.
_REACH_PX = 30.0


class RegistrationError(ThermographyError):
    """The table cannot be located in the frame; the message says which fiducials were located and what to do."""


def chance_of_arrangement(
    listed: int, spots: int, missed_px: Array, *, hypotheses: int, coefficients: int, area_px: float
) -> float:
    """Expected number of arrangements as good by chance, from spots that are scattered over the frame.

    Parameters
    ----------
    listed, spots : int
        Number of fiducials in the list, and of spots in the frame.
    missed_px : (k,) ndarray, px
        Distance by which each of the discs that agree is missed by the others.
    hypotheses : int
        Number of assignments that were tried.
    coefficients : int
        Number of fitted distortion coefficients: each two of them, as four discs for the homography, are no evidence.
    area_px : float
        Area of the frame.

    Returns
    -------
    float
        Infinite where no disc is left as evidence.

    Notes
    -----
    Number of false alarms of the a-contrario test of point matches (L. Moisan, B. Stival, Int. J. Comput. Vis. 57 (2004) 201-218).
    """
    agreeing = len(missed_px)
    free = agreeing - 4 - (coefficients + 1) // 2
    if free < 1 or not np.isfinite(missed_px).all():
        return inf
    single = min(1.0, spots * np.pi * float(missed_px.max()) ** 2 / area_px)
    return float(hypotheses) * comb(listed - 4, agreeing - 4) * single**free


def chance_of_hints(distances_px: Array, listed: int, spots: int, *, area_px: float) -> float:
    """Expected number of hints that have a spot as near by chance.

    Parameters
    ----------
    distances_px : (k,) ndarray, px
        Of the located discs from their hints.
    listed : int
        Number of fiducials with a hint.
    spots : int
        Number of spots of fitting size in the frame.
    area_px : float
        Area of the frame.

    Returns
    -------
    float
        Least over the nearest 4, 5, ... hints; infinite with fewer than four.
    """
    nearest = np.sort(distances_px)
    chances = [
        comb(listed, count) * min(1.0, spots * np.pi * max(float(nearest[count - 1]), 1.0) ** 2 / area_px) ** count
        for count in range(4, len(nearest) + 1)
    ]
    return min(chances, default=inf)


def refuse_chance(
    located: Mapping[str, LocatedDisc],
    listed: Sequence[Fiducial],
    spots: Sequence[Spot],
    missed_px: Array,
    *,
    hypotheses: int,
    coefficients: int,
    shape: tuple[int, int],
) -> None:
    """Refuse discs whose agreement with list or hints is no better than chance would have it.

    Parameters
    ----------
    located : mapping of str to LocatedDisc
        Discs that agree, by name.
    listed : sequence of Fiducial
        All of the plan.
    spots : sequence of Spot
        All of the frame.
    missed_px : (k,) ndarray, px
        Distance by which each of the located discs is missed by the others.
    hypotheses : int
        Number of assignments that were tried.
    coefficients : int
        Number of fitted distortion coefficients.
    shape : (int, int)
        (rows, columns) of the frame.

    Raises
    ------
    RegistrationError
        Neither the arrangement nor the hints prove the discs to be those of the plan.
    """
    area = float(shape[0] * shape[1])
    by_arrangement = chance_of_arrangement(
        len(listed), len(spots), missed_px, hypotheses=hypotheses, coefficients=coefficients, area_px=area
    )
    hinted = [disc for disc in listed if disc.hint_px is not None]
    distances = np.array([_from_hint(disc, located[disc.name]) for disc in hinted if disc.name in located])
    typical = float(np.median([place.area_px for place in located.values()]))
    fitting = sum(typical / 2 < spot.area_px < 2 * typical for spot in spots)
    by_hints = chance_of_hints(distances, len(hinted), fitting, area_px=area)
    if min(by_arrangement, by_hints) <= _LARGEST_CHANCE:
        return
    expected = min(by_arrangement, by_hints)
    chance = (
        "nothing else confirms them" if expected == inf else f"chance alone would do so 10^{log10(expected):.1f} times"
    )
    hints = (
        f"; {int((distances > WRONG_HINT_PX).sum())} of their {len(distances)} hints contradict them"
        if len(distances)
        else ""
    )
    raise RegistrationError(
        f"{len(located)} of {len(listed)} fiducials fit the spots in view, and {chance}{hints}; check that this is the list of "
        "this table, that all its discs are in view with contrast, and give column_px,row_px for at least 4"
    )


def refuse_scatter(scatter_mm: float, missed_mm: Mapping[str, float], fiducials: Sequence[Fiducial]) -> None:
    """Refuse discs whose places contradict one another by more than a list that was measured on them could.

    Parameters
    ----------
    scatter_mm : float, mm
        Standard deviation of the places along either coordinate, from the residuals of the fit.
    missed_mm : mapping of str to float, mm
        Distance by which each disc is missed by the others, by name, to name the worst.
    fiducials : sequence of Fiducial
        Those discs.

    Raises
    ------
    RegistrationError
        The scatter exceeds a tenth of the discs' diameter.
    """
    limit = _LARGEST_SCATTER * float(np.median([disc.diameter_mm for disc in fiducials]))
    if scatter_mm > limit:
        raise RegistrationError(
            f"the places of the fiducials contradict one another by {scatter_mm:.1f} mm (standard deviation; up to {limit:.1f} mm, a tenth "
            f"of their diameter, is measured amiss, more is another list): {_worst(missed_mm)}; check x_mm, y_mm of these and of their "
            "neighbours"
        )


def refuse_picks(scatter_px: float, missed_mm: Mapping[str, float]) -> None:
    """Refuse points picked by hand that contradict one another.

    Parameters
    ----------
    scatter_px : float, px
        Standard deviation of the picks along either coordinate, from the residuals of the fit.
    missed_mm : mapping of str to float, mm
        Distance by which each point is missed by the others, by name, to name the worst.

    Raises
    ------
    RegistrationError
        The scatter exceeds 3 px.
    """
    if scatter_px > _LARGEST_PICK_SCATTER_PX:
        raise RegistrationError(
            f"the picked points contradict one another by {scatter_px:.1f} px (standard deviation; a hand errs by 1 px): "
            f"{_worst(missed_mm)}; check their column_px, row_px and their x_mm, y_mm"
        )


def _worst(missed_mm: Mapping[str, float]) -> str:
    """The three points that the others miss by most, in words."""
    names = sorted(missed_mm, key=lambda name: -missed_mm[name])[:3]
    return ", ".join(f"{name} is missed by the others by {missed_mm[name]:.1f} mm" for name in names)


def refuse_sizes(ratio: float, fiducials: Sequence[Fiducial]) -> None:
    """Refuse a plan whose places say another scale than the diameters of its discs.

    Parameters
    ----------
    ratio : float
        `area_ratio` of the discs that agree.
    fiducials : sequence of Fiducial
        Those discs.

    Raises
    ------
    RegistrationError
        The ratio is beyond 1.3 or below its inverse.
    """
    if abs(np.log(ratio)) > np.log(_LARGEST_AREA_RATIO):
        raise RegistrationError(_size_message(float(np.sqrt(ratio)), fiducials))


def area_ratio(located: Mapping[str, LocatedDisc], fiducials: Sequence[Fiducial], projection: Projection) -> float:
    """Median ratio of the imaged to the listed area of the discs.

    Parameters
    ----------
    located : mapping of str to LocatedDisc
        Discs that agree, by name.
    fiducials : sequence of Fiducial
        Those discs.
    projection : Projection
        Fitted to their places.

    Returns
    -------
    float
        NaN for points without a disc.
    """
    if any(disc.is_point for disc in fiducials):
        return np.nan
    centres = np.array([(disc.x_mm, disc.y_mm) for disc in fiducials])
    listed_mm2 = np.pi / 4 * np.array([disc.diameter_mm**2 for disc in fiducials])
    listed_px = listed_mm2 * np.abs(np.linalg.det(projection.jacobian(centres)))
    return float(np.median([located[disc.name].area_px for disc in fiducials] / listed_px))


def size_contradiction(spots: Sequence[Spot], fiducials: Sequence[Fiducial]) -> str:
    """Why discs were not found where the hints point: spots of another size lie there.

    Parameters
    ----------
    spots : sequence of Spot
        All of the frame.
    fiducials : sequence of Fiducial
        Discs of the plan.

    Returns
    -------
    str
        Empty where the sizes agree or there are too few hints to tell.
    """
    hinted = [disc for disc in fiducials if disc.hint_px is not None]
    if len(hinted) < 4:
        return ""
    plan = np.array([(disc.x_mm, disc.y_mm) for disc in hinted])
    homography, _ = cv2.findHomography(plan, np.array([disc.hint_px for disc in hinted], float), cv2.RANSAC, _REACH_PX)
    if homography is None:
        return ""
    projection = Projection(homography, np.zeros(4), 1.0, (0.0, 0.0))
    magnification = np.abs(np.linalg.det(projection.jacobian(plan)))
    ratios = []
    for disc, scale in zip(hinted, magnification, strict=True):
        near = [(_from_hint(disc, spot), spot.area_px) for spot in spots]
        distance, area = min(near, default=(inf, 0.0))
        if distance < _REACH_PX:
            ratios.append(area / (np.pi / 4 * disc.diameter_mm**2 * scale))
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

    Parameters
    ----------
    located : mapping of str to LocatedDisc
        Discs that agree, by name.
    fiducials : sequence of Fiducial
        Those discs.

    Returns
    -------
    dict of str to str
        The reason by ``"name (hint)"``.
    """
    wrong = {}
    for disc in fiducials:
        if disc.hint_px is not None and (distance := _from_hint(disc, located[disc.name])) > WRONG_HINT_PX:
            wrong[f"{disc.name} (hint)"] = (
                f"the hint ({disc.hint_px[0]:g}, {disc.hint_px[1]:g}) px is {distance:.0f} px from the disc; it was not used"
            )
    return wrong


def _from_hint(disc: Fiducial, place: LocatedDisc | Spot) -> float:
    """Distance of a place in the frame from the hint of a disc, px."""
    assert disc.hint_px is not None
    return float(np.hypot(disc.hint_px[0] - place.column_px, disc.hint_px[1] - place.row_px))
