"""Admissibility: every check fires at its limit and not below it, in a fixed order."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from scipy import stats

from fusion.analysis.alignment.readings import Readings, Series
from fusion.analysis.drift_model.admissibility import (
    AxisGrounds,
    CandidateScorer,
    _centred_mean,
    heteroscedastic_interval,
    inconsistent_patterns,
    noise_share,
    pattern_p_value,
    refuse,
    refuse_in_heteroscedastic_drift,
    warm_up_share,
)
from fusion.analysis.drift_model.axis import AxisProblem, detection_limits, hold_out, shown_by_one_warm_up
from fusion.analysis.drift_model.model import ModelFit
from fusion.analysis.drift_model.search import TIE_GAIN, Decision, Reason, Score
from fusion.analysis.effects.effect import Candidate, Effect, warm_up
from fusion.analysis.effects.library import library
from fusion.analysis.levels import DENIAL_LEVEL
from fusion.results.loop import DetectionLimit
from tests.fusion.long_tests import long_test
from tests.fusion.small_campaign import campaign, logged, model_of, term

CANDIDATE = Candidate(np.zeros((2, 1)), {}, ("um",))


@dataclass
class Stated:
    """Grounds that are stated; what was asked is noted."""

    hours: float | None = None
    noise: tuple[str, float, float] = ("t1", 0.0, 0.01)
    single: Decision | None = None
    rate: bool = False
    advantage: float = 5.0
    heat: bool = True
    asked: list[str] = field(default_factory=list)

    def at_switching(self, candidate: Candidate) -> float | None:
        self.asked.append("switching")
        return self.hours

    def heat_is_logged(self) -> bool:
        self.asked.append("heat")
        return self.heat

    def noise_of_lag(self, candidate: Candidate) -> tuple[str, float, float]:
        self.asked.append("noise")
        return self.noise

    def refuse_single_excitation(self, effect: str, excited_by: str, candidate: Candidate) -> Decision | None:
        self.asked.append(f"single {excited_by}")
        return self.single

    def follows_rate(self, candidate: Candidate) -> bool:
        self.asked.append("rate")
        return self.rate

    def advantage_over_smoothing(self, candidate: Candidate) -> float:
        self.asked.append("smoothing")
        return self.advantage


WRONG = {"noise": ("t1", 1.0, 0.01), "rate": True, "advantage": -9.0}
SINGLE = Decision("a", Reason.SINGLE_WARM_UP, {"share_percent": 99.5, "gain": 1.0})


def noisy(percent: float) -> Decision:
    evidence = {"series": "t1", "noise_percent": pytest.approx(percent), "limit_percent": 1.0}
    return Decision("a", Reason.TEMPERATURE_NOISE, evidence)


#: What a lag is asked for, in this order.
OF_LAG = ["switching", "noise", "single field", "rate", "smoothing", "heat"]
OF_SOURCE = ["switching", "single driver"]


@pytest.mark.parametrize(
    ("excited_by", "stated", "decision", "asked"),
    [
        # An event at a switching is refused first; an effect that needs no switching is asked no more.
        ("field", {"hours": 2.5, **WRONG}, Decision("a", Reason.AT_SWITCHING, {"hours": 2.5}), OF_LAG[:1]),
        ("", {"hours": 0.0}, Decision("a", Reason.AT_SWITCHING, {"hours": 0.0}), OF_LAG[:1]),
        ("", {**WRONG, "heat": False}, None, OF_LAG[:1]),
        # A source is only asked for its excitation.
        ("driver", {**WRONG, "heat": False}, None, OF_SOURCE),
        ("driver", {"single": SINGLE}, SINGLE, OF_SOURCE),
        # A lag passes every check in turn, each at its limit.
        ("field", {}, None, OF_LAG),
        ("field", {"noise": ("t1", 0.01, 0.01), "advantage": 2.0}, None, OF_LAG),
        ("field", {"noise": ("t1", 0.0101, 0.01)}, noisy(1.01), OF_LAG[:2]),
        ("field", {"single": SINGLE, "rate": True}, SINGLE, OF_LAG[:3]),
        ("field", {"rate": True, "advantage": 0.0}, Decision("a", Reason.FOLLOWS_RATE, {"series": "t1"}), OF_LAG[:4]),
        (
            "field",
            {"advantage": 1.99},
            Decision("a", Reason.SMOOTHING, {"series": "t1", "advantage": 1.99}),
            OF_LAG[:5],
        ),
        # It is not told from heat that was not logged.
        ("field", {"heat": False}, Decision("a", Reason.UNLOGGED_HEAT), OF_LAG),
    ],
)
def test_an_effect_is_refused_by_the_first_check_that_it_fails(excited_by, stated, decision, asked):
    grounds = Stated(**stated)
    assert refuse("a", excited_by, CANDIDATE, grounds) == decision
    assert grounds.asked == asked


def test_a_campaign_logs_heat_where_it_has_a_driver():
    for drivers in ((), ("duty",)):
        readings = campaign(cycles=12, series={"duty": logged(np.arange(60.0), "1")}, drivers=drivers)
        assert AxisGrounds(model_of(readings)).heat_is_logged() is bool(drivers)


def test_the_noise_of_a_series_is_seen_beside_its_course():
    k = np.arange(40)
    # Second differences of an alternating 0.5 are +-2; those of independent noise scatter by sqrt(6) standard deviations.
    values = 0.5 * (-1.0) ** k + 3.0 * k
    assert noise_share(logged(values, "K")) == pytest.approx(1.4826 * 2.0 / np.sqrt(6.0) / np.ptp(values), rel=1e-5)
    assert noise_share(logged(3.0 * k, "K")) == pytest.approx(0.0, abs=1e-12)
    assert noise_share(logged(values[:4], "K")) == 1.0
    assert noise_share(logged(values[:5], "K")) < 1.0
    assert np.isfinite(noise_share(logged(np.ones(10), "K")))


def test_the_share_of_a_warm_up_is_that_of_the_best_time_constant_at_the_far_end():
    readings = campaign(cycles=40)
    plain = warm_up(readings, 20.0)
    assert warm_up_share(readings, Candidate(plain[:, None] - 3.0, {}, ("um",))) > 0.999
    wave = np.sin(readings.seconds / 200.0)
    assert warm_up_share(readings, Candidate(wave[:, None], {}, ("um",))) < 0.2
    # A candidate of two columns is as free as the freer of them.
    both = Candidate(np.column_stack([plain, wave]), {}, ("um", "um"))
    assert warm_up_share(readings, both) < 0.2
    # Only the target with the largest position counts.
    elsewhere = np.where(readings.position_mm < 400.0, wave, plain)
    assert warm_up_share(readings, Candidate(elsewhere[:, None], {}, ("um",))) > 0.999


def test_the_share_of_a_warm_up_is_the_share_of_variance():
    readings = campaign(cycles=60)
    plain = warm_up(readings, 20.0)
    far = readings.position_mm == 400.0
    wave = np.sin(readings.seconds / 97.0)
    wave -= wave[far].mean()
    mixed = plain + 0.1 * wave
    left = min(
        np.linalg.lstsq(np.column_stack([np.ones(far.sum()), warm_up(readings, minutes)[far]]), mixed[far], rcond=None)[
            1
        ][0]
        for minutes in np.geomspace(5.0, 400.0, 40)
    )
    expected = 1.0 - left / ((mixed[far] - mixed[far].mean()) ** 2).sum()
    assert warm_up_share(readings, Candidate(mixed[:, None], {}, ("um",))) == pytest.approx(expected)


def field_of(course: np.ndarray, *, samples: int = 300) -> dict[str, Series]:
    """A table whose rise is uniform along the axis."""
    positions = np.array([100.0, 200.0, 300.0, 400.0])
    seconds = 20.0 * np.arange(samples)
    return {
        "mean_rise": Series(seconds, course, "K"),
        "axis_integral": Series(seconds, course[:, None] * positions, "K mm"),
    }


def switched(*, samples: int = 300) -> np.ndarray:
    """A temperature that follows a load which is switched at random times."""
    load = np.repeat(np.random.default_rng(4).integers(0, 2, samples // 10), 10).astype(float)
    return Series(20.0 * np.arange(samples), load, "1").lagged(400.0, at_rest=0.0).values


def seen(course: np.ndarray) -> Readings:
    return campaign(cycles=40, series=field_of(course))


def lagged(readings: Readings, minutes: float) -> np.ndarray:
    return readings.at(readings.series["mean_rise"].lagged(60.0 * minutes))


def lag_of(readings: Readings, minutes: float) -> Candidate:
    return Candidate(lagged(readings, minutes)[:, None], {"time_constant_min": minutes}, ("um/K",))


def test_a_single_warm_up_needs_a_quieter_temperature():
    alternating = 2e-3 * (-1.0) ** np.arange(300)
    quiet = seen(switched() + alternating)
    name, noise, limit = AxisGrounds(model_of(quiet)).noise_of_lag(lag_of(quiet, 10.0))
    assert (name, limit) == ("the mean rise", 0.01)
    assert noise == noise_share(quiet.series["mean_rise"])
    single = seen(1.0 - np.exp(-20.0 * np.arange(300) / 1200.0))
    assert AxisGrounds(model_of(single)).noise_of_lag(lag_of(single, 10.0))[2] == 0.003


def test_what_a_plain_warm_up_explains_is_refused_unless_it_gains_beside_free_ones(rng):
    readings = seen(1.0 - np.exp(-20.0 * np.arange(300) / 1200.0))
    noise = 0.1 * rng.standard_normal(readings.seconds.size)
    candidate = Candidate(warm_up(readings, 20.0)[:, None], {}, ("um",))
    drifting = replace(readings, response=3.0 * candidate.columns[:, 0] + noise)
    decision = AxisGrounds(model_of(drifting)).refuse_single_excitation("thermal_lag", "field", candidate)
    assert decision is not None and decision.reason is Reason.SINGLE_WARM_UP
    assert decision.effect == "thermal_lag"
    assert decision.evidence["share_percent"] > 99.9 and decision.evidence["gain"] < 4.0
    # The same warm-up with a wave on it that no free warm-up follows: 0.6 % of its variance, and plainly seen.
    wave = 0.03 * np.sin(readings.seconds / 97.0)
    waved = Candidate((warm_up(readings, 20.0) + wave)[:, None], {}, ("um",))
    assert warm_up_share(readings, waved) > 0.99
    following = replace(readings, response=30.0 * waved.columns[:, 0] + noise)
    assert AxisGrounds(model_of(following)).refuse_single_excitation("thermal_lag", "field", waved) is None


@pytest.mark.parametrize(
    ("size", "wave", "alone"),
    [(3.0, 0.0, True), (30.0, 0.03, False), (0.0, 0.0, False)],
    ids=["seen", "waved", "not seen"],
)
def test_a_declared_effect_that_only_one_warm_up_shows_is_told(rng, size, wave, alone):
    """Not one that a wave shows as well, nor one that the readings do not show at all."""
    readings = seen(1.0 - np.exp(-20.0 * np.arange(300) / 1200.0))
    course = warm_up(readings, 20.0) + wave * np.sin(readings.seconds / 97.0)
    noise = 0.1 * rng.standard_normal(readings.seconds.size)
    model = model_of(replace(readings, response=size * course + noise), [term(course, "table_offset")])
    assert shown_by_one_warm_up(model, 1) == (("table_offset",) if alone else ())


@pytest.mark.parametrize(
    ("delayed", "rate"), [(-0.45, False), (-0.55, True), (-1.0, True), (-1.9, True), (-2.1, False), (0.8, False)]
)
def test_a_field_that_its_delayed_copy_nearly_cancels_is_a_rate(delayed, rate):
    """Without noise the fit gives back both coefficients: their sum is held against half the larger."""
    bare = seen(switched())
    rise = bare.at(bare.series["mean_rise"])
    readings = replace(bare, response=rise + delayed * lagged(bare, 10.0))
    model = model_of(readings, [term(rise, "table_offset", units=("um/K",))])
    assert AxisGrounds(model).follows_rate(lag_of(readings, 10.0)) is rate


def test_a_lag_along_the_axis_is_held_against_the_expansion():
    bare = seen(switched())
    rise = bare.at(bare.series["mean_rise"])
    readings = replace(bare, response=bare.position_mm * 1e-3 * (rise - 0.9 * lagged(bare, 10.0)))
    terms = [
        term(rise, "table_offset", units=("um/K",)),
        term(rise * bare.position_mm * 1e-3, "axis_expansion", units=("ppm/K",)),
    ]
    linear = Candidate((lagged(readings, 10.0) * readings.position_mm * 1e-3)[:, None], {}, ("ppm/K",))
    both = Candidate(np.column_stack([lagged(readings, 10.0), linear.columns[:, 0]]), {}, ("um/K", "ppm/K"))
    assert AxisGrounds(model_of(readings, terms)).follows_rate(linear)
    assert AxisGrounds(model_of(readings, terms)).follows_rate(both)
    # Without the direct effect in the model there is nothing to cancel.
    assert not AxisGrounds(model_of(readings, terms[:1])).follows_rate(linear)


def test_a_delayed_copy_gains_over_one_that_is_only_smoothed_where_there_is_a_lag(rng):
    bare = seen(switched())
    noise = 0.01 * rng.standard_normal(bare.seconds.size)
    late = replace(bare, response=lagged(bare, 10.0) + noise)
    grounds = AxisGrounds(model_of(late))
    assert grounds.advantage_over_smoothing(lag_of(late, 10.0)) > 50.0
    series = bare.series["mean_rise"]
    near = np.abs(series.seconds[:, None] - series.seconds) <= 600.0
    smooth = Series(series.seconds, (near * series.values).sum(axis=1) / near.sum(axis=1), "K")
    denoised = replace(bare, response=bare.at(smooth) + noise)
    assert AxisGrounds(model_of(denoised)).advantage_over_smoothing(lag_of(denoised, 10.0)) < -50.0


def test_only_the_readings_of_the_fit_count():
    readings = seen(1.0 - np.exp(-20.0 * np.arange(300) / 1200.0))
    used = readings.cycle <= 32
    # A warm-up in the used cycles; what happens later is not looked at.
    column = np.where(used, warm_up(readings, 20.0), np.sin(readings.seconds))
    grounds = AxisGrounds(model_of(readings, used=used))
    assert grounds.noise_of_lag(Candidate(column[:, None], {}, ("um/K",)))[2] == 0.003


def test_a_centred_mean_is_that_of_all_samples_in_its_window(rng):
    seconds = np.sort(rng.uniform(0.0, 900.0, 40))
    values = 1e6 + rng.standard_normal((40, 2))
    told = _centred_mean(Series(seconds, values, "K"), 100.0)
    expected = [values[np.abs(seconds - at) <= 100.0].mean(axis=0) for at in seconds]
    np.testing.assert_allclose(told.values, expected, rtol=1e-13)
    alone = _centred_mean(Series(seconds, values[:, 0], "K"), 100.0)
    np.testing.assert_array_equal(alone.values, told.values[:, 0])


# Patterns along the axis: the right one passes, the nearest one is denied its name.


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


def test_a_stretch_that_differs_by_direction_is_no_reversal():
    """The nearest effect of the library is found, but its pattern is the wrong one."""
    seen = COURSE * BARE.share * BARE.sign
    model = fitted(seen, ("reversal_drift", REVERSAL))
    ((place, decision),) = inconsistent_patterns(model, model.terms, library()).items()
    assert (place, decision.effect, decision.reason) == (0, "reversal_drift", Reason.INCONSISTENT_PATTERN)
    assert decision.evidence["p_value"] == pattern_p_value(model, model.terms[0]) < DENIAL_LEVEL


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
    assert stats.chi2.sf(free_statistic(model), 13) < DENIAL_LEVEL
    assert inconsistent_patterns(model, model.terms, library()) == {}
    assert 0.01 < pattern_p_value(model, model.terms[0]) < 0.99


@pytest.mark.parametrize("seed", [3, 5])
def test_a_course_that_is_uneven_between_visits_hides_no_wrong_pattern(seed):
    """Read at one target and interpolated, it is not the term's own course: the difference is no deviation of one target."""
    course = np.sin(BARE.seconds / 150.0)
    bending = course * BARE.share**2
    odd = course * np.select([BARE.target == 3, BARE.target == 6], [0.2, -0.2], 0.0)
    right, wrong = (fitted(seen, ("angular_growth", bending), seed=seed) for seen in (bending, bending + odd))
    assert pattern_p_value(wrong, wrong.terms[0]) < DENIAL_LEVEL < pattern_p_value(right, right.terms[0])


