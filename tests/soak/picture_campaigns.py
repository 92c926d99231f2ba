"""Small campaigns with pictures of known truth, by numpy: views of `table_views`, Planck's law, and planted faults that combine.

Of the program it uses the formats of files and their constants, nothing of the analysis. A `Campaign` renders its frames; `write`
makes the folder that ``thermofuse run`` takes; `reduced` goes from that folder to fields and their checks without the command.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, reduce
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.soak.table_views import View, draw_view
from thermography.io.flir_writer import write_sequence
from thermography.io.frame import CameraParameters, Frame
from thermography.registration.plan import Fiducial, PlanGrid

Array = NDArray[np.float64]
GRID = PlanGrid(700, 180, 5)
#: Irregular places of twelve discs of 24 mm, mm.
PLACES = (
    (42, 31), (168, 24), (311, 34), (452, 22), (583, 29), (664, 37),
    (36, 148), (203, 157), (338, 146), (476, 158), (571, 147), (657, 152),
)  # fmt: skip
DISC_MM, DISC_EMISSIVITY, EMISSIVITY = 24.0, 0.45, 0.97
ROOM_C, REFLECTED_C = 21.0, 20.0
START = np.datetime64("2026-03-09T06:30:00.000", "ms")
#: SC660 in a workshop, without the path through the air, so that the counts need no model of it.
CAMERA = CameraParameters(
    emissivity=EMISSIVITY, object_distance_m=1.5, reflected_temperature_K=REFLECTED_C + 273.15,
    atmospheric_temperature_K=ROOM_C + 273.15, window_temperature_K=293.15, window_transmission=1.0, stored_transmission=1.0,
    relative_humidity=0.45, planck_r1=21106.77, planck_b=1501.0, planck_f=1.0, planck_o=-7340.0, planck_r2=0.012545258,
    atmosphere_alpha1=0.006569, atmosphere_alpha2=0.012620, atmosphere_beta1=-0.002276, atmosphere_beta2=-0.006670,
    atmosphere_x=1.9,
)  # fmt: skip
#: Points per side of a pixel.
_FINE = 3
_TARGETS_MM = np.arange(0.0, 300.0, 50.0)


def signal(celsius: Array | float) -> Array:
    """Counts of a black body, less the offset: Planck's law with the camera's constants."""
    return np.asarray(CAMERA.planck_r1 / CAMERA.planck_r2 / (np.exp(CAMERA.planck_b / (celsius + 273.15)) - 1.0))


def view(kind: str, rng: np.random.Generator) -> View:
    """A camera with the whole table in view: ``wide`` (strong distortion), ``tilted`` (30 degrees) or ``small`` (240 x 180)."""
    common: dict[str, Any] = {"centre_mm": (350.0, 90.0)}
    large: dict[str, Any] = {**common, "shape": (360, 480)}
    if kind == "wide":
        return draw_view(rng, focal_px=390.0, mm_per_px=(1.87, 2.0), lens=(-0.2, 0.04, 0.0, 0.0), **large)
    if kind == "tilted":
        return draw_view(rng, tilt_deg=30.0, focal_px=825.0, mm_per_px=(1.8, 1.93), lens=(-0.1, 0, 0, 0), **large)
    return draw_view(rng, shape=(180, 240), focal_px=420.0, mm_per_px=(3.6, 3.8), lens=(-0.15, 0.0, 0.0, 0.0), **common)


def warming(x: Array, y: Array, seconds: float) -> Array:
    """Temperature of the table, degC: a warm end, a broad and a narrow source, and the room's slow swing."""
    grown = 1.0 - np.exp(-seconds / 2400.0)
    end = 3.0 * np.exp(-((x - 700) ** 2 + (y - 90) ** 2) / (2 * 160.0**2))
    broad = 1.2 * np.exp(-((x - 270) ** 2 + (y - 95) ** 2) / (2 * 85.0**2))
    narrow = 1.8 * np.exp(-((x - 500) ** 2 + (y - 85) ** 2) / (2 * 30.0**2))
    return np.asarray(24.0 + 0.3 * np.sin(2 * np.pi * seconds / 5200.0 - 0.5) + grown * (end + broad + narrow))


