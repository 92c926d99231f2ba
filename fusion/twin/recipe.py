"""The recipe of a simulated campaign: machine, test, instruments, and the effects that are not declared to the analysis.

Every class is one table of RECIPE.toml; a key that the file leaves out keeps the default given here. The annotations are the limits
that :func:`fusion.twin.recipe_file.check_recipe` enforces. Units stand in the names; times count from the start of the test.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, Literal

from pydantic import ConfigDict, Field, PositiveFloat, PositiveInt

from fusion.common import FusionError

#: Two numbers, x and y.
Pair = tuple[float, float]


class RecipeError(FusionError):
    """A recipe that cannot be simulated; the message names file, key, value and remedy."""


class _TomlTable:
    """Base of the recipe's tables: an unknown key or a number that is not finite is an error."""

    __pydantic_config__: ClassVar = ConfigDict(
        extra="forbid", revalidate_instances="always", allow_inf_nan=False, use_attribute_docstrings=True
    )


@dataclass(frozen=True)
class Campaign(_TomlTable):
    """What the campaign is called and when it took place."""

    title: str = "Twin"
    """Title of the report."""
    axis: str = "X"
    """Name of the measured axis."""
    start: str = "2026-03-09T06:30:00"
    """Start of the test, UTC, ISO 8601."""
    seed: int = 1
    """Seed of every random series: the same recipe with the same seed writes the same files."""
    further: str = ""
    """Tables that are added to the campaign file as they are: what a laboratory states of a test."""


@dataclass(frozen=True)
class Test(_TomlTable):
    """The bidirectional positioning test."""

    cycles: PositiveInt = 60
    """Number of cycles; in each, every target is approached from both directions."""
    targets: int = 16
    """Number of targets, evenly spaced from position 0."""
    spacing_mm: float = 20.0
    """Distance of the targets."""
    jitter_mm: float = 0.0
    """Largest random offset of a target, the first and the last one apart."""
    positions_mm: tuple[float, ...] = ()
    """Target positions, increasing; they replace `targets`, `spacing_mm` and `jitter_mm`."""
    feed_mm_per_min: PositiveFloat = 300.0
    """Feed between the targets."""
    dwell_s: float = 2.0
    """Dwell before a reading."""
    reversal_s: float = 12.0
    """Time between the last forward and the first backward reading."""
    period_s: PositiveFloat = 252.0
    """Time from the start of one cycle to that of the next."""
    missing_fraction: float = 0.0
    """Probability that a reading is lost, 0 to 1."""


@dataclass(frozen=True)
class Duty(_TomlTable):
    """Load of the machine over time, as a fraction of full load."""

    kind: Literal["random", "constant", "switched", "randomised"] = "random"
    """Levels held for random times (random), always `high` (constant), `low` and `high` in turn (switched; randomised: by the law
    that the campaign file states)."""
    low: float = 0.0
    """Smallest load."""
    high: float = 1.0
    """Largest load."""
    mean_hold_min: PositiveFloat = 30.0
    """Mean time for which a level is held."""
    least_hold_min: float = 0.0
    """Of a randomised load: shortest hold, beyond which the time is exponentially distributed."""


@dataclass(frozen=True)
class Plan(_TomlTable):
    """Plan of the table with the measured line and the disc fiducials."""

    width_mm: PositiveFloat = 700.0
    """Width of the table, along x."""
    height_mm: PositiveFloat = 180.0
    """Height of the table, along y."""
    origin_mm: Pair = (500.0, 90.0)
    """Plan point (x, y) under the spindle at axis position 0."""
    direction: Pair = (-1.0, 0.0)
    """Unit vector in which that point moves as the axis position grows."""
    fiducial_diameter_mm: PositiveFloat = 16.0
    """Diameter of the discs."""
    fiducials_x_mm: tuple[float, ...] = (40, 195, 350, 505, 660, 40, 195, 350, 505, 660, 115, 590)
    """Coordinate x of the centre of every disc."""
    fiducials_y_mm: tuple[float, ...] = (18, 20, 17, 19, 21, 161, 163, 160, 164, 159, 88, 92)
    """Coordinate y of the centre of every disc."""
    hint_error_px: float = 4.0
    """Standard deviation of the rough pixel positions that are written with the fiducials."""


