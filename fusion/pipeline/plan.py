"""The next test: when to switch what, with what power; and the test after a compensation against what the one before it predicted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr

from fusion.analysis.alignment.sensor_health import describe_fault
from fusion.analysis.attribution.duty import DutyPlanError, Machine, plan_duty, switchings
from fusion.analysis.drift_model.record import examine_record
from fusion.analysis.drift_model.record_data import reduce_record
from fusion.analysis.drift_model.verification import ChannelVerdict, NextTest, choose_test, propose_tests, verify
from fusion.analysis.effects.thermal import QUASI_STATIC
from fusion.campaign.config import CampaignError, load_campaign
from fusion.campaign.schema import keys_of
from fusion.campaign.time_zones import shown_zone
from fusion.campaign.values import read_option
from fusion.report.letterhead import Letterhead
from fusion.results.loop import RecordLoop
from fusion.results.numbers import duration
from fusion.results.parts import Iso230Condition
from fusion.results.recursion import read_recursion
from fusion.results.results import read_results
from fusion.results.store import file_sha256, read_product

#: Inputs that are named as known worst.
_NAMED = 4
#: Share by which a test lowers an uncertainty where it is worth its time.
_WORTH_IT = 0.1
#: A dwell in seconds by control: LinuxCNC and SINUMERIK in seconds, Fanuc in seconds where the number has a decimal point.
DWELLS = {"linuxcnc": "G4 P{:.0f}", "siemens840d": "G4 F{:.0f}", "fanuc": "G04 X{:.1f}"}


def propose_duty(
    sources: Sequence[str], *, effect: str, drift: str, noise: str, cycle: str, power: float, seed: int
) -> xr.Dataset:
    """Propose a duty schedule: how long, with what power, and when to switch what."""
    named = [_source(text) for text in sources]
    machine = Machine(
        sources=tuple(name for name, _ in named),
        time_constants_s=tuple(seconds for _, seconds in named),
        effect_um=read_option("--effect", effect, "um"),
        drift_um_per_sqrt_h=read_option("--drift", drift, "um"),
        noise_um=read_option("--noise", noise, "um"),
        cycle_s=read_option("--cycle", cycle, "s"),
    )
    return plan_duty(machine, power=power, seed=seed)


def duty_lines(proposed: xr.Dataset, *, power: float) -> list[str]:
    """Describe a duty schedule."""
    reached = float(proposed["power"].sel(hours=float(proposed["test_hours"])).max())
    longest = f"; no test of up to {float(proposed['hours'].max()):g} h reaches {power:.0%}"
    return [
        f"test of {float(proposed['test_hours']):g} h, mean dwell {duration(float(proposed['mean_dwell']))}: "
        f"chance to name the weakest source {reached:.0%}{'' if proposed.attrs['enough'] else longest}",
        "What passes is a load that moves the axis; it need not act where it warms the table. To test a place, add a source that heats or "
        "cools it alone (a mat, a fan), or loads that warm it and the rest of the machine in different ratios.",
        "minute  source  state",
        *(f"{minute:6.0f}  {name}  {state}" for minute, name, state in switchings(proposed)),
    ]


def next_tests(folder: Path, largest: Sequence[str], *, seed: int) -> list[NextTest]:
    """Return the tests that were tried for a record's machine, from what the last one left open."""
    results = read_results(folder)
    if not isinstance(results.loop, RecordLoop):
        raise DutyPlanError(
            f"{folder}: the results of a [record] are needed; for a positioning test name its heat sources by --source, and where a place "
            'that the drift follows is to be told from the load that warms it, a mat or a fan at that place as well: --source "mat=20 min"'
        )
    product = read_product(folder, "record")
    units = dict(zip(product["driver_name"].values.tolist(), product["driver_units"].values.tolist(), strict=True))
    levels = (_level(text, units) for text in largest)
    return list(propose_tests(product, results.loop, largest=dict(levels), seed=seed))


def next_test_lines(tests: Sequence[NextTest]) -> list[str]:
    """Describe the tests that were tried, and the schedule of the one that is proposed."""
    first, best = tests[0], choose_test(tests)

    def sizes(um: Mapping[str, float], most: int | None = None) -> str:
        return ", ".join(f"{name} {value:.2g} um" for name, value in list(um.items())[:most])

    small = 1.0 - min(one.left for one in tests) < _WORTH_IT
    nothing = f"no test of up to {tests[-1].hours:g} h lowers it by a tenth: what is left wanders or is noise, and needs a new zero"
    return [
        f"standard uncertainty of a prediction under another duty, over {first.over_h:.2g} h after a zero: {sizes(first.now_um)}; least "
        f"known by itself: {sizes(first.open_um, _NAMED)}",
        *(f"after {one.hours:g} h, mean hold {one.hold_min:g} min: {sizes(one.after_um)}" for one in tests),
        *([nothing] if small else []),
        f"proposed: {best.hours:g} h",
        "minute  " + "  ".join(f"{name} / {unit}" for name, unit in best.units.items()),
        *(
            f"{minute:6.0f}  " + "  ".join(f"{level:g}" for level in row)
            for minute, *row in zip(best.minutes, *best.levels.values(), strict=True)
        ),
    ]


