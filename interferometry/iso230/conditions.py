"""The conditions that ISO 230-2 asks of a test, checked on the readings: targets, travel, spacing, cycles, completeness, settling."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
import xarray as xr

from interferometry.drift.planning import Settling, spacing_warnings
from interferometry.iso230.evaluation import STANDARD_CYCLES

#: Least number of target positions, and per metre of travel; travel in mm above which the standard has another test.
LEAST_TARGETS, TARGETS_PER_METRE, LONGEST_TRAVEL_MM = 5, 5, 2000.0
#: Travel of a rotary axis in deg up to which so many target positions are enough, and how many beyond.
_ANGULAR_TARGETS, _MOST_ANGULAR_TARGETS = ((90.0, 3), (180.0, 5)), 8
#: Decimals of a position, mm or deg: a tenth of a micrometre is that of the readers.
_DIGITS = 4
#: Spacings that differ by less than this share of their mean are equal.
_EQUAL_SHARE = 1e-3
#: A trend over the cycles with a smaller p-value is no scatter.
_SIGNIFICANT = 0.01


@dataclass(frozen=True)
class ConditionCheck:
    """One condition of a test: what is asked for, whether it is met (None: the readings do not tell), and the evidence in a sentence."""

    name: str
    met: bool | None
    evidence: str


def check_conditions(
    deviations: xr.Dataset,
    *,
    cycles: Sequence[int],
    lead_mm: float | None = None,
    settling: Sequence[Settling] | None = None,
) -> list[ConditionCheck]:
    """Check what ISO 230-2 asks of a test of an axis."""
    position = np.sort(deviations["position"].values)
    if deviations["position"].attrs.get("units") == "deg":
        return [_angles(position), _cycles(cycles), _completeness(deviations, cycles)]
    checks = [_targets(position), _travel(position), _spacing(position, lead_mm)]
    return [*checks, _cycles(cycles), _completeness(deviations, cycles), _settled(deviations, cycles, settling)]


def _targets(position: np.ndarray) -> ConditionCheck:
    travel = _travelled(position)
    required = max(LEAST_TARGETS, math.ceil(TARGETS_PER_METRE * travel / 1000.0))
    name = f"at least {LEAST_TARGETS} targets, and {TARGETS_PER_METRE} per metre"
    return ConditionCheck(
        name, position.size >= required, f"{position.size} targets over {travel:g} mm; required: {required}."
    )


def _travelled(position: np.ndarray) -> float:
    """Return the measured travel to the digit that positions have, in mm or deg: their difference in binary numbers may be longer."""
    return round(float(np.ptp(position)), _DIGITS)


def _angles(position: np.ndarray) -> ConditionCheck:
    travel = _travelled(position)
    required = next((least for angle, least in _ANGULAR_TARGETS if travel <= angle), _MOST_ANGULAR_TARGETS)
    name = f"at least {required} targets for this travel of a rotary axis"
    return ConditionCheck(name, position.size >= required, f"{position.size} targets over {travel:g}°.")


def _travel(position: np.ndarray) -> ConditionCheck:
    travel = _travelled(position)
    evidence = f"Measured travel {travel:g} mm."
    if travel > LONGEST_TRAVEL_MM:
        evidence += " Longer axes have a test of their own: one approach from each side to targets about 250 mm apart."
    return ConditionCheck("travel up to 2 m", travel <= LONGEST_TRAVEL_MM, evidence)


def _spacing(position: np.ndarray, lead_mm: float | None) -> ConditionCheck:
    name = "non-uniform spacing"
    spacing = np.diff(position)
    if spacing.size < 2:
        return ConditionCheck(name, None, "Fewer than two spacings.")
    hidden = [] if lead_mm is None else spacing_warnings(position, lead_mm=lead_mm)
    if hidden:
        return ConditionCheck(name, False, f"{hidden[0][0].upper()}{hidden[0][1:]}.")
    if np.ptp(spacing) < _EQUAL_SHARE * spacing.mean():
        evidence = (
            f"All spacings are {spacing.mean():g} mm: a periodic error of that length, or of a whole part of it, is not seen; the standard "
            "adds a random part to each position."
        )
        return ConditionCheck(name, False, evidence)
    return ConditionCheck(name, True, f"Spacings of {spacing.min():g} to {spacing.max():g} mm.")


def _cycles(cycles: Sequence[int]) -> ConditionCheck:
    return ConditionCheck(
        f"{STANDARD_CYCLES} cycles", len(cycles) == STANDARD_CYCLES, f"Cycles evaluated: {len(cycles)}."
    )


def _completeness(deviations: xr.Dataset, cycles: Sequence[int]) -> ConditionCheck:
    within = deviations["deviation"].sel(cycle=list(cycles)).transpose("direction", ...).values
    missing = int(np.isnan(within).sum())
    evidence = "Every target was read from both sides in every cycle."
    if np.isnan(within).all(axis=(1, 2)).any():
        evidence = "The targets were approached from one side only."
    elif missing:
        evidence = f"{missing} of {within.size} readings of the window are missing."
    return ConditionCheck("every target from both sides in every cycle", missing == 0, evidence)


def _settled(deviations: xr.Dataset, cycles: Sequence[int], settling: Sequence[Settling] | None) -> ConditionCheck:
    name = "warmed-up axis"
    time = deviations["time"].values.astype("datetime64[ns]")
    here = deviations["time"].sel(cycle=list(cycles)).values.astype("datetime64[ns]")
    if np.isnat(here).all():
        return ConditionCheck(name, None, "Without times of the readings a warm-up is not seen.")
    if settling is None:
        return ConditionCheck(name, None, "The readings are too few to show a warm-up.")
    start_s = float((here[~np.isnat(here)].min() - time[~np.isnat(time)].min()) / np.timedelta64(1, "s"))
    if not settling:
        change_um, p_value = _change_within(deviations.sel(cycle=list(cycles)))
        if p_value < _SIGNIFICANT:
            return ConditionCheck(
                name,
                False,
                f"The deviations still change within the cycles evaluated, by up to {change_um:.2g} µm (straight lines over the cycles, "
                f"F test, p < {_SIGNIFICANT:g}), without levelling off.",
            )
        return ConditionCheck(name, True, "No part of the drift settles during the test: none looks like a warm-up.")
    last = max(settling, key=lambda part: part.t95_s)
    evidence = (
        f"The drift ({last.component}) takes {last.t95_s / 3600:.1f} h to reach 95 % of its end "
        f"(95 % confidence: {last.t95_low_s / 3600:.1f} to {_hours(last.t95_high_s)}); the window begins after {start_s / 3600:.1f} h."
    )
    return ConditionCheck(name, start_s >= last.t95_s, evidence)


def _change_within(window: xr.Dataset) -> tuple[float, float]:
    """Largest change of a position over the cycles, um, by straight lines, and the p-value of "no position changes"."""
    values = window["deviation"].transpose("cycle", "direction", "target").values.reshape(window.sizes["cycle"], -1)
    values = values[:, np.isfinite(values).all(axis=0)]
    cycles, series = values.shape
    if cycles < 3 or series == 0:
        return 0.0, 1.0
    step = np.arange(cycles) - (cycles - 1) / 2.0
    slope = step @ values / (step @ step)
    about = values - values.mean(axis=0) - np.outer(step, slope)
    explained, degrees = slope @ slope * (step @ step) / series, series * (cycles - 2)
    scatter = float(np.sum(about**2)) / degrees
    p_value = float(scipy.special.fdtrc(series, degrees, explained / scatter)) if scatter > 0.0 else 1.0
    return float(np.abs(slope).max()) * (cycles - 1), p_value


def _hours(seconds: float) -> str:
    return f"{seconds / 3600:.1f} h" if np.isfinite(seconds) else "longer than the test can show"