def test_an_event_has_no_pattern_to_be_tested():
    late = (BARE.seconds > 3000.0) * BARE.share
    readings = replace(BARE, response=np.where(BARE.target == 2, 5.0, 0.0) * (BARE.seconds > 3000.0))
    model = model_of(readings, [term(late, "step_event", event_s=3000.0)], ratios=QUIET)
    assert inconsistent_patterns(model, model.terms, library()) == {}


def test_two_patterns_with_one_course_are_one_pattern_without_a_name():
    """A bending and a reversal with the same course, sized so that together they come close to a stretch of one direction."""
    seen = COURSE * BARE.share**2 * (BARE.sign > 0)
    model = fitted(seen, ("angular_growth", BENDING), ("reversal_drift", REVERSAL))
    wrong = inconsistent_patterns(model, model.terms, library())
    assert [wrong[place].reason for place in (0, 1)] == [Reason.SHARED_PATTERN] * 2
    assert wrong[0].evidence == {"first": "angular_growth", "second": "reversal_drift"}


def test_two_patterns_with_courses_of_their_own_keep_their_names():
    other = OTHER_COURSE * 0.5 * BARE.sign
    model = fitted(BENDING + other, ("angular_growth", BENDING), ("reversal_drift", other))
    assert inconsistent_patterns(model, model.terms, library()) == {}


