"""Consistency checks of the readings: each lie is named, sound readings pass."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.consistency.checks import Inputs
from fusion.analysis.consistency.deviations import (
    _equal_shares,
    find_gross_readings,
    random_part_um,
)
from fusion.pipeline.consistency import Check, _with_readings, run_checks
from interferometry.deviations import build_deviations

CYCLES, TARGETS = 40, 12
PLAN_MM = 700.0


def sound(seed: int = 5, *, noise_um: float = 0.4, reversal_um: float = 1.2) -> xr.Dataset:
    """A test of 12 targets over 330 mm with a drift of 5 um and a reversal error."""
    rng = np.random.default_rng(seed)
    position = 30.0 * np.arange(TARGETS)
    profile = np.cumsum(rng.normal(0.0, 0.8, TARGETS))
    drift = 5.0 * (1.0 - np.exp(-np.arange(CYCLES) / 15.0))
    sign = np.array([0.5, -0.5])
    deviation = (
        profile
        + drift[:, None, None] * (0.3 + position / 330.0)
        + reversal_um * sign[:, None]
        + noise_um * rng.standard_normal((CYCLES, 2, TARGETS))
    )
    order = np.concatenate([np.arange(TARGETS), TARGETS + np.arange(TARGETS)[::-1]]).reshape(2, TARGETS)
    time = np.datetime64("2026-03-09T06:30") + (250 * np.arange(CYCLES)[:, None, None] + 8 * order).astype("m8[s]")
    return build_deviations(range(1, CYCLES + 1), range(1, TARGETS + 1), position, deviation, time)


def failed(deviations: xr.Dataset) -> dict[str, Check]:
    return {
        check.code: check
        for check in run_checks("source", Inputs(linear=deviations, plan_extent_mm=PLAN_MM))
        if not check.passed
    }


def with_deviation(test: xr.Dataset, values: np.ndarray) -> xr.Dataset:
    return test.assign(deviation=test["deviation"].copy(data=values))


def test_the_random_part_is_that_of_the_noise() -> None:
    # 38 x 24 second differences, two of three independent: 3 % standard error; four of them allowed.
    assert random_part_um(sound()["deviation"].values) == pytest.approx(0.4, rel=0.12)
    assert np.isnan(random_part_um(np.zeros((2, 2, 3))))


def test_a_unit_that_changes_in_the_test_is_named_with_its_cycle_and_compensation_or_averaging_is_none() -> None:
    test = sound()
    values, late = test["deviation"].values, np.arange(CYCLES)[:, None, None] >= 24
    named = failed(with_deviation(test, np.where(late, 0.1 * values, values)))
    assert "From cycle 25 on scatter and profile are both some 0.1" in named["deviation_unit"].evidence
    mean = values.mean(axis=0)
    compensated, averaged = np.where(late, values - mean, values), np.where(late, mean + 0.1 * (values - mean), values)
    assert not any("deviation_unit" in failed(with_deviation(test, other)) for other in (compensated, averaged))


@pytest.mark.parametrize(
    ("travel_mm", "targets", "cycles", "slope_um", "reversal_um", "noise_um", "rounding_um"),
    [
        pytest.param(8.0, 5, 5, 60.0, 100.0, 150.0, 0.4, id="stage of 8 mm"),
        pytest.param(300.0, 16, 5, 2500.0, 120.0, 20.0, 10.0, id="printer whose scale was never set"),
        pytest.param(300.0, 11, 30, 5.0, 1.0, 0.3, 10.0, id="dial indicator of 10 um"),
        pytest.param(0.1, 11, 5, 0.02, 0.001, 5e-4, 1e-4, id="piezo stage"),
        pytest.param(25.0, 11, 10, 0.02, 5e-4, 5e-4, 1e-4, id="nanomeasuring machine"),
        pytest.param(10_000.0, 41, 5, 200.0, 30.0, 15.0, 0.1, id="gantry"),
        pytest.param(0.0, 1, 200, 0.0, 1.0, 0.3, 0.01, id="one target for a day"),
    ],
)
def test_sound_tests_of_other_machines_pass(
    travel_mm: float,
    targets: int,
    cycles: int,
    slope_um: float,
    reversal_um: float,
    noise_um: float,
    rounding_um: float,
) -> None:
    for seed in range(2):
        rng, share = np.random.default_rng([seed, 3]), np.linspace(0.0, 1.0, targets)
        drift = 2.0 * noise_um * (1.0 - np.exp(-3.0 * np.arange(cycles) / cycles))
        values = slope_um * (1.5 - 0.5 * share) * share + drift[:, None, None] * (0.5 + 0.5 * share)
        values = values + reversal_um * np.array([0.5, -0.5])[:, None]
        values = values + noise_um * rng.standard_normal((cycles, 2, targets))
        values = np.round(values / rounding_um) * rounding_um
        time = np.full(values.shape, np.datetime64("NaT", "ns"))
        test = build_deviations(range(1, cycles + 1), range(1, targets + 1), travel_mm * share, values, time)
        assert run_checks("source", Inputs(deviations=test)) and not failed_signs(test)
        assert [check for check in run_checks("source", Inputs(linear=test)) if not check.passed] == []


@pytest.mark.parametrize("late", [1, -1])
def test_a_missed_trigger_is_named_with_its_first_cycle(late: int) -> None:
    """In the order of travel, so that the approaches shift against each other; the reading that falls out of a pass is the next one's."""
    test = sound(noise_um=0.2)
    passes = test["deviation"].values.copy()
    passes[:, 1] = passes[:, 1, ::-1]
    passes[18:] = np.roll(passes.ravel(), late).reshape(passes.shape)[18:]
    passes[:, 1] = passes[:, 1, ::-1]
    check = failed(with_deviation(test, passes))["missed_trigger"]
    assert f"From cycle 19 on every target reads what the one {'before' if late > 0 else 'after'} it" in check.evidence


