"""Patterns along the axis: the right one passes, the nearest one is denied its name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from fusion.effects.library import library
from fusion.loop.axis_pattern import LEVEL, pattern_p_value, wrong_patterns
from fusion.loop.decisions import Reason
from fusion.model.fit import ModelFit
from tests.fusion.small_campaign import campaign, model_of, term

POSITIONS = (100.0, 150.0, 200.0, 250.0, 300.0, 350.0, 400.0)
BARE = campaign(cycles=40, positions_mm=POSITIONS)
#: A course in time that no drift of this size stands in for: straight between the readings of the last target in positive direction.
KNOTS = BARE.seconds[(BARE.target == 7) & (BARE.sign > 0)]
COURSE = np.interp(BARE.seconds, KNOTS, np.sin(KNOTS / 300.0))
OTHER_COURSE = np.interp(BARE.seconds, KNOTS, np.cos(KNOTS / 1000.0))
#: Variances of a drift that is hardly there.
QUIET = np.array([1e-9, 1e-9])


def fitted(seen: np.ndarray, *named: tuple[str, np.ndarray], seed: int = 3, noise_um: float = 0.1) -> ModelFit:
    """A model with the named columns, of readings that hold what is seen and noise."""
    noise = noise_um * np.random.default_rng(seed).standard_normal(BARE.seconds.size)
    readings = replace(BARE, response=seen + noise)
    return model_of(readings, [term(column, name) for name, column in named], ratios=QUIET)


BENDING = COURSE * BARE.share**2
REVERSAL = COURSE * 0.5 * BARE.sign


def test_the_right_pattern_has_uniform_p_values():
    p_values = [
        pattern_p_value(model, model.terms[0])
        for model in (fitted(BENDING, ("angular_growth", BENDING), seed=seed) for seed in range(60))
    ]
    # The one target that deviates most is left out, which makes the test careful.
    assert min(p_values) > LEVEL
    assert (np.array(p_values) < 0.05).mean() <= 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / 60)


def test_a_stretch_that_differs_by_direction_is_no_reversal():
    """The nearest effect of the library is found, but its pattern is the wrong one."""
    seen = COURSE * BARE.share * BARE.sign
    model = fitted(seen, ("reversal_drift", REVERSAL))
    ((place, decision),) = wrong_patterns(model, model.terms, library()).items()
    assert (place, decision.effect, decision.reason) == (0, "reversal_drift", Reason.WRONG_PATTERN)
    assert decision.evidence["p_value"] == pattern_p_value(model, model.terms[0]) < LEVEL


def free_statistic(model: ModelFit) -> float:
    """Reduction of the squared error by a size at every site, in units of the model's variance; the drift is hardly there."""
    y, x = model.fit.response, model.fit.design
    free = (BARE.site[:, None] == np.arange(14)) * COURSE[:, None]

    def squares(design: np.ndarray) -> float:
        residual = y - design @ np.linalg.lstsq(design, y, rcond=None)[0]
        return float(residual @ residual)

    return (squares(x) - squares(np.column_stack([x, free]))) / model.fit.sigma**2


@pytest.mark.parametrize("seed", [3, 4])
def test_one_target_of_its_own_does_not_make_a_pattern_wrong(seed):
    odd = np.where(BARE.target == 3, 0.2 * COURSE, 0.0)
    model = fitted(BENDING + odd, ("angular_growth", BENDING), seed=seed)
    # Thirteen sizes beside the term's own: with that target the pattern would be wrong.
    assert stats.chi2.sf(free_statistic(model), 13) < LEVEL
    assert wrong_patterns(model, model.terms, library()) == {}
    assert 0.01 < pattern_p_value(model, model.terms[0]) < 0.99


def test_two_targets_of_their_own_make_a_pattern_wrong():
    odd = COURSE * np.select([BARE.target == 3, BARE.target == 6], [0.2, -0.2], 0.0)
    model = fitted(BENDING + odd, ("angular_growth", BENDING))
    assert wrong_patterns(model, model.terms, library())[0].reason is Reason.WRONG_PATTERN
    # What is left of the statistic without the largest target is referred to two degrees of freedom fewer.
    statistic = free_statistic(model)
    assert stats.chi2.sf(statistic, 11) < pattern_p_value(model, model.terms[0]) < stats.chi2.sf(0.25 * statistic, 11)


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_a_course_that_is_uneven_between_visits_hides_no_wrong_pattern(seed):
    """Read at one target and interpolated, it is not the term's own course: the difference is no deviation of one target."""
    course = np.sin(BARE.seconds / 150.0)
    bending = course * BARE.share**2
    odd = course * np.select([BARE.target == 3, BARE.target == 6], [0.2, -0.2], 0.0)
    right, wrong = (fitted(seen, ("angular_growth", bending), seed=seed) for seen in (bending, bending + odd))
    assert pattern_p_value(wrong, wrong.terms[0]) < LEVEL < pattern_p_value(right, right.terms[0])


