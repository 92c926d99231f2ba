"""False drifts of the camera's zero: level of the background of a perfect camera, its housing and the air logged with real noise.

Reproduces a figure of docs/measured.csv. The room swings, is held by a thermostat, wanders or ramps; walls follow the air at once or
slowly. ``THERMOFUSE_RUNS`` sets the number of series of each of the sixteen kinds of room and housing.
"""

from __future__ import annotations

import os
from itertools import product

import numpy as np
import pytest

from thermography.common import Array
from thermography.radiometry.camera import LevelSeries, estimate_correction, room_temperatures

pytestmark = pytest.mark.slow

RUNS = int(os.environ.get("THERMOFUSE_RUNS", "25"))
#: Standard deviations of the sensors of a housing, K, of an air log, K, and of the mean of the background, K.
HOUSING_K, AIR_K, BACKGROUND_K = (0.0, 0.006, 0.012, 0.019), 0.01, 5e-4
INTERVAL_S, STEP_S = 125.0, 10.0
#: The housing warms by this, K, with a time constant of 40 min.
WARMS_K = 0.5


@pytest.mark.parametrize(
    ("wall", "level_of_test"),
    # What slow walls hold from before the log decays as a housing warms: only a log that begins long before the frames tells it.
    [("thin", 0.01), ("mixed", 0.25)],
)
def test_a_perfect_camera_has_no_drift_of_its_zero(wall, level_of_test):
    corrected, counted = 0, 0
    for room, housing_K in product(("swing", "thermostat", "walk", "ramp"), HOUSING_K):
        found = sum(
            estimate_correction(level(seed, 28 if seed % 2 else 60, room, wall, housing_K)).corrects
            for seed in range(9100, 9100 + RUNS)
        )
        corrected, counted = corrected + found, counted + RUNS
        print(f"{room}, {wall} walls, housing ± {1e3 * housing_K:.0f} mK: {found} of {RUNS} corrected")
    print(f"false drifts of the zero, {wall} walls: {corrected} of {counted}")
    assert corrected <= max(1, level_of_test * counted)


def level(seed: int, frames: int, room: str, wall: str, housing_K: float) -> LevelSeries:
    """What a camera without any drift shows of the surroundings, 7 % of which reflect something constant."""
    rng = np.random.default_rng((seed, frames))
    seconds = INTERVAL_S * np.arange(frames)
    logged = np.arange(0.0, seconds[-1] + 120.0, 60.0)
    fine = np.arange(-7200.0, logged[-1] + 1.0, STEP_S)
    air = _air(room, fine, rng)
    slow = _lagged(air, 1800.0)
    surface = np.interp(seconds, fine, air if wall == "thin" else (air + slow) / 2)
    warmed = 300.0 + WARMS_K * (1.0 - np.exp(-seconds / 2400.0))
    log = np.round(np.interp(logged, fine, air) + rng.normal(0, AIR_K, logged.size), 3)
    return LevelSeries(
        seconds,
        0.93 * surface + rng.normal(0, BACKGROUND_K, frames),
        23.0 + 3.0 * (1.0 - np.exp(-seconds / 5000.0)) + rng.normal(0, BACKGROUND_K, frames),
        warmed[:, None] + [0.0, -0.8] + rng.normal(0, housing_K, (frames, 2)),
        room_temperatures(seconds, logged, log),
    )


def _air(room: str, seconds: Array, rng: np.random.Generator) -> Array:
    wander = 0.05 * np.cumsum(rng.normal(0, np.sqrt(STEP_S / 3600.0), seconds.size))
    if room == "swing":
        return np.asarray(24.0 + 0.3 * np.sin(2 * np.pi * (seconds / 5200.0 + rng.random())))
    if room == "walk":
        return np.asarray(23.5 + 0.15 * np.sin(2 * np.pi * (seconds / 2820.0 + rng.random())) + wander)
    if room == "ramp":
        return np.asarray(23.5 + rng.uniform(-1, 1) * seconds / 7200.0 + wander)
    half, warming, cooling = rng.uniform(0.15, 0.4), rng.uniform(0.2, 0.6), rng.uniform(0.4, 1.2)
    air, cools = np.full(seconds.size, 23.5), True
    for i in range(1, seconds.size):
        air[i] = air[i - 1] + STEP_S / 1000.0 * (-cooling if cools else warming)
        cools = air[i] > 23.5 - half if cools else air[i] > 23.5 + half
    return _lagged(air, 120.0)


def _lagged(air: Array, constant_s: float) -> Array:
    """What follows the air with a time constant."""
    kept, lagged = np.exp(-STEP_S / constant_s), air.copy()
    for i in range(1, air.size):
        lagged[i] = kept * lagged[i - 1] + (1.0 - kept) * air[i]
    return lagged
