"""Anomalous positions: found, named, and not invented."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from interferometry import anomalies as anomalies_module
from interferometry.anomalies import (
    Anomaly,
    _moving_apart,
    _scatter_direction,
    _Series,
    detect_anomalies,
    generalised_esd,
)
from interferometry.drift.estimate import estimate_drift
from interferometry.errors import InterferometryError
from tests.interferometry.simulated_campaigns import SIGMA_UM, simulate

PERMUTATIONS = 249


def anomalies_of(deviations: xr.Dataset) -> list[Anomaly]:
    return detect_anomalies(estimate_drift(deviations), deviations, permutations=PERMUTATIONS)


def noise(rng: np.random.Generator) -> np.ndarray:
    return rng.normal(0, SIGMA_UM, (100, 2, 16))


def test_a_quiet_test_shows_none(rng: np.random.Generator) -> None:
    assert anomalies_of(simulate(rng)[0]) == []


def test_excess_scatter_is_placed_on_its_position_and_not_on_its_links(rng: np.random.Generator) -> None:
    made = noise(rng)
    made[:, :, 2] += 0.5 * rng.standard_normal((100, 2))
    (one,) = anomalies_of(simulate(rng, noise=made)[0])
    assert (one.target, one.direction, one.kind, one.stands_out) == (3, "both", "scatter", True)
    assert one.p_value < 0.05
    assert one.extra_um == pytest.approx(0.5, abs=0.12)


def test_scatter_of_one_direction_is_given_to_that_direction(rng: np.random.Generator) -> None:
    made = noise(rng)
    made[:, 1, 7] += 0.8 * rng.standard_normal(100)
    one = anomalies_of(simulate(rng, noise=made)[0])[0]
    assert (one.target, one.direction, one.kind) == (8, "negative", "scatter")


def test_two_positions_do_not_hide_each_other(rng: np.random.Generator) -> None:
    made = noise(rng)
    made[:, :, [2, 11]] += 0.7 * rng.standard_normal((100, 2, 2))
    assert {(one.target, one.kind) for one in anomalies_of(simulate(rng, noise=made)[0])} == {
        (3, "scatter"),
        (12, "scatter"),
    }


def test_a_step_is_dated_and_measured(rng: np.random.Generator) -> None:
    made = noise(rng)
    made[60:, :, 5] += 0.6
    one = next(one for one in anomalies_of(simulate(rng, noise=made)[0]) if one.kind == "step")
    assert one.target == 6
    assert one.at_cycle == pytest.approx(61, abs=3)
    assert one.extra_um == pytest.approx(0.6, abs=0.15)


def test_a_slow_local_motion_is_slow_and_not_a_step(rng: np.random.Generator) -> None:
    made = noise(rng)
    wave = np.cumsum(rng.standard_normal(100)) * 0.12
    made[:, :, 9] += wave[:, None] - wave.mean()
    kinds = {(one.target, one.kind) for one in anomalies_of(simulate(rng, noise=made)[0]) if one.kind != "scatter"}
    assert kinds == {(10, "slow")}


def test_a_period_is_measured(rng: np.random.Generator) -> None:
    made = noise(rng)
    cycle = np.arange(100)
    made[:, :, 12] += 0.4 * np.sin(2 * np.pi * cycle / 5.3)[:, None]
    one = next(one for one in anomalies_of(simulate(rng, noise=made)[0]) if one.kind == "periodic")
    assert one.target == 13
    # Frequencies are spaced by one over the test's length: a period of 5.3 cycles is known to 5.3 / 100 of itself.
    assert one.period_s == pytest.approx(5.3 * 252, rel=0.06)
    assert one.extra_um == pytest.approx(0.4, abs=0.12)


def test_lost_cycles_and_a_lost_direction_do_not_disturb(rng: np.random.Generator) -> None:
    made = noise(rng)
    made[:, :, 2] += 0.7 * rng.standard_normal((100, 2))
    deviations, _ = simulate(rng, noise=made)
    deviations["deviation"].values[30:40] = np.nan
    deviations["deviation"].values[:, 1, 9] = np.nan
    assert [(one.target, one.kind) for one in anomalies_of(deviations)] == [(3, "scatter")]


def test_results_are_repeatable(rng: np.random.Generator) -> None:
    made = noise(rng)
    made[:, :, 2] += 0.5 * rng.standard_normal((100, 2))
    deviations, _ = simulate(rng, noise=made)
    assert anomalies_of(deviations) == anomalies_of(deviations)


def test_too_few_permutations_are_refused(rng: np.random.Generator) -> None:
    deviations, _ = simulate(rng, cycles=5)
    with pytest.raises(ValueError, match=r"permutations=50 cannot reach level=0.05; use at least 199"):
        detect_anomalies(estimate_drift(deviations), deviations, permutations=50)


def test_generalised_esd_on_rosners_example() -> None:
    # Rosner (1983), as the NIST/SEMATECH e-Handbook of Statistical Methods, 1.3.5.17.3, prints it: three outliers.
    values = """-0.25 0.68 0.94 1.15 1.20 1.26 1.26 1.34 1.38 1.43 1.49 1.49 1.55 1.56 1.58 1.65 1.69 1.70 1.76 1.77 1.81
    1.91 1.94 1.96 1.99 2.06 2.09 2.10 2.14 2.15 2.23 2.24 2.26 2.35 2.37 2.40 2.47 2.54 2.62 2.64 2.90 2.92 2.92 2.93
    3.21 3.26 3.30 3.59 3.68 4.30 4.64 5.34 5.42 6.01"""
    numbers = np.array([float(word) for word in values.split()])
    marked = generalised_esd(numbers, most=10)
    assert sorted(numbers[marked]) == [5.34, 5.42, 6.01]


def test_generalised_esd_of_one_side_leaves_the_other_alone(rng: np.random.Generator) -> None:
    numbers = np.append(rng.standard_normal(40), [-9.0, 9.0])
    assert numbers[generalised_esd(numbers, most=5)].tolist() == [-9.0, 9.0]
    assert numbers[generalised_esd(numbers, most=5, high_only=True)].tolist() == [9.0]


def test_generalised_esd_without_spread() -> None:
    assert not generalised_esd(np.full(8, 2.0), most=3).any()


@pytest.mark.parametrize("level", [2, 1, 0, -0.05, np.nan])
def test_a_level_that_is_no_probability_is_refused(level: float, rng: np.random.Generator) -> None:
    deviations, _ = simulate(rng, cycles=5)
    with pytest.raises(InterferometryError, match=f"level={level} is no probability between 0 and 1"):
        detect_anomalies(estimate_drift(deviations), deviations, level=level)


def test_noise_with_memory_that_all_positions_have_makes_no_anomaly() -> None:
    flagged = 0
    for seed in range(6):
        rng = np.random.default_rng(880_000 + seed)
        noise = rng.standard_normal((100, 2, 16))
        for k in range(1, 100):
            noise[k] = 0.3 * noise[k - 1] + np.sqrt(0.91) * noise[k]
        deviations, _ = simulate(rng, noise=0.4 * noise)
        flagged += any(anomaly.stands_out for anomaly in detect_anomalies(estimate_drift(deviations), deviations))
    # At 5 % two of six have a probability of 0.03; with cycles permuted as they are, five of six were flagged.
    assert flagged <= 1


def test_a_motion_stands_out_only_where_it_exceeds_those_of_the_other_positions(rng: np.random.Generator) -> None:
    rows = rng.standard_normal(16)
    labels = [_Series(target, direction) for target in range(16) for direction in ("positive", "negative")]
    alone, common = np.repeat(rows, 2), np.repeat(rows + 6.0, 2)
    alone[2 * 4] += 6.0
    assert _moving_apart(labels, alone) == {4}
    assert _moving_apart(labels, common) == set()


def test_a_direction_without_any_scatter_leaves_the_excess_to_the_other() -> None:
    scatter = np.full((2, 8), 0.4)
    scatter[:, 2] = 0.9, 0.0
    estimated = xr.Dataset(
        {
            "scatter": (("direction", "target"), scatter),
            "scatter_freedom": (("direction", "target"), np.full((2, 8), 80.0)),
        },
        coords={"direction": ["positive", "negative"]},
    )
    assert _scatter_direction(estimated, 2, np.array([0, 1, 3, 4, 5, 6, 7])) == "positive"


@pytest.mark.parametrize(("share_above", "flagged"), [(0.03, True), (0.04, False)])
def test_scatter_has_seven_tenths_of_the_error_probability(
    share_above: float, flagged: bool, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    """At a level of 0.05, excess scatter is found up to p = 0.035, and its p-value is given on the scale of the whole family."""
    deviations, permutations = simulate(rng)[0], 999
    largest = np.zeros(permutations)
    largest[: int(share_above * (permutations + 1)) - 1] = 9.0
    excess = np.zeros(16)
    excess[4] = 5.0
    pools: list[int] = []

    def tested(z: np.ndarray, count: int, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        pools.append(z.shape[2])
        return (excess, largest) if len(pools) == 1 else (np.zeros(z.shape[2]), np.full(count, 9.0))

    monkeypatch.setattr(anomalies_module, "_scatter_test", tested)
    found = anomalies_module._scatter_anomalies(estimate_drift(deviations), 0.05, permutations, rng)
    assert [one.target for one in found] == ([5] if flagged else [])
    assert not flagged or found[0].p_value == pytest.approx(share_above / 0.7)


def test_one_wild_reading_counts_as_three_standard_deviations(rng: np.random.Generator) -> None:
    """The excess of a target does not depend on how far beyond three standard deviations one of its readings lies."""
    z = rng.standard_normal((60, 2, 8))
    excess = []
    for wild in (3.0, 30.0):
        z[20, 0, 5] = wild
        excess.append(anomalies_module._scatter_test(z, 1, np.random.default_rng(1))[0])
    np.testing.assert_array_equal(excess[0], excess[1])


def test_the_smallest_p_value_of_a_kind_is_that_of_its_share_of_the_error_probability() -> None:
    """400 orders with the measured one, a tenth of the error probability for slow motion, seven tenths for scatter."""
    assert anomalies_module._least_p_value("slow", 399) == pytest.approx(1 / 400 / 0.1)
    assert anomalies_module._least_p_value("scatter", 399) == pytest.approx(1 / 400 / 0.7)
    assert anomalies_module._least_p_value("periodic", 399) == 0.0


def test_the_power_of_a_wave_is_the_number_of_cycles(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scargle's power in units of the variance, doubled: n for a wave of any amplitude and phase, chi-square (2) for noise."""
    seconds = 252.0 * np.arange(60)
    periodogram = anomalies_module._Periodogram(seconds)
    # From three oscillations to one in three cycles.
    np.testing.assert_allclose(periodogram.frequency * 59 * 252.0, np.arange(3.0, 20.0))
    waves = [
        a * np.cos(2 * np.pi * f * seconds + 0.7)
        for a, f in zip((0.5, 3.0), periodogram.frequency[[0, 9]], strict=True)
    ]
    power = periodogram.power(np.array(waves))
    # The frequencies fit into 59 cycles, and 60 are read.
    np.testing.assert_allclose([power[0, 0], power[1, 9]], 60.0, rtol=0.05)
    assert power[0, 1:].max() < 2.0
    monkeypatch.setattr(anomalies_module, "_WAVES_AT_ONCE", 4)
    np.testing.assert_allclose(periodogram.power(np.array(waves)), power)
    # Seventeen frequencies of two series: chi-square of two degrees of freedom exceeds x with probability exp(-x / 2).
    np.testing.assert_allclose(periodogram.p_values(np.array([20.0, 1.0])), [34 * np.exp(-10.0), 1.0])


