"""around - The stages of the main job, each one a call of the steps in order: fields, deviations, fusion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from fusion.alignment import align, camera_on_laser_clock, cycle_bounds
from fusion.contracts import check
from fusion.correlation import correlate
from fusion.diagnosis import Diagnosis, diagnose
from fusion.effects import library
from fusion.groups import group, joined
from fusion.loop import LoopResult, close_loop
from fusion.model import ModelFit, fit_model
from fusion.products import write_atomically
from fusion.progress import Report
from fusion.readings import Readings, read_fused
from fusion.results import Notice
from fusion.sources import Source, counted, listed
from interferometry import iso230, neighbours
from interferometry.anomalies import Anomaly, detect_anomalies
from interferometry.drift import estimate_drift, flag_outliers
from thermography.contract import FIELDS
from thermography.exr import write_maps
from thermography.fields import reduce_frames
from thermography.hotspots import Hotspot, detect_hotspots
from thermography.overrides import Overrides
from thermography.radiometry import calibrate
from thermography.registration import Registration, register

#: What each stage is called in progress and provenance.
LABELS = {
    "fields": "thermal fields",
    "deviations": "deviations",
    "correlation": "correlation",
    "model": "anomalies and closed loop",
}
#: The plan is registered on the mean of so many first frames: noise falls, and the table has hardly warmed yet.
_REGISTRATION_FRAMES = 5
_CORRELATION_CELL_MM = 10.0
_KELVIN = 273.15


@dataclass(frozen=True)
class Outcome:
    """What a stage found: its Dataset, its shares of results.json, and what it left out."""

    dataset: xr.Dataset
    parts: dict[str, Any]
    notices: tuple[Notice, ...] = ()


def effect_names() -> tuple[str, ...]:
    """Return the names that a campaign may declare, a user's own effects included."""
    return tuple(library())


def reduce_thermography(source: Source, *, report: Report) -> Outcome:
    """Register the plan on the first frames and reduce all frames to one field per cycle."""
    override = Overrides(campaign_constants(source))
    first = [frame.read() for frame in source.frames[:_REGISTRATION_FRAMES]]
    reference = np.mean([calibrate(frame.counts, override(frame)) for frame in first], axis=0)
    report("registration", 0, 1)
    registration = register(reference, source.fiducials, grid=source.grid)
    report("registration", 1, 1)
    offset = source.thermography.clock_offset_s or 0.0
    bounds = cycle_bounds(source.deviations) + np.timedelta64(round(offset * 1e9), "ns")
    total, done = len(source.frames), 0

    def count(more: int) -> None:
        nonlocal done
        done += more
        report("frames", done, total)

    report("frames", 0, total)
    fields = reduce_frames(source.frames, registration, source.grid, bounds, override=override, progress=count)
    check(fields, FIELDS, name="the fields")
    fields = fields.assign_coords(cycle=source.deviations["cycle"].values)
    for name in ("time", "cycle_time"):
        fields[name] = (fields[name].dims, camera_on_laser_clock(fields[name].values, offset), fields[name].attrs)
    fields = fields.assign(registration_variables(registration, reference))
    fields = fields.assign(target_places(source))
    parts = {
        "registration": {
            "rms_mm": registration.rms_mm,
            "leave_one_out_mm": registration.leave_one_out_mm,
            "frames_rejected": source.frames_rejected,
        },
        "alignment": {
            "clock_offset_s": {"value": offset, "u": 0.0 if source.thermography.clock_offset_s is not None else None}
        },
    }
    return Outcome(fields, parts, tuple(registration_notices(registration)))


def campaign_constants(source: Source) -> dict[str, float]:
    """Return the camera parameters that the campaign file overrides, in the units of the parameters."""
    table = source.thermography
    given = {
        "emissivity": table.emissivity,
        "relative_humidity": table.relative_humidity,
        "object_distance_m": table.object_distance_m,
        "reflected_temperature_K": _kelvin(table.reflected_temperature_degC),
        "atmospheric_temperature_K": _kelvin(table.atmospheric_temperature_degC),
    }
    return {name: value for name, value in given.items() if value is not None}


