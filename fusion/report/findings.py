"""Findings of a run as report and terminal state them: one text per quantity."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fusion.diagnosis.causes import CAUSES
from fusion.products.results import Results
from fusion.products.results_attribution import CorrelationPart
from fusion.products.results_axis import AnomalyPart, DriftPart, HotspotPart, Iso230Part, Iso230Window
from fusion.products.results_inputs import Figures
from fusion.products.results_loop import Loop, RecordLoop, StepPart
from fusion.products.results_part import AreaPart
from fusion.report.wording import BASELINES, alike, number, place, quantity

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


def approach_of(iso: Iso230Part | Iso230Window) -> str:
    """Return the only direction of approach that a window holds, "positive" or "negative"; empty where it holds both.

    Parameters
    ----------
    iso : Iso230Part or Iso230Window
        A window of the part ``iso230`` of the results.
    """
    if not isinstance(iso, Iso230Window) or iso.A_um.value is not None:
        return ""
    return next((side for side in ("positive", "negative") if getattr(iso, side).A_um.value is not None), "")


def quoted_values(iso: Iso230Part | Iso230Window) -> dict[str, str]:
    """Return the axis values to quote with their expanded uncertainty (k = 2) by symbol, µm: A, R and B, of one approach A and R.

    Parameters
    ----------
    iso : Iso230Part or Iso230Window
        A window of the part ``iso230`` of the results.
    """
    side = approach_of(iso)
    if not side:
        values = iso230_values(iso)
        return {symbol: values[symbol] for symbol in ("A", "R", "B")}
    arrow = {"positive": "↑", "negative": "↓"}[side]
    return {f"{symbol}{arrow}": quantity(getattr(getattr(iso, side), f"{symbol}_um"), "µm") for symbol in "AR"}


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


def drift_u_note(iso: Iso230Part | None) -> str:
    """Return what the ± of profile and drift contains, and where the rest stands.

    Parameters
    ----------
    iso : Iso230Part or None
        The part ``iso230`` of the results; None: the run has no budget.
    """
    rest = "laser, material temperature and expansion coefficient"
    if iso is None or iso.settled is None:
        return f"± from scatter and estimate alone, without {rest}"
    return f"± from scatter and estimate alone; {rest}: see the ISO 230-2 budget"


def scatter_range(drift: DriftPart) -> str:
    """Return smallest, largest and median scatter over targets and directions, µm.

    Parameters
    ----------
    drift : DriftPart
        The part ``drift`` of the results.
    """
    scatter = drift.scatter_um.values()
    if not scatter:
        return "not known: no position has readings enough"
    # A variance that comes out negative beside the drift is kept as zero: no position has no scatter.
    span = f"{min(scatter):.2f} to" if min(scatter) > 0.0 else "up to"
    return f"{span} {max(scatter):.2f} µm, median {np.median(scatter):.2f} µm"


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


def area_words(area: AreaPart | None, x_mm: float | None, y_mm: float | None) -> str:
    """Return the name of a place on the plan: the area, and where it is strongest.

    Parameters
    ----------
    area : AreaPart or None
        None: only the point is named.
    x_mm, y_mm : float or None
        Its strongest cell, or the middle of a region, mm.
    """
    if area is None:
        return f"the place around {place(x_mm, y_mm)}"
    return f"the area {span_words(area)} (strongest at {place(x_mm, y_mm)})"


def span_words(area: AreaPart | None) -> str:
    """Return the edges of an area on the plan; a dash where there is none.

    Parameters
    ----------
    area : AreaPart or None
        mm.
    """
    if area is None:
        return "–"
    return f"x {area.x_low_mm:.0f} to {area.x_high_mm:.0f} mm, y {area.y_low_mm:.0f} to {area.y_high_mm:.0f} mm"


class SpotPlaces(NamedTuple):
    """Places of a hotspot in words: on the plan in mm, or in the picture in px.

    Attributes
    ----------
    area, peak, middle : str
        Edges of its area, its peak, and the middle of its area.
    """

    area: str
    peak: str
    middle: str


def spot_places(spot: HotspotPart) -> SpotPlaces:
    """Return the places of a hotspot in words.

    Parameters
    ----------
    spot : HotspotPart
        An entry of ``hotspots`` in the results.
    """
    if spot.x_px is None:
        return SpotPlaces(
            span_words(spot.area), place(spot.x_mm, spot.y_mm), place(spot.centroid_x_mm, spot.centroid_y_mm)
        )
    area = spot.area_px
    edges = (
        "–"
        if area is None
        else f"x {area.x_low_px:.0f} to {area.x_high_px:.0f} px, y {area.y_low_px:.0f} to {area.y_high_px:.0f} px"
    )
    peak, middle = place(spot.x_px, spot.y_px, "px"), place(spot.centroid_x_px, spot.centroid_y_px, "px")
    return SpotPlaces(edges, peak, middle)


def figures_of(results: Results) -> list[Figures]:
    """Return which kinds of figures a run has: of the laser, of the camera, and of both together.

    Parameters
    ----------
    results : Results
        Results of a run.
    """
    there: list[Figures] = []
    if results.iso230 is not None or results.loop is not None:
        there.append("positions")
    if results.registration is not None:
        there.append("field")
    if results.correlation is not None:
        there.append("attribution")
    return there


def randomised_causes(correlation: CorrelationPart) -> list[str]:
    """Return the loads that randomisation shows to cause drift.

    Parameters
    ----------
    correlation : CorrelationPart
        The part ``correlation`` of the results.
    """
    return [load.name for load in correlation.randomised_duty or () if load.cause]


def hold_out_errors(loop: Loop) -> str:
    """Return the errors on the hold-out of the declared model and, where effects were added, of the final one, µm.

    Parameters
    ----------
    loop : Loop
        The part ``loop`` of the results.
    """
    stages = (loop.errors.declared, loop.errors.final) if loop.steps else (loop.errors.declared,)
    told = alike(
        [getattr(error, name) for error in stages for name in ("rmse_um", "low_um", "high_um")], distinct=False
    )
    return " -> ".join(f"{told[at]} [{told[at + 1]} to {told[at + 2]}]" for at in range(0, len(told), 3)) + " µm"


def baseline_errors(loop: Loop) -> str:
    """Return the errors on the hold-out of the last value, of the mean and of the best plain regression, µm.

    Parameters
    ----------
    loop : Loop
        The part ``loop`` of the results.
    """
    names = dict.fromkeys(("last_value", "mean", loop.best_baseline))
    errors = alike([getattr(loop.baselines, name).rmse_um for name in names], distinct=False)
    words = baseline_words(loop)
    return ", ".join(f"{words[name]} {error}" for name, error in zip(names, errors, strict=True)) + " µm"


def baseline_words(loop: Loop) -> dict[str, str]:
    """Return plain predictions in words, by their key in ``loop.baselines``: along an axis cycles are repeated, of a record values.

    Parameters
    ----------
    loop : Loop
        The part ``loop`` of the results.
    """
    record = isinstance(loop, RecordLoop)
    return {
        name: words.replace("cycles before", "time before").replace("cycle", "value") if record else words
        for name, words in BASELINES.items()
    }


def step_errors(step: StepPart) -> str:
    """Return the errors before and after an effect entered: on the hold-out, and of blocks predicted from the others, µm.

    Parameters
    ----------
    step : StepPart
        One of ``loop.steps``.
    """
    cross = f"blocks predicted from the others {' -> '.join(alike((step.cross_rmse_before_um, step.cross_rmse_after_um)))} µm"
    if step.rmse_after_um is None:
        return f"found after the hold-out was opened, {cross}"
    return f"held-out error {' -> '.join(alike((step.rmse_before_um, step.rmse_after_um)))} µm, {cross}"