def test_slowness_and_steps_of_series_that_are_known() -> None:
    """Ten cycles of -1 and ten of +1: sums of five are 5, so 4 * 25 / 20; alternation leaves the odd one of every five."""
    step = np.repeat([-1.0, 1.0], 10)
    alternating = np.tile([1.0, -1.0], 10)
    np.testing.assert_allclose(anomalies_module._slowness(np.stack([step, alternating])), [5.0, 0.2])
    # The difference of the means is 2, over a standard deviation of 1 times sqrt(20 / 100).
    profile = anomalies_module._step_profile(step)
    assert profile.size == 11 and profile[5] == pytest.approx(-2.0 * np.sqrt(5.0))
    assert anomalies_module._largest_step(step) == pytest.approx(2.0 * np.sqrt(5.0))
    assert anomalies_module._step_index(step) == 10
    # At the first cycle that leaves a block before it: -1 against 5 / 15 of +1.
    assert profile[0] == pytest.approx((-1.0 - 1 / 3) * np.sqrt(5 * 15 / 20))


def test_a_step_is_slow_only_if_its_remainder_is() -> None:
    alternating = 0.1 * np.tile([1.0, -1.0], 20)
    step = np.repeat([0.0, 3.0], 20)
    ramps = np.tile(np.linspace(-1.0, 1.0, 20), 2)
    significant = {"step": {0: (0.01, 0), 1: (0.01, 1)}, "slow": {0: (0.01, 0), 1: (0.01, 1)}, "periodic": {}}
    values = np.stack([step + alternating, step + ramps])
    assert anomalies_module._one_kind_per_target(significant, values) == [("step", 0), ("slow", 1)]
    periods = {"step": {}, "slow": {0: (0.01, 0), 1: (0.03, 1)}, "periodic": {0: (0.02, 0), 1: (0.03, 1), 2: (0.01, 0)}}
    assert anomalies_module._one_kind_per_target(periods, values) == [("slow", 0), ("periodic", 1), ("periodic", 2)]


