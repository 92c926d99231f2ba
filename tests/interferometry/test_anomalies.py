"""Anomalous positions: found, named, and not invented."""

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
from interferometry.common import InterferometryError
from interferometry.deviations import build_deviations
from interferometry.drift.estimate import estimate_drift
from interferometry.drift.gls import Autoregression
from tests.interferometry.simulated_campaigns import SIGMA_UM, recorded, simulate

pytestmark = pytest.mark.long

PERMUTATIONS = 199


def anomalies_of(deviations: xr.Dataset) -> list[Anomaly]:
    return detect_anomalies(deviations, estimate_drift(deviations), permutations=PERMUTATIONS)


def noise(rng: np.random.Generator) -> np.ndarray:
    return rng.normal(0, SIGMA_UM, (100, 2, 16))


def test_a_quiet_test_shows_none(rng):
    assert anomalies_of(simulate(rng)[0]) == []


def test_excess_scatter_is_placed_on_its_position_and_not_on_its_links(rng):
    made = noise(rng)
    made[:, :, 2] += 0.5 * rng.standard_normal((100, 2))
    deviations, _ = simulate(rng, noise=made)
    drift = estimate_drift(deviations)
    (one,), again = (detect_anomalies(deviations, drift, permutations=PERMUTATIONS) for _ in range(2))
    assert [one] == again
    assert (one.target, one.direction, one.kind, one.stands_out) == (3, "both", "scatter", True)
    assert one.p_value < 0.05
    assert one.extra_um == pytest.approx(0.5, abs=0.12)


def test_scatter_of_one_direction_is_given_to_that_direction(rng):
    made = noise(rng)
    made[:, 1, 7] += 0.8 * rng.standard_normal(100)
    one = anomalies_of(simulate(rng, noise=made)[0])[0]
    assert (one.target, one.direction, one.kind) == (8, "negative", "scatter")


def test_two_positions_do_not_hide_each_other(rng):
    made = noise(rng)
    made[:, :, [2, 11]] += 0.7 * rng.standard_normal((100, 2, 2))
    found = anomalies_of(simulate(rng, noise=made)[0])
    assert sorted((one.target, one.kind) for one in found) == [(3, "scatter"), (12, "scatter")]


def test_a_step_is_dated_and_measured(rng):
    made = noise(rng)
    made[60:, :, 5] += 0.6
    one = next(one for one in anomalies_of(simulate(rng, noise=made)[0]) if one.kind == "step")
    assert one.target == 6
    assert one.at_cycle == pytest.approx(61, abs=3)
    assert one.extra_um == pytest.approx(0.6, abs=0.15)


def test_a_slow_local_motion_is_slow_and_not_a_step(rng):
    made = noise(rng)
    wave = np.cumsum(rng.standard_normal(100)) * 0.12
    made[:, :, 9] += wave[:, None] - wave.mean()
    kinds = {(one.target, one.kind) for one in anomalies_of(simulate(rng, noise=made)[0]) if one.kind != "scatter"}
    assert kinds == {(10, "slow")}


def test_a_period_is_measured(rng):
    made = noise(rng)
    cycle = np.arange(100)
    made[:, :, 12] += 0.4 * np.sin(2 * np.pi * cycle / 5.3)[:, None]
    one = next(one for one in anomalies_of(simulate(rng, noise=made)[0]) if one.kind == "periodic")
    assert one.target == 13
    # Frequencies are spaced by one over the test's length: a period of 5.3 cycles is known to 5.3 / 100 of itself.
    assert one.period_s == pytest.approx(5.3 * 252, rel=0.06)
    assert one.extra_um == pytest.approx(0.4, abs=0.12)


def test_lost_cycles_and_a_lost_direction_do_not_disturb(rng):
    made = noise(rng)
    made[:, :, 2] += 0.7 * rng.standard_normal((100, 2))
    deviations, _ = simulate(rng, noise=made)
    deviations["deviation"].values[30:40] = np.nan
    deviations["deviation"].values[:, 1, 9] = np.nan
    assert [(one.target, one.kind) for one in anomalies_of(deviations)] == [(3, "scatter")]


def test_too_few_permutations_are_refused(rng):
    deviations, _ = simulate(rng, cycles=5)
    with pytest.raises(ValueError, match=r"permutations=50 cannot reach level=0.05; use at least 199"):
        detect_anomalies(deviations, estimate_drift(deviations), permutations=50)


def test_generalised_esd_of_one_side_leaves_the_other_alone(rng):
    numbers = np.append(rng.standard_normal(40), [-9.0, 9.0])
    assert numbers[generalised_esd(numbers, most=5)].tolist() == [-9.0, 9.0]
    assert numbers[generalised_esd(numbers, most=5, high_only=True)].tolist() == [9.0]