def test_an_effect_with_a_course_of_its_own_physics_shares_no_pattern():
    """A dead path is told by the index of air, not by its pattern, so that one common course is no objection."""
    flat = COURSE.copy()
    model = fitted(flat + REVERSAL, ("dead_path", flat), ("reversal_drift", REVERSAL))
    assert inconsistent_patterns(model, model.terms, library()) == {}


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
        wrong = inconsistent_patterns(model, model.terms, library())
        shared.append(any(decision.reason is Reason.SHARED_PATTERN for decision in wrong.values()))
    assert shared == [gain >= 6.0 for gain in gains]
    assert 0 < sum(shared) < 12


def test_the_course_is_that_of_the_column_that_moves_most_with_its_coefficient():
    """The second column moves a hundred times as much, but its coefficient is next to nothing."""
    columns = np.column_stack([COURSE * BARE.share, 100.0 * OTHER_COURSE * BARE.share])
    model = fitted(3.0 * COURSE * BARE.share**3, ("angular_growth", columns))
    assert abs(model.fit.coefficients[-1]) < 1e-2
    assert pattern_p_value(model, model.terms[0]) < DENIAL_LEVEL


# Detection limits: they scale with the noise, follow from the critical gain, and say what looks alike.


SHORT = campaign(cycles=20, positions_mm=(100.0, 150.0, 200.0, 250.0, 300.0, 350.0))
QUICK = np.sign(np.sin(2.3 * np.arange(SHORT.seconds.size)))
TURNS = 0.5 * SHORT.sign * np.sin(SHORT.seconds / 150.0)
CRITICAL = 6.0


