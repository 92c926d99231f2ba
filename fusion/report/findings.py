"""Conclusions of a run as answers to a reader's questions: why, how much, where, how sure, which place, what remains."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import rich.table

from fusion.messages import cell
from fusion.report.wording import (
    ARROWS,
    baseline_words,
    condition,
    conditional,
    figures_of,
    randomised_causes,
    say,
    untouched,
)
from fusion.results.axis import DriftPart, Iso230Part, RegistrationPart
from fusion.results.loop import Loop, RecordLoop, StepPart
from fusion.results.numbers import alike, number, p_words
from fusion.results.parts import Figures, TimePart, decide
from fusion.results.results import Results

#: Question of a reader, and the statement that answers it.
_QUESTIONS = {
    "How much": "how_much",
    "Where": "where",
    "How sure": "how_sure",
    "Which place": "which_place",
    "What remains": "what_remains",
}


class Conclusion(NamedTuple):
    """One conclusion of a run: the question that it answers, and sentences."""

    question: str
    text: str


def conclude(results: Results) -> list[Conclusion]:
    """Return the conclusions of a run in the order of a reader's questions; those that the run does not answer are absent."""
    answers = [Conclusion(question, say(statement, results)) for question, statement in _QUESTIONS.items()]
    return [answer for answer in answers if answer.text]


def headline(results: Results) -> str:
    """Return one sentence that states the outcome, conditional where an input is doubted."""
    return say("headline", results)


#: Most actions on the first screen, and words of each.
_FIRST_STEPS, _WORDS = 3, 14
_BRACKETS = re.compile(r" \([^()]*\)")
#: Where a sentence may end before its end.
_CLAUSE = re.compile(r"[;:] |, and | for ")
_CONDITION = re.compile(r"^Only if [^:]+: ")


def in_brief(step: str) -> str:
    """Return the beginning of an action: its clauses as far as a line holds them, without what stands in brackets."""
    sentence = _BRACKETS.sub("", _if_so(step)).split(". ")[0].rstrip(".")
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
    still_open = "" if inputs is None else say("open_inputs", inputs)
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
        "decision": decision,
        "unmet": "" if iso is None else say("unmet", iso),
        "cause": _if_so(say("why", results)),
        "open": still_open,
        "next": [in_brief(step) for step in next_steps(results)[: _FIRST_STEPS - bool(still_open)]],
    }


def _cameras(results: Results) -> str:
    """Return the camera that took the pictures, with its serial number, or of how many cameras they are; empty where it is not known."""
    names = [one.name.rpartition(", ")[0] for one in results.thermograms.cameras] if results.thermograms else []
    return names[0] if len(names) == 1 else f"{len(names)} cameras" if names else ""


# Added effects in words: what each is, and what to check.


def step_phrase(step: StepPart, time: TimePart | None, *, record: bool) -> str:
    """Return an added effect with what it follows, or when it happened."""
    return say("step_phrase", step, time, record)


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
                (row.text.split()[0] for row in iso.conditions if row.name == "Expansion coefficient" and row.text), ""
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
    """Return what to do next: doubted inputs, what the loop found, positions that stand out, the place, remedies of the warnings."""
    inputs = results.inputs
    steps = [check.remedy for check in (*inputs.doubts, *inputs.unverified)] if inputs else []
    loop, correlation = results.loop, results.correlation
    if loop is not None:
        # Where no cause is separable, none is to be looked for.
        shown = loop.steps if loop.separable else ()
        actions = [action(step, results.time, record=results.registration is None) for step in shown]
        steps += [conditional(one, inputs, "causes") for one in actions]
        if loop.verdict in {"partial", "unexplained", "no_skill"} and loop.separable and not _clock_doubted(results):
            steps.append(say("log_more", loop.unexplained.shape))
    steps += [say("position_action", anomaly) for anomaly in results.anomalies or ()]
    if correlation is not None and correlation.verdict == "attributable" and not randomised_causes(correlation):
        steps.append(say("test_place", correlation.source))
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
    return unique or [f"Nothing has to be done: use the {values} with the stated uncertainty as they are."]


# What the command prints.


def summary_table(results: Results) -> rich.table.Table:
    """Return the findings of a run as a table for the terminal."""
    printed = rich.table.Table(title=cell(results.campaign), title_justify="left", show_header=False, pad_edge=False)
    printed.add_column(no_wrap=True)
    printed.add_column(overflow="fold")
    for name, text in summary_rows(results):
        # Names of keys stand in brackets, which rich would take for styles.
        printed.add_row(cell(name), cell(text))
    return printed


