"""What must not change a result: the order in which readings are stored, the end of the axis from which it is counted, unit and epoch."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
import xarray as xr

from interferometry.anomalies import detect_anomalies
from interferometry.common import DIRECTIONS
from interferometry.drift.estimate import estimate_drift
from interferometry.iso230.evaluation import evaluate_iso230
from tests.interferometry.simulated_campaigns import recorded, simulate

pytestmark = pytest.mark.long

#: Of the joint estimate: the search for its variances ends at another last digit of its logarithms (reviewed: 2e-5 at most).
SEARCH = 1e-4


class Change(NamedTuple):
    """Another way to store a test, by which values are multiplied by a factor, and whether approaches change their names."""

    change: Callable[[xr.Dataset], xr.Dataset]
    factor: float = 1.0
    mirrored: bool = False


def scaled(test: xr.Dataset, factor: float) -> xr.Dataset:
    return test.assign(deviation=factor * test["deviation"], resolution=abs(factor) * test["resolution"])


def mirrored(test: xr.Dataset) -> xr.Dataset:
    """Counted from the other end: what was approached in positive direction is approached in negative."""
    turned = scaled(test, -1.0).assign(position=300.0 - test["position"])
    return turned.assign_coords(
        direction=[DIRECTIONS[1 - DIRECTIONS.index(str(one))] for one in test["direction"].values]
    )


CHANGES = {
    "cycles in another order": Change(
        lambda test: test.isel(cycle=np.random.default_rng(1).permutation(test.sizes["cycle"]))
    ),
    "targets in another order": Change(lambda test: test.isel(target=[3, 0, 5, 1, 7, 4, 2, 6])),
    "approaches in another order": Change(lambda test: test.isel(direction=[1, 0])),
    "axis counted from its other end": Change(mirrored, -1.0, mirrored=True),
    "nanometres for micrometres": Change(lambda test: scaled(test, 1000.0), 1000.0),
    "sixty years earlier": Change(lambda test: test.assign(time=test["time"] - np.timedelta64(60 * 365, "D"))),
    "positions from another zero": Change(lambda test: test.assign(position=test["position"] - 5000.0)),
}


#: Every change of a test with gaps, and those that digits or a single approach may feel of another test.
CASES = [
    *(("with gaps", name) for name in CHANGES),
    *(("one approach", name) for name in ("axis counted from its other end", "targets in another order")),
    *(("in whole digits", name) for name in ("axis counted from its other end", "nanometres for micrometres")),
]


@pytest.fixture(scope="module")
def test(request) -> xr.Dataset:
    """Twenty cycles of eight targets, of which one scatters and moves by itself."""
    made, _ = simulate(np.random.default_rng(4), kind="warmup", cycles=20, scale=0.3, sigma=0.25)
    made = made.isel(target=slice(None, None, 2))
    made["deviation"][10:, :, 2] += 1.5
    if request.param == "with gaps":
        gaps = [(5, slice(None), slice(None)), (9, 1, 4), (slice(0, 3), 0, 1), (0, 0, 0)]
        for place in gaps:
            made["deviation"][place], made["time"][place] = np.nan, np.datetime64("NaT", "ns")
    if request.param == "one approach":
        return made.sel(direction=["negative"])
    return recorded(made, 0.5) if request.param == "in whole digits" else made


@pytest.fixture(scope="module")
def change(request) -> Change:
    return CHANGES[request.param]


@pytest.fixture(scope="module")
def estimated(test) -> xr.Dataset:
    return estimate_drift(test)


@pytest.fixture(scope="module")
def again(test, change) -> tuple[xr.Dataset, xr.Dataset]:
    """The test as it is stored in the other way, and its joint estimate."""
    stored = change.change(test)
    return stored, estimate_drift(stored)


in_every_way = pytest.mark.parametrize(("test", "change"), CASES, indirect=True, scope="module")


def as_before(found: xr.Dataset, like: xr.Dataset, change: Change) -> xr.Dataset:
    """A result over the coordinates of the test as it was."""
    if change.mirrored and "direction" in found.coords:
        found = found.assign_coords(
            direction=[DIRECTIONS[1 - DIRECTIONS.index(str(one))] for one in found["direction"].values]
        )
    return found.sel({name: like[name] for name in ("cycle", "direction", "target") if name in found.indexes})


@in_every_way
def test_the_joint_estimate_keeps_profile_drift_and_scatter(test, estimated, change, again):
    plain, found = estimated, as_before(again[1], test, change)
    size_um = float(plain["drift"].max() - plain["drift"].min())
    # A reversal is positive minus negative: of the mirrored axis the mirrored difference of the exchanged approaches.
    for name, factor in {"profile": change.factor, "drift": change.factor, "reversal": abs(change.factor)}.items():
        missed = np.abs(found[name] - factor * plain[name])
        # Shift and stretch wander independently of each other about the first position: about the last one that is another model, whose
        # values differ by less than they are known (k = 2).
        limit = 2.0 * plain[f"{name}_u"] if change.mirrored else SEARCH * abs(factor) * size_um
        assert bool(((missed <= limit) | plain[name].isnull()).all()), name
    for name in ("profile_u", "drift_u", "scatter", "sigma"):
        expected = abs(change.factor) * plain[name]
        near = 0.25 if change.mirrored else 100 * SEARCH
        np.testing.assert_allclose(
            found[name], expected, rtol=near, atol=100 * SEARCH * float(expected.max()), err_msg=name
        )


def steps(one: xr.Dataset, drift: xr.Dataset, moved: int) -> list[tuple[int, str, int | None]]:
    """Steps of the position that moved, with the cycle."""
    found = detect_anomalies(one, drift)
    return [
        (each.target, each.direction, each.at_cycle) for each in found if (each.kind, each.target) == ("step", moved)
    ]


@pytest.fixture(scope="module")
def step(test, estimated) -> tuple[int, str, int | None]:
    (one,) = steps(test, estimated, int(test["target"][2]))
    return one


@in_every_way
def test_a_position_that_stands_out_is_the_same(step, change, again):
    target, direction, at_cycle = step
    assert at_cycle == pytest.approx(11, abs=2)
    other = {"positive": "negative", "negative": "positive"} if change.mirrored else {}
    assert steps(*again, target) == [(target, other.get(direction, direction), at_cycle)]


@in_every_way
def test_quantities_by_iso_230_2_are_the_same(test, change):
    plain, found = evaluate_iso230(test), evaluate_iso230(change.change(test))
    # Exact: sums in another order.
    for name in ("B", "E", "M", "A", "R", "mean_reversal"):
        if name in plain:
            np.testing.assert_allclose(
                np.abs(found[name]), abs(change.factor) * np.abs(plain[name]), rtol=1e-9, atol=1e-9, err_msg=name
            )
