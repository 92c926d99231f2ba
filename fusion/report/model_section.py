"""Model and anomalies in the report: steps, coefficients, candidates, tests of the residual, detection limits, evidence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fusion.products.results_axis import Evidence
from fusion.products.results_loop import (
    AxisLoop,
    AxisStep,
    Coefficient,
    HoldOutQuestion,
    Loop,
    Nothing,
    Nuisance,
    Range,
    ResidualPart,
    RunnerUp,
    StepPart,
)
from fusion.report.findings import baseline_words
from fusion.report.tables import Row, Table, Words, table
from fusion.report.wording import (
    alike,
    duration,
    effect_words,
    join,
    measured,
    number,
    p_cell,
    p_words,
    print_unit,
)

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
    "_um_per_K": "µm/K",
    "_um": "µm",
    "_nats": "in log-likelihood",
    "_min": "min",
    "_mm": "mm",
    "_s": "s",
    "_K": "K",
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
    plain = [(words, getattr(loop.baselines, name)) for name, words in baseline_words(loop).items()]
    listed = [*named, *plain]
    told = alike([getattr(one, name) for _, one in listed for name in ("rmse_um", "low_um", "high_um")], distinct=False)
    rows = [
        Row([name, told[3 * at], f"{told[3 * at + 1]} to {told[3 * at + 2]}"], marked=at < len(named))
        for at, (name, _) in enumerate(listed)
    ]
    return table([Words("Prediction of what was held out"), "Error / µm", "95 % interval / µm"], rows)


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
        "p",
        "Held out / µm",
        "Blocks / µm",
        Words("Confirmed"),
        Words("Next best effect"),
    ]
    declared = join([effect_words(name).name for name in loop.declared]) or "nothing"
    errors = [error for step in loop.steps for error in (step.rmse_before_um, step.rmse_after_um)]
    told = alike([loop.rmse_declared_um, *errors])
    rows = [Row(["0", f"declared: {declared}", "–", told[0], "–", "", ""])]
    for turn, step in enumerate(loop.steps, start=1):
        held_out = " -> ".join(told[2 * turn - 1 : 2 * turn + 1])
        rows.append(Row([str(turn), *_step_cells(step, held_out)], marked=True))
    return table(columns, rows)


def _step_cells(step: StepPart, held_out: str) -> list[str]:
    told = parameters_with_ranges(step.parameters, step.parameter_ranges)
    return [
        f"{effect_words(step.effect).name}{f': {told}' if told else ''}",
        p_cell(step.p_value),
        held_out,
        " -> ".join(alike((step.cross_rmse_before_um, step.cross_rmse_after_um))),
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
        name = effect_words(step.effect).name
        named = zip(coefficient_names(step), step.coefficients, strict=True)
        rows += [(f"{name}: {what}" if what else name, _coefficient(coefficient)) for what, coefficient in named]
    rows.append(("drift without explanation", _unexplained_drift(loop.nuisance)))
    if isinstance(loop.sealed_question, HoldOutQuestion):
        rows.append(("extra test on the held-out cycles", _question(loop.sealed_question)))
    return rows + refused_effects(loop)


def coefficient_names(step: AxisStep) -> list[str]:
    """Return what each coefficient of an added effect is the size of, empty for one that stands alone.

    Parameters
    ----------
    step : AxisStep
        One of ``loop.steps`` of a campaign along an axis.
    """
    count = len(step.coefficients)
    shape = str(step.parameters.get("shape", ""))
    shapes = (
        ["shift", "stretch at the far end"]
        if shape == "flat and linear"
        else ["shift" if shape == "flat" else "stretch at the far end"]
    )
    if step.effect == "unseen_heat_source" and count in (len(shapes), 2 * len(shapes)):
        start = (
            ["what was left of the time before the start, " + name for name in shapes] if count > len(shapes) else []
        )
        return [f"{name} at full load" for name in shapes] + start
    if step.effect == "periodic_disturbance" and count == 2:
        return ["sine part", "cosine part"]
    if count == len(shapes) and count > 1:
        return shapes
    return [""] if count == 1 else [f"coefficient {k}" for k in range(1, count + 1)]


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
            f"{p_words(loop.unnamed[name])}; {reason}" if name in loop.unnamed else reason,
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
        f"{left.kind}: {_small(left.common_rms_um)} µm rms common to all positions, "
        f"{_small(left.stretch_rms_um)} µm rms of stretch along the axis"
    )


def _question(asked: HoldOutQuestion) -> str:
    """What the held-out cycles say of the strongest undecided candidate."""
    before, after = alike((asked.rmse_before_um, asked.rmse_after_um))
    return (
        f"strongest undecided candidate, {effect_words(asked.effect).name}: error {before} µm without it and {after} µm with it "
        f"({p_words(asked.p_value)})"
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
            p_cell(score.family_wise_p),
            _nats(score.held_out_gain),
            p_cell(score.held_out_p),
        ]
        for turn, scores in enumerate(loop.search, start=1)
        for score in scores
    ]
    return table(columns, rows)


def _nats(gain: float | None) -> str:
    return "–" if gain is None else f"{gain:z.1f}".replace("-", "−")


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
        "event": f", {duration(tests.event_s)} after the start",
        "rhythm": f", {number(tests.period_min, 2)} min{own}",
    }
    return f"{p_words(tests.p_values[shape])}{where.get(shape, '')}"


def _runner_up(other: RunnerUp | Nothing) -> str:
    """Return the second best effect of a step and how far behind it is."""
    if isinstance(other, Nothing) or other.behind_by is None:
        return "none"
    name = effect_words(other.effect).name
    if other.behind_by < 0:
        return f"{name} (log-likelihood higher by {number(-other.behind_by, 2)}, but not confirmed)"
    return f"{name} (log-likelihood lower by {number(other.behind_by, 2)})"


def parameters(values: Mapping[str, Any]) -> str:
    """Return parameters in words, ``name value unit``.

    Parameters
    ----------
    values : mapping
        Numbers or words by name; a name ends with its unit.

    Examples
    --------
    >>> parameters({"follows": "warm_up", "time_constant_min": 30.0})
    'follows warm up, time constant 30.0 min'
    """
    return parameters_with_ranges(values, {})


def parameters_with_ranges(values: Mapping[str, Any], ranges: Mapping[str, Range]) -> str:
    """Return parameters in words, each with the values that fit as well.

    Parameters
    ----------
    values : mapping
        Numbers or words by name; a name ends with its unit.
    ranges : mapping
        Ends of the 95 % range by name (None where the data set no end), or the other words that fit as well.

    Examples
    --------
    >>> parameters_with_ranges({"time_constant_min": 39.6}, {"time_constant_min": (29.0, None)})
    'time constant 39.6 min (at least 29.0)'
    """
    return ", ".join(
        f"{_parameter(name, value)}{_as_well(name, ranges[name]) if name in ranges else ''}"
        for name, value in values.items()
    )


def _parameter(name: str, value: Any) -> str:
    """One parameter in words; an instant as time since the start."""
    if name == "time_s" and isinstance(value, int | float):
        return f"{duration(float(value))} after the start"
    for ending, unit in _UNITS.items():
        if name.endswith(ending):
            return f"{name.removesuffix(ending).replace('_', ' ')} {in_words(value)} {unit}"
    return f"{name.replace('_', ' ')} {in_words(value)}"


def _as_well(name: str, fits: Range) -> str:
    """The values of a parameter that fit as well, in brackets."""
    others = [word for word in fits if isinstance(word, str)]
    if others or not fits:
        return f" (or {join([spaced(word) for word in others])})"
    show = duration if name == "time_s" else number
    low, high = (None if value is None else show(float(value)) for value in fits)
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
            bracketed = f"({unit})" if "/" in unit else unit
            return f"{name.removesuffix(ending).replace('_', ' ')} / {bracketed}"
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