def model(*, scale: float = 1.0, terms: tuple = (), used: np.ndarray | None = None) -> ModelFit:
    noise = 0.1 * np.random.default_rng(8).standard_normal(SHORT.seconds.size)
    return model_of(replace(SHORT, response=scale * noise), terms, used)


def limits_of(fitted: ModelFit, families: dict[str, list[Candidate]], **effects: Effect) -> dict[str, DetectionLimit]:
    scorer = CandidateScorer.of(fitted, np.random.default_rng(1))
    scores = [Score(name, None, critical=CRITICAL) for name in families]
    known = {name: effects.get(name, Effect(name, "", "", lambda *_: iter(()))) for name in families}
    products = scorer.products([one for candidates in families.values() for one in candidates])
    return {limit.effect: limit for limit in detection_limits(scorer, products, fitted, families, scores, known)}


def candidate(columns: np.ndarray, **changes) -> Candidate:
    columns = columns if columns.ndim == 2 else columns[:, None]
    return Candidate(columns, {}, ("um",) * columns.shape[1], **changes)


def test_the_limit_is_the_size_whose_expected_gain_has_eighty_percent_power():
    """A pattern by direction that changes quickly is beyond any drift: sigma squared and the design alone set its limit."""
    column = 0.5 * SHORT.sign * QUICK
    fitted = model()
    told = limits_of(fitted, {"a": [candidate(column)]})["a"]
    n, p = fitted.fit.design.shape
    # n/2 log(1 + size**2 E / S) reaches (sqrt(2 c) + 0.84)**2 / 2, with E and S beside the model.
    wanted = 0.5 * (np.sqrt(2.0 * CRITICAL) + 0.84) ** 2
    q, _ = np.linalg.qr(fitted.fit.design)
    energy = ((column - q @ (q.T @ column)) ** 2).sum()
    squares = (n - p) * fitted.fit.sigma**2
    size = np.sqrt(np.expm1(2.0 * wanted / n) * squares / energy)
    site_means = np.array([column[SHORT.site == site].mean() for site in range(12)])
    rms = np.sqrt(np.mean((column - site_means[SHORT.site]) ** 2))
    assert told.detectable_um == pytest.approx(size * rms, rel=0.1)
    assert told.best_um == told.worst_um == told.detectable_um
    assert told.visible_share == pytest.approx(1.0, abs=1e-9)