def _kelvin(celsius: float | None) -> float | None:
    return None if celsius is None else celsius + _KELVIN


def registration_variables(registration: Registration, reference: np.ndarray) -> xr.Dataset:
    """Return the registration as variables: the fiducials with their errors, the homography, and the frame it was made on."""
    names = list(registration.located)
    places = [registration.located[name] for name in names]
    listed = [registration.fiducials[name] for name in names]
    along = {
        "fiducial_x": ([one.x_mm for one in listed], "mm"),
        "fiducial_y": ([one.y_mm for one in listed], "mm"),
        "fiducial_column": ([one.column_px for one in places], "1"),
        "fiducial_row": ([one.row_px for one in places], "1"),
        "fiducial_residual": ([registration.residual_mm[name] for name in names], "mm"),
        "fiducial_leave_one_out": ([registration.leave_one_out_mm[name] for name in names], "mm"),
    }
    variables: dict[str, Any] = {name: ("fiducial", values, {"units": unit}) for name, (values, unit) in along.items()}
    variables["homography"] = (("plan_axis", "sensor_axis"), registration.homography, {"units": "1"})
    variables["reference_frame"] = (
        ("row", "column"), reference.astype("f4"), {"units": "degC", "units_metadata": "temperature: on_scale"},
    )  # fmt: skip
    return xr.Dataset(variables, coords={"fiducial": names})


def registration_notices(registration: Registration) -> list[Notice]:
    """Return one notice for all fiducials that were not used."""
    if not registration.left_out:
        return []
    named = "; ".join(f"{name}: {reason}" for name, reason in registration.left_out.items())
    return [
        Notice(
            "fiducials_left_out",
            f"{len(registration.left_out)} entries of the fiducial list not used: {named}.",
            "Correct the list of fiducials, or clean and repaint the discs; the others carry the registration.",
        )
    ]


def target_places(source: Source) -> xr.Dataset:
    """Return the plan points of the targets, along ``target``."""
    x, y = source.axis.points(source.deviations["position"].values)
    targets = source.deviations["target"].values
    return xr.Dataset(
        {"target_x": ("target", x, {"units": "mm"}), "target_y": ("target", y, {"units": "mm"})},
        coords={"target": targets},
    )


def evaluate_interferometry(source: Source) -> Outcome:
    """Evaluate the readings conventionally, by the paper's differences, by ISO 230-2 and by the joint estimate."""
    deviations = source.deviations
    drift = estimate_drift(deviations)
    deviations = flag_outliers(deviations, drift)
    comparison = neighbours.compare(deviations)
    windows = iso230.evaluate_windows(deviations)
    dataset = joined(
        deviations,
        conventional=neighbours.evaluate_conventional(deviations),
        neighbours=neighbours.evaluate_neighbours(deviations),
        comparison=comparison,
        chart=neighbours.build_chart(deviations),
        iso=windows,
        drift=drift,
    )
    parts = {
        "iso230": iso_part(windows),
        "neighbours": {
            "conventional_s_um": by_direction(comparison["conventional"]),
            "pair_s_um": by_direction(comparison["differenced"]),
            "ratio": by_direction(comparison["ratio"]),
        },
        "drift": {
            "profile_um": by_direction(drift["profile"]),
            "profile_u_um": by_direction(drift["profile_u"]),
            "scatter_um": by_direction(drift["scatter"]),
        },
    }
    return Outcome(dataset, parts)


def iso_part(windows: xr.Dataset) -> dict[str, Any]:
    """Return the axis values of the first window, as the standard's test would have found them."""
    first = windows.isel(window=0)
    values = {f"{name}_um": {"value": float(first[name]), "u": float(first[f"{name}_u"])} for name in iso230.QUANTITIES}
    return {"window": str(first["window"].values), **values}


