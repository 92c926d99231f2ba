"""The drift model: places of its terms, priors, and predictions in open loop against dense algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from fusion.analysis.alignment.readings import Readings
from fusion.analysis.drift_model.model import (
    _LATEST_READINGS,
    PARTS,
    SINGLE,
    ModelFit,
    PriorRows,
    Term,
    coefficient_spread,
    condition,
    density_ahead,
    fit_model,
    gain_across,
    least_ratio,
    moments_of,
    place_of,
    plausible_ratios,
    profile_likelihood,
    recompute_term,
    refit_fixed,
    residual_squares,
    scaled_systems,
    size_camera_errors,
    solve,
    unexplained_drift,
)
from fusion.analysis.effects.effect import Candidate, Effect, Prior
from interferometry.drift.gls import DriftFit, drift_system, fit_fixed_effects
from tests.fusion.small_campaign import RATIOS, campaign, dense_covariance, model_of, term


def with_response(readings: Readings, rng: np.random.Generator, *named: tuple[float, np.ndarray]) -> Readings:
    """A profile, effects of given size, a common random walk, and noise of 0.1 um."""
    profile = readings.profile @ rng.standard_normal(readings.profile.shape[1])
    steps = np.sqrt(np.diff(readings.seconds, prepend=0.0))
    walk = 0.01 * np.cumsum(steps * rng.standard_normal(steps.size))
    response = profile + walk + 0.1 * rng.standard_normal(steps.size)
    return replace(readings, response=response + sum(size * column for size, column in named))


def test_columns_of_a_term_stand_behind_those_before_it():
    terms = [term(np.ones((3, width))) for width in (1, 2, 3)]
    assert [place_of(terms, one, 10) for one in terms] == [slice(10, 11), slice(11, 13), slice(13, 16)]
    assert place_of(terms, terms[0]) == slice(0, 1)
    # An equal term is not the same term.
    with pytest.raises(KeyError, match="effect"):
        place_of(terms, replace(terms[0]))


def test_coefficients_and_contributions_of_the_terms(rng):
    readings = with_response(campaign(cycles=8), rng)
    first, second = term(rng.standard_normal((64, 2)), "a"), term(rng.standard_normal(64), "b")
    repeated = term(rng.standard_normal(64), "a")
    model = model_of(readings, [first, second, repeated])
    profile = readings.profile.shape[1]
    assert [model.place(one).start - profile for one in model.terms] == [0, 2, 3]
    assert model.coefficients() == {"a": model.fit.coefficients[profile], "b": model.fit.coefficients[profile + 2]}
    series, u = model.series(first)
    np.testing.assert_allclose(series, first.candidate.columns @ model.fit.coefficients[profile : profile + 2])
    covariance = model.fit.covariance[profile : profile + 2, profile : profile + 2]
    row = first.candidate.columns[5]
    assert u[5] == pytest.approx(np.sqrt(row @ covariance @ row))


def test_a_prior_is_one_more_observation_of_its_coefficient(rng):
    n = 40
    design, y = rng.standard_normal((n, 3)), rng.standard_normal(n)
    system = drift_system(np.arange(n), np.ones((n, 1)), order=1, ratios=np.zeros(1))
    fit = fit_fixed_effects(system, y, design)
    told = condition(fit, np.eye(3)[1], Prior(mean=2.0, u=0.1))
    # One further row that observes the second coefficient, weighted by sigma over its uncertainty.
    row = np.array([0.0, fit.sigma / 0.1, 0.0])
    augmented = np.vstack([design, row])
    expected = np.linalg.lstsq(augmented, np.r_[y, 2.0 * row[1]], rcond=None)[0]
    np.testing.assert_allclose(told.coefficients, expected, rtol=1e-9)
    np.testing.assert_allclose(told.covariance, fit.sigma**2 * np.linalg.inv(augmented.T @ augmented), rtol=1e-9)
    assert told.sigma == fit.sigma


def test_a_profile_column_that_the_used_readings_do_not_hold_is_left_out(rng):
    readings = with_response(campaign(cycles=12), rng)
    # Target 4 is not seen, target 3 from one side only: its reversal is half its level.
    used = (readings.target < 4) & ~((readings.target == 3) & (readings.sign < 0))
    model = fit_model(readings, [], used=used)
    assert readings.profile.shape[1] == 8
    # Levels of targets 1 to 3, reversals of targets 1 and 2.
    np.testing.assert_array_equal(model.profile, readings.profile[:, [0, 1, 2, 4, 5]])
    errors, spread = model.open_loop_errors()
    unseen = readings.site[~used]
    np.testing.assert_array_equal(np.isnan(errors), np.isin(unseen, [5, 6, 7]))
    assert np.isfinite(spread).all()


@pytest.mark.parametrize("order", [1, 2])
def test_predictions_in_open_loop_are_those_of_dense_algebra(order, rng):
    readings = with_response(campaign(cycles=10), rng)
    column = np.cos(readings.seconds / 300.0)
    used = readings.cycle <= 7
    model = model_of(readings, [term(column)], used, order=order, ratios=RATIOS if order == 1 else RATIOS / 1e4)
    design = model.whole_design()
    hours = readings.loadings * (readings.seconds / 3600.0)[:, None]
    expected_design = np.column_stack([readings.profile, column, *([hours] if order == 2 else [])])
    np.testing.assert_allclose(design, expected_design)
    v = dense_covariance(readings, model.fit.system.ratios, order)
    early, late = np.ix_(used, used), np.ix_(~used, used)
    weight = np.linalg.solve(v[early], v[late].T).T
    through = design[~used] - weight @ design[used]
    expected = readings.response[~used] - weight @ readings.response[used] - through @ model.fit.coefficients
    own = np.diag(v)[~used] - np.einsum("nm,nm->n", weight, v[late])
    spread = model.fit.sigma**2 * own + np.einsum("ni,ij,nj->n", through, model.fit.covariance, through)
    errors, told = model.open_loop_errors()
    np.testing.assert_allclose(errors, expected, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(told, np.sqrt(spread), rtol=1e-6)


def test_the_whole_system_keeps_the_weights_of_the_used_readings_and_goes_on_with_the_last_ones(rng):
    readings = with_response(campaign(cycles=8), rng)
    used = readings.cycle <= 5
    model = model_of(readings, [], used)
    weights = np.linspace(1.0, 2.0, used.sum())
    model = replace(model, fit=replace(model.fit, system=replace(model.fit.system, variance=weights)))
    whole = model.whole_system()
    np.testing.assert_array_equal(whole.variance[used], weights)
    last = [np.median(weights[readings.site[used] == site][-_LATEST_READINGS:]) for site in readings.site[~used]]
    np.testing.assert_array_equal(whole.variance[~used], last)
    np.testing.assert_array_equal(whole.observed, used)
    assert whole.order == 1 and whole.ratios is model.fit.system.ratios


@pytest.mark.parametrize("order", [1, 2])
def test_the_unexplained_drift_is_what_profile_and_effects_cannot_make(order, rng):
    readings = with_response(campaign(cycles=10), rng)
    model = model_of(readings, [term(np.sqrt(readings.seconds))], order=order)
    drift, basis = unexplained_drift(model.fit)
    named = model.fit.design[:, : readings.profile.shape[1] + 1]
    assert drift.shape == (readings.seconds.size, 2)
    assert np.abs(named.T @ drift).max() < 1e-8 * np.abs(named).max()
    np.testing.assert_allclose(basis @ (basis.T @ named), named, atol=1e-9)
    np.testing.assert_allclose(basis.T @ basis, np.eye(named.shape[1]), atol=1e-12)
    whole = model.fit.smoothed.levels[:, :, 0] * readings.loadings
    if order == 2:
        whole = whole + model.fit.design[:, -2:] * model.fit.coefficients[-2:]
    np.testing.assert_allclose(drift, whole - basis @ (basis.T @ whole), atol=1e-10)
    assert np.abs(drift).max() > 1e-3


def test_a_nested_model_is_fitted_with_the_drift_kept(rng):
    for order in (1, 2):
        readings = with_response(campaign(cycles=10), rng)
        used = readings.cycle <= 8
        first, second = term(rng.standard_normal(80)), term(rng.standard_normal(80))
        model = model_of(readings, [first, second], used, order=order)
        nested = refit_fixed(model, [first])
        expected = model_of(readings, [first], used, order=order).fit
        np.testing.assert_allclose(nested.coefficients, expected.coefficients, rtol=1e-9)
        assert nested.rss == pytest.approx(expected.rss, rel=1e-9)
        assert nested.rss > model.fit.rss


def camera_error(name: str) -> Effect:
    """A column that is minus the coefficient of the table's offset, as the field's error is weighed."""

    def candidates(readings, coefficients, near):
        for instant in (300.0, 600.0):
            late = (readings.seconds >= instant).astype(float)
            yield Candidate((-coefficients.get("offset", 0.0) * late)[:, None], {"time_s": instant}, ("K",))

    return Effect(name, "", "", candidates, errs_camera=True)


def test_a_term_is_computed_anew_for_the_same_parameters():
    readings = campaign(cycles=10)
    effects = {"camera_offset": camera_error("camera_offset")}
    chosen = term(np.zeros(80), "camera_offset", parameters={"time_s": 600.0 * (1.0 + 1e-12)}, prior=Prior(1.0, 2.0))
    renewed = recompute_term(chosen, readings, {"offset": 2.0}, effects)
    np.testing.assert_array_equal(renewed.candidate.columns[:, 0], np.where(readings.seconds >= 600.0, -2.0, 0.0))
    assert renewed.candidate.prior == Prior(1.0, 2.0)
    other = replace(chosen, candidate=replace(chosen.candidate, parameters={"time_s": 600.1}))
    np.testing.assert_array_equal(recompute_term(other, readings, {"offset": 2.0}, effects).candidate.columns, 0.0)


def test_words_and_names_of_parameters_have_to_agree():
    readings = campaign(cycles=10)

    def candidates(readings, coefficients, near):
        for shape, size in (("flat", 1.0), ("linear", 2.0)):
            yield Candidate(np.full((80, 1), size), {"shape": shape, "minutes": 5.0}, ("um",))

    effects = {"own": Effect("own", "", "", candidates)}
    for parameters, size in (
        ({"shape": "linear", "minutes": 5.0}, 2.0),
        ({"shape": "curved", "minutes": 5.0}, 0.0),
        ({"minutes": 5.0}, 0.0),
    ):
        renewed = recompute_term(term(np.zeros(80), "own", parameters=parameters), readings, {}, effects)
        np.testing.assert_array_equal(renewed.candidate.columns, size)


def test_a_camera_error_is_weighed_by_the_coefficients_beside_it(rng):
    bare = campaign(cycles=20)
    rise = np.sin(bare.seconds / 400.0)
    late = (bare.seconds >= 600.0).astype(float)
    # The table's offset is 2 um/K; a false rise of 0.5 K is predicted as 1 um too much.
    readings = with_response(bare, rng, (2.0, rise), (0.5, -2.0 * late))
    offset = term(rise, "offset")
    wrong = term(-1.0 * late, "camera_offset", parameters={"time_s": 600.0})
    model = fit_model(readings, [offset, wrong])
    assert model.coefficients()["camera_offset"] == pytest.approx(1.0, abs=0.2)
    effects = {"camera_offset": camera_error("camera_offset")}
    weighed = size_camera_errors(model, effects)
    assert weighed.coefficients()["camera_offset"] == pytest.approx(0.5, abs=0.1)
    assert weighed.terms[0] is offset
    fit = fit_model(readings, [offset])
    assert size_camera_errors(fit, effects) is fit


def test_each_site_is_weighted_by_its_own_scatter(rng):
    bare = campaign(cycles=40)
    loud = (bare.target == 2) & (bare.sign > 0)
    noise = rng.choice([-1.0, 1.0], bare.seconds.size) * np.where(loud, 0.2, 0.1)
    variance = fit_model(replace(bare, response=noise), []).fit.system.variance
    assert variance.mean() == pytest.approx(1.0)
    by_site = np.array([variance[bare.site == site].mean() for site in range(8)])
    assert by_site.argmax() == 2
    # Seven sites of variance 0.01 and one of 0.04 have 0.01375 in common. Each site's 40 readings are joined by 20 of that variance:
    # (40 * 0.04 / 0.01375 + 20) / (40 * 0.01 / 0.01375 + 20) = 2.78.
    assert by_site[2] / np.median(by_site) == pytest.approx(2.78, rel=0.1)


def test_noise_that_grows_over_the_test_is_weighted_by_its_size(rng):
    bare = campaign(cycles=60, positions_mm=tuple(np.linspace(100.0, 400.0, 12)))
    size = 0.1 * np.exp(1.2 * (bare.cycle - 1) / 59)
    noise = rng.standard_normal(bare.seconds.size)
    of_cycle = [fit_model(replace(bare, response=one), []).fit.system.variance for one in (noise, size * noise)]
    even, grown = ([one[bare.cycle == cycle].mean() for cycle in (1, 60)] for one in of_cycle)
    assert even[1] == pytest.approx(even[0], rel=1e-9)
    # exp(2.4) = 11; 24 readings of each of 60 cycles know the logarithm to 0.13.
    assert np.log(grown[1] / grown[0]) == pytest.approx(2.4, abs=0.5)


# Least squares of many candidates and many responses, against one `lstsq` each and against dense densities.


def squares_beside(y: np.ndarray, x: np.ndarray) -> float:
    """Residual sum of squares of one response by `lstsq`."""
    left = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    return float(left @ left)


def halves_of(y: np.ndarray, columns: np.ndarray, half: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Products of columns and responses over each half, and squared lengths of the columns there."""
    return [(columns[part].T @ y[part], (columns[part] ** 2).sum(axis=0)) for part in (half, ~half)]


