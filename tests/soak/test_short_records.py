"""Robustness of the loop on records: quoted in docs/measured.csv.

Records of the twin of 0.5 h to 12 h, one sample a second to one a minute, are damaged as loggers and machines damage them. Each goes
from the logged table to checked results, one in `WHOLE` from its file to the report, as the command runs it. The answer is a result or an
error of this package that says what to do; anything else, a warning of NumPy included, is a crash. But for the whole commands, `DRAWS`
simulated records stand behind the p-values instead of 200, and records are averaged over at most `BLOCKS` blocks instead of 600, which
saves time and leaves every step of the work in place.
THERMOFUSE_RUNS sets the number of records (2000 by default), THERMOFUSE_FIRST_SEED the first seed.
"""

from __future__ import annotations

import traceback
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.drift_model.record import examine_record
from fusion.analysis.drift_model.record_data import reduce_record
from fusion.common import FusionError
from fusion.pipeline.record import RecordSource, model_record, record_notices, sensor_notices
from fusion.pipeline.run import run_campaign
from fusion.results.progress import silent
from fusion.results.results import assemble
from fusion.twin.recipe import EffectRecipe, Recipe, RecipeError
from fusion.twin.record import RecordTruth, simulate_record, write_record
from tests.fusion.record_tables import table_of
from tests.soak.rates import campaigns, first_seed, rate

pytestmark = pytest.mark.slow

RUNS = campaigns(2000)
FIRST_SEED = first_seed(41_000)
#: One record in so many goes through the whole command.
WHOLE = 50
DRAWS = 20
BLOCKS = 100
EFFECTS = ("none", "thermal_lag", "unseen_heat_source", "step_event", "periodic_disturbance")


