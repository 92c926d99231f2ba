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

    __pydantic_config__: ClassVar = ConfigDict(extra="forbid", revalidate_instances="always", allow_inf_nan=False)


@dataclass(frozen=True)
class Campaign(_TomlTable):
    """What the campaign is called and when it took place.

    Attributes
    ----------
    title, axis : title of the report, name of the measured axis
    start : start of the test, UTC, ISO 8601
    seed : seed of every random series; the same recipe with the same seed writes the same files
    further : tables that are added to the campaign file as they are: what a laboratory states of a test
    """

    title: str = "Twin"
    axis: str = "X"
    start: str = "2026-03-09T06:30:00"
    seed: int = 1
    further: str = ""


@dataclass(frozen=True)
class Test(_TomlTable):
    """The bidirectional positioning test.

    Attributes
    ----------
    cycles : number of cycles; in each, every target is approached from both directions
    targets, spacing_mm, jitter_mm : int, float, float
        Evenly spaced targets from position 0, all but the first and the last offset at random by up to `jitter_mm`.
    positions_mm : target positions, increasing; they replace `targets`, `spacing_mm` and `jitter_mm`
    feed_mm_per_min, dwell_s, reversal_s : feed, dwell before a reading, time between the last forward and the first backward reading
    period_s : time from the start of one cycle to that of the next
    missing_fraction : probability that a reading is lost, 0..1
    """

    cycles: PositiveInt = 60
    targets: int = 16
    spacing_mm: float = 20.0
    jitter_mm: float = 0.0
    positions_mm: tuple[float, ...] = ()
    feed_mm_per_min: PositiveFloat = 300.0
    dwell_s: float = 2.0
    reversal_s: float = 12.0
    period_s: PositiveFloat = 252.0
    missing_fraction: float = 0.0


@dataclass(frozen=True)
class Duty(_TomlTable):
    """Load of the machine over time, as a fraction of full load.

    Attributes
    ----------
    kind : str
        "random": levels between `low` and `high` held for random times; "constant": always `high`; "switched": `low` and `high`
        alternate; "randomised": they alternate by the law that the campaign file states.
    low, high : range of the load
    mean_hold_min : mean time for which a level is held
    least_hold_min : of "randomised": minimum hold; the remainder is exponentially distributed
    """

    kind: Literal["random", "constant", "switched", "randomised"] = "random"
    low: float = 0.0
    high: float = 1.0
    mean_hold_min: PositiveFloat = 30.0
    least_hold_min: float = 0.0


@dataclass(frozen=True)
class Plan(_TomlTable):
    """Plan of the table with the measured line and the disc fiducials.

    Attributes
    ----------
    width_mm, height_mm : size of the table
    origin_mm, direction : tuple of two floats
        Plan point under the spindle at axis position 0, and unit vector in which that point moves as the axis position grows.
    fiducial_diameter_mm : diameter of the discs
    fiducials_x_mm, fiducials_y_mm : coordinates of the discs' centres, one each per disc
    hint_error_px : standard deviation of the rough pixel positions that are written with the fiducials
    """

    width_mm: PositiveFloat = 700.0
    height_mm: PositiveFloat = 180.0
    origin_mm: Pair = (500.0, 90.0)
    direction: Pair = (-1.0, 0.0)
    fiducial_diameter_mm: PositiveFloat = 16.0
    fiducials_x_mm: tuple[float, ...] = (40, 195, 350, 505, 660, 40, 195, 350, 505, 660, 115, 590)
    fiducials_y_mm: tuple[float, ...] = (18, 20, 17, 19, 21, 161, 163, 160, 164, 159, 88, 92)
    hint_error_px: float = 4.0


@dataclass(frozen=True)
class Table(_TomlTable):
    """The table as a plate of cast iron.

    Attributes
    ----------
    thickness_mm, conductivity_W_per_mK, density_kg_per_m3, heat_capacity_J_per_kgK : thickness and material
    convection_W_per_m2K : heat transfer to the air, sum over both faces
    initial_temperature_degC : uniform temperature at the start of the pre-heat
    preheat_min : time for which the machine runs before the test
    """

    thickness_mm: PositiveFloat = 40.0
    conductivity_W_per_mK: PositiveFloat = 52.0
    density_kg_per_m3: PositiveFloat = 7200.0
    heat_capacity_J_per_kgK: PositiveFloat = 460.0
    convection_W_per_m2K: PositiveFloat = 18.0
    initial_temperature_degC: float = 23.5
    preheat_min: float = 0.0


@dataclass(frozen=True)
class Source(_TomlTable):
    """One heat source under the table with a Gaussian footprint.

    Attributes
    ----------
    name : str
    x_mm, y_mm, spread_x_mm, spread_y_mm : centre of the footprint on the plan and its standard deviations
    power_W : power into the table at full load
    time_constant_min : first-order lag between the load and the power
    follows : "duty": the logged load; "constant": full load from the start; "own": a switched load that is not logged
    """

    name: str
    x_mm: float
    y_mm: float
    spread_x_mm: float
    spread_y_mm: float
    power_W: float
    time_constant_min: float = 10.0
    follows: Literal["duty", "constant", "own"] = "duty"