def test_every_response_chooses_its_own_event_on_the_half_that_sizes_it(rng):
    y = rng.standard_normal((12, 5))
    # Columns of very different size: the largest product with the response is not the largest reduction.
    columns = rng.standard_normal((12, 7)) * np.array([0.01, 0.1, 1.0, 10.0, 100.0, 1e3, 1e4])
    half = np.arange(12) % 3 == 0
    expected = np.zeros(5)
    chosen = set()
    for k in range(5):
        for train, test in ((half, ~half), (~half, half)):
            size = [float(c[train] @ y[train, k] / (c[train] @ c[train])) for c in columns.T]
            left = [((y[train, k] - s * c[train]) ** 2).sum() for s, c in zip(size, columns.T, strict=True)]
            best = int(np.argmin(left))
            chosen.add(best)
            expected[k] += (y[test, k] ** 2).sum() - ((y[test, k] - size[best] * columns[test, best]) ** 2).sum()
    assert len(chosen) > 2
    np.testing.assert_allclose(gain_across(halves_of(y, columns, half)), expected, rtol=1e-10)


@pytest.mark.parametrize(("tilt", "left"), [(1.9e-3, 1.0), (2.1e-3, 0.0)])
def test_a_direction_below_a_thousandth_counts_as_dependent(tilt, left):
    """Two unit columns at a small angle t have singular values in the ratio t / 2."""
    x = np.array([[1.0, 1.0], [0.0, tilt], [0.0, 0.0]]) * np.array([1.0, 1e6])
    assert residual_squares(np.array([0.0, 1.0, 0.0]), x) == pytest.approx(left, abs=1e-6)


