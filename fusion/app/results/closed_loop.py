"""The closed loop step by step: residual before, scores of the candidates, effect added, residual after."""

from __future__ import annotations

import re

import panel as pn
import xarray as xr

from fusion.app.elements import heading, paragraph, table
from fusion.app.results.charts import shown
from fusion.app.results.products import Products
from fusion.app.results.selection import CYCLE, POSITION, Linker
from fusion.products.results_loop import AxisLoop, RecordLoop
from fusion.products.store import DamagedProductError
from fusion.report.charts.drift import cycle_map
from fusion.report.charts.style import Chart
from fusion.report.conclusions.actions import next_steps
from fusion.report.conclusions.answers import conclude
from fusion.report.conclusions.effects import action, step_phrase
from fusion.report.findings import step_errors
from fusion.report.model_section import DECIDED_BEFORE, describe_candidates, describe_model, errors_table, steps_table
from fusion.report.record_section import draw_record
from fusion.report.tables import Table
from fusion.report.wording import effect_words, join, number, p_words


def table_of(shown_table: Table, caption: str) -> pn.viewable.Viewable:
    """Return a table of the report.

    Parameters
    ----------
    shown_table : Table
        Of finished texts.
    caption : str
        What it shows.
    """
    return table(
        [column.title for column in shown_table.columns], [row.cells for row in shown_table.rows], caption=caption
    )


def loop_steps(products: Products, linker: Linker) -> list[pn.viewable.Viewable]:
    """Return the closed loop step by step, in the words of the report, or say why there is none.

    Parameters
    ----------
    products : Products
        Of a run.
    linker : Linker
        Links the residuals to cycle and position.
    """
    results = products.results
    loop = results.loop
    if loop is None:
        lacks = [warning.message for warning in results.warnings if warning.code.startswith("too_")]
        return [paragraph(" ".join(["There is no model of the drift in this run.", *lacks]), kind="note")]
    parts = [
        paragraph(f"{one.question}: {one.text}")
        for one in conclude(results)
        if one.question in ("How sure", "What remains")
    ]
    parts += [
        table_of(errors_table(loop), "Errors of predicting what was held out"),
        paragraph(DECIDED_BEFORE, kind="note"),
    ]
    if isinstance(loop, RecordLoop):
        return [*parts, *_record_parts(products, loop)]
    assert isinstance(loop, AxisLoop)
    stored = products.loop
    if stored is not None:
        _require_same_run(products, loop, stored)
    parts += _step_parts(products, loop, stored, linker)
    parts += [
        heading("The model in numbers", level=3),
        table(
            ("Coefficient", "Value (k = 2)"),
            describe_model(loop),
            caption="Coefficients, what was not tried and not admitted",
        ),
    ]
    return [*parts, *_next(products)]


def _require_same_run(products: Products, loop: AxisLoop, stored: xr.Dataset) -> None:
    """Refuse a fusion.nc whose last effects are not the steps of results.json."""
    # An effect that entered more than once has its place behind its name.
    kept = [re.sub(r" \d+$", "", str(name)) for name in stored["effect"].values]
    steps = [step.effect for step in loop.steps]
    if len(kept) < len(steps) or kept[len(kept) - len(steps) :] != steps:
        raise DamagedProductError(
            f"{products.folder / 'fusion.nc'}: its effects are not the steps of results.json; put the files of one run back, or run the "
            "campaign again"
        )


def _next(products: Products) -> list[pn.viewable.Viewable]:
    steps = next_steps(products.results)
    return [heading("What to do next", level=3), *(paragraph(step) for step in steps[:6])]


def _record_parts(products: Products, loop: RecordLoop) -> list[pn.viewable.Viewable]:
    """The steps of a record, with the charts of its channels."""
    parts = [heading("Steps", level=3), table_of(steps_table(loop), "Declared model and added effects")]
    record = products.fusion
    if record is not None:
        for name, chart in draw_record(record).items():
            parts.append(shown(chart, name.partition("_")[0].capitalize()))
    return [*parts, *_next(products)]


