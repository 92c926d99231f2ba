"""Conclusions of a run as answers to a reader's questions: why, how much, where, how sure, which place, what remains."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fusion.products.results import Results
from fusion.products.results_attribution import CorrelationPart
from fusion.products.results_axis import AnomalyPart
from fusion.products.results_loop import Loop, RecordLoop, StepPart
from fusion.products.results_part import Quantity, TimePart
from fusion.report.conclusions.effects import phrase, step_phrase
from fusion.report.findings import (
    anomaly_figures,
    area_words,
    drift_u_note,
    quoted_values,
    quoted_window,
    randomised_causes,
    spot_places,
)
from fusion.report.wording import (
    INPUT_NAMES,
    alike,
    conditional,
    duration,
    effect_words,
    join,
    measured,
    number,
    p_words,
    place,
)

#: A drift of less than this share of the median scatter is none that readings can show.
_SHARE_OF_SCATTER = 0.01
#: Effects that the seen temperatures of the table drive.
_SEEN = {"axis_expansion", "table_offset", "thermal_lag"}
#: Anomalies in words: what the position does, and what that speaks for.
_ANOMALIES = {
    "scatter": "repeats worse than the others",
    "slow": "moves slowly by itself",
    "step": "makes a step by itself",
    "periodic": "moves periodically by itself",
}
_ANOMALY_CAUSES = {
    "structural": "probably mechanical (guideway, scale, screw or nut)",
    "local_temperature": "it goes with the temperature at its own place",
    "stick_slip": "probably stick-slip",
    "step": "one step at cycle {cycle}",
    "undetermined": "these data do not tell why",
}


#: Hotspots that the summary names; the table has all.
_TOLD = 3
#: What p does not hold, because it takes sensors for prompt; docs/method/records.md, error rates.
_NAMES_OF_RECORDS = (
    "A name is less certain than that: p takes sensors for prompt. Of 40 simulated records with late sensors "
    "in which nothing was missing, 3 were given a name."
)


class Conclusion(NamedTuple):
    """One conclusion of a run.

    Attributes
    ----------
    question : str
        What it answers: how much, where, how sure, which place, what remains.
    text : str
        Sentences.
    """

    question: str
    text: str


def conclude(results: Results) -> list[Conclusion]:
    """Return the conclusions of a run in the order of a reader's questions; those that the run does not answer are absent.

    Parameters
    ----------
    results : Results
        Results of a run.
    """
    answers = (
        ("How much", _how_much(results)),
        ("Where", _where(results) + _rise(results)),
        ("How sure", _how_sure(results) + _rise_u(results)),
        ("Which place", _which_place(results)),
        ("What remains", _what_remains(results)),
    )
    return [Conclusion(question, " ".join(sentences)) for question, sentences in answers if sentences]


def headline(results: Results) -> str:
    """Return one sentence that states the outcome, conditional where an input is doubted.

    Parameters
    ----------
    results : Results
        Results of a run.
    """
    if results.loop is None:
        return _without_model(results)
    return conditional(
        _verdict(results.loop, results.time, record=results.registration is None), results.inputs, "causes"
    )


def _without_model(results: Results) -> str:
    """The outcome of a campaign whose drift has no model: the rise where only a camera measured, else the accuracy by the standard."""
    field = results.field
    if field is not None and results.iso230 is None:
        seen = "picture" if results.registration is not None and results.registration.is_picture else "table"
        mean, largest = measured_quantity(field.mean_rise_K, "K"), measured_quantity(field.largest_rise_K, "K")
        over = duration(field.duration_s)
        text = f"Over {over} the {seen} changed by {mean} on average; the largest rise of a cell is {largest}."
        return conditional(text, results.inputs, "field")
    if results.iso230 is not None:
        quoted = quoted_window(results.iso230)
        symbol, value = next(iter(quoted_values(quoted).items()))
        text = f"Positioning accuracy {symbol} = {value} by ISO 230-2 (k = 2); the drift has no model."
        return conditional(text, results.inputs, "positions")
    return conditional("Evaluated without a model of the drift.", results.inputs, "causes")


def measured_quantity(quantity: Quantity, unit: str) -> str:
    """Return a value with its expanded uncertainty (k = 2).

    Parameters
    ----------
    quantity : Quantity
        Value and standard uncertainty.
    unit : str
        Of both.
    """
    return measured(quantity.value, quantity.u, unit)


def _rise(results: Results) -> list[str]:
    """Rise of a table or picture of which only the camera tells: where and when it is largest, and the hotspots of the last field."""
    field = results.field
    if field is None or results.drift is not None or results.iso230 is not None:
        return []
    unit = "mm" if field.largest_x_px is None else "px"
    x, y = (getattr(field, f"largest_{axis}_{unit}") for axis in "xy")
    when = f"after {duration(field.largest_after_s)} (window {field.largest_cycle})"
    sentences = [
        f"The largest rise of a cell, {measured_quantity(field.largest_rise_K, 'K')}, is at {place(x, y, unit)} {when}."
    ]
    spots = results.hotspots or ()
    named = [
        f"{spot.name} at {spot_places(spot).peak}, {measured(spot.peak_rise_K, spot.peak_rise_u_K, 'K')}"
        for spot in spots
    ]
    more = f", and {len(named) - _TOLD} more (table of hotspots)" if len(named) > _TOLD else ""
    sentences.append(
        f"Warmer than their surroundings in the last field: {'; '.join(named[:_TOLD])}{more}."
        if named
        else "In the last field no place stands out from its surroundings."
    )
    return [conditional(" ".join(sentences), results.inputs, "field")]


def _rise_u(results: Results) -> list[str]:
    """What the uncertainty of the rise rests on, where only the camera tells."""
    radiometry = results.radiometry
    if radiometry is None or results.drift is not None or results.iso230 is not None:
        return []
    largest = max(radiometry.budget, key=lambda entry: entry.rise_u_percent or 0.0, default=None)
    share = radiometry.rise_scale_u
    if largest is None or share is None or not largest.rise_u_percent:
        return []
    return [
        f"Values after ± are expanded uncertainties (k = 2). Every rise is uncertain by {100 * share:.2g} % of itself (k = 1), most of it "
        f"from {INPUT_NAMES.get(largest.input, largest.input).split(' / ')[0]} ({largest.source}). Places are not tested against chance, "
        "as no drift was measured that could follow them."
    ]


def _verdict(loop: Loop, time: TimePart | None, *, record: bool) -> str:
    lacks = join([step_phrase(step, time, record=record) for step in loop.steps if step.confirmed])
    declared = join([phrase(name, record=record) for name in loop.declared])
    explains = f"The declared model explains the drift ({declared})" if declared else "No effect is declared"
    last = "value" if isinstance(loop, RecordLoop) else "cycle"
    size = f" ({number(loop.unexplained.rms_um, 2)} µm rms)" if loop.unexplained.shape else ""
    alone = f"{'The declared model' if declared else 'Random drift'} does not explain the drift alone:"
    return {
        "complete": f"{explains}; no missing effect can be shown.",
        "explained": f"{alone} it lacks {lacks}. With that, no further cause can be shown.",
        "partial": f"{alone} it lacks {lacks}. Even with that, a part is left that has no name.",
        "unexplained": f"A part of the drift{size} has no explanation: no effect of the library deserves its name.",
        "no_skill": f"The model predicts no better than repeating the last {last} or the mean: these data cannot tell what drives it.",
    }[loop.verdict]


def _how_much(results: Results) -> list[str]:
    """Size of the drift, and the accuracy by the standard."""
    sentences = []
    if results.drift is not None and results.drift.range_um:
        sentences.append(
            f"During the test the deviation drifted by {_extreme_position(results, largest=True)}, {_least_drift(results)} "
            f"({drift_u_note(results.iso230)})."
        )
    if results.iso230 is not None:
        quoted = quoted_window(results.iso230)
        values = ", ".join(f"{symbol} = {value}" for symbol, value in quoted_values(quoted).items())
        sentences.append(f"By ISO 230-2, {quoted.window}: {values} (k = 2).")
    return [conditional(" ".join(sentences), results.inputs, "positions")] if sentences else []


def _least_drift(results: Results) -> str:
    """The smallest drift with its position; of far less than the scatter it is not told as a number."""
    drift = results.drift
    assert drift is not None
    known = [k for k, value in enumerate(drift.range_um) if value is not None]
    at = min(known, key=lambda k: drift.range_um[k] or 0.0)
    scatters = drift.scatter_um.values()
    if scatters and (drift.range_um[at] or 0.0) < _SHARE_OF_SCATTER * float(np.median(scatters)):
        return f"and not noticeably at position {at + 1} ({drift.position_mm[at]:g} mm)"
    return f"and least by {_extreme_position(results, largest=False)}"


def _extreme_position(results: Results, *, largest: bool) -> str:
    """Largest or smallest range of drift with its position."""
    drift = results.drift
    assert drift is not None
    known = [k for k, value in enumerate(drift.range_um) if value is not None]
    choose = max if largest else min
    at = choose(known, key=lambda k: drift.range_um[k] or 0.0)
    return f"{measured(drift.range_um[at], drift.range_u_um[at], 'µm')} at position {at + 1} ({drift.position_mm[at]:g} mm)"


def _where(results: Results) -> list[str]:
    """Positions that stand out."""
    if results.anomalies is None:
        return []
    told = " ".join(map(describe_anomaly, results.anomalies)) or "No position stands out from the others."
    rests_on = {figure for anomaly in results.anomalies for figure in anomaly_figures(anomaly)} or {"positions"}
    return [conditional(told, results.inputs, *sorted(rests_on))]


def describe_anomaly(anomaly: AnomalyPart) -> str:
    """Return one sentence on a position that stands out: what it does, by how much, and what that speaks for.

    Parameters
    ----------
    anomaly : AnomalyPart
        An entry of ``anomalies`` in the results.
    """
    evidence = anomaly.evidence
    approach = "" if anomaly.direction == "both" else f", {anomaly.direction} approach,"
    sizes = (
        f"its standard deviation is {number(_scatter(anomaly), 2)} µm, that of the others {number(evidence.scatter_typical_um, 2)} µm"
        if evidence.kind == "scatter"
        else f"{number(evidence.extra_um, 2)} µm"
    )
    cause = _ANOMALY_CAUSES[anomaly.cause].format(cycle=evidence.step_cycle)
    return (
        f"{position_words(anomaly.target, anomaly.position_mm)}{approach} {_ANOMALIES[evidence.kind]}: {sizes} "
        f"({p_words(anomaly.p_value, anomaly.least_p)}); {cause}."
    )


def position_words(target: int, position_mm: float | None) -> str:
    """Return the name of a target position with its place.

    Parameters
    ----------
    target : int
        Number of the position, from 1.
    position_mm : float or None
        Place along the axis, mm; None: left out.
    """
    return f"Position {target}" + ("" if position_mm is None else f" ({position_mm:g} mm)")


def _scatter(anomaly: AnomalyPart) -> float | None:
    """Standard deviation of the approach that stands out, um; root mean square of both where both do."""
    evidence = anomaly.evidence
    sides = {"positive": evidence.scatter_positive_um, "negative": evidence.scatter_negative_um}
    if anomaly.direction != "both":
        return sides[anomaly.direction]
    known = [value for value in sides.values() if value is not None]
    return float((sum(value**2 for value in known) / len(known)) ** 0.5) if known else None


def _how_sure(results: Results) -> list[str]:
    """Probability of what was found, what was not confirmed, and what the prediction is worth."""
    loop = results.loop
    if loop is None:
        return []
    added = [f"{effect_words(step.effect).name} {p_words(step.p_value)}" for step in loop.steps if step.confirmed]
    found = f"{join(added)} (chance that the whole search finds as much where nothing is missing)." if added else ""
    found = f"{found[:1].upper()}{found[1:]}"
    if added and isinstance(loop, RecordLoop):
        found = f"{found} {_NAMES_OF_RECORDS}"
    doubtful = [f"{effect_words(step.effect).name} ({step.doubt})" for step in loop.steps if not step.confirmed]
    named = " ".join(text for text in (found, f"Not confirmed: {join(doubtful)}." if doubtful else "") if text)
    sentences = [conditional(named, results.inputs, "causes")] if named else []
    return [*sentences, conditional(prediction_sentence(loop), results.inputs, "positions")]


def prediction_sentence(loop: Loop) -> str:
    """Return the sentences on the error of prediction: before, after, of repeating the last cycle, and what they say.

    Parameters
    ----------
    loop : Loop
        The part ``loop`` of the results.
    """
    record = isinstance(loop, RecordLoop)
    last = "value" if record else "cycle"
    declared, final, plain = alike((loop.rmse_declared_um, loop.rmse_final_um, loop.rmse_persistence_um))
    noise = number(loop.noise_floor_um, 2)
    scatter = "the noise of a block mean" if record else "the scatter of single readings"
    steps = [step for step in loop.steps if step.rmse_after_um is not None]
    better = "" if loop.rmse_persistence_um is None or not steps else _plain_wins(loop)
    beside = f"repeating the last {last} gives {plain} µm{better}, {scatter} is {noise} µm"
    where = loop.held_out.split(" held out")[0]
    if not steps:
        return f"Error of predicting {where} from what was measured before: {declared} µm; {beside}."
    lower = (loop.rmse_final_um or 0.0) < (loop.rmse_declared_um or 0.0)
    change = (
        f"falls from {declared} to {final} µm" if lower else f"does not fall ({declared} µm before, {final} µm after)"
    )
    noun = "effect" if len(steps) == 1 else "effects"
    blocks = f"blocks of {'time' if record else 'cycles'} predicted from the others: {_block_errors(steps)}"
    return f"With the added {noun} the error of predicting {where} {change}; {beside}; {blocks}.{_worse_channels(loop)}"


def _worse_channels(loop: Loop) -> str:
    """The channels of a record whose error does not fall with the added effects, as a sentence; empty where it falls in all."""
    channels = loop.channels if isinstance(loop, RecordLoop) else {}
    worse = [
        f"{name} ({' -> '.join(alike((channel.rmse_declared_um, channel.rmse_final_um)))} µm)"
        for name, channel in channels.items()
        if (channel.rmse_final_um or 0.0) > (channel.rmse_declared_um or 0.0)
    ]
    return f" It does not fall in {join(worse)}." if worse else ""


def _block_errors(steps: list[StepPart]) -> str:
    """Errors of blocks that are left out, before and after every step."""
    texts = []
    for step in steps:
        before, after = alike((step.cross_rmse_before_um, step.cross_rmse_after_um))
        texts.append(f"{before} -> {after} µm" + (f" ({effect_words(step.effect).name})" if len(steps) > 1 else ""))
    return join(texts)


def _plain_wins(loop: Loop) -> str:
    """Than which models the plain repetition predicts better, in brackets; empty where it wins against none."""
    plain, declared, final = loop.rmse_persistence_um, loop.rmse_declared_um, loop.rmse_final_um
    if plain is None or declared is None or final is None:
        return ""
    if plain < final:
        return " (less than the model, which explains here but does not predict better)"
    return " (less than the declared model alone)" if plain < declared else ""


def place_sentence(correlation: CorrelationPart) -> str:
    """Return one sentence on the place of the field that the drift follows.

    Parameters
    ----------
    correlation : CorrelationPart
        The part ``correlation`` of the results.
    """
    source = correlation.source
    where = area_words(source.area, source.x_mm, source.y_mm)
    shown = p_words(source.p_value, correlation.least_p)
    return {
        "not separable": "These data cannot tell which place the drift follows: the whole session is one warm-up, in which every "
        "temperature rises like every drift.",
        "not attributable": "The drift follows no place that the camera sees more closely than chance allows; the closest is "
        f"{where} ({shown}).",
        "attributable": f"The drift as a whole follows the temperature of {where} more closely than chance and a common warm-up allow "
        f"({shown}); this is not yet proof of cause.",
    }[correlation.verdict]


def _which_place(results: Results) -> list[str]:
    """The place that the drift follows, and how that goes together with the model."""
    correlation = results.correlation
    if correlation is None:
        return []
    causes = randomised_causes(correlation)
    verb = "is a cause" if len(causes) == 1 else "are causes"
    shown = f"Loads were switched at random, which shows that {join(causes)} {verb} of drift." if causes else ""
    sentences = (place_sentence(correlation), shown, reconcile(results))
    return [conditional(" ".join(text for text in sentences if text), results.inputs, "attribution")]


def reconcile(results: Results) -> str:
    """Return one sentence on how the place that the drift follows goes together with what the model names; empty where nothing has to.

    Parameters
    ----------
    results : Results
        Results of a run.
    """
    correlation, loop = results.correlation, results.loop
    if correlation is None or loop is None or correlation.verdict != "attributable":
        return ""
    if not any(step.confirmed and step.effect == "unseen_heat_source" for step in loop.steps):
        return ""
    seen = [phrase(name, record=False) for name in loop.declared if name in _SEEN]
    part = f"the part that follows the seen temperatures ({join(seen)})" if seen else "what was declared"
    return f"The unseen heat source is what is left beside {part}, so this place does not show where it is."


def _what_remains(results: Results) -> list[str]:
    """What the final model leaves."""
    loop = results.loop
    if loop is None:
        return []
    left = loop.unexplained
    sentences = [f"{left.shape[0].upper()}{left.shape[1:]}: {number(left.rms_um, 2)} µm rms."] if left.shape else []
    sentences += [
        f"Significant and not admitted: {effect_words(name).name} ({p_words(p)})." for name, p in loop.unnamed.items()
    ]
    if sentences:
        return sentences
    scatter = "the noise of a block mean" if isinstance(loop, RecordLoop) else "the scatter of single readings"
    return [f"Nothing that these data can show beyond {scatter}, {number(loop.noise_floor_um, 2)} µm."]
