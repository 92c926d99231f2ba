"""A table with known truth, rendered to the sensor with 4 x 4 rays per pixel through OpenCV's own lens model."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np

from thermography.io.flir import index_frames
from thermography.io.flir_writer import write_sequence
from thermography.io.frame import CameraParameters, Frame
from thermography.radiometry.planck import counts_from_temperature
from thermography.registration.plan import Fiducial, PlanGrid
from thermography.registration.register import Registration, register, register_points

GRID = PlanGrid(700, 180, 5)
PLACES = [
    (40, 20), (200, 18), (360, 16), (520, 18), (665, 22), (40, 160), (200, 163), (360, 165), (520, 162), (665, 158),
    (120, 90), (600, 88),
]  # fmt: skip
DISCS = [Fiducial(f"F{i}", x, y, 16.0) for i, (x, y) in enumerate(PLACES, 1)]
FOCAL_PX = 1530.0


def smooth_field(x, y):
    """Degrees Celsius: a gradient along the table and one warm zone of 90 mm."""
    return 23.0 + 0.004 * x + 0.003 * y + 2.5 * np.exp(-((x - 450) ** 2 + (y - 80) ** 2) / (2 * 90.0**2))


@dataclass(frozen=True)
class Scene:
    """Camera, lens and table of one rendered frame; the table may stand `shift_mm` off its place."""

    corners_px: tuple = ((30, 118), (585, 92), (612, 325), (28, 352))
    k1: float = 0.0
    shape: tuple[int, int] = (480, 640)
    disc_K: float = -1.5
    discs: tuple = tuple(DISCS)
    field: Callable = smooth_field
    outside: float = 22.5
    shift_mm: tuple[float, float] = (0.0, 0.0)
    shift_px: tuple[float, float] = (0.0, 0.0)
    rays: int = 4

    @property
    def camera_matrix(self):
        return np.array([[FOCAL_PX, 0, (self.shape[1] - 1) / 2], [0, FOCAL_PX, (self.shape[0] - 1) / 2], [0, 0, 1]])

    @property
    def plan_to_pixel(self):
        corners = np.array([(0, 0), (700, 0), (700, 180), (0, 180)], "f4")
        return cv2.getPerspectiveTransform(corners, np.array(self.corners_px, "f4"))

    def to_plan(self, points_px):
        """True plan place of sensor points (n, 2)."""
        ideal = (np.ascontiguousarray(points_px, float) - self.shift_px).reshape(-1, 1, 2)
        if self.k1:
            criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-7)
            camera, distortion = self.camera_matrix, np.array([self.k1, 0, 0, 0])
            ideal = cv2.undistortPoints(ideal, camera, distortion, None, None, camera, criteria)
        return cv2.perspectiveTransform(ideal, np.linalg.inv(self.plan_to_pixel)).reshape(-1, 2) - self.shift_mm

    def to_pixels(self, points_mm):
        """True place on the sensor of plan points (n, 2)."""
        ideal = cv2.perspectiveTransform((np.asarray(points_mm, float) + self.shift_mm)[None], self.plan_to_pixel)[0]
        middle = self.camera_matrix[:2, 2]
        rays = (ideal - middle) / FOCAL_PX
        return middle + FOCAL_PX * rays * (1 + self.k1 * (rays**2).sum(axis=1, keepdims=True)) + self.shift_px

    def render(self, rng=None, noise_K=0.05):
        """One frame in degC, float64 (row, column)."""
        frame = _rendered(self)
        return frame.copy() if rng is None else frame + rng.normal(0, noise_K, frame.shape)

    def registration_rms_mm(self, registration):
        """Root mean square distance over the plan between the registration and the truth, mm."""
        plan = GRID.centres_mm.reshape(-1, 2)
        error = self.to_plan(registration.to_sensor(plan)) - plan
        return float(np.sqrt((error**2).sum(axis=1).mean()))


@cache
def _rendered(scene):
    edge = np.linspace(0, 1, 40)
    along = np.concatenate([edge, edge, 0 * edge, 0 * edge + 1])
    across = np.concatenate([0 * edge, 0 * edge + 1, edge, edge])
    outline = scene.to_pixels(np.column_stack([700 * along, 180 * across]))
    frame = np.full(scene.shape, float(scene.outside))
    # Beyond the outline of the table there is nothing to trace.
    left, top = np.maximum(np.floor(outline.min(0)) - 2, 0).astype(int)
    right, bottom = np.ceil(outline.max(0) + 3).astype(int)
    seen = frame[top:bottom, left:right]
    rows, columns = seen.shape
    steps = (np.arange(scene.rays) + 0.5) / scene.rays - 0.5
    column = (left + np.arange(columns)[:, None] + steps).ravel()
    row = (top + np.arange(rows)[:, None] + steps).ravel()
    points = np.stack(np.meshgrid(column, row), axis=-1).reshape(-1, 2)
    x, y = scene.to_plan(points).T.reshape(2, row.size, column.size)
    value = np.where((x >= 0) & (x <= 700) & (y >= 0) & (y <= 180), scene.field(x, y), scene.outside)
    for disc in scene.discs:
        place = scene.to_pixels([(disc.x_mm, disc.y_mm)])[0] - (left, top)
        reach = 2 * disc.diameter_mm
        (c, r), (c_end, r_end) = (np.maximum(scene.rays * (place + d), 0).astype(int) for d in (-reach, reach))
        near = np.s_[r:r_end, c:c_end]
        inside = (x[near] - disc.x_mm) ** 2 + (y[near] - disc.y_mm) ** 2 < (disc.diameter_mm / 2) ** 2
        value[near] = np.where(inside, smooth_field(450, 80) - 2.5 + scene.disc_K, value[near])
    seen[:] = value.reshape(rows, scene.rays, columns, scene.rays).mean(axis=(1, 3))
    return frame


@cache
def registered(scene=None):
    """Registration of a scene without noise (a still table with 4 K colder discs), whose hints spare the search by arrangement."""
    scene = Scene(disc_K=-4.0) if scene is None else scene
    places = scene.to_pixels([(disc.x_mm, disc.y_mm) for disc in DISCS])
    hinted = [replace(disc, column_px=c, row_px=r) for disc, (c, r) in zip(DISCS, places, strict=True)]
    return register(scene.render(), hinted, grid=GRID)


#: SC660 constants as in the vendor's own files; air and surroundings as in a workshop.
SC660 = CameraParameters(
    emissivity=0.97, object_distance_m=1.2, reflected_temperature_K=295.15, atmospheric_temperature_K=297.15,
    window_temperature_K=297.15, window_transmission=1.0, stored_transmission=0.0, relative_humidity=0.45,
    planck_r1=21106.77, planck_b=1501.0, planck_f=1.0, planck_o=-7340.0, planck_r2=0.012545258,
    atmosphere_alpha1=0.006569, atmosphere_alpha2=0.012620, atmosphere_beta1=-0.002276, atmosphere_beta2=-0.006670,
    atmosphere_x=1.9,
)  # fmt: skip
START = np.datetime64("2026-03-09T06:30:00.000", "ms")


def record(path, images, *, interval_s=1.0, parameters=SC660, start=START):
    """Write temperature images (degC) as a SEQ file, one every `interval_s`, and return the references to its frames."""

    def frames():
        for i, image in enumerate(images):
            counts = np.round(counts_from_temperature(image, parameters)).astype(np.uint16)
            time = start + np.timedelta64(round(1000 * interval_s * i), "ms")
            yield Frame(counts=counts, parameters=parameters, time=time)

    write_sequence(path, frames())
    references, rejected = index_frames([path])
    assert not rejected
    return references


def edges(*seconds):
    """Edges of cycles, seconds after the first frame."""
    return START + np.array(seconds, int) * np.timedelta64(1, "s")


def assert_equal_bits(one, other):
    """Hold two Datasets against each other bit by bit."""
    for name in one.variables:
        assert one[name].values.tobytes() == other[name].values.tobytes(), name
    assert one.attrs == other.attrs


def cell_truth(field=smooth_field, grid=GRID):
    """Mean of a field over every cell, (y, x), from 10 x 10 points per cell."""
    fine = grid.cell_size_mm / 10
    x = (np.arange(grid.shape[1] * 10) + 0.5) * fine
    y = (np.arange(grid.shape[0] * 10) + 0.5) * fine
    values = field(*np.meshgrid(x, y))
    return values.reshape(grid.shape[0], 10, grid.shape[1], 10).mean(axis=(1, 3))


def overhead(grid: PlanGrid, discs, *, shape, px_per_mm: float, origin_px=(0.0, 0.0)) -> Registration:
    """Registration of a camera that looks straight down: plan (0, 0) at `origin_px`, no distortion; exact to 1e-9 px."""
    corners = [(0, 0), (grid.width_mm, 0), (0, grid.height_mm), (grid.width_mm, grid.height_mm)]
    listed = [Fiducial(f"C{i}", x, y, 1e-6) for i, (x, y) in enumerate(corners)]
    picked = {c.name: (origin_px[0] + px_per_mm * c.x_mm, origin_px[1] + px_per_mm * c.y_mm) for c in listed}
    return replace(register_points(picked, listed, shape), masked=tuple(discs))