@pytest.mark.parametrize("level", [2, 1, 0, -0.05, np.nan])
def test_a_level_that_is_no_probability_is_refused(level, rng):
    deviations, _ = simulate(rng, cycles=5)
    with pytest.raises(InterferometryError, match=f"level={level} is not a probability between 0 and 1"):
        detect_anomalies(deviations, estimate_drift(deviations), level=level)


def test_a_motion_stands_out_only_where_it_exceeds_those_of_the_other_positions(rng):
    rows = rng.standard_normal(16)
    labels = [_Series(target, direction) for target in range(16) for direction in ("positive", "negative")]
    alone, common = np.repeat(rows, 2), np.repeat(rows + 6.0, 2)
    alone[2 * 4] += 6.0
    assert _moving_apart(labels, alone) == {4}
    assert _moving_apart(labels, common) == set()


def scatters(scatter: np.ndarray, freedom: float) -> xr.Dataset:
    values = {"scatter": scatter, "scatter_freedom": np.full(scatter.shape, freedom)}
    dims = ("direction", "target")
    coords = {"direction": ["positive", "negative"]}
    return xr.Dataset({name: (dims, one) for name, one in values.items()}, coords)


def test_the_direction_of_an_excess_is_told_by_the_scatter_of_the_other_positions():
    scatter = np.full((2, 8), 0.4)
    scatter[:, 2] = 0.9, 0.0
    assert _scatter_direction(scatters(scatter, 80.0), 2, np.array([0, 1, 3, 4, 5, 6, 7])) == "positive"
    # Positive approaches scatter by 2 um everywhere; negative ones by 0.5 um, and by 2 um at the first position.
    estimated = scatters(np.array([[2.0] * 4, [2.0, 0.5, 0.5, 0.5]]), 50.0)
    assert _scatter_direction(estimated, 0, np.arange(1, 4)) == "negative"
    estimated["scatter"][0, 0] = 8.0
    assert _scatter_direction(estimated, 0, np.arange(1, 4)) == "both"
    # The scatter of negative approaches is known at the first position alone.
    estimated["scatter"][1, 1:] = np.nan
    assert _scatter_direction(estimated, 0, np.arange(1, 4)) == "both"


@pytest.mark.parametrize(("share_above", "flagged"), [(0.03, True), (0.031, False)])
def test_scatter_has_six_tenths_of_the_error_probability(share_above, flagged, monkeypatch, rng):
    """At a level of 0.05, excess scatter is found up to p = 0.03, and its p-value is given on the scale of the whole family."""
    deviations, permutations = simulate(rng)[0], 999
    largest = np.zeros(permutations)
    largest[: int(share_above * (permutations + 1)) - 1] = 9.0
    excess = np.zeros(16)
    excess[4] = 5.0
    pools = []

    def tested(z, count, generator):
        pools.append(z.shape[2])
        return (excess, largest) if len(pools) == 1 else (np.zeros(z.shape[2]), np.full(count, 9.0))

    monkeypatch.setattr(anomalies_module, "_scatter_test", tested)
    found = anomalies_module._scatter_anomalies(estimate_drift(deviations), 0.05, permutations, rng)
    assert [one.target for one in found] == ([5] if flagged else [])
    assert not flagged or found[0].p_value == pytest.approx(share_above / 0.6)


def test_one_wild_reading_counts_as_three_standard_deviations(rng):
    z = rng.standard_normal((60, 2, 8))
    excess = []
    for z[20, 0, 5] in (3.0, 30.0):
        excess.append(anomalies_module._scatter_test(z, 1, np.random.default_rng(1))[0])
    np.testing.assert_array_equal(excess[0], excess[1])


def test_the_smallest_p_value_of_a_kind_is_that_of_its_share_of_the_error_probability():
    """400 orders with the measured one, a tenth of the error probability for slow motion, six tenths for scatter."""
    assert anomalies_module._least_p_value("slow", 399) == pytest.approx(1 / 400 / 0.1)
    assert anomalies_module._least_p_value("scatter", 399) == pytest.approx(1 / 400 / 0.6)
    assert anomalies_module._least_p_value("periodic", 399) == 0.0


def test_the_power_of_a_wave_is_the_number_of_cycles(monkeypatch):
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


def test_slowness_and_steps_of_series_that_are_known():
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


