"""Numbers, times, places and conditions as a reader meets them: significant digits, unit, uncertainty, zone."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from inspect import getmembers, isfunction
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import numpy as np
import rich.table
from markupsafe import Markup

from fusion.analysis.diagnosis.causes import CAUSES
from fusion.analysis.effects.library import describe_effect
from fusion.common.messages import cell, printable
from fusion.results import numbers
from fusion.results.axis import AnomalyPart, CorrelationPart, DriftPart, Iso230Window
from fusion.results.loop import ERROR_BY_CHANCE, ChannelErrors, DriftShare, Loop, ModelError, Range, RecordLoop
from fusion.results.parts import AreaPart, Figures, InputsPart, Quantity
from fusion.results.progress import counted
from fusion.results.results import Results
from thermofuse.resources import vocabulary

# Tables as the report and the terminal show them: columns, rows, and which rows are marked.


class Words(str):
    """Heading of a column of text, set to the left; a plain str is the heading of a column of numbers, with their unit."""


@dataclass(frozen=True)
class Row:
    """A row of a table, one text per column; a marked one is set off from the others."""

    cells: Sequence[str]
    marked: bool = False


@dataclass(frozen=True)
class Table:
    """A table of finished texts; the cells of a stacked one stand below each other on a narrow screen, for long sentences."""

    titles: tuple[str, ...]
    rows: tuple[Row, ...]
    stacked: bool = False


def table(titles: Iterable[str], rows: Iterable[Row | Sequence[str]], *, stacked: bool = False) -> Table:
    """Return a table."""
    return Table(tuple(titles), tuple(row if isinstance(row, Row) else Row(row) for row in rows), stacked)


def with_values(shown: Table) -> Table:
    """Return a table without the columns in which every row has a dash."""
    kept = [at for at in range(len(shown.titles)) if any(row.cells[at] != "–" for row in shown.rows)]
    rows = (Row([row.cells[at] for at in kept], row.marked) for row in shown.rows)
    return table([shown.titles[at] for at in kept], rows, stacked=shown.stacked)


def print_table(shown: Table, title: str) -> rich.table.Table:
    """Return a table as the terminal shows it."""
    printed = rich.table.Table(title=cell(title), title_justify="left")
    for title in shown.titles:
        printed.add_column(cell(title), justify="left" if isinstance(title, Words) else "right")
    for row in shown.rows:
        printed.add_row(*map(cell, row.cells))
    return printed


_NAMES = vocabulary("names")
_FIGURE_WORDS: dict[Figures, str] = _NAMES["figures"]


#: Inputs of the radiometry in words, with their unit.
INPUT_NAMES: dict[str, str] = _NAMES["radiometry"]

#: Parts of the drift as the correlation names them, in plain words.
CHANNELS: dict[str, str] = _NAMES["channels"]


#: Units at the end of a name in the results, as they are printed.
_UNITS = {
    "_um_per_K": "µm/K", "_um": "µm", "_nats": "in log-likelihood", "_min": "min", "_mm": "mm", "_s": "s", "_K": "K",
}  # fmt: skip


#: Numbers of a diagnosis in words, with their unit.
EVIDENCE: dict[str, str] = _NAMES["evidence"]


class EffectWords(NamedTuple):
    """An effect as a reader meets it: its name, alone and within a sentence, and what to check where it was missing."""

    name: str
    phrase: str
    remedy: str


@cache
def effect_words(name: str) -> EffectWords:
    """Return the words of an effect."""
    effect = describe_effect(name)
    if effect is None:  # of a distribution that is not installed here
        return EffectWords(name.replace("_", " "), name.replace("_", " "), "")
    return EffectWords(effect.words, effect.phrase or effect.words, effect.remedy)


def quantity(found: Quantity, unit: str = "") -> str:
    """Return a quantity of the results as ``value ± U unit``, see `measured`."""
    return numbers.measured(found.value, found.u, unit)


def limited(value: float | None, limits: tuple[float, float] | None, unit: str = "") -> str:
    """Return a value with the limits of its interval as ``value [low to high] unit``."""
    low, high = (None, None) if limits is None else limits
    if value is None or low is None or high is None or not np.isfinite([value, low, high]).all():
        return numbers.measured(value, None, unit)
    places = numbers.decimals_of((high - low) / 4.0)
    return f"{numbers.fixed(value, places)} [{numbers.fixed(low, places)} to {numbers.fixed(high, places)}]{f' {unit}' if unit else ''}"


def region_words(name: str) -> str:
    """Return the name of a region in the report: the disc about a hotspot is not the area of the hotspot itself."""
    return re.sub(r"^hotspot (?=\d+$)", "disc about hotspot ", name)


#: Plain predictions of the hold-out in words, by their key in ``loop.baselines``.
BASELINES: dict[str, str] = _NAMES["baselines"]


def conditional(sentence: str, inputs: InputsPart | None, *figures: Figures) -> str:
    """Return a sentence with the conditions under which it holds."""
    sentence = sentence.strip()
    right = assumption(inputs, *figures)
    return f"Only if {right}: {numbers.lower_first(sentence)}" if right and sentence else sentence


def condition(inputs: InputsPart | None, *figures: Figures) -> str:
    """Return the conditions of a number in brackets, empty where there are none."""
    right = assumption(inputs, *figures)
    return f"(only if {right})" if right else ""


def assumption(inputs: InputsPart | None, *figures: Figures) -> str:
    """Return what has to be right for some figures to hold, as it follows "only if"; empty where no doubt touches them."""
    assumptions = inputs.assumptions(*figures) if inputs else ()
    return numbers.join(assumptions) if len(assumptions) <= 2 else f"{len(assumptions)} doubted inputs are right"


def untouched(inputs: InputsPart | None, there: Collection[Figures] = tuple(_FIGURE_WORDS)) -> str:
    """Return one sentence on what holds whatever becomes of the doubts, empty where nothing is doubted or nothing is left."""
    if inputs is None or not inputs.doubts:
        return ""
    held = [words for figure, words in _FIGURE_WORDS.items() if figure in there and not inputs.assumptions(figure)]
    return f"Not affected: {numbers.join(held)}." if held else ""


def parameters(values: Mapping[str, Any], ranges: Mapping[str, Range] | None = None) -> str:
    """Return parameters in words, ``name value unit``, each with the values that fit as well where their range is known."""
    as_well = {name: _as_well(name, fits) for name, fits in (ranges or {}).items() if name in values}
    return ", ".join(f"{_parameter(name, value)}{as_well.get(name, '')}" for name, value in values.items())


def _parameter(name: str, value: Any) -> str:
    """One parameter in words; an instant as time since the start."""
    if name == "time_s" and isinstance(value, int | float):
        return f"{numbers.duration(float(value))} after the start"
    for ending, unit in _UNITS.items():
        if name.endswith(ending):
            return f"{name.removesuffix(ending).replace('_', ' ')} {in_words(value)} {unit}"
    # A sensor has the name that its file gives it; other choices are names of the results.
    return f"{name.replace('_', ' ')} {value if name == 'sensor' else in_words(value)}"


def _as_well(name: str, fits: Range) -> str:
    """The values of a parameter that fit as well, in brackets."""
    others = [word for word in fits if isinstance(word, str)]
    if others or not fits:
        return f" (or {numbers.join(others if name == 'sensor' else [in_words(word) for word in others])})"
    show = numbers.duration if name == "time_s" else numbers.number
    low, high = (None if value is None else show(float(value)) for value in fits)
    if low is None and high is None:
        return " (not determined)"
    return f" (at most {high})" if low is None else f" (at least {low})" if high is None else f" ({low} to {high})"


def in_words(value: Any) -> str:
    """Return the value of a parameter or of a piece of evidence for a table cell."""
    if isinstance(value, Sequence) and not isinstance(value, str):
        return numbers.join([in_words(item) for item in value])
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        return numbers.number(float(value), 3)
    return "–" if value is None else str(value).replace("_", " ")


# What a run found: the choices behind each statement of report and terminal, whose words are in
# ``templates/sentences.j2``.

TEMPLATES = Path(__file__).parent / "templates"
#: Axis values in the terms of ISO 230-2:2014, in the order of the report.
ISO230_TERMS: dict[str, str] = _NAMES["iso230"]
#: Values of each direction, in the terms of the standard.
ONE_WAY_TERMS: dict[str, str] = _NAMES["iso230_one_way"]
#: Signs of the directions of approach.
ARROWS = {"positive": "↑", "negative": "↓"}
#: Inputs of the uncertainty of a positioning test in words.
CONTRIBUTORS: dict[str, str] = _NAMES["contributors"]


def _compiled(pattern: str) -> jinja2.BytecodeCache | None:
    """Return where compiled templates are kept: beside the compiled modules, where that can be written."""
    folder = Path(__file__).parent / "__pycache__"
    return jinja2.FileSystemBytecodeCache(str(folder), pattern) if os.access(folder, os.W_OK) else None


@cache
def environment(*, html: bool) -> jinja2.Environment:
    """Return the templates with what formats values in them; text from files is escaped where a page is made."""
    made = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES), autoescape=html, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined,
        finalize=_without_control if html else None, bytecode_cache=_compiled(f"{'page' if html else 'text'}_%s.jinja"),
    )  # fmt: skip
    formats = (
        anomaly_cause, anomaly_place, by_effect, caption, condition, conditional, counted, drift_size, limited, parameters, quantity,
        region_words, variance_left, whole_percent,
    )  # fmt: skip
    # Filters of the templates' own language, such as join, stay.
    made.filters = {**dict(getmembers(numbers, isfunction)), **made.filters}
    made.filters |= {function.__name__: function for function in formats}
    made.filters |= {
        "channel": lambda name: CHANNELS.get(name, name),
        "contributor": lambda name: CONTRIBUTORS.get(name, name),
        "edges": edges,
        "error_of": lambda name, loop: getattr(loop.baselines, name).rmse_um,
        "effect": effect_words,
        "input_name": lambda name: INPUT_NAMES.get(name, name),
        "is_record": lambda loop: isinstance(loop, RecordLoop),
        "listed": numbers.join,
        "scatter_um": scatter_of,
    }
    made.globals["text"] = Words
    made.tests |= {
        "assumed": lambda origin: origin.startswith("assumed"),
        "numeric": lambda title: not isinstance(title, Words),
    }
    found = (
        numbers.alike, baseline_words, beaten_by_repetition, better_plain, drift_extremes, extrapolates, figures_of, figures_of_anomalies,
        quoted_term, quoted_values, randomised_causes, untouched, worse_channels,
    )  # fmt: skip
    made.globals |= {"say": say, **{function.__name__: function for function in found}}
    return made


def _without_control(value: object) -> object:
    """Return a text of which no character acts on the text around it; what is HTML already is made of such texts."""
    return printable(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def sentences(name: str, *facts: Any, template: str = "sentences.j2") -> list[str]:
    """Return the lines of a statement as plain text."""
    macro = getattr(environment(html=False).get_template(template).module, name)
    return [" ".join(line.split()) for line in macro(*facts).split("\n") if line.strip()]


def say(name: str, *facts: Any) -> str:
    """Return a statement of ``sentences.j2`` as plain text on one line."""
    return " ".join(sentences(name, *facts))


def caption(chart: str) -> str:
    """Return what a chart of the report shows, by its name, of which a number at its end tells one of several."""
    captions = environment(html=False).get_template("captions.j2").module.captions  # type: ignore[attr-defined]
    return str(captions[re.sub(r"_\d+$", "", chart)])


def iso230_values(iso: Iso230Window) -> dict[str, str]:
    """Return the axis values with their expanded uncertainty (k = 2) by symbol, with their unit."""
    return {symbol: quantity(getattr(iso, f"{symbol}_um"), numbers.print_unit(iso.unit)) for symbol in ISO230_TERMS}


def quoted_values(iso: Iso230Window) -> dict[str, str]:
    """Return the axis values to quote with their expanded uncertainty (k = 2) by symbol: A, R and B, of one approach A and R.

    Of one cycle, which has neither A nor R, they are E, M and B, of one approach E.
    """
    side, unit = iso.approach, numbers.print_unit(iso.unit)
    of_side = getattr(iso, side) if side else iso
    once = of_side.A_um.value is None and of_side.E_um.value is not None
    symbols, arrow = ("E" if once else "AR", ARROWS[side]) if side else ("EMB" if once else "ARB", "")
    return {f"{symbol}{arrow}": quantity(getattr(of_side, f"{symbol}_um"), unit) for symbol in symbols}


def quoted_term(symbol: str) -> str:
    """Return the term of the standard for the symbol of a quoted value, which ends with it."""
    return ISO230_TERMS.get(symbol) or f"{ONE_WAY_TERMS[symbol[0]]}{symbol[1:]}"


def check_words(code: str, facts: Mapping[str, Any]) -> dict[str, str]:
    """Return the words of a check; its remedy where it is not passed, or not verified."""
    assumption, endangers = environment(html=False).get_template("consistency.j2").module.conditions[code]  # type: ignore[attr-defined]
    evidence, *remedy = sentences(code, facts, template="consistency.j2")
    needed = [] if facts["passed"] and facts["verified"] else remedy
    return {"assumption": assumption, "endangers": endangers, "evidence": evidence, "remedy": " ".join(needed)}


class DriftExtreme(NamedTuple):
    """Range of the drift at one position, µm; `negligible` where it is below its standard uncertainty: none that the readings show."""

    size: Quantity
    target: int
    position_mm: float | None
    negligible: bool


def drift_extremes(drift: DriftPart) -> tuple[DriftExtreme, DriftExtreme]:
    """Return the largest and the smallest range of the drift."""
    ranges = {at: value for at, value in enumerate(drift.range_um) if value is not None}

    def extreme(at: int) -> DriftExtreme:
        u = drift.range_u_um[at]
        negligible = u is not None and ranges[at] < u
        return DriftExtreme(Quantity(value=ranges[at], u=u), at + 1, drift.position_mm[at], negligible)

    return extreme(max(ranges, key=ranges.__getitem__)), extreme(min(ranges, key=ranges.__getitem__))


def drift_size(one: DriftExtreme) -> str:
    """Return the range of the drift at one position with its uncertainty, of none that the readings show the bound."""
    return f"below {numbers.number(2 * (one.size.u or 0.0), 2)} µm" if one.negligible else quantity(one.size, "µm")


def anomaly_place(anomaly: AnomalyPart) -> str:
    """Return which target and direction of approach stand out."""
    approach = "both approaches" if anomaly.direction == "both" else f"{anomaly.direction} approach"
    return f"position {anomaly.target}, {approach}"


def anomaly_cause(anomaly: AnomalyPart) -> str:
    """Return the cause of an anomaly in words."""
    return CAUSES[anomaly.cause].words


def anomaly_figures(anomaly: AnomalyPart) -> tuple[Figures, ...]:
    """Return what the statement on an anomaly rests on: the laser, and the camera where the cause is a temperature."""
    return ("positions", "field") if anomaly.cause == "local_temperature" else ("positions",)


def figures_of_anomalies(anomalies: Iterable[AnomalyPart]) -> list[Figures]:
    """Return what the statements on all anomalies rest on."""
    return sorted({"positions", *(figure for anomaly in anomalies for figure in anomaly_figures(anomaly))})


def scatter_of(anomaly: AnomalyPart) -> float | None:
    """Return the standard deviation of the approach that stands out, µm; root mean square of both where both do."""
    evidence = anomaly.evidence
    sides = {"positive": evidence.scatter_positive_um, "negative": evidence.scatter_negative_um}
    if anomaly.direction != "both":
        return sides[anomaly.direction]
    known = [value for value in sides.values() if value is not None]
    return float((sum(value**2 for value in known) / len(known)) ** 0.5) if known else None


def edges(area: AreaPart | None) -> str:
    """Return the edges of an area on the plan, mm; a dash where there is none."""
    if area is None:
        return "–"
    return f"x {area.x_low_mm:.0f} to {area.x_high_mm:.0f} mm, y {area.y_low_mm:.0f} to {area.y_high_mm:.0f} mm"


def figures_of(results: Results) -> list[Figures]:
    """Return which kinds of figures a run has: of the laser, of the camera, and of both together."""
    there: list[Figures] = []
    if results.iso230 is not None or results.loop is not None:
        there.append("positions")
    if results.registration is not None:
        there.append("field")
    if results.correlation is not None:
        there.append("attribution")
    return there


def randomised_causes(correlation: CorrelationPart) -> list[str]:
    """Return the loads that randomisation shows to move the axis."""
    return [load.name for load in correlation.randomised_duty or () if load.cause]


def beaten_by_repetition(loop: Loop) -> str:
    """Return what the plain repetition predicts better than: the final "model", the "declared" one alone, or neither (empty)."""
    plain, declared, final = loop.rmse_persistence_um, loop.rmse_declared_um, loop.rmse_final_um
    if plain is None or declared is None or final is None:
        return ""
    return "model" if plain < final else "declared" if plain < declared else ""


#: Error of the declared model over that of the last value from which on it is no reference for what was added.
_EXTRAPOLATED = 2.0


def extrapolates(loop: Loop) -> bool:
    """Return whether the declared model misses the hold-out set by a multiple of what repeating the last value misses it by."""
    return (loop.rmse_declared_um or 0.0) > _EXTRAPOLATED * (loop.rmse_persistence_um or float("inf"))


class PlainPrediction(NamedTuple):
    """A plain prediction in words with its error on the hold-out, beside that of the model, µm."""

    words: str
    rmse_um: float
    final_um: float


def better_plain(loop: Loop) -> PlainPrediction | None:
    """Return the last value or the mean, whichever predicts better, where the model predicts no better than that."""
    words, final = baseline_words(loop), loop.rmse_final_um
    known = [
        (error, name) for name in ("last_value", "mean") if (error := getattr(loop.baselines, name).rmse_um) is not None
    ]
    if final is None or not known:
        return None
    error, name = min(known)
    return PlainPrediction(words[name], error, final) if error < ERROR_BY_CHANCE * final else None


def variance_left(share: float | None) -> str:
    """Return the share of a variance that a prediction leaves, in per cent; "all" where the mean itself would leave less."""
    return "–" if share is None else "all" if share > 1.0 else f"{numbers.number(100 * share, 2)} %"


def by_effect(parts: Iterable[DriftShare]) -> list[DriftShare]:
    """Return what the drift follows with each effect once, in their order: several sudden steps have one share together."""
    together: dict[str, DriftShare] = {}
    for part in parts:
        before = together.get(part.effect)
        together[part.effect] = (
            part if before is None else before.model_copy(update={"share": (before.share or 0.0) + (part.share or 0.0)})
        )
    return list(together.values())


def whole_percent(share: float) -> str:
    """Return a share of 1 in whole per cent, without one that only rounding makes 0 or 100."""
    return "less than 1 %" if share <= 0.005 else "more than 99 %" if share >= 0.995 else f"{100 * share:.0f} %"


def worse_channels(loop: Loop) -> list[tuple[str, ChannelErrors]]:
    """Return the channels of a record whose error does not fall with the added effects."""
    channels = loop.channels if isinstance(loop, RecordLoop) else {}
    return [(name, one) for name, one in channels.items() if (one.rmse_final_um or 0.0) > (one.rmse_declared_um or 0.0)]


def model_errors(loop: Loop) -> dict[str, ModelError]:
    """Return the errors of the model in words; of a record of one run with that from the last values before the hold-out."""
    errors = {"declared model": loop.errors.declared, "with the added effects": loop.errors.final}
    if isinstance(loop, RecordLoop) and loop.anchored:
        errors["from the last values before it, with the readings since"] = loop.anchored.model
    return errors


def baseline_words(loop: Loop) -> dict[str, str]:
    """Return plain predictions in words, by their key in ``loop.baselines``: along an axis cycles, of a record values."""
    record = isinstance(loop, RecordLoop)
    return {
        name: words.replace("cycles before", "time before").replace("cycle", "value") if record else words
        for name, words in BASELINES.items()
        if getattr(loop.baselines, name, None) is not None
    }
