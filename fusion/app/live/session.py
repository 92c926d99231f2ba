"""A running test, followed beside the page in a thread of its own."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import xarray as xr

from fusion.campaign.config import load_campaign
from fusion.errors import FusionError
from fusion.pipeline.watch import Enough, LiveState, follow
from interferometry.errors import InterferometryError
from thermography.errors import ThermographyError

#: Most warnings that are kept, the latest ones.
_MOST_WARNINGS = 30


@dataclass
class Course:
    """What a test has shown so far; of the fields only the latest is kept.

    Attributes
    ----------
    cycle, mean_drift_um, rise_K : list
        Number, mean drift (um) and mean rise (K) of every finished cycle; NaN where there is none.
    far_drift_um : list of float
        Drift of the last target of the file, um.
    iso230_cycle, iso230_um : list
        Cycle after which values by ISO 230-2 were evaluated, and these, um.
    latest_field : (y, x) DataArray or None
        Latest field, degC.
    field_cycle : int
        Its cycle.
    field_range_degC : (float, float) or None
        Lowest and highest temperature of all fields so far, degC.
    enough : Enough or None
        Latest answer.
    frames, readings : int
        Seen so far.
    window : str
        Cycles of the latest values by ISO 230-2.
    warnings : list of str
        The latest ones.
    """

    cycle: list[int] = field(default_factory=list)
    mean_drift_um: list[float] = field(default_factory=list)
    far_drift_um: list[float] = field(default_factory=list)
    rise_K: list[float] = field(default_factory=list)
    iso230_cycle: list[int] = field(default_factory=list)
    iso230_um: list[dict[str, float]] = field(default_factory=list)
    latest_field: xr.DataArray | None = None
    field_cycle: int = 0
    field_range_degC: tuple[float, float] | None = None
    enough: Enough | None = None
    frames: int = 0
    readings: int = 0
    window: str = ""
    warnings: list[str] = field(default_factory=list)

    def take(self, state: LiveState) -> None:
        """Add what is new.

        Parameters
        ----------
        state : LiveState
            The next state of the test.
        """
        self.frames, self.readings = state.frames, state.readings
        self.warnings = [*self.warnings, *state.warnings][-_MOST_WARNINGS:]
        self.enough = state.enough or self.enough
        cycle = state.cycle
        if cycle is None:
            return
        self.cycle.append(cycle.number)
        self.mean_drift_um.append(cycle.mean_drift_um)
        self.far_drift_um.append(float(cycle.drift_um[-1]) if cycle.drift_um.size else float("nan"))
        self.rise_K.append(cycle.rise_K)
        if state.iso230_um:
            self.iso230_cycle.append(cycle.number)
            self.iso230_um.append(dict(state.iso230_um))
            self.window = state.iso230_window
        if cycle.field is not None and cycle.field_range_degC is not None:
            self.latest_field, self.field_cycle = cycle.field, cycle.number
            known = [cycle.field_range_degC, *([self.field_range_degC] if self.field_range_degC else [])]
            self.field_range_degC = (min(low for low, _ in known), max(high for _, high in known))

    def values(self, symbol: str) -> np.ndarray:
        """Return one quantity of ISO 230-2 after every evaluation, um.

        Parameters
        ----------
        symbol : str
            B, R, E, M or A.
        """
        return np.array([values.get(symbol, np.nan) for values in self.iso230_um])


class LiveSession:
    """Follows one campaign until it is ended.

    Parameters
    ----------
    campaign : Path
        The campaign file; the files that it names may still be growing.
    wanted_u_um : float
        Standard uncertainty of a position that the test is to reach, um.
    poll_s : float
        Time between two looks at the files, s.

    Attributes
    ----------
    course : Course
        What the test has shown so far.
    version : int
        Grows with everything that is new.
    fault : str
        Why it ended by itself; empty while it runs and after `end`.

    Raises
    ------
    CampaignError
        If the campaign file cannot be used.
    """

    def __init__(self, campaign: Path, *, wanted_u_um: float, poll_s: float = 1.0) -> None:
        self._campaign = load_campaign(campaign)
        self._wanted_u_um, self._poll_s = wanted_u_um, poll_s
        self.course, self.version, self.fault = Course(), 0, ""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._follow, name="live", daemon=True)
        self._thread.start()

    @property
    def runs(self) -> bool:
        """Whether the test is still followed."""
        return self._thread.is_alive()

    def end(self, timeout_s: float | None = None) -> None:
        """Tell it to end.

        Parameters
        ----------
        timeout_s : float, optional
            Longest time to wait for the end, s; None: not at all.
        """
        self._stop.set()
        if timeout_s is not None:
            self._thread.join(timeout_s)

    def _follow(self) -> None:
        try:
            for state in follow(self._campaign, poll_s=self._poll_s, wanted_u_um=self._wanted_u_um, stop=self._stop):
                self.course.take(state)
                self.version += 1
        except (FusionError, InterferometryError, ThermographyError, OSError) as error:
            self.fault = str(error)
        except Exception as error:  # the page must say that nothing is followed any more, whatever the reason
            self.fault = f"fault of the program, not of the input: {type(error).__name__}; run the campaign when the test is over"
        self.version += 1
