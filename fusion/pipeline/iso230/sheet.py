"""What the test sheet of ISO 230-2 holds beside the values: tolerances, conditions stated and checked, other standards."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
import xarray as xr

from fusion.campaign.config import Campaign, InterferometryTable
from fusion.campaign.standard_test import AcceptanceTable, ReportTable
from fusion.products.grouped import group, has
from fusion.report.wording import moment
from interferometry.drift.planning import estimate_settling
from interferometry.figures import time_span
from interferometry.iso230 import evaluate_other_standards
from interferometry.iso230.acceptance import decide
from interferometry.iso230.conditions import check_conditions

_ARROWS = {"positive": "↑", "negative": "↓"}


def complete_sheet(
    part: Mapping[str, Any], dataset: xr.Dataset, *, campaign: Campaign | None, environment: xr.Dataset | None
) -> dict[str, Any]:
    """Return the part ``iso230`` of the results with tolerances, conditions and other standards of its settled window.

    Parameters
    ----------
    part : mapping
        As from `fusion.pipeline.iso230.evaluation.evaluate_standard`.
    dataset : Dataset
        Readings, and the group ``drift`` where the drift was estimated.
    campaign : Campaign or None
        What was stated; None for a bare file.
    environment : Dataset or None
        Log along ``time``.
    """
    cycles = part["settled"]["cycles"]
    report = ReportTable() if campaign is None else campaign.report
    limits = (AcceptanceTable() if campaign is None else campaign.acceptance).limits()
    settling = estimate_settling(group(dataset, "drift"), dataset) if has(dataset, "drift") else None
    checks = check_conditions(dataset, cycles=cycles, lead_mm=report.screw_lead_mm, settling=settling)
    return {
        **part,
        "tolerances": [row for symbol, limit in limits.items() for row in _judge(part["settled"], symbol, limit)],
        "checks": [asdict(check) for check in checks],
        "conditions": [
            {"name": name, "text": text} for name, text in _conditions(dataset, report, campaign, environment).items()
        ],
        "other_standards": [asdict(value) for value in evaluate_other_standards(dataset, cycles=cycles)],
    }


def _judge(settled: Mapping[str, Any], symbol: str, limit: float) -> list[dict[str, Any]]:
    """Judge a quantity, each direction by itself where it is unidirectional."""
    if symbol.endswith("_unidirectional"):
        short = symbol.removesuffix("_unidirectional")
        found = {f"{short}{arrow}": settled[direction][f"{short}_um"] for direction, arrow in _ARROWS.items()}
    else:
        found = {symbol: settled[f"{symbol}_um"]}
    rows = []
    for name, quantity in found.items():
        value, expanded = quantity["value"], 2 * quantity["u"]
        known = np.isfinite([value, expanded]).all()
        decision = decide(value, expanded, limit) if known else "not measured"
        rows.append(
            {"quantity": name, "limit_um": limit, "value_um": value, "expanded_u_um": expanded, "decision": decision}
        )
    return rows


def _conditions(
    dataset: xr.Dataset, report: ReportTable, campaign: Campaign | None, environment: xr.Dataset | None
) -> dict[str, str]:
    """Return the conditions of the test by name, empty where they are not stated; logged values where there is a log."""
    laser = None if campaign is None else campaign.interferometry
    position = dataset["position"].values
    feed = report.feed_mm_per_min or (laser.feed_mm_per_min if laser else None)
    dwell = report.dwell_s or (laser.dwell_s if laser else None)
    compensation = {
        "as recorded": "as the laser compensated them",
        "redo": "compensated again with the logged conditions",
    }
    return {
        "Date of the test": _date(dataset, None if campaign is None else campaign.zone_of("interferometry")),
        "Machine": report.machine,
        "Serial number of the machine": report.machine_serial_number,
        "Control": report.control,
        "Location": report.location,
        "Customer": report.customer,
        "Operator": report.operator,
        "Axis": "" if campaign is None else campaign.campaign.axis,
        "Travel of the axis": _with_unit(report.axis_travel_mm, "mm"),
        "Measured travel": f"{np.ptp(position):g} mm, {position.min():g} to {position.max():g} mm",
        "Lead of the screw": _with_unit(report.screw_lead_mm, "mm"),
        "Feed": _with_unit(feed, "mm/min"),
        "Dwell at a target": _with_unit(dwell, "s"),
        "Warm-up": report.warm_up,
        "Compensation of the machine": report.machine_compensation,
        **_instruments(report),
        "Air temperature before, after": _pair(
            report.air_temperature_before_degC,
            report.air_temperature_after_degC,
            dataset,
            environment,
            "air_temperature",
        ),
        "Material temperature before, after": _pair(
            report.material_temperature_before_degC,
            report.material_temperature_after_degC,
            dataset,
            environment,
            "material_temperature",
        ),
        "Places of the sensors": report.sensor_places,
        "Expansion coefficient": _coefficient(laser),
        "Dead path": f"{laser.dead_path_mm:g} mm" if laser and "dead_path_mm" in laser.model_fields_set else "",
        "Readings": "" if laser is None else compensation[laser.compensation],
        "Remarks": report.remarks,
    }


def _date(dataset: xr.Dataset, zone: str | None) -> str:
    """Return from when to when readings were taken, in local time where the zone is stated, else in UTC."""
    if np.isnat(dataset["time"].values).all():
        return ""
    first, last = time_span(dataset)
    return f"{moment(first, zone)} to {moment(last, zone)}"


def _coefficient(laser: InterferometryTable | None) -> str:
    """Return the expansion coefficient, and whether it is assumed."""
    if laser is None:
        return ""
    stated = "expansion_coefficient_ppm_per_K" in laser.model_fields_set
    return f"{laser.expansion_coefficient_ppm_per_K:g} ppm/K{'' if stated else ' (assumed)'}"


def _with_unit(value: float | None, unit: str) -> str:
    return "" if value is None else f"{value:g} {unit}"


def _instruments(report: ReportTable) -> dict[str, str]:
    """Return each instrument with serial number and date of its calibration."""
    if not report.instrument:
        return {"Instruments": ""}
    named = {}
    for k, item in enumerate(report.instrument, start=1):
        parts = [item.name, f"serial number {item.serial_number or 'not stated'}"]
        parts.append(f"calibrated {item.calibrated.isoformat()}" if item.calibrated else "calibration not stated")
        named[f"Instrument {k}"] = ", ".join(
            [*parts, *([f"certificate {item.certificate}"] if item.certificate else [])]
        )
    return named


def _pair(
    before: float | None, after: float | None, dataset: xr.Dataset, environment: xr.Dataset | None, name: str
) -> str:
    """Return a temperature at the first and at the last reading: as stated, else as logged, else of the laser's own file."""
    if before is not None or after is not None:
        return ", ".join("not stated" if value is None else f"{value:.1f} °C" for value in (before, after))
    time = dataset["time"].values
    if environment is not None and name in environment and not np.isnat(time).all():
        log = environment[[name]].dropna("time")
        if log.sizes["time"]:
            known = time[~np.isnat(time)]
            at = [float(log[name].sel(time=when, method="nearest")) for when in (known.min(), known.max())]
            return f"{at[0]:.1f} °C, {at[1]:.1f} °C (logged)"
    if name in dataset and np.isfinite(dataset[name]).any():
        ends = np.nanmean(np.atleast_2d(dataset[name].values), axis=0)
        return ", ".join(f"{value:.1f} °C" for value in ends) + " (file of the laser)"
    return ""
