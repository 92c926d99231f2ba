"""The twin's camera: pinhole and lens, low-emissivity discs, its own forward radiometry, noise, counts.

The forward formula is the vendor's measurement equation (FLIR user's manuals, "measurement formula"), written here by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.twin.machine.effects import EFFECTS
from fusion.twin.machine.recipe import Camera, Plan
from fusion.twin.machine.streams import stream
from fusion.twin.simulate import Truth

Floats = NDArray[np.floating[Any]]
Image = NDArray[np.floating[Any]]
KELVIN = 273.15
#: Calibration of the camera model, as its sample files store it.
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
SUBSAMPLES = 8
#: A bad pixel shows one value between these for ever.
BAD_COUNTS = (12000, 30000)
FIELD_STEP_MM = 1.0
SURROUND_EMISSIVITY = 0.95


def counts_of(temperature_degC: Floats | Image | float) -> Floats:
    """Return the counts of a black body, R1 / (R2 (exp(B / T) - F)) - O."""
    kelvin = np.asarray(temperature_degC) + KELVIN
    return np.asarray(
        SC660["planck_r1"] / (SC660["planck_r2"] * (np.exp(SC660["planck_b"] / kelvin) - SC660["planck_f"]))
        - SC660["planck_o"]
    )


def air_transmission(distance_m: float, temperature_degC: float, humidity: float) -> float:
    """Return the transmission of the air over the whole path; humidity 0..1."""
    t = temperature_degC
    water = np.sqrt(humidity * np.exp(1.5587 + 0.06939 * t - 0.00027816 * t**2 + 0.00000068455 * t**3))
    k, root = SC660, np.sqrt(distance_m)
    first = np.exp(-root * (k["atmosphere_alpha1"] + k["atmosphere_beta1"] * water))
    second = np.exp(-root * (k["atmosphere_alpha2"] + k["atmosphere_beta2"] * water))
    return float(k["atmosphere_x"] * first + (1.0 - k["atmosphere_x"]) * second)


@dataclass(frozen=True)
class View:
    """How the camera sees the table's plane: pinhole `homography` (plan mm to ideal px), radial `k1` about `centre_px`."""

    homography: Floats
    focal_px: float
    k1: float
    centre_px: tuple[float, float]

    def to_sensor(self, points_mm: Floats) -> Floats:
        """Return the pixels (n, 2) = (column, row) of points (n, 2) on the plane, mm."""
        points = np.asarray(points_mm, dtype=float)
        ideal = np.column_stack([points, np.ones(len(points))]) @ self.homography.T
        normal = (ideal[:, :2] / ideal[:, 2:] - self.centre_px) / self.focal_px
        factor = 1.0 + self.k1 * np.sum(normal**2, axis=1, keepdims=True)
        return np.asarray(normal * factor * self.focal_px + self.centre_px)

    def to_plan(self, points_px: Floats) -> Floats:
        """Return the points (n, 2) on the plane, mm, that pixels (n, 2) look at; the lens is undone by Newton's method."""
        seen = (np.asarray(points_px, dtype=float) - self.centre_px) / self.focal_px
        radius = np.hypot(seen[:, 0], seen[:, 1])
        ideal = radius.copy()
        for _ in range(6):
            ideal -= (ideal * (1.0 + self.k1 * ideal**2) - radius) / (1.0 + 3.0 * self.k1 * ideal**2)
        scale = np.divide(ideal, radius, out=np.ones_like(radius), where=radius > 0)
        points = (
            np.column_stack([seen * scale[:, None] * self.focal_px + self.centre_px, np.ones(len(seen))])
            @ np.linalg.inv(self.homography).T
        )
        return np.asarray(points[:, :2] / points[:, 2:])

    def shifted(self, columns: float, rows: float) -> View:
        """Return the view of a camera that was knocked: everything lands some pixels away."""
        move = np.array([[1.0, 0.0, columns], [0.0, 1.0, rows], [0.0, 0.0, 1.0]])
        centre = (self.centre_px[0] + columns, self.centre_px[1] + rows)
        return View(move @ self.homography, self.focal_px, self.k1, centre)


def make_view(camera: Camera) -> View:
    """Return the view of a camera at `distance_mm` from `centre_mm`, tilted, panned and rolled."""
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


def fiducial_points(plan: Plan) -> Floats:
    """Return the disc centres (n, 2) on the plan, mm."""
    return np.column_stack([plan.fiducials_x_mm, plan.fiducials_y_mm]).astype(float)


