"""The simulated camera: pinhole and lens, discs of low emissivity, forward radiometry, noise and counts.

The forward formula is the measurement equation of the vendor (FLIR user's manuals, "measurement formula"), implemented independently
of the analysis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.common import Array
from fusion.twin.effects import EFFECTS
from fusion.twin.machine import stream
from fusion.twin.recipe import Camera, Plan, Recipe
from fusion.twin.simulate import Truth

Image = NDArray[np.float32]
KELVIN = 273.15
#: Planck and atmospheric constants of the camera model, as its sample files store them.
SC660 = {
    "planck_r1": 21106.77,
    "planck_b": 1501.0,
    "planck_f": 1.0,
    "planck_o": -7340.0,
    "planck_r2": 0.012545258,
    "atmosphere_alpha1": 0.006569,
    "atmosphere_alpha2": 0.012620,
    "atmosphere_beta1": -0.002276,
    "atmosphere_beta2": -0.006670,
    "atmosphere_x": 1.9,
}
#: A pixel at an edge is the mean over the square of this number of points.
SUBSAMPLES = 8
#: Range of the counts that bad pixels show.
BAD_COUNTS = (12000, 30000)
#: Step of the grid on which the temperature field is evaluated before it is interpolated to the pixels.
FIELD_STEP_MM = 1.0
#: Emissivity of the room's surfaces around the table.
SURROUND_EMISSIVITY = 0.95


def counts_of(temperature_degC: Array | Image | float) -> Array:
    """Return the detector counts of a black body, R1 / (R2 (exp(B / T) - F)) - O."""
    kelvin = np.asarray(temperature_degC) + KELVIN
    r1, b, f, o, r2 = (SC660[f"planck_{name}"] for name in ("r1", "b", "f", "o", "r2"))
    return np.asarray(r1 / (r2 * (np.exp(b / kelvin) - f)) - o)


def air_transmission(distance_m: float, temperature_degC: float, humidity: float) -> float:
    """Return the transmission of the air in the optical path by the vendor's atmospheric model."""
    t = temperature_degC
    water = np.sqrt(humidity * np.exp(1.5587 + 0.06939 * t - 0.00027816 * t**2 + 0.00000068455 * t**3))
    k, root = SC660, np.sqrt(distance_m)
    first = np.exp(-root * (k["atmosphere_alpha1"] + k["atmosphere_beta1"] * water))
    second = np.exp(-root * (k["atmosphere_alpha2"] + k["atmosphere_beta2"] * water))
    return float(k["atmosphere_x"] * first + (1.0 - k["atmosphere_x"]) * second)


@dataclass(frozen=True)
class View:
    """Projection of the table's plane to the sensor: pinhole homography from plan mm to ideal pixels (column, row), and radial distortion.

    About the principal point, r is imaged at r (1 + k1 r^2), r in units of the focal length.
    """

    homography: Array
    focal_px: float
    k1: float
    centre_px: tuple[float, float]

    def to_sensor(self, points_mm: Array) -> Array:
        """Return the pixels (n, 2) = (column, row) of points (n, 2) on the plane, mm."""
        points = np.asarray(points_mm, dtype=float)
        ideal = np.column_stack([points, np.ones(len(points))]) @ self.homography.T
        normal = (ideal[:, :2] / ideal[:, 2:] - self.centre_px) / self.focal_px
        factor = 1.0 + self.k1 * np.sum(normal**2, axis=1, keepdims=True)
        return np.asarray(normal * factor * self.focal_px + self.centre_px)

    def to_plan(self, points_px: Array) -> Array:
        """Return the points (n, 2) on the plane, mm, imaged at pixels (n, 2); the distortion is inverted by Newton's method."""
        normal = (np.asarray(points_px, dtype=float) - self.centre_px) / self.focal_px
        radius = np.hypot(normal[:, 0], normal[:, 1])
        ideal = radius.copy()
        for _ in range(6):
            ideal -= (ideal * (1.0 + self.k1 * ideal**2) - radius) / (1.0 + 3.0 * self.k1 * ideal**2)
        scale = np.divide(ideal, radius, out=np.ones_like(radius), where=radius > 0)
        seen = np.column_stack([normal * scale[:, None] * self.focal_px + self.centre_px, np.ones(len(normal))])
        points = seen @ np.linalg.inv(self.homography).T
        return np.asarray(points[:, :2] / points[:, 2:])

    def shifted(self, columns: float, rows: float) -> View:
        """Return the view of a displaced camera: everything is imaged some pixels away."""
        move = np.array([[1.0, 0.0, columns], [0.0, 1.0, rows], [0.0, 0.0, 1.0]])
        centre = (self.centre_px[0] + columns, self.centre_px[1] + rows)
        return View(move @ self.homography, self.focal_px, self.k1, centre)