@dataclass(frozen=True)
class Now:
    """Instant of a frame: index, cycle from 1, seconds since the first frame, and share of the test that has passed."""

    frame: int
    cycle: int
    seconds: float
    share: float


class Fault:
    """What is planted; a part overrides the steps that it changes."""

    def seen_from(self, camera: View, now: Now) -> View:
        return camera

    def surface(self, x: Array, y: Array, celsius: Array, emissivity: Array, now: Now) -> tuple[Array, Array]:
        return celsius, emissivity

    def before(self, camera: View, image: Array, now: Now) -> Array:
        """What the lens adds or something before it hides, in counts."""
        return image

    def sensor(self, counts: Array, now: Now, rng: np.random.Generator) -> Array:
        return counts


@dataclass(frozen=True)
class Lying(Fault):
    """An object on the table from one cycle to before another, round or (length, width, turn in degrees), of its own or the table's
    temperature (None).
    """

    x_mm: float
    y_mm: float
    size_mm: float | tuple[float, float, float]
    celsius: float | None = None
    emissivity: float = 0.95
    first: int = 1
    stop: int = 10_000

    def covers(self, x: Array, y: Array) -> NDArray[np.bool_]:
        length, width, turn = self.size_mm if isinstance(self.size_mm, tuple) else (0.0, 0.0, 0.0)
        dx, dy, angle = x - self.x_mm, y - self.y_mm, np.deg2rad(turn)
        if not isinstance(self.size_mm, tuple):
            return np.asarray(np.hypot(dx, dy) < self.size_mm / 2)
        along, across = dx * np.cos(angle) + dy * np.sin(angle), dy * np.cos(angle) - dx * np.sin(angle)
        return np.asarray((np.abs(along) < length / 2) & (np.abs(across) < width / 2))

    def surface(self, x: Array, y: Array, celsius: Array, emissivity: Array, now: Now) -> tuple[Array, Array]:
        if not self.first <= now.cycle < self.stop:
            return celsius, emissivity
        inside = self.covers(x, y)
        own = celsius if self.celsius is None else np.full_like(celsius, self.celsius)
        return np.where(inside, own, celsius), np.where(inside, self.emissivity, emissivity)


