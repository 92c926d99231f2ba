"""Shapes along the axis that a drift may have by name, and the share of each in a reading."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from interferometry._typing import Array

#: Share of a drift component in a reading, by its sign of approach (+1, -1) and its place (0 first position, 1 last).
COMPONENTS = {
    "shift": lambda sign, place: np.ones(place.size),
    "stretch": lambda sign, place: place,
    "reversal": lambda sign, place: sign / 2.0,
    "bend": lambda sign, place: 4.0 * place * (1.0 - place),
}
BASE_COMPONENTS = ("shift", "stretch")


def component_loadings(
    sign: Array, position_mm: Array, *, components: Sequence[str], span_mm: tuple[float, float]
) -> Array:
    """Return the share of each drift component in readings of a direction at a position.

    Parameters
    ----------
    sign : (n,) ndarray
        +1 positive, -1 negative approach.
    position_mm : (n,) ndarray
        Target positions, mm.
    components : sequence of str
        Names out of COMPONENTS.
    span_mm : (float, float)
        First and last position of the test, mm: a stretch is 0 at the first and 1 at the last.

    Returns
    -------
    (n, components) ndarray
        Shares (1): shift 1, stretch 0 to 1, reversal +1/2 and -1/2, bend a parabola of height 1 in the middle.
    """
    place = (np.asarray(position_mm, float) - span_mm[0]) / (span_mm[1] - span_mm[0])
    return np.column_stack([COMPONENTS[name](np.asarray(sign, float), place) for name in components])