def test_a_step_is_slow_only_if_its_remainder_is():
    alternating = 0.1 * np.tile([1.0, -1.0], 20)
    step = np.repeat([0.0, 3.0], 20)
    ramps = np.tile(np.linspace(-1.0, 1.0, 20), 2)
    significant = {"step": {0: (0.01, 0), 1: (0.01, 1)}, "slow": {0: (0.01, 0), 1: (0.01, 1)}, "periodic": {}}
    values = np.stack([step + alternating, step + ramps])
    assert anomalies_module._one_kind_per_target(significant, values) == [("step", 0), ("slow", 1)]
    periods = {"step": {}, "slow": {0: (0.01, 0), 1: (0.03, 1)}, "periodic": {0: (0.02, 0), 1: (0.03, 1), 2: (0.01, 0)}}
    assert anomalies_module._one_kind_per_target(periods, values) == [("slow", 0), ("periodic", 1), ("periodic", 2)]


def test_a_permutation_test_ranks_every_series_among_the_largest_of_all(monkeypatch):
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


def test_generalised_esd_on_rosners_example_and_without_spread():
    # Rosner (1983), as the NIST/SEMATECH e-Handbook of Statistical Methods, 1.3.5.17.3, prints it: three outliers.
    values = """-0.25 0.68 0.94 1.15 1.20 1.26 1.26 1.34 1.38 1.43 1.49 1.49 1.55 1.56 1.58 1.65 1.69 1.70 1.76 1.77 1.81
    1.91 1.94 1.96 1.99 2.06 2.09 2.10 2.14 2.15 2.23 2.24 2.26 2.35 2.37 2.40 2.47 2.54 2.62 2.64 2.90 2.92 2.92 2.93
    3.21 3.26 3.30 3.59 3.68 4.30 4.64 5.34 5.42 6.01"""
    numbers = np.array([float(word) for word in values.split()])
    assert sorted(numbers[generalised_esd(numbers, most=10)]) == [5.34, 5.42, 6.01]
    assert not generalised_esd(np.full(8, 2.0), most=3).any()


@pytest.mark.parametrize(
    ("deviate", "first", "outliers"), [(2.16, [], 0), (2.19, [], 1), (2.10, [1000.0], 1), (2.12, [1000.0], 2)]
)
def test_an_outlier_is_marked_from_its_percentage_point_on(deviate, first, outliers):
    """One side at 0.05: 2.176 standard deviations of ten values, 2.110 of nine after a first outlier (Grubbs 1969, Technometrics 11, 1)."""
    others = np.linspace(-1.0, 1.0, 9 - len(first))
    n = others.size
    # With x beside n values of mean 0 and sum of squares q, x - mean = n / (n + 1) x and n s^2 = q + n / (n + 1) x^2.
    share = n / (n + 1)
    x = np.sqrt((others**2).sum() * deviate**2 / n / (share**2 - deviate**2 * share / n))
    assert generalised_esd(np.append(others, [x, *first]), most=1 + len(first), high_only=True).sum() == outliers


def test_how_large_a_motion_is():
    """In standard deviations of a reading; a slow one without what noise leaves in means of blocks."""
    estimated = xr.Dataset(coords={"cycle": np.arange(101, 141)})
    block = anomalies_module.BLOCK_CYCLES
    periodogram = anomalies_module._Periodogram(600.0 * np.arange(40.0))
    slow = np.resize(np.repeat([3.0, -3.0], block), 8 * block)
    noise = np.resize([1.0, -1.0], 8 * block)
    step = np.where(np.arange(40) < 13, -1.5, 2.5)
    for kind, row, expected in (
        ("slow", slow, (3.0 * np.sqrt(1.0 - 1.0 / block), None, None)),
        ("slow", noise, (0.0, None, None)),
        ("step", step, (4.0, 114, None)),
    ):
        size, *rest = anomalies_module._size_of_motion(estimated, kind, row, row, periodogram)
        assert (size, *rest) == (pytest.approx(expected[0]), *expected[1:])


def test_an_approach_whose_readings_are_all_left_out_has_no_course(rng):
    standardised = rng.normal(size=(40, 2, 3))
    standardised[:, 1, 2] = np.inf
    labels, values = anomalies_module._series(
        xr.Dataset(
            {"standardised": (("cycle", "direction", "target"), standardised), "sigma": 0.4, "resolution": 0.0},
            coords={"direction": ["positive", "negative"]},
        )
    )
    assert [(label.target, label.direction) for label in labels] == [
        *((target, direction) for target in (0, 1) for direction in ("positive", "negative", "both")),
        (2, "positive"),
    ]
    assert (values.std(axis=1) > 0.5).all()


