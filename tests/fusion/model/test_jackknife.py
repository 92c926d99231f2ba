"""The jackknife of coefficients: against its definition by fits to parts of the readings, and what makes it large."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.alignment.readings import Readings
from fusion.model.fit import ModelFit
from fusion.model.jackknife import PARTS, coefficient_spread
from tests.fusion.small_campaign import RATIOS, campaign, dense_covariance, model_of, term

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


def test_the_spread_is_the_jackknife_over_targets_and_parts() -> None:
    fitted = model(measured())
    part = (BARE.cycle - 1) * PARTS // 12
    expected = np.sqrt(by_definition(fitted, BARE.target) + by_definition(fitted, part))
    assert coefficient_spread(fitted)[-1] == pytest.approx(expected, rel=1e-6)
    assert np.isnan(coefficient_spread(fitted)[: fitted.profile.shape[1]]).all()


def test_a_missing_effect_at_one_target_moves_the_coefficient_far_beyond_its_uncertainty() -> None:
    lacking = model(measured(np.where(BARE.target == 4, 2.0 * BARE.seconds / BARE.seconds[-1], 0.0)))
    complete = model(measured())
    # With nothing missing both state the same uncertainty, here within a factor of three: twelve groups tell no more.
    assert coefficient_spread(complete)[-1] < 3.0 * complete.fit.coefficients_u[-1]
    assert coefficient_spread(lacking)[-1] > 3.0 * lacking.fit.coefficients_u[-1]


def test_a_coefficient_that_rests_on_one_target_is_unbounded() -> None:
    readings = measured()
    fitted = model_of(readings, [term(np.where(BARE.target == 2, GROWTH, 0.0))])
    assert np.isinf(coefficient_spread(fitted)[-1])
