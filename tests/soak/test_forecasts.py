"""Forecasts of records from the last value before the hold-out: their interval in simulation, their error beside a ridge of one's own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fusion.analysis.drift_model.record import hold_out
from fusion.analysis.drift_model.record_data import Record, reduce_record
from fusion.analysis.drift_model.recursion import forecast
from tests.fusion.record_tables import SPINDLE, record_of, spindle_table
from tests.soak.simulator import Array, first_order, room, switched_load, walk

pytestmark = pytest.mark.slow


def simulated(rng: np.random.Generator, *, walk_um: float, noise_um: float, blocks: int) -> Record:
    """Blocks of 5 min: four sensors of a load in a room, a displacement that follows two of them late, wanders and is noisy."""
    seconds = 300.0 * np.arange(blocks)
    load, air = switched_load(rng, seconds / 4.0), room(rng, seconds, 600.0)
    rise = [
        rng.uniform(2.0, 10.0) * first_order(seconds, load, rng.uniform(10.0, 120.0)) + rng.uniform(0.2, 1.5) * air
        for _ in range(4)
    ]
    late = [2.0 * rng.normal() * first_order(seconds, one - one[0], rng.uniform(1.0, 60.0)) for one in rise[:2]]
    beside = walk(rng, seconds, walk_um * np.sqrt(12.0)) + noise_um * rng.standard_normal(blocks)
    temperature = 20.0 + np.column_stack(rise) + 0.02 * rng.standard_normal((blocks, 4))
    return record_of((sum(late) + beside)[:, None], temperature, drivers={"speed": load})


@pytest.mark.parametrize(("walk_um", "noise_um"), [(0.0, 0.3), (0.05, 0.3), (0.3, 0.2), (1.0, 0.2)])
def test_the_interval_of_a_forecast_holds_what_a_random_walk_does(walk_um: float, noise_um: float) -> None:
    """Steps of the walk per block; 100 records of 150, 300 or 600 blocks each."""
    covered, errors, expected, last = [], [], [], []
    for seed in range(7000, 7100):
        rng = np.random.default_rng(seed)
        record = simulated(rng, walk_um=walk_um, noise_um=noise_um, blocks=int(rng.choice([150, 300, 600])))
        train, _ = hold_out(record)
        found = forecast(record, np.zeros((0, *record.displacement.shape)), train)
        assert found is not None
        missed, u = (record.displacement - found.predicted)[~train], found.u[~train]
        covered.append(np.mean(np.abs(missed) < 1.96 * u))
        errors.append(found.error.rmse_um)
        expected.append(found.error.expected_um)
        last.append(np.sqrt(np.mean((record.displacement[~train] - record.displacement[train][-1]) ** 2)))
    rms = [float(np.sqrt(np.mean(np.square(one)))) for one in (errors, expected, last)]
    print(f"\nwalk {walk_um} um, noise {noise_um} um: coverage {np.mean(covered):.3f} ± {np.std(covered) / 10.0:.3f}")
    print("missed {:.2f}, expected {:.2f}, staying at the last value {:.2f} um".format(*rms))
    # Nominal .95; blocks of one record share their error, so that 100 records count as some 100 trials.
    assert 0.9 <= np.mean(covered) <= 0.98
    assert 0.75 < rms[1] / rms[0] < 1.35


def own_ridge(seconds: Array, logged: Array, course: Array, train: np.ndarray) -> Array:
    """Anchored ridge regression: lags as candidates, blocked cross-validation in the later half of eight parts, from the last value on."""
    known = np.flatnonzero(train & np.isfinite(course))
    parts, found = np.array_split(known, 8), []
    for lags in ((0,), (0, 5), (0, 20), (0, 80), (0, 5, 20), (0, 20, 80), (0, 5, 20, 80)):
        columns = np.column_stack([_late(seconds, logged, minutes) for minutes in lags])
        for penalty in 10.0 ** np.arange(-5.0, 2.1, 0.5):
            squares = []
            for k in range(4, 8):
                before = np.concatenate(parts[:k])
                moved = (columns[parts[k]] - columns[before[-1]]) @ _ridge(columns[before], course[before], penalty)
                squares.append(np.mean((course[parts[k]] - course[before[-1]] - moved) ** 2))
            found.append((np.mean(squares), lags, penalty))
    _, lags, penalty = min(found)
    columns = np.column_stack([_late(seconds, logged, minutes) for minutes in lags])
    moved = (columns - columns[known[-1]]) @ _ridge(columns[known], course[known], penalty)
    return np.asarray(course[known[-1]] + moved)


def _late(seconds: Array, logged: Array, minutes: float) -> Array:
    return (
        logged if minutes == 0 else np.column_stack([first_order(seconds, one - one[0], minutes) for one in logged.T])
    )


def _ridge(columns: Array, course: Array, penalty: float) -> Array:
    scale = columns.std(axis=0)
    standard = (columns - columns.mean(axis=0)) / np.where(scale > 1e-9, scale, np.inf)
    normal = standard.T @ standard / course.size + penalty * np.eye(scale.size)
    coefficients = np.linalg.solve(normal, standard.T @ (course - course.mean()) / course.size)
    return np.asarray(coefficients / np.where(scale > 1e-9, scale, np.inf))


@pytest.mark.real_data
def test_a_measured_record_is_predicted_as_well_as_by_an_anchored_ridge(tmp_path: Path, real_file) -> None:
    """Five displacements of a spindle, 46 h (CAIVIAC/FL_THERMAL)."""
    record = reduce_record(spindle_table(tmp_path, real_file(SPINDLE)))
    train, _ = hold_out(record)
    found = forecast(record, np.zeros((0, *record.displacement.shape)), train)
    assert found is not None
    drivers = [values for powers in record.drivers.values() for values in powers.values()]
    logged, held = np.column_stack([record.rise, *drivers]), ~train
    ridge, last = [], []
    for course in record.displacement.T:
        ridge.append(np.sqrt(np.mean((course - own_ridge(record.seconds, logged, course, train))[held] ** 2)))
        last.append(np.sqrt(np.mean((course[held] - course[train][-1]) ** 2)))
    for each in zip(record.channels, found.channels_um, ridge, last, strict=True):
        print("{}: {:.2f} um, own ridge {:.2f}, staying at the last value {:.2f}".format(*each))
    # The ridge chooses among other lags and parts of a block that is laid otherwise.
    assert np.mean(found.channels_um) < 1.05 * np.mean(ridge) < 0.3 * np.mean(last)
