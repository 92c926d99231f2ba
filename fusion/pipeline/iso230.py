"""Evaluation of a test by ISO 230-2: windows of cycles, and the one that is quoted with its budget."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.campaign.config import (
    AcceptanceTable,
    Campaign,
    CampaignError,
    InterferometryTable,
    ReportTable,
    SheetTable,
    load_campaign,
)
from fusion.campaign.inputs import cycles_within, is_rotary, lacks_course, read_laser
from fusion.campaign.recompensation import ROTARY_BUDGET, StatedBudget, material_by_cycle
from fusion.campaign.schema import Key, keys_of
from fusion.campaign.time_zones import is_dated, shown_zone
from fusion.campaign.values import QuantityError, read_cycles, stored_path
from fusion.pipeline.resume import noted_campaign
from fusion.report.letterhead import PLAIN, Letterhead
from fusion.results.axis import Iso230Contribution, Iso230Part, Iso230Range, Iso230Window, Iso230WithTable
from fusion.results.numbers import exact, moment
from fusion.results.parts import Iso230Condition, Iso230Tolerance, Quantity, decide, is_determined
from fusion.results.progress import left_out_notices
from fusion.results.results import Notice, read_results
from fusion.results.store import file_sha256, group, has, is_file_list, joined, plain, read_json_object, read_product
from interferometry import iso230 as standard
from interferometry.common import InterferometryError
from interferometry.drift.estimate import NoScatterError, estimate_drift
from interferometry.drift.planning import estimate_settling
from interferometry.inspection import describe_notes
from interferometry.io.readings import read_deviations
from interferometry.iso230.conditions import check_conditions
from interferometry.iso230.quantities import LENGTHS

_LAST = f"the last {standard.STANDARD_CYCLES} whole cycles of the test"
_ONLY = "the only window of the test"
_CHOSEN = "as chosen"
_AXIS = (*standard.QUANTITIES, "mean_reversal")


def estimate_joint(deviations: xr.Dataset) -> tuple[xr.Dataset | None, tuple[Notice, ...]]:
    """Return the joint estimate; None without a course or times, and with a notice where the digits are too coarse for scatter."""
    if lacks_course(deviations) or np.isnat(deviations["time"].values).all():
        return None, ()
    try:
        return estimate_drift(deviations), ()
    except NoScatterError:
        file = str(deviations.attrs.get("source", "the file of the readings"))
        return None, (Notice.of("no_scatter", file=file),)


def evaluate_standard(
    deviations: xr.Dataset,
    budget: StatedBudget,
    *,
    drift: xr.Dataset | None,
    environment: xr.Dataset | None = None,
    cycles: list[int] | None = None,
) -> tuple[xr.Dataset, xr.Dataset, Iso230Part]:
    """Evaluate windows of a test by ISO 230-2, and the cycles to quote: those that were chosen, else the last window.

    Which cycles are quoted follows from nothing that was measured in them: what is chosen by its drift is chosen by its R and A.
    """
    beside: dict[str, Any] = {
        "budget": budget.budget,
        "drift": None if drift is None else drift["drift"],
        "material_degC": material_by_cycle(deviations, environment),
    }
    windows = standard.evaluate_windows(deviations, **beside)
    numbers = deviations["cycle"].values
    blocks = [
        numbers[(numbers >= first) & (numbers <= last)].tolist()
        for first, last in zip(windows["first_cycle"].values, windows["last_cycle"].values, strict=True)
    ]
    of_standard = _of_standard(windows)
    chosen = blocks[of_standard.sizes["window"] - 1] if cycles is None else cycles
    first, quoted = (standard.evaluate_iso230(deviations, cycles=window, **beside) for window in (blocks[0], chosen))
    rule = _CHOSEN if cycles is not None else _ONLY if of_standard.sizes["window"] == 1 else _LAST
    # What was measured beside the readings tells where two inputs of the budget come from.
    material = beside["material_degC"] is not None
    described = partial(_describe_window, budget=budget, drift=drift is not None, material=material)
    part = Iso230Part(
        **vars(described(quoted, chosen)),
        window_rule=rule,
        first=described(first, blocks[0]),
        range_um={
            name: Iso230Range(lowest=of_standard[name].min(), highest=of_standard[name].max())
            for name in standard.QUANTITIES
        },
        with_table=None
        if drift is None
        else _with_table(deviations, drift, blocks[: of_standard.sizes["window"]], chosen),
    )
    return windows, quoted, part


def _of_standard(windows: xr.Dataset) -> xr.Dataset:
    """Return the windows without the whole test, which is the last of several."""
    return windows.isel(window=slice(0, max(1, windows.sizes["window"] - 1)))


def _with_table(
    deviations: xr.Dataset, drift: xr.Dataset, windows: list[list[int]], quoted: list[int]
) -> Iso230WithTable | None:
    """Return A with a compensation table; None where no cycles are left that it could be made from."""
    found = standard.accuracy_with_table(deviations, drift["drift"], [quoted, *windows])
    if not np.isfinite(found).all():
        return None
    return Iso230WithTable(quoted_um=found[0], lowest_um=found.min(), highest_um=found.max())


def _quantity(result: xr.Dataset, name: str, **where: str) -> Quantity:
    """Return value and standard uncertainty of a quantity."""
    return Quantity(value=result[name].sel(where), u=result[f"{name}_u"].sel(where))


def _describe_window(
    result: xr.Dataset, cycles: list[int], *, budget: StatedBudget, drift: bool, material: bool
) -> Iso230Window:
    """Return the values of one window with its budget."""
    by_direction = {
        direction: {f"{name}_um": _quantity(result, f"{name}_unidirectional", direction=direction) for name in "ARE"}
        for direction in ("positive", "negative")
    }
    other = [name for name in standard.CONTRIBUTIONS if name not in standard.SAMPLING]
    without = (result["contribution"].sel(contributor=other) ** 2).sum("contributor", skipna=False) ** 0.5
    one_way = {
        name: float((found.sel(contributor=other) ** 2).sum() ** 0.5) for name, found in _one_way_shares(result).items()
    }
    return Iso230Window(
        unit=result["A"].attrs["units"],
        window=result.attrs["window"],
        cycles=cycles,
        **{f"{name}_um": _quantity(result, name) for name in _AXIS},
        B_of_scatter_um=result["B_of_scatter"],
        **by_direction,
        u_without_sampling_um={name: without.sel(quantity=name) for name in _AXIS} | one_way,
        contributions=[
            _contribution(result, name, budget, drift, material)
            for name in standard.CONTRIBUTIONS
            if budget.origins.get(name) != "not of a rotary axis"
        ],
    )


def _one_way_shares(result: xr.Dataset) -> dict[str, xr.DataArray]:
    """Return the contributions to A, R and E of every direction that was measured."""
    shares = {
        f"{name}_{direction}": result[f"{name}_unidirectional_contribution"].sel(direction=direction)
        for direction in ("positive", "negative")
        for name in "ARE"
    }
    return {name: found for name, found in shares.items() if found.notnull().all()}


def _contribution(
    result: xr.Dataset, name: str, budget: StatedBudget, drift: bool, material: bool
) -> Iso230Contribution:
    """Return one row of the budget."""
    parts = {f"{symbol}_um": result["contribution"].sel(quantity=symbol, contributor=name) for symbol in _AXIS}
    u: float | None = None
    unit, origin = "um", "from the readings"
    if name in LENGTHS:
        field, unit = LENGTHS[name]
        u, origin = getattr(budget.budget, field), budget.origins[name]
        if name == "expansion_coefficient" and not budget.budget.is_scatter_alone:
            logged = "" if material else "an assumed "
            origin += f"; material at {logged}{float(result['temperature_difference']):.2g} K from 20 °C"
    elif name == "environmental_variation":
        u = float(result["environmental_variation"])
        found = "standard deviation of the drift within the window" if drift else "not known, not contained"
        origin = budget.origins.get(name, found)
    elif name == "extremes":
        origin = "mean excess in simulated tests like this one"
    one_way = {key: found.sel(contributor=name) for key, found in _one_way_shares(result).items()}
    return Iso230Contribution(contributor=name, u=u, unit=unit, origin=origin, **parts, unidirectional_um=one_way)


# What the test sheet of ISO 230-2 holds in addition to the values: tolerances, conditions stated and checked, other
# standards.

_ARROWS = {"positive": "↑", "negative": "↓"}
_COMPENSATION = {"as recorded": "as the laser compensated them", "redo": "compensated again with the logged conditions"}
#: Key, name and text of a condition.
_Stated = tuple[str, str, str]


def complete_sheet(
    part: Iso230Part, dataset: xr.Dataset, *, campaign: Campaign | None, environment: xr.Dataset | None
) -> Iso230Part:
    """Return the evaluation with tolerances, conditions and other standards of the quoted window."""
    cycles = part.cycles
    report = ReportTable() if campaign is None else campaign.report
    limits = (AcceptanceTable() if campaign is None else campaign.acceptance).limits()
    settling = estimate_settling(dataset, group(dataset, "estimate")) if has(dataset, "estimate") else None
    checks = check_conditions(dataset, cycles=cycles, lead_mm=report.screw_lead_mm, settling=settling)
    others = [] if is_rotary(dataset) else standard.evaluate_other_standards(dataset, cycles=cycles)
    windows = _of_standard(group(dataset, "iso"))
    judged = [row for symbol, limit in limits.items() for row in _judge(part, windows, symbol, limit)]
    met = {check.met for check in checks}
    sheet = {
        "tolerances": [row for row, _ in judged],
        "windows": windows.sizes["window"],
        "windows_otherwise": sum(map(any, zip(*(otherwise for _, otherwise in judged), strict=True))),
        "checks": [vars(check) for check in checks],
        "is_acceptance_test": False if False in met else None if None in met else True,
        "conditions": _conditions(dataset, report, campaign, environment),
        "other_standards": [vars(value) for value in others],
    }
    return Iso230Part.model_validate({**vars(part), **sheet})


def _judge(
    part: Iso230Part, windows: xr.Dataset, symbol: str, limit: float
) -> Iterator[tuple[Iso230Tolerance, list[bool]]]:
    """Judge a quantity, each direction by itself where it is unidirectional, with whether each window is judged otherwise."""
    found: dict[str, tuple[Any, xr.Dataset]] = {symbol: (part, windows)}
    if symbol.endswith("_unidirectional"):
        found = {
            f"{symbol[0]}{arrow}": (getattr(part, direction), windows.sel(direction=direction))
            for direction, arrow in _ARROWS.items()
        }
    for name, (holder, along) in found.items():
        quantity: Quantity = getattr(holder, f"{name[0]}_um")
        expanded = 2 * quantity.u if is_determined(quantity.u) else None
        decision = decide(quantity.value, expanded, limit)
        pairs = zip(along[symbol].values, 2 * along[f"{symbol}_u"].values, strict=True)
        otherwise = [decide(value, u, limit) != decision for value, u in pairs]
        judged = {"limit_um": limit, "value_um": quantity.value, "expanded_u_um": expanded, "decision": decision}
        yield Iso230Tolerance(quantity=name, **judged, windows_otherwise=sum(otherwise)), otherwise


def _conditions(
    dataset: xr.Dataset, report: ReportTable, campaign: Campaign | None, environment: xr.Dataset | None
) -> tuple[Iso230Condition, ...]:
    """Return the conditions of the test, empty where they are not stated; logged values where there is a log."""
    laser = None if campaign is None else campaign.interferometry
    position, rotary = dataset["position"].values, is_rotary(dataset)
    unit = "°" if rotary else " mm"
    travel = f"{exact(np.ptp(position))}{unit}, {exact(position.min())} to {exact(position.max())}{unit}"
    temperatures: list[_Stated] = []
    for name in ("air_temperature", "material_temperature"):
        before, after = (getattr(report, f"{name}_{when}_degC") for when in ("before", "after"))
        text = _pair(before, after, dataset, environment, name)
        temperatures.append((name, f"{name.replace('_', ' ').capitalize()} before, after", text))
    of_lengths: list[_Stated] = []
    if not rotary:
        dead = f"{laser.dead_path_mm:g} mm" if laser and "dead_path_mm" in laser.model_fields_set else ""
        of_lengths = [
            ("expansion_coefficient", "Expansion coefficient", _coefficient(laser)),
            ("dead_path", "Dead path", dead),
            ("compensation", "Readings", _COMPENSATION[laser.compensation] if laser else ""),
        ]
    stated = report.model_dump(by_alias=True)
    if laser is not None:
        stated |= {"feed": report.feed_mm_per_min or laser.feed_mm_per_min, "dwell": report.dwell_s or laser.dwell_s}
    zone = shown_zone(dataset, None if campaign is None else campaign.zone_of("interferometry"))
    return state_conditions(
        [
            one
            for one in keys_of("report", of="interferometry")
            if one.unit != "degC" and not (rotary and one.unit.startswith("mm"))
        ],
        stated,
        date_of(dataset["time"].values, zone),
        "" if campaign is None else campaign.campaign.axis,
        {
            "dwell" if rotary else "screw_lead": [("measured_travel", "Measured travel", travel)],
            "sensor_places": temperatures,
            "remarks": of_lengths,
        },
    )


def state_conditions(
    keys: Iterable[Key], stated: Mapping[str, Any], date: str, axis: str, others: Mapping[str, Sequence[_Stated]]
) -> tuple[Iso230Condition, ...]:
    """Return whose test it was and under which conditions: keys of ``[report]`` in their order, before some of them what no key states."""
    placed = {
        "machine": [("date", "Date of the test", date)],
        "sign_convention": [("axis", "Axis", axis), *_instruments(stated["instrument"])],
        **others,
    }
    rows: list[_Stated] = []
    for one in keys:
        value = stated[one.key] or ""
        text = f"{value:g} {one.unit}" if one.unit and value else value
        rows += [*placed.get(one.key, ()), (one.key, one.label, text)]
    return tuple(Iso230Condition(key=key, name=name, text=text) for key, name, text in rows)


def date_of(times: NDArray[np.datetime64], zone: str | None) -> str:
    """Return from when to when readings were taken in a zone, see `moment`; empty of times without a date."""
    if not is_dated(times):
        return ""
    known = times[~np.isnat(times)]
    return f"{moment(known.min(), zone)} to {moment(known.max(), zone)}"


def _coefficient(laser: InterferometryTable | None) -> str:
    """Return the expansion coefficient, and whether it is assumed."""
    if laser is None:
        return ""
    stated = "expansion_coefficient_ppm_per_K" in laser.model_fields_set
    return f"{laser.expansion_coefficient_ppm_per_K:g} ppm/K{'' if stated else ' (assumed)'}"


def _instruments(stated: Sequence[Mapping[str, Any]]) -> list[_Stated]:
    """Return each instrument with serial number and date of its calibration."""
    named = []
    for k, item in enumerate(stated, start=1):
        parts = [item["name"], f"serial number {item['serial_number'] or 'not stated'}"]
        parts.append(f"calibrated {item['calibrated'].isoformat()}" if item["calibrated"] else "calibration not stated")
        parts += [f"certificate {item['certificate']}"] if item["certificate"] else []
        named.append(("instrument", f"Instrument {k}", ", ".join(parts)))
    return named or [("instrument", "Instruments", "")]


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


# A test by ISO 230-2 from a file of readings, a campaign file or the results of a run, evaluated for its own page.


@dataclass(frozen=True)
class StandardTest:
    """A test as its page and the terminal show it.

    Attributes
    ----------
    part : values; those that need a standard deviation are null of a test of one cycle
    dataset : readings; the group ``quoted`` holds the quoted window
    remarks : what was left out or assumed when the file was read
    files : SHA-256 of the files that it was read from, by name
    sheet : head, templates and language of the sheet, with the paths of its files
    """

    title: str
    part: Iso230Part
    dataset: xr.Dataset
    remarks: tuple[str, ...]
    files: dict[str, str]
    sheet: Letterhead = PLAIN


def read_test(path: Path, cycles: str | None) -> StandardTest:
    """Read and evaluate a test."""
    if path.is_dir():
        return _of_results(path, cycles)
    if path.exists() and not path.is_file():
        raise CampaignError(f"{path}: is a pipe, a socket or a device; name a file")
    if path.suffix == ".toml":
        campaign = load_campaign(path)
        if campaign.interferometry is None:
            raise CampaignError(f"{path}: this campaign has no [interferometry]; name one with readings of the axis")
        laser = read_laser(campaign)
        readings = laser["deviations"]
        window = (
            laser["iso_cycles"] if cycles is None else _window_of(cycles, readings, campaign.interferometry.deviations)
        )
        named = {path.name: path, **campaign.files_of("interferometry")}
        read = (readings, laser["iso_budget"], window, campaign, laser["environment"])
        return _evaluate(campaign.campaign.title, named, *read)
    deviations = read_deviations(path, rotary=True)
    window = None if cycles is None else _window_of(cycles, deviations, path.name)
    budget = (
        ROTARY_BUDGET
        if is_rotary(deviations)
        else StatedBudget(standard.Iso230Budget(), dict.fromkeys(LENGTHS, "assumed"))
    )
    try:
        return _evaluate(path.name, {path.name: path}, deviations, budget, window)
    except InterferometryError as error:
        raise CampaignError(f"{path}: {error}") from None


def _of_results(folder: Path, cycles: str | None) -> StandardTest:
    """Return the test of a run as its results hold it."""
    if cycles is not None:
        raise CampaignError(
            f'--cycles "{cycles}": {folder} holds the values of its run; name the campaign file or the file of readings instead, or write '
            "[acceptance] cycles into the campaign file and run it again"
        )
    results = read_results(folder)
    if results.iso230 is None:
        raise CampaignError(
            f"{folder}: its run had no readings of an axis; name the results of a campaign with [interferometry]"
        )
    if not results.iso230.cycles or not has(dataset := read_product(folder, "deviations"), "quoted"):
        raise CampaignError(
            f"{folder}: these results hold no evaluation by ISO 230-2 of this version; run the campaign again"
        )
    read = (_remarks(dataset), files_of_run(folder), sheet_of_run(folder))
    return StandardTest(results.campaign, results.iso230, dataset, *read)


def _remarks(deviations: xr.Dataset) -> tuple[str, ...]:
    return (*describe_notes(deviations), *(notice.message for notice in left_out_notices(deviations, "left_out")))


def files_of_run(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of the files that were measured, as the provenance of a run holds it, and that of its results, by name."""
    origin = read_json_object(folder / "provenance.json")
    inputs, readings, parameters = origin.get("inputs"), origin.get("readings"), origin.get("parameters")
    if not isinstance(readings, list):  # Earlier versions wrote no such list: what the campaign file names.
        tables = [parameters.get(name) for name in ("interferometry", "record")] if isinstance(parameters, dict) else []
        values = [value for table in tables if isinstance(table, dict) for value in table.values()]
        readings = [name for value in values for name in (value if isinstance(value, list) else [value])]
    known: dict[str, Any] = inputs if is_file_list(inputs) else {}
    measured = {name: str(item["sha256"]) for name, item in known.items() if name in readings}
    return {**measured, **hashed({"results.json": folder / "results.json"})}


