"""Causes of anomalous targets: each is named where its effect is large, none where the data do not decide."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from fusion.analysis.diagnosis import diagnose as module
from fusion.analysis.diagnosis.causes import undetermined_check
from fusion.analysis.diagnosis.diagnose import (
    THRESHOLDS,
    _agreement,
    _directions,
    _objections,
    _probabilities,
    diagnose,
)
from fusion.analysis.diagnosis.explanations import DiagnosisError
from tests.fusion import field_simulator as simulator
from tests.fusion.residual_simulator import CAUSES, odd_position
from tests.fusion.twin_sessions import Flag


@pytest.mark.parametrize("cause", ["structural", "local_temperature", "step", "stick_slip", "one_direction", "slow"])
def test_a_plain_effect_gets_its_name(cause):
    """0.6 um rms beside 0.4 um of noise, twice the size for which the thresholds are set."""
    named = [
        diagnose(odd_position(cause, np.random.default_rng([seed, 5]), rms_um=0.6), [Flag(3)])[0].cause
        for seed in range(3)
    ]
    assert named.count(CAUSES[cause]) >= 2, named
    assert "local_temperature" not in named or cause == "local_temperature"


def diagnosed(fused, course_um):
    """The diagnosis of target 3 that follows a course (cycles,) in both directions."""
    fused["deviation"][:, :, 2] += course_um[:, None]
    return diagnose(fused, [Flag(3)])[0]


def test_the_step_is_dated_and_measured(rng):
    fused = odd_position("structural", rng, rms_um=0.0)
    diagnosis = diagnosed(fused, 1.0 * (np.arange(100) >= 60))
    assert diagnosis.cause == "step"
    # The first reading after the step is that of cycle 61.
    assert abs(diagnosis.evidence["step_cycle"] - 61) <= 1
    assert diagnosis.evidence["step_um"] == pytest.approx(1.0, abs=4 * diagnosis.evidence["step_u_um"])
    expanded = f"± {2 * diagnosis.evidence['step_u_um']:.2f} µm (k = 2)"
    assert any("step of +" in sentence and expanded in sentence for sentence in diagnosis.for_it)
    assert diagnosis.check == module.CAUSES["step"].check


def test_sensitivity_and_lag_of_a_local_temperature(rng):
    fused = odd_position("structural", rng, rms_um=0.0)
    rise = fused["local_rise_series"].values[:, 2]
    response = simulator.first_order(rise - rise[0], 1800.0)
    diagnosis = diagnosed(fused, 0.3 * response)
    assert diagnosis.cause == "local_temperature"
    assert diagnosis.evidence["temperature_lag_s"] == 1800.0
    u = diagnosis.evidence["temperature_u_um_per_K"]
    assert diagnosis.evidence["temperature_um_per_K"] == pytest.approx(0.3, abs=4 * u)
    assert diagnosis.evidence["temperature_held_out_nats"] > 0


def test_a_local_warm_up_is_not_called_a_cause(rng):
    fused = odd_position("structural", rng, rms_um=0.0)
    warm = 3.0 * (1 - np.exp(-np.arange(100) * simulator.PERIOD_S / 4500.0))
    fused["local_rise_series"] = (("frame_time", "target"), np.tile(warm[:, None], (1, 16)))
    diagnosis = diagnosed(fused, warm)
    assert diagnosis.cause == "undetermined"
    assert diagnosis.evidence["temperature_warm_up_share"] > 0.98


def test_without_a_camera_the_other_causes_are_still_compared(rng):
    fused = odd_position("structural", rng, rms_um=0.6).drop_vars("local_rise_series")
    diagnosis = diagnose(fused, [Flag(3)])[0]
    assert diagnosis.cause == "structural"
    assert "temperature_p" not in diagnosis.evidence


def test_one_direction_alone_can_be_diagnosed(rng):
    fused = odd_position("step", rng, rms_um=0.8).sel(direction=["positive"])
    diagnosis = diagnose(fused, [Flag(3, "positive")])[0]
    assert diagnosis.evidence["probability_step"] > 0.5
    assert np.isnan(diagnosis.evidence["step_held_out_nats"])


def test_probabilities_sum_to_one_and_follow_the_anomalies(rng):
    fused = odd_position("structural", rng)
    diagnoses = diagnose(fused, [Flag(3), Flag(7, "positive"), Flag(3, "negative")])
    assert [(d.target, d.direction) for d in diagnoses] == [(3, "both"), (7, "positive"), (3, "negative")]
    for diagnosis in diagnoses:
        total = sum(
            value for name, value in diagnosis.evidence.items() if name.startswith("probability_") and value is not None
        )
        assert total == pytest.approx(1.0)
        assert diagnosis.cause == "undetermined" or diagnosis.probability >= THRESHOLDS[diagnosis.cause]


@pytest.mark.parametrize(
    ("flags", "cycles", "message"),
    [
        ([40], 100, r"target 40 is not among the measured targets \[1, 2, 3"),
        (range(1, 15), 100, "only 2 targets are free of anomalies"),
        ([3], 8, "target 3 has readings in 8 cycles; a diagnosis needs 12"),
    ],
)
def test_what_cannot_be_diagnosed_is_named(rng, flags, cycles, message):
    fused = odd_position("structural", rng).isel(cycle=slice(0, cycles))
    with pytest.raises(DiagnosisError, match=message):
        diagnose(fused, [Flag(target) for target in flags])


EQUAL = "standard deviations equal within their uncertainty: "
BOTH = "1.00 µm in the positive direction, {:.2f} µm in the negative direction"


@pytest.mark.parametrize(
    ("readings", "negative_um", "sentence"),
    [
        # 51 readings each: u = s / 10, so that 1.00 and 1.30 differ by 0.30 and agree within 2 * hypot(0.10, 0.13) = 0.33.
        (51, 1.3, EQUAL + BOTH),
        (51, 1.4, "standard deviation " + BOTH),
        (51, np.nan, "directions not compared: fewer than two readings in one of them"),
        # Nine readings each, eight degrees of freedom: u = s / 4, so that 1.00 and 0.46 agree within 2 * hypot(0.25, 0.115) = 0.55.
        (9, 0.46, EQUAL + BOTH),
        (9, 0.44, "standard deviation " + BOTH),
    ],
)
def test_directions_are_called_equal_only_within_their_uncertainty(readings, negative_um, sentence):
    row = np.resize([1.0, -1.0], readings)
    residual = SimpleNamespace(values=np.stack([row, negative_um * row]), scatter_um=(1.0, negative_um))
    assert _directions(_agreement(residual), residual) == sentence.format(negative_um)


def fitted(**changes):
    """A case of which nothing is wrong: a local temperature and a step that their tests accept and the other direction confirms."""
    profile = SimpleNamespace(p_value=0.001, hold_out_gain=3.0, log_likelihood=0.0, by_direction=(0.3, 0.2))
    temperature, step = (
        SimpleNamespace(**{**vars(profile), **changes.pop(name, {})}) for name in ("temperature", "step")
    )
    case = SimpleNamespace(
        residual=SimpleNamespace(seconds=np.arange(100.0)),
        random_walk=SimpleNamespace(white=0.0, shared=0.0, one_direction=-np.inf),
        scatter=SimpleNamespace(
            **{"both": 0.0, "one_direction": -np.inf, "along_approach": -np.inf, **changes.pop("scatter", {})}
        ),
        temperature=temperature,
        step=step,
        tested={"step": step, "local_temperature": temperature},
        serial_p=0.5,
        warm_up_share=0.5,
    )
    case.excluded = module._Case.excluded.fget(case)
    return case


@pytest.mark.parametrize(
    ("leading", "probability", "changes", "reason"),
    [
        ("local_temperature", 0.80, {}, None),
        ("local_temperature", 0.79, {}, "probability 0.79 of local temperature is below its threshold 0.80"),
        (
            "local_temperature",
            0.95,
            {"temperature": {"by_direction": (0.3, -0.1)}},
            "the sign differs between directions",
        ),
        (
            "local_temperature",
            0.95,
            {"temperature": {"hold_out_gain": 0.0}},
            "the fit to one direction does not predict",
        ),
        ("step", 0.60, {}, None),
        ("step", 0.59, {}, "is below its threshold 0.60"),
        ("step", 0.95, {"step": {"hold_out_gain": -0.1}}, "the fit to one direction does not predict"),
        ("structural", 0.29, {}, "is below its threshold 0.30"),
        ("stick_slip", 0.39, {}, "is below its threshold 0.40"),
    ],
)
def test_an_objection_takes_the_name_away(leading, probability, changes, reason):
    reasons = _objections(fitted(**changes), leading, probability)
    assert len(reasons) == (reason is not None)
    assert reason is None or reason in reasons[0]


@pytest.mark.parametrize(
    ("name", "cause", "p_value", "possible"),
    [
        ("temperature", "local_temperature", 0.02, True),
        ("temperature", "local_temperature", 0.021, False),
        ("step", "step", 0.05, True),
        ("step", "step", 0.051, False),
    ],
)
def test_a_cause_that_its_own_test_does_not_accept_is_impossible(name, cause, p_value, possible):
    assert (_probabilities(fitted(**{name: {"p_value": p_value}}))[cause] > 0) is possible


@pytest.mark.parametrize(("kind", "bar"), [("one_direction", 4.0), ("along_approach", 2.1)])
def test_scatter_by_direction_must_gain_its_bar_over_scatter_alike(kind, bar):
    """At the bar both explanations are equally probable; every nat above it multiplies their ratio by e."""
    for beyond in (0.0, 1.0):
        probability = _probabilities(fitted(scatter={kind: bar + beyond}))
        assert probability["stick_slip"] / probability["structural"] == pytest.approx(np.exp(beyond))


@pytest.mark.parametrize(
    ("name", "cause", "candidates"), [("temperature", "local_temperature", 4), ("step", "step", 91)]
)
def test_a_regressor_pays_for_its_coefficient_and_for_the_search_of_its_candidates(name, cause, candidates):
    """100 cycles: half their logarithm for the coefficient, the logarithm of 4 lags or of 91 instants for the search."""
    case = fitted(**{name: {"log_likelihood": 0.5 * np.log(100) + np.log(candidates) + 1.0}})
    probability = _probabilities(case)
    assert probability[cause] / probability["structural"] == pytest.approx(np.e)


def test_a_walk_in_one_direction_pays_for_its_parameter_and_its_bar():
    """As likely as white noise by 2 nats and half the logarithm of 100 cycles more."""
    case = fitted()
    case.random_walk.one_direction = 2.0 + 0.5 * np.log(100) + 1.0
    probability = _probabilities(case)
    assert probability["stick_slip"] / probability["structural"] == pytest.approx(np.e)


def test_the_gain_of_an_approach_is_that_of_the_better_of_its_two_forms():
    def case(one_direction, along_approach):
        scatter = SimpleNamespace(both=-20.0, one_direction=one_direction, along_approach=along_approach)
        return SimpleNamespace(scatter=scatter)

    assert module._Case.approach_gain.fget(case(-14.0, -17.0)) == 6.0
    assert module._Case.approach_gain.fget(case(-25.0, -17.0)) == 3.0


def test_the_next_best_explanation_and_rejected_tests_are_told(monkeypatch):
    case = fitted(step={"p_value": 0.2})
    case.residual = SimpleNamespace(target=3)
    monkeypatch.setattr(
        module, "_probabilities", lambda case: {"structural": 0.6, "stick_slip": 0.3, "slow": 0.1, "step": 0.0}
    )
    monkeypatch.setattr(module, "_evidence", lambda case, probability: {})
    monkeypatch.setattr(module, "_support", lambda case, leading: [])
    told = module._judge(case, "both")
    assert (told.cause, told.probability) == ("structural", 0.6)
    assert told.against_it == (
        "next best explanation: stick-slip, probability 0.30",
        "sudden step: excluded, since ordinary slow drift would look the same (p = 0.2)",
    )


# Causes of an anomaly: every one has its words and what to inspect.


def test_without_a_cause_the_test_is_repeated_and_the_leading_explanation_is_looked_at() -> None:
    generic = module.CAUSES["undetermined"].check
    assert undetermined_check("step") == (
        f"{generic} If the cause is sudden step: inspect fixture, optics, clamps and the coupling of the scale, "
        "and look for an event at that time in the machine's log."
    )
    assert all(
        module.CAUSES[name].words in undetermined_check(name)
        for name in ("structural", "local_temperature", "stick_slip")
    )
    # A random walk is no cause, and nor is "undetermined".
    assert undetermined_check("slow") == undetermined_check("undetermined") == generic
