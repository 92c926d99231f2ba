"""The section on a record: every channel with its errors, means over the parts, what was rejected."""

from __future__ import annotations

import numpy as np
import xarray as xr

from fusion.products.results import RecordLoop, assemble
from fusion.report.record_section import describe_record, draw_record
from tests.fusion.results_sample import RECORD_LOOP

RESULTS = assemble("R", {"loop": RECORD_LOOP}, [])


def record(channels: int = 1, drivers: int = 1) -> xr.Dataset:
    """A record of four blocks of a minute, as fusion.nc holds it."""
    time = np.datetime64("2026-01-05T06:00", "ns") + np.arange(4) * np.timedelta64(60, "s")
    return xr.Dataset(
        {
            **{
                name: (("time", "channel"), np.zeros((4, channels)))
                for name in ("displacement", "predicted_declared", "predicted_final")
            },
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


def test_a_record_is_told_with_its_channels_and_its_driver() -> None:
    assert isinstance(RESULTS.loop, RecordLoop)
    told = describe_record(RESULTS, {"inputs": {"record.csv": {}}}, record())
    assert told["measured"] == "Measured: 1 displacement and 2 temperatures over 4 min, with speed as driver."
    assert told["channels"].rows[0].cells == ["X", "0.900", "0.600", "0.400", "10", "0.10", "0.300"]
    assert told["chained"].rows[-1].cells == ["mean", "", "0.900", "0.600", "0.400"]
    assert told["rejected"].rows == ()
    assert ("not tried: dead path of the laser", "no air") in told["refused"]
    assert told["candidates"].rows[0].cells[-2:] == ["0.700 to 0.500", "chosen"]


def test_the_page_stays_readable_with_many_channels() -> None:
    told = describe_record(RESULTS, {"inputs": {}}, record(channels=9, drivers=0))
    assert (len(told["shown"]), told["omitted"]) == (6, 3)
    assert "driver" not in told["measured"]
    charts = draw_record(record(channels=9, drivers=0))
    assert "drivers" not in charts
    assert len([name for name in charts if name.startswith("prediction_")]) == 6


def test_a_candidate_that_was_tried_and_not_chosen_is_rejected_whatever_the_sentence() -> None:
    (scores,) = RECORD_LOOP["search"]
    tried = {**scores[0], "chosen": False, "rejected": ""}
    untried = {**tried, "chained_rmse_after_um": None}
    results = assemble("R", {"loop": {**RECORD_LOOP, "search": [[tried, untried]]}}, [])
    told = describe_record(results, {"inputs": {}}, record())
    assert [row.cells[-1] for row in told["candidates"].rows] == ["predicts no better", ""]
    assert len(told["rejected"].rows) == 1


def test_a_faulty_sensor_stands_with_the_error_with_and_without_it() -> None:
    fault = {
        "sensor": "t5",
        "kind": "ramp",
        "state": "left_out",
        "onset_s": 9000.0,
        "onset_u_s": 180.0,
        "size": 27.9,
        "ratio": 214.0,
        "limit": 10.6,
        "reason": "",
        "rmse_with_um": 15.7,
        "rmse_without_um": 4.3,
    }
    suspected = {**fault, "state": "suspected", "reason": "other sensors respond", "rmse_with_um": None}
    results = assemble("R", {"loop": {**RECORD_LOOP, "sensor_faults": [fault, suspected]}}, [])
    first, second = describe_record(results, {"inputs": {}}, record())["sensor_faults"].rows
    told = "ramps by 28 K from 2.50 h on (standard uncertainty 0.05 h)"
    assert first.cells == ["t5", told, "214", "10.6", "left out", "15.7", "4.30"]
    assert second.cells[1] == f"{told}; other sensors respond"
    assert describe_record(RESULTS, {"inputs": {}}, record())["sensor_faults"].rows == ()


def test_the_time_of_several_runs_is_without_what_lies_between_them() -> None:
    errors = dict.fromkeys(("rmse_persistence_um", "rmse_declared_um", "rmse_final_um"))
    runs = [
        {"file": f"{day}.csv", "held_out": False, "duration_h": 5.0, "blocks": 60, "verdict": "", **errors}
        for day in ("monday", "tuesday")
    ]
    results = assemble("R", {"loop": {**RECORD_LOOP, "runs": runs}}, [])
    told = describe_record(results, {"inputs": {"record.csv": {}}}, record())
    assert "over 10.0 h in 2 runs" in told["measured"]
