"""Machines of the twin with a compensation from their first test: what the second test of another duty shows, and planted faults."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.alignment.sensor_health import describe_fault
from fusion.analysis.drift_model.record import close_record, examine_record, predict
from fusion.analysis.drift_model.record_data import Record, reduce_record
from fusion.analysis.drift_model.recursion import make_recursion, record_of_product
from fusion.analysis.drift_model.verification import ChannelVerdict, predicted_ranges, verify
from fusion.pipeline.record import record_variables
from fusion.results.loop import RecordLoop
from fusion.results.recursion import Recursion
from fusion.twin.recipe import EffectRecipe, Recipe
from fusion.twin.record import simulate_record
from tests.fusion.record_tables import table_of

pytestmark = pytest.mark.slow
#: A spindle without a sensor; nothing else is undeclared.
SOURCE = EffectRecipe("unseen_heat_source", parameters={"um": 15.0, "time_constant_min": 20.0})


def logged(seed: int, **record) -> xr.Dataset:
    """What a machine logs; its names are those of the twin."""
    made = simulate_record(Recipe().vary(campaign={"seed": seed}, record=record, effect=(SOURCE,)))
    table = table_of(made.table["displacement"].values, made.table["temperature"].values, made.table["speed"].values)
    names = {name: made.table[name].values for name in ("sensor", "channel")}
    table = table.assign_coords(**names, driver_name=["spindle speed"])
    return table.assign_attrs(ideal=json.dumps(_ideal_range(made.table).tolist()))


def _ideal_range(table: xr.Dataset) -> np.ndarray:
    """Range that no model can avoid: wandering and noise, on blocks of two minutes as the program averages them."""
    left = (table["nuisance"] + table["noise"]).values
    return np.ptp(left[: len(left) // 3 * 3].reshape(-1, 3, left.shape[1]).mean(axis=1), axis=0)


@cache
def first_test(seed: int) -> tuple[Record, xr.Dataset, RecordLoop, Recursion]:
    record = reduce_record(logged(seed))
    result = close_record(record, ["quasi_static"])
    product, loop = record_variables(record, result), result.described(())
    return record, product, loop, make_recursion(product, loop, campaign="", results_sha256="0", sampling_s=60.0)


def second_test(
    seed: int, folder: Path, *, runs: Recursion | None = None, says: Recursion | None = None, **record
) -> tuple[list[ChannelVerdict], xr.Dataset]:
    """Verify the test after it: the control runs one model and is said to run another; the machine's own by default."""
    _, product, loop, model = first_test(seed)
    file = folder / "model.json"
    file.write_text((runs or model).model_dump_json(), encoding="utf-8")
    table = logged(seed, duty_seed=1000 + seed, applied=str(file), **record)
    health = examine_record(table, ["quasi_static"])
    faulty = {one.sensor: describe_fault(one) for one in health.findings if one.state == "left_out"}
    after = reduce_record(health.table)
    ranges = predicted_ranges(product, loop, after)
    return verify(after, says or model, ranges, faulty_sensors=faulty), table


@pytest.mark.xfail(
    reason="the interval holds 73 % of 60 axes instead of 90 %: a day of the room that the first test did not show",
    strict=True,
)
def test_what_a_compensation_leaves_is_what_was_predicted(tmp_path):
    rows, inside = [], []
    for seed in range(1, 21):
        verdicts, table = second_test(seed, tmp_path)
        bare = reduce_record(logged(seed, duty_seed=1000 + seed))
        ideal = json.loads(table.attrs["ideal"])
        ridge = ridge_ranges(seed, bare)
        for one in verdicts:
            k = ("X", "Y", "Z").index(one.name)
            inside.append(one.achieved_um <= one.predicted_high_um)
            before = float(np.ptp(bare.displacement[:, k]))
            rows.append([before, one.predicted_um, one.achieved_um, ridge[k], ideal[k]])
    before, predicted, achieved, ridge, ideal = np.median(rows, axis=0)
    print(
        f"{len(rows)} axes of 20 machines, median range: before {before:.2f}, predicted {predicted:.2f}, achieved {achieved:.2f}, ridge "
        f"with lags {ridge:.2f}, best possible {ideal:.2f} um; achieved within the interval {np.mean(inside):.2f}"
    )
    assert np.mean(inside) >= 0.9
    assert achieved < 0.5 * before


def ridge_ranges(seed: int, bare: Record) -> np.ndarray:
    """Range that ridge regression with lagged copies, fitted to the first test, leaves in the second."""
    first = record_of_product(first_test(seed)[1])
    left = []
    for record in (first, bare):
        now = np.column_stack(
            [record.temperature, *(one for powers in record.drivers.values() for one in powers.values())]
        )
        late = [record.series(now, "1").lagged(60.0 * minutes).values for minutes in (5.0, 20.0, 80.0)]
        left.append(np.column_stack([now, *late]))
    fitted = predict(first, left[0], np.ones(first.seconds.size, bool))
    return np.ptp(bare.displacement - left[1] @ fitted.coefficients, axis=0)


FAULTS = {
    "wrong sign": {"applied_gain": -1.0},
    "wrong scale": {"applied_gain": 25.4},
    "half the gain": {"applied_gain": 0.5},
    "dead sensor": {"dead_sensor": 2},
    "stale table": {},
}


#: Faults that are not named often enough, with the machines of 10 on which they are.
MISSED = {
    "half the gain": "4 of 10: what half a correction leaves is within the predicted interval, and no fault is looked for",
    "stale table": "5 of 10: a model of another machine may be nearly proportional to the machine's own",
}


@pytest.mark.parametrize(
    "fault",
    [
        pytest.param(one, marks=pytest.mark.xfail(reason=MISSED[one], strict=True)) if one in MISSED else one
        for one in FAULTS
    ],
)
def test_a_planted_fault_is_named(fault, tmp_path):
    named = []
    for seed in range(1, 11):
        # A stale table is that of another machine: its sensors are the same, its coefficients are not.
        runs = first_test(seed + 10)[3] if fault == "stale table" else None
        verdicts, _ = second_test(seed, tmp_path, runs=runs, **FAULTS[fault])
        faults = [one.fault for one in verdicts if one.fault]
        named.append(max(set(faults), key=faults.count) if faults else "")
    print(f"{fault}: {named.count(fault)} of 10 machines; {named}")
    assert named.count(fault) >= 9