def test_normal_equations_are_solved_for_several_responses_in_any_units(rng):
    x, y = rng.standard_normal((30, 3)), rng.standard_normal((30, 2))
    unit = np.array([1e-6, 1.0, 1e5])
    expected = np.linalg.lstsq(x, y, rcond=None)[0] / unit[:, None]
    np.testing.assert_allclose(solve((x * unit).T @ (x * unit), (x * unit).T @ y), expected, rtol=1e-7)


def test_a_column_that_is_zero_here_gets_no_coefficient_and_equal_columns_share(rng):
    column, y = rng.standard_normal(20), rng.standard_normal((20, 1))
    size = float(column @ y[:, 0] / (column @ column))
    x = np.column_stack([column, np.zeros(20)])
    np.testing.assert_allclose(solve(x.T @ x, x.T @ y)[:, 0], [size, 0.0], rtol=1e-8)
    twice = np.column_stack([column, column])
    np.testing.assert_allclose(solve(twice.T @ twice, twice.T @ y)[:, 0], [size / 2, size / 2], rtol=1e-6)


def test_priors_are_further_rows_that_know_the_models_columns_only():
    rows = PriorRows(np.array([[0.0, 2.0]]), np.array([5.0]), np.array([[7.0, 8.0]]))
    y, x = rows.append(np.zeros((3, 3)), np.ones((3, 4)))
    np.testing.assert_array_equal(y[3], [5.0, 7.0, 8.0])
    np.testing.assert_array_equal(x[3], [0.0, 2.0, 0.0, 0.0])
    assert (y.shape, x.shape) == ((4, 3), (4, 4))
    measured_only, _ = rows.append(np.zeros((3, 1)), np.ones((3, 2)))
    np.testing.assert_array_equal(measured_only[:, 0], [0.0, 0.0, 0.0, 5.0])
    # The prior of the measured response loses what coefficients make of it.
    beside = rows.beside(np.array([9.0, 1.5]))
    np.testing.assert_array_equal(beside.responses(3), [[2.0, 7.0, 8.0]])
    assert beside.design is rows.design


