"""Tables of own axes between two tests: right ones are no change of the machine, planted faults are named: docs/method/comparison.md.

THERMOFUSE_RUNS sets the number of axes.
"""

from __future__ import annotations

import numpy as np
import pytest

from fusion.analysis.comparison import compare_profiles, find_table_fault, predict_here, take_out
from fusion.analysis.predicted_test import scatter_and_drift
from fusion.report.exports.controls import ActiveTable, ErrorTable, read_profile, tabulate
from fusion.report.exports.export import predict_test
from fusion.results.parts import ByDirection, TablePrediction
from fusion.results.store import joined
from interferometry.drift.estimate import estimate_drift
from interferometry.iso230 import evaluate_iso230
from tests.soak.rates import campaigns, first_seed, rate
from tests.soak.simulator import Array, deviations_of

pytestmark = pytest.mark.slow
RUNS = campaigns(40)
LEVEL = 0.05
POSITION = np.array(
    [0.0, 21.0, 43.0, 61.0, 82.0, 103.0, 121.0, 140.0, 163.0, 182.0, 199.0, 223.0, 241.0, 262.0, 279.0, 300.0]
)
#: Noise of a reading and smallest difference of two tables that are called different, um.
NOISE_UM = 0.3


def axis(rng: np.random.Generator) -> Array:
    """Deviations (2, n), um: a pitch error, a screw's period, a bow and a reversal that varies along the axis."""
    share = POSITION / 300.0
    mean = 8.0 * rng.standard_normal() * share + 6.0 * rng.standard_normal() * share * (1.0 - share)
    mean = mean + np.cumsum(rng.normal(0.0, 0.9, POSITION.size)) + 0.6 * np.sin(POSITION / 1.3 + rng.uniform(0, 6))
    reversal = rng.normal(0.0, 0.8) + 0.4 * np.cumsum(rng.normal(0.0, 0.5, POSITION.size))
    return np.array([mean + reversal / 2.0, mean - reversal / 2.0])


def measure(
    rng: np.random.Generator,
    profile: Array,
    *,
    cycles: int,
    drift_um: float,
    state: tuple[float, float, float] = (1.0, 1.0, 0.0),
    noise: np.random.Generator | None = None,
):
    """A test: both approaches of every cycle; shift and stretch of its own warm-up, and noise of the same generator or another one."""
    order = np.concatenate([np.arange(16), np.arange(31, 15, -1)]).reshape(2, -1)
    order[1] = 31 - np.arange(16)
    seconds = 300.0 * np.arange(cycles)[:, None, None] + 8.0 * order
    share, of_time, begun = state
    reached = 1.0 - (1.0 - begun) * np.exp(-seconds / (of_time * rng.uniform(1500.0, 6000.0)))
    shift, stretch = share * drift_um * rng.standard_normal(2)
    drift = reached * (shift + stretch * POSITION / 300.0)
    return deviations_of(seconds, POSITION, profile + drift + NOISE_UM * (noise or rng).standard_normal(seconds.shape))


def an_old_table(rng: np.random.Generator, errors: Array) -> ActiveTable:
    """A table of what the axis had once, which is not what it has now."""
    at, once = np.arange(-10.0, 311.0, 16.0), errors + np.cumsum(rng.normal(0.0, 0.5, (2, 16)), axis=1)
    old = np.array([np.interp(at, POSITION, one) for one in once])
    return ActiveTable("old.comp", at, old - old[0, 0])


FAULTS = {
    "not active": lambda table: 0.0 * table(POSITION),
    "wrong sign": lambda table: -table(POSITION),
    "half the gain": lambda table: 0.5 * table(POSITION),
    "wrong scale": lambda table: 2.0 * table(POSITION),
    "shifted": lambda table: table(POSITION - 40.0),
    "mirrored": lambda table: table(300.0 - POSITION),
    "approaches swapped": lambda table: table(POSITION)[::-1],
}


def made(table: ErrorTable, predicted, *, one_table: bool = False) -> TablePrediction:
    forward, reverse = table.added_um(table.position_mm, one_table=one_table).tolist()
    return TablePrediction(
        table="x.comp", campaign="", results_sha256="0" * 64, cycles=5, predicted_um=predicted,
        position_mm=tuple(table.position_mm.tolist()), correction_um=ByDirection(positive=tuple(forward), negative=tuple(reverse)),
    )  # fmt: skip


@pytest.mark.parametrize(("cycles", "drift_um"), [(5, 0.3), (10, 2.0), (20, 6.0)])
def test_right_tables_and_planted_faults(cycles: int, drift_um: float) -> None:
    counts = dict.fromkeys(("changed", "fault", "not told"), 0)
    named, wrong = dict.fromkeys(FAULTS, 0), []
    for run in range(RUNS):
        rng = np.random.default_rng(first_seed(5300) + run)
        profile = axis(rng)
        first = measure(rng, profile, cycles=cycles, drift_um=drift_um)
        drift = estimate_drift(first)
        whole = joined(first, estimate=drift)
        before = drift.assign(position=first["position"])
        table = tabulate(read_profile(whole))
        found = predict_test(read_profile(whole), table, *scatter_and_drift(before), cycles=5, one_table=False)
        stated = made(table, found)

        def taken(at: Array, table=table) -> Array:
            return table.added_um(at, one_table=False)

        def second(correction: Array, rng=rng, profile=profile):
            readings = measure(rng, profile - correction, cycles=cycles, drift_um=drift_um)
            return estimate_drift(readings).assign(position=readings["position"])

        after = second(taken(POSITION))
        change = compare_profiles(take_out(before, stated), after, level=LEVEL)
        counts["changed"] += any(one.machine and one.p_value * change.tests <= LEVEL for one in change.shapes)
        right = find_table_fault(before, after, stated)
        counts["fault"] += bool(right.names)
        counts["not told"] += not right.told
        for name, act in FAULTS.items():
            names = find_table_fault(before, second(act(taken)), stated).names
            hit = any(one.startswith(name) for one in names)
            named[name] += hit
            if not hit:
                wrong.append((run, name, names))
    print(
        f"\n{cycles} cycles, drift {drift_um} um: right tables",
        {name: rate(count, RUNS) for name, count in counts.items()},
    )
    print("named", named, "of", RUNS, wrong[:12])
    assert counts["fault"] <= 0.02 * RUNS
    assert sum(named.values()) >= 0.95 * RUNS * len(FAULTS)


