"""Checks of clocks and of the camera's rise: how often they doubt sound campaigns, and what they notice; quoted in docs/measured.csv."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.alignment.align import AxisGeometry
from fusion.analysis.consistency.checks import Inputs
from fusion.analysis.consistency.series import Motion, field_at, log_with_camera, thin_fields
from fusion.pipeline.consistency import Check, run_checks
from fusion.twin import simulate
from fusion.twin.instruments import deviations_of, fields_of
from fusion.twin.recipe import EffectRecipe, Recipe
from fusion.twin.simulate import PROBE_MM, driver_log, environment_log
from tests.fusion.analysis.consistency.twin_fields import FILES, Recorded, clocks, scaled, with_late, without_ends
from tests.soak.lies.logs import in_blocks, of_another_test, starts
from tests.soak.rates import campaigns, first_seed, rate, wilson
from tests.soak.test_sound_inputs import sound_recipe
from thermography.fields.survey import stray_frames

pytestmark = pytest.mark.slow


def varied_recipe(seed: int) -> Recipe:
    """A sound campaign of 14 to 60 cycles, with errors of the camera among the undeclared effects and loads of several paces."""
    rng = np.random.default_rng([seed, 77])
    recipe = sound_recipe(seed)
    if rng.random() < 0.25:
        errs = EffectRecipe("camera_offset", amplitude_K=float(rng.uniform(0.2, 1.0)))
        reflects = EffectRecipe("reflected_source", amplitude_K=float(rng.uniform(3.0, 12.0)))
        recipe = recipe.vary(effect=(errs if rng.random() < 0.5 else reflects,))
    if rng.random() < 0.3:
        recipe = recipe.vary(test={"cycles": int(rng.integers(16, 26))})
    if rng.random() < 0.3:
        recipe = recipe.vary(duty={"mean_hold_min": float(rng.choice([8.0, 12.0, 60.0]))})
    return recipe


def record(recipe: Recipe) -> Recorded:
    """Simulate a campaign and what an ideal reduction of its frames would give."""
    truth = simulate(recipe)
    axis = AxisGeometry(tuple(recipe.plan.origin_mm), tuple(recipe.plan.direction))
    return Recorded(axis, deviations_of(truth), fields_of(truth), environment_log(truth), driver_log(truth))


def of_logs(test: Recorded, *, stated: bool) -> list[Check]:
    """The checks of the logs and of the camera's rise."""
    field = thin_fields(test.fields)
    near = field_at(test.fields, PROBE_MM) if stated else field
    logged = log_with_camera(near, test.environment)
    inputs = Inputs(field=field, drivers=test.drivers, logged=logged, place_stated=stated)
    return [check for check in run_checks("fields", inputs) if check.code != "drivers_course"]


def of_stamps(stamps: np.ndarray, deviations: xr.Dataset) -> list[Check]:
    """The checks of the stamps of the frames against the motion of the axis."""
    return run_checks("source", Inputs(motion=Motion.of(stamps, deviations)))


def test_sound_campaigns_are_not_doubted(capsys: pytest.CaptureFixture[str]) -> None:
    runs, doubted, named = campaigns(200), 0, list[str]()
    for seed in range(first_seed(57000), first_seed(57000) + runs):
        test = record(varied_recipe(seed))
        failed = [
            check
            for check in (
                *of_logs(test, stated=True),
                *of_logs(test, stated=False),
                *of_stamps(test.fields["time"].values, test.deviations),
                *clocks(test).values(),
                *clocks(without_ends(test)).values(),
            )
            if not check.passed
        ]
        doubted += bool(failed)
        named += [f"{seed} {check.code} {check.value:.3g}" for check in failed]
    with capsys.disabled():
        print(f"\nsound campaigns doubted by clocks or temperature: {rate(doubted, runs)}; {named}")
    assert wilson(doubted, runs)[0] <= 0.01


