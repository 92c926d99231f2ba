"""The stage that joins field and drift: what is tested, what it says for results.json, and which contact sensors would do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from fusion.attribution.attribute import correlate
from fusion.attribution.contact_sensors import SensorChoice, choose_sensors
from fusion.attribution.family_wise import LEVEL
from fusion.attribution.leading_source import Found, find_source, would_tell
from fusion.attribution.randomised_duty import randomisation_test
from fusion.attribution.thermal_modes import Region, cluster_cells, disc
from fusion.campaign.inputs import Source
from fusion.products.progress import Report
from fusion.products.results import Outcome
from thermography.fields.hotspots import Hotspot, detect_hotspots

_CORRELATION_CELL_MM = 10.0


def correlate_field(source: Source, fields: xr.Dataset, fused: xr.Dataset, *, report: Report) -> Outcome[xr.DataTree]:
    """Test every part of the field as a source of the drift.

    The cells are averaged to about a centimetre first: within one cycle heat spreads further than that in steel, so nothing is lost
    but noise and time.
    """
    cell = float(np.median(np.diff(fields["x"])))
    block = max(1, int(_CORRELATION_CELL_MM / cell))
    film = fields["frame_temperature"].coarsen(x=block, y=block, boundary="trim").mean()
    spots = detect_hotspots(fields["temperature_rise"].isel(cycle=-1))
    regions = [*source.regions, *hotspot_regions(spots, film)]
    report("correlation", 0, 100)
    maps = correlate(
        fused,
        film,
        regions=regions,
        per_target=True,
        progress=lambda part: report("correlation", round(100 * part), 100),
    )
    report("correlation", 100, 100)
    report("sensor places", 0, 1)
    choice = choose_sensors(fused, film)
    maps["clusters"] = xr.DataTree(cluster_cells(film))
    maps["sensors"] = xr.DataTree(sensor_variables(choice))
    report("sensor places", 1, 1)
    if source.duty is not None:
        schedule, law = source.duty
        maps["duty"] = xr.DataTree(randomisation_test(fused, schedule, law))
    found = find_source(maps)
    parts = {
        "hotspots": [_hotspot(f"hotspot {k}", spot, maps, fused) for k, spot in enumerate(spots, start=1)],
        "correlation": correlation_part(maps, found, fused),
    }
    return Outcome(maps, parts)


def hotspot_regions(spots: Sequence[Hotspot], film: xr.DataArray) -> list[Region]:
    """Return the zones of the hotspots as discs of their area; those on cells that were hardly ever seen are left out."""
    cell = float(np.median(np.diff(film["x"])))
    seen = film.notnull().mean("time").values.ravel() > 0.8
    zones = []
    for number, spot in enumerate(spots, start=1):
        radius = max(float(np.sqrt(spot.area_mm2 / np.pi)), cell)
        zone = disc(f"hotspot {number}", spot.centroid_x_mm, spot.centroid_y_mm, radius)
        if (zone.cells(film) & seen).any():
            zones.append(zone)
    return zones


def sensor_variables(choice: SensorChoice) -> xr.Dataset:
    """Return the best places of contact sensors and what each number of them misses beside the camera."""
    places = np.array(choice.sets[-1].places_mm if choice.sets else []).reshape(-1, 2)
    um, mm = {"units": "um"}, {"units": "mm"}
    losses = [one.loss for one in choice.sets]
    columns = {"loss": [one.um for one in losses], "loss_at_most": [one.at_most_um for one in losses]}
    dataset = xr.Dataset(
        {name: ("sensor", np.array(values, float), um) for name, values in columns.items()}
        | {
            "at_x": ("sensor", places[:, 0], mm),
            "at_y": ("sensor", places[:, 1], mm),
            "decided": ("sensor", np.array([one.decided for one in losses], np.int8), {"units": "1"}),
            "camera_gain": ((), choice.without.um, um),
            "camera_gain_at_most": ((), choice.without.at_most_um, um),
            "camera_decided": ((), np.int8(choice.without.decided), {"units": "1"}),
            "run_length": ((), choice.run_s, {"units": "s"}),
        }
    )
    return dataset.assign_coords(sensor=np.arange(1, len(losses) + 1))


def correlation_part(maps: xr.DataTree, found: Found, fused: xr.Dataset) -> dict[str, Any]:
    """Return what results.json says of drift and field."""
    session = maps.to_dataset()
    channels = [str(name) for name in session["channel"].values]
    duty = maps.children["duty"].to_dataset() if "duty" in maps.children else None
    return {
        "verdict": found.verdict,
        "excitation": str(maps.attrs["excitation"]),
        "false_alarm_rate": float(session["false_alarm_rate"]),
        "source": {
            "kind": found.kind,
            "name": found.name,
            "part": found.channel,
            "x_mm": found.x_mm,
            "y_mm": found.y_mm,
            "p_value": found.p_value,
            "sensitivity_um_per_K": {"value": found.sensitivity_um_per_K, "u": found.sensitivity_u_um_per_K},
            "lag_s": found.lag_s,
            "detectable_um_per_K": found.detectable_um_per_K,
            "equal_places_mm": [list(place) for place in found.others_mm],
        },
        "would_tell": would_tell(maps, found),
        "unexplained_drift_um_per_h": {
            name: float(session["unexplained_drift"].sel(channel=name)) for name in channels if name != "joint"
        },
        "modes": _candidates(maps, "modes", "mode"),
        "regions": _candidates(maps, "regions", "region"),
        "sensors": _sensors(maps.children["sensors"].to_dataset()),
        "randomised_duty": None if duty is None else duty_part(duty),
    }


def duty_part(duty: xr.Dataset) -> list[dict[str, Any]]:
    """Return what the randomisation test says of every switched source."""
    return [
        {
            "name": str(name),
            "cause": bool(one["p_value"] <= LEVEL),
            "p_value": float(one["p_value"]),
            "drift_at_full_duty_um": {"value": float(one["sensitivity"]), "u": float(one["sensitivity_u"])},
            "time_constants_s": [float(one["time_constant"]), float(one["second_time_constant"])],
        }
        for name, one in ((name, duty.sel(source=name)) for name in duty["source"].values)
    ]


def _candidates(maps: xr.DataTree, name: str, kind: str) -> list[dict[str, Any]]:
    """Return modes or regions with what they show in every part of the drift."""
    if name not in maps.children:
        return []
    few = maps.children[name].to_dataset()
    listed = []
    for at in range(few.sizes[kind]):
        one = few.isel({kind: at})
        parts: dict[str, dict[str, Any]] = {
            str(channel): {
                "p_value": float(one["p_value"].sel(channel=channel)),
                "sensitivity_um_per_K": {
                    "value": float(one["sensitivity"].sel(channel=channel)),
                    "u": float(one["sensitivity_u"].sel(channel=channel)),
                },
                "lag_s": float(one["lag"].sel(channel=channel)),
                "detectable_um_per_K": float(one["detectable_sensitivity"].sel(channel=channel)),
            }
            for channel in few["channel"].values
        }
        named = f"mode {one[kind].item()}" if kind == "mode" else str(one[kind].item())
        if kind == "mode":
            for channel, part in parts.items():
                part["p_beside_leader"] = float(one["p_beside"].sel(channel=channel))
        listed.append({"name": named, "x_mm": float(one["at_x"]), "y_mm": float(one["at_y"]), "parts": parts})
    return listed


def _sensors(sensors: xr.Dataset) -> dict[str, Any]:
    """Return the contact sensors in place of the camera."""
    return {
        "within_s": float(sensors["run_length"]),
        "camera_gain_um": float(sensors["camera_gain"]),
        "camera_gain_decided": bool(sensors["camera_decided"]),
        "sets": [
            {
                "x_mm": float(one["at_x"]),
                "y_mm": float(one["at_y"]),
                "loss_um": float(one["loss"]),
                "loss_at_most_um": float(one["loss_at_most"]),
                "decided": bool(one["decided"]),
            }
            for one in (sensors.isel(sensor=at) for at in range(sensors.sizes["sensor"]))
        ],
    }


def _hotspot(name: str, spot: Hotspot, maps: xr.DataTree, fused: xr.Dataset) -> dict[str, Any]:
    """Return one entry of ``hotspots``: its strongest part of the drift, and the targets that it drives."""
    found: dict[str, Any] = {"targets": [], "p_value": None, "lag_s": None}
    regions = maps.children["regions"].to_dataset() if "regions" in maps.children else None
    if regions is not None and name in regions["region"].values:
        one = regions.sel(region=name)
        ratio = (one["statistic"] / one["threshold"]).fillna(0.0).values
        best = one.isel(channel=int(np.lexsort((-ratio, one["p_value"].fillna(1.0).values))[0]))
        found = {
            "targets": driven_targets(maps, fused, name, best),
            "p_value": float(best["p_value"]),
            "lag_s": float(best["lag"]),
        }
    return {"x_mm": spot.x_mm, "y_mm": spot.y_mm, "peak_rise_K": spot.peak_rise_K, **found}


def driven_targets(maps: xr.DataTree, fused: xr.Dataset, region: str, best: xr.Dataset) -> list[int]:
    """Return the targets that a region drives: none unless the session tells and the region passes.

    Through a shift it drives all, through a stretch those away from the laser's zero, and whatever target shows it by itself.
    """
    if maps.attrs["verdict"] != "attributable":
        return []
    driven = np.zeros(fused.sizes["target"], bool)
    if float(best["p_value"]) <= LEVEL:
        driven |= fused["position"].values != 0 if best["channel"] == "proportional" else True
    single = maps.children["target_regions"].to_dataset()["p_value"].sel(region=region)
    for series in single["series"].values[(single <= LEVEL).values]:
        driven |= fused["target"].values == int(str(series).split()[-1])
    return fused["target"].values[driven].astype(int).tolist()