#: Of a second test: the share of the drift and of its time constant, and the share of it that is there at the start.
STATES = {
    "the same": (1.0, 1.0, 0.0),
    "half the duty": (0.5, 0.5, 0.0),
    "after a stop": (1.0, 1.0, 0.3),
    "warm": (1.0, 1.0, 0.7),
}


@pytest.mark.parametrize("active", [False, True], ids=["alone", "added to an active table"])
@pytest.mark.parametrize("one_table", [False, True])
@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize(("cycles", "drift_um"), [(5, 0.3), (5, 1.4), (10, 2.0)])
def test_a_test_with_the_table_is_as_predicted(
    cycles: int, drift_um: float, state: str, one_table: bool, active: bool
) -> None:
    """A window of five cycles of a second test; of a control of one table an axis of constant reversal.

    Stated with the table is a test in the thermal state of the first; `compare` predicts the second one in its own. A camera changes
    nothing: a table is made from the readings of the laser.
    """
    off: dict[str, dict[str, list[float]]] = {kind: {symbol: [] for symbol in "AEMB"} for kind in ("stated", "here")}
    for run in range(RUNS):
        rng = np.random.default_rng(first_seed(5400) + run)
        profile, seed = axis(rng), int(rng.integers(1 << 30))
        if one_table:
            profile = profile.mean(axis=0) + np.array([[0.4], [-0.4]])
        old = an_old_table(rng, profile) if active else None
        shown = profile - old.at(POSITION) if old else profile
        first = measure(np.random.default_rng(seed), shown, cycles=cycles, drift_um=drift_um)
        before = estimate_drift(first).assign(position=first["position"])
        known = read_profile(joined(first, estimate=before.drop_vars("position")))
        table = tabulate(known, active=old)
        stated = predict_test(known, table, *scatter_and_drift(before), cycles=5, one_table=one_table)
        left = shown - table.added_um(POSITION, one_table=one_table)
        again = measure(
            np.random.default_rng(seed), left, cycles=cycles, drift_um=drift_um, state=STATES[state], noise=rng
        )
        start = int(rng.integers(1, cycles - 3))
        window = range(start, start + 5)
        second = evaluate_iso230(again, cycles=window)
        after = estimate_drift(again).assign(position=again["position"])
        here = predict_here(before, after, made(table, stated, one_table=one_table), window)
        for symbol in "AEMB":
            for kind, found in (("stated", stated), ("here", here)):
                off[kind][symbol].append((float(second[symbol]) - found[symbol].value) / found[symbol].u)
    for kind, errors in off.items():
        rms = {symbol: round(float(np.sqrt(np.mean(np.square(one)))), 2) for symbol, one in errors.items()}
        inside = {symbol: float(np.mean(np.abs(one) <= 2.0)) for symbol, one in errors.items()}
        print(
            f"\n{cycles} cycles, {drift_um} um, {state}, {one_table=}, {active=}, {kind}: error/u {rms}, within {inside}"
        )
        # Of 40 axes the rms is known within 11 %: three of these about 1, and a tenth for the course of the drift, which is taken as known.
        # Another state moves slope and bow, and with them A, E and M, which the table alone cannot tell.
        promised = "AEMB" if kind == "here" or state in ("the same", "half the duty") else "B"
        assert all(0.65 < rms[symbol] < 1.45 for symbol in promised)


def test_the_sum_with_the_table_that_was_active_leaves_least() -> None:
    """E of a second test without drift: as tested, with the new table in place of the active one, and with the sum of both."""
    found = []
    for run in range(RUNS):
        rng = np.random.default_rng(first_seed(5500) + run)
        errors = axis(rng)
        active = an_old_table(rng, errors)
        first = measure(rng, errors - active.at(POSITION), cycles=10, drift_um=1.0)
        known = read_profile(joined(first, estimate=estimate_drift(first)))
        table = tabulate(known, active=active)
        added, old_there = table.added_um(POSITION, one_table=False), active.at(POSITION)
        left = [errors - one for one in (old_there, added, old_there + added)]
        np.testing.assert_allclose(
            ErrorTable.added_um(table, POSITION, one_table=False) + old_there,
            np.array([np.interp(POSITION, table.position_mm, one) for one in table.deviation_um]),
            atol=1e-9,
        )
        found.append([float(evaluate_iso230(measure(rng, one, cycles=5, drift_um=0.0))["E"]) for one in left])
    tested, replaced, both = np.median(found, axis=0)
    print(
        f"\nE as tested {tested:.2f} um, new table in place of the active one {replaced:.2f} um, sum of both {both:.2f} um"
    )
    assert both < 0.5 * tested < replaced
