"""The report of a record: every channel with its errors, means over the parts, what was rejected."""

from typing import Any

import numpy as np
import xarray as xr

from fusion.report.campaign import describe_campaign
from fusion.report.charts.model import draw_record
from fusion.report.page import render_page
from fusion.results.loop import RecordLoop
from fusion.results.results import assemble
from tests.fusion.report.page_tables import tables_of
from tests.fusion.report.test_campaign import ORIGIN
from tests.fusion.results_sample import RECORD_LOOP


def record(channels: int = 1, drivers: int = 1) -> xr.Dataset:
    """A record of four blocks of a minute, as fusion.nc holds it."""
    time = np.datetime64("2026-01-05T06:00", "ns") + np.arange(4) * np.timedelta64(60, "s")
    predicted = ("displacement", "predicted_declared", "predicted_final")
    return xr.Dataset(
        {
            **{name: (("time", "channel"), np.zeros((4, channels))) for name in predicted},
            "predicted_u": ("channel", np.full(channels, 0.1)),
            "temperature": (("time", "sensor"), np.full((4, 2), 20.0)),
            "sealed": ("time", [False, False, False, True]),
            "driver": (("time", "driver_name"), np.zeros((4, drivers))),
        },
        coords={
            "time": time,
            "channel": ["X", *(f"c{k}" for k in range(1, channels))],
            "sensor": ["t1", "t2"],
            "driver_name": ["speed"] * drivers,
            "effect": [],
        },
        attrs={"block_s": 60.0},
    )


def page_of(**changes: Any) -> str:
    """The report of the record without its charts, with another loop."""
    results = assemble("R", {"loop": {**RECORD_LOOP, **changes}}, [])
    assert isinstance(results.loop, RecordLoop)
    return render_page(
        "report.html.j2", {}, results=results, provenance=ORIGIN, thermal_map=None,
        summary=describe_campaign(results, ORIGIN, {"record": record()}, None),
    )  # fmt: skip


def test_a_record_is_told_with_its_channels_and_its_driver():
    page = page_of()
    assert "1 displacement and 2 temperatures over 4 min, with speed as driver" in page
    tables = tables_of(page)
    assert tables["Errors channel by channel"][1] == ["X", "0.900", "0.600", "0.400", "–", "10 %", "0.10", "0.300"]
    assert tables["Errors of forward chaining"][-1] == ["mean", "", "0.900", "0.600", "0.400"]
    assert ["not tried: dead path of the laser", "no air"] in tables["Effects that were not admitted or not tried"]
    assert tables["Candidates with their scores"][1][-2:] == ["0.700 to 0.500", "chosen"]
    assert not {
        "Effects that were tested and rejected",
        "Sensors and displacements that are faulty or suspected",
    } & set(tables)


def test_the_forecast_from_the_last_value_stands_beside_its_own_baseline():
    expected = {"expected_um": 0.3, "expected_low_um": 0.1, "expected_high_um": 0.35, "expected_p": 0.02}
    page = page_of(anchored={"model": {"rmse_um": 0.45, **expected}, "last_value": {"rmse_um": 0.9}})
    rows = tables_of(page)["Errors of predicting the hold-out"]
    assert ["0.45", "0.30 [0.10 to 0.35]"] in [row[1:] for row in rows]
    told = " ".join(page.split())
    assert (
        "predicted to 0.45 µm, more than expected (0.10 to 0.35 µm); staying at them gives 0.90 µm. What was measured"
        in told
    )


def test_the_page_stays_readable_with_many_channels():
    told = describe_campaign(
        assemble("R", {"loop": RECORD_LOOP}, []), ORIGIN, {"record": record(channels=9, drivers=0)}, None
    )["record"]
    assert (len(told["shown"]), told["omitted"]) == (6, 3)
    assert "driver" not in told["measured"]
    charts = draw_record(record(channels=9, drivers=0))
    assert "drivers" not in charts
    assert len([name for name in charts if name.startswith("prediction_")]) == 6


def test_a_candidate_that_was_tried_and_not_chosen_is_rejected_whatever_the_reason():
    (scores,) = RECORD_LOOP["search"]
    tried = {**scores[0], "chosen": False, "rejected": ""}
    untried = {**tried, "chained_rmse_after_um": None}
    tables = tables_of(page_of(search=[[tried, untried]]))
    assert [row[-1] for row in tables["Candidates with their scores"][1:]] == ["predicts no better", ""]
    assert len(tables["Effects that were tested and rejected"]) == 2


def test_a_faulty_sensor_stands_with_the_error_with_and_without_it():
    fault = {
        "sensor": "t5", "kind": "ramp", "state": "left_out", "onset_s": 9000.0, "onset_u_s": 180.0, "size": 27.9, "ratio": 214.0,
        "limit": 10.6, "reason": "", "rmse_with_um": 15.7, "rmse_without_um": 4.3,
    }  # fmt: skip
    suspected = {**fault, "state": "suspected", "reason": "other sensors respond", "rmse_with_um": None}
    _, first, second = tables_of(page_of(sensor_faults=[fault, suspected]))[
        "Sensors and displacements that are faulty or suspected"
    ]
    assert "28 K from 2.50 h on (standard uncertainty 0.05 h)" in first[1]
    assert [first[0], *first[2:]] == ["t5", "214", "10.6", "left out", "15.7", "4.30"]
    assert second[1] == f"{first[1]}; other sensors respond"


def test_the_time_of_several_runs_is_without_what_lies_between_them():
    errors = dict.fromkeys(("rmse_persistence_um", "rmse_declared_um", "rmse_final_um"))
    runs = [
        {"file": f"{day}.csv", "held_out": False, "duration_h": 5.0, "blocks": 60, "verdict": "", **errors}
        for day in ("monday", "tuesday")
    ]
    page = page_of(runs=runs)
    assert "over 10.0 h in 2 runs" in page
    assert tables_of(page)["Errors run by run"][1] == ["monday.csv", "5.00", "–", "–", "–", "training"]
