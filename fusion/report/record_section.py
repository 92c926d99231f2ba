"""The report of a record: the same page, with what sensors and channels have to tell."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from fusion.report import plots_record, wording
from fusion.report.model_section import in_words, runner_up, step_parameters
from fusion.report.wording import duration, join, moment, number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Channels and figures beyond these are in fusion.nc; the page stays readable.
_MOST_CHANNELS = 6

GLOSSARY = (
    ("Displacement", "What a probe shows of the machine's motion in one channel, in µm."),
    ("Block", "The samples of a short stretch of time, averaged; the model sees blocks."),
    ("Quasi-static model", "Every displacement is a linear function of the temperatures at the same time."),
    ("Driver", "What makes heat and was logged: speed, load, duty."),
    ("Held-out error", "Root mean square error on a part that took no part in any choice, mean over the channels."),
    (
        "Part after part",
        "Every part from the third on is predicted by the whole procedure, applied to the time before it alone.",
    ),
    (
        "Family-wise p",
        "Chance that a record without any effect shows something as strong anywhere among all that was tried.",
    ),
    ("Noise", "Standard deviation of one block mean after model and drift."),
)


def draw_record(record: xr.Dataset) -> dict[str, Callable[[], Axes]]:
    """Return the charts of a record by name."""
    charts: dict[str, Callable[[], Axes]] = {"temperatures": lambda: plots_record.plot_temperatures(record)}
    if record.sizes["driver_name"]:
        charts["drivers"] = lambda: plots_record.plot_drivers(record)
    for k, name in enumerate(shown_channels(record)):
        charts[f"prediction_{k}"] = lambda name=name: plots_record.plot_prediction(record, name)  # type: ignore[misc]
        charts[f"residual_{k}"] = lambda name=name: plots_record.plot_residuals(record, name)  # type: ignore[misc]
        charts[f"contribution_{k}"] = lambda name=name: plots_record.plot_contributions(record, name)  # type: ignore[misc]
    return charts


def shown_channels(record: xr.Dataset) -> list[str]:
    """Return the channels that get charts."""
    return [str(name) for name in record["channel"].values[:_MOST_CHANNELS]]


def describe_record(results: Mapping[str, Any], provenance: Mapping[str, Any], record: xr.Dataset) -> dict[str, Any]:
    """Return everything the page says of a record in words and tables."""
    loop = results["loop"]
    time = record["time"].values
    span_s = float((time[-1] - time[0]) / np.timedelta64(1, "s")) + float(record.attrs["block_s"])
    channels = [str(name) for name in record["channel"].values]
    return {
        "subtitle": _start(time[0]),
        "headline": wording.verdict_headline(loop),
        "sentences": [
            f"Measured: {len(channels)} displacements and {record.sizes['sensor']} temperatures over {duration(span_s)}"
            + (
                f", with {join([str(one) for one in record['driver_name'].values])} as driver."
                if record.sizes["driver_name"]
                else "."
            ),
            wording.verdict_numbers(loop),
        ],
        "numbers": _numbers(loop),
        "next": wording.next_steps(results)[:6],
        "contents": [
            ("data", "Data"),
            ("record", "Record"),
            ("loop", "Model"),
            ("chained", "Part after part"),
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
            ("Sealed", loop["held_out"]),
            ("Input files", f"{len(provenance['inputs'])}, listed with their SHA-256 under Provenance"),
        ],
        "shown": list(enumerate(shown_channels(record))),
        "parameters": step_parameters(loop),
        "runners_up": [runner_up(step["runner_up"]) for step in loop["steps"]],
        "rejected": [
            (wording.effect_name(row["effect"]), readable_reason(row["rejected"]))
            for turn in loop["search"]
            for row in turn
            if row["rejected"]
        ],
        "reasons": [
            (f"{title}: {wording.effect_name(name)}", readable_reason(reason))
            for title, reasons in (("blocked", loop["blocked"]), ("not tried", loop["not_tried"]))
            for name, reason in reasons.items()
        ],
        "candidates": _candidates(loop),
        "uncertainty": _uncertainty(loop),
        "glossary": GLOSSARY,
        "mean_declared": _mean(loop, "rmse_declared_um"),
        "mean_final": _mean(loop, "rmse_final_um"),
        "mean_persistence": _mean(loop, "rmse_persistence_um"),
        "omitted": max(0, len(channels) - _MOST_CHANNELS),
    }


def _start(first: np.datetime64) -> str:
    """Return when the record began, empty where the campaign file does not say so and its times count from zero."""
    return moment(first) if first >= np.datetime64("1971-01-01") else ""


def readable_reason(text: str) -> str:
    """Return a reason with the signs of print."""
    return text.replace(" um", " µm")


def _mean(loop: Mapping[str, Any], name: str) -> float | None:
    values = [one[name] for one in loop["chained"] if one[name] is not None]
    return float(np.mean(values)) if values else None


def _numbers(loop: Mapping[str, Any]) -> list[dict[str, str]]:
    """The figures that a reader looks for first."""
    left = loop["unexplained"]
    numbers = [
        {
            "name": "Held-out error",
            "value": f"{number(loop['rmse_final_um'], 3)} µm",
            "note": f"declared model {number(loop['rmse_declared_um'], 3)} µm",
        },
        {
            "name": "Repeating the last value",
            "value": f"{number(loop['rmse_persistence_um'], 3)} µm",
            "note": "error of the simplest prediction on the same part",
        },
        {
            "name": "Left of the variance",
            "value": f"{100 * left['variance_share']:.1f} %",
            "note": "share of the displacements' variance, on the held-out part",
        },
    ]
    mean = _mean(loop, "rmse_final_um")
    if mean is not None:
        numbers.append(
            {
                "name": "Part after part",
                "value": f"{number(mean, 3)} µm",
                "note": f"declared model {number(_mean(loop, 'rmse_declared_um'), 3)} µm",
            }
        )
    return numbers


def _candidates(loop: Mapping[str, Any]) -> list[list[str]]:
    rows = []
    for turn, scores in enumerate(loop["search"], start=1):
        for row in scores:
            after = row["chained_rmse_after_um"]
            outcome = "chosen" if row["chosen"] else ("predicts no better" if row["rejected"] else "")
            rows.append(
                [
                    str(turn),
                    wording.effect_name(row["effect"]),
                    in_words(row["parameters"]),
                    number(row["gain"], 3),
                    number(row["excess_gain"], 3),
                    wording.p_value(row["family_wise_p"]),
                    "–" if after is None else f"{number(row['chained_rmse_before_um'], 3)} to {number(after, 3)}",
                    outcome,
                ]
            )
    return rows


def _uncertainty(loop: Mapping[str, Any]) -> list[str]:
    sentences = [
        "Whether an effect is there is tested against a drift that wanders by itself in every channel; channels that watch the same "
        "part are not counted twice, because the simulated records behind p have the correlation of the measured ones.",
        "The bands of a prediction (two standard uncertainties) come from parts of the record that the model had not seen. They do not "
        "hold for a machine that is used in a way this record does not contain.",
        "The coefficients of single sensors are not printed: alike sensors share what they explain, and only their sum means something.",
        "The verdict says what these data can show: a source that was not logged and that no sensor sees looks like drift without a cause.",
    ]
    if loop["steps"]:
        sentences.append(f"An effect was confirmed thus: {loop['steps'][0]['confirmed']}.")
    return sentences
