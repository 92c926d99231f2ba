"""The drift system: checked input, whitening, and what it shares with dense algebra."""

from __future__ import annotations

import numpy as np
import pytest

from interferometry.drift.state_space import DriftModelError, DriftSystem, drift_system, start_columns


def test_start_columns_are_levels_and_rates_per_hour() -> None:
    seconds, loadings = np.array([0.0, 1800.0, 3600.0]), np.array([[1.0], [1.0], [2.0]])
    assert start_columns(seconds, loadings, 1).tolist() == [[1.0], [1.0], [2.0]]
    assert start_columns(seconds, loadings, 2).tolist() == [[1.0, 0.0], [1.0, 0.5], [2.0, 2.0]]


def test_defaults_are_ordinary_readings_that_all_count_under_constant_process_noise() -> None:
    system = drift_system([0, 1, 2], np.ones((3, 1)), order=1, ratios=[0.5])  # type: ignore[arg-type]
    assert system.variance.tolist() == [1.0, 1.0, 1.0]
    assert system.observed.all()
    assert system.step_scales.tolist() == [1.0, 1.0, 1.0]


def test_whitening_a_random_walk_is_its_cholesky_factor(rng: np.random.Generator) -> None:
    seconds = np.sort(rng.uniform(0, 20, 12))
    system = drift_system(seconds, np.ones((12, 1)), order=1, ratios=np.array([0.3]))
    white, log_determinant = system.whiten(np.eye(12))
    covariance = 0.3 * np.minimum.outer(seconds - seconds[0], seconds - seconds[0]) + np.eye(12)
    np.testing.assert_allclose(white @ np.linalg.cholesky(covariance), np.eye(12), atol=1e-12)
    assert log_determinant == pytest.approx(np.linalg.slogdet(covariance)[1], rel=1e-12)


def test_smoothed_drift_and_noise_make_up_the_reading(rng: np.random.Generator) -> None:
    columns = rng.normal(size=(12, 2))
    system = drift_system(np.arange(12.0), np.ones((12, 1)), order=2, ratios=np.array([0.1]))
    smoothed = system.smooth(columns)
    np.testing.assert_allclose(smoothed.levels[:, 0] + system.variance[:, None] * smoothed.u, columns, atol=1e-12)


@pytest.mark.parametrize(
    ("seconds", "loadings", "message"),
    [
        ([0.0, 2.0, 1.0], np.ones((3, 1)), "must not decrease"),
        ([0.0, np.nan, 1.0], np.ones((3, 1)), "must be finite"),
        ([0.0, 1.0, 2.0], np.ones(3), r"loadings has shape \(3,\); expected \(3, number of drift components\)"),
    ],
)
def test_bad_input_is_named(seconds: list[float], loadings: np.ndarray, message: str) -> None:
    with pytest.raises(DriftModelError, match=message):
        drift_system(np.array(seconds), loadings, order=1, ratios=np.ones(1))


def uneven(rng: np.random.Generator, n: int) -> DriftSystem:
    """A smooth drift with a stretch, every fifth reading held out."""
    return drift_system(
        np.sort(rng.uniform(0, 900, n)),
        np.column_stack([np.ones(n), rng.random(n)]),
        order=2,
        ratios=np.array([1e-4, 1e-3]),
        variance=rng.uniform(0.5, 2.0, n),
        observed=np.arange(n) % 5 != 0,
    )


def test_readings_that_are_whitened_some_after_others_are_those_whitened_at_once(rng: np.random.Generator) -> None:
    n = 23
    system, columns = uneven(rng, n), rng.normal(size=(n, 3))
    whitening = system.whitening(3)
    parts = [whitening.whiten(columns[rows].copy()) for rows in (slice(0, 7), slice(7, 8), slice(8, n))]
    innovations, variances = system.innovations(columns)
    np.testing.assert_allclose(np.vstack(parts), innovations / np.sqrt(variances)[:, None], atol=1e-13)
    assert whitening.done == n


def test_products_of_many_columns_are_those_of_few(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    n = 700
    system, columns = uneven(rng, n), rng.normal(size=(n, 5))
    gram, log_determinant = system.normal_equations(columns)
    monkeypatch.setattr("interferometry.drift.state_space.MANY_COLUMNS", 5)
    by_blocks, determinant = system.normal_equations(columns)
    np.testing.assert_allclose(by_blocks, gram, rtol=1e-11, atol=1e-11)
    assert determinant == pytest.approx(log_determinant, rel=1e-12)


def test_many_columns_are_smoothed_as_few_are(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    n = 30
    system, columns = uneven(rng, n), rng.normal(size=(n, 5))
    at_once = system.smooth(columns)
    monkeypatch.setattr("interferometry.drift.state_space.MANY_COLUMNS", 2)
    for told, expected in zip(system.smooth(columns), at_once, strict=True):
        np.testing.assert_array_equal(told, expected)


def test_readings_at_one_instant_share_their_drift_and_other_shapes_are_refused():
    """Two readings at once of a drift that starts at zero: the second innovation lacks what the first told."""
    system = drift_system(np.array([0.0, 100.0, 100.0]), np.ones((3, 1)), order=1, ratios=[0.01])
    innovations, variances = system.innovations(np.array([[0.0], [2.0], [2.0]]))
    np.testing.assert_allclose(innovations[:, 0], [0.0, 2.0, 1.0])
    np.testing.assert_allclose(variances, [1.0, 2.0, 1.5])
    with pytest.raises(
        DriftModelError, match=r"loadings has shape \(3, 1, 1\); expected \(3, number of drift components\)"
    ):
        drift_system(np.arange(3.0), np.ones((3, 1, 1)), order=1, ratios=[0.01])