def summary_rows(results: Results) -> list[tuple[str, str]]:
    """Return names and texts of the findings of a run, in the order of the report."""
    rows: list[tuple[str, str]] = []
    if results.inputs is not None and not (results.thermograms and not results.thermograms.series):
        doubts = [f"doubted: {check.evidence} {check.remedy}" for check in results.inputs.doubts]
        lines = [line for line in (*doubts, untouched(results.inputs, figures_of(results))) if line]
        open_checks = [f"not verified: {check.evidence} {check.remedy}" for check in results.inputs.unverified]
        sound = [] if lines else [f"sound in {len(results.inputs.checks)} checks"]
        rows.append(("inputs", "\n".join([*lines, *sound, *open_checks])))
    if results.regions is not None:
        several = results.thermograms is not None and len(results.thermograms.cameras) > 1
        shown = [one for one in results.regions if not several or one.name == "whole picture"]
        rows += [(one.camera if several else one.name, say("region_line", one)) for one in shown]
    if results.registration is not None and results.thermograms is None:
        rows.append(("registration", _registration(results.registration)))
    if results.drift is not None:
        scatter = _scatter_range(results.drift)
        rows.append(("scatter per position", f"{scatter} {condition(results.inputs, 'positions')}".rstrip()))
    if results.loop is not None:
        rows.append(("verdict", f"{results.loop.verdict.replace('_', ' ')}: {headline(results)}"))
    rows += [(answer.question.lower(), answer.text) for answer in conclude(results)]
    if results.loop is not None:
        rows.append(("declared", ", ".join(results.loop.declared) or "nothing"))
        found = _loop_rows(results.loop)
        rows += [(name, f"{text} {condition(results.inputs, figures)}".rstrip()) for name, text, figures in found]
        rows += _run_rows(results.loop)
    steps = enumerate(next_steps(results), start=1)
    rows.append(("next", "\n".join(f"{number}. {step}" for number, step in steps)))
    return rows + [("warning", warning.message) for warning in results.warnings]


def _registration(part: RegistrationPart) -> str:
    """Return the scatter of the fiducials; of four, which determine the plan exactly, the uncertainty."""
    if part.rms_mm is None or not math.isfinite(part.rms_mm):
        count = len(part.leave_one_out_mm)
        return f"standard uncertainty {number(part.position_u_mm, 2)} mm, not checked: {count} fiducials determine the plan exactly"
    return f"{number(part.rms_mm, 2)} mm rms"


def _scatter_range(drift: DriftPart) -> str:
    """Return smallest, largest and median scatter over targets and directions, µm."""
    scatter = drift.scatter_um.values()
    if not scatter:
        return "not known: no position has enough readings"
    least, largest, median = alike([min(scatter), max(scatter), float(np.median(scatter))], distinct=False)
    # A variance whose estimate is negative is kept as zero: no position is free of scatter.
    span = f"{least} to" if min(scatter) > 0.0 else "up to"
    return f"{span} {largest} µm, median {median} µm"


def _loop_rows(loop: Loop) -> list[tuple[str, str, Figures]]:
    """Return name and text of what the model is and predicts, with the figures that each rests on."""
    rows: list[tuple[str, str, Figures]] = []
    for step in loop.steps:
        doubt = f", {say('doubt', step)}" if step.doubt else ""
        one_of = f"one of {', '.join((step.effect, *step.tied))}" if step.tied else step.effect
        without = f", without a name: {step.withheld}" if step.withheld else ""
        rows.append(
            ("added", f"{one_of} ({p_words(step.p_value)}), {say('step_errors', step)}{doubt}{without}", "causes")
        )
    stages = (loop.errors.declared, loop.errors.final) if loop.steps else (loop.errors.declared,)
    numbers = iter(alike([value for one in stages for value in (one.rmse_um, one.low_um, one.high_um)], distinct=False))
    errors = " -> ".join(
        f"{error} [{low} to {high}]" for error, low, high in zip(numbers, numbers, numbers, strict=True)
    )
    words = baseline_words(loop)
    names = dict.fromkeys(name for name in ("last_value", "mean", "mean_run", loop.best_baseline) if name in words)
    plain = alike([getattr(loop.baselines, name).rmse_um for name in names], distinct=False)
    baselines = ", ".join(f"{words[name]} {error}" for name, error in zip(names, plain, strict=True))
    return [
        *rows,
        ("held-out error", f"{errors} µm", "positions"),
        ("plain predictions", f"{baselines} µm", "positions"),
        ("noise floor", f"{number(loop.noise_floor_um, 3)} µm", "positions"),
    ]


def _run_rows(loop: Loop) -> list[tuple[str, str]]:
    """The runs that are held out of a record of several, each with its error before and after and its verdict."""
    rows = []
    for run in loop.runs if isinstance(loop, RecordLoop) else ():
        if run.held_out:
            errors = (run.rmse_declared_um, run.rmse_final_um, run.rmse_persistence_um)
            declared, final, plain = (number(error, 3) for error in errors)
            rows.append((f"run {run.file}", f"{run.verdict}: {declared} -> {final} µm, its zero repeated {plain} µm"))
    return rows
