"""Contact sensors on the table: sound by themselves, and as warm as the camera sees their places."""

from __future__ import annotations

import numpy as np
import xarray as xr

from fusion.consistency.plan_sensors import check_sensors, compare_sensors

START = np.datetime64("2026-03-09T08:00", "ns")
MINUTES = START + 60 * np.arange(120) * np.timedelta64(1, "s")
WARMING = 4.0 * (1.0 - np.exp(-np.arange(120) / 40.0))


def logged(*shares: float, seed: int = 3) -> xr.DataArray:
    """Sensors that show a share of the warming each, with 0.02 K of noise."""
    noise = np.random.default_rng(seed).normal(0.0, 0.02, (120, len(shares)))
    values = 20.0 + WARMING[:, None] * np.array(shares) + noise
    return xr.DataArray(
        values, {"time": MINUTES, "sensor": [f"t{k + 1}" for k in range(len(shares))]}, ("time", "sensor")
    )


def fields() -> xr.Dataset:
    """A plan of 5 x 9 cells of 20 mm that warms alike everywhere."""
    frames = np.broadcast_to(20.0 + WARMING[:, None, None], (120, 5, 9))
    plan = {"time": MINUTES, "y": 10.0 + 20.0 * np.arange(5), "x": 10.0 + 20.0 * np.arange(9)}
    rise_u = (("cycle", "y", "x"), np.full((2, 5, 9), 0.05))
    return xr.Dataset({"frame_temperature": (("time", "y", "x"), frames), "temperature_rise_u": rise_u}, plan)


def test_sound_sensors_pass_and_one_that_breaks_is_named() -> None:
    sound = logged(1.0, 0.8, 0.6, 0.9)
    assert check_sensors(sound, file="t.csv")[0].passed
    broken = sound.copy(deep=True)
    broken.values[60:, 2] += 15.0
    (check,) = check_sensors(broken, file="t.csv")
    assert not check.passed and "t3" in check.evidence
    (check,) = check_sensors(sound, file="t.csv", left_out=["t5 jumps by 15 K"])
    assert (
        check.passed and check.evidence.startswith("No other contact sensor") and "left out: t5 jumps" in check.evidence
    )


def test_a_camera_that_reads_the_rise_too_small_is_doubted() -> None:
    x, y = np.array([30.0, 130.0]), np.array([30.0, 70.0])
    (agreeing,) = compare_sensors(fields(), logged(1.0, 1.0), x, y, u_K=0.1)
    assert agreeing.passed and "2 sensors compared" in agreeing.evidence
    (doubted,) = compare_sensors(fields(), logged(1.0, 1.4), x, y, u_K=0.1)
    assert not doubted.passed and doubted.evidence.startswith("At t2 the camera shows a rise of ")


def test_sensors_of_another_time_are_not_compared() -> None:
    late = logged(1.0).assign_coords(time=MINUTES + np.timedelta64(1, "D"))
    assert compare_sensors(fields(), late, np.array([30.0]), np.array([30.0]), u_K=0.1) == []