def make_view(camera: Camera) -> View:
    """Return the view of a camera from its pose and lens."""
    tilt, pan, roll = np.deg2rad([camera.tilt_deg, camera.pan_deg, camera.roll_deg])
    about_x = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    about_y = np.array([[np.cos(pan), 0, np.sin(pan)], [0, 1, 0], [-np.sin(pan), 0, np.cos(pan)]])
    about_z = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    turn = about_z @ about_y @ about_x
    shift = np.array([0.0, 0.0, camera.distance_mm]) - turn @ np.array([*camera.centre_mm, 0.0])
    centre = ((camera.columns - 1) / 2.0, (camera.rows - 1) / 2.0)
    inner = np.array([[camera.focal_px, 0.0, centre[0]], [0.0, camera.focal_px, centre[1]], [0.0, 0.0, 1.0]])
    homography = inner @ np.column_stack([turn[:, 0], turn[:, 1], shift])
    return View(homography / homography[2, 2], camera.focal_px, camera.k1, centre)


def fiducial_points(plan: Plan) -> Array:
    """Return the centres of the disc fiducials."""
    return np.column_stack([plan.fiducials_x_mm, plan.fiducials_y_mm]).astype(float)


def reflected_spot(recipe: Recipe, x_mm: Array, y_mm: Array) -> Array:
    """Return the spot in which the paint of the table reflects a warm body, as a weight of 1 at its centre."""
    given = [effect.parameters for effect in recipe.effect if effect.name == "reflected_source"]
    spot = EFFECTS["reflected_source"].parameters | (given[0] if given else {})
    return np.exp(-0.5 * ((x_mm - spot["x_mm"]) ** 2 + (y_mm - spot["y_mm"]) ** 2) / spot["spread_mm"] ** 2)


@dataclass(frozen=True)
class Scene:
    """What every pixel sees at one position of the table: shares 0..1 of table and discs, the surroundings fill the rest.

    ``column_of_field`` and ``row_of_field`` are the place of the pixel on the temperature field of step `FIELD_STEP_MM`.
    """

    table: Image
    disc: Image
    column_of_field: Image
    row_of_field: Image


