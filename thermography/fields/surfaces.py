"""Surfaces of the table with an emissivity of their own: their cells, and their temperatures calibrated with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import ndimage

from thermography._typing import Array
from thermography.errors import ThermographyError
from thermography.fields.cycle_fields import PARTLY_SEEN_BELOW, SURFACE_EDGE, rate, reference_cycle
from thermography.io.frame import CameraParameters
from thermography.radiometry.emissivity import EmissivityEstimate, KnownState, estimate_emissivity
from thermography.radiometry.planck import (
    ZERO_CELSIUS_K,
    count_line,
    counts_from_temperature,
    signal_slope,
    temperature_from_counts,
)
from thermography.registration.polygon import Polygon


@dataclass(frozen=True, eq=False)
class EmissivityRegion:
    """A part of the table with an emissivity of its own, such as bare steel beside paint.

    Attributes
    ----------
    outline : Polygon
        Name and corners, plan mm.
    emissivity, emissivity_u : float
        Emissivity, above 0 and up to 1, and its standard uncertainty.
    """

    outline: Polygon
    emissivity: float
    emissivity_u: float


@dataclass(frozen=True, eq=False)
class Surface:
    """Cells of the plan that share an emissivity.

    Attributes
    ----------
    name : str
        Name of the region; empty for the rest of the table.
    emissivity, emissivity_u : float
        Emissivity and its standard uncertainty.
    cells : (y, x) ndarray of bool
        Its cells.
    """

    name: str
    emissivity: float
    emissivity_u: float
    cells: NDArray[np.bool_]


def find_surfaces(
    fields: xr.Dataset, regions: Sequence[EmissivityRegion], *, emissivity: float, emissivity_u: float
) -> tuple[list[Surface], NDArray[np.bool_]]:
    """Divide the plan into surfaces of one emissivity each.

    Parameters
    ----------
    fields : Dataset
        Coordinates ``x``, ``y`` (mm) and ``coverage`` (y, x).
    regions : sequence of EmissivityRegion
        A later region covers an earlier one.
    emissivity, emissivity_u : float
        Of the rest of the table.

    Returns
    -------
    surfaces : list of Surface
        The rest of the table first.
    edge : (y, x) ndarray of bool
        Cells that see two surfaces, and their neighbours across the edge, into which the lens blurs the other surface: they belong to none.

    Raises
    ------
    ThermographyError
        A region has no cell of its own.
    """
    x_mm, y_mm = fields["x"].values, fields["y"].values
    owner = np.zeros((len(y_mm), len(x_mm)), int)
    mixed = np.zeros(owner.shape, bool)
    for number, region in enumerate(regions, start=1):
        share = region.outline.cell_shares(x_mm, y_mm)
        owner[share == 1.0] = number
        mixed = np.where(share == 1.0, False, mixed | (share > 0.0))
    spread = ndimage.maximum_filter(owner, 3, mode="nearest") != ndimage.minimum_filter(owner, 3, mode="nearest")
    edge = mixed | spread
    # A partly seen cell was moved to its centre along a gradient that its neighbours across the edge take part in.
    edge |= ndimage.binary_dilation(edge, np.ones((3, 3))) & (fields["coverage"].values < PARTLY_SEEN_BELOW)
    surfaces = [Surface("", emissivity, emissivity_u, (owner == 0) & ~edge)]
    for number, region in enumerate(regions, start=1):
        cells = (owner == number) & ~edge
        if not cells.any():
            raise ThermographyError(
                f"region {region.outline.name}: no cell lies inside and away from its edge, where the lens blurs both surfaces; "
                "give a larger region, at least three cells wide, or smaller cells"
            )
        surfaces.append(Surface(region.outline.name, region.emissivity, region.emissivity_u, cells))
    return surfaces, edge


def calibrate_surfaces(
    fields: xr.Dataset,
    surfaces: Sequence[Surface],
    edge: NDArray[np.bool_],
    parameters: Mapping[str, Sequence[CameraParameters]],
) -> xr.Dataset:
    """Calibrate the surfaces of a field with their own emissivity.

    Parameters
    ----------
    fields : Dataset
        Fields as reduced, calibrated with one emissivity.
    surfaces, edge
        Of `find_surfaces`.
    parameters : mapping of str to sequence of CameraParameters
        With which every ``cycle`` and every block of frames along ``time`` was calibrated.

    Returns
    -------
    Dataset
        With temperatures, rise, rate, spread and noise of the surfaces; cells of the edge are empty and flagged ``surface_edge``.

    Notes
    -----
    The mean temperature of a cell is brought back to counts and calibrated again. Mean and calibration may be exchanged where the
    temperatures of a cell differ little: at emissivity 0.35 a spread of 0.1 K changes the mean by 0.4 mK.
    """
    changed = fields.copy()
    scale = np.ones(fields["temperature"].shape)
    for name in ("temperature", "frame_temperature"):
        along = str(fields[name].dims[0])
        values = fields[name].values.astype(float)
        for surface in surfaces[1:]:
            for k, one in enumerate(parameters[along]):
                before = values[k][surface.cells]
                values[k][surface.cells] = after = _recalibrated(before, one, surface.emissivity)
                if along == "cycle":
                    scale[k][surface.cells] = _sensitivity(before, after, one, surface.emissivity)
        changed[name] = fields[name].copy(data=np.where(edge, np.nan, values).astype(np.float32))
    for name in ("temperature_noise_u", "temperature_rise_noise_u", "temperature_spread"):
        changed[name] = fields[name].copy(data=np.where(edge, np.nan, fields[name].values * scale).astype(np.float32))
    mean = changed["temperature"].values.astype(float)
    rise = mean - mean[reference_cycle(mean)]
    changed["temperature_rise"] = fields["temperature_rise"].copy(data=rise.astype(np.float32))
    rates = rate(mean, fields["cycle_time"].values).astype(np.float32)
    changed["temperature_rate"] = fields["temperature_rate"].copy(data=rates)
    flags = fields["quality_flag"].values | np.where(edge, SURFACE_EDGE, 0).astype(np.uint8)
    changed["quality_flag"] = fields["quality_flag"].copy(data=flags)
    return changed


def measure_emissivity(
    fields: xr.Dataset,
    outline: Polygon,
    states: Sequence[tuple[int, float, float]],
    parameters: CameraParameters,
    *,
    camera_scale: float,
) -> EmissivityEstimate:
    """Estimate the emissivity of a region from two cycles in which a contact sensor has measured its temperature.

    Parameters
    ----------
    fields : Dataset
        Fields as reduced, calibrated with `parameters`.
    outline : Polygon
        The region.
    states : sequence of (cycle, temperature_degC, temperature_u_K)
        Two cycles by their number, the temperature of the region in them, and its standard uncertainty.
    parameters : CameraParameters
        With which the fields were calibrated.
    camera_scale : float
        Relative standard uncertainty of differences that the camera reads.

    Returns
    -------
    EmissivityEstimate
        See `thermography.radiometry.emissivity.estimate_emissivity`.

    Raises
    ------
    ThermographyError
        A cycle is not there or shows nothing of the region, or the states determine no emissivity.
    """
    inside = outline.cell_shares(fields["x"].values, fields["y"].values) == 1.0
    inside = ndimage.binary_erosion(inside, np.ones((3, 3)))
    known = []
    for cycle, celsius, celsius_u in states:
        if cycle not in fields["cycle"].values:
            raise ThermographyError(f"region {outline.name}: there is no cycle {cycle}; name a measured one")
        field = fields.sel(cycle=cycle)
        seen = inside & np.isfinite(field["temperature"].values)
        if not seen.any():
            raise ThermographyError(f"region {outline.name}: cycle {cycle} shows no cell of it away from its edge")
        counts = counts_from_temperature(field["temperature"].values[seen], parameters)
        u_K = float(np.sqrt(np.mean(field["temperature_noise_u"].values[seen].astype(float) ** 2) / seen.sum()))
        gain, _ = count_line(parameters)
        slope = float(gain * signal_slope(celsius + ZERO_CELSIUS_K, parameters))
        known.append(KnownState(float(counts.mean()), u_K * slope, celsius, celsius_u))
    estimate = estimate_emissivity(known[0], known[1], parameters)
    u = float(np.hypot(estimate.emissivity_u, estimate.emissivity * camera_scale))
    if estimate.quality == "undetermined":
        raise ThermographyError(
            f"region {outline.name}: the two states give an emissivity of {estimate.emissivity:.3g} with a standard uncertainty of "
            f"{u:.2g}, which determines none; check their temperatures, or take states that differ more"
        )
    return EmissivityEstimate(estimate.emissivity, u, estimate.reflected_temperature_degC, estimate.quality)


def _recalibrated(celsius: Array, parameters: CameraParameters, emissivity: float) -> Array:
    return temperature_from_counts(counts_from_temperature(celsius, parameters), parameters, emissivity=emissivity)


def _sensitivity(before: Array, after: Array, parameters: CameraParameters, emissivity: float) -> Array:
    """Change of the temperature by its own emissivity per change of that by the emissivity it was calibrated with."""
    ratio = parameters.emissivity / emissivity
    slopes = [signal_slope(celsius + ZERO_CELSIUS_K, parameters) for celsius in (before, after)]
    return np.asarray(ratio * slopes[0] / slopes[1])