@dataclass(frozen=True)
class Table(_TomlTable):
    """The table as a plate of cast iron."""

    thickness_mm: PositiveFloat = 40.0
    """Thickness of the plate."""
    conductivity_W_per_mK: PositiveFloat = 52.0
    """Thermal conductivity."""
    density_kg_per_m3: PositiveFloat = 7200.0
    """Density."""
    heat_capacity_J_per_kgK: PositiveFloat = 460.0
    """Specific heat capacity."""
    convection_W_per_m2K: PositiveFloat = 18.0
    """Heat transfer to the air, sum over both faces."""
    initial_temperature_degC: float = 23.5
    """Uniform temperature at the start of the pre-heat."""
    preheat_min: float = 0.0
    """Time for which the machine runs before the test."""


@dataclass(frozen=True)
class Source(_TomlTable):
    """One heat source under the table with a Gaussian footprint."""

    name: str
    """Name of the source."""
    x_mm: float
    """Centre of the footprint on the plan, x."""
    y_mm: float
    """Centre of the footprint on the plan, y."""
    spread_x_mm: float
    """Standard deviation of the footprint along x."""
    spread_y_mm: float
    """Standard deviation of the footprint along y."""
    power_W: float
    """Power into the table at full load."""
    time_constant_min: float = 10.0
    """First-order lag between the load and the power."""
    follows: Literal["duty", "constant", "own"] = "duty"
    """What switches it: the logged load (duty), nothing (constant: full load from the start), or a load that is not logged (own)."""


@dataclass(frozen=True)
class Room(_TomlTable):
    """Air around the machine."""

    temperature_degC: float = 23.5
    """Temperature at the start."""
    trend_K_per_h: float = 0.1
    """Linear trend of the temperature."""
    swing_K: float = 0.15
    """Amplitude of the periodic change of the temperature."""
    swing_period_min: float = 47.0
    """Period of that change."""
    pressure_hPa: float = 1000.0
    """Pressure at the start."""
    pressure_walk_hPa_per_sqrt_h: float = 0.4
    """Standard deviation of the random walk of the pressure after one hour."""
    humidity_percent: float = 42.0
    """Relative humidity at the start."""
    probe_lag_min: float = 6.0
    """Time constant of the material temperature sensor."""


@dataclass(frozen=True)
class Drift(_TomlTable):
    """Drift by the declared effects, and drift without a physical cause."""

    expansion_ppm_per_K: float = 11.7
    """Coefficient of `axis_expansion`."""
    offset_um_per_K: float = -1.6
    """Coefficient of `table_offset`."""
    walk: Literal["none", "random_walk", "integrated", "ou"] = "random_walk"
    """Kind of the drift without a cause; integrated: an integrated random walk, ou: an Ornstein-Uhlenbeck process."""
    walk_common_um_per_sqrt_h: float = 0.15
    """Its standard deviation after one hour (ou: in the long run), common to all positions."""
    walk_slope_um_per_sqrt_h: float = 0.1
    """The same of the part that grows with position, at the far end of the travel."""


@dataclass(frozen=True)
class Profile(_TomlTable):
    """Static positioning error."""

    slope_um: float = 3.0
    """Error at the far end of the travel by a linear scale error."""
    bow_um: float = 1.0
    """Height of a parabola over the travel."""
    rough_um: float = 0.6
    """Standard deviation of an independent error of every target."""
    pitch_um: float = 0.2
    """Amplitude of the cyclic error of the screw."""
    lead_mm: PositiveFloat = 5.0
    """Period of that error."""
    reversal_um: float = 0.9
    """Mean reversal error; it varies by 15 % between targets."""


