"""The truth of a simulated campaign as the Datasets that ideal instruments and an ideal reduction would hand over, without files.

Studies by simulation run hundreds of campaigns; rendering and reading frames would take nearly all of their time. These Datasets keep
the contracts of the instruments' own. The fields carry the noise that remains after averaging a frame over a cell.
"""

from __future__ import annotations

import numpy as np
import xarray as xr

from fusion.common import Array, FusionError
from fusion.twin.camera import counts_of, make_view, reflected_spot
from fusion.twin.machine import stream
from fusion.twin.simulate import Truth

_ON_SCALE = {"units": "degC", "units_metadata": "temperature: on_scale"}
_DIFFERENCE = {"units": "K", "units_metadata": "temperature: difference"}


def deviations_of(truth: Truth) -> xr.Dataset:
    """Return the measured deviations of a simulated campaign."""
    measured = truth.readings[["deviation", "time"]].copy()
    measured["time"] = measured["time"].where(measured["deviation"].notnull())
    measured["time"].attrs = {"long_name": "time of the reading, recorded"}
    measured["quality_flag"] = (measured["deviation"].dims, np.zeros(measured["deviation"].shape, dtype=np.uint8))
    measured["quality_flag"].attrs["units"] = "1"
    return measured


def fields_of(truth: Truth, *, cell_size_mm: float = 5.0, noise_K: float | None = None) -> xr.Dataset:
    """Return the table's temperature per cycle on the plan grid, as the frames of a still table would give it."""
    camera, plan = truth.recipe.camera, truth.recipe.plan
    if camera.table != "still":
        raise FusionError(
            "fields_of needs camera.table = 'still'; write the campaign and reduce its frames for a moving table"
        )
    centre_x = (np.arange(round(plan.width_mm / cell_size_mm), dtype=float) + 0.5) * cell_size_mm
    centre_y = (np.arange(round(plan.height_mm / cell_size_mm), dtype=float) + 0.5) * cell_size_mm
    frames = truth.temperature(truth.session.frame_s, centre_x, centre_y, cell_mm=cell_size_mm)
    frames += truth.frames["camera_offset_K"].values[:, None, None]
    frames += truth.frames["reflected_K"].values[:, None, None] * _reflection_gain(truth, centre_x, centre_y)
    pixels = _pixels_per_cell(truth, cell_size_mm)
    sigma = camera.netd_K / np.sqrt(pixels) if noise_K is None else noise_K
    frames += sigma * stream(truth.recipe.campaign.seed, "cell noise").standard_normal(frames.shape)
    cycles, burst = truth.schedule.cycles, camera.frames_per_cycle
    by_cycle = frames.reshape(cycles, burst, *frames.shape[1:])
    mean = by_cycle.mean(axis=1)
    dims = ("cycle", "y", "x")
    uncertainty = np.full(mean.shape, sigma / np.sqrt(burst))
    middle_s = truth.session.frame_s.reshape(cycles, burst).mean(axis=1)
    return xr.Dataset(
        {
            "temperature": (dims, mean, _ON_SCALE),
            "temperature_u": (dims, uncertainty, _DIFFERENCE),
            "temperature_rise": (dims, mean - mean[0], _DIFFERENCE),
            "temperature_rise_u": (dims, np.sqrt(2.0) * uncertainty, _DIFFERENCE),
            "temperature_noise_u": (dims, uncertainty, _DIFFERENCE),
            "temperature_rise_noise_u": (dims, np.sqrt(2.0) * uncertainty, _DIFFERENCE),
            "rise_scale_u": (dims[1:], np.zeros(uncertainty.shape[1:]), {"units": "1"}),
            "rise_reflected_u": ("cycle", np.zeros(cycles), _DIFFERENCE),
            "temperature_spread": (dims, by_cycle.std(axis=1), _DIFFERENCE),
            "count": (dims, np.full(mean.shape, burst, dtype=np.int32), {"units": "1"}),
            "cycle_time": ("cycle", truth.clock(middle_s).astype("datetime64[ns]")),
            "frame_temperature": (("time", "y", "x"), frames, _ON_SCALE),
        },
        coords={
            "cycle": truth.readings["cycle"].values,
            "time": truth.clock(truth.session.frame_s).astype("datetime64[ns]"),
            "y": ("y", centre_y, {"units": "mm"}),
            "x": ("x", centre_x, {"units": "mm"}),
        },
    )


def _pixels_per_cell(truth: Truth, cell_size_mm: float) -> float:
    """Return how many pixels a cell in the middle of the plan covers."""
    view = make_view(truth.recipe.camera)
    centre = np.array([truth.recipe.plan.width_mm, truth.recipe.plan.height_mm]) / 2.0
    corners = centre + 0.5 * cell_size_mm * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    column, row = view.to_sensor(corners).T
    return float(0.5 * abs(np.dot(column, np.roll(row, -1)) - np.dot(row, np.roll(column, -1))))


def _reflection_gain(truth: Truth, x_mm: Array, y_mm: Array) -> Array:
    """Return by how many K a cell (y, x) reads high per K of a body that is reflected in it."""
    recipe = truth.recipe
    reflected, start = recipe.camera.reflected_temperature_degC, recipe.table.initial_temperature_degC
    per_K = [counts_of(at + 0.5) - counts_of(at - 0.5) for at in (reflected, start)]
    gain = (1.0 - recipe.camera.emissivity) / recipe.camera.emissivity * float(per_K[0] / per_K[1])
    return gain * reflected_spot(recipe, x_mm, y_mm[:, None])
