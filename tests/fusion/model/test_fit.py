"""The drift model: places of its terms, priors, and predictions in open loop against dense algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.alignment.readings import Readings
from fusion.effects.effect import Candidate, Effect, Prior
from fusion.model.fit import (
    again,
    condition,
    fit_model,
    place_of,
    refit_fixed,
    settled,
    unexplained_drift,
)
from interferometry.drift.gls import drift_system, fit_fixed_effects
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
    assert model.coefficients() == {
        "a": model.fit.coefficients[profile],
        "b": model.fit.coefficients[profile + 2],
    }
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
    told = condition(fit, 1, Prior(mean=2.0, u=0.1))
    # One further row that observes the second coefficient, weighted by sigma over its uncertainty.
    row = np.array([0.0, fit.sigma / 0.1, 0.0])
    augmented = np.vstack([design, row])
    expected = np.linalg.lstsq(augmented, np.r_[y, 2.0 * row[1]], rcond=None)[0]
    np.testing.assert_allclose(told.coefficients, expected, rtol=1e-9)
    np.testing.assert_allclose(told.covariance, fit.sigma**2 * np.linalg.inv(augmented.T @ augmented), rtol=1e-9)
    assert told.sigma == fit.sigma


def test_only_terms_with_a_prior_have_one_in_the_model(rng):
    readings = with_response(campaign(cycles=8), rng)
    known = term(rng.standard_normal((64, 2)), "known", prior=Prior(1.0, 0.5))
    model = model_of(readings, [term(rng.standard_normal(64)), known])
    assert model.priors() == [(readings.profile.shape[1] + 1, Prior(1.0, 0.5))]


def test_the_fit_gives_back_what_was_put_in(rng):
    bare = campaign(cycles=20)
    column = np.sin(bare.seconds / 500.0) * bare.share
    readings = with_response(bare, rng, (3.0, column))
    model = fit_model(readings, [term(column)])
    value, u = model.fit.coefficients[-1], model.fit.coefficients_u[-1]
    assert model.coefficients()["effect"] == pytest.approx(3.0, abs=3.0 * u)
    assert 0.0 < u < 0.1 and model.fit.sigma == pytest.approx(0.1, rel=0.2)
    held = fit_model(readings, [term(column, prior=Prior(5.0, 1e-6))])
    assert held.coefficients()["effect"] == pytest.approx(5.0, abs=1e-3)
    assert value != pytest.approx(5.0, abs=0.5)


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


def test_the_whole_system_keeps_the_weights_of_the_used_readings(rng):
    readings = with_response(campaign(cycles=8), rng)
    used = readings.cycle <= 5
    model = model_of(readings, [], used)
    weights = np.linspace(1.0, 2.0, used.sum())
    model = replace(model, fit=replace(model.fit, system=replace(model.fit.system, variance=weights)))
    whole = model.whole_system()
    np.testing.assert_array_equal(whole.variance[used], weights)
    np.testing.assert_array_equal(whole.variance[~used], 1.0)
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
    levels, _ = model.fit.drift()
    whole = levels * readings.loadings
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
    renewed = again(chosen, readings, {"offset": 2.0}, effects)
    np.testing.assert_array_equal(renewed.candidate.columns[:, 0], np.where(readings.seconds >= 600.0, -2.0, 0.0))
    assert renewed.candidate.prior == Prior(1.0, 2.0)
    other = replace(chosen, candidate=replace(chosen.candidate, parameters={"time_s": 600.1}))
    np.testing.assert_array_equal(again(other, readings, {"offset": 2.0}, effects).candidate.columns, 0.0)


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
        renewed = again(term(np.zeros(80), "own", parameters=parameters), readings, {}, effects)
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
    weighed = settled(model, effects)
    assert weighed.coefficients()["camera_offset"] == pytest.approx(0.5, abs=0.1)
    assert weighed.terms[0] is offset
    fit = fit_model(readings, [offset])
    assert settled(fit, effects) is fit


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
