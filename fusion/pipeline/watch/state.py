"""What is known of a test while it runs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr

from fusion.campaign.inputs import counted
from fusion.report.wording import number


@dataclass(frozen=True, eq=False)
class FinishedCycle:
    """A cycle after which the next one has begun.

    Attributes
    ----------
    number : int
        As the readings number it, or of the window of time where there is no laser.
    start, end : datetime64[ns]
        First instant of the cycle and of the next one, on the laser's clock; NaT where the readings have no times.
    frames : int
        Usable frames in it.
    field : (y, x) DataArray or None
        Mean temperature of the table in the cycle, degC; None where no frame of it can be used.
    field_range_degC : (float, float) or None
        Lowest and highest temperature of `field`, degC.
    rise_K : float
        Mean rise of the table since the first cycle that has a field, K; NaN where it is not known.
    drift_um : (target,) ndarray
        Change of the deviation at every target since the first cycle, mean of the directions, um; NaN where a reading is missing. Empty
        without a laser.
    """

    number: int
    start: np.datetime64
    end: np.datetime64
    frames: int
    field: xr.DataArray | None
    field_range_degC: tuple[float, float] | None
    rise_K: float
    drift_um: np.ndarray

    @property
    def mean_drift_um(self) -> float:
        """Mean of `drift_um` over the targets, um; NaN where no target has one."""
        known = self.drift_um[np.isfinite(self.drift_um)]
        return float(known.mean()) if known.size else float("nan")


@dataclass(frozen=True)
class Enough:
    """Whether the cycles so far are enough.

    Attributes
    ----------
    cycles : int
        Cycles that were used for the answer.
    u_um : float
        Standard uncertainty of a position against the first one that all cycles so far reach, um; the largest of the targets.
    cycles_for_wanted : int
        Number of cycles that reaches the wanted uncertainty.
    lacks : str
        What an analysis still lacks, in words; empty where nothing is lacking.
    """

    cycles: int
    u_um: float
    cycles_for_wanted: int
    lacks: str

    @property
    def is_enough(self) -> bool:
        """Whether the test may end."""
        return not self.lacks and self.cycles >= self.cycles_for_wanted


@dataclass(frozen=True, eq=False)
class LiveState:
    """A test so far.

    Attributes
    ----------
    frames, readings, cycles : int
        Frames and readings seen, cycles finished.
    cycle : FinishedCycle or None
        The cycle that has just been finished; None where only frames or readings have come.
    iso230_um : mapping of str to float
        Quantities of ISO 230-2 (B, R, E, M, A) of the last five cycles, um; empty before there are two.
    iso230_window : str
        Which cycles these are.
    enough : Enough or None
        Whether the cycles are enough; None before it can be told.
    warnings : tuple of str
        What has been noticed since the last state.
    """

    frames: int
    readings: int
    cycles: int
    cycle: FinishedCycle | None
    iso230_um: Mapping[str, float]
    iso230_window: str
    enough: Enough | None
    warnings: tuple[str, ...]


def live_line(state: LiveState) -> str:
    """Return a finished cycle and what is known after it as one line.

    Parameters
    ----------
    state : LiveState
        With a finished cycle.

    Examples
    --------
    >>> nat = np.datetime64("NaT", "ns")
    >>> cycle = FinishedCycle(7, nat, nat, 3, None, (23.1, 25.64), 0.8, np.array([1.0, 1.5]))
    >>> live_line(LiveState(21, 140, 7, cycle, {"A": 4.21}, "cycles 3 to 7", Enough(7, 0.31, 68, ""), ()))
    'cycle 7: 3 frames, 23.10 to 25.64 degC, rise 0.80 K; drift 1.25 µm; A 4.21 µm (cycles 3 to 7); u 0.31 µm, wanted after 68 cycles'
    """
    cycle = state.cycle
    assert cycle is not None
    parts = []
    if cycle.field_range_degC is not None:
        low, high = cycle.field_range_degC
        parts.append(f"{counted(cycle.frames, 'frame')}, {low:.2f} to {high:.2f} degC, rise {cycle.rise_K:.2f} K")
    elif cycle.frames:
        parts.append(f"{counted(cycle.frames, 'frame')}, no field")
    if math.isfinite(cycle.mean_drift_um):
        parts.append(f"drift {cycle.mean_drift_um:.2f} µm")
    if state.iso230_um:
        values = ", ".join(f"{name} {number(value, 3)} µm" for name, value in state.iso230_um.items())
        parts.append(f"{values} ({state.iso230_window})")
    if state.enough is not None:
        parts.append(_enough_words(state.enough))
    return f"cycle {cycle.number}: {'; '.join(parts) or 'nothing that can be used'}"


def _enough_words(enough: Enough) -> str:
    """Return whether the cycles are enough, in words."""
    reached = f"u {number(enough.u_um, 2)} µm" if math.isfinite(enough.u_um) else ""
    wanted = "enough" if enough.is_enough else f"wanted after {enough.cycles_for_wanted} cycles" if reached else ""
    return ", ".join(text for text in (reached, wanted, enough.lacks) if text)
