"""Objects on a still table: found by size and connectedness, left empty and flagged; heat, noise and common steps are none."""

import json

import numpy as np
import pytest
import xarray as xr

from thermography.fields.cycle_fields import OBJECT
from thermography.fields.objects import describe_unnamed_surfaces, find_abrupt_parts, leave_out_objects
from thermography.io.frame import CameraParameters
from thermography.radiometry.planck import counts_from_temperature, temperature_from_counts

FRAMES, ROWS, COLUMNS, CELL_MM = 28, 36, 80, 5.0
X, Y = CELL_MM * (np.arange(COLUMNS) + 0.5), CELL_MM * (np.arange(ROWS) + 0.5)
DISTANCE_MM = np.hypot(X - 200.0, Y[:, None] - 90.0)


def fields(added_K: np.ndarray) -> xr.Dataset:
    """Two frames a cycle of a table that warms by 2 K, with 30 mK of noise, and what is added (time, y, x)."""
    rng = np.random.default_rng(5)
    warm = 2.0 * (1.0 - np.exp(-np.arange(FRAMES) / 15.0))[:, None, None] * np.exp(-((X - 300.0) ** 2) / 2e4)
    stack = 24.0 + warm + rng.normal(0.0, 0.03, (FRAMES, ROWS, COLUMNS)) + added_K
    mean = stack.reshape(-1, 2, ROWS, COLUMNS).mean(axis=1)
    values = dict.fromkeys(("temperature", "temperature_noise_u", "temperature_rate", "temperature_spread"), mean)
    values |= dict.fromkeys(("temperature_rise", "temperature_rise_noise_u"), mean - mean[0])
    return xr.Dataset(
        {name: (("cycle", "y", "x"), value) for name, value in values.items()}
        | {
            "quality_flag": (("cycle", "y", "x"), np.zeros(mean.shape, np.uint8)),
            "frame_temperature": (("time", "y", "x"), stack),
            "frame_cycle": ("time", 1 + np.arange(FRAMES) // 2),
        },
        coords={
            "time": np.datetime64("2026-03-09T06:30", "ns") + 125 * np.arange(FRAMES) * np.timedelta64(1, "s"),
            "y": Y,
            "x": X,
        },
    )


def lying(diameter_mm: float, step_K: float, first: int, stop: int) -> np.ndarray:
    frame = np.arange(FRAMES)[:, None, None]
    return np.where((frame >= first) & (frame < stop) & (diameter_mm / 2 > DISTANCE_MM), step_K, 0.0)


@pytest.mark.parametrize(("diameter_mm", "step_K"), [(24.0, 1.5), (24.0, -0.8), (100.0, 1.0)])
def test_an_object_is_named_and_left_empty_while_it_lies_there(diameter_mm: float, step_K: float) -> None:
    found = leave_out_objects(fields(lying(diameter_mm, step_K, 8, 16)))
    (part,) = json.loads(found.attrs["abrupt_parts"])
    assert (part["x_mm"], part["y_mm"], part["step_K"]) == pytest.approx((200.0, 90.0, step_K), abs=0.1)
    # Cells of 5 mm round a diameter.
    assert part["size_mm"] == pytest.approx([diameter_mm, diameter_mm], abs=3.0)
    assert (part["since"], part["until"]) == ("2026-03-09T06:46:40", "2026-03-09T07:03:20")
    inside = diameter_mm / 2 > DISTANCE_MM
    shown = np.isfinite(found["temperature_rise"].values[:, inside])
    assert shown[:4].all() and not shown[4:8].any() and shown[8:].all()
    assert ((found["quality_flag"].values[4:8, inside] & OBJECT) > 0).all()
    assert not (found["quality_flag"].values[[0, 3, 8, 13]] & OBJECT).any()
    assert np.isnan(found["frame_temperature"].values[8:16, inside]).all()


def test_an_object_in_the_first_cycle_leaves_no_rise_to_count_from() -> None:
    found = leave_out_objects(fields(lying(40.0, 1.0, 0, 9)))
    inside = DISTANCE_MM < 20.0
    (part,) = json.loads(found.attrs["abrupt_parts"])
    assert (part["since"], part["until"]) == ("2026-03-09T06:30:00", "2026-03-09T06:48:45")
    assert np.isnan(found["temperature_rise"].values[:, inside]).all()


def test_heat_noise_and_a_common_step_are_no_objects() -> None:
    frame = np.arange(FRAMES)[:, None, None]
    flash = np.where(frame >= 9, 1.5 * np.exp(-(frame - 9) / 6.0), 0.0) * np.exp(-(DISTANCE_MM**2) / (2 * 30.0**2))
    step = np.where(frame >= 12, 0.8, 0.0) * np.ones((1, ROWS, COLUMNS))
    for added in (0.0 * step, step):
        assert not find_abrupt_parts(fields(added)["frame_temperature"])
    assert not any(part.sharp for part in find_abrupt_parts(fields(flash)["frame_temperature"]))


def test_what_covers_the_table_is_named_and_kept() -> None:
    found = leave_out_objects(fields(lying(170.0, 1.0, 8, 16)))
    assert len(json.loads(found.attrs["abrupt_parts"])) == 1
    assert np.isfinite(found["temperature_rise"].values).all()


CAMERA = CameraParameters(
    emissivity=0.97, object_distance_m=1.5, reflected_temperature_K=293.15, atmospheric_temperature_K=294.15,
    window_temperature_K=293.15, window_transmission=1.0, stored_transmission=1.0, relative_humidity=0.45, planck_r1=21106.77,
    planck_b=1501.0, planck_f=1.0, planck_o=-7340.0, planck_r2=0.012545258, atmosphere_alpha1=0.006569, atmosphere_alpha2=0.012620,
    atmosphere_beta1=-0.002276, atmosphere_beta2=-0.006670, atmosphere_x=1.9,
)  # fmt: skip


def first_cycle(celsius: np.ndarray) -> xr.Dataset:
    """A cycle with 20 mK of noise whose discs, 80 mm apart, are empty."""
    noise = np.random.default_rng(8).normal(0.0, 0.02, celsius.shape)
    disc = np.hypot((X + 15.0) % 80.0 - 40.0, (Y[:, None] + 10.0) % 80.0 - 40.0) < 16.0
    values = np.where(disc, np.nan, celsius + noise)[None]
    data = {
        "temperature": (("cycle", "y", "x"), values),
        "temperature_noise_u": (("cycle", "y", "x"), 0.02 + 0.0 * values),
    }
    return xr.Dataset(data, coords={"y": Y, "x": X})


@pytest.mark.parametrize("emissivity", [0.35, 0.6])
@pytest.mark.parametrize("diameter_mm", [24.0, 40.0, 56.0])
def test_a_surface_that_no_one_named_is_found_with_the_emissivity_that_explains_it(
    diameter_mm: float, emissivity: float
) -> None:
    celsius = 24.0 + 0.3 * X / X.max() + 0.0 * Y[:, None]
    patch = np.hypot(X - 225.0, Y[:, None] - 70.0) < diameter_mm / 2
    shown = temperature_from_counts(counts_from_temperature(celsius, CAMERA, emissivity=emissivity), CAMERA)
    (found,) = describe_unnamed_surfaces(first_cycle(np.where(patch, shown, celsius)), CAMERA)
    # A cell, and two hundredths of an emissivity where noise of 20 mK stands against 4 K.
    assert (found["x_mm"], found["y_mm"]) == pytest.approx((225.0, 70.0), abs=5.0)
    assert found["size_mm"] == pytest.approx([diameter_mm] * 2, abs=5.0)
    assert found["emissivity"] == pytest.approx(emissivity, abs=0.02)


def test_what_no_emissivity_explains_is_found_without_one() -> None:
    (found,) = describe_unnamed_surfaces(first_cycle(24.0 + np.where(DISTANCE_MM < 25.0, 2.0, 0.0)), CAMERA)
    assert found["emissivity"] is None and found["step_K"] == pytest.approx(2.0, abs=0.05)


def test_warm_sources_gradients_and_discs_are_no_other_surface() -> None:
    source = 3.0 * np.exp(-(DISTANCE_MM**2) / (2 * 30.0**2))
    gradient = 4.0 * X / X.max() + np.exp(-((Y[:, None] / 60.0) ** 2))
    for celsius in (0.0 * source, source, gradient, source + gradient):
        assert describe_unnamed_surfaces(first_cycle(24.0 + celsius), CAMERA) == []