def write_nc_program(path: Path, test: NextTest, *, control: str) -> None:
    """Write the schedule of a test as an NC program of spindle speeds and dwells, which moves no axis."""
    if len(test.units) != 1 or next(iter(test.units.values())) not in ("1/min", "rpm", "min-1"):
        named = ", ".join(f"{name} / {unit}" for name, unit in test.units.items())
        raise DutyPlanError(
            f"--nc: a program sets the speed of one spindle in 1/min, and this record has {named}; set the levels by hand"
        )
    if control not in DWELLS:
        raise DutyPlanError(f'--control "{control}" is not known; write one of {", ".join(DWELLS)}')
    if path.exists():
        raise DutyPlanError(f"--nc: {path} exists; name another file")
    ends, (levels,) = [*test.minutes[1:], 60.0 * test.hours], test.levels.values()
    lines = [
        f"{f'M3 S{level:.0f}' if level > 0.0 else 'M5'}\n{DWELLS[control].format(60.0 * (end - start))}\n"
        for start, end, level in zip(test.minutes, ends, levels, strict=True)
    ]
    path.write_text("".join(lines) + "M5\nM30\n", encoding="ascii")


def _level(text: str, units: Mapping[str, str]) -> tuple[str, float]:
    """Return a driver and its largest level from a text such as ``"spindle speed=12000"``."""
    name, _, value = (part.strip() for part in text.partition("="))
    try:
        return name, float(value.removesuffix(units[name]))
    except (KeyError, ValueError):
        raise DutyPlanError(
            f'--largest "{text}" is no driver of this record with its highest level; write, for example, '
            + ", ".join(f'"{one}=12000 {unit}"' for one, unit in units.items())
        ) from None


def _source(text: str) -> tuple[str, float]:
    """Return name and time constant (s) of a heat source such as ``"spindle=40 min"``."""
    name, equals, time_constant = text.partition("=")
    if not equals or not name.strip():
        raise DutyPlanError(
            f'--source "{text}" is no source; write its name and time constant, for example "spindle=40 min"'
        )
    return name.strip(), read_option(f"--source {name.strip()}", time_constant, "s")


# The test after a compensation.


@dataclass(frozen=True)
class Verification:
    """As found and as left: titles of both campaigns, a verdict per displacement that is corrected, what to know, and what the sheet says
    of the test after.
    """

    before: str
    after: str
    channels: tuple[ChannelVerdict, ...]
    remarks: tuple[str, ...]
    test: StatedTest


class StatedTest(NamedTuple):
    """Conditions of a test, the SHA-256 of the files that a sheet rests on, and what makes the sheet a laboratory's own."""

    conditions: tuple[Iso230Condition, ...]
    files: dict[str, str]
    sheet: Letterhead


def verify_compensation(before: Path, after: Path, applied: Path) -> Verification:
    """Compare a test with an active compensation with what the results before it predicted."""
    from fusion.campaign.inputs import read_record  # loads both instruments, which no plan needs
    from fusion.pipeline.iso230 import date_of, hashed, sheet_files, state_conditions

    if applied.suffix.lower() != ".json":
        raise CampaignError(
            f"{applied}: name the model that the control runs, model.json of export --format model-json; what a table of positions did "
            "shows in thermofuse compare BEFORE AFTER --applied TABLE"
        )
    results, model, campaign = read_results(before), read_recursion(applied), load_campaign(after)
    if not isinstance(results.loop, RecordLoop) or campaign.record is None:
        raise CampaignError(f"{before}, {after}: both tests need temperature sensors and displacements in a [record]")
    table = read_record(campaign)
    if "runs" in table.attrs:
        raise CampaignError(
            f"{after}: name one run as record.file; each test after a compensation is verified by itself"
        )
    health = examine_record(table, [QUASI_STATIC])
    record = reduce_record(health.table, constants=[one.name for one in model.inputs])
    faulty = {one.sensor: describe_fault(one) for one in health.findings if one.state == "left_out"}
    remarks = []
    if model.results_sha256 != file_sha256(before / "results.json"):
        remarks.append(
            f"{applied.name} was not made from the results in {before}: the prediction belongs to another model."
        )
    outside = [
        one.name
        for one in model.inputs
        if one.name in record.sensors
        and not one.low <= np.median(record.temperature[:, record.sensors.index(one.name)]) <= one.high
    ]
    if outside:
        remarks.append(
            f"For most of the test outside the range of the model, where it holds its correction: {', '.join(outside)}."
        )
    date = date_of(table["time"].values, shown_zone(table, campaign.zone_of("record")))
    stated = campaign.report.model_dump(by_alias=True)
    files = {f"{before.name}/results.json": before / "results.json", applied.name: applied, after.name: after}
    return Verification(
        results.campaign,
        campaign.campaign.title,
        tuple(verify(read_product(before, "record"), results.loop, record, model, faulty_sensors=faulty)),
        tuple(remarks),
        StatedTest(
            state_conditions(keys_of("report", of="record"), stated, date, campaign.campaign.axis, {}),
            hashed({**files, **campaign.files_of("record")}),
            sheet_files(campaign.sheet, campaign.folder),
        ),
    )