def test_the_limits_of_an_effect_are_median_best_and_worst_of_its_candidates():
    columns = [TURNS, np.sin(SHORT.seconds / 600.0), 0.5 * SHORT.sign * QUICK]
    alone = [limits_of(model(), {"a": [candidate(column)]})["a"].detectable_um for column in columns]
    told = limits_of(model(), {"a": [candidate(column) for column in columns]})["a"]
    assert told.best_um == pytest.approx(min(alone)) and told.worst_um == pytest.approx(max(alone))
    assert told.detectable_um == pytest.approx(np.median(alone))


def test_what_the_model_contains_or_what_never_moves_cannot_be_found():
    declared = term(TURNS, "declared")
    # A constant load differs from its mean by rounding.
    for column, share in ((3.0 * TURNS, 0.0), (np.zeros(SHORT.seconds.size), None), (0.3 + 0.0 * TURNS, None)):
        told = limits_of(model(terms=(declared,)), {"a": [candidate(column)]})["a"]
        assert (told.detectable_um, told.best_um, told.worst_um) == (None, None, None)
        assert told.note == "the declared model contains it, or nothing excites it"
        assert told.visible_share == (None if share is None else pytest.approx(share, abs=1e-6))


def test_the_visible_share_is_what_is_left_beside_the_declared_effects():
    other = 0.5 * SHORT.sign * np.cos(SHORT.seconds / 150.0)
    half = TURNS + other
    fitted = model(terms=(term(other),))
    told = limits_of(fitted, {"a": [candidate(half)]})["a"]
    q, _ = np.linalg.qr(fitted.fit.design)
    site_means = np.array([half[SHORT.site == site].mean() for site in range(12)])
    expected = np.linalg.norm(half - q @ (q.T @ half)) / np.linalg.norm(half - site_means[SHORT.site])
    assert told.visible_share == pytest.approx(expected, rel=1e-9)
    assert 0.4 < told.visible_share < 0.9