@pytest.mark.parametrize("loads", ["varying", "constant"])
@pytest.mark.parametrize("together", [True, False])
def test_the_odd_clock(together: bool, loads: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Each of four recordings late and early; recordings that begin and end together, and recordings that do not."""
    runs, told = campaigns(40), Counter[tuple[float, str]]()
    for seed in range(first_seed(53000), first_seed(53000) + runs):
        duty = {"mean_hold_min": 25.0} if loads == "varying" else {"kind": "constant"}
        test = record(Recipe().vary(campaign={"seed": seed}, duty=duty))
        test = test if together else without_ends(test)
        for name, minutes in product(FILES, (-120.0, -60.0, -15.0, 15.0, 60.0, 120.0)):
            doubts = [check for check in clocks(with_late(test, name, minutes)).values() if not check.passed]
            named = doubts[0].code.removesuffix("_clock") if doubts else "silent"
            right = "named" if named == name and doubts[0].value == minutes else "its file, another shift"
            told[abs(minutes), right if named == name else named if named in ("silent", "clocks") else "wrong"] += 1
    with capsys.disabled():
        for minutes in (15.0, 60.0, 120.0):
            every = {word: count for (size, word), count in told.items() if size == minutes}
            print(f"\nloads {loads}, begun together {together}, {minutes:.0f} min: {every}")
    assert not any(word == "wrong" for _, word in told)


@pytest.mark.parametrize("gain_s_per_h", [3.0, 6.0, 10.0, 60.0, 600.0])
def test_clock_rates(gain_s_per_h: float, capsys: pytest.CaptureFixture[str]) -> None:
    runs, noticed = campaigns(40), 0
    for seed in range(first_seed(55000), first_seed(55000) + runs):
        test = record(Recipe().vary(campaign={"seed": seed}))
        true = test.fields["time"].values
        gained = (true - true[0]) * (gain_s_per_h / 3600.0)
        noticed += not of_stamps(true + gained, test.deviations)[0].passed
    with capsys.disabled():
        print(f"\ncamera clock gains {gain_s_per_h:g} s/h over 4.2 h: noticed {rate(noticed, runs)}")


@pytest.mark.parametrize("emissivity", [0.50, 0.80, 0.85, 0.88, 0.90, 0.92, 0.94, 1.0])
def test_wrong_emissivities(emissivity: float, capsys: pytest.CaptureFixture[str]) -> None:
    """The table is painted, 0.97; near the temperature of the room the rise goes with the reciprocal of the emissivity."""
    runs, noticed = campaigns(40), Counter[bool]()
    for seed in range(first_seed(54000), first_seed(54000) + runs):
        test = record(Recipe().vary(campaign={"seed": seed}, duty={"mean_hold_min": 25.0}))
        wrong = replace(test, fields=scaled(test.fields, 0.97 / emissivity))
        for stated in (True, False):
            noticed[stated] += not next(c for c in of_logs(wrong, stated=stated) if c.code == "material_rise").passed
    with capsys.disabled():
        print(
            f"\nemissivity {emissivity:.2f} for 0.97: noticed with the sensor's place {rate(noticed[True], runs)}, without "
            f"{rate(noticed[False], runs)}"
        )


@pytest.mark.parametrize("duty", ["random", "switched", "constant"])
def test_windows_that_get_dirty(duty: str, capsys: pytest.CaptureFixture[str]) -> None:
    """A transmission that falls steadily through the test, to 1 (a clean window), 0.9 and 0.85; the window is at 24 degC."""
    runs, told = campaigns(60), Counter[tuple[float, str]]()
    for seed in range(first_seed(67000), first_seed(67000) + runs):
        test = record(sound_recipe(seed).vary(duty={"kind": duty, "mean_hold_min": 25.0}, effect=(), anomaly=()))
        passed = xr.DataArray(np.linspace(0.0, 1.0, test.fields.sizes["time"]), dims="time")
        for left in (1.0, 0.9, 0.85):
            seen = 24.0 + (1.0 - (1.0 - left) * passed) * (test.fields["frame_temperature"] - 24.0)
            checks = of_logs(replace(test, fields=test.fields.assign(frame_temperature=seen)), stated=True)
            gain = next(check for check in checks if check.code == "material_gain")
            told[
                left, "noticed" if not gain.passed else "not told" if "does not show" in gain.evidence else "told"
            ] += 1
    with capsys.disabled():
        print(f"\nload {duty}: {dict(told)}")
    assert told[1.0, "noticed"] <= 0.02 * runs


def _of(log: xr.Dataset, **columns: np.ndarray) -> xr.Dataset:
    """A log with other values in some columns."""
    return log.assign({name: log[name].copy(data=values) for name, values in columns.items()})


LYING_LOADS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "as it is": lambda duty: duty,
    "inverted": lambda duty: 1.0 - duty,
    "starts": starts,
    "blocks": in_blocks,
    "clipped": lambda duty: np.minimum(duty, 0.2),
    "switch": lambda duty: (duty > 0.5).astype(float),
    "backwards": lambda duty: duty[::-1],
    "counter": np.cumsum,
    "another test": of_another_test,
    "stands still": lambda duty: np.full(duty.size, duty[0]),
}


def test_lying_loads(capsys: pytest.CaptureFixture[str]) -> None:
    """What a load explains of the field's rate once it lies, and whether that is noticed, in tests of several lengths and paces."""
    runs, told = campaigns(40), {name: Counter[str]() for name in LYING_LOADS}
    for seed in range(first_seed(59000), first_seed(59000) + runs):
        rng = np.random.default_rng([seed, 3])
        duty = {"mean_hold_min": float(rng.choice([8.0, 15.0, 25.0, 40.0]))}
        test = record(Recipe().vary(campaign={"seed": seed}, test={"cycles": int(rng.integers(30, 61))}, duty=duty))
        field, logged = thin_fields(test.fields), test.drivers["duty"].values
        for name, change in LYING_LOADS.items():
            log = _of(test.drivers, duty=np.asarray(change(logged), float))
            inputs = Inputs(field=field, drivers=log)
            course = next(check for check in run_checks("fields", inputs) if check.code == "drivers_course")
            kind = next(iter(run_checks("source", inputs)), course)
            little = "explains little" if course.value > course.limit else "explains most"
            little = little if np.ptp(log["duty"].values) > 0.0 else "constant"
            told[name][f"{little}, {'silent' if course.passed and kind.passed else 'noticed'}"] += 1
    with capsys.disabled():
        for name, counts in told.items():
            print(f"\nload {name}: {dict(counts)}")
    assert told["as it is"] == {"explains most, silent": runs} == told["inverted"]
    # What is left of a load in marks, blocks and beyond a limit is noticed where it explains little; few changes do not show it.
    for name in ("starts", "blocks", "clipped"):
        assert told[name]["explains little, silent"] <= 0.2 * runs


def test_frames_of_another_campaign(capsys: pytest.CaptureFixture[str]) -> None:
    """Levels of coarse cells stand for those of blocks of pixels; every campaign sound, then with one frame of another one."""
    runs, rng = campaigns(100), np.random.default_rng(58)
    levels = []
    for seed in range(first_seed(92000), first_seed(92000) + runs):
        cells = (
            record(varied_recipe(seed)).fields["frame_temperature"].coarsen(x=4, y=4, boundary="trim").reduce(np.mean)
        )
        levels.append(cells.values.reshape(cells.sizes["time"], -1).astype(float))
    doubted = sum(bool(stray_frames(one, ends=False)) for one in levels)
    told: dict[str, list[bool]] = {"0.2 to 0.5 K": [], "0.5 to 1 K": [], "above 1 K": []}
    for _ in range(20 * runs):
        first, second = rng.choice(runs, 2, replace=False)
        place, other = rng.integers(1, len(levels[first]) - 1), rng.integers(len(levels[second]))
        mixed = levels[first].copy()
        mixed[place] = levels[second][other]
        off_K = float(np.sqrt(np.mean((mixed[place] - levels[first][place]) ** 2)))
        if off_K >= 0.2:
            size = "0.2 to 0.5 K" if off_K < 0.5 else "0.5 to 1 K" if off_K < 1.0 else "above 1 K"
            told[size].append(int(place) in stray_frames(mixed, ends=False))
    with capsys.disabled():
        print(f"\nsound campaigns with a frame left out: {rate(doubted, runs)}")
        for size, found in told.items():
            print(f"one frame of another campaign, {size}: left out {rate(sum(found), len(found))}")
    assert wilson(doubted, runs)[0] <= 0.01