def test_a_trigger_missed_on_a_straight_axis_is_named_by_the_ends_of_its_passes() -> None:
    """A shift of a straight line is one of its level, but for the first reading of a pass, which is the last one of the other approach."""
    noise = np.random.default_rng(6).normal(0.0, 0.2, (40, 2, TARGETS))
    passes = noise + np.array([3.0, -3.0])[:, None] + 0.5 * np.stack([np.arange(TARGETS), np.arange(TARGETS)[::-1]])
    passes[18:] = np.roll(passes.ravel(), 1).reshape(passes.shape)[18:]
    passes[:, 1] = passes[:, 1, ::-1]
    check = failed(with_deviation(sound(), passes))["missed_trigger"]
    assert "From cycle 19 on" in check.evidence or "In cycles 4 to 18, against all others" in check.evidence


@pytest.mark.parametrize(
    ("cycles", "approaches", "words"),
    [
        (slice(18, None), [1], ("From cycle 19 on", "in negative approach")),
        (slice(18, None), [0], ("From cycle 19 on", "in positive approach")),
        (slice(12, 24), [0, 1], ("In cycles 13 to 24, against all others", "otherwise:")),
    ],
)
def test_a_trigger_missed_in_one_approach_or_for_some_cycles_is_named_with_where(
    cycles: slice, approaches: list[int], words: tuple[str, str]
) -> None:
    test = sound(noise_um=0.2)
    values = test["deviation"].values.copy()
    for approach in approaches:
        here = values[cycles, approach]
        here[:, 1:] = here[:, :-1].copy() if approach == 0 else here[:, 1:]
        here[:, :-1] = here[:, 1:].copy() if approach == 1 else here[:, :-1]
    evidence = failed(with_deviation(test, values))["missed_trigger"].evidence
    assert all(text in evidence for text in words)


def test_readings_that_hold_the_target_before_are_named_with_their_number() -> None:
    test = sound()
    values = np.round(test["deviation"].values, 3)
    held = np.random.default_rng(4).random(values.shape) < 0.15
    held[:, :, 0] = False
    changed = np.where(held, np.roll(values, 1, axis=2), values)
    check = failed(with_deviation(test, changed))["repeated_value"]
    assert check.value == np.count_nonzero(np.diff(changed, axis=2) == 0.0)
    assert "hold what the target before or after them read" in check.evidence


def test_readings_that_hold_a_part_of_the_one_before_are_told_from_noise_with_a_memory() -> None:
    test, rng = sound(), np.random.default_rng(9)
    values, noise = test["deviation"].values, rng.standard_normal((CYCLES, 2, TARGETS))
    for target in range(1, TARGETS):
        noise[:, :, target] = 0.6 * noise[:, :, target - 1] + 0.8 * noise[:, :, target]
    swinging = 2.0 * np.sin(2.0 * np.pi * (np.arange(TARGETS) / 4.4 + rng.random((CYCLES, 2, 1))))
    for added in (noise, swinging):
        assert "mixed_readings" not in failed(with_deviation(test, values + added))
    mixed = values.copy()
    mixed[:, :, 1:] = 0.6 * values[:, :, 1:] + 0.4 * values[:, :, :-1]
    assert "two targets on" in failed(with_deviation(test, mixed))["mixed_readings"].evidence


