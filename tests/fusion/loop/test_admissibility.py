"""Admissibility: every check fires at its limit and not below it, in a fixed order."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from fusion.alignment.readings import Readings, Series
from fusion.effects.effect import Candidate
from fusion.effects.states import warm_up
from fusion.loop.admissibility import AxisGrounds, _centred_mean, noise_share, refuse, warm_up_share
from fusion.loop.decisions import Decision, Reason
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


def test_an_event_at_a_switching_is_refused_first():
    decision = refuse("step_event", "field", CANDIDATE, Stated(hours=2.5, noise=("t1", 1.0, 0.01)))
    assert decision == Decision("step_event", Reason.AT_SWITCHING, {"hours": 2.5})
    assert refuse("step_event", "", CANDIDATE, Stated(hours=0.0)).reason is Reason.AT_SWITCHING


def test_an_effect_that_needs_no_switching_is_asked_no_more():
    grounds = Stated(noise=("t1", 1.0, 0.01), rate=True, advantage=-9.0)
    assert refuse("dead_path", "", CANDIDATE, grounds) is None
    assert grounds.asked == ["switching"]


def test_a_source_is_only_asked_for_its_excitation():
    grounds = Stated(noise=("t1", 1.0, 0.01), rate=True, advantage=-9.0)
    assert refuse("unseen_heat_source", "driver", CANDIDATE, grounds) is None
    assert grounds.asked == ["switching", "single driver"]
    single = Decision("unseen_heat_source", Reason.SINGLE_SWITCHING, {"driver": "duty", "share_percent": 99.5})
    assert refuse("unseen_heat_source", "driver", CANDIDATE, Stated(single=single)) is single


def test_a_lag_passes_every_check_in_turn():
    grounds = Stated()
    assert refuse("thermal_lag", "field", CANDIDATE, grounds) is None
    assert grounds.asked == ["switching", "noise", "single field", "rate", "smoothing", "heat"]


def test_a_lag_is_not_told_from_heat_that_was_not_logged():
    decision = refuse("thermal_lag", "field", CANDIDATE, Stated(heat=False))
    assert decision == Decision("thermal_lag", Reason.UNLOGGED_HEAT)
    assert refuse("unseen_heat_source", "driver", CANDIDATE, Stated(heat=False)) is None
    assert refuse("dead_path", "", CANDIDATE, Stated(heat=False)) is None


def test_a_campaign_logs_heat_where_it_has_a_driver():
    for drivers in ((), ("duty",)):
        readings = campaign(cycles=12, series={"duty": logged(np.arange(60.0), "1")}, drivers=drivers)
        assert AxisGrounds(model_of(readings)).heat_is_logged() is bool(drivers)


@pytest.mark.parametrize(("noise", "refused"), [(0.01, False), (0.0101, True)])
def test_a_lag_of_a_noisy_temperature_is_refused(noise, refused):
    decision = refuse("thermal_lag", "field", CANDIDATE, Stated(noise=("the mean rise", noise, 0.01)))
    assert (decision is not None) is refused
    if decision is not None:
        assert decision == Decision(
            "thermal_lag",
            Reason.TEMPERATURE_NOISE,
            {"series": "the mean rise", "noise_percent": pytest.approx(1.01), "limit_percent": 1.0},
        )


def test_a_lag_that_was_excited_once_or_follows_the_rate_is_refused():
    single = Decision("thermal_lag", Reason.SINGLE_WARM_UP, {"share_percent": 99.5, "gain": 1.0})
    assert refuse("thermal_lag", "field", CANDIDATE, Stated(single=single, rate=True)) is single
    assert refuse("thermal_lag", "field", CANDIDATE, Stated(rate=True, advantage=0.0)) == Decision(
        "thermal_lag", Reason.FOLLOWS_RATE, {"series": "t1"}
    )


@pytest.mark.parametrize(("advantage", "refused"), [(2.0, False), (1.99, True)])
def test_a_lag_that_only_smooths_is_refused(advantage, refused):
    decision = refuse("thermal_lag", "field", CANDIDATE, Stated(advantage=advantage))
    assert (decision is not None) is refused
    if decision is not None:
        assert decision == Decision("thermal_lag", Reason.SMOOTHING, {"series": "t1", "advantage": 1.99})


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


def test_a_load_that_is_switched_between_cycles_leaves_an_event_its_instant():
    readings = campaign()
    assert AxisGrounds(model_of(readings)).at_switching(CANDIDATE) is None


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


def test_a_candidate_that_is_no_warm_up_is_not_refused_for_one():
    readings = seen(switched())
    candidate = Candidate(np.sin(readings.seconds / 200.0)[:, None], {}, ("um",))
    assert AxisGrounds(model_of(readings)).refuse_single_excitation("thermal_lag", "field", candidate) is None


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
