"""The next test: when to switch what, with what power; and the test after a compensation against what the one before it predicted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fusion.analysis.alignment.sensor_health import describe_fault
from fusion.analysis.attribution.duty import DutyPlanError, Machine, plan_duty, switchings
from fusion.analysis.drift_model.next_test import propose_tests
from fusion.analysis.drift_model.record import examine_record
from fusion.analysis.drift_model.record_data import reduce_record
from fusion.analysis.drift_model.verification import ChannelVerdict, verify
from fusion.analysis.effects.thermal import QUASI_STATIC
from fusion.campaign.config import CampaignError, load_campaign
from fusion.campaign.values import read_option
from fusion.results.loop import RecordLoop
from fusion.results.numbers import duration
from fusion.results.recursion import read_recursion
from fusion.results.results import read_results
from fusion.results.store import file_sha256, read_product

#: Inputs that are named as known worst.
_NAMED = 4


def duty_lines(
    sources: Sequence[str], *, effect: str, drift: str, noise: str, cycle: str, power: float, seed: int
) -> list[str]:
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
    proposed = plan_duty(machine, power=power, seed=seed)
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


def next_test_lines(folder: Path, *, seed: int) -> list[str]:
    """Propose the next test of a record's machine from what the last one left open."""
    results = read_results(folder)
    if not isinstance(results.loop, RecordLoop):
        raise DutyPlanError(
            f"{folder}: the results of a [record] are needed; for a positioning test name its heat sources by --source"
        )
    product = read_product(folder, "record")
    tests = list(propose_tests(product, results.loop, seed=seed))
    now = tests[0].width_now_um
    # The shortest that halves what is open, else the one that leaves least.
    best = next((one for one in tests if one.width_um <= now / 2.0), min(tests, key=lambda one: one.width_um))
    worst = ", ".join(f"{name} {um:.2g} um" for name, um in list(tests[0].open_um.items())[:_NAMED])
    names = [str(name) for name in product["driver_name"].values]
    units = [str(unit) for unit in product["driver_units"].values]
    return [
        f"standard uncertainty of a prediction under another duty: {now:.2g} um now; least known by itself: {worst}",
        *(
            f"after {one.hours:g} h, mean time at one level {one.hold_min:g} min: {one.width_um:.2g} um"
            for one in tests
        ),
        f"proposed: {best.hours:g} h",
        "minute  " + "  ".join(f"{name} / {unit}" for name, unit in zip(names, units, strict=True)),
        *(
            f"{minute:6.0f}  " + "  ".join(f"{level:g}" for level in row)
            for minute, row in zip(best.minutes, best.levels, strict=True)
        ),
    ]


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
    """As found and as left.

    Attributes
    ----------
    before, after : titles of the campaigns
    channels : one verdict per displacement that is corrected
    remarks : what to know, one sentence each
    """

    before: str
    after: str
    channels: tuple[ChannelVerdict, ...]
    remarks: tuple[str, ...]


def verify_compensation(before: Path, after: Path, applied: Path) -> Verification:
    """Compare a test with an active compensation with what the results before it predicted."""
    from fusion.campaign.inputs import read_record  # loads both instruments, which no plan needs

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
    return Verification(
        results.campaign,
        campaign.campaign.title,
        tuple(verify(read_product(before, "record"), results.loop, record, model, faulty_sensors=faulty)),
        tuple(remarks),
    )
