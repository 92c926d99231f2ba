"""Records of one simulated machine compared: unchanged under another load and room, and with a response or a level that changed.

THERMOFUSE_RUNS sets the number of pairs of each kind (60 by default), THERMOFUSE_FIRST_SEED the first seed.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.comparison import Change, compare_tests
from fusion.analysis.drift_model.record_data import reduce_record
from tests.fusion.record_tables import table_of
from tests.soak.rates import campaigns, first_seed, rate
from tests.soak.simulator import Array, first_order, room, switched_load, walk

pytestmark = pytest.mark.slow

RUNS, FIRST_SEED = campaigns(60), first_seed(4000)
#: What the first of two displacements does in the second record: factor of its response, and um of its level.
KINDS = {
    "unchanged": (1.0, 0.0),
    "response x 1.3": (1.3, 0.0),
    "response x 0.8": (0.8, 0.0),
    "level + 10 um": (1.0, 10.0),
}


def records(seed: int, response: float, level_um: float) -> list[xr.Dataset]:
    """Two records a day apart: a spindle warms a chain of parts in a room; sensors read mixtures late, displacements follow later."""
    rng = np.random.default_rng([seed, 51])
    minutes, coupled = rng.uniform(15.0, 120.0, 3), rng.uniform(0.3, 0.9, 3)
    first_min, rise_K, power = rng.uniform(5.0, 30.0), rng.uniform(2.0, 12.0), rng.choice([1, 2])
    read = rng.dirichlet(np.full(5, 0.5), int(rng.integers(2, 7)))
    late_min, per_kelvin = rng.uniform(1.0, 40.0, (2, 5)), rng.normal(0.0, 3.0, (2, 5))
    bent, wander, noise = rng.normal(0.0, 0.1), rng.choice([0.1, 0.5, 1.5]), rng.choice([0.1, 0.5])
    sensor_min, levels, is_logged = rng.uniform(0.3, 3.0, len(read)), rng.normal(0.0, 50.0, 2), rng.random() < 0.6
    tables = []
    for day in range(2):
        samples = int(rng.integers(1500, 4000))
        seconds = np.linspace(0.0, 3600.0 * rng.uniform(6.0, 36.0), samples)
        load = switched_load(rng, seconds * rng.uniform(0.3, 1.5)) * rng.uniform(0.5, 1.0)
        parts = [rise_K * first_order(seconds, load**power, first_min)]
        for one, share in zip(minutes, coupled, strict=True):
            parts.append(first_order(seconds, share * parts[-1], one))
        air = rng.uniform(0.3, 2.0) * room(rng, seconds, rng.uniform(120.0, 600.0)) + rng.normal(0.0, 2.0)
        parts.append(air)

        def late(course: Array, tau_min: float, seconds: Array = seconds) -> Array:
            return course[0] + first_order(seconds, course - course[0], tau_min)

        mixed = np.column_stack(parts) @ read.T
        temperature = np.column_stack([late(one, tau) for one, tau in zip(mixed.T, sensor_min, strict=True)])
        courses = []
        for k in range(2):
            moved = sum(
                size * late(part, tau) for size, part, tau in zip(per_kelvin[k], parts, late_min[k], strict=True)
            )
            moved *= 1.0 + bent * np.tanh(parts[0] / 10.0)
            changes = day == 1 and k == 0
            moved = moved * (response if changes else 1.0) + levels[k] + (level_um if changes else 0.0)
            courses.append(moved + walk(rng, seconds, wander) + noise * rng.standard_normal(samples))
        logged = 20.0 + temperature + 0.03 * rng.standard_normal(temperature.shape)
        table = table_of(np.column_stack(courses), logged, load if is_logged else None, step_s=float(seconds[1]))
        tables.append(table.assign_coords(time=table["time"] + np.timedelta64(day, "D")))
    return tables


def product_of(table: xr.Dataset) -> xr.Dataset:
    """A record as ``fusion.nc`` holds it, as far as a comparison reads it."""
    record, dims = reduce_record(table), ("time", "driver_name")
    drivers = [
        np.reshape([powers[k] for powers in record.drivers.values()], (-1, record.seconds.size)).T for k in (1, 2)
    ]
    return xr.Dataset(
        {
            "displacement": (("time", "channel"), record.displacement),
            "temperature": (("time", "sensor"), record.temperature),
            "driver": (dims, drivers[0]),
            "driver_square": (dims, drivers[1]),
            "driver_size": ("driver_name", [size for size, _ in record.driver_sizes.values()]),
            "driver_units": ("driver_name", np.array([unit for _, unit in record.driver_sizes.values()], object)),
            "elapsed": ("time", record.seconds),
            "part": ("time", record.chained + 1),
        },
        {
            "time": record.time,
            "channel": list(record.channels),
            "sensor": list(record.sensors),
            "driver_name": list(record.drivers),
        },
        {"block_s": record.block_s},
    )


def compared(seed: int, response: float, level_um: float) -> list[Change]:
    """What differs between the two, judged as of a comparison of two."""
    tests = [SimpleNamespace(record=product_of(one), axis="") for one in records(seed, response, level_um)]
    return [*compare_tests(tests[0], tests[1:])[0].changes]


def test_what_changed_between_two_records_is_told_and_nothing_else(capsys: pytest.CaptureFixture[str]) -> None:
    for kind, (response, level_um) in KINDS.items():
        covered, found, large, false, values = [], [], [], [], 0
        for seed in range(FIRST_SEED, FIRST_SEED + RUNS):
            changes = [one for one in compared(seed, response, level_um) if one.change.u is not None]
            truth = {"response": 100.0 * (response - 1.0), "level": level_um}
            for one in changes:
                true = truth[one.group] if one.quantity == "ch1" else 0.0
                covered.append(abs(one.change.value - true) <= 2.0 * one.change.u)
                found += [one.significant] if true else []
                large += [one.significant] if abs(true) >= one.shown_from else []
            of_other = [one for one in changes if one.quantity == "ch2" or kind == "unchanged"]
            false.append(any(one.significant for one in of_other))
            values += len(changes)
        with capsys.disabled():
            told = f"{kind}: pairs with a false change {rate(sum(false), len(false))}; within 2 u {np.mean(covered):.3f} of {values}"
            print(
                f"{told}; found {sum(found)} of {len(found)}, of the sizes that are shown {sum(large)} of {len(large)}"
            )
        # The level of a comparison, and three standard deviations of a count of pairs; 2 u, and that of their values.
        assert np.mean(false) <= 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / RUNS)
        assert np.mean(covered) >= 0.9
        assert sum(large) >= 0.8 * len(large)
