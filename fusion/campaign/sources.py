"""What a campaign was read into, before anything is calculated: the inputs of either instrument, or of both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.alignment.align import AxisGeometry, cycle_bounds
from fusion.attribution.randomised_duty import DutyLaw
from fusion.attribution.thermal_modes import Region
from fusion.campaign.config import Campaign, InterferometryTable, PlanTable, ThermographyTable
from fusion.campaign.iso_budget import StatedBudget
from fusion.campaign.sensors import ContactSensors
from fusion.products.results import Notice
from thermography.io.frame import FrameReference
from thermography.io.frame_index.frame_list import frame_times
from thermography.registration.lens import Lens
from thermography.registration.plan import Fiducial, PlanGrid

#: Lengths of the windows that stand for cycles where no laser gives them, s: what a clock shows, from 10 s to a day.
_WINDOWS_S = (10.0, 30.0, *(60.0 * m for m in (1, 2, 5, 10, 15, 30)), *(3600.0 * h for h in (1, 2, 4, 8, 24)))
#: Lengths for a recording that is shorter than that, s.
_SHORT_WINDOWS_S = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
#: So many windows a recording is divided into at most: as many maps as a reader pages through.
_MOST_WINDOWS = 60


@dataclass(frozen=True, eq=False)
class Cycles:
    """Cycles by number, each from its first instant to that of the time after it.

    Attributes
    ----------
    number : (n,) ndarray of int
        Counted from 1; some may be missing.
    bounds : (n, 2) ndarray of datetime64[ns]
        On the laser's clock, or on the camera's where there is no laser.
    """

    number: NDArray[np.int64]
    bounds: NDArray[np.datetime64]


def cycles_of_readings(deviations: xr.Dataset) -> Cycles:
    """Return the cycles of a laser test.

    Parameters
    ----------
    deviations : Dataset
        Keeps ``interferometry.contract.DEVIATIONS``.
    """
    return Cycles(deviations["cycle"].values, cycle_bounds(deviations))


def cycles_of_frames(times: NDArray[np.datetime64], window_s: float) -> Cycles:
    """Return consecutive windows of equal length that stand for cycles, from the first frame on; windows without a frame are left out.

    Parameters
    ----------
    times : (frames,) ndarray of datetime64
        Times of the frames, sorted.
    window_s : float, s
        Length of a window.

    Examples
    --------
    >>> minutes = np.datetime64("2026-03-09T08:00", "ns") + 60 * np.arange(12) * np.timedelta64(1, "s")
    >>> cycles_of_frames(minutes, 300.0).number.tolist()
    [1, 2, 3]
    """
    length = np.timedelta64(round(window_s * 1e9), "ns")
    start = times.astype("datetime64[ns]")[0]
    number = np.unique((times.astype("datetime64[ns]") - start) // length).astype(np.int64)
    first = start + number * length
    return Cycles(number + 1, np.stack([first, first + length], axis=1))


def usual_window_s(times: NDArray[np.datetime64]) -> float:
    """Return the length of the windows where the campaign file states none, s.

    Parameters
    ----------
    times : (frames,) ndarray of datetime64
        Times of the frames, sorted.

    Returns
    -------
    float
        The shortest of some usual lengths that holds a frame and divides the recording into at most 60 windows; of a recording that lasts
        less than 10 s, shorter, so that it has at least two.
    """
    length_s = float((times[-1] - times[0]) / np.timedelta64(1, "s"))
    between_s = float(np.median(np.diff(times) / np.timedelta64(1, "s"))) if times.size > 1 else 0.0
    least_s = max(between_s, length_s / _MOST_WINDOWS)
    if 0.0 < length_s < _WINDOWS_S[0]:
        short = [window for window in _SHORT_WINDOWS_S if window <= length_s] or [length_s]
        return next((window for window in short if window >= least_s), short[-1])
    return next((window for window in _WINDOWS_S if window >= least_s), _WINDOWS_S[-1])


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """What every campaign with an instrument has.

    Attributes
    ----------
    campaign : Campaign
        The campaign file.
    environment, drivers : Dataset or None
        Logs along ``time`` (UTC); None where nothing was logged.
    sensors : ContactSensors or None
        Contact sensors on the table; None where there are none.
    duty : tuple or None
        Randomised loads over time and the law that they were drawn from.
    notices : list of Notice
        Everything that was left out.
    """

    campaign: Campaign
    environment: xr.Dataset | None = None
    drivers: xr.Dataset | None = None
    sensors: ContactSensors | None = None
    duty: tuple[xr.DataArray, DutyLaw] | None = None
    notices: list[Notice] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class LaserInputs(Inputs):
    """Inputs of a campaign with the laser.

    Attributes
    ----------
    interferometry : InterferometryTable
        ``[interferometry]`` of the campaign file.
    deviations : Dataset
        Readings that keep ``interferometry.contract.DEVIATIONS``.
    iso_budget : StatedBudget
        Uncertainty contributions to ISO 230-2 values.
    """

    interferometry: InterferometryTable
    deviations: xr.Dataset
    iso_budget: StatedBudget

    @property
    def is_recompensated(self) -> bool:
        """Whether the environment log entered the readings: compensated again, or corrected for a dead path."""
        return self.interferometry.compensation == "redo" or self.interferometry.dead_path_mm != 0.0


@dataclass(frozen=True, kw_only=True)
class CameraInputs(Inputs):
    """Inputs of a campaign with the camera.

    Attributes
    ----------
    thermography, plan
        ``[thermography]`` and ``[plan]`` of the campaign file.
    grid : PlanGrid
        The plan's cells.
    fiducials : list of Fiducial
        Fiducials of the plan.
    fiducials_file : str
        Their file, for messages.
    frames, frames_rejected : list
        Usable thermograms sorted by time, and file, index and reason of the others.
    cycles : Cycles
        Those of the laser, or windows of the camera's time.
    regions : list of Region
        Named regions of the plan.
    lens : Lens or None
        Calibration of the camera's lens.
    """

    thermography: ThermographyTable
    plan: PlanTable
    grid: PlanGrid
    fiducials: list[Fiducial]
    fiducials_file: str
    frames: Sequence[FrameReference]
    frames_rejected: list[dict[str, Any]]
    cycles: Cycles
    regions: list[Region] = field(default_factory=list)
    lens: Lens | None = None

    @property
    def frame_times(self) -> np.ndarray:
        """Times of the usable frames on the camera's clock, (n,) datetime64[ns]."""
        return frame_times(self.frames)

    @property
    def direction(self) -> tuple[float, float]:
        """Direction in which a moving table goes over the plan as the axis position grows."""
        assert self.plan.axis is not None
        return self.plan.axis.direction

    @property
    def travel_mm(self) -> float:
        """Largest distance of the table from where the plan holds, mm: without a laser, up to the length of the plan."""
        return max(self.grid.width_mm, self.grid.height_mm)


@dataclass(frozen=True, kw_only=True)
class Source(CameraInputs, LaserInputs):
    """Inputs of a campaign with both instruments.

    Attributes
    ----------
    axis : AxisGeometry
        Where the measured line lies on the plan.
    """

    axis: AxisGeometry

    @property
    def needs_camera(self) -> bool:
        """Whether the readings are compensated again with the temperature from the camera."""
        return self.interferometry.material_temperature == "camera"

    @property
    def travel_mm(self) -> float:
        """Largest distance of a target from axis position 0, mm."""
        return float(np.abs(self.deviations["position"].values).max())