def test_moments_hold_products_and_give_those_of_the_first_columns(rng):
    x, y, spread = rng.standard_normal((9, 3)), rng.standard_normal((9, 2)), rng.uniform(1.0, 2.0, 9)
    part = moments_of(y, x, spread).first(2)
    np.testing.assert_allclose(part.design, x[:, :2].T @ x[:, :2], rtol=1e-12)
    np.testing.assert_allclose(part.cross, x[:, :2].T @ y, rtol=1e-12)
    np.testing.assert_allclose(part.squares, (y**2).sum(axis=0), rtol=1e-12)
    assert part.readings == 9
    assert part.log_spread == pytest.approx(np.log(spread).sum())


def test_moments_of_parts_and_of_priors_add_up(rng):
    x, y, spread = rng.standard_normal((9, 3)), rng.standard_normal((9, 2)), rng.uniform(1.0, 2.0, 9)
    priors = PriorRows(np.array([[0.0, 2.0]]), np.array([5.0]), np.array([[7.0]]))
    told = priors.add_to(moments_of(y[:4], x[:4], spread[:4]).plus(moments_of(y[4:], x[4:], spread[4:])))
    whole = moments_of(*priors.append(y, x), spread)
    for name in ("design", "cross", "squares", "readings", "log_spread"):
        np.testing.assert_allclose(getattr(told, name), getattr(whole, name), rtol=1e-12)


