"""The report of a record: sensors and channels, prediction and residual, part after part."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from fusion.alignment.sensor_health import describe_fault
from fusion.products.notices import counted
from fusion.products.results import Results
from fusion.products.results_loop import RecordLoop, RecordScorePart
from fusion.record.problem import ENTRY_LEVEL
from fusion.report.charts import record as charts
from fusion.report.charts.prediction import plot_block_errors
from fusion.report.charts.style import Chart
from fusion.report.conclusions.actions import next_steps
from fusion.report.conclusions.answers import conclude, headline
from fusion.report.model_section import DECIDED_BEFORE, errors_table, parameters, refused_effects, steps_table
from fusion.report.tables import Row, Table, Words, table
from fusion.report.wording import (
    alike,
    duration,
    effect_words,
    join,
    moment,
    number,
    p_cell,
)

#: Largest number of channels with charts; all of them are in fusion.nc.
_MOST_CHANNELS = 6
_ERRORS = ("Last value repeated / µm", "Declared model / µm", "Final model / µm")
_ERROR_KEYS = ("rmse_persistence_um", "rmse_declared_um", "rmse_final_um")

_GLOSSARY = (
    ("Displacement", "Motion of the machine that a probe measures in one channel, in µm."),
    ("Block", "Average of the samples of a short stretch of time; the model is fitted to blocks."),
    ("Quasi-static model", "Every displacement is a linear function of the temperatures at the same time."),
    ("Driver", "A logged quantity that generates heat: speed, load, duty."),
    ("Held-out error", "Root mean square error on a part that took no part in any choice, mean over the channels."),
    (
        "Part after part",
        "Forward chaining: every part from the third on is predicted by the whole procedure, applied to the time before it alone.",
    ),
    (
        "Family-wise p",
        "Probability that a record without any effect shows something as strong anywhere among all that was tested.",
    ),
    ("Noise", "Standard deviation of one block mean after model and drift."),
)


def draw_record(record: xr.Dataset) -> dict[str, Chart]:
    """Return the charts of a record by name.

    Parameters
    ----------
    record : Dataset
        fusion.nc of a record.
    """
    drawn = {"temperatures": charts.plot_temperatures(record)}
    if record.sizes["driver_name"]:
        drawn["drivers"] = charts.plot_drivers(record)
    for k, name in enumerate(_shown_channels(record)):
        drawn[f"prediction_{k}"] = charts.plot_prediction(record, name)
        drawn[f"residual_{k}"] = charts.plot_residuals(record, name)
        if record.sizes["effect"]:
            drawn[f"contribution_{k}"] = charts.plot_contributions(record, name)
    for step in range(record.sizes.get("step", 0)):
        errors = xr.Dataset({name: record[f"block_error_{name}"].isel(step=step) for name in ("before", "after")})
        drawn[f"block_errors_{step}"] = plot_block_errors(errors, charts.hours_of(record), "time")
    return drawn


def _shown_channels(record: xr.Dataset) -> list[str]:
    """Return the channels that get charts."""
    return [str(name) for name in record["channel"].values[:_MOST_CHANNELS]]


def describe_record(results: Results, provenance: Mapping[str, Any], record: xr.Dataset) -> dict[str, Any]:
    """Return everything the report of a record says in words and tables, as the template reads it.

    Parameters
    ----------
    results : Results
        Results of the run.
    provenance : mapping
        Content of provenance.json.
    record : Dataset
        fusion.nc of the run.
    """
    loop = results.loop
    assert isinstance(loop, RecordLoop)
    time = record["time"].values
    span_s = float((time[-1] - time[0]) / np.timedelta64(1, "s")) + float(record.attrs["block_s"])
    channels = [str(name) for name in record["channel"].values]
    drivers = join([str(name) for name in record["driver_name"].values])
    return {
        "subtitle": _start(time[0]),
        "verdict": loop.verdict,
        "headline": headline(results),
        "zone": "UTC",
        "doubts": (),
        "untouched": "",
        "measured": (
            f"Measured: {counted(len(channels), 'displacement')} and {counted(record.sizes['sensor'], 'temperature')} over "
            f"{_measured_time(loop, span_s)}" + (f", with {drivers} as driver." if drivers else ".")
        ),
        "answers": conclude(results),
        "numbers": _numbers(loop),
        "next": next_steps(results)[:6],
        "contents": [
            ("record", "Record"),
            ("loop", "Cause"),
            ("chained", "Part after part"),
            ("data", "Data"),
            ("uncertainty", "Uncertainty"),
            ("glossary", "Glossary"),
            ("provenance", "Provenance"),
        ],
        "data": [
            ("Channels", join(channels)),
            ("Sensors", join([str(name) for name in record["sensor"].values])),
            (
                "Time",
                f"{_start(time[0]) or 'start not stated'}, {duration(span_s)}; averaged over {record.sizes['time']} blocks of "
                f"{duration(float(record.attrs['block_s']))}",
            ),
            ("Held out", loop.held_out),
            ("Input files", f"{len(provenance['inputs'])}, listed with their SHA-256 under Provenance"),
        ],
        "shown": list(enumerate(_shown_channels(record))),
        "omitted": max(0, len(channels) - _MOST_CHANNELS),
        "sensor_faults": _sensor_faults_table(loop),
        "steps": steps_table(loop),
        "held_out": loop.held_out,
        "step_names": [effect_words(step.effect).name for step in loop.steps],
        "errors": errors_table(loop),
        "unexplained": loop.unexplained,
        "channels": _channels_table(loop),
        "rejected": _rejected_table(loop),
        "refused": refused_effects(loop),
        "candidates": _candidates_table(loop),
        "chained": _chained_table(loop),
        "runs": _runs_table(loop),
        "uncertainty": _uncertainty(loop),
        "glossary": _GLOSSARY,
    }


def _start(first: np.datetime64) -> str:
    """Return when the record began, empty where the campaign file does not state it and the times count from zero."""
    return moment(first) if first >= np.datetime64("1971-01-01") else ""


def _mean_chained(loop: RecordLoop, name: str) -> float | None:
    """Return an error, mean over the forward-chained parts, um."""
    values = [getattr(part, name) for part in loop.chained if getattr(part, name) is not None]
    return float(np.mean(values)) if values else None


def _percent(share: float | None) -> float | None:
    return None if share is None else 100 * share


def _numbers(loop: RecordLoop) -> list[dict[str, str]]:
    """Return the key figures."""
    final, declared, last = alike((loop.rmse_final_um, loop.rmse_declared_um, loop.rmse_persistence_um))
    numbers = [
        {
            "name": f"Prediction error, {loop.held_out.split(' held out')[0]}",
            "value": f"{final} µm",
            "note": f"not used for the fit; declared model {declared} µm",
        },
        {
            "name": "Last value repeated",
            "value": f"{last} µm",
            "note": "error of the simplest prediction of the same part",
        },
        {
            "name": "Variance left",
            "value": f"{number(_percent(loop.unexplained.variance_share), 2)} %",
            "note": "share of the displacements' variance, on the held-out part",
        },
    ]
    mean = _mean_chained(loop, "rmse_final_um")
    if mean is not None:
        numbers.append(
            {
                "name": "Part after part",
                "value": f"{number(mean, 3)} µm",
                "note": f"declared model {number(_mean_chained(loop, 'rmse_declared_um'), 3)} µm",
            }
        )
    return numbers


def _sensor_faults_table(loop: RecordLoop) -> Table:
    """Return the sensors that are faulty or suspected, with the error of the declared model with and without each."""
    rows = [
        [
            f"{fault.sensor}, {fault.run}" if fault.run else fault.sensor,
            f"{describe_fault(fault.kind, fault.size, fault.onset_s, fault.onset_u_s)}{f'; {fault.reason}' if fault.reason else ''}",
            number(fault.ratio, 3),
            number(fault.limit, 3),
            fault.state.replace("_", " "),
            number(fault.rmse_with_um, 3),
            number(fault.rmse_without_um, 3),
        ]
        for fault in loop.sensor_faults
    ]
    columns = [
        Words("Sensor"),
        Words("What it does"),
        "Largest excursion / next",
        "Limit",
        Words("State"),
        "Held-out error with it / µm",
        "without / µm",
    ]
    return table(columns, rows)


def _channels_table(loop: RecordLoop) -> Table:
    """Return the errors on the hold-out and the size of every step, channel by channel."""
    steps = [f"Step {turn}, rms / µm" for turn in range(1, len(loop.steps) + 1)]
    rows = [
        [
            name,
            *(number(getattr(channel, key), 3) for key in _ERROR_KEYS),
            number(_percent(channel.variance_share), 2),
            number(channel.noise_um, 2),
            *(number(step.rms_by_channel_um[name], 3) for step in loop.steps),
        ]
        for name, channel in loop.channels.items()
    ]
    return table([Words("Channel"), *_ERRORS, "Variance left / %", "Noise of a block / µm", *steps], rows)


def _rejected_table(loop: RecordLoop) -> Table:
    """Return the candidates that passed the search and were rejected, with the reason."""
    rows = [
        [effect_words(score.effect).name, score.rejected]
        for turn in loop.search
        for score in turn
        if _is_rejected(score)
    ]
    return table([Words("Effect"), Words("Why it did not enter")], rows, stacked=True)


def _is_rejected(score: RecordScorePart) -> bool:
    """Return whether a candidate was tried on the forward-chained parts and did not enter."""
    return score.chained_rmse_after_um is not None and not score.chosen


def _candidates_table(loop: RecordLoop) -> Table:
    """Return the best candidate of every effect in every round of the search."""
    columns = [
        "Round",
        Words("Effect"),
        Words("Best parameters"),
        "Gain",
        "Gain beyond chance",
        "p (search)",
        "Forward-chained error / µm",
        Words("Outcome"),
    ]
    rows = []
    for turn, scores in enumerate(loop.search, start=1):
        for score in scores:
            before, after = (number(value, 3) for value in (score.chained_rmse_before_um, score.chained_rmse_after_um))
            rows.append(
                [
                    str(turn),
                    effect_words(score.effect).name,
                    parameters(score.parameters),
                    number(score.gain, 3),
                    number(score.excess_gain, 3),
                    p_cell(score.family_wise_p),
                    "–" if score.chained_rmse_after_um is None else f"{before} to {after}",
                    "chosen" if score.chosen else "predicts no better" if _is_rejected(score) else "",
                ]
            )
    return table(columns, rows)


def _measured_time(loop: RecordLoop, span_s: float) -> str:
    """Return how long was measured; of several runs without the time between them."""
    hours = [run.duration_h for run in loop.runs if run.duration_h is not None]
    if not hours or len(hours) < len(loop.runs):
        return duration(span_s)
    return f"{duration(3600.0 * sum(hours))} in {counted(len(hours), 'run')}"


def _runs_table(loop: RecordLoop) -> Table:
    """Return the runs of a record of several, with errors and verdict of those that are held out."""
    rows = [
        [
            run.file,
            number(run.duration_h, 3),
            *((number(getattr(run, key), 3) if run.held_out else "–") for key in _ERROR_KEYS),
            run.verdict.replace("_", " ") or "learnt from",
        ]
        for run in loop.runs
    ]
    return table([Words("Run"), "Length / h", *_ERRORS, Words("Verdict")], rows)


def _chained_table(loop: RecordLoop) -> Table:
    """Return the errors of the forward-chained parts and their means."""
    rows = [
        Row(
            [
                join(list(part.runs)) or f"{number(part.first_h, 3)} to {number(part.last_h, 3)}",
                join([effect_words(name).name for name in part.effects]) or "none",
                *(number(getattr(part, key), 3) for key in _ERROR_KEYS),
            ]
        )
        for part in loop.chained
    ]
    means = [number(_mean_chained(loop, key), 3) for key in _ERROR_KEYS]
    return table(
        [
            Words("Run" if loop.runs else "Part / h"),
            Words("Effects found in the other runs" if loop.runs else "Effects found before it"),
            *_ERRORS,
        ],
        [*rows, Row(["mean", "", *means], marked=True)],
    )


def _uncertainty(loop: RecordLoop) -> list[str]:
    """Return what the numbers are worth, sentence by sentence."""
    sentences = [
        "Whether an effect is present is tested against a drift that wanders at random in every channel. Channels that measure the same "
        "part are not counted twice: the simulated records behind p have the correlation of the measured ones.",
        f"p is family-wise over the search of one round. An effect enters at p up to {100 * ENTRY_LEVEL:g} %.",
        DECIDED_BEFORE,
        "The bands of a prediction (two standard uncertainties) come from parts of the record that the model had not seen. They do not "
        "hold for a machine that is used in a way this record does not contain.",
        "The coefficients of single sensors are not printed: collinear sensors share what they explain, and only their sum is meaningful.",
        "The verdict says what these data can show: a source that was not logged and that no sensor sees looks like drift without a cause.",
    ]
    if loop.steps:
        sentences.append(f"How the added effects were confirmed before they entered: {loop.steps[0].confirmed_by}.")
    return sentences
