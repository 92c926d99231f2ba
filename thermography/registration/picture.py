"""The picture as the plan: where no place on the table is known in millimetres, lengths are counted in pixels of the frames."""

from __future__ import annotations

import math

import numpy as np

from thermography.errors import ThermographyError
from thermography.registration.plan import PlanGrid
from thermography.registration.projection import Projection
from thermography.registration.register import Registration

#: Name of this registration, in the place of a lens model.
PICTURE = "picture"
#: Largest number of cells along the longer side where no size of a cell is given: cells finer than a screen shows are only slow.
_MOST_CELLS = 160


def usual_cell_px(shape: tuple[int, int]) -> int:
    """Return the size of a cell where none is given, px.

    Parameters
    ----------
    shape : (int, int)
        (rows, columns) of the frames.

    Returns
    -------
    int
        The smallest that divides both sides and makes at most 160 cells along the longer one.

    Examples
    --------
    >>> usual_cell_px((480, 640)), usual_cell_px((96, 128)), usual_cell_px((768, 1024))
    (4, 1, 8)
    """
    sizes = _dividing(shape)
    return next((size for size in sizes if max(shape) <= _MOST_CELLS * size), sizes[-1])


def picture_grid(shape: tuple[int, int], cell_px: int | None = None) -> PlanGrid:
    """Return the grid of a plan that is the picture itself.

    Parameters
    ----------
    shape : (int, int)
        (rows, columns) of the frames.
    cell_px : int or None
        Side of a cell, px; None: `usual_cell_px`.

    Returns
    -------
    PlanGrid
        Its lengths are in px. The corner (0, 0) is the upper left corner of the picture, so that the centre of the first pixel lies at
        (0.5, 0.5); y runs downwards.

    Raises
    ------
    ThermographyError
        The cell does not divide both sides of the picture.
    """
    rows, columns = shape
    size = usual_cell_px(shape) if cell_px is None else cell_px
    if size not in _dividing(shape):
        choice = ", ".join(str(one) for one in _dividing(shape) if 2 * one <= min(shape))
        raise ThermographyError(
            f'cell_px = "{size} px" does not divide frames of {columns} x {rows} pixels; choose one of {choice} px'
        )
    return PlanGrid(columns, rows, size)


def register_picture(shape: tuple[int, int]) -> Registration:
    """Return the registration of a plan that is the picture itself.

    Parameters
    ----------
    shape : (int, int)
        (rows, columns) of the frames.

    Returns
    -------
    Registration
        Without fiducials; exact by definition, as nothing of the table is located: its plan is in px, see `picture_grid`, and it holds as
        long as neither camera nor table moves.
    """
    rows, columns = shape
    to_sensor = np.array([[1.0, 0.0, -0.5], [0.0, 1.0, -0.5], [0.0, 0.0, 1.0]])
    centre = ((columns - 1) / 2, (rows - 1) / 2)
    return Registration(
        homography=np.linalg.inv(to_sensor),
        distortion=np.zeros(4),
        model=PICTURE,
        projection=Projection(to_sensor, np.zeros(4), float(max(shape)), centre),
        fiducials={},
        located={},
        residual_mm={},
        leave_one_out_mm={},
        rms_mm=math.nan,
        scatter_mm=math.nan,
        scatter_px=math.nan,
        area_ratio=math.nan,
        unchecked=(),
        left_out={},
        masked=(),
        shape=shape,
        lens=None,
        covariance=np.zeros((8, 8)),
    )


def _dividing(shape: tuple[int, int]) -> list[int]:
    """Sizes of a cell that divide both sides."""
    common = math.gcd(*shape)
    return [size for size in range(1, common + 1) if common % size == 0]