def test_the_profile_likelihood_is_that_of_the_best_coefficients_and_noise(rng):
    n = 25
    x, y, spread = rng.standard_normal((n, 3)), rng.standard_normal((n, 2)), rng.uniform(1.0, 4.0, n)
    # The likelihood of the unwhitened readings at the maximum, without n/2 (1 + log 2 pi).
    for k, told in enumerate(profile_likelihood(moments_of(y, x, spread))):
        sigma = np.sqrt(squares_beside(y[:, k], x) / n)
        fitted = x @ np.linalg.lstsq(x, y[:, k], rcond=None)[0]
        density = stats.norm.logpdf(y[:, k], fitted, sigma).sum() - 0.5 * np.log(spread).sum()
        assert told == pytest.approx(density + 0.5 * n * (1.0 + np.log(2.0 * np.pi)), rel=1e-8)


@pytest.mark.parametrize("flat", [2, 4])
def test_the_density_of_later_readings_is_the_predictive_t_density(rng, flat):
    """Coefficients after the flat ones have a normal prior worth one of all readings; the noise has the prior 1 / sigma."""
    n, later = 30, 12
    x, spread = rng.standard_normal((n, 4)), rng.uniform(1.0, 3.0, n)
    y = x @ np.array([1.0, -2.0, 0.5, 0.3]) + rng.standard_normal(n)
    precision = np.zeros((4, 4))
    base, other = x[:, :flat], x[:, flat:]
    free = other - base @ np.linalg.lstsq(base, other, rcond=None)[0]
    precision[flat:, flat:] = free.T @ free / n
    early, late = slice(0, n - later), slice(n - later, n)
    normal = x[early].T @ x[early] + precision
    beta = np.linalg.solve(normal, x[early].T @ y[early])
    left = y[early] @ y[early] - beta @ normal @ beta
    freedom = n - later - flat
    shape = left / freedom * (np.eye(later) + x[late] @ np.linalg.solve(normal, x[late].T))
    expected = stats.multivariate_t.logpdf(y[late], x[late] @ beta, shape, df=freedom)
    told = density_ahead(moments_of(y[early, None], x[early], spread[early]), moments_of(y[:, None], x, spread), flat)
    assert told[0] == pytest.approx(expected - 0.5 * np.log(spread[late]).sum(), rel=1e-7)