def test_noise_with_a_memory_over_the_cycles_makes_no_position_scatter():
    """The scatter of fewer independent values differs more between positions than permuted readings do."""
    memory, found = Autoregression(np.array([0.6]), 0.64), {True: 0, False: 0}
    for seed in range(60):
        z = memory.with_memory(np.random.default_rng(seed).normal(size=(40, 32))).reshape(40, 2, 16)
        for freed, values in ((True, anomalies_module._without_memory(z)), (False, z)):
            excess, largest = anomalies_module._scatter_test(values, 199, np.random.default_rng(seed))
            found[freed] += (1 + np.count_nonzero(largest >= excess.max())) <= 0.05 * 200
    # Three of 60 by chance, more than eight once in a hundred.
    assert found[True] <= 8 < found[False]
    # Readings that are missing stay missing, and noise without memory stays as it is.
    white = np.random.default_rng(1).normal(size=(40, 2, 16))
    white[3, 0, 2] = np.nan
    np.testing.assert_array_equal(anomalies_module._without_memory(white), white)


@pytest.mark.parametrize("noise_um", [0.2, 0.3])
def test_digits_coarser_than_the_noise_make_no_anomaly_and_hide_no_larger_one(noise_um):
    """A settled machine, 25 cycles in whole micrometres: many positions read the same in every cycle, and none moves."""
    for seed in range(3):
        test, _ = simulate(np.random.default_rng(seed), kind="none", cycles=25, sigma=noise_um)
        assert anomalies_of(recorded(test, 1.0)) == []
    test["deviation"][13:, :, 4] += 3.0
    (step,) = [one for one in anomalies_of(recorded(test, 1.0)) if one.kind == "step"]
    # The shift and the stretch that all positions share take up to three of the sixteen parts of a step of one.
    assert (step.target, step.at_cycle, step.extra_um) == (5, 14, pytest.approx(2.8, abs=0.3))


def test_approaches_that_mirror_each_other_have_no_course_in_common(rng):
    """Their sum is nothing but what the arithmetic rounds, which the statistics must not standardise."""
    standardised = rng.normal(size=(40, 1, 6))
    estimated = xr.Dataset(
        {
            "standardised": (
                ("cycle", "direction", "target"),
                np.concatenate([standardised, 1e-13 - standardised], axis=1),
            ),
            "sigma": 0.4,
            "resolution": 0.0,
        },
        coords={"direction": ["positive", "negative"]},
    )
    labels, _ = anomalies_module._series(estimated)
    assert {label.direction for label in labels} == {"positive", "negative"}
    strength, p = anomalies_module._against_permuted(
        np.ones(3), np.column_stack([np.ones(199), rng.normal(size=(199, 2))])
    )
    assert (strength[0], p[0] > 0.5) == (0.0, True)


@pytest.mark.parametrize("height_um", [2.0, 6.0])
def test_the_height_of_a_step_is_not_that_of_its_winsorised_residuals(height_um):
    test, _ = simulate(np.random.default_rng(1), kind="none", cycles=40)
    test["deviation"][20:, :, 4] += height_um
    step = next(one for one in anomalies_of(test) if one.kind == "step")
    # Up to three of sixteen parts belong to the shift and stretch of all.
    assert step.extra_um == pytest.approx(height_um, rel=0.2)


@pytest.mark.parametrize("sides", [(0,), (0, 1)])
def test_a_jump_that_carries_everything_beyond_is_a_link_and_no_scatter_of_a_position(sides, rng):
    made = noise(rng)
    for side in sides:
        made[:, side, 8:] += 0.8 * rng.standard_normal((100, 1))
    found = anomalies_of(simulate(rng, noise=made)[0])
    (one,) = [anomaly for anomaly in found if anomaly.kind == "link"]
    assert not {8, 9} & {anomaly.target for anomaly in found if anomaly.kind == "scatter"}
    assert (one.target, one.kind, one.stands_out) == (9, "link", True)
    assert one.direction == ("both" if len(sides) == 2 else "positive")
    # Standard uncertainty of a standard deviation from successive differences of 100 values: sqrt(3 / 400), 9 %; three of them.
    assert one.extra_um == pytest.approx(0.8, rel=0.3)


def test_jumps_that_pass_for_a_bend_of_the_drift_are_a_link():
    rng = np.random.default_rng(5)
    made = 0.3 * rng.standard_normal((30, 2, 10))
    jumps = rng.standard_normal(31)
    # Neighbours are alike, which is how the drift is told from noise.
    made[:, :, 4:] += (jumps[1:] + 0.6 * jumps[:-1])[:, None, None]
    time = np.datetime64("2026-03-09T06:30") + 8 * np.arange(made.size).reshape(made.shape) * np.timedelta64(1, "s")
    test = build_deviations(range(1, 31), range(1, 11), 20.0 * np.arange(10), made, time)
    assert "bend" in estimate_drift(test)["component"]
    assert [(one.target, one.kind) for one in anomalies_of(test)] == [(5, "link")]