@dataclass(frozen=True)
class Laser(_TomlTable):
    """The laser interferometer."""

    noise_um: float = 0.4
    """Standard deviation of a reading's random error."""
    noise_spread: float = 0.0
    """Standard deviation, over the targets, of the logarithm of that standard deviation."""
    tails: Literal["normal", "t4"] = "normal"
    """Distribution of that error; t4: Student's t with 4 degrees of freedom, scaled to the same standard deviation."""
    file: Literal["csv", "rtl"] = "csv"
    """Format of the laser file."""
    stated_expansion_ppm_per_K: float = 11.7
    """Expansion coefficient that the campaign file states."""


@dataclass(frozen=True)
class Camera(_TomlTable):
    """The thermal camera, with the calibration of a FLIR SC660."""

    table: Literal["still", "moving"] = "still"
    """Whether frames are taken after a cycle with the table at axis position 0 (still), or throughout the test (moving)."""
    frame_after_s: float = 30.0
    """Time of the first frame of a cycle after its last reading."""
    frames_per_cycle: PositiveInt = 1
    """Frames after every cycle."""
    burst_interval_s: PositiveFloat = 0.2
    """Time between the frames of a cycle."""
    frame_interval_s: PositiveFloat = 10.0
    """Of a moving table: time between frames."""
    file: Literal["jpg", "seq"] = "jpg"
    """Format of the frames."""
    columns: PositiveInt = 640
    """Columns of the detector."""
    rows: PositiveInt = 480
    """Rows of the detector."""
    focal_px: PositiveFloat = 1530.0
    """Focal length."""
    k1: float = -0.3
    """Coefficient of the radial distortion 1 + k1 r²."""
    distance_mm: PositiveFloat = 1760.0
    """Distance to the plan point in the centre of the view."""
    centre_mm: Pair = (348.0, 92.0)
    """Plan point (x, y) in the centre of the view."""
    tilt_deg: float = 9.0
    """Rotation of the camera about x."""
    pan_deg: float = 4.0
    """Rotation of the camera about y."""
    roll_deg: float = 1.5
    """Rotation of the camera about its optical axis."""
    blur_px: float = 0.6
    """Standard deviation of the optical blur."""
    emissivity: float = 0.97
    """Emissivity of the painted table."""
    disc_emissivity: float = 0.15
    """Emissivity of the discs."""
    reflected_temperature_degC: float = 22.0
    """Reflected apparent temperature."""
    atmospheric_temperature_degC: float = 24.0
    """Temperature of the air in the optical path."""
    relative_humidity: float = 0.45
    """Relative humidity of that air, 0 to 1."""
    netd_K: float = 0.05
    """Standard deviation of the temporal noise (NETD at 25 degC)."""
    fixed_pattern_K: float = 0.0
    """Standard deviation of the fixed pattern."""
    ffc_step_K: float = 0.0
    """Standard deviation of the offset after a flat-field correction (FFC)."""
    ffc_interval_min: PositiveFloat = 15.0
    """Interval of those corrections."""
    drift_K_per_K: float = 0.0
    """Offset of all pixels per kelvin by which the camera's housing warms."""
    bad_pixels: int = 0
    """Number of pixels that always show the same value."""
    knock_cycle: int = 0
    """Cycle from which on the view is displaced; 0: never."""
    knock_px: Pair = (3.0, 0.0)
    """That displacement in columns and rows."""
    clock_offset_s: float = 0.0
    """Camera clock minus laser clock."""
    state_clock_offset: bool = True
    """Whether the campaign file states it."""