# The jackknife of coefficients: against its definition by fits to parts of the readings, and what makes it large.


BARE = campaign(cycles=12)
GROWTH = BARE.seconds / BARE.seconds[-1] * (BARE.position_mm / 400.0) ** 2


def measured(extra: np.ndarray | float = 0.0) -> Readings:
    noise = 0.05 * np.random.default_rng(4).standard_normal(BARE.seconds.size)
    return replace(BARE, response=3.0 * GROWTH + noise + extra)


def model(readings: Readings) -> ModelFit:
    return model_of(readings, [term(GROWTH)])


def by_definition(model: ModelFit, groups: np.ndarray) -> float:
    """Delete-a-group jackknife by dense algebra on the readings that are kept."""
    covariance = dense_covariance(model.readings, RATIOS)
    values = []
    for group in np.unique(groups):
        kept = groups != group
        design = model.fit.design[kept]
        design = design[:, (design != 0.0).any(axis=0)]
        weight = np.linalg.inv(covariance[np.ix_(kept, kept)])
        normal = design.T @ weight @ design
        values.append(np.linalg.solve(normal, design.T @ weight @ model.readings.response[kept])[-1])
    spread = np.array(values) - np.mean(values)
    return float((len(values) - 1) / len(values) * spread @ spread)


def test_the_spread_is_the_larger_jackknife_over_targets_or_parts() -> None:
    fitted = model(measured())
    part = (BARE.cycle - 1) * PARTS // 12
    expected = np.sqrt(max(by_definition(fitted, BARE.target), by_definition(fitted, part)))
    assert coefficient_spread(fitted)[-1] == pytest.approx(expected, rel=1e-6)
    assert np.isnan(coefficient_spread(fitted)[: fitted.profile.shape[1]]).all()


def test_a_coefficient_that_rests_on_one_target_is_unbounded() -> None:
    readings = measured()
    fitted = model_of(readings, [term(np.where(BARE.target == 2, GROWTH, 0.0))])
    assert np.isinf(coefficient_spread(fitted)[-1])


# Grids of drift variances: the least of them by its definition, the factors, and draws in proportion to the likelihood.


SECONDS = np.linspace(0.0, 7200.0, 40)
LEVEL = np.ones((40, 1))


def fit_of(ratio: float, response: np.ndarray, *, order: int = 1) -> DriftFit:
    system = drift_system(SECONDS, LEVEL, order=order, ratios=np.array([ratio]))
    return fit_fixed_effects(system, response, LEVEL)


def test_the_least_drift_moves_by_a_quarter_of_the_noise_until_the_end():
    walk = drift_system(SECONDS + 500.0, LEVEL, order=1, ratios=np.ones(1))
    # Variance of a random walk after T: ratio * T; of an integrated one: ratio * T**3 / 3.
    assert np.sqrt(least_ratio(walk) * 7200.0) == pytest.approx(0.25)
    integrated = drift_system(SECONDS + 500.0, LEVEL, order=2, ratios=np.ones(1))
    assert np.sqrt(least_ratio(integrated) * 7200.0**3 / 3.0) == pytest.approx(0.25)