def _step_parts(
    products: Products, loop: AxisLoop, stored: xr.Dataset | None, linker: Linker
) -> list[pn.viewable.Viewable]:
    """Every round of the search: what was left, who was tried, what entered."""
    parts: list[pn.viewable.Viewable] = []
    candidates = describe_candidates(loop)
    last = len(loop.steps)
    for turn in range(1, max(last + 1, len(loop.search)) + 1):
        step = loop.steps[turn - 1] if turn <= last else None
        parts.append(heading(f"Round {turn}", level=3))
        if stored is not None and (step is not None or turn == last + 1):
            parts += _residual(products, stored, loop, turn - 1, linker)
        scores = [row.cells[1:] for row in candidates.rows if row.cells[0] == str(turn)]
        if scores:
            titles = [column.title for column in candidates.columns[1:]]
            parts.append(
                table(
                    titles, scores, caption=f"Best candidate of every effect in round {turn}, gains in log-likelihood"
                )
            )
        if step is None:
            parts.append(paragraph("No further effect entered."))
            continue
        entered = "Entered" if step.confirmed else "Entered, not confirmed"
        parts.append(
            paragraph(
                f"{entered}: {step_phrase(step, products.results.time, record=False)}, {p_words(step.p_value)}; {step_errors(step)}. "
                f"{action(step, products.results.time, record=False)}"
            )
        )
        if stored is not None:
            parts += _contribution(products, stored, loop, turn - 1, linker)
    return parts


def effects_left(stored: xr.Dataset, loop: AxisLoop, entered: int) -> xr.DataArray:
    """Return the residual of the final model with the effects that had not entered yet put back (cycle, direction, target), um.

    Parameters
    ----------
    stored : Dataset
        Group ``loop`` of fusion.nc.
    loop : AxisLoop
        The part ``loop`` of the results.
    entered : int
        How many of the added effects have entered.

    Returns
    -------
    DataArray
        A partial residual: coefficients are those of the final model, so that steps can be compared.
    """
    first = stored.sizes["effect"] - len(loop.steps) + entered
    later = stored["contribution"].isel(effect=slice(first, None))
    return stored["residual_final"] + later.sum("effect", skipna=False)


def _residual(
    products: Products, stored: xr.Dataset, loop: AxisLoop, entered: int, linker: Linker
) -> list[pn.viewable.Viewable]:
    """The residual before a round."""
    read = products.deviations
    assert read is not None
    left = effects_left(stored, loop, entered).mean("direction")
    left = left - left.mean("cycle")
    names = join([effect_words(step.effect).name for step in loop.steps[entered:]])
    without = f" with {names} put back" if names else ""
    caption = (
        f"Residual before this round: that of the final model{without}, each position about its mean"
        if names
        else "What the final model leaves"
    )
    return [_linked(cycle_map(left, read["position"], "residual / µm"), caption, linker)]


def _contribution(
    products: Products, stored: xr.Dataset, loop: AxisLoop, entered: int, linker: Linker
) -> list[pn.viewable.Viewable]:
    """What the effect of a round contributes."""
    read = products.deviations
    assert read is not None
    at = stored.sizes["effect"] - len(loop.steps) + entered
    part = stored["contribution"].isel(effect=at).mean("direction").drop_vars("effect")
    step = loop.steps[entered]
    caption = f"Added: {effect_words(step.effect).name}, {number(step.rms_um, 2)} µm rms, each position about its mean"
    return [_linked(cycle_map(part - part.mean("cycle"), read["position"], "contribution / µm"), caption, linker)]


def _linked(chart: Chart, caption: str, linker: Linker) -> pn.viewable.Viewable:
    """Return a map of cycle and position that is linked."""
    linker.link(chart.figure, x=CYCLE, y=POSITION)
    return shown(chart, f"{caption}. A click chooses cycle and position.")