def test_an_event_has_no_pattern_to_be_tested():
    late = (BARE.seconds > 3000.0) * BARE.share
    readings = replace(BARE, response=np.where(BARE.target == 2, 5.0, 0.0) * (BARE.seconds > 3000.0))
    model = model_of(readings, [term(late, "step_event", event_s=3000.0)], ratios=QUIET)
    assert wrong_patterns(model, model.terms, library()) == {}


def test_two_patterns_with_one_course_are_one_pattern_without_a_name():
    """A bending and a reversal with the same course, sized so that together they come close to a stretch of one direction."""
    seen = COURSE * BARE.share**2 * (BARE.sign > 0)
    model = fitted(seen, ("angular_growth", BENDING), ("reversal_drift", REVERSAL))
    wrong = wrong_patterns(model, model.terms, library())
    assert [wrong[place].reason for place in (0, 1)] == [Reason.SHARED_PATTERN] * 2
    assert wrong[0].evidence == {"first": "angular_growth", "second": "reversal_drift"}


def test_two_patterns_with_courses_of_their_own_keep_their_names():
    other = OTHER_COURSE * 0.5 * BARE.sign
    model = fitted(BENDING + other, ("angular_growth", BENDING), ("reversal_drift", other))
    assert wrong_patterns(model, model.terms, library()) == {}


def test_an_effect_with_a_course_of_its_own_physics_shares_no_pattern():
    """A dead path is told by the index of air, not by its pattern, so that one common course is no objection."""
    flat = COURSE.copy()
    model = fitted(flat + REVERSAL, ("dead_path", flat), ("reversal_drift", REVERSAL))
    assert wrong_patterns(model, model.terms, library()) == {}


@pytest.mark.parametrize("size", [3.0, -3.0])
def test_the_course_of_two_columns_is_that_of_the_larger(size):
    """A wave along the axis has two columns; its course is read where the larger of them moves most."""
    waves = COURSE[:, None] * np.column_stack(
        [np.cos(2.0 * np.pi * BARE.position_mm / 150.0), np.sin(2.0 * np.pi * BARE.position_mm / 150.0)]
    )
    model = fitted(waves @ [size, 0.2], ("pitch_error", waves))
    assert pattern_p_value(model, model.terms[0]) > LEVEL
    wrong = fitted(COURSE * BARE.share**3 * size, ("pitch_error", waves))
    assert pattern_p_value(wrong, wrong.terms[0]) < LEVEL


def test_a_pattern_is_tested_without_its_largest_target_by_dense_algebra():
    """The same from normal equations: sizes of smallest norm, their shares of the statistic, two degrees of freedom fewer."""
    odd = COURSE * np.select([BARE.target == 3, BARE.target == 6], [0.12, -0.1], 0.0)
    model = fitted(BENDING + odd, ("angular_growth", BENDING))
    x, y = model.fit.design, model.fit.response
    free = (BARE.site[:, None] == np.arange(14)) * COURSE[:, None]
    free /= np.linalg.norm(free, axis=0)
    beside = free - x @ np.linalg.lstsq(x, free, rcond=None)[0]
    moment = beside.T @ y / model.fit.sigma
    share = (np.linalg.pinv(beside.T @ free, rcond=1e-6) @ moment) * moment
    by_target = share.reshape(7, 2).sum(axis=1)
    assert by_target.argmax() == 2
    expected = stats.chi2.sf(share.sum() - by_target.max(), 13 - 2)
    assert 1e-12 < expected < 0.1
    assert pattern_p_value(model, model.terms[0]) == pytest.approx(expected, rel=1e-2)


def test_two_patterns_are_one_where_free_sizes_gain_more_than_chance():
    """Twelve further sizes gain half a unit of log-likelihood each by chance."""
    shared, gains = [], []
    for seed in range(12):
        model = fitted(
            BENDING + REVERSAL, ("angular_growth", BENDING), ("reversal_drift", REVERSAL), seed=seed, noise_um=1.0
        )
        x, y = model.fit.design, model.fit.response
        free = np.column_stack([x[:, :-2], (BARE.site[:, None] == np.arange(14)) * COURSE[:, None]])
        squares = [((y - design @ np.linalg.lstsq(design, y, rcond=None)[0]) ** 2).sum() for design in (x, free)]
        gains.append(0.5 * y.size * np.log(squares[0] / squares[1]))
        wrong = wrong_patterns(model, model.terms, library())
        shared.append(any(decision.reason is Reason.SHARED_PATTERN for decision in wrong.values()))
    assert shared == [gain >= 6.0 for gain in gains]
    assert 0 < sum(shared) < 12


def test_the_course_is_that_of_the_column_that_moves_most_with_its_coefficient():
    """The second column moves a hundred times as much, but its coefficient is next to nothing."""
    columns = np.column_stack([COURSE * BARE.share, 100.0 * OTHER_COURSE * BARE.share])
    model = fitted(3.0 * COURSE * BARE.share**3, ("angular_growth", columns))
    assert abs(model.fit.coefficients[-1]) < 1e-2
    assert pattern_p_value(model, model.terms[0]) < LEVEL