class Renderer:
    """Renders the frames of one campaign; the scene is kept for as long as the table stands still.

    Parameters
    ----------
    truth : Truth
        The campaign, from :func:`fusion.twin.simulate.simulate`.
    """

    def __init__(self, truth: Truth) -> None:
        self.truth = truth
        self.camera = truth.recipe.camera
        self.plan = truth.recipe.plan
        self.view = make_view(self.camera)
        self.knocked_view = self.view.shifted(*self.camera.knock_px)
        self.x_mm = np.arange(0.0, self.plan.width_mm + FIELD_STEP_MM, FIELD_STEP_MM, dtype=float)
        self.y_mm = np.arange(0.0, self.plan.height_mm + FIELD_STEP_MM, FIELD_STEP_MM, dtype=float)
        self.noise = stream(truth.recipe.campaign.seed, "detector")
        shape = (self.camera.rows, self.camera.columns)
        self.counts_per_K = float(counts_of(25.5) - counts_of(24.5))
        pattern = stream(truth.recipe.campaign.seed, "fixed pattern").standard_normal(shape)
        self.pattern = (self.camera.fixed_pattern_K * self.counts_per_K * pattern).astype(np.float32)
        bad = stream(truth.recipe.campaign.seed, "bad pixels")
        self.bad_places = bad.choice(pattern.size, self.camera.bad_pixels, replace=False)
        self.bad_values = bad.integers(*BAD_COUNTS, self.camera.bad_pixels, dtype=np.uint16)
        self.transmission = air_transmission(
            self.camera.distance_mm * 1e-3, self.camera.atmospheric_temperature_degC, self.camera.relative_humidity
        )
        self._points_seen: dict[bool, Array] = {}
        self._steps: dict[bool, Sequence[Array]] = {}
        self._scene: tuple[tuple[float, bool], Scene] | None = None

    def scene(self, position_mm: float, knocked: bool) -> Scene:
        """Return what the pixels see with the table at an axis position, mm, before or after the displacement of the camera."""
        key = (float(position_mm), bool(knocked))
        if self._scene is None or self._scene[0] != key:
            self._scene = (key, self._make_scene(*key))
        return self._scene[1]

    def render(self, number: int) -> NDArray[np.uint16]:
        """Return the counts (row, column) of frame `number` (from 0); the temporal noise differs from call to call."""
        frame = self.truth.frames.isel(frame=number)
        scene = self.scene(float(frame["table_position"]), bool(frame["knocked"]))
        field = self.truth.temperature(np.array([float(frame["time_s"])]), self.x_mm, self.y_mm)[0].astype(np.float32)
        place = (scene.column_of_field, scene.row_of_field)
        surface = np.asarray(cv2.remap(field, *place, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)
        counts = self._radiance(surface, scene, frame)
        if self.camera.blur_px > 0:
            counts = np.asarray(cv2.GaussianBlur(counts, (0, 0), self.camera.blur_px), np.float32)
        noise = self.noise.standard_normal(counts.shape, dtype=np.float32)
        offset = np.float32(float(frame["camera_offset_K"]) * self.counts_per_K)
        counts += noise * np.float32(self.camera.netd_K * self.counts_per_K) + self.pattern + offset
        digital = np.asarray(np.clip(np.rint(counts), 0, 65535), dtype=np.uint16)
        digital.ravel()[self.bad_places] = self.bad_values
        return digital

    def _radiance(self, surface: Image, scene: Scene, frame: xr.Dataset) -> Image:
        """Return noiseless counts: what table, discs and surroundings emit and reflect, attenuated by the air, plus its emission."""
        camera = self.camera
        reflected = np.float32(counts_of(camera.reflected_temperature_degC))
        emitted = counts_of(surface).astype(np.float32)
        table = camera.emissivity * emitted + (1.0 - camera.emissivity) * reflected
        if float(frame["reflected_K"]) != 0.0:
            table += (1.0 - camera.emissivity) * self._spot(bool(frame["knocked"]), float(frame["reflected_K"]))
        disc = camera.disc_emissivity * emitted + (1.0 - camera.disc_emissivity) * reflected
        room = float(np.interp(float(frame["time_s"]), self.truth.session.grid_s, self.truth.session.air_degC))
        surround = SURROUND_EMISSIVITY * counts_of(room) + (1.0 - SURROUND_EMISSIVITY) * reflected
        leaving = surround + scene.table * (table - surround) + scene.disc * (disc - surround)
        air = (1.0 - self.transmission) * counts_of(camera.atmospheric_temperature_degC)
        return np.asarray(self.transmission * leaving + air, dtype=np.float32)

    def _spot(self, knocked: bool, reflected_K: float) -> Image:
        """Return the additional counts of a warm body that the table reflects in one part; fixed in the room, not on the table."""
        points = self._points_seen[knocked]
        weight = reflected_spot(self.truth.recipe, points[..., 0], points[..., 1])
        background = self.camera.reflected_temperature_degC
        return np.asarray(weight * float(counts_of(background + reflected_K) - counts_of(background)), dtype=np.float32)

    def _make_scene(self, position_mm: float, knocked: bool) -> Scene:
        """Cover every pixel: by its centre where it sees one thing only, by `SUBSAMPLES` squared points at the edges."""
        camera, plan = self.camera, self.plan
        view = self.knocked_view if knocked else self.view
        if knocked not in self._points_seen:
            pixels = np.stack(np.meshgrid(np.arange(camera.columns), np.arange(camera.rows)), axis=-1)
            self._points_seen[knocked] = view.to_plan(pixels.reshape(-1, 2)).reshape(camera.rows, camera.columns, 2)
            self._steps[knocked] = np.gradient(self._points_seen[knocked], axis=(1, 0))
        points = self._points_seen[knocked] + np.array(plan.direction) * position_mm
        to_border, to_disc = self._distances(points.reshape(-1, 2))
        per_column, per_row = (step.reshape(-1, 2) for step in self._steps[knocked])
        reach = 0.8 * float(np.abs(per_column).max())
        table = ((to_border > 0) & (to_disc < 0)).astype(np.float32)
        disc = ((to_border > 0) & (to_disc >= 0)).astype(np.float32)
        edge = np.flatnonzero(np.minimum(np.abs(to_border), np.abs(to_disc)) < reach)
        offsets = (np.arange(SUBSAMPLES) + 0.5) / SUBSAMPLES - 0.5
        right, down = (offset.reshape(1, -1, 1) for offset in np.meshgrid(offsets, offsets))
        fine = points.reshape(-1, 2)[edge, None] + per_column[edge, None] * right + per_row[edge, None] * down
        fine_border, fine_disc = self._distances(fine.reshape(-1, 2))
        table[edge] = ((fine_border > 0) & (fine_disc < 0)).reshape(edge.size, -1).mean(axis=1)
        disc[edge] = ((fine_border > 0) & (fine_disc >= 0)).reshape(edge.size, -1).mean(axis=1)
        shape = (camera.rows, camera.columns)
        size = np.array([plan.width_mm, plan.height_mm])
        place = (np.clip(points, 0.0, size) / FIELD_STEP_MM).astype(np.float32)
        return Scene(
            table=table.reshape(shape),
            disc=disc.reshape(shape),
            column_of_field=np.ascontiguousarray(place[..., 0]),
            row_of_field=np.ascontiguousarray(place[..., 1]),
        )

    def _distances(self, points_mm: Array) -> tuple[Array, Array]:
        """Return how far points (n, 2) lie inside the table's border and inside the nearest disc's rim, mm, negative outside."""
        x, y = np.ascontiguousarray(points_mm[:, 0]), np.ascontiguousarray(points_mm[:, 1])
        to_border = np.minimum(np.minimum(x, self.plan.width_mm - x), np.minimum(y, self.plan.height_mm - y))
        diameter = self.plan.fiducial_diameter_mm
        to_disc = np.full(len(points_mm), -diameter)
        for disc_x, disc_y in fiducial_points(self.plan):
            near = np.flatnonzero(np.abs(x - disc_x) < diameter)
            near = near[np.abs(y[near] - disc_y) < diameter]
            to_disc[near] = 0.5 * diameter - np.hypot(x[near] - disc_x, y[near] - disc_y)
        return to_border, to_disc
