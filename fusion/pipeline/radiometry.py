"""Radiometry of a campaign: parameters and their uncertainties, surfaces with an emissivity of their own, total uncertainty."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.campaign.config import SurfaceTable, ThermographyTable
from fusion.campaign.sources import CameraInputs
from fusion.products.notices import counted
from fusion.products.results import Notice, Outcome
from thermography.fields.cycle_fields import cycles_with_field, plan_unit, reference_cycle
from thermography.fields.surfaces import (
    EmissivityRegion,
    Surface,
    calibrate_surfaces,
    find_surfaces,
    measure_emissivity,
)
from thermography.fields.tasks.pieces import in_pieces
from thermography.fields.total_uncertainty import compare_with_monte_carlo, evaluate_uncertainty, find_range
from thermography.io.frame import CameraParameters
from thermography.radiometry.overrides import Overrides
from thermography.radiometry.planck import ZERO_CELSIUS_K, override
from thermography.radiometry.uncertainty import InputUncertainty, common_contributions, rise_scale_contributions
from thermography.registration.polygon import Polygon

#: Attribute of `InputUncertainty` -> attribute of ``[thermography]`` that states it.
_STATED = {
    "emissivity": "emissivity_u",
    "reflected_temperature_K": "reflected_temperature_u_K",
    "atmospheric_temperature_K": "atmospheric_temperature_u_K",
    "relative_humidity": "relative_humidity_u",
    "object_distance_m": "object_distance_u_m",
    "window_transmission": "window_transmission_u",
    "window_temperature_K": "window_temperature_u_K",
    "camera_offset_K": "camera_offset_u_K",
    "camera_scale": "camera_scale_u",
    "camera_drift_K": "camera_drift_u_K",
}


def overridden_parameters(table: ThermographyTable) -> dict[str, float]:
    """Return the camera parameters that the campaign file overrides.

    Parameters
    ----------
    table : ThermographyTable
        ``[thermography]`` of the campaign.

    Returns
    -------
    dict of str to float
        By name of the attribute of `CameraParameters`, in its unit.
    """
    given = {
        "emissivity": table.emissivity,
        "relative_humidity": table.relative_humidity,
        "object_distance_m": table.object_distance_m,
        "reflected_temperature_K": _kelvin(table.reflected_temperature_degC),
        "atmospheric_temperature_K": _kelvin(table.atmospheric_temperature_degC),
        "window_transmission": table.window_transmission,
        "window_temperature_K": _kelvin(table.window_temperature_degC),
    }
    return {name: value for name, value in given.items() if value is not None}


def _kelvin(celsius: float | None) -> float | None:
    return None if celsius is None else celsius + ZERO_CELSIUS_K


def stated_uncertainty(table: ThermographyTable) -> InputUncertainty:
    """Return the uncertainties of the radiometric inputs: those that the campaign states, defaults for the others.

    Parameters
    ----------
    table : ThermographyTable
        ``[thermography]`` of the campaign.
    """
    given = {name: getattr(table, key) for name, key in _STATED.items()}
    return InputUncertainty(**{name: u for name, u in given.items() if u is not None})


def complete_fields(source: CameraInputs, fields: xr.Dataset, parameters: Overrides) -> Outcome[xr.Dataset]:
    """Calibrate the surfaces that have an emissivity of their own, and add the total uncertainties.

    Parameters
    ----------
    source : CameraInputs
        Inputs of the campaign.
    fields : Dataset
        Fields as reduced, their times on the camera's clock, their cycles numbered as the readings.
    parameters : Overrides
        From a frame to the parameters that it was calibrated with.

    Returns
    -------
    Outcome
        The fields, which keep ``thermography.contract.FIELDS``; the part ``radiometry`` of results.json; notices.

    Raises
    ------
    ThermographyError
        A region has no cell, its two states determine no emissivity, or an input is too uncertain for a temperature to be stated.
    """
    table, inputs = source.thermography, stated_uncertainty(source.thermography)
    cameras = {
        along: _parameters_at(source, parameters, fields[time].values)
        for along, time in (("cycle", "cycle_time"), ("time", "time"))
    }
    camera = cameras["cycle"][reference_cycle(fields["temperature"])]
    regions = [_emissivity_region(one, fields, camera, inputs) for one in table.region]
    surfaces, edge = find_surfaces(fields, regions, emissivity=camera.emissivity, emissivity_u=inputs.emissivity)
    if regions:
        fields = calibrate_surfaces(fields, surfaces, edge, cameras)
    fields = evaluate_uncertainty(fields, cameras["cycle"], inputs, surfaces=surfaces if regions else ())
    part = {
        **_two_parts(fields),
        "rise_scale_u": float(fields["rise_scale_u"].mean()),
        "budget": _budget(table, fields, camera, inputs),
        "surfaces": [_surface_part(table, one, fields, camera, inputs) for one in surfaces],
        "edge_cells": int(edge.sum()),
    }
    return Outcome(fields, {"radiometry": part}, (*_edge_notices(edge, regions), *_drift_notices(table, fields)))


def describe_field(fields: xr.Dataset, radiometry: Mapping[str, Any]) -> dict[str, Any]:
    """Return the part ``field`` of results.json.

    Parameters
    ----------
    fields : Dataset
        Keeps ``thermography.contract.FIELDS``.
    radiometry : mapping
        Part ``radiometry`` of results.json.
    """
    rise, times = fields["temperature_rise"], fields["time"].values
    seen = cycles_with_field(rise)
    mean = float(rise.isel(cycle=int(np.flatnonzero(seen)[-1])).mean())
    at = _largest_at(rise)
    cell = rise[at]
    unit = plan_unit(fields)
    since = (fields["cycle_time"].values[at[0]] - fields["cycle_time"].values[seen][0]) / np.timedelta64(1, "s")
    return {
        "fields": int(seen.sum()),
        "frames": int(fields["frame_count"].sum()) if "frame_count" in fields else int(times.size),
        "duration_s": float((times[-1] - times[0]) / np.timedelta64(1, "s")),
        "mean_rise_K": {"value": mean, "u": radiometry["rise_u"]["common_K"]},
        "largest_rise_K": {"value": float(cell), "u": float(fields["temperature_rise_u"][at])},
        "largest_cycle": int(cell["cycle"]),
        "largest_after_s": float(since),
        **{f"largest_{axis}_{unit}": float(cell[axis]) for axis in "xy"},
    }


def _largest_at(rise: xr.DataArray) -> tuple[int, int, int]:
    """Cycle, row and column of the largest rise, the first of equal ones."""
    largest, at = -np.inf, (0, 0, 0)
    for some, piece in in_pieces(rise):
        cycle, y, x = np.unravel_index(int(np.argmax(np.where(np.isnan(piece), -np.inf, piece))), piece.shape)
        if piece[cycle, y, x] > largest:
            largest, at = piece[cycle, y, x], (some.start + int(cycle), int(y), int(x))
    return at


def _parameters_at(
    source: CameraInputs, parameters: Overrides, times: NDArray[np.datetime64]
) -> list[CameraParameters]:
    """Parameters of the frame nearest to each time; frames of one cycle or block hardly ever differ in them."""
    frames = source.frame_times
    last = np.minimum(np.searchsorted(frames, np.where(np.isnat(times), frames[0], times)), len(frames) - 1)
    return [parameters(source.frames[int(k)]) for k in last]


def _emissivity_region(
    table: SurfaceTable, fields: xr.Dataset, camera: CameraParameters, inputs: InputUncertainty
) -> EmissivityRegion:
    """One region of the campaign file, its emissivity measured from two states where it is not given."""
    outline = Polygon(f"region {table.name}", np.array(table.corners_mm))
    if table.states is None:
        assert table.emissivity is not None
        u = inputs.emissivity if table.emissivity_u is None else table.emissivity_u
        return EmissivityRegion(outline, table.emissivity, u)
    states = [(state.cycle, state.temperature_degC, state.temperature_u_K) for state in table.states]
    estimate = measure_emissivity(fields, outline, states, camera, camera_scale=inputs.camera_scale)
    return EmissivityRegion(outline, min(estimate.emissivity, 1.0), estimate.emissivity_u)


def _two_parts(fields: xr.Dataset) -> dict[str, dict[str, float]]:
    """Noise, common part and total of temperature and rise, root mean squares over the cells of the last cycle."""
    parts = {}
    last = _last_field(fields)
    for key, name in (("temperature_u", "temperature"), ("rise_u", "temperature_rise")):
        noise, total = (float(np.sqrt((last[f"{name}{end}"] ** 2).mean())) for end in ("_noise_u", "_u"))
        parts[key] = {"noise_K": noise, "common_K": float(np.sqrt(max(total**2 - noise**2, 0.0))), "total_K": total}
    return parts


def _last_field(fields: xr.Dataset) -> xr.Dataset:
    """The last cycle with a field."""
    return fields.isel(cycle=int(np.flatnonzero(cycles_with_field(fields["temperature"]))[-1]))


def _budget(
    table: ThermographyTable, fields: xr.Dataset, camera: CameraParameters, inputs: InputUncertainty
) -> list[dict[str, Any]]:
    """Every input that all frames share, with its contributions on the main surface at the mean of the last field."""
    last = _last_field(fields)
    mean = float(last["temperature"].mean())
    middle = mean - 0.5 * float(last["temperature_rise"].mean())
    to_temperature = common_contributions(mean, camera, inputs)
    to_rise = rise_scale_contributions(middle, camera, inputs)
    entries = []
    for name, key in _STATED.items():
        if name == "camera_drift_K":
            entries.append(_zero_entry(table, fields, inputs))
            continue
        if camera.window_transmission == 1 and name.startswith("window_") and getattr(inputs, name) == 0:
            continue
        entries.append(
            {
                "input": name,
                "value": getattr(camera, name, None),
                "u": getattr(inputs, name),
                "source": "assumed" if getattr(table, key) is None else "stated",
                "temperature_u_K": abs(float(to_temperature.get(name, 0.0))),
                "rise_u_percent": 100.0 * abs(float(to_rise.get(name, 0.0))),
            }
        )
    return entries


def _zero_entry(table: ThermographyTable, fields: xr.Dataset, inputs: InputUncertainty) -> dict[str, Any]:
    """The entry of the budget for the camera's zero: what its correction leaves, or the drift that is stated or assumed."""
    left_K = _zero_left_K(fields)
    measured = left_K > inputs.camera_drift_K
    return {
        "input": "camera_drift_K",
        "value": None,
        "u": max(left_K, inputs.camera_drift_K),
        "source": "measured" if measured else "assumed" if table.camera_drift_u_K is None else "stated",
        "temperature_u_K": 0.0,
        "rise_u_percent": None,
    }


