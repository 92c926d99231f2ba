"""Model and anomalies in the report: steps, coefficients, candidates, tests of the residual, detection limits, evidence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fusion.products.results_axis import Evidence
from fusion.products.results_loop import (
    AxisLoop,
    Coefficient,
    ErrorInterval,
    HoldOutQuestion,
    Loop,
    Nothing,
    Nuisance,
    Range,
    ResidualPart,
    RunnerUp,
    StepPart,
)
from fusion.report.tables import Row, Table, Words, table
from fusion.report.wording import BASELINES, duration, effect_words, join, measured, number, p_value, print_unit

#: Shapes of a residual in the order of the report: name in the results, words.
_SHAPES = (
    ("memory", "correlation from reading to reading"),
    ("event", "a shift at one instant"),
    ("rhythm", "a rhythm"),
    ("curvature", "curvature along the axis"),
    ("one place", "one position by itself"),
    ("direction", "difference of the approaches"),
    ("direction along the axis", "difference of the approaches that grows along the axis"),
    ("pattern", "any pattern of positions"),
    ("slow pattern", "any slow pattern of positions"),
)
#: Kind of an anomaly -> what `extra_um` is the size of.
_KINDS = {
    "scatter": "extra scatter",
    "slow": "slow motion beyond the other positions",
    "step": "a step",
    "periodic": "a periodic motion",
}
_UNITS = {
    "_um_per_K": " / (µm/K)",
    "_um": " / µm",
    "_nats": " / nats",
    "_min": " / min",
    "_mm": " / mm",
    "_s": " / s",
    "_K": " / K",
}


#: What the hold-out is for, and what it is not.
DECIDED_BEFORE = (
    "What enters is decided on the training part alone. The hold-out is opened once, to report: an effect that it does not bear out "
    "stays in the table as not confirmed, and the error after may exceed the error before."
)


def errors_table(loop: Loop) -> Table:
    """Return the errors on the hold-out with their intervals: of the model before and after, and of plain predictions.

    Parameters
    ----------
    loop : Loop
        The part ``loop`` of the results.
    """
    named = [("declared model", loop.errors.declared), ("with the added effects", loop.errors.final)]
    rows = [Row(_error_cells(name, one), marked=True) for name, one in named]
    rows += [Row(_error_cells(words, getattr(loop.baselines, name))) for name, words in BASELINES.items()]
    return table([Words("Prediction of the hold-out"), "Error / µm", "95 % interval / µm"], rows)


def _error_cells(name: str, error: ErrorInterval) -> list[str]:
    return [name, number(error.rmse_um, 3), f"{number(error.low_um, 2)} to {number(error.high_um, 2)}"]


def steps_table(loop: Loop) -> Table:
    """Return the declared model and every effect that was added, with the errors before and after: held out, and blocks left out.

    Parameters
    ----------
    loop : Loop
        The part ``loop`` of the results.
    """
    columns = [
        "Step",
        Words("Effect"),
        Words("Parameters"),
        "p",
        "Held-out error before / µm",
        "after / µm",
        "Blocks left out, before / µm",
        "after / µm",
        Words("Confirmed"),
        Words("Runner-up"),
    ]
    declared = join([effect_words(name).name for name in loop.declared]) or "nothing"
    rows = [Row(["0", f"declared: {declared}", "", "–", "–", number(loop.rmse_declared_um, 3), "–", "–", "", ""])]
    for turn, step in enumerate(loop.steps, start=1):
        rows.append(Row([str(turn), *_step_cells(step)], marked=True))
    return table(columns, rows)


def _step_cells(step: StepPart) -> list[str]:
    return [
        effect_words(step.effect).name,
        parameters_with_ranges(step.parameters, step.parameter_ranges),
        p_value(step.p_value),
        number(step.rmse_before_um, 3),
        number(step.rmse_after_um, 3),
        number(step.cross_rmse_before_um, 3),
        number(step.cross_rmse_after_um, 3),
        f"not confirmed: {step.doubt}" if step.doubt else "yes",
        _runner_up(step.runner_up),
    ]


def describe_model(loop: AxisLoop) -> list[tuple[str, str]]:
    """Return the model in numbers: coefficients, unexplained drift, simplest prediction, and what was not tried.

    Parameters
    ----------
    loop : AxisLoop
        The part ``loop`` of the results of a campaign with both instruments.
    """
    rows = [
        (effect_words(coefficient.effect).name, _coefficient(coefficient)) for coefficient in loop.declared_coefficients
    ]
    for step in loop.steps:
        rows += [(effect_words(step.effect).name, _coefficient(coefficient)) for coefficient in step.coefficients]
    rows.append(("unexplained drift", _unexplained_drift(loop.nuisance)))
    rows.append(("error of repeating the last value", f"{number(loop.rmse_persistence_um, 3)} µm"))
    if isinstance(loop.sealed_question, HoldOutQuestion):
        rows.append(("hold-out test of the strongest undecided candidate", _question(loop.sealed_question)))
    return rows + refused_effects(loop)


def refused_effects(loop: Loop) -> list[tuple[str, str]]:
    """Return the effects that were not tried or not admitted, with the reason.

    Parameters
    ----------
    loop : Loop
        The part ``loop`` of the results.
    """
    titled = (("not tried", loop.not_tried), ("not admitted", loop.blocked))
    rows = [(title, name, reason) for title, reasons in titled for name, reason in reasons.items()]
    return [
        (
            f"{title}: {effect_words(name).name}",
            f"p {p_value(loop.unnamed[name])}; {reason}" if name in loop.unnamed else reason,
        )
        for title, name, reason in rows
    ]


def _coefficient(coefficient: Coefficient) -> str:
    unit = print_unit(coefficient.unit)
    prior = (
        ""
        if coefficient.prior is None
        else f" (expected beforehand {measured(coefficient.prior, coefficient.prior_u, unit)})"
    )
    parts = (
        ""
        if coefficient.u_scale is None
        else f", of which the fit ± {number(2 * (coefficient.u_fit or 0.0), 2)} and the scale of the rise "
        f"± {number(2 * coefficient.u_scale, 2)}"
    )
    return measured(coefficient.value, coefficient.u, unit) + parts + prior


def _unexplained_drift(left: Nuisance) -> str:
    return (
        f"{left.kind}; rms {_small(left.common_rms_um)} µm common to all positions, "
        f"{_small(left.stretch_rms_um)} µm of stretch along the axis"
    )


def _question(asked: HoldOutQuestion) -> str:
    """What the hold-out says of the strongest undecided candidate."""
    return (
        f"{effect_words(asked.effect).name}: error {number(asked.rmse_before_um, 3)} µm without it and "
        f"{number(asked.rmse_after_um, 3)} µm with it, predicted from the cycles before; p {p_value(asked.p_value)}"
    )


def describe_identifiability(loop: AxisLoop) -> Table:
    """Return the detection limit of every effect.

    Parameters
    ----------
    loop : AxisLoop
        The part ``loop`` of the results of a campaign with both instruments.
    """
    columns = [
        Words("Effect"),
        "Detected from / µm rms",
        "best to worst / µm",
        "Visible",
        Words("Collinear with"),
        Words("Limitation"),
    ]
    rows = []
    for limit in loop.identifiability:
        determined = limit.detectable_um is not None
        rows.append(
            [
                effect_words(limit.effect).name,
                number(limit.detectable_um, 2) if determined else "never",
                f"{number(limit.best_um, 2)} to {number(limit.worst_um, 2)}" if determined else "–",
                "–" if limit.visible_share is None else f"{100 * limit.visible_share:.0f} %",
                join([effect_words(name).name for name in limit.looks_like]) or "–",
                limit.note,
            ]
        )
    return table(columns, rows)


def _small(value: float | None) -> str:
    """Return a size in µm, values below a nanometre as such."""
    return "below 0.001" if value is not None and value < 1e-3 else number(value, 2)


def describe_candidates(loop: AxisLoop) -> Table:
    """Return the best candidate of every effect in every round of the search with its scores.

    Parameters
    ----------
    loop : AxisLoop
        The part ``loop`` of the results of a campaign with both instruments.
    """
    columns = [
        "Round",
        Words("Effect"),
        Words("Best parameters"),
        "Gain",
        "Gain beyond chance",
        "p (search)",
        "Held-out gain",
        "p (held out)",
    ]
    rows = [
        [
            str(turn),
            effect_words(score.effect).name,
            parameters(score.parameters),
            _nats(score.gain),
            _nats(score.excess_gain),
            p_value(score.family_wise_p),
            _nats(score.held_out_gain),
            p_value(score.held_out_p),
        ]
        for turn, scores in enumerate(loop.search, start=1)
        for score in scores
    ]
    return table(columns, rows)


def _nats(gain: float | None) -> str:
    return "–" if gain is None else f"{gain:.1f}".replace("-", "−")


def describe_residual(declared: ResidualPart, final: ResidualPart) -> Table:
    """Return every shape of the residual with its p-value, or its size, for the declared and the final model.

    Parameters
    ----------
    declared, final : ResidualPart
        Tests of the residual of both models.
    """
    rows = [[shape, _chance(declared, name), _chance(final, name)] for name, shape in _SHAPES]
    sizes = (
        ("shift of all positions", declared.drift_common_um, final.drift_common_um),
        ("stretch of the axis", declared.drift_stretch_um, final.drift_stretch_um),
    )
    rows += [[shape, f"{_small(before)} µm rms", f"{_small(after)} µm rms"] for shape, before, after in sizes]
    return table([Words("Shape"), "Declared model", "Final model"], rows)


def _chance(tests: ResidualPart, shape: str) -> str:
    """Return p, and where the shape is: the instant of an event, the period of a rhythm."""
    own = " (that of the cycles)" if tests.period_is_cycle else ""
    where = {
        "event": f", {duration(tests.event_s)} from the start",
        "rhythm": f", {number(tests.period_min, 2)} min{own}",
    }
    return f"p {p_value(tests.p_values[shape])}{where.get(shape, '')}"


def _runner_up(other: RunnerUp | Nothing) -> str:
    """Return the second best effect of a step and how far behind it is."""
    if isinstance(other, Nothing) or other.behind_by is None:
        return "none"
    name = effect_words(other.effect).name
    if other.behind_by < 0:
        return f"{name}, {number(-other.behind_by, 2)} more in log-likelihood but not confirmed"
    return f"{name}, {number(other.behind_by, 2)} less in log-likelihood"


def parameters(values: Mapping[str, Any]) -> str:
    """Return parameters as ``name value, name value``.

    Parameters
    ----------
    values : mapping
        Numbers or words by name; a name ends with its unit.
    """
    return ", ".join(f"{spaced(name)} {in_words(value)}" for name, value in values.items())


def parameters_with_ranges(values: Mapping[str, Any], ranges: Mapping[str, Range]) -> str:
    """Return parameters, each with the values that fit as well.

    Parameters
    ----------
    values : mapping
        Numbers or words by name; a name ends with its unit.
    ranges : mapping
        Ends of the 95 % range by name (None where the data set no end), or the other words that fit as well.

    Examples
    --------
    >>> parameters_with_ranges({"time_constant_min": 39.6}, {"time_constant_min": (29.0, None)})
    'time constant / min 39.6 (at least 29.0)'
    """
    return ", ".join(
        f"{spaced(name)} {in_words(value)}{_as_well(ranges[name]) if name in ranges else ''}"
        for name, value in values.items()
    )


def _as_well(fits: Range) -> str:
    others = [word for word in fits if isinstance(word, str)]
    if others or not fits:
        return f" (or {join([spaced(word) for word in others])})"
    low, high = (None if value is None else number(float(value), 3) for value in fits)
    if low is None and high is None:
        return " (not determined)"
    return f" (at most {high})" if low is None else f" (at least {low})" if high is None else f" ({low} to {high})"


def spaced(name: str) -> str:
    """Return a name of the results as words, with the unit at its end set off.

    Parameters
    ----------
    name : str
        Key of the results, or a name that is the value of a parameter.

    Examples
    --------
    >>> spaced("time_constant_min")
    'time constant / min'
    """
    for ending, unit in _UNITS.items():
        if name.endswith(ending):
            return name.removesuffix(ending).replace("_", " ") + unit
    return name.replace("_", " ")


def describe_evidence(evidence: Evidence) -> dict[str, Any]:
    """Return the evidence of an anomaly: size, sentences for and against, what to inspect, and all numbers.

    Parameters
    ----------
    evidence : Evidence
        Evidence of an entry of ``anomalies`` in the results.
    """
    return {
        "stands_out": f"{_KINDS[evidence.kind]} of {number(evidence.extra_um, 2)} µm",
        "support": evidence.support,
        "against": evidence.against,
        "check": evidence.check,
        "numbers": [(spaced(name), in_words(value)) for name, value in evidence.numbers().items()],
    }


def in_words(value: Any) -> str:
    """Return the value of a parameter or of a piece of evidence for a table cell.

    Parameters
    ----------
    value : number, str, bool, None, or a sequence of them
        A number is shown with three significant digits, a name with spaces for underscores, None as a dash.
    """
    if isinstance(value, Sequence) and not isinstance(value, str):
        return join([in_words(item) for item in value])
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        return number(float(value), 3)
    return "–" if value is None else str(value).replace("_", " ")