def test_coincidences_are_no_chance_in_sound_tests_of_all_lengths_and_resolutions() -> None:
    """Two cycles and more, fine and coarse, with a profile that changes at one cycle, a target at zero, and compensated afterwards."""
    for seed, (cycles, step_um) in enumerate([(2, 0.1), (3, 1.0), (5, 0.001), (12, 0.5), (40, 0.3), (40, 10.0)]):
        test = sound(seed, noise_um=0.3).isel(cycle=slice(0, cycles))
        bent = np.random.default_rng(seed).normal(0.0, 0.5, TARGETS) * (np.arange(cycles) >= cycles // 2)[:, None, None]
        values = np.round((test["deviation"].values + bent) / step_um) * step_um
        values[:, :, 0] = 0.0
        compensated = values + np.linspace(0.0, 0.37, cycles)[:, None, None] * np.linspace(0.0, 1.0, TARGETS)
        for one in (values, compensated):
            assert {"copied_targets", "repeated_value", "missed_trigger"}.isdisjoint(failed(with_deviation(test, one)))


def test_coarse_rounding_is_no_copy() -> None:
    test = sound(noise_um=0.1)
    assert "copied_cycles" not in failed(with_deviation(test, np.round(test["deviation"].values)))


def test_a_reversal_that_drifts_or_steps_to_another_size_is_no_exchange() -> None:
    test = sound()
    sign = np.array([0.5, -0.5])[None, :, None]
    ramp = np.linspace(0.0, -2.4, CYCLES)[:, None, None] * sign
    step = np.where(np.arange(CYCLES) >= 20, -3.0, 0.0)[:, None, None] * sign
    for change in (ramp, step):
        assert "approach_labels" not in failed(with_deviation(test, test["deviation"].values + change))


def test_one_approach_alone_and_missing_readings_pass() -> None:
    test = sound()
    values = test["deviation"].values.copy()
    values[:, 1] = np.nan
    values[3, 0, 4] = np.nan
    assert failed(with_deviation(test, values)) == {} == failed(test.isel(direction=[0]))


def test_only_what_lies_far_beyond_the_scatter_of_its_own_position_is_an_error_of_reading() -> None:
    rng = np.random.default_rng(2)
    values = rng.standard_normal((200, 2, 3))
    values[:, :, 2] *= 4.0
    values[5, 0, 0], values[6, 1, 2], values[7, 1, 1], values[8, 0, 1] = 11.5, 30.0, np.inf, np.nan
    found = find_gross_readings(xr.DataArray(values, dims=("cycle", "direction", "target")))
    # 30 standard deviations of an ordinary reading are 7.5 of that position.
    assert np.argwhere(found.values).tolist() == [[5, 0, 0], [7, 1, 1]]


def test_cycles_that_have_no_site_in_common_tell_no_jump() -> None:
    """Two cycles of one half of the targets, two of the other; then one cycle with all, and nothing has jumped either."""
    deviations = sound()
    half = (np.arange(CYCLES) // 2 % 2)[:, None] == (np.arange(TARGETS) < TARGETS // 2)
    for whole in ([], [20]):
        half[whole] = True
        values = np.where(half[:, None, :], deviations["deviation"].values, np.nan)
        assert "datum" not in failed(with_deviation(deviations, values))


def test_a_jump_of_some_targets_or_a_small_slip_is_no_new_datum() -> None:
    some, small = sound(), sound()
    some["deviation"][20:, :, 6:] += 20.0
    small["deviation"][20:] += 3.0
    assert not failed(some) and not failed(small)


@pytest.mark.parametrize(("part_um", "first"), [(20.0, 22), (60.0, 21)])
def test_a_cycle_within_which_the_datum_changes_belongs_to_the_nearer_level(part_um: float, first: int) -> None:
    test = sound()
    test["deviation"][20] += part_um
    test["deviation"][21:] += 80.0
    assert f"From cycle {first} on all targets read +80." in failed(test)["datum"].evidence


def test_of_many_copies_five_are_named() -> None:
    values = sound()["deviation"].values.copy()
    values[20:24] = values[19]
    assert "20 and 24, 21 and 22 and 5 more agree" in failed(with_deviation(sound(), values))["copied_cycles"].evidence


def test_targets_that_are_always_at_the_limit_are_clipped_and_not_zeroed() -> None:
    deviations = sound()
    far = deviations["deviation"].where(~deviations["target"].isin([5, 6]), deviations["deviation"] + 50.0)
    limit = 25.0
    named = failed(deviations.assign(deviation=np.minimum(far, limit)))
    assert f"{limit:g} µm, the largest" in named["repeated_value"].evidence
    assert "zeroed_cycles" not in named


def test_a_laser_that_is_zeroed_in_every_cycle_is_named() -> None:
    deviations = sound()
    zeroed = deviations["deviation"] - deviations["deviation"].isel(direction=0, target=0, drop=True)
    check = failed(deviations.assign(deviation=zeroed))["zeroed_cycles"]
    assert "Target 1 in positive approach" in check.evidence
    # Coarse digits make every reading repeat; that says nothing of the zero.
    coarse = deviations["deviation"].copy(data=10.0 * np.round(deviations["deviation"].values / 10.0))
    assert "zeroed_cycles" not in failed(deviations.assign(deviation=coarse))


def test_shares_of_equal_readings_are_those_of_every_pair_of_cycles(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = np.round(rng.normal(size=(30, 6)), 1)
    values[rng.random(values.shape) < 0.2] = np.nan
    values[4] = np.nan
    monkeypatch.setattr("fusion.analysis.consistency.deviations._CYCLES_AT_ONCE", 7)
    told = np.vstack([shares for _, shares in _equal_shares(values)])
    both = (np.isfinite(values)[:, None] & np.isfinite(values)).sum(axis=2)
    expected = (values[:, None] == values).sum(axis=2) / np.maximum(both, 1)
    np.testing.assert_allclose(told, expected, rtol=1e-12)
    assert [start for start, _ in _equal_shares(values)] == [0, 7, 14, 21, 28]


def test_without_any_reading_there_is_nothing_to_check() -> None:
    values = np.full((4, 2, 4), np.nan)
    ((start, shares),) = _equal_shares(values.reshape(4, -1))
    assert start == 0 and not shares.any() and shares.shape == (4, 4)
    assert np.isnan(random_part_um(values))
    nothing = with_deviation(sound(), np.full((CYCLES, 2, TARGETS), np.nan))
    source = SimpleNamespace(deviations=nothing, campaign=SimpleNamespace(plan=None), sensors=None)
    assert _with_readings(Inputs(), source).linear is None


# Order and sign of the readings: exchanged labels and inverted signs are named, sound readings and step cycles pass.


def failed_signs(deviations: xr.Dataset) -> dict[str, Check]:
    return {check.code: check for check in run_checks("source", Inputs(deviations=deviations)) if not check.passed}


def sloped(seed: int = 5) -> xr.Dataset:
    """Sound readings of an axis with a pitch error, which gives them a shape that has a sign."""
    test = sound(seed)
    return with_deviation(test, test["deviation"].values + 0.8 * np.arange(TARGETS))


def inverted(place: tuple) -> xr.Dataset:
    test = sloped()
    values = test["deviation"].values.copy()
    values[place] *= -1.0
    return with_deviation(test, values)


@pytest.mark.parametrize(
    ("place", "words"),
    [
        (np.s_[20:], "from cycle 21 on"),
        (np.s_[:, 1], "approach in negative direction against approach in positive direction"),
        (np.s_[:, :, 9], "target 10"),
    ],
)
def test_inverted_signs_are_named_with_their_place(place: tuple, words: str) -> None:
    found = failed_signs(inverted(place))
    assert list(found) == ["mirrored_readings"]
    assert words in found["mirrored_readings"].evidence


def test_a_step_cycle_and_readings_without_times_are_no_contradiction() -> None:
    test = sloped()
    up = test["time"].isel(direction=[0, 0]).values + np.array([0, 4], "m8[s]")[:, None]
    assert failed_signs(test.assign(time=test["time"].copy(data=up))) == {}
    nothing = np.full(test["time"].shape, np.datetime64("NaT", "ns"))
    assert failed_signs(test.assign(time=test["time"].copy(data=nothing))) == {}


def test_cycles_that_lack_readings_take_no_part() -> None:
    test = inverted(np.s_[20:])
    values = test["deviation"].values.copy()
    values[5, 0, 3] = np.nan
    assert "from cycle 21 on" in failed_signs(with_deviation(test, values))["mirrored_readings"].evidence
    values[:, 0, 3] = np.nan
    assert failed_signs(with_deviation(test, values)) == {}
