"""Findings of a run, which every output shows in this order; what is on the first screen, and what to do next."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import rich.table

from fusion.common.messages import cell
from fusion.report.wording import (
    ARROWS,
    ISO230_TERMS,
    condition,
    conditional,
    drift_extremes,
    quantity,
    quoted_values,
    say,
    sentences,
)
from fusion.results.axis import DriftPart, Iso230Part
from fusion.results.loop import RecordLoop, StepPart
from fusion.results.numbers import alike, print_unit
from fusion.results.parts import Figures, Quantity, TimePart, decide
from fusion.results.results import Results


def headline(results: Results) -> str:
    """Return one sentence that states the outcome, conditional where an input is doubted."""
    return say("headline", results)


#: Most actions on the first screen, and words of each.
_FIRST_STEPS, _WORDS = 2, 14
#: Most of them on the terminal.
_PRINTED_STEPS = 2
_BRACKETS = re.compile(r" \([^()]*\)")
#: Where a sentence may end before its end.
_CLAUSE = re.compile(r"[;:] |, and | for ")
_CONDITION = re.compile(r"^Only if [^:]+: ")
_UNCONFIRMED = re.compile(r"^Not confirmed, check this only where nothing else is found: ")


def in_brief(step: str) -> str:
    """Return the beginning of an action: its clauses as far as a line holds them, without what stands in brackets."""
    step = _UNCONFIRMED.sub("Unconfirmed: ", _if_so(step))
    sentence = _BRACKETS.sub("", step).split(". ")[0].rstrip(".")
    words = sentence.split()
    line = " ".join(words[:_WORDS])
    if len(words) <= _WORDS:
        return line + "."
    ends = [found.start() for found in _CLAUSE.finditer(sentence) if len(line) / 3 < found.start() <= len(line)]
    return sentence[: ends[-1]] + "." if ends else line + " …"


def _if_so(statement: str) -> str:
    """Return a conditional statement below the inputs that it is conditional on."""
    return _CONDITION.sub("If so: ", statement)


def first_screen(results: Results, report: Mapping[str, Any], axis: str, begun: str) -> dict[str, Any]:
    """Return what a reader learns before anything else: which machine, whether it passes, why, what to doubt, what to do."""
    iso, inputs = results.iso230, results.inputs
    # A camera alone is no acceptance test, and says with its temperatures what is beyond its range.
    alone = iso is None and results.loop is None
    if alone and inputs is not None:
        inputs = inputs.model_copy(update={"accepted": (*inputs.accepted, "camera_range")})
    serial = report.get("machine_serial_number", "")
    still_open = "" if inputs is None else say("open_inputs", inputs, results.radiometry)
    decision = "" if alone else "Not an acceptance test: no tolerance applies."
    if iso is not None:
        decision = _if_so(conditional(say("decision", iso), inputs, "positions"))
    return {
        "identity": [
            report.get("machine") or (_cameras(results) if alone else "machine not stated"),
            f"no. {serial}" if serial else "",
            f"{axis} axis" if axis and f"{axis} axis" not in results.campaign else "",
            report.get("operator", ""),
            begun[:10] or "date not stated",
        ],
        "answers": _told(
            {
                "Decision": decision,
                "Acceptance": say("unmet", iso) if iso is not None and iso.tolerances else "",
                "Temperature" if alone else "Cause": _if_so(say("why", results)),
                "Map": "" if results.field is None else say("map_in_brief", results.field),
                "Place": _if_so(say("place_in_brief", results)),
                "Position": _if_so(say("position_in_brief", results)),
            }
        ),
        "open": still_open,
        "next": [in_brief(step) for step in next_steps(results)[: _FIRST_STEPS - bool(still_open)]],
    }


def _told(answers: Mapping[str, str]) -> dict[str, str]:
    return {name: text for name, text in answers.items() if text}


def _cameras(results: Results) -> str:
    """Return the camera that took the pictures, with its serial number, or of how many cameras they are; empty where it is not known."""
    names = [one.name.rpartition(", ")[0] for one in results.thermograms.cameras] if results.thermograms else []
    return names[0] if len(names) == 1 else f"{len(names)} cameras" if names else ""


# Added effects in words: what each is, and what to check.


def action(step: StepPart, time: TimePart | None, *, record: bool) -> str:
    """Return what to check on machine or instruments where an effect was missing; empty where the effect states nothing."""
    return say("action", step, time, record)


# What would make the uncertainty of the axis values smaller.

#: An uncertainty that becomes no smaller than this share of itself is not worth a line.
_WORTH = 0.8
#: Line of the campaign file and standard uncertainty of an input that is stated in place of an assumption: a coefficient that was measured
#: or certified; a contact sensor of class A (IEC 60751: 0.15 K at 0 degC, rectangular).
_STATED: dict[str, tuple[str, float]] = {
    "expansion_coefficient": ('expansion_coefficient = "{value} +- 0.3 ppm/K"', 0.3),
    "material_temperature": ('uncertainty.material_temperature = "0.1 K"', 0.1),
}
#: What stands for the first line where no value of the coefficient is known.
_STATED_WITHOUT_VALUE = "the expansion coefficient with its uncertainty, 0.3 ppm/K"
#: Cycles for one of the test, so that what shrinks with their square root is halved.
_MORE_CYCLES = 4


#: Contributions that more cycles lessen, `interferometry.iso230.SAMPLING`: a summary on the terminal does not wait for that package.
_OF_SCATTER = ("sampling", "extremes")


class Sharper(NamedTuple):
    """The largest term of the uncertainty of A, and the line of the campaign file that shrinks it most; an empty `line` where none does.

    Where the scatter of the readings is the largest term, `cycles` says how many would halve it, otherwise it is 0.
    """

    symbol: str
    contributor: str
    share: float
    origin: str
    unit: str
    expanded_um: float
    line: str = ""
    sharper_um: float = math.inf
    decision: str = ""
    cycles: int = 0


def sharpen(iso: Iso230Part | None) -> Sharper | None:
    """Return what the uncertainty of the quoted A mostly is, and by how much a stated input would shrink it (k = 2); None without one."""
    if iso is None or not iso.contributions:
        return None
    side = iso.approach
    found = (getattr(iso, side) if side else iso).A_um
    if not found.u:
        return None
    terms = {
        one.contributor: (one, (one.unidirectional_um.get(f"A_{side}") if side else one.A_um) or 0.0)
        for one in iso.contributions
    }
    largest, term = max(terms.values(), key=lambda each: each[1])
    symbol = f"A{ARROWS[side]}" if side else "A"
    told = Sharper(symbol, largest.contributor, (term / found.u) ** 2, largest.origin, iso.unit, 2 * found.u)
    for name, (line, stated_u) in _STATED.items():
        one, term = terms.get(name, (None, 0.0))
        if one is None or not one.u or not one.origin.startswith("assumed"):
            continue
        expanded = 2 * (found.u**2 - term**2 + (term * stated_u / one.u) ** 2) ** 0.5
        if expanded < _WORTH * min(told.sharper_um, told.expanded_um):
            value = next(
                (row.text.split()[0] for row in iso.conditions if row.key == "expansion_coefficient" and row.text), ""
            )
            line = line.format(value=value) if value or "{value}" not in line else _STATED_WITHOUT_VALUE
            limit = next((row.limit_um for row in iso.tolerances if row.quantity == symbol), None)
            decision = "" if limit is None else decide(found.value, expanded, limit)
            told = told._replace(line=line, sharper_um=expanded, decision=decision)
    if not told.line and told.contributor in _OF_SCATTER:
        halved = sum(terms[name][1] ** 2 for name in _OF_SCATTER if name in terms) * (1.0 - 1.0 / _MORE_CYCLES)
        told = told._replace(sharper_um=2 * (found.u**2 - halved) ** 0.5, cycles=_MORE_CYCLES * len(iso.cycles))
    return told


# What to do next, in the order of importance; every action names the place, the time or the part that it is about.


def _clock_doubted(results: Results) -> bool:
    """Whether a clock is doubted: what remains may then be its doing."""
    doubts = results.inputs.doubts if results.inputs else ()
    return any(check.code == "clocks" or check.code.endswith("_clock") for check in doubts)


def next_steps(results: Results) -> list[str]:
    """Return what to do next: doubted inputs, what the loop found, positions, the place, then what to record and state, and warnings."""
    inputs = results.inputs
    steps = [check.remedy for check in inputs.doubts] if inputs else []
    loop, correlation = results.loop, results.correlation
    # What is inspected on the machine comes before what is written or recorded.
    records = []
    if loop is not None:
        # Where no cause is separable, none is to be looked for.
        shown = loop.steps if loop.separable else ()
        actions = [action(step, results.time, record=results.registration is None) for step in shown]
        steps += [conditional(one, inputs, "causes") for one in actions]
        if loop.warm_up_only:
            records.append(say("vary_load"))
        if loop.verdict in {"partial", "unexplained", "no_skill"} and loop.separable and not _clock_doubted(results):
            records.append(say("log_more", loop.unexplained.shape))
    steps += [say("position_action", anomaly) for anomaly in results.anomalies or ()]
    if correlation is not None and correlation.verdict == "attributable":
        steps.append(say("test_place", correlation.source))
    steps += records + [check.remedy for check in (inputs.unverified if inputs else ())]
    steps += [warning.remedy for warning in results.warnings]
    unique = list(dict.fromkeys(step for step in steps if step))
    if (sharper := sharpen(results.iso230)) is not None and sharper.line:
        # What makes a decision possible comes first.
        unique.insert(0 if sharper.decision in ("pass", "fail") else len(unique), say("sharper_step", sharper))
    judged = {row.quantity: row.decision for row in results.iso230.tolerances} if results.iso230 else {}
    if judged.get("A") != "pass" and (compensation := say("compensation_step", results)):
        unique.insert(0 if judged.get("A") == "fail" else len(unique), compensation)
    values = "profile" if results.drift else "values by ISO 230-2" if results.iso230 else "temperatures"
    if isinstance(loop, RecordLoop):
        values = "displacements"
    return unique or [f"Nothing has to be done; use the {values} as they are, with their uncertainty."]


# The findings of a run in the order in which they are told.


class Tile(NamedTuple):
    """A number on the first screen: what it is, the number with its unit, and what it is of."""

    name: str
    value: str
    note: str = ""


class Finding(NamedTuple):
    """What a run found, with what each output shows of it.

    `name` and `text` stand on the terminal and in the workbook, `tile` on the first screen of report and application, `value` in its `unit`
    in the summary of a fleet.
    """

    code: str
    name: str
    text: str
    tile: Tile | None
    value: Quantity | None
    unit: str


def findings(results: Results) -> list[Finding]:
    """Return the findings of a run in the order in which they are told; their words are statements of ``sentences.j2``, by code."""
    found: list[Finding] = []
    loop, drift, pictures, regions = results.loop, results.drift, results.thermograms, results.regions or ()

    def add(
        code: str, name: str = "", of: object = results, *, text: str = "", tile: str = "", rests_on: Figures | None = None,
        value: Quantity | None = None, unit: str = "",
    ) -> None:  # fmt: skip
        text = text or (say(code, of) if name else "")
        if text or tile or value:
            limits = condition(results.inputs, rests_on) if rests_on else ""
            shown = Tile(tile, *sentences(f"{code}_tile", of)) if tile else None
            found.append(Finding(code, name if text else "", f"{text} {limits}".rstrip(), shown, value, unit))

    if results.inputs is not None and (pictures is None or pictures.series):
        add("inputs", "inputs", text="\n".join(sentences("inputs", results)))
    if results.iso230 is not None:
        for symbol, quoted in _quoted(results, results.iso230).items():
            add("quoted", of=(quoted, results.iso230.window), tile=f"{symbol}, ISO 230-2")
        for symbol in ISO230_TERMS:
            add(symbol, value=getattr(results.iso230, f"{symbol}_um"), unit=results.iso230.unit)
    if isinstance(loop, RecordLoop):
        moved = [one for test in results.iso230_3 or () for one in test.distortions if one.unit == "um"]
        for most in sorted(moved, key=lambda one: one.whole.value or 0.0, reverse=True)[:1]:
            add("drift", of=most, tile="Largest drift", value=most.whole, unit="um")
    elif drift is not None and drift.range_um:
        largest, _ = drift_extremes(drift)
        add("drift", of=largest, tile="Largest drift", value=largest.size, unit="um")
    if results.field is not None:
        # Beside the values of an axis the largest rise says enough.
        add("mean_rise", of=results.field, tile="" if results.iso230 else "Table, mean rise")
    elif pictures is not None:
        own = [one for one in regions if one.camera == pictures.series] or regions
        for code, name in (("highest", "Highest"), ("lowest", "Lowest"), ("mean", "Mean")):
            add(code, of=(own[0], pictures), tile=name)
    several = pictures is not None and len(pictures.cameras) > 1
    for one in regions:
        if not several or one.name == "whole picture":
            add("region_line", one.camera if several else one.name, one)
    if results.registration is not None and pictures is None:
        add("registration", "registration", results.registration)
    if drift is not None:
        add("scatter", "scatter per position", text=_scatter_range(drift), rests_on="positions")
    if loop is not None:
        add("verdict", "verdict", text=f"{say('verdict_word', loop).replace('_', ' ')}: {headline(results)}")
    for code in ("how_much", "where", "how_sure", "which_place", "what_remains"):
        add(code, code.replace("_", " "))
    if loop is not None:
        add("declared", "declared", text=", ".join(loop.declared) or "nothing")
        for step in loop.steps:
            add("added", "added", step, rests_on="causes")
        error = Quantity(value=loop.rmse_final_um, u=None)
        add("held_out", "held-out error", loop, tile="Held-out error", rests_on="positions", value=error, unit="um")
        add("plain_predictions", "plain predictions", loop, rests_on="positions")
        add("noise_floor", "noise floor", loop, rests_on="positions")
    if isinstance(loop, RecordLoop):
        add("unexplained", of=loop, tile="Unexplained variance")
        for run in (one for one in loop.runs if one.held_out):
            add("run_line", f"run {run.file}", run)
    add("next", "next", text=_numbered(next_steps(results)))
    for warning in results.warnings:
        add("warning", "warning", text=warning.message)
    return found


def _numbered(steps: list[str]) -> str:
    return "\n".join(f"{number}. {step}" for number, step in enumerate(steps, start=1))


def _quoted(results: Results, iso: Iso230Part) -> dict[str, str]:
    """Return A by ISO 230-2, and where the readings of the laser say nothing else the other values that are quoted."""
    quoted = quoted_values(iso)
    if results.loop is not None or results.drift is not None or results.field is not None:
        return dict(list(quoted.items())[:1])
    return quoted | ({} if iso.A_um.value is None else {"M": quantity(iso.M_um, print_unit(iso.unit))})


def _scatter_range(drift: DriftPart) -> str:
    """Return smallest, largest and median scatter over targets and directions, µm."""
    scatter = drift.scatter_um.values()
    if not scatter:
        return "not known: no position has enough readings"
    least, largest, median = alike([min(scatter), max(scatter), float(np.median(scatter))], distinct=False)
    # A variance whose estimate is negative is kept as zero: no position is free of scatter.
    span = f"{least} to" if min(scatter) > 0.0 else "up to"
    return f"{span} {largest} µm, median {median} µm"


# What the command prints.


def summary_table(results: Results) -> rich.table.Table:
    """Return the findings of a run as a table for the terminal."""
    return _printed(results, summary_rows(results))


def brief_table(results: Results) -> rich.table.Table:
    """Return what the first screen of the report says as a table of about twelve lines for the terminal."""
    return _printed(results, brief_rows(results), box=None)


def _printed(results: Results, rows: list[tuple[str, str]], **looks: Any) -> rich.table.Table:
    printed = rich.table.Table(
        title=cell(results.campaign), title_justify="left", show_header=False, pad_edge=False, **looks
    )
    printed.add_column(no_wrap=True)
    printed.add_column(overflow="fold")
    for name, text in rows:
        # Names of keys stand in brackets, which rich would take for styles.
        printed.add_row(cell(name), cell(text))
    return printed


def brief_rows(results: Results) -> list[tuple[str, str]]:
    """Return names and texts of what the first screen of the report says."""
    first = first_screen(results, {}, "", "")
    shown = [one.tile for one in findings(results) if one.tile]
    figures = "; ".join(f"{tile.name.removesuffix(', ISO 230-2')} {tile.value}" for tile in shown)
    rows = {
        "Inputs": first["open"],
        **first["answers"],
        "Figures": figures,
        "Next": _numbered(first["next"][:_PRINTED_STEPS]),
    }
    return [(name.lower(), text) for name, text in _told(rows).items() if name != "Acceptance"]


def summary_rows(results: Results) -> list[tuple[str, str]]:
    """Return names and texts of the findings of a run."""
    return [(one.name, one.text) for one in findings(results) if one.name]