def _zero_left_K(fields: xr.Dataset) -> float:
    """Largest standard uncertainty of the camera's zero that its correction leaves, K; 0 where it was not examined."""
    left = fields["camera_correction_u"].values if "camera_correction_u" in fields else np.zeros(1)
    return float(np.nan_to_num(left).max())


def _drift_notices(table: ThermographyTable, fields: xr.Dataset) -> list[Notice]:
    """Return a notice where the stated drift of the camera's zero is not the one that the frames leave."""
    stated_K, left_K = table.camera_drift_u_K, _zero_left_K(fields)
    if stated_K is None or left_K == 0.0:
        return []
    larger = "the stated one" if stated_K >= left_K else "that of the frames"
    return [
        Notice(
            "camera_drift_stated",
            f"camera_drift_u = {stated_K:.2g} K is stated; the frames leave up to {left_K:.2g} K of the camera's zero uncertain. The "
            f"larger was taken, {larger}.",
            ""
            if stated_K >= left_K
            else "Leave camera_drift_u out, or keep a surface of constant temperature in view.",
        )
    ]


def _surface_part(
    table: ThermographyTable, surface: Surface, fields: xr.Dataset, camera: CameraParameters, inputs: InputUncertainty
) -> dict[str, Any]:
    """One entry of ``radiometry.surfaces`` in results.json."""
    shown = find_range(fields, surface.cells)
    ratio = scale = None
    if shown is not None:
        own = replace(inputs, emissivity=surface.emissivity_u)
        compared = compare_with_monte_carlo(shown, override(camera, emissivity=surface.emissivity), own)
        ratio, scale = compared.rise_ratio, float(np.nanmean(fields["rise_scale_u"].values[surface.cells]))
    return {
        "name": surface.name.removeprefix("region "),
        "emissivity": {"value": surface.emissivity, "u": surface.emissivity_u},
        "source": _emissivity_source(table, surface.name),
        "cells": int(surface.cells.sum()),
        "rise_scale_u": scale,
        "monte_carlo_ratio": ratio,
    }


def _emissivity_source(table: ThermographyTable, name: str) -> str:
    """Where the emissivity of a surface comes from."""
    for region in table.region:
        if name == f"region {region.name}":
            return "stated" if region.states is None else "two states"
    return "frames" if table.emissivity is None else "stated"


def _edge_notices(edge: NDArray[np.bool_], regions: list[EmissivityRegion]) -> list[Notice]:
    """Return a notice for the cells that see two surfaces."""
    if not regions:
        return []
    named = ", ".join(region.outline.name for region in regions)
    return [
        Notice(
            "surface_edges",
            f"{counted(int(edge.sum()), 'cell')} at the edges of {named} see two surfaces and were left empty.",
            "",
        )
    ]
