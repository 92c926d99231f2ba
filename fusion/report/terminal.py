"""What the command prints: findings of a run, an ISO 230-2 evaluation, a duty schedule, and what a file holds."""

from __future__ import annotations

import math

import numpy as np
import rich.table

from fusion.messages import cell
from fusion.report.findings import conclude, headline, next_steps
from fusion.report.wording import baseline_words, condition, figures_of, say, untouched
from fusion.results.axis import DriftPart, RegistrationPart
from fusion.results.loop import Loop, RecordLoop
from fusion.results.numbers import alike, number, p_words
from fusion.results.parts import Figures
from fusion.results.results import Results


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
