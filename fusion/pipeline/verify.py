"""The test after a compensation against what the test before it predicted."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fusion.analysis.alignment.sensor_health import describe_fault
from fusion.analysis.drift_model.record import examine_record
from fusion.analysis.drift_model.record_data import reduce_record
from fusion.analysis.drift_model.verification import ChannelVerdict, verify
from fusion.analysis.effects.thermal import QUASI_STATIC
from fusion.campaign.config import CampaignError, load_campaign
from fusion.campaign.inputs import read_record
from fusion.results.loop import RecordLoop
from fusion.results.recursion import read_recursion
from fusion.results.results import read_results
from fusion.results.store import file_sha256, read_product


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
    record = reduce_record(health.table)
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