@dataclass(frozen=True)
class Scene:
    """What every pixel looks at for one place of the table: coverage by table and discs (0..1), and where on the fine field."""

    table: Image
    disc: Image
    column_of_field: Image
    row_of_field: Image


class Renderer:
    """Renders frames of one campaign; scenes and the reflected spot are kept for as long as the table stands still.

    Parameters
    ----------
    truth : Truth
        The campaign.
    """

    def __init__(self, truth: Truth) -> None:
        self.truth = truth
        self.camera = truth.recipe.camera
        self.plan = truth.recipe.plan
        self.view = make_view(self.camera)
        self.knocked_view = self.view.shifted(*self.camera.knock_px)
        self.x_mm = np.arange(0.0, self.plan.width_mm + FIELD_STEP_MM, FIELD_STEP_MM)
        self.y_mm = np.arange(0.0, self.plan.height_mm + FIELD_STEP_MM, FIELD_STEP_MM)
        self.noise = stream(truth.recipe.campaign.seed, "detector")
        shape = (self.camera.rows, self.camera.columns)
        self.slope = float(counts_of(25.5) - counts_of(24.5))
        pattern = stream(truth.recipe.campaign.seed, "fixed pattern").standard_normal(shape)
        self.pattern = (self.camera.fixed_pattern_K * self.slope * pattern).astype(np.float32)
        bad = stream(truth.recipe.campaign.seed, "bad pixels")
        self.bad_places = bad.choice(pattern.size, self.camera.bad_pixels, replace=False)
        self.bad_values = bad.integers(*BAD_COUNTS, self.camera.bad_pixels, dtype=np.uint16)
        self.transmission = air_transmission(
            self.camera.distance_mm * 1e-3, self.camera.atmospheric_temperature_degC, self.camera.relative_humidity
        )
        self._looks_at: dict[bool, Floats] = {}
        self._steps: dict[bool, Sequence[Floats]] = {}
        self._scene: tuple[tuple[float, bool], Scene] | None = None

    def scene(self, position_mm: float, knocked: bool) -> Scene:
        """Return what the pixels look at with the table at an axis position; coverage by `SUBSAMPLES` squared points per pixel."""
        key = (float(position_mm), bool(knocked))
        if self._scene is None or self._scene[0] != key:
            self._scene = (key, self._make_scene(*key))
        return self._scene[1]

    def render(self, number: int) -> NDArray[np.uint16]:
        """Return the counts (row, column) of frame `number` (from 0)."""
        frame = self.truth.frames.isel(frame=number)
        scene = self.scene(float(frame["table_position"]), bool(frame["knocked"]))
        field = self.truth.temperature(np.array([float(frame["time_s"])]), self.x_mm, self.y_mm)[0].astype(np.float32)
        where = (scene.column_of_field, scene.row_of_field)
        surface = np.asarray(cv2.remap(field, *where, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)
        counts = self._radiance(surface, scene, frame)
        if self.camera.blur_px > 0:
            counts = np.asarray(cv2.GaussianBlur(counts, (0, 0), self.camera.blur_px), np.float32)
        noise = self.noise.standard_normal(counts.shape, dtype=np.float32) * np.float32(self.camera.netd_K * self.slope)
        counts += noise + self.pattern + np.float32(float(frame["camera_offset_K"]) * self.slope)
        digital = np.asarray(np.clip(np.rint(counts), 0, 65535), dtype=np.uint16)
        digital.ravel()[self.bad_places] = self.bad_values
        return digital

    def _radiance(self, surface: Image, scene: Scene, frame: xr.Dataset) -> Image:
        """Return noiseless counts: table, discs and surround each send what they emit and mirror, through the air."""
        camera = self.camera
        mirrored = np.float32(counts_of(camera.reflected_temperature_degC))
        own = counts_of(surface).astype(np.float32)
        table = camera.emissivity * own + (1.0 - camera.emissivity) * mirrored
        if float(frame["reflected_K"]) != 0.0:
            table += (1.0 - camera.emissivity) * self._spot(bool(frame["knocked"]), float(frame["reflected_K"]))
        disc = camera.disc_emissivity * own + (1.0 - camera.disc_emissivity) * mirrored
        room = float(np.interp(float(frame["time_s"]), self.truth.session.grid_s, self.truth.session.air_degC))
        surround = SURROUND_EMISSIVITY * counts_of(room) + (1.0 - SURROUND_EMISSIVITY) * mirrored
        leaving = surround + scene.table * (table - surround) + scene.disc * (disc - surround)
        through = self.transmission * leaving + (1.0 - self.transmission) * counts_of(
            camera.atmospheric_temperature_degC
        )
        return np.asarray(through, dtype=np.float32)

    def _spot(self, knocked: bool, reflected_K: float) -> Image:
        """Return the additional counts of a warm body that mirrors in a part of the table; fixed in the room, not on the table."""
        recipe = self.truth.recipe
        spot = (
            EFFECTS["reflected_source"].parameters
            | next(e for e in recipe.effect if e.name == "reflected_source").parameters
        )
        x_mm, y_mm = self._looks_at[knocked][..., 0], self._looks_at[knocked][..., 1]
        weight = np.exp(-0.5 * ((x_mm - spot["x_mm"]) ** 2 + (y_mm - spot["y_mm"]) ** 2) / spot["spread_mm"] ** 2)
        background = self.camera.reflected_temperature_degC
        return np.asarray(weight * float(counts_of(background + reflected_K) - counts_of(background)), dtype=np.float32)

    def _make_scene(self, position_mm: float, knocked: bool) -> Scene:
        """Cover every pixel: by its centre where it lies wholly on one thing, by `SUBSAMPLES` squared points at the edges."""
        camera, plan = self.camera, self.plan
        view = self.knocked_view if knocked else self.view
        moved = np.array(plan.direction) * position_mm
        if knocked not in self._looks_at:
            pixels = np.stack(np.meshgrid(np.arange(camera.columns), np.arange(camera.rows)), axis=-1)
            self._looks_at[knocked] = view.to_plan(pixels.reshape(-1, 2)).reshape(camera.rows, camera.columns, 2)
            self._steps[knocked] = np.gradient(self._looks_at[knocked], axis=(1, 0))
        at = self._looks_at[knocked] + moved
        to_border, to_disc = self._distances(at.reshape(-1, 2))
        per_column, per_row = (step.reshape(-1, 2) for step in self._steps[knocked])
        reach = 0.8 * float(np.abs(per_column).max())
        table = ((to_border > 0) & (to_disc < 0)).astype(np.float32)
        disc = ((to_border > 0) & (to_disc >= 0)).astype(np.float32)
        edge = np.flatnonzero(np.minimum(np.abs(to_border), np.abs(to_disc)) < reach)
        offsets = (np.arange(SUBSAMPLES) + 0.5) / SUBSAMPLES - 0.5
        right, down = (o.reshape(1, -1, 1) for o in np.meshgrid(offsets, offsets))
        fine = at.reshape(-1, 2)[edge, None] + per_column[edge, None] * right + per_row[edge, None] * down
        fine_border, fine_disc = self._distances(fine.reshape(-1, 2))
        table[edge] = ((fine_border > 0) & (fine_disc < 0)).reshape(edge.size, -1).mean(axis=1)
        disc[edge] = ((fine_border > 0) & (fine_disc >= 0)).reshape(edge.size, -1).mean(axis=1)
        shape = (camera.rows, camera.columns)
        size = np.array([plan.width_mm, plan.height_mm])
        place = (np.clip(at, 0.0, size) / FIELD_STEP_MM).astype(np.float32)
        return Scene(
            table=table.reshape(shape),
            disc=disc.reshape(shape),
            column_of_field=np.ascontiguousarray(place[..., 0]),
            row_of_field=np.ascontiguousarray(place[..., 1]),
        )

    def _distances(self, at_mm: Floats) -> tuple[Floats, Floats]:
        """Return how far inside the table's border and inside the nearest disc's rim points (n, 2) lie, mm, negative outside."""
        x, y = np.ascontiguousarray(at_mm[:, 0]), np.ascontiguousarray(at_mm[:, 1])
        to_border = np.minimum(np.minimum(x, self.plan.width_mm - x), np.minimum(y, self.plan.height_mm - y))
        diameter = self.plan.fiducial_diameter_mm
        to_disc = np.full(len(at_mm), -diameter)
        for disc_x, disc_y in fiducial_points(self.plan):
            near = np.flatnonzero(np.abs(x - disc_x) < diameter)
            near = near[np.abs(y[near] - disc_y) < diameter]
            to_disc[near] = 0.5 * diameter - np.hypot(x[near] - disc_x, y[near] - disc_y)
        return to_border, to_disc
