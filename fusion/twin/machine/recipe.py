"""The twin's recipe: machine, test, instruments, and what is wrong without anybody declaring it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

from fusion.errors import FusionError


class RecipeError(FusionError):
    """A recipe that cannot be simulated; the message names file, key, value and remedy."""


@dataclass(frozen=True)
class Campaign:
    """Title, axis, start (UTC) and the seed that fixes every random series."""

    title: str = "Twin"
    axis: str = "X"
    start: str = "2026-03-09T06:30:00"
    seed: int = 1


@dataclass(frozen=True)
class Test:
    """The positioning test: targets, motion, timing. Without `positions_mm` the targets are evenly spaced from 0."""

    cycles: int = 60
    targets: int = 16
    spacing_mm: float = 20.0
    jitter_mm: float = 0.0
    positions_mm: tuple[float, ...] = ()
    feed_mm_per_min: float = 300.0
    dwell_s: float = 2.0
    reversal_s: float = 12.0
    period_s: float = 252.0
    missing_fraction: float = 0.0


@dataclass(frozen=True)
class Duty:
    """Load of the machine: `random` levels held for random times, `constant` = `high`, or `switched` between low and high.

    `randomised` switches by the law that the campaign file states: holds of `least_hold_min` and an exponential rest.
    """

    kind: str = "random"
    low: float = 0.0
    high: float = 1.0
    mean_hold_min: float = 30.0
    least_hold_min: float = 0.0


@dataclass(frozen=True)
class Plan:
    """The table plan: size, measured line (`origin_mm` + `direction` x axis position) and disc fiducials (x, y pairs)."""

    width_mm: float = 700.0
    height_mm: float = 180.0
    origin_mm: tuple[float, ...] = (500.0, 90.0)
    direction: tuple[float, ...] = (-1.0, 0.0)
    fiducial_diameter_mm: float = 16.0
    fiducials_x_mm: tuple[float, ...] = (40, 195, 350, 505, 660, 40, 195, 350, 505, 660, 115, 590)
    fiducials_y_mm: tuple[float, ...] = (18, 20, 17, 19, 21, 161, 163, 160, 164, 159, 88, 92)
    hint_error_px: float = 4.0


@dataclass(frozen=True)
class Table:
    """Cast-iron plate; `convection_W_per_m2K` is the sum over both faces. `preheat_min` runs the machine before the test."""

    thickness_mm: float = 40.0
    conductivity_W_per_mK: float = 52.0
    density_kg_per_m3: float = 7200.0
    heat_capacity_J_per_kgK: float = 460.0
    convection_W_per_m2K: float = 18.0
    initial_temperature_degC: float = 23.5
    preheat_min: float = 0.0


@dataclass(frozen=True)
class Source:
    """One heat source under the table: a Gaussian footprint whose power follows a drive through its own first-order lag."""

    name: str
    x_mm: float
    y_mm: float
    spread_x_mm: float
    spread_y_mm: float
    power_W: float
    time_constant_min: float = 10.0
    follows: str = "duty"


@dataclass(frozen=True)
class Room:
    """Air around the machine: mean, trend, slow swing and a random walk of the pressure."""

    temperature_degC: float = 23.5
    trend_K_per_h: float = 0.1
    swing_K: float = 0.15
    swing_period_min: float = 47.0
    pressure_hPa: float = 1000.0
    pressure_walk_hPa_per_sqrt_h: float = 0.4
    humidity_percent: float = 42.0
    probe_lag_min: float = 6.0


@dataclass(frozen=True)
class Drift:
    """Declared physics and the nuisance that nobody declared: `walk` = none, random_walk, integrated or ou."""

    expansion_ppm_per_K: float = 11.7
    offset_um_per_K: float = -1.6
    walk: str = "random_walk"
    walk_common_um_per_sqrt_h: float = 0.15
    walk_slope_um_per_sqrt_h: float = 0.1


@dataclass(frozen=True)
class Profile:
    """Static positioning error: slope and bow over the travel, cyclic error of the screw, roughness, reversal."""

    slope_um: float = 3.0
    bow_um: float = 1.0
    rough_um: float = 0.6
    pitch_um: float = 0.2
    lead_mm: float = 5.0
    reversal_um: float = 0.9


@dataclass(frozen=True)
class Laser:
    """The laser's random error, its relative spread over the targets, and the file it writes (csv or rtl)."""

    noise_um: float = 0.4
    noise_spread: float = 0.0
    tails: str = "normal"
    file: str = "csv"
    stated_expansion_ppm_per_K: float = 11.7