@pytest.mark.parametrize(("mixing", "alike"), [(0.30, True), (0.36, False)])
def test_effects_look_alike_from_nine_tenths_of_the_variance_on(mixing, alike):
    """Of a + m b, a explains 1 / (1 + m**2) where b is as large and independent: 0.917 and 0.885."""
    rng = np.random.default_rng(2)
    first, second = (0.5 * SHORT.sign * np.sign(rng.standard_normal(SHORT.seconds.size)) for _ in range(2))
    q, _ = np.linalg.qr(np.column_stack([model().fit.design, first]))
    second = second - q @ (q.T @ second)
    second *= np.linalg.norm(first) / np.linalg.norm(second)
    told = limits_of(model(), {"pure": [candidate(first)], "mixed": [candidate(first + mixing * second)]})
    assert told["mixed"].confounded_with == (("pure",) if alike else ())
    assert told["pure"].confounded_with == (("mixed",) if alike else ())


def test_what_may_be_present_without_an_effect_does_not_make_it_alike():
    told = limits_of(
        model(), {"a": [candidate(TURNS)], "b": [candidate(np.column_stack([QUICK * SHORT.sign, TURNS]), beside=1)]}
    )
    assert told["a"].confounded_with == ()
    without = limits_of(
        model(), {"a": [candidate(TURNS)], "b": [candidate(np.column_stack([QUICK * SHORT.sign, TURNS]))]}
    )
    assert without["a"].confounded_with == ("b",)