@dataclass(frozen=True)
class Room(_TomlTable):
    """Air around the machine.

    Attributes
    ----------
    temperature_degC, trend_K_per_h, swing_K, swing_period_min : float
        Temperature at the start, its linear trend, and amplitude and period of its swing.
    pressure_hPa, pressure_walk_hPa_per_sqrt_h : pressure at the start, and standard deviation of its random walk after one hour
    humidity_percent : relative humidity at the start
    probe_lag_min : time constant of the material temperature sensor
    """

    temperature_degC: float = 23.5
    trend_K_per_h: float = 0.1
    swing_K: float = 0.15
    swing_period_min: float = 47.0
    pressure_hPa: float = 1000.0
    pressure_walk_hPa_per_sqrt_h: float = 0.4
    humidity_percent: float = 42.0
    probe_lag_min: float = 6.0


@dataclass(frozen=True)
class Drift(_TomlTable):
    """Drift by the declared effects, and drift without a physical cause.

    Attributes
    ----------
    expansion_ppm_per_K, offset_um_per_K : coefficients of `axis_expansion` and `table_offset`
    walk : kind of the drift without a cause: "none", "random_walk", "integrated" (random walk) or "ou" (Ornstein-Uhlenbeck)
    walk_common_um_per_sqrt_h, walk_slope_um_per_sqrt_h : float
        Its standard deviation after one hour ("ou": in the long run), common to all positions, and at the far end of the travel.
    """

    expansion_ppm_per_K: float = 11.7
    offset_um_per_K: float = -1.6
    walk: Literal["none", "random_walk", "integrated", "ou"] = "random_walk"
    walk_common_um_per_sqrt_h: float = 0.15
    walk_slope_um_per_sqrt_h: float = 0.1


@dataclass(frozen=True)
class Profile(_TomlTable):
    """Static positioning error.

    Attributes
    ----------
    slope_um, bow_um : error at the far end of the travel, and height of a parabola over the travel
    rough_um : standard deviation of an independent error of every target
    pitch_um, lead_mm : amplitude and period of the cyclic error of the screw
    reversal_um : mean reversal error; it varies by 15 % between targets
    """

    slope_um: float = 3.0
    bow_um: float = 1.0
    rough_um: float = 0.6
    pitch_um: float = 0.2
    lead_mm: PositiveFloat = 5.0
    reversal_um: float = 0.9


@dataclass(frozen=True)
class Laser(_TomlTable):
    """The laser interferometer.

    Attributes
    ----------
    noise_um, noise_spread : float
        Standard deviation of a reading's random error, and of the logarithm of that standard deviation over the targets.
    tails : "normal", or "t4": Student's t with 4 degrees of freedom, scaled to the same standard deviation
    file : format of the laser file: "csv" or "rtl"
    stated_expansion_ppm_per_K : expansion coefficient that the campaign file states
    """

    noise_um: float = 0.4
    noise_spread: float = 0.0
    tails: Literal["normal", "t4"] = "normal"
    file: Literal["csv", "rtl"] = "csv"
    stated_expansion_ppm_per_K: float = 11.7


@dataclass(frozen=True)
class Camera(_TomlTable):
    """The thermal camera, with the calibration of a FLIR SC660.

    Attributes
    ----------
    table : str
        "still": `frames_per_cycle` frames, `burst_interval_s` apart, from `frame_after_s` after a cycle's last reading on, with the
        table at axis position 0. "moving": a frame every `frame_interval_s` throughout the test.
    file : format of the frames: "jpg" or "seq"
    columns, rows, focal_px, k1 : size of the detector, focal length, coefficient of the radial distortion 1 + k1 r^2
    distance_mm, centre_mm, tilt_deg, pan_deg, roll_deg : float, tuple of two floats, float, float, float
        Distance to the plan point in the centre of the view, that point, and rotations about x, y and the optical axis.
    blur_px : standard deviation of the optical blur
    emissivity, disc_emissivity : emissivity of the painted table and of the discs
    reflected_temperature_degC, atmospheric_temperature_degC, relative_humidity : float
        Reflected apparent temperature, and state of the air in the optical path (humidity 0..1).
    netd_K, fixed_pattern_K : standard deviations of the temporal noise (NETD at 25 degC) and of the fixed pattern
    ffc_step_K, ffc_interval_min : float
        Standard deviation of the offset after a flat-field correction (FFC), and the interval of those corrections.
    drift_K_per_K : offset of all pixels per K of warming of the camera's housing
    bad_pixels : number of pixels that always show the same value
    knock_cycle, knock_px : cycle from which on the view is displaced (0: never), and the displacement in columns and rows
    clock_offset_s, state_clock_offset : camera clock minus laser clock, and whether the campaign file states it
    """

    table: Literal["still", "moving"] = "still"
    frame_after_s: float = 30.0
    frames_per_cycle: PositiveInt = 1
    burst_interval_s: PositiveFloat = 0.2
    frame_interval_s: PositiveFloat = 10.0
    file: Literal["jpg", "seq"] = "jpg"
    columns: PositiveInt = 640
    rows: PositiveInt = 480
    focal_px: PositiveFloat = 1530.0
    k1: float = -0.3
    distance_mm: PositiveFloat = 1760.0
    centre_mm: Pair = (348.0, 92.0)
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
    ffc_interval_min: PositiveFloat = 15.0
    drift_K_per_K: float = 0.0
    bad_pixels: int = 0
    knock_cycle: int = 0
    knock_px: Pair = (3.0, 0.0)
    clock_offset_s: float = 0.0
    state_clock_offset: bool = True


