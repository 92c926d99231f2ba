"""Findings of a run as report and terminal state them: one text per quantity."""

from __future__ import annotations

import numpy as np

from fusion.diagnosis.causes import CAUSES
from fusion.products.results_attribution import CorrelationPart
from fusion.products.results_axis import AnomalyPart, DriftPart, Iso230Part, Iso230Window
from fusion.products.results_inputs import Figures
from fusion.products.results_loop import Loop, StepPart
from fusion.report.wording import BASELINES, join, number, p_value, place, quantity

#: Axis values in the terms of ISO 230-2:2014, in the order of the report.
ISO230_TERMS = {
    "A": "Bidirectional positioning accuracy A",
    "R": "Bidirectional positioning repeatability R",
    "E": "Bidirectional systematic positioning error E",
    "M": "Mean bidirectional positioning error M",
    "B": "Reversal error B",
}


def quoted_window(iso: Iso230Part) -> Iso230Part | Iso230Window:
    """Return the window whose values are quoted: the most settled one, the first of results that hold no other.

    Parameters
    ----------
    iso : Iso230Part
        The part ``iso230`` of the results.
    """
    return iso if iso.settled is None else iso.settled


def iso230_values(iso: Iso230Part | Iso230Window) -> dict[str, str]:
    """Return the axis values with their expanded uncertainty (k = 2) by symbol, µm.

    Parameters
    ----------
    iso : Iso230Part or Iso230Window
        A window of the part ``iso230`` of the results.
    """
    return {symbol: quantity(getattr(iso, f"{symbol}_um"), "µm") for symbol in ISO230_TERMS}


def reversal_note(iso: Iso230Part | Iso230Window) -> str:
    """Return what B means beside the scatter of the readings; empty where the approaches were not compared.

    Parameters
    ----------
    iso : Iso230Part or Iso230Window
        A window of the part ``iso230`` of the results.
    """
    if iso.B_of_scatter_um is None:
        return ""
    return (
        "B is the largest |B_i| of the positions, and so the largest of noisy values: scatter alone gives "
        f"{number(iso.B_of_scatter_um, 2)} µm in half of such tests of an axis without reversal error. The mean reversal error, "
        f"{quantity(iso.mean_reversal_um, 'µm')}, is free of that."
    )


def scatter_range(drift: DriftPart) -> str:
    """Return smallest, largest and median scatter over targets and directions, µm.

    Parameters
    ----------
    drift : DriftPart
        The part ``drift`` of the results.
    """
    scatter = drift.scatter_um.values()
    return f"{min(scatter):.2f} to {max(scatter):.2f} µm, median {np.median(scatter):.2f} µm"


def anomaly_place(anomaly: AnomalyPart) -> str:
    """Return which target and direction of approach stand out.

    Parameters
    ----------
    anomaly : AnomalyPart
        An entry of ``anomalies`` in the results.
    """
    approach = "both approaches" if anomaly.direction == "both" else f"{anomaly.direction} approach"
    return f"position {anomaly.target}, {approach}"


def anomaly_cause(anomaly: AnomalyPart) -> str:
    """Return the cause of an anomaly in words.

    Parameters
    ----------
    anomaly : AnomalyPart
        An entry of ``anomalies`` in the results.
    """
    return CAUSES[anomaly.cause].words


def anomaly_figures(anomaly: AnomalyPart) -> tuple[Figures, ...]:
    """Return what the statement on an anomaly rests on: the laser, and the camera where the cause is a temperature.

    Parameters
    ----------
    anomaly : AnomalyPart
        An entry of ``anomalies`` in the results.
    """
    return ("positions", "field") if anomaly.cause == "local_temperature" else ("positions",)


def attribution_headline(correlation: CorrelationPart) -> str:
    """Return one sentence that states whether a part of the field goes with the drift.

    Parameters
    ----------
    correlation : CorrelationPart
        The part ``correlation`` of the results.
    """
    source = correlation.source
    where = place(source.x_mm, source.y_mm)
    return {
        "not separable": "These data cannot tell: the whole session is one warm-up, in which every temperature rises like every drift.",
        "not attributable": "No part of the field goes with the drift more closely than chance allows; the closest is around "
        f"{where} (p = {p_value(source.p_value)}).",
        "attributable": f"The drift goes with the temperature around {where} more closely than chance and common warm-up allow "
        f"(p = {p_value(source.p_value)}).",
    }[correlation.verdict]


def randomised_causes(correlation: CorrelationPart) -> list[str]:
    """Return the loads that randomisation shows to cause drift.

    Parameters
    ----------
    correlation : CorrelationPart
        The part ``correlation`` of the results.
    """
    return [load.name for load in correlation.randomised_duty or () if load.cause]


def hold_out_errors(loop: Loop) -> str:
    """Return the errors on the hold-out of the declared and of the final model, µm.

    Parameters
    ----------
    loop : Loop
        The part ``loop`` of the results.
    """
    declared, final = (
        f"{number(error.rmse_um, 3)} [{number(error.low_um, 2)}, {number(error.high_um, 2)}]"
        for error in (loop.errors.declared, loop.errors.final)
    )
    return f"{declared} -> {final} µm"


def baseline_errors(loop: Loop) -> str:
    """Return the errors on the hold-out of the last value, of the mean and of the best plain regression, µm.

    Parameters
    ----------
    loop : Loop
        The part ``loop`` of the results.
    """
    names = dict.fromkeys(("last_value", "mean", loop.best_baseline))
    return ", ".join(f"{BASELINES[name]} {number(getattr(loop.baselines, name).rmse_um, 3)}" for name in names) + " µm"


def step_errors(step: StepPart) -> str:
    """Return the errors before and after an effect entered: on the hold-out, and of blocks predicted from the others, µm.

    Parameters
    ----------
    step : StepPart
        One of ``loop.steps``.
    """
    cross = f"blocks left out {number(step.cross_rmse_before_um, 3)} -> {number(step.cross_rmse_after_um, 3)} µm"
    if step.rmse_after_um is None:
        return f"found after the hold-out was opened, {cross}"
    return f"held-out error {number(step.rmse_before_um, 3)} -> {number(step.rmse_after_um, 3)} µm, {cross}"


def standing_out(anomalies: tuple[AnomalyPart, ...]) -> str:
    """Return one sentence that names the positions that stand out with their causes.

    Parameters
    ----------
    anomalies : tuple of AnomalyPart
        The part ``anomalies`` of the results.
    """
    named = [f"position {anomaly.target} ({anomaly_cause(anomaly)})" for anomaly in anomalies]
    return f"Standing out: {join(named)}." if named else "No position stands out from the others."