def by_direction(values: xr.DataArray) -> dict[str, list[float]]:
    """Return an array over direction and target as lists per direction."""
    return {str(name): np.asarray(values.sel(direction=name), float).tolist() for name in values["direction"].values}


def align_recordings(source: Source, fields: xr.Dataset, deviations: xr.Dataset) -> tuple[xr.Dataset, list[Notice]]:
    """Give every reading the field, the environment and the drivers at its own time; note readings outside the frames' time."""
    fused = align(deviations, fields, source.axis, environment=source.environment, drivers=source.drivers)
    return fused, outside_notices(fused)


def correlate_field(fields: xr.Dataset, fused: xr.Dataset, *, report: Report) -> Outcome:
    """Test every part of the field as a source of the drift.

    The cells are averaged to about a centimetre first: within one cycle heat spreads further than that in steel, so nothing is lost
    but noise and time.
    """
    cell = float(np.median(np.diff(fields["x"])))
    block = max(1, int(_CORRELATION_CELL_MM / cell))
    film = fields["frame_temperature"].coarsen(x=block, y=block, boundary="trim").mean()
    report("correlation", 0, 100)
    maps = correlate(fused, film, progress=lambda part: report("correlation", round(100 * part), 100))
    return Outcome(maps, {"hotspots": hotspot_part(fields, maps)})


def model_drift(source: Source, fused: xr.Dataset, deviations: xr.Dataset, *, report: Report) -> Outcome:
    """Find positions that stand out and their cause, then close the loop on the others."""
    report("anomalies", 0, 1)
    anomalies = detect_anomalies(group(deviations, "drift"), deviations)
    diagnoses = diagnose(anomalies, fused)
    report("anomalies", 1, 1)
    readings = read_fused(fused)
    found = close_loop(
        readings,
        source.campaign.model.declared,
        set_aside=[(one.target, name) for one in anomalies for name in directions_of(one.direction)],
        progress=lambda done, total, what: report("closed loop", done, total),
    )
    parts = {
        "anomalies": [anomaly_part(*pair) for pair in zip(anomalies, diagnoses, strict=True)],
        "loop": found.as_json(),
    }
    return Outcome(loop_variables(fused, readings, found), parts)


def join_fusion(fused: xr.Dataset, maps: xr.Dataset, loop: xr.Dataset) -> xr.Dataset:
    """Return everything that joins both recordings in one Dataset, for fusion.nc."""
    dataset = joined(fused, correlation=maps, loop=loop)
    return dataset.assign_attrs({f"correlation_{name}": value for name, value in maps.attrs.items()})


def directions_of(direction: str) -> tuple[str, ...]:
    """Return the approaches that an anomaly concerns."""
    return ("positive", "negative") if direction == "both" else (direction,)


def anomaly_part(anomaly: Anomaly, diagnosis: Diagnosis) -> dict[str, Any]:
    """Return one entry of ``anomalies`` in results.json: what was flagged, its cause, and the evidence for and against it."""
    return {
        "target": anomaly.target,
        "direction": anomaly.direction,
        "p_value": anomaly.p_value,
        "scatter_um": anomaly.scatter_um,
        "cause": diagnosis.cause,
        "evidence": {
            "kind": anomaly.kind,
            "extra_um": anomaly.extra_um,
            "probability": diagnosis.probability,
            "for": list(diagnosis.for_it),
            "against": list(diagnosis.against_it),
            "check": diagnosis.check,
            **diagnosis.evidence,
        },
    }