@dataclass(frozen=True)
class Person(Fault):
    """Warm and before the camera for some frames: a part of the picture's columns."""

    first: int
    frames: int
    columns: tuple[float, float] = (0.3, 0.55)
    celsius: float = 32.0

    def before(self, camera: View, image: Array, now: Now) -> Array:
        if not self.first <= now.frame < self.first + self.frames:
            return image
        edge = [round(share * image.shape[1]) + 2 * (now.frame - self.first) for share in self.columns]
        image = image.copy()
        image[image.shape[0] // 4 :, edge[0] : edge[1]] = signal(self.celsius)
        return image


@dataclass(frozen=True)
class Blur(Fault):
    """Defocus beyond the lens's own blur, from a frame on."""

    sigma_px: float
    first: int = 0

    def before(self, camera: View, image: Array, now: Now) -> Array:
        return np.asarray(cv2.GaussianBlur(image, (0, 0), self.sigma_px)) if now.frame >= self.first else image


@dataclass(frozen=True)
class Vignetting(Fault):
    """Level that grows over the test with the square of the distance from the middle, up to `corner_K` in the corners."""

    corner_K: float

    def before(self, camera: View, image: Array, now: Now) -> Array:
        row, column = (np.linspace(-1, 1, size) for size in image.shape)
        return image + self.corner_K * now.share * _SLOPE * (row[:, None] ** 2 + column**2) / 2


@dataclass(frozen=True)
class ZeroDrift(Fault):
    """What the camera adds to every pixel, `course_K` of the share of the test."""

    course_K: Callable[[float], float]

    def before(self, camera: View, image: Array, now: Now) -> Array:
        return image + self.course_K(now.share) * _SLOPE


@dataclass(frozen=True)
class Clipped(Fault):
    """Counts that end at a temperature."""

    celsius: float

    def sensor(self, counts: Array, now: Now, rng: np.random.Generator) -> Array:
        return np.minimum(counts, _to_counts(signal(self.celsius)))


@dataclass(frozen=True)
class BadPixels(Fault):
    """Pixels at 0, at 65535 and off by 340 counts, a third each."""

    count: int
    seed: int = 0

    def sensor(self, counts: Array, now: Now, rng: np.random.Generator) -> Array:
        places = np.random.default_rng(self.seed).choice(counts.size, self.count, replace=False)
        flat = counts.ravel().copy()
        flat[places[::3]], flat[places[1::3]] = 0, 65535
        flat[places[2::3]] += 340
        return flat.reshape(counts.shape)


@dataclass(frozen=True)
class ColumnNoise(Fault):
    """Noise that the pixels of a column share, new in every frame."""

    sigma_K: float

    def sensor(self, counts: Array, now: Now, rng: np.random.Generator) -> Array:
        return counts + rng.normal(0, self.sigma_K * _SLOPE, counts.shape[1])


@dataclass(frozen=True)
class Knock(Fault):
    """The camera's picture shifts by so many pixels from a frame on."""

    first: int
    shift_px: tuple[float, float]

    def seen_from(self, camera: View, now: Now) -> View:
        if now.frame < self.first:
            return camera
        moved = np.array([*self.shift_px, 0.0]) * camera.shift_mm[2] / camera.focal_px
        return replace(camera, shift_mm=camera.shift_mm + moved)


@dataclass(frozen=True)
class Creep(Fault):
    """The camera's picture shifts steadily over the test, by so many pixels at its end."""

    shift_px: tuple[float, float]

    def seen_from(self, camera: View, now: Now) -> View:
        moved = np.array([*self.shift_px, 0.0]) * now.share * camera.shift_mm[2] / camera.focal_px
        return replace(camera, shift_mm=camera.shift_mm + moved)


#: Counts per kelvin at the table.
_SLOPE = float(signal(24.5) - signal(23.5))


def _to_counts(image: Array) -> Array:
    return image - CAMERA.planck_o


@lru_cache(maxsize=3)
def _rays(size: tuple[int, int], focal_px: float, lens: bytes) -> Array:
    """Directions of the points of every pixel of a camera, (point, row, column) as one axis."""
    camera = View(np.eye(3), np.zeros(3), focal_px, np.frombuffer(lens), size)
    offsets = (np.arange(_FINE) + 0.5) / _FINE - 0.5
    down, across, row, column = np.meshgrid(offsets, offsets, *map(np.arange, size), indexing="ij")
    return np.asarray(camera.rays(np.stack([column + across, row + down], axis=-1).reshape(-1, 2)))


@lru_cache(maxsize=2)
def _scene(
    size: tuple[int, int],
    focal_px: float,
    lens: bytes,
    pose: bytes,
    places: tuple[tuple[float, float], ...],
    disc_mm: float,
) -> tuple[NDArray[np.intp], Array, Array, NDArray[np.bool_], Array]:
    """Pixels that show the table, and of their points (point, pixel) the plan's x and y, mm, whether they lie on it, and emissivity."""
    values = np.frombuffer(pose)
    camera = View(values[:9].reshape(3, 3), values[9:], focal_px, np.frombuffer(lens), size)
    x, y = camera.meets_plan(_rays(size, focal_px, lens)).T.reshape(2, _FINE**2, -1)
    on_table = (x >= 0) & (x <= GRID.width_mm) & (y >= 0) & (y <= GRID.height_mm)
    pixels = np.flatnonzero(on_table.any(axis=0))
    x, y, on_table = x[:, pixels], y[:, pixels], on_table[:, pixels]
    emissivity = np.full(x.shape, EMISSIVITY)
    for place in places:
        near = np.flatnonzero(np.abs(x[0] - place[0]) + np.abs(y[0] - place[1]) < 2 * disc_mm)
        on_disc = np.hypot(x[:, near] - place[0], y[:, near] - place[1]) < disc_mm / 2
        emissivity[:, near] = np.where(on_disc, DISC_EMISSIVITY, emissivity[:, near])
    return pixels, x, y, on_table, emissivity


@lru_cache(maxsize=64)
def _radiance(
    view_of: tuple[Any, ...], celsius: Callable[[Array, Array, float], Array], now: Now, faults: tuple[Fault, ...]
) -> Array:
    """Counts of one frame before the lens's blur. Campaigns that differ in what lens and sensor do share it."""
    pixels, x, y, on_table, emissivity = _scene(*view_of)
    own = celsius(x, y, now.seconds)
    for fault in faults:
        own, emissivity = fault.surface(x, y, own, emissivity, now)
    reflected = float(signal(REFLECTED_C))
    room = 0.95 * float(signal(ROOM_C)) + 0.05 * reflected
    image = np.full(view_of[0], room)
    image.flat[pixels] = np.where(on_table, reflected + emissivity * (signal(own) - reflected), room).mean(axis=0)
    return image


@dataclass(frozen=True)
class Campaign:
    """A small campaign: the camera, the table's temperature at (x, y, seconds) in mm, and what is planted; `hints` 0 lists none."""

    camera: View
    celsius: Callable[[Array, Array, float], Array] = warming
    faults: tuple[Fault, ...] = ()
    cycles: int = 14
    frames_per_cycle: int = 2
    cycle_s: float = 250.0
    noise_K: float = 0.05
    blur_px: float = 0.6
    places: tuple[tuple[float, float], ...] = PLACES
    disc_mm: float = DISC_MM
    hint_px: float = 4.0
    seed: int = 1
    housing: Callable[[float], float] | None = None
    stored: Callable[[Now], CameraParameters] = field(default=lambda now: CAMERA)

    @cached_property
    def instants(self) -> list[Now]:
        """Of the frames, evenly spread over every cycle."""
        total, step = self.cycles * self.frames_per_cycle, self.cycle_s / self.frames_per_cycle
        return [Now(i, 1 + i // self.frames_per_cycle, (i + 0.4) * step, i / (total - 1)) for i in range(total)]

    @property
    def discs(self) -> list[Fiducial]:
        """As listed, with hints that are off by up to `hint_px`."""
        rng = np.random.default_rng((self.seed, 1))
        at = (
            self.camera.to_sensor(np.array(self.places, float))
            + rng.uniform(-1, 1, (len(self.places), 2)) * self.hint_px
        )
        hints = at if self.hint_px else np.full(at.shape, np.nan)
        return [
            Fiducial(f"F{i}", x, y, self.disc_mm, float(column), float(row))
            for i, ((x, y), (column, row)) in enumerate(zip(self.places, hints, strict=True), 1)
        ]

    def counts(self, now: Now) -> NDArray[np.uint16]:
        """One frame, (row, column)."""
        rng = np.random.default_rng((self.seed, 2, now.frame))
        camera = reduce(lambda one, fault: fault.seen_from(one, now), self.faults, self.camera)
        pose = np.concatenate([camera.turn.ravel(), camera.shift_mm])
        view_of = (camera.shape, camera.focal_px, camera.lens.tobytes(), pose.tobytes(), self.places, self.disc_mm)
        on_it = tuple(fault for fault in self.faults if type(fault).surface is not Fault.surface)
        image = _radiance(view_of, self.celsius, now, on_it)
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), self.blur_px))
        for fault in self.faults:
            image = fault.before(camera, image, now)
        counts = _to_counts(image) + rng.normal(0, self.noise_K * _SLOPE, image.shape)
        for fault in self.faults:
            counts = fault.sensor(counts, now, rng)
        return np.clip(np.rint(counts), 0, 65535).astype(np.uint16)

    def truth(self, seconds: float) -> Array:
        """Mean temperature of every cell of the plan without what is planted, (y, x) degC."""
        fine = np.arange(0.5, 5.0, 1.0)
        x, y = ((np.arange(n)[:, None] * 5 + fine).ravel() for n in reversed(GRID.shape))
        values = self.celsius(*np.meshgrid(x, y), seconds)
        return np.asarray(values.reshape(GRID.shape[0], 5, GRID.shape[1], 5).mean(axis=(1, 3)))