def test_the_excess_of_a_target_is_the_largest_of_both_directions_and_of_either() -> None:
    """Two targets, two readings from either side: sums over the root of their number."""
    values = np.array([1.0, 1.0, 2.0, 0.0, -1.0, -3.0, 3.0, 1.0])
    target, direction = np.repeat([0, 1], 4), np.tile([0, 0, 1, 1], 2)
    excess = anomalies_module._excess(values, target, direction, np.full((2, 2), 2.0))
    np.testing.assert_allclose(excess, [4.0 / 2.0, 4.0 / np.sqrt(2.0)])


def test_a_permutation_test_ranks_every_series_among_the_largest_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two series, of which the statistic takes the first cycle: by permutation each value leads equally often."""
    values = np.array([[9.0, 1.0, 2.0, 3.0, 0.0], [2.0, 1.0, 3.0, 9.0, 0.0]])
    # Ten permutations at a time, and nine at last: the same as all at once.
    monkeypatch.setattr(anomalies_module, "_PERMUTED_VALUES", 100)
    statistics = {"first": lambda some: some[..., 0], "last": lambda some: some[..., -1]}
    tests = anomalies_module._permutation_tests(values, statistics, 99, np.random.default_rng(3))
    rng = np.random.default_rng(3)
    orders = np.array([rng.permutation(5) for _ in range(99)])
    for place, name in ((0, "first"), (-1, "last")):
        strength, p = tests[name]
        taken = values[:, orders[:, place]]
        scaled = (taken - taken.mean(axis=1, keepdims=True)) / taken.std(axis=1, keepdims=True)
        expected = (values[:, place] - taken.mean(axis=1)) / taken.std(axis=1)
        np.testing.assert_allclose(strength, expected)
        np.testing.assert_allclose(p, [(1 + (scaled.max(axis=0) >= one - 1e-12).sum()) / 100 for one in expected])


def test_one_outlier_is_marked_from_its_percentage_point_on() -> None:
    """Ten values, one side at 0.05: 2.176 standard deviations (Grubbs 1969, Technometrics 11, 1, table 1)."""
    nine = np.linspace(-1.0, 1.0, 9)
    for deviate, marked in ((2.16, False), (2.19, True)):
        # With x beside nine values of mean 0 and sum of squares q, x - mean = 0.9 x and 9 s^2 = q + 0.9 x^2.
        x = np.sqrt((nine**2).sum() * deviate**2 / 9.0 / (0.81 - 0.1 * deviate**2))
        found = generalised_esd(np.append(nine, x), most=1, high_only=True)
        assert found.tolist() == [False] * 9 + [marked]


def test_how_large_a_motion_is() -> None:
    """In units of the scatter of one direction, or of a mean of both; a slow one without what noise leaves in means of blocks."""
    estimated = xr.Dataset(
        {
            "scatter": (("direction", "target"), [[0.5, 1.0], [0.7, 1.0]]),
            "scatter_position": ("target", [0.6, 1.0]),
        },
        coords={"cycle": np.arange(101, 141), "direction": ["positive", "negative"], "target": [4, 9]},
    )
    block = anomalies_module.BLOCK_CYCLES
    series = np.resize(np.repeat([3.0, -3.0], block), 8 * block)
    noise = np.resize([1.0, -1.0], 8 * block)
    step = np.where(np.arange(40) < 13, -1.5, 2.5)
    periodogram = anomalies_module._Periodogram(600.0 * np.arange(40.0))

    def described(kind: str, row: np.ndarray, direction: str) -> Anomaly:
        return anomalies_module._describe_series(estimated, kind, _Series(0, direction), row, (0.01, True), periodogram)

    slow = described("slow", series, "positive")
    assert slow.extra_um == pytest.approx(3.0 * np.sqrt(1.0 - 1.0 / block) * 0.5)
    assert (slow.target, slow.scatter_um, slow.at_cycle, slow.period_s) == (4, 0.5, None, None)
    assert described("slow", series, "both").extra_um == pytest.approx(slow.extra_um / 0.5 * 0.6 / np.sqrt(2.0))
    assert described("slow", noise, "positive").extra_um == 0.0
    shifted = described("step", step, "negative")
    assert (shifted.extra_um, shifted.at_cycle) == (pytest.approx(4.0 * 0.7), 114)


def test_the_direction_of_an_excess_is_told_by_the_scatter_of_the_other_positions() -> None:
    """Positive approaches scatter by 2 um everywhere; negative ones by 0.5 um, and by 2 um at the first position."""
    estimated = xr.Dataset(
        {
            "scatter": (("direction", "target"), [[2.0] * 4, [2.0, 0.5, 0.5, 0.5]]),
            "scatter_freedom": (("direction", "target"), np.full((2, 4), 50.0)),
        },
        coords={"direction": ["positive", "negative"]},
    )
    assert _scatter_direction(estimated, 0, np.arange(1, 4)) == "negative"
    estimated["scatter"][0, 0] = 8.0
    assert _scatter_direction(estimated, 0, np.arange(1, 4)) == "both"


def test_an_approach_whose_readings_are_all_left_out_has_no_course(rng: np.random.Generator) -> None:
    standardised = rng.normal(size=(40, 2, 3))
    standardised[:, 1, 2] = np.inf
    labels, values = anomalies_module._series(
        xr.Dataset(
            {"standardised": (("cycle", "direction", "target"), standardised)},
            coords={"direction": ["positive", "negative"]},
        )
    )
    assert [(label.target, label.direction) for label in labels] == [
        *((target, direction) for target in (0, 1) for direction in ("positive", "negative", "both")),
        (2, "positive"),
    ]
    assert (values.std(axis=1) > 0.5).all()


def test_readings_are_shuffled_within_their_pass(monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    """Three cycles from both sides at two targets, of which one reading is missing: six passes, one of a single reading."""
    seen = []
    monkeypatch.setattr(anomalies_module, "_largest_excess", lambda *given: seen.append(given) or np.zeros(1))
    z = rng.normal(size=(3, 2, 2))
    z[1, 0, 1] = np.nan
    anomalies_module._scatter_test(z, 1, rng)
    assert seen[0][4].tolist() == [0, 2, 4, 5, 7, 9, 11]


def test_the_limit_of_a_second_outlier_is_that_of_the_values_without_the_first() -> None:
    """Nine values beside a first outlier, one side at 0.05: 2.110 standard deviations (Grubbs 1969, Technometrics 11, 1, table 1)."""
    eight = np.linspace(-1.0, 1.0, 8)
    for deviate, outliers in ((2.10, 1), (2.12, 2)):
        # With x beside eight values of mean 0 and sum of squares q, x - mean = 8/9 x and 8 s^2 = q + 8/9 x^2.
        x = np.sqrt((eight**2).sum() * deviate**2 / 8.0 / ((8.0 / 9.0) ** 2 - deviate**2 / 9.0))
        assert generalised_esd(np.append(eight, [x, 1000.0]), most=2, high_only=True).sum() == outliers
