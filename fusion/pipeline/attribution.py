"""The correlation stage: test field and loads as sources of the drift, choose contact sensors, and give the results their JSON form."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import scipy
import xarray as xr

from fusion.analysis.attribution.correlate import (
    area_of,
    coarsen_field,
    correlate,
    find_source,
    mode_cells,
)
from fusion.analysis.attribution.duty import randomisation_test
from fusion.analysis.attribution.modes import Region, cluster_cells, disc
from fusion.analysis.attribution.sensors import SensorChoice, choose_sensors
from fusion.analysis.levels import ATTRIBUTION_LEVEL
from fusion.campaign.inputs import Source
from fusion.campaign.time_zones import utc
from fusion.common import Array
from fusion.pipeline.drift_model import place_scale_u, scaled
from fusion.pipeline.positioning import average_cycles
from fusion.report.wording import say
from fusion.results import axis as schema
from fusion.results.parts import AreaPart, Quantity, Sensitivity
from fusion.results.progress import Report
from fusion.results.results import Outcome, Parts
from thermography.fields.cycle_fields import CLIPPED, OBJECT, SURFACE_EDGE
from thermography.fields.hotspots import Hotspot, detect_hotspots
from thermography.fields.objects import EDGE_MM

#: Hotspots are tested on cells that are seen in more than this share of the frames.
_SEEN_SHARE = 0.8


def correlate_field(source: Source, fields: xr.Dataset, fused: xr.Dataset, *, report: Report) -> Outcome[xr.DataTree]:
    """Run the correlation stage."""
    field = coarsen_field(fields)
    # What the parts of results.json say of targets needs all readings as they are.
    readings = fused
    fused, field, averaged = average_cycles(fused, field)
    spots = _find_hotspots(fields)
    report("correlation", 0, 100)
    regions = [*source.regions, *_hotspot_regions(spots, field)]

    def progress(part: float) -> None:
        report("correlation", round(100 * part), 100)

    maps = correlate(fused, field, regions=regions, per_target=True, progress=progress)
    report("correlation", 100, 100)
    report("sensor places", 0, 1)
    maps["clusters"] = xr.DataTree(cluster_cells(field))
    maps["sensors"] = xr.DataTree(_describe_sensors(choose_sensors(fused, field)))
    report("sensor places", 1, 1)
    if source.duty is not None:
        schedule, law = source.duty
        maps["duty"] = xr.DataTree(randomisation_test(fused, schedule, law))
    plan, shape = field.to_dataset(name="field"), (field.sizes["y"], field.sizes["x"])
    areas = {region.name: area_of(region.cells(field).reshape(shape), plan) for region in regions}
    named = {f"hotspot {k}": spot for k, spot in enumerate(spots, start=1)}
    parts = Parts(
        hotspots=[_hotspot(name, spot, fields, **_tested(name, maps, readings)) for name, spot in named.items()],
        correlation=_describe_correlation(maps, find_source(maps), fields, areas),
    )
    return Outcome(maps, parts, tuple(averaged))


def describe_hotspots(fields: xr.Dataset) -> tuple[schema.HotspotPart, ...]:
    """Return the hotspots where no drift was measured, or too little of it to be tested."""
    spots = _find_hotspots(fields)
    return tuple(_hotspot(f"hotspot {k}", spot, fields) for k, spot in enumerate(spots, start=1))


def _find_hotspots(fields: xr.Dataset) -> list[Hotspot]:
    """The hotspots of all cycles, but objects, unnamed surfaces, and those whose height the emissivity of a named surface may have made."""
    flags, x, y = fields["quality_flag"].values, fields["x"].values, fields["y"].values
    rise = fields["temperature_rise"].where((flags & OBJECT) == 0)
    # A corner of such a surface and the edge that its step has: the table beside it looks like a peak.
    unnamed = json.loads(fields.attrs.get("unnamed_surfaces", "[]"))
    surfaces = [(one, np.hypot(*one["size_mm"]) / 2 + EDGE_MM) for one in unnamed]
    # By an object cells show a part of it, by clipped ones the source is hotter than any that is seen.
    hidden = scipy.ndimage.binary_dilation((flags & (OBJECT | CLIPPED)) > 0, np.ones((1, 5, 5)))
    spots = []
    for spot in detect_hotspots(rise, noise_u=fields["temperature_rise_noise_u"]):
        if all(np.hypot(spot.x_mm - one["x_mm"], spot.y_mm - one["y_mm"]) > reach for one, reach in surfaces):
            at = spot.cycle, np.abs(y - spot.y_mm).argmin(), np.abs(x - spot.x_mm).argmin()
            spots.append(replace(spot, masked=spot.masked or bool(hidden[at])))
    if "rise_scale_u" not in fields:
        return spots
    border = scipy.ndimage.binary_dilation((flags & SURFACE_EDGE).any(axis=0), np.ones((3, 3)))
    kept = []
    for spot in spots:
        left, right, low, high = spot.extent_mm
        zone = np.ix_((y > low) & (y < high), (x > left) & (x < right))
        scale = fields["rise_scale_u"].values[zone]
        if not border[zone].any() or spot.prominence_K > 2.0 * np.nanmax(scale) * spot.peak_rise_K:
            kept.append(spot)
    return kept


def _hotspot(name: str, spot: Hotspot, fields: xr.Dataset, **tested: Any) -> schema.HotspotPart:
    """Place, time, area and rise of a hotspot; without results where it was not tested."""
    cycle, at = fields.isel(cycle=spot.cycle), {"x": spot.x_mm, "y": spot.y_mm}
    total, noise = (float(cycle[f"temperature_rise{end}"].sel(at, method="nearest")) for end in ("_u", "_noise_u"))
    if not np.isfinite(total):  # of a cell that is not seen: the largest that the plan shows
        total, noise = (float(cycle[f"temperature_rise{end}"].max()) for end in ("_u", "_noise_u"))
    place_u = float(fields["position_u"].max()) / np.sqrt(2.0)
    end, times = spot.end_cycle, fields["cycle_time"].values
    described = {
        "x_u_mm": float(np.hypot(spot.x_u_mm, place_u)),
        "y_u_mm": float(np.hypot(spot.y_u_mm, place_u)),
        "peak_rise_u_K": float(np.sqrt(spot.peak_rise_u_K**2 + max(total**2 - noise**2, 0.0))),
        "area": dict(zip(AreaPart.model_fields, spot.extent_mm, strict=True)),
        "cycle": fields["cycle"][spot.cycle],
        "onset_cycle": fields["cycle"][spot.onset_cycle],
        "end_cycle": None if end is None else fields["cycle"][end],
        "time": utc(times[spot.cycle]),
        "onset_time": utc(times[spot.onset_cycle]),
        "end_time": None if end is None else utc(times[end]),
    }
    own = {key: value for key, value in vars(spot).items() if key in schema.HotspotPart.model_fields}
    untested = {"targets": (), "p_value": None, "lag_s": None}
    return schema.HotspotPart(name=name, **{**own, **described, **untested, **tested})


def _hotspot_regions(spots: Sequence[Hotspot], field: xr.DataArray) -> list[Region]:
    """The hotspots as discs of their area, without those on cells that were hardly ever seen."""
    cell_mm = float(np.median(np.diff(field["x"])))
    seen = field.notnull().mean("time").values.ravel() > _SEEN_SHARE
    regions = []
    for number, spot in enumerate(spots, start=1):
        radius_mm = max(float(np.sqrt(spot.area_mm2 / np.pi)), cell_mm)
        region = disc(f"hotspot {number}", spot.centroid_x_mm, spot.centroid_y_mm, radius_mm)
        if (region.cells(field) & seen).any():
            regions.append(region)
    return regions


def _describe_sensors(choice: SensorChoice) -> xr.Dataset:
    """The best places of contact sensors, and what each number of them loses against the camera, as variables."""
    places_mm = np.array(choice.sets[-1].places_mm if choice.sets else []).reshape(-1, 2)
    um, mm = {"units": "um"}, {"units": "mm"}
    losses = [sensors.loss for sensors in choice.sets]
    dataset = xr.Dataset(
        {
            "loss": ("sensor", np.array([loss.um for loss in losses], float), um),
            "loss_at_most": ("sensor", np.array([loss.at_most_um for loss in losses], float), um),
            "at_x": ("sensor", places_mm[:, 0], mm),
            "at_y": ("sensor", places_mm[:, 1], mm),
            "decided": ("sensor", np.array([loss.decided for loss in losses], np.int8), {"units": "1"}),
            "camera_gain": ((), choice.without.um, um),
            "camera_gain_at_most": ((), choice.without.at_most_um, um),
            "camera_decided": ((), np.int8(choice.without.decided), {"units": "1"}),
            "run_length": ((), choice.run_s, {"units": "s"}),
        }
    )
    return dataset.assign_coords(sensor=np.arange(1, len(losses) + 1))


def _describe_correlation(
    maps: xr.DataTree, source: schema.SourcePart, fields: xr.Dataset, regions: Mapping[str, AreaPart | None]
) -> schema.CorrelationPart:
    """What the correlation found."""
    session = maps.to_dataset()
    drift, channels = session["unexplained_drift"], session["channel"].values
    known = session.sel(channel="common" if "common" in channels else channels[0])
    noise_um, drift_um = float(known["noise"]), max(float(known["unexplained_drift"]), 0.01)
    scale_u = place_scale_u(fields, *np.array([source.x_mm, source.y_mm], float))
    area = regions[source.name] if source.kind == "region" else source.area
    limits = np.array([source.sensitivity_um_per_K.value, *(source.sensitivity_interval_um_per_K or ())], float)
    completed = {
        "area": area,
        "sensitivity_um_per_K": scaled(source.sensitivity_um_per_K, scale_u),
        "sensitivity_interval_um_per_K": _with_scale(limits, scale_u),
    }
    return schema.CorrelationPart(
        p_resolution=1.0 / (int(maps.attrs["draws"]) + 1),
        verdict=maps.attrs["verdict"],
        excitation=maps.attrs["excitation"],
        false_alarm_rate=session["false_alarm_rate"],
        source=source.model_copy(update=completed),
        recommended_test=say("recommended_test", maps.attrs["verdict"], source, noise_um, drift_um),
        unexplained_drift_um_per_h={
            str(name): drift.sel(channel=name) for name in drift["channel"].values if name != "joint"
        },
        modes=_describe_places(maps, "modes", "mode", fields, _mode_areas(maps)),
        regions=_describe_places(maps, "regions", "region", fields, regions),
        sensors=_describe_choice(maps.children["sensors"].to_dataset()),
        randomised_duty=_describe_duty(maps.children["duty"].to_dataset()) if "duty" in maps.children else None,
    )


def _sensitivity(found: xr.Dataset, scale_u: float) -> Sensitivity:
    return scaled(Sensitivity(value=float(found["sensitivity"]), u=float(found["sensitivity_u"])), scale_u)


def _with_scale(found: Array, scale_u: float) -> tuple[float, float]:
    """Limits of a sensitivity (its value and both limits) with the scale of the rise (k = 2), which moves none of them across 0."""
    value, low, high = found.tolist()
    scale = 2.0 * scale_u * value
    below, above = value - float(np.hypot(value - low, scale)), value + float(np.hypot(high - value, scale))
    return max(below, 0.0) if low > 0.0 else below, min(above, 0.0) if high < 0.0 else above


def _describe_duty(duty: xr.Dataset) -> list[schema.DutyPart]:
    """What the randomisation test found for every switched source."""
    return [
        schema.DutyPart(
            name=str(name),
            cause=float(load["p_value"]) <= ATTRIBUTION_LEVEL,
            p_value=load["p_value"],
            drift_at_full_duty_um=Quantity(value=load["sensitivity"], u=load["sensitivity_u"]),
            time_constants_s=(load["time_constant"], load["second_time_constant"]),
        )
        for name in duty["source"].values
        for load in [duty.sel(source=name)]
    ]


def _mode_areas(maps: xr.DataTree) -> dict[str, AreaPart | None]:
    """The area of every thermal mode, by its name."""
    if "modes" not in maps.children:
        return {}
    modes = maps.children["modes"].to_dataset()
    patterns = modes["pattern"].transpose("mode", "y", "x").values
    return {
        f"mode {number}": area_of(mode_cells(one), modes)
        for number, one in zip(modes["mode"].values, patterns, strict=True)
    }


def _describe_places(
    maps: xr.DataTree, name: str, kind: str, fields: xr.Dataset, areas: Mapping[str, AreaPart | None]
) -> list[schema.PlacePart]:
    """Modes or regions with their areas and their results for every part of the drift."""
    if name not in maps.children:
        return []
    group = maps.children[name].to_dataset()
    places = []
    for k in range(group.sizes[kind]):
        candidate = group.isel({kind: k})
        x_mm, y_mm = float(candidate["at_x"]), float(candidate["at_y"])
        scale_u = place_scale_u(fields, x_mm, y_mm)
        parts = {}
        for channel in map(str, group["channel"].values):
            found = candidate.sel(channel=channel)
            parts[channel] = schema.TestedPart(
                p_value=found["p_value"],
                sensitivity_um_per_K=_sensitivity(found, scale_u),
                sensitivity_interval_um_per_K=_with_scale(
                    np.array([float(found[f"sensitivity{end}"]) for end in ("", "_low", "_high")]), scale_u
                ),
                lag_s=found["lag"],
                detectable_um_per_K=found["detectable_sensitivity"],
                **({"p_given_leading_mode": found["p_beside"]} if kind == "mode" else {}),
            )
        label = f"mode {candidate[kind].item()}" if kind == "mode" else str(candidate[kind].item())
        places.append(schema.PlacePart(name=label, x_mm=x_mm, y_mm=y_mm, area=areas[label], parts=parts))
    return places


def _describe_choice(sensors: xr.Dataset) -> schema.SensorsPart:
    """The contact sensors in place of the camera."""
    keys = {"x_mm": "at_x", "y_mm": "at_y", "loss_um": "loss", "loss_upper_limit_um": "loss_at_most"}
    return schema.SensorsPart(
        block_length_s=sensors["run_length"],
        camera_reduction_um=sensors["camera_gain"],
        camera_reduction_significant=bool(sensors["camera_decided"]),
        sets=[
            schema.SensorSetPart(significant=bool(one["decided"]), **{key: one[name] for key, name in keys.items()})
            for one in (sensors.isel(sensor=k) for k in range(sensors.sizes["sensor"]))
        ],
    )


def _tested(hotspot: str, maps: xr.DataTree, fused: xr.Dataset) -> dict[str, Any]:
    """The part of the drift that a hotspot goes with most, and the targets that it drives; nothing where it was not tested."""
    regions = maps.children["regions"].to_dataset() if "regions" in maps.children else None
    if regions is None or hotspot not in regions["region"].values:
        return {}
    region = regions.sel(region=hotspot)
    ratio = (region["statistic"] / region["threshold"]).fillna(0.0).values
    best = region.isel(channel=int(np.lexsort((-ratio, region["p_value"].fillna(1.0).values))[0]))
    driven = _driven_targets(maps, fused, hotspot, best)
    return {"targets": driven, "p_value": best["p_value"], "lag_s": best["lag"]}


def _driven_targets(maps: xr.DataTree, fused: xr.Dataset, region: str, best: xr.Dataset) -> list[int]:
    """Targets that a region drives: none unless the session is attributable and the region passes."""
    if maps.attrs["verdict"] != "attributable":
        return []
    driven = np.zeros(fused.sizes["target"], bool)
    if float(best["p_value"]) <= ATTRIBUTION_LEVEL:
        driven |= fused["position"].values != 0 if best["channel"] == "proportional" else True
    single = maps.children["target_regions"].to_dataset().sel(region=region)
    followers = single["series_target"].values[(single["p_value"] <= ATTRIBUTION_LEVEL).values]
    driven |= np.isin(fused["target"].values, followers)
    return fused["target"].values[driven].astype(int).tolist()
