"""What the command prints: findings of a run, an ISO 230-2 evaluation, a duty schedule, and what a file holds."""

from __future__ import annotations

import math
from collections.abc import Sequence

import rich.table

from fusion.campaign.quantities import read_option
from fusion.products.results import Results
from fusion.products.results_axis import RegistrationPart
from fusion.products.results_inputs import Figures
from fusion.products.results_loop import Loop, RecordLoop
from fusion.report.conclusions.actions import next_steps
from fusion.report.conclusions.answers import conclude, headline
from fusion.report.findings import (
    baseline_errors,
    figures_of,
    hold_out_errors,
    scatter_range,
    step_errors,
)
from fusion.report.wording import (
    condition,
    duration,
    number,
    p_words,
    untouched,
)
from fusion.terminal import cell


def summary_table(results: Results) -> rich.table.Table:
    """Return the findings of a run as a table for the terminal.

    Parameters
    ----------
    results : Results
        Results of a run.
    """
    printed = rich.table.Table(title=cell(results.campaign), title_justify="left", show_header=False, pad_edge=False)
    printed.add_column(no_wrap=True)
    printed.add_column(overflow="fold")
    for name, text in summary_rows(results):
        # Names of keys stand in brackets, which rich would take for styles.
        printed.add_row(cell(name), cell(text))
    return printed


def summary_rows(results: Results) -> list[tuple[str, str]]:
    """Return names and texts of the findings of a run, in the order of the report.

    Parameters
    ----------
    results : Results
        Results of a run.
    """
    rows: list[tuple[str, str]] = []
    if results.inputs is not None:
        doubts = [f"doubted: {check.evidence} {check.remedy}" for check in results.inputs.doubts]
        lines = [line for line in (*doubts, untouched(results.inputs, figures_of(results))) if line]
        rows.append(("inputs", "\n".join(lines) or f"sound in {len(results.inputs.checks)} checks"))
    if results.registration is not None:
        rows.append(("registration", _registration(results.registration)))
    if results.drift is not None:
        rows.append(("scatter per position", _under(scatter_range(results.drift), results, "positions")))
    if results.loop is not None:
        rows.append(("verdict", f"{results.loop.verdict.replace('_', ' ')}: {headline(results)}"))
    rows += [(answer.question.lower(), answer.text) for answer in conclude(results)]
    if results.loop is not None:
        rows += _loop_rows(results, results.loop)
    steps = enumerate(next_steps(results), start=1)
    rows.append(("next", "\n".join(f"{number}. {step}" for number, step in steps)))
    return rows + [("warning", warning.message) for warning in results.warnings]


def _registration(part: RegistrationPart) -> str:
    """Return the scatter of the fiducials; of four, which determine the plan exactly, the uncertainty; of a picture, that it is one."""
    if part.is_picture:
        return "none: the picture is the plan, lengths in px"
    if part.rms_mm is None or not math.isfinite(part.rms_mm):
        count = len(part.leave_one_out_mm)
        return f"standard uncertainty {number(part.position_u_mm, 2)} mm, not checked: {count} fiducials determine the plan exactly"
    return f"{number(part.rms_mm, 2)} mm rms"


def _run_rows(loop: Loop) -> list[tuple[str, str]]:
    """The runs that are held out of a record of several, each with its error before and after and its verdict."""
    runs = loop.runs if isinstance(loop, RecordLoop) else ()
    return [
        (
            f"run {run.file}",
            f"{run.verdict}: {number(run.rmse_declared_um, 3)} -> {number(run.rmse_final_um, 3)} µm, "
            f"its zero repeated {number(run.rmse_persistence_um, 3)} µm",
        )
        for run in runs
        if run.held_out
    ]


def _loop_rows(results: Results, loop: Loop) -> list[tuple[str, str]]:
    rows = [("declared", ", ".join(loop.declared) or "nothing")]
    for step in loop.steps:
        text = (
            f"{step.effect} ({p_words(step.p_value)}), {step_errors(step)}{'' if step.confirmed else ', not confirmed'}"
        )
        rows.append(("added", _under(text, results, "causes")))
    return [
        *rows,
        ("held-out error", _under(hold_out_errors(loop), results, "positions")),
        ("plain predictions", _under(baseline_errors(loop), results, "positions")),
        ("noise floor", _under(f"{number(loop.noise_floor_um, 3)} µm", results, "positions")),
        *_run_rows(loop),
    ]


def _under(text: str, results: Results, *figures: Figures) -> str:
    """Return a finding with the conditions under which it holds."""
    return f"{text} {condition(results.inputs, *figures)}".rstrip()


def duty_lines(
    sources: Sequence[str], *, effect: str, drift: str, noise: str, cycle: str, power: float, seed: int
) -> list[str]:
    """Propose a duty schedule: how long, with what power, and when to switch what.

    Parameters
    ----------
    sources : sequence of str
        Heat sources with their time constants, ``"spindle=40 min"``.
    effect, drift, noise, cycle : str
        Smallest drift to be detected, random walk of the axis in one hour, noise of a cycle's mean, and length of a cycle, each
        with its unit.
    power : float
        Wanted chance of detecting the weakest source, 0 to 1.
    seed : int
        Of the random schedule.

    Returns
    -------
    list of str
        Lines for the terminal.

    Raises
    ------
    QuantityError, DutyPlanError
        If a quantity has no unit, a source no time constant, or no schedule is possible.
    """
    named = [_source(text) for text in sources]
    from fusion.attribution.duty_plan import (
        Machine,
        plan_duty,
        switchings,
    )  # no other summary needs them

    machine = Machine(
        sources=tuple(name for name, _ in named),
        time_constants_s=tuple(seconds for _, seconds in named),
        effect_um=read_option("--effect", effect, "um"),
        drift_um_per_sqrt_h=read_option("--drift", drift, "um"),
        noise_um=read_option("--noise", noise, "um"),
        cycle_s=read_option("--cycle", cycle, "s"),
    )
    proposed = plan_duty(machine, power=power, seed=seed)
    reached = float(proposed["power"].sel(hours=float(proposed["test_hours"])).max())
    longest = f"; no test of up to {float(proposed['hours'].max()):g} h reaches {power:.0%}"
    lines = [
        f"test of {float(proposed['test_hours']):g} h, mean dwell {duration(float(proposed['mean_dwell']))}: "
        f"chance to name the weakest source {reached:.0%}{'' if proposed.attrs['enough'] else longest}",
        "minute  source  state",
    ]
    return lines + [f"{minute:6.0f}  {name}  {state}" for minute, name, state in switchings(proposed)]


def _source(text: str) -> tuple[str, float]:
    """Return name and time constant (s) of a heat source such as ``"spindle=40 min"``."""
    from fusion.attribution.duty_plan import DutyPlanError

    name, equals, time_constant = text.partition("=")
    if not equals or not name.strip():
        raise DutyPlanError(
            f'--source "{text}" is no source; write its name and time constant, for example "spindle=40 min"'
        )
    return name.strip(), read_option(f"--source {name.strip()}", time_constant, "s")
