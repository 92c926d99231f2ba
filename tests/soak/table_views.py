"""Views of a painted table of 500 mm x 300 mm through a pinhole camera with lens distortion, for the registration's error rates.

Shares no code with the registration but the list of fiducials and OpenCV's names for the coefficients of the lens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from thermography.registration.plan import Fiducial, PlanGrid

GRID = PlanGrid(500, 300, 10)
#: Irregular places of twelve discs of 14 mm, mm.
PLACES = (
    (32, 28), (171, 41), (318, 24), (463, 36), (47, 148), (151, 187),
    (262, 122), (371, 171), (470, 141), (29, 262), (226, 271), (448, 268),
)  # fmt: skip
DISCS = tuple(Fiducial(f"F{i}", x, y, 14.0) for i, (x, y) in enumerate(PLACES, 1))
#: Points per side of a pixel for the coverage of a disc, and of everything else.
_FINE, _COARSE = 8, 2


@dataclass(frozen=True)
class View:
    """A camera above the table.

    Attributes
    ----------
    turn : (3, 3) ndarray
        Rotation from the plan to the camera.
    shift_mm : (3,) ndarray, mm
        Plan origin in the camera's system.
    focal_px : float, px
    lens : (4,) ndarray
        k1, k2, p1, p2.
    shape : (int, int)
        Rows and columns.
    off_px : (float, float)
        Principal point from the middle of the frame.
    """

    turn: np.ndarray
    shift_mm: np.ndarray
    focal_px: float
    lens: np.ndarray
    shape: tuple[int, int]
    off_px: tuple[float, float] = (0.0, 0.0)

    @property
    def matrix(self) -> np.ndarray:
        column, row = (np.array(self.shape[::-1]) - 1) / 2 + self.off_px
        return np.array([[self.focal_px, 0, column], [0, self.focal_px, row], [0, 0, 1]])

    def to_sensor(self, points_mm: np.ndarray) -> np.ndarray:
        """Project plan points (n, 2) mm to pixels (n, 2)."""
        rotation, _ = cv2.Rodrigues(self.turn)
        space = np.column_stack([points_mm, np.zeros(len(points_mm))])
        pixels, _ = cv2.projectPoints(space, rotation, self.shift_mm, self.matrix, self.lens)
        return pixels[:, 0]

    def to_plan(self, points_px: np.ndarray) -> np.ndarray:
        """Locate pixels (n, 2) on the plan, (n, 2) mm."""
        return self.meets_plan(self.rays(points_px))

    def rays(self, points_px: np.ndarray) -> np.ndarray:
        """Directions of pixels (n, 2) in the camera's system, (n, 2) per unit of depth."""
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-9)
        pixels = np.ascontiguousarray(points_px, float).reshape(-1, 1, 2)
        return cv2.undistortPoints(pixels, self.matrix, self.lens, None, None, np.eye(3), criteria)[:, 0]

    def meets_plan(self, rays: np.ndarray) -> np.ndarray:
        """Where directions (n, 2) meet the plan, (n, 2) mm."""
        plane = np.column_stack([self.turn[:, 0], self.turn[:, 1], self.shift_mm])
        x, y, depth = np.linalg.inv(plane) @ np.vstack([rays.T, np.ones(len(rays))])
        return np.stack([x / depth, y / depth], axis=1)

    def in_view(self, points_mm: np.ndarray) -> np.ndarray:
        """Plan points (n, 2) that the frame shows, (m, 2)."""
        pixels = self.to_sensor(points_mm)
        inside = (pixels >= 0).all(axis=1) & (pixels <= np.array(self.shape[::-1]) - 1.0).all(axis=1)
        return points_mm[inside]


def draw_view(
    rng: np.random.Generator,
    *,
    tilt_deg: float = 8.0,
    mm_per_px: tuple[float, float] = (0.85, 1.0),
    focal_px: float = 900.0,
    lens: Sequence[float] | None = None,
    shape: tuple[int, int] = (480, 640),
    centre_mm: tuple[float, float] = (250.0, 150.0),
) -> View:
    """Draw a camera at random: tilt up to `tilt_deg` about any axis, any roll within 10 degrees, and a lens unless given, as calibrations
    find them: k1 from -0.25 to 0.1, k2 up to twice its square, principal point off by 1 % of the width, decentred by 5e-4.
    """
    azimuth, roll = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(-10, 10))
    tilt = np.deg2rad(tilt_deg) * (1.0 if tilt_deg > 15 else rng.uniform(0, 1))
    turn, _ = cv2.Rodrigues(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))
    spin, _ = cv2.Rodrigues(np.array([0.0, 0.0, roll]))
    turn = turn @ spin
    distance = focal_px * rng.uniform(*mm_per_px) * (1 + 0.25 * np.sin(tilt))
    aim = np.array(centre_mm) + rng.uniform(-6, 6, 2)
    shift = np.array([0.0, 0.0, distance]) - turn @ np.array([*aim, 0.0])
    if lens is not None:
        return View(turn, shift, focal_px, np.array(lens, float), shape)
    k1 = rng.uniform(-0.25, 0.1)
    coefficients = np.array([k1, rng.uniform(0, 2) * k1**2, *rng.normal(0, 5e-4, 2)])
    column, row = rng.normal(0, 0.01 * shape[1], 2)
    return View(turn, shift, focal_px, coefficients, shape, (column, row))


