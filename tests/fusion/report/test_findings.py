"""Findings in words: one text per quantity, for report and terminal alike."""

from __future__ import annotations

from fusion.products.results import (
    AnomalyPart,
    ByDirection,
    CorrelationPart,
    DriftPart,
    DutyPart,
    Iso230Part,
    Loop,
    Quantity,
    SourcePart,
)
from fusion.products.results_axis import Iso230Direction, Iso230Window
from fusion.products.results_loop import Baselines, ErrorInterval, ModelErrors, StepPart
from fusion.products.results_part import AreaPart
from fusion.report import findings

ISO = Iso230Part(
    window="cycles 1 to 5",
    B_of_scatter_um=0.4379,
    **{f"{name}_um": Quantity(value=9.9017, u=1.378) for name in (*"BREMA", "mean_reversal")},
)


def correlation(verdict: str, *loads: DutyPart) -> CorrelationPart:
    """The part of an attribution that sentences are made of."""
    return CorrelationPart.model_construct(
        verdict=verdict, source=SourcePart.model_construct(x_mm=355.0, y_mm=95.4, p_value=0.002), randomised_duty=loads
    )


def test_axis_values_bear_the_terms_of_the_standard() -> None:
    assert findings.iso230_values(ISO)["A"] == "9.9 \u00b1 2.8 \u00b5m"
    assert "scatter alone gives 0.44 \u00b5m" in findings.reversal_note(ISO)
    assert findings.reversal_note(ISO.model_copy(update={"B_of_scatter_um": None})) == ""
    assert findings.ISO230_TERMS["E"] == "Bidirectional systematic positioning error E"
    assert findings.ISO230_TERMS["M"] == "Mean bidirectional positioning error M"
    assert findings.ISO230_TERMS["B"] == "Reversal error B"


def test_scatter_leaves_out_what_is_not_determined() -> None:
    drift = DriftPart.model_construct(scatter_um=ByDirection(positive=(0.4, None), negative=(0.2, 0.3)))
    assert findings.scatter_range(drift) == "0.20 to 0.40 \u00b5m, median 0.30 \u00b5m"
    none = DriftPart.model_construct(scatter_um=ByDirection(positive=(0.4, 0.0), negative=(0.2, 0.3)))
    assert findings.scatter_range(none) == "up to 0.40 \u00b5m, median 0.25 \u00b5m"
    few = DriftPart.model_construct(scatter_um=ByDirection(positive=(None,), negative=(None,)))
    assert findings.scatter_range(few) == "not known: no position has readings enough"


def test_of_one_approach_the_unidirectional_values_are_quoted() -> None:
    known, unknown = Quantity(value=9.9017, u=1.378), Quantity(value=None, u=None)
    side = Iso230Direction(A_um=known, R_um=known, E_um=known)
    other = Iso230Direction(A_um=unknown, R_um=unknown, E_um=unknown)
    window = Iso230Window.model_construct(A_um=unknown, positive=other, negative=side)
    assert findings.quoted_values(window) == {"A\u2193": "9.9 \u00b1 2.8 \u00b5m", "R\u2193": "9.9 \u00b1 2.8 \u00b5m"}
    assert list(findings.quoted_values(ISO)) == ["A", "R", "B"]


def test_anomalies_are_named_with_their_cause() -> None:
    both = AnomalyPart.model_construct(target=3, direction="both", cause="stick_slip")
    one = AnomalyPart.model_construct(target=5, direction="negative", cause="undetermined")
    assert findings.anomaly_place(both) == "position 3, both approaches"
    assert findings.anomaly_place(one) == "position 5, negative approach"


def test_a_place_is_named_as_an_area() -> None:
    area = AreaPart(x_low_mm=280.0, x_high_mm=420.0, y_low_mm=40.0, y_high_mm=150.0)
    assert findings.span_words(area) == "x 280 to 420 mm, y 40 to 150 mm"
    assert findings.area_words(area, 355.0, 95.0) == (
        "the area x 280 to 420 mm, y 40 to 150 mm (strongest at x 355 mm, y 95 mm)"
    )
    assert findings.area_words(None, 355.0, 95.0) == "the place around x 355 mm, y 95 mm"


def test_randomised_loads_that_are_causes_are_named() -> None:
    loads = [DutyPart.model_construct(name=name, cause=name == "spindle") for name in ("spindle", "coolant")]
    assert findings.randomised_causes(correlation("attributable", *loads)) == ["spindle"]


def error(rmse_um: float) -> ErrorInterval:
    return ErrorInterval(rmse_um=rmse_um, low_um=0.9 * rmse_um, high_um=1.1 * rmse_um)


def test_errors_are_stated_before_and_after_with_their_intervals() -> None:
    loop = Loop.model_construct(steps=(None,), errors=ModelErrors(declared=error(1.94), final=error(0.464)))
    assert findings.hold_out_errors(loop) == "1.94 [1.75 to 2.13] -> 0.46 [0.42 to 0.51] \u00b5m"
    assert findings.hold_out_errors(loop.model_copy(update={"steps": ()})) == "1.9 [1.7 to 2.1] \u00b5m"


def test_plain_predictions_are_last_value_mean_and_the_best_regression() -> None:
    names = ("last_value", "mean", "least_squares", "ridge", "ridge_with_lags")
    baselines = Baselines(**{name: error(1.0 + place) for place, name in enumerate(names)})
    told = findings.baseline_errors(Loop.model_construct(baselines=baselines, best_baseline="ridge"))
    assert told == (
        "last cycle simply repeated 1.0, mean of the cycles before 2.0, ridge regression on the same 4.0 \u00b5m"
    )
    short = findings.baseline_errors(Loop.model_construct(baselines=baselines, best_baseline="mean"))
    assert short == "last cycle simply repeated 1.0, mean of the cycles before 2.0 \u00b5m"


def test_a_step_has_both_pairs_of_errors() -> None:
    step = StepPart.model_construct(
        rmse_before_um=0.6, rmse_after_um=0.7, cross_rmse_before_um=0.5, cross_rmse_after_um=0.4
    )
    assert findings.step_errors(step) == (
        "held-out error 0.60 -> 0.70 \u00b5m, blocks predicted from the others 0.50 -> 0.40 \u00b5m"
    )
    late = step.model_copy(update={"rmse_after_um": None})
    assert findings.step_errors(late).startswith(
        "found after the hold-out was opened, blocks predicted from the others 0.50"
    )