def sheet_of_run(folder: Path) -> Letterhead:
    """Return what makes the sheet of a run a laboratory's own, as its campaign file stated it, with the paths of its files."""
    parameters, campaign = read_json_object(folder / "provenance.json").get("parameters"), noted_campaign(folder)
    stated = parameters.get("sheet", {}) if isinstance(parameters, dict) else {}
    table = SheetTable.model_validate({key: value for key, value in stated.items() if key in SheetTable.model_fields})
    return sheet_files(table, folder.parent if campaign is None else campaign.parent)


def sheet_files(table: SheetTable, folder: Path) -> Letterhead:
    """Return what a campaign file in `folder` states of its sheet, with the paths of the files."""
    paths: dict[str, str] = {}
    for name in ("logo", "word_template", "page_template"):
        if written := getattr(table, name):
            path = stored_path(folder, written)
            if not path.is_file():
                raise CampaignError(f"{path}: no such file; put it back, or take {name} out of [sheet] and run again")
            paths[name] = str(path)
    return Letterhead(**{**table.model_dump(), **paths})


def hashed(files: Mapping[str, Path]) -> dict[str, str]:
    """Return the SHA-256 of the files that exist, by name."""
    return {name: file_sha256(path) for name, path in files.items() if path.is_file()}


def _evaluate(
    title: str,
    files: Mapping[str, Path],
    deviations: xr.Dataset,
    budget: StatedBudget,
    cycles: list[int] | None,
    campaign: Campaign | None = None,
    environment: xr.Dataset | None = None,
) -> StandardTest:
    """Evaluate readings."""
    drift, digits = estimate_joint(deviations)
    without = lacks_course(deviations)
    remarks = (*_remarks(deviations), *(notice.message for notice in digits), *([without] if without else []))
    windows, quoted, found = evaluate_standard(deviations, budget, drift=drift, environment=environment, cycles=cycles)
    dataset = joined(deviations, iso=windows, quoted=quoted, **({} if drift is None else {"estimate": drift}))
    found = complete_sheet(found, dataset, campaign=campaign, environment=environment)
    own = PLAIN if campaign is None else sheet_files(campaign.sheet, campaign.folder)
    return StandardTest(title, Iso230Part.model_validate(plain(found)), dataset, remarks, hashed(files), own)


def _window_of(text: str, deviations: xr.Dataset, file: str) -> list[int]:
    """Return the cycles of the window that ``--cycles`` names."""
    stated = f'--cycles "{text}"'
    try:
        span = read_cycles(text)
    except QuantityError as error:
        raise CampaignError(f"{stated}: {error}") from None
    return cycles_within(span, deviations, stated=stated, file=file)