def test_a_single_warm_up_limits_an_effect_that_needs_switching():
    plain = candidate(warm_up(SHORT, 15.0))
    source = Effect("source", "", "", lambda *_: iter(()), excited_by="driver")
    told = limits_of(model(), {"source": [plain], "other": [plain]}, source=source)
    assert (
        told["source"].note == "one warm-up is all that excites it; switch the load on purpose to tell it from others"
    )
    assert told["other"].note == ""
    free = limits_of(model(), {"source": [candidate(TURNS)]}, source=source)
    assert free["source"].note == ""


def test_evenly_spaced_targets_limit_a_pitch_error():
    told = limits_of(model(), {"pitch_error": [candidate(TURNS)]}, pitch_error=library()["pitch_error"])
    assert told["pitch_error"].note.startswith("evenly spaced targets hide leads of 50, 25, 16.7")
    assert told["pitch_error"].note.endswith("space them unevenly to see all")


def test_a_pattern_of_the_hold_out_set_alone_cannot_be_found():
    """A pattern that moves after the training part alone cannot be found."""
    used = SHORT.cycle <= 12
    told = limits_of(model(used=used), {"a": [candidate(np.where(used, 0.0, TURNS))]})["a"]
    assert told.detectable_um is None


# An event beside restless drift: a warm-up that the drift's variance does not allow is no step, and a step is no warm-up.


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
    assert refusal.reason is Reason.HETEROSCEDASTIC_DRIFT
    # Twice the time constant of 1.5 h, within the factor of two between two durations that are tried.
    assert refusal.evidence["start_h"] == 0.0 and 1.5 <= refusal.evidence["end_h"] <= 6.0
    assert refusal.evidence["times"] > 3.0
    assert "drift that moved" in refusal.sentence


def test_a_step_in_a_quiet_drift_keeps_its_name():
    problem, state, score = first_step(long_test("walk", 200, 3, step_um=1.0))
    assert score.family_wise_p <= 0.02
    assert problem.refuse(score, state.model) is None
    time = heteroscedastic_interval(state.model, score.best.event_s)
    assert time.start_s < score.best.event_s < time.end_s
    # A fast drift of some cycles explains a part of a step.
    assert 0.0 < time.gain < score.gain - TIE_GAIN


def test_the_odds_are_twenty_to_one(warming):
    _, state, score = warming
    time = heteroscedastic_interval(state.model, score.best.event_s)
    better = replace(score, gain=time.gain + TIE_GAIN + 0.01)
    assert refuse_in_heteroscedastic_drift(better, state.model) is None
    as_good = refuse_in_heteroscedastic_drift(replace(score, gain=time.gain + TIE_GAIN - 0.01), state.model)
    assert as_good.evidence["advantage"] == pytest.approx(TIE_GAIN - 0.01)


def test_an_effect_that_lasts_is_not_asked(warming):
    _, state, _ = warming
    lasting = Score("reversal_drift", Candidate(np.zeros((1, 1)), {}, ("um",)))
    assert refuse_in_heteroscedastic_drift(lasting, state.model) is None