def outside_notices(fused: xr.Dataset) -> list[Notice]:
    """Return a notice for readings that lie outside the frames' time."""
    outside = (fused["deviation"].notnull() & ~fused["inside_frames"]).values
    if not outside.any():
        return []
    cycles = [str(cycle) for cycle in fused["cycle"].values[outside.any(axis=(1, 2))]]
    return [
        Notice(
            "readings_outside_frames",
            f"{int(outside.sum())} readings lie outside the frames' time, in {counted(len(cycles), 'cycle')} ({listed(cycles)}); "
            "they are evaluated, but take no part in what joins drift and field.",
            "Start the camera before the first cycle and stop it after the last one.",
        )
    ]


def loop_variables(fused: xr.Dataset, readings: Readings, found: LoopResult) -> xr.Dataset:
    """Return the residuals before and after, and what each effect contributes, at every reading."""
    declared = fit_model(readings, found.after.terms[: len(found.declared)])
    dims = ("cycle", "direction", "target")
    shape = tuple(fused.sizes[name] for name in dims)
    place = (
        np.searchsorted(fused["cycle"].values, readings.cycle),
        np.where(readings.sign > 0, 0, 1),
        readings.target_index,
    )

    def spread(values: np.ndarray) -> np.ndarray:
        laid = np.full(shape, np.nan)
        laid[place] = values
        return laid

    terms = found.after.terms
    names = [term.effect for term in terms]
    unique = [name if names.count(name) == 1 else f"{name} {at + 1}" for at, name in enumerate(names)]
    contribution = np.array([spread(found.after.series(term)[0]) for term in terms]).reshape(len(terms), *shape)
    um = {"units": "um"}
    return xr.Dataset(
        {
            "residual_declared": (dims, spread(centred(declared)), um),
            "residual_final": (dims, spread(centred(found.after)), um),
            "contribution": (("effect", *dims), contribution, um),
        },
        coords={"effect": unique},
    )


def centred(fit: ModelFit) -> np.ndarray:
    """Return the readings minus profile and effects, the unexplained drift left in, with mean zero, (n,)."""
    residual = fit.fit.residual()
    return residual - residual.mean()


def hotspot_part(fields: xr.Dataset, maps: xr.Dataset) -> list[dict[str, Any]]:
    """Return the hotspots of the last cycle with the smallest family-wise p of their cells and its lag."""
    return [_hotspot(spot, maps) for spot in detect_hotspots(fields["temperature_rise"].isel(cycle=-1))]


def _hotspot(spot: Hotspot, maps: xr.Dataset) -> dict[str, Any]:
    here = maps.sel(x=spot.x_mm, y=spot.y_mm, method="nearest")
    p = here["p_value"].fillna(1.0)
    at = int(np.argmin(p.values))
    return {
        "x_mm": spot.x_mm,
        "y_mm": spot.y_mm,
        "peak_rise_K": spot.peak_rise_K,
        "targets": [],
        "p_value": float(p[at]),
        "lag_s": float(here["lag"][at]),
    }


def write_exr(folder: Path, fields: xr.Dataset, *, report: Report) -> list[Path]:
    """Write the fields of every cycle as OpenEXR maps and return the files."""
    total = fields.sizes["cycle"]
    paths = []
    for done, cycle in enumerate(fields["cycle"].values):
        report("OpenEXR maps", done, total)
        maps = exr_maps(fields.sel(cycle=cycle))
        path = folder / f"cycle_{cycle:04d}.exr"
        paths.append(write_atomically(path, lambda temporary, maps=maps: write_maps(temporary, maps)))  # type: ignore[misc]
    report("OpenEXR maps", total, total)
    return paths


def exr_maps(field: xr.Dataset) -> Mapping[str, np.ndarray]:
    """Return the maps of one cycle for OpenEXR; the mask is 1 where the table was seen."""
    maps = {
        "temperature": field["temperature"],
        "rise": field["temperature_rise"],
        "uncertainty": field["temperature_u"],
        "mask": np.isfinite(field["temperature"]),
    }
    return {name: np.ascontiguousarray(values, dtype="f4") for name, values in maps.items()}
