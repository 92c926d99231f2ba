"""A simulated campaign in the form that perfect instruments and a perfect reduction would hand over, without files.

Studies by simulation run hundreds of campaigns; rendering and reading frames would be all of their time. These Datasets keep the
same contracts as what the instruments hand to the fusion. The fields carry the noise that averaging a frame over a cell leaves.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.errors import FusionError
from fusion.twin.camera import counts_of, make_view
from fusion.twin.machine.effects import EFFECTS
from fusion.twin.machine.streams import stream
from fusion.twin.simulate import Truth

Floats = NDArray[np.floating[Any]]
KELVIN_RISE = {"units": "K", "units_metadata": "temperature: difference"}


def deviations_of(truth: Truth) -> xr.Dataset:
    """Return the measured deviations: deviation (um), time (NaT where lost), position (mm), quality_flag (0)."""
    measured = truth.readings[["deviation", "time"]].copy()
    measured["time"] = measured["time"].where(measured["deviation"].notnull())
    measured["time"].attrs = {"long_name": "time of the reading, recorded"}
    measured["quality_flag"] = (measured["deviation"].dims, np.zeros(measured["deviation"].shape, dtype=np.uint8))
    measured["quality_flag"].attrs["units"] = "1"
    return measured


def fields_of(truth: Truth, *, cell_size_mm: float = 5.0, noise_K: float | None = None) -> xr.Dataset:
    """Return the table's temperature per cycle on the plan grid, as the frames of a still table would give it.

    Parameters
    ----------
    truth : Truth
        From `simulate`, with ``camera.table = "still"``.
    cell_size_mm : float
        Size of a cell; the cell's value is the mean of the true field over it.
    noise_K : float, optional
        Standard deviation per cell; left out: the camera's noise averaged over the pixels that a cell covers.

    Returns
    -------
    xarray.Dataset
        temperature, temperature_rise, their uncertainties and spread (cycle, y, x), frame_temperature (time, y, x), count, cycle_time.
        Effects of the camera are included: its offset, and a reflected source at first order in its own temperature.

    Raises
    ------
    FusionError
        The table moves in the camera's view.
    """
    camera, plan = truth.recipe.camera, truth.recipe.plan
    if camera.table != "still":
        raise FusionError(
            "fields_of needs camera.table = 'still'; write the campaign and reduce its frames for a moving table"
        )
    centre_x = (np.arange(round(plan.width_mm / cell_size_mm)) + 0.5) * cell_size_mm
    centre_y = (np.arange(round(plan.height_mm / cell_size_mm)) + 0.5) * cell_size_mm
    seen = truth.temperature(truth.session.frame_s, centre_x, centre_y, cell_mm=cell_size_mm)
    seen += truth.frames["camera_offset_K"].values[:, None, None]
    seen += truth.frames["reflected_K"].values[:, None, None] * _mirror_gain(truth, centre_x, centre_y)
    pixels = _pixels_per_cell(truth, cell_size_mm)
    sigma = camera.netd_K / np.sqrt(pixels) if noise_K is None else noise_K
    seen += sigma * stream(truth.recipe.campaign.seed, "cell noise").standard_normal(seen.shape)
    cycles, burst = truth.schedule.cycles, camera.frames_per_cycle
    by_cycle = seen.reshape(cycles, burst, *seen.shape[1:])
    mean = by_cycle.mean(axis=1)
    dims = ("cycle", "y", "x")
    level = np.full(mean.shape, sigma / np.sqrt(burst))
    middle_s = truth.session.frame_s.reshape(cycles, burst).mean(axis=1)
    return xr.Dataset(
        {
            "temperature": (dims, mean, {"units": "degC", "units_metadata": "temperature: on_scale"}),
            "temperature_u": (dims, level, KELVIN_RISE),
            "temperature_rise": (dims, mean - mean[0], KELVIN_RISE),
            "temperature_rise_u": (dims, np.sqrt(2.0) * level, KELVIN_RISE),
            "temperature_spread": (dims, by_cycle.std(axis=1), KELVIN_RISE),
            "count": (dims, np.full(mean.shape, burst, dtype=np.int32), {"units": "1"}),
            "cycle_time": ("cycle", truth.clock(middle_s).astype("datetime64[ns]")),
            "frame_temperature": (
                ("time", "y", "x"),
                seen,
                {"units": "degC", "units_metadata": "temperature: on_scale"},
            ),
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


def _mirror_gain(truth: Truth, x_mm: Floats, y_mm: Floats) -> Floats:
    """Return by how many K a cell (y, x) reads high per K of a body that mirrors in it."""
    recipe = truth.recipe
    chosen = [effect.parameters for effect in recipe.effect if effect.name == "reflected_source"]
    spot = EFFECTS["reflected_source"].parameters | (chosen[0] if chosen else {})
    mirrored, start = recipe.camera.reflected_temperature_degC, recipe.table.initial_temperature_degC
    gain = (1.0 - recipe.camera.emissivity) / recipe.camera.emissivity
    gain *= float(
        (counts_of(mirrored + 0.5) - counts_of(mirrored - 0.5)) / (counts_of(start + 0.5) - counts_of(start - 0.5))
    )
    away = (x_mm - spot["x_mm"]) ** 2 + (y_mm[:, None] - spot["y_mm"]) ** 2
    return np.asarray(gain * np.exp(-0.5 * away / spot["spread_mm"] ** 2))