def write(campaign: Campaign, folder: Path, *, regions: str = "") -> Path:
    """Write a campaign's files, and return its campaign file; `regions` is added to it as it stands."""
    folder.mkdir(parents=True, exist_ok=True)
    inside = campaign.housing
    write_sequence(
        folder / "frames.seq",
        (
            Frame(
                counts=campaign.counts(now),
                parameters=campaign.stored(now),
                time=_time(now.seconds),
                housekeeping={} if inside is None else {"housing": inside(now.seconds) + 273.15},
            )
            for now in campaign.instants
        ),
    )
    lines = ["name,x_mm,y_mm,diameter_mm" + (",column_px,row_px" if campaign.hint_px else "")]
    for disc in campaign.discs:
        hint = f",{disc.column_px:.0f},{disc.row_px:.0f}" if campaign.hint_px else ""
        lines.append(f"{disc.name},{disc.x_mm},{disc.y_mm},{disc.diameter_mm}{hint}")
    (folder / "fiducials.csv").write_text("\n".join(lines) + "\n")
    rng = np.random.default_rng((campaign.seed, 3))
    lines = ["time,air_temperature_degC,air_pressure_hPa,relative_humidity_percent,material_temperature_degC"]
    for seconds in np.arange(0.0, campaign.cycles * campaign.cycle_s + 61.0, 60.0):
        air = 22.0 + 0.3 * np.sin(2 * np.pi * seconds / 5200.0 - 0.5) + rng.normal(0, 0.01)
        material = float(campaign.celsius(np.array(600.0), np.array(90.0), seconds)) + rng.normal(0, 0.005)
        lines.append(f"{_time(seconds)}+00:00,{air:.3f},1002.0,45.0,{material:.3f}")
    (folder / "environment.csv").write_text("\n".join(lines) + "\n")
    (folder / "laser.csv").write_text("\n".join(_readings(campaign, rng)) + "\n")
    (folder / "campaign.toml").write_text(_CAMPAIGN + regions)
    return folder / "campaign.toml"