def test_variances_are_scaled_from_the_estimate_or_from_the_least_drift(rng):
    fit = fit_of(1e-3, rng.standard_normal(40))
    told = [float(system.ratios[0]) for system in scaled_systems(fit, SINGLE)]
    np.testing.assert_allclose(told, [1e-9, 10**-5.5, 1e-4, 1e-3, 10**-2.5, 1e-2], rtol=1e-12)
    none = fit_of(0.0, rng.standard_normal(40))
    (least,) = scaled_systems(none, ((1.0,),))
    assert least.ratios[0] == pytest.approx(10.0 * 0.0625 / 7200.0)


def test_every_component_has_its_own_factor_and_a_short_set_is_repeated(rng):
    loadings = np.column_stack([np.ones(40), np.tile([0.5, 1.0], 20)])
    system = drift_system(SECONDS, loadings, order=1, ratios=np.array([1e-2, 1e-3]))
    fit = fit_fixed_effects(system, rng.standard_normal(40), loadings)
    first, second = scaled_systems(fit, ((0.0, -1.0), (1.0,)))
    np.testing.assert_allclose(first.ratios, [1e-2, 1e-4])
    np.testing.assert_allclose(second.ratios, [1e-1, 1e-2])


def test_variances_are_drawn_in_proportion_to_their_restricted_likelihood(rng):
    walk = np.cumsum(rng.standard_normal(40)) * np.sqrt(7200.0 / 39.0 * 2e-3)
    response = walk + rng.standard_normal(40)
    fit = fit_of(2e-3, response)
    tried = 2e-3 * 10.0 ** np.array([-2.0, -1.0, -0.5, 0.0, 0.5, 1.0])
    likelihood = np.array([fit_of(ratio, response).log_likelihood for ratio in tried])
    weight = np.exp(likelihood - likelihood.max())
    weight /= weight.sum()
    draws = plausible_ratios(fit, rng, draws=4000)
    assert draws.shape == (4000, 1)
    share = [float(np.isclose(draws[:, 0], ratio, rtol=1e-9).mean()) for ratio in tried]
    assert sum(share) == pytest.approx(1.0)
    # Four standard deviations of a share of 4,000 draws.
    np.testing.assert_allclose(share, weight, atol=4.0 * np.sqrt(0.25 / 4000))
    assert weight.max() > 10.0 * weight.min()


def test_a_drift_estimated_as_zero_is_still_drawn(rng):
    draws = plausible_ratios(fit_of(0.0, rng.standard_normal(40)), rng, draws=50)
    assert (draws > 0.0).all()


def test_what_is_known_of_the_expansion_is_known_of_its_direct_and_lagged_share_together(rng):
    """3.7 ppm/K at once and 8.1 ppm/K late are 11.8 ppm/K of a table that has settled."""
    bare = campaign(cycles=30)
    direct = np.sin(bare.seconds / 700.0) * bare.position_mm * 1e-2
    late = np.sin(bare.seconds / 700.0 - 1.0) * bare.position_mm * 1e-2
    readings = with_response(bare, rng, (3.7, direct), (8.1, late))
    expansion = Term("axis_expansion", Candidate(direct[:, None], {}, ("ppm/K",), prior=Prior(11.7, 0.01)))
    lag = Term("thermal_lag", Candidate(np.column_stack([late, late**2]), {}, ("ppm/K", "um/K")))
    model = fit_model(readings, [expansion, lag])
    place = model.place(expansion).start
    assert 11.7 < (model.fit.coefficients @ model.static())[place] < 11.8
    assert model.fit.coefficients[place] == pytest.approx(3.7, abs=0.5)
    assert coefficient_spread(model)[place] < 1.0
    alone = fit_model(readings, [expansion])
    np.testing.assert_array_equal(alone.static(), np.eye(alone.fit.coefficients.size))