@dataclass(frozen=True)
class EffectRecipe(_TomlTable):
    """One undeclared effect; see :mod:`fusion.twin.effects` for the names.

    Attributes
    ----------
    name : str
    amplitude_um : float or None
        Rms about the mean of every target and direction, over those that move; None keeps the size that the parameters give.
    amplitude_K : of `camera_offset` and `reflected_source`: size in K instead of an rms in um
    parameters : the effect's own parameters; in RECIPE.toml they follow `name`
    """

    name: str
    amplitude_um: float | None = None
    amplitude_K: float | None = None
    parameters: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class AnomalyRecipe(_TomlTable):
    """One anomalous target.

    Attributes
    ----------
    target : target number, from 1
    kind : cause; "wander" is a slow random motion that no measured quantity explains
    direction : approaches that it affects
    amplitude_um : rms about the mean of each affected direction
    at_cycle : of "step": first cycle after the step; 0: half-way through the test
    """

    target: int
    kind: Literal["structural", "local_temperature", "stick_slip", "step", "wander"] = "structural"
    direction: Literal["both", "positive", "negative"] = "both"
    amplitude_um: float = 0.5
    at_cycle: int = 0


@dataclass(frozen=True)
class Record(_TomlTable):
    """A record instead of a positioning test: temperature sensors and displacement channels under a random spindle speed.

    Attributes
    ----------
    hours, step_s : float
        Duration and logging interval.
    sensors, channels : int
        Numbers of temperature sensors and of displacement channels (X, Y, Z, A, B, C).
    top_speed_rpm, mean_hold_min, rest_share : float
        Spindle speed at full load, mean time for which a speed is held, and the load below which the spindle rests.
    room_swing_K : float
        Amplitude of the daily swing of the room temperature.
    sensitivity_um_per_K : float
        Standard deviation of the channels' sensitivities to the parts' temperatures.
    noise_K, noise_um : float
        Standard deviations of a logged temperature and of a logged displacement.
    sensor_lag_min : tuple of two floats
        Range of the sensors' time constants.
    walk_um_per_sqrt_h : float
        Standard deviation after one hour of the random walk of each channel.
    duty_seed : int
        Seed of what the same machine does on another day: duty, room, noise; 0: that of the campaign.
    applied, applied_gain : str and float
        Model description that the control runs as its compensation, and the factor with which it acts; empty: none.
    dead_sensor : int
        Sensor that reads 0 degC after a quarter of the test; 0: none.
    """

    hours: PositiveFloat = 24.0
    step_s: PositiveFloat = 60.0
    sensors: PositiveInt = 10
    channels: Annotated[int, Field(gt=0, le=6)] = 3
    top_speed_rpm: PositiveFloat = 8000.0
    mean_hold_min: PositiveFloat = 90.0
    rest_share: float = 0.25
    room_swing_K: float = 1.0
    sensitivity_um_per_K: float = 1.5
    noise_K: float = 0.03
    sensor_lag_min: Pair = (0.5, 2.0)
    noise_um: float = 0.3
    walk_um_per_sqrt_h: float = 0.2
    duty_seed: int = 0
    applied: str = ""
    applied_gain: float = 1.0
    dead_sensor: int = 0


@dataclass(frozen=True)
class Recipe(_TomlTable):
    """Everything the twin needs for one campaign; one attribute per table of RECIPE.toml.

    Attributes
    ----------
    campaign, test, duty, plan, table, room, drift, profile, laser, camera
        See their classes.
    source : heat sources under the table
    effect : effects that the campaign file does not declare
    anomaly : anomalous targets
    record : a record instead of a positioning test
    """

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
        """Return a copy with some values changed: for each table a dict of the keys to change, or its new value.

        >>> Recipe().vary(campaign={"seed": 7}, effect=(EffectRecipe("dead_path"),)).campaign.seed
        7
        """
        changes: dict[str, Any] = {
            name: replace(getattr(self, name) or Record(), **value) if isinstance(value, dict) else value
            for name, value in tables.items()
        }
        return replace(self, **changes)