def _readings(campaign: Campaign, rng: np.random.Generator) -> list[str]:
    """An axis that expands with the table below it and shifts with the mean of the whole."""
    lines = ["cycle,direction,target,position_mm,time,deviation_um"]
    x, y = np.meshgrid(GRID.x_mm[::2], GRID.y_mm[::2])
    start = campaign.celsius(x, y, 0.0)
    for cycle in range(campaign.cycles):
        order = [*range(_TARGETS_MM.size), *reversed(range(_TARGETS_MM.size))]
        for step, target in enumerate(order):
            seconds = campaign.cycle_s * (cycle + 0.05 + 0.9 * step / len(order))
            rise = campaign.celsius(x, y, seconds) - start
            along = np.interp(_TARGETS_MM[target], [0.0, 300.0], [0.0, 1.0])
            line = float(rise[9, 20:50].mean())
            drift = 3.0 * float(rise.mean()) + along * 0.3 * 11.7 * line
            direction = "positive" if step < _TARGETS_MM.size else "negative"
            deviation = drift + 0.8 * np.sin(target) + rng.normal(0, 0.2)
            lines.append(
                f"{cycle + 1},{direction},{target + 1},{_TARGETS_MM[target]:.0f},{_time(seconds)}+00:00,{deviation:.3f}"
            )
    return lines


def _time(seconds: float) -> np.datetime64:
    return START + np.timedelta64(round(1000 * seconds), "ms")


_CAMPAIGN = """
[campaign]
title = "pictures"
axis = "X"
[thermography]
frames = ["frames.seq"]
emissivity = 0.97
table = "still"
clock_offset = "0 s"
[plan]
size = ["700 mm", "180 mm"]
cell_size = "5 mm"
fiducials = "fiducials.csv"
[plan.axis]
origin = ["500 mm", "90 mm"]
direction = [-1, 0]
[interferometry]
deviations = "laser.csv"
environment = "environment.csv"
dead_path = "0 mm"
expansion_coefficient = "11.7 ppm/K"
material_sensor = ["600 mm", "90 mm"]
[model]
declared = ["axis_expansion", "table_offset"]
"""


def reduced(path: Path) -> Any:
    """Fields of a written campaign with their notices and parts, and the checks of source and fields: (outcome, checks by code)."""
    from fusion.campaign.config import load_campaign
    from fusion.campaign.inputs import Source, read_source
    from fusion.pipeline.consistency import check_fields, check_source
    from fusion.pipeline.thermal import reduce_thermography
    from fusion.results.progress import silent

    source = read_source(load_campaign(path))
    assert isinstance(source, Source)
    outcome = reduce_thermography(source, checkpoint=path.parent / "kept", scheduler=None, report=silent)
    checks = [*check_source(source), *check_fields(source, outcome.dataset)]
    return outcome, {check.code: check for check in checks}
