"""An event beside restless drift: a warm-up that the drift's variance does not allow is no step, and a step is no warm-up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.effects.effect import Candidate
from fusion.effects.library import library
from fusion.loop.axis import AxisProblem, hold_out
from fusion.loop.decisions import Reason
from fusion.loop.restless_drift import refuse_in_restless_drift, restless_time
from fusion.loop.state import TIE_GAIN, Score
from fusion.model.fit import fit_model
from tests.fusion.long_tests import long_test


def first_step(readings):
    """The problem, its state before the search, and the score of a step in the first round."""
    used, _ = hold_out(readings)
    problem = AxisProblem(readings, used, {"step_event": library()["step_event"]}, np.random.default_rng(1))
    state = problem.start([])
    (score,) = problem.score(state).scores
    return problem, state, score


@pytest.fixture(scope="module")
def warming():
    """Three days that begin with a warm-up of some hours: the model's drift is too slow for these and too fast for the rest."""
    return first_step(long_test("warm-up", 1000, 8))


def test_the_warm_up_of_a_long_test_is_no_step(warming):
    problem, state, score = warming
    assert score.family_wise_p <= 0.02
    refusal = problem.refuse(score, state.model)
    assert refusal.reason is Reason.RESTLESS_DRIFT
    # Twice the time constant of 1.5 h, within the factor of two between two durations that are tried.
    assert refusal.evidence["start_h"] == 0.0 and 1.5 <= refusal.evidence["end_h"] <= 6.0
    assert refusal.evidence["times"] > 3.0
    assert "drift that moved" in refusal.sentence


def test_a_step_in_a_quiet_drift_keeps_its_name():
    problem, state, score = first_step(long_test("walk", 200, 3, step_um=1.0))
    assert score.family_wise_p <= 0.02
    assert problem.refuse(score, state.model) is None
    time = restless_time(state.model, score.best.event_s)
    assert time.start_s < score.best.event_s < time.end_s
    # A fast drift of some cycles explains a part of a step.
    assert 0.0 < time.gain < score.gain - TIE_GAIN


def test_the_odds_are_twenty_to_one(warming):
    _, state, score = warming
    time = restless_time(state.model, score.best.event_s)
    better = replace(score, gain=time.gain + TIE_GAIN + 0.01)
    assert refuse_in_restless_drift(better, state.model) is None
    as_good = refuse_in_restless_drift(replace(score, gain=time.gain + TIE_GAIN - 0.01), state.model)
    assert as_good.evidence["advantage"] == pytest.approx(TIE_GAIN - 0.01)


def test_drift_of_even_variance_is_not_restless():
    model = fit_model(long_test("walk", 60, 4), ())
    # Three numbers more, chosen among dozens: a gain beyond 5 has odds of a hundred to one.
    assert restless_time(model, 0.5 * model.readings.seconds[-1]).gain < 5.0


def test_an_effect_that_lasts_is_not_asked(warming):
    _, state, _ = warming
    lasting = Score("reversal_drift", Candidate(np.zeros((1, 1)), {}, ("um",)))
    assert refuse_in_restless_drift(lasting, state.model) is None