@dataclass(frozen=True)
class Table:
    """What lies in view: painted discs, a thermal field, and clutter beside and on the table.

    Attributes
    ----------
    discs : tuple of Fiducial
        As painted.
    contrast_K : float or tuple of float, K
        Of all discs, or of each.
    gradient : float
        Factor on the slope of the field.
    covered : tuple of str
        Discs of which a strip along one side is hidden at the table's temperature.
    blur_px : float
        Width of the lens's Gaussian blur.
    spots : tuple of (x, y, diameter, contrast)
        Further round spots on the table, mm and K.
    bars : bool
        Clamps on the table and objects beside it.
    """

    discs: tuple[Fiducial, ...] = DISCS
    contrast_K: float | tuple[float, ...] = -3.0
    gradient: float = 1.0
    covered: tuple[str, ...] = ()
    blur_px: float = 0.7
    spots: tuple[tuple[float, float, float, float], ...] = ()
    bars: bool = True

    def render(self, view: View, rng: np.random.Generator) -> np.ndarray:
        """Noise-free frame in degC, (row, column)."""
        rows, columns = view.shape
        offsets = (np.arange(_COARSE) + 0.5) / _COARSE - 0.5
        column, row = np.meshgrid(
            (np.arange(columns)[:, None] + offsets).ravel(), (np.arange(rows)[:, None] + offsets).ravel()
        )
        x, y = view.to_plan(np.stack([column, row], axis=-1).reshape(-1, 2)).T
        on_table = (x >= 0) & (x <= GRID.width_mm) & (y >= 0) & (y <= GRID.height_mm)
        field = self.field(x, y)
        if self.bars:
            for _ in range(3):
                left, top, angle = rng.uniform(60, 440), rng.uniform(60, 240), rng.uniform(0, np.pi)
                along = (x - left) * np.cos(angle) + (y - top) * np.sin(angle)
                aside = (y - top) * np.cos(angle) - (x - left) * np.sin(angle)
                bar = (np.abs(along) < rng.uniform(15, 40)) & (np.abs(aside) < rng.uniform(2, 5))
                clear = min(np.hypot(left - px, top - py) for px, py in PLACES) > 55
                field = np.where(bar & clear, field + rng.uniform(-2, 3), field)
        room = np.full_like(x, 21.0)
        if self.bars:
            for _ in range(8):
                place, size = rng.uniform((-90, -90), (590, 390)), rng.uniform(8, 40, 2)
                thing = (np.abs(x - place[0]) < size[0]) & (np.abs(y - place[1]) < size[1])
                room = np.where(thing, 21.0 + rng.uniform(-2, 6), room)
        image = np.where(on_table, field, room).reshape(rows, _COARSE, columns, _COARSE).mean(axis=(1, 3))
        contrasts = np.broadcast_to(np.asarray(self.contrast_K, float), len(self.discs))
        for disc, contrast in zip(self.discs, contrasts, strict=True):
            image = _painted(image, view, disc.x_mm, disc.y_mm, disc.diameter_mm, contrast, disc.name in self.covered)
        for x_mm, y_mm, diameter_mm, contrast in self.spots:
            image = _painted(image, view, x_mm, y_mm, diameter_mm, contrast, False)
        return cv2.GaussianBlur(image, (0, 0), self.blur_px)

    def field(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Temperature of the table, degC: slopes and a warm zone of 70 mm."""
        warm = 2.0 * np.exp(-((x - 330) ** 2 + (y - 110) ** 2) / (2 * 70.0**2))
        return 24.0 + self.gradient * (0.003 * x - 0.002 * y + warm)


def _painted(
    image: np.ndarray, view: View, x_mm: float, y_mm: float, diameter_mm: float, contrast_K: float, half: bool
) -> np.ndarray:
    """The image with one disc, of which a half is hidden where `half`."""
    angle = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    radius = diameter_mm / 2
    rim = view.to_sensor(np.column_stack([x_mm + radius * np.cos(angle), y_mm + radius * np.sin(angle)]))
    low = np.maximum(np.floor(rim.min(axis=0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(rim.max(axis=0)).astype(int) + 2, np.array(view.shape[::-1]))
    if (high <= low).any():
        return image
    offsets = (np.arange(_FINE) + 0.5) / _FINE - 0.5
    column, row = np.meshgrid(
        (np.arange(low[0], high[0])[:, None] + offsets).ravel(), (np.arange(low[1], high[1])[:, None] + offsets).ravel()
    )
    x, y = view.to_plan(np.stack([column, row], axis=-1).reshape(-1, 2)).T
    inside = (np.hypot(x - x_mm, y - y_mm) < radius) & ((x > x_mm) | (not half))
    share = inside.reshape(high[1] - low[1], _FINE, high[0] - low[0], _FINE).mean(axis=(1, 3))
    image = image.copy()
    image[low[1] : high[1], low[0] : high[0]] += contrast_K * share
    return image


def hinted(view: View, listed: Sequence[Fiducial], rng: np.random.Generator, error_px: float = 10.0) -> list[Fiducial]:
    """The list with pixel places read off a screen, wrong by up to `error_px`."""
    places = view.to_sensor(np.array([(disc.x_mm, disc.y_mm) for disc in DISCS]))
    by_name = dict(zip((disc.name for disc in DISCS), places, strict=True))
    with_hints = []
    for disc in listed:
        column, row = by_name[disc.name] + rng.uniform(-error_px, error_px, 2)
        with_hints.append(replace(disc, column_px=float(column), row_px=float(row)))
    return with_hints