@dataclass(frozen=True)
class Camera:
    """Pose, lens, detector and clock of the camera, and which frames it takes (SC660 constants throughout).

    Table "still": `frames_per_cycle` frames, `burst_interval_s` apart, `frame_after_s` after a cycle's last reading, at axis
    position 0. Table "moving": a frame every `frame_interval_s` through the whole test. `drift_K_per_K`: by how much all
    pixels read high per K that the camera's housing warms. `state_clock_offset`: whether the campaign file tells the offset.
    """

    table: str = "still"
    frame_after_s: float = 30.0
    frames_per_cycle: int = 1
    burst_interval_s: float = 0.2
    frame_interval_s: float = 10.0
    file: str = "jpg"
    columns: int = 640
    rows: int = 480
    focal_px: float = 1530.0
    k1: float = -0.3
    distance_mm: float = 1760.0
    centre_mm: tuple[float, ...] = (348.0, 92.0)
    tilt_deg: float = 9.0
    pan_deg: float = 4.0
    roll_deg: float = 1.5
    blur_px: float = 0.6
    emissivity: float = 0.97
    disc_emissivity: float = 0.15
    reflected_temperature_degC: float = 22.0
    atmospheric_temperature_degC: float = 24.0
    relative_humidity: float = 0.45
    netd_K: float = 0.05
    fixed_pattern_K: float = 0.0
    ffc_step_K: float = 0.0
    ffc_interval_min: float = 15.0
    drift_K_per_K: float = 0.0
    bad_pixels: int = 0
    knock_cycle: int = 0
    knock_px: tuple[float, ...] = (3.0, 0.0)
    clock_offset_s: float = 0.0
    state_clock_offset: bool = True


@dataclass(frozen=True)
class EffectRecipe:
    """One undeclared effect: its name, its size (rms um, or K for what only the camera sees) and its own parameters."""

    name: str
    amplitude_um: float | None = None
    amplitude_K: float | None = None
    parameters: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class AnomalyRecipe:
    """One target that misbehaves: cause (structural, local_temperature, stick_slip, step, wander), direction and rms in um."""

    target: int
    kind: str = "structural"
    direction: str = "both"
    amplitude_um: float = 0.5
    at_cycle: int = 0


@dataclass(frozen=True)
class Record:
    """A record instead of a positioning test: sensors and channels over hours, under a spindle speed that changes at random.

    Sensors follow their part late, each by a time between the two of `sensor_lag_min`.
    """

    hours: float = 24.0
    step_s: float = 60.0
    sensors: int = 10
    channels: int = 3
    top_speed_rpm: float = 8000.0
    mean_hold_min: float = 90.0
    rest_share: float = 0.25
    room_swing_K: float = 1.0
    sensitivity_um_per_K: float = 1.5
    noise_K: float = 0.03
    sensor_lag_min: tuple[float, float] = (0.5, 2.0)
    noise_um: float = 0.3
    walk_um_per_sqrt_h: float = 0.2


@dataclass(frozen=True)
class Recipe:
    """Everything the twin needs for one campaign."""

    campaign: Campaign = field(default_factory=Campaign)
    test: Test = field(default_factory=Test)
    duty: Duty = field(default_factory=Duty)
    plan: Plan = field(default_factory=Plan)
    table: Table = field(default_factory=Table)
    source: tuple[Source, ...] = (
        Source("screw nut", 345.0, 95.0, 45.0, 30.0, 5.0, 8.0),
        Source("drive bearing", 700.0, 90.0, 70.0, 90.0, 9.0, 18.0),
        Source("spindle shadow", 430.0, 80.0, 90.0, 45.0, 2.0, 25.0),
    )
    room: Room = field(default_factory=Room)
    drift: Drift = field(default_factory=Drift)
    profile: Profile = field(default_factory=Profile)
    laser: Laser = field(default_factory=Laser)
    camera: Camera = field(default_factory=Camera)
    effect: tuple[EffectRecipe, ...] = ()
    anomaly: tuple[AnomalyRecipe, ...] = ()
    record: Record | None = None

    def vary(self, **tables: Any) -> Recipe:
        """Return a copy with some values changed: ``recipe.vary(campaign={"seed": 7}, effect=())``."""
        changes: dict[str, Any] = {
            k: replace(getattr(self, k) or Record(), **v) if isinstance(v, dict) else v for k, v in tables.items()
        }
        return replace(self, **changes)