def short_record(seed: int) -> RecordTruth:
    """A record of the twin of random length, rate, size and undeclared effect."""
    rng = np.random.default_rng([seed, 1])
    hours = float(np.exp(rng.uniform(np.log(0.5), np.log(12.0))))
    wanted = {
        "hours": hours,
        "step_s": float(np.exp(rng.uniform(0.0, np.log(60.0))).round(rng.integers(0, 3))),
        "sensors": int(rng.integers(1, 9)),
        "channels": int(rng.integers(1, 4)),
        "mean_hold_min": float(rng.choice([5.0, 30.0, 120.0])),
        "noise_um": float(rng.choice([0.0, 0.3, 3.0])),
        "noise_K": float(rng.choice([0.0, 0.03, 0.3])),
        "walk_um_per_sqrt_h": float(rng.choice([0.0, 0.2, 2.0])),
    }
    name = str(rng.choice(EFFECTS))
    parameters = {"step_event": {"at_cycle": 1 + int(hours // 2)}, "periodic_disturbance": {"period_min": 20.0 * hours}}
    effect = EffectRecipe(name, float(rng.choice([0.5, 5.0])), parameters=parameters.get(name, {}))
    plain = Recipe().vary(campaign={"seed": seed}, record=wanted)
    try:
        return simulate_record(plain.vary(effect=[] if name == "none" else [effect]))
    except RecipeError:
        return simulate_record(plain)


def damage(table: xr.Dataset, seed: int) -> xr.Dataset:
    """Damage a record in up to four ways; the names of its variables are those of the twin."""
    rng = np.random.default_rng([seed, 2])
    table = table[["temperature", "displacement", "speed"]].copy(deep=True)
    for kind in rng.choice(list(DAMAGES), rng.integers(0, 5), replace=False):
        table = DAMAGES[kind](table, rng)
    return table


def _one_column(table: xr.Dataset, rng: np.random.Generator) -> np.ndarray:
    """The values of one random column, to be changed in place."""
    name = str(rng.choice(["temperature", "displacement", "speed"]))
    values = table[name].values
    return values if values.ndim == 1 else values[:, rng.integers(values.shape[1])]


def _stretch(size: int, rng: np.random.Generator, *, share: float = 0.5) -> slice:
    first = int(rng.integers(0, size))
    return slice(first, first + 1 + int(rng.uniform(0.0, share) * size))


def _missing_values(table: xr.Dataset, rng: np.random.Generator) -> xr.Dataset:
    for name in ("temperature", "displacement", "speed"):
        table[name].values[rng.random(table[name].shape) < rng.choice([0.001, 0.05, 0.5])] = np.nan
    return table


def _missing_stretch(table: xr.Dataset, rng: np.random.Generator) -> xr.Dataset:
    values = _one_column(table, rng)
    values[_stretch(values.size, rng, share=1.0)] = np.nan
    return table


def _constant(table: xr.Dataset, rng: np.random.Generator) -> xr.Dataset:
    _one_column(table, rng)[:] = rng.choice([0.0, 20.0, 1e-9])
    return table


def _stuck(table: xr.Dataset, rng: np.random.Generator) -> xr.Dataset:
    values = _one_column(table, rng)
    where = _stretch(values.size, rng, share=1.0)
    values[where] = values[where.start]
    return table


def _jump(table: xr.Dataset, rng: np.random.Generator) -> xr.Dataset:
    values = _one_column(table, rng)
    values[int(rng.integers(0, values.size)) :] += rng.choice([-5.0, 28.0, 1e4])
    return table


def _spikes(table: xr.Dataset, rng: np.random.Generator) -> xr.Dataset:
    values = _one_column(table, rng)
    values[rng.integers(0, values.size, 3)] = rng.choice([-9999.0, 1e7, 3.4e38])
    return table


def _rounded(table: xr.Dataset, rng: np.random.Generator) -> xr.Dataset:
    values = _one_column(table, rng)
    values[:] = np.round(values, int(rng.integers(-1, 2)))
    return table


def _twins(table: xr.Dataset, rng: np.random.Generator) -> xr.Dataset:
    values = table["temperature"].values
    values[:] = values[:, rng.integers(0, values.shape[1], values.shape[1])]
    return table


def _pauses(table: xr.Dataset, rng: np.random.Generator) -> xr.Dataset:
    kept = np.ones(table.sizes["time"], bool)
    for _ in range(rng.integers(1, 5)):
        kept[_stretch(kept.size, rng, share=0.2)] = False
    return table.isel(time=kept) if kept.any() else table


def _clock(table: xr.Dataset, rng: np.random.Generator) -> xr.Dataset:
    """Stamps that repeat, jitter, or leap by days."""
    step = np.diff(table["time"].values[:2])[0]
    rows = np.sort(rng.integers(0, table.sizes["time"], table.sizes["time"]))
    leap = np.where(np.arange(rows.size) > rng.integers(0, rows.size), rng.choice([0, 1, 10_000]), 0) * step
    jitter = (rng.uniform(-0.4, 0.4, rows.size) * step.astype(float)).astype("m8[ns]")
    table = table.isel(time=rows)
    time = table["time"].values + leap + (jitter if rng.random() < 0.5 else 0 * jitter)
    return table.assign_coords(time=np.sort(time))


DAMAGES = {
    "missing values": _missing_values,
    "missing stretch": _missing_stretch,
    "constant": _constant,
    "stuck": _stuck,
    "jump": _jump,
    "spikes": _spikes,
    "rounded": _rounded,
    "twins": _twins,
    "pauses": _pauses,
    "clock": _clock,
}


def model(truth: RecordTruth, seed: int) -> str:
    """Model a damaged record as the pipeline does from the table that it has read; the verdict."""
    table = damage(truth.table, seed)
    logged = seed % 4 != 0
    speed = table["speed"].values if logged else None
    whole = table_of(table["displacement"].values, table["temperature"].values, speed)
    health = examine_record(whole.assign_coords(time=table["time"].values), ["quasi_static"])
    record = reduce_record(health.table)
    notices = [*sensor_notices(health), *record_notices(record)]
    source = RecordSource(record, ["quasi_static"], notices, health)
    outcome = model_record(source, report=silent)
    results = assemble("short record", outcome.parts, outcome.notices)
    assert results.loop is not None
    return results.loop.verdict


def run_command(truth: RecordTruth, seed: int, folder: Path) -> str:
    """Run a damaged record as the command does, from its file to the report; the verdict."""
    (folder / "truth").mkdir(parents=True)
    table = truth.table.drop_dims("time").merge(damage(truth.table, seed))
    path = write_record(RecordTruth(truth.recipe, table, ()), folder, folder / "truth")
    results = run_campaign(path, folder / "results")
    assert results.loop is not None
    return results.loop.verdict


def test_short_records_end_with_a_result_or_a_clear_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    outcomes: Counter[str] = Counter()
    crashes: list[str] = []
    for seed in range(FIRST_SEED, FIRST_SEED + RUNS):
        truth = short_record(seed)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                if seed % WHOLE == 0:
                    outcomes[run_command(truth, seed, tmp_path / str(seed))] += 1
                else:
                    with monkeypatch.context() as reduced:
                        reduced.setattr("fusion.analysis.drift_model.record.DRAWS", DRAWS)
                        reduced.setattr("fusion.analysis.drift_model.record_data.MOST_BLOCKS", BLOCKS)
                        outcomes[model(truth, seed)] += 1
        except FusionError:
            outcomes["refused"] += 1
        except Exception:
            outcomes["crashed"] += 1
            crashes.append(f"seed {seed}: {traceback.format_exc(limit=-4)}")
    with capsys.disabled():
        print(f"\nshort records: {dict(outcomes)}, crashed {rate(len(crashes), RUNS)}", *crashes[:20], sep="\n")
    assert not crashes