@dataclass(frozen=True)
class EffectRecipe(_TomlTable):
    """One undeclared effect; see :mod:`fusion.twin.effects` for the names."""

    name: str
    """Name of the effect."""
    amplitude_um: float | None = None
    """Rms about the mean of every target and direction, over those that move; left out: as the parameters give it."""
    amplitude_K: float | None = None
    """Of `camera_offset` and `reflected_source`: the size in K in place of that rms."""
    parameters: dict[str, Any] = field(default_factory=dict)
    """Parameters of the effect; in RECIPE.toml they follow `name`."""


@dataclass(frozen=True)
class AnomalyRecipe(_TomlTable):
    """One anomalous target."""

    target: int
    """Target number, from 1."""
    kind: Literal["structural", "local_temperature", "stick_slip", "step", "wander"] = "structural"
    """Cause; wander is a slow random motion that no measured quantity explains."""
    direction: Literal["both", "positive", "negative"] = "both"
    """Direction of the approaches that it affects."""
    amplitude_um: float = 0.5
    """Rms about the mean of each affected direction."""
    at_cycle: int = 0
    """Of a step: first cycle after it; 0: half-way through the test."""


@dataclass(frozen=True)
class Record(_TomlTable):
    """A record instead of a positioning test: temperature sensors and displacement channels under a random spindle speed."""

    hours: PositiveFloat = 24.0
    """Duration."""
    step_s: PositiveFloat = 60.0
    """Logging interval."""
    sensors: PositiveInt = 10
    """Number of temperature sensors."""
    channels: Annotated[int, Field(gt=0, le=6)] = 3
    """Number of displacement channels (X, Y, Z, A, B, C)."""
    top_speed_rpm: PositiveFloat = 8000.0
    """Spindle speed at full load."""
    mean_hold_min: PositiveFloat = 90.0
    """Mean time for which a speed is held."""
    rest_share: float = 0.25
    """Load below which the spindle rests, 0 to 1."""
    room_swing_K: float = 1.0
    """Amplitude of the daily change of the room temperature."""
    sensitivity_um_per_K: float = 1.5
    """Standard deviation of the channels' sensitivities to the parts' temperatures."""
    noise_K: float = 0.03
    """Standard deviation of a logged temperature."""
    sensor_lag_min: Pair = (0.5, 2.0)
    """Range of the sensors' time constants."""
    noise_um: float = 0.3
    """Standard deviation of a logged displacement."""
    walk_um_per_sqrt_h: float = 0.2
    """Standard deviation of the random walk of each channel after one hour."""
    duty_seed: int = 0
    """Seed of load, room and noise of the same machine on another day; 0: that of the campaign."""
    applied: str = ""
    """Model description that the control runs as its compensation; empty: none."""
    applied_gain: float = 1.0
    """Factor with which that compensation acts."""
    dead_sensor: int = 0
    """Sensor that reads 0 degC after a quarter of the test; 0: none."""


@dataclass(frozen=True)
class Recipe(_TomlTable):
    """Everything the twin needs for one campaign; one attribute per table of RECIPE.toml."""

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
    """Heat sources under the table."""
    room: Room = field(default_factory=Room)
    drift: Drift = field(default_factory=Drift)
    profile: Profile = field(default_factory=Profile)
    laser: Laser = field(default_factory=Laser)
    camera: Camera = field(default_factory=Camera)
    effect: tuple[EffectRecipe, ...] = ()
    """Effects that the campaign file does not declare."""
    anomaly: tuple[AnomalyRecipe, ...] = ()
    """Anomalous targets."""
    record: Record | None = None
    """A record instead of a positioning test."""

    def vary(self, **tables: Any) -> Recipe:
        """Return a copy with some values changed: for each table a dict of the keys to change, or its new value.

        >>> Recipe().vary(campaign={"seed": 7}, effect=(EffectRecipe("dead_path"),)).campaign.seed
        7
        """
        changes: dict[str, Any] = {
            name: replace(getattr(self, name) or Record(), **value) if isinstance(value, dict) else value
            for name, value in tables.items()
        }
        return replace(self, **changes)
