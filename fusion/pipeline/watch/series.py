"""Readings of the finished cycles: drift since the first one, ISO 230-2 of the last five, and whether the cycles are enough."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping

import numpy as np
import xarray as xr

from fusion._typing import Array
from fusion.pipeline.sizes import lacks_for_model
from fusion.pipeline.watch.state import Enough
from interferometry.deviations import build_deviations
from interferometry.drift.estimate import estimate_drift
from interferometry.drift.planning import plan_cycles
from interferometry.errors import InterferometryError
from interferometry.iso230 import QUANTITIES, STANDARD_CYCLES, evaluate_iso230

#: Cycles that the joint estimate of the drift takes into account: the latest of a long test, so that time and memory stay bounded.
_LATEST = 200
#: The estimate is made again when the cycles have grown by this share.
_GROWTH = 0.1


class CycleSeries:
    """The latest cycles of a test, and the first as reference.

    Parameters
    ----------
    wanted_u_um : float
        Standard uncertainty of a position that the test is to reach, um.
    """

    def __init__(self, wanted_u_um: float) -> None:
        self._wanted_u_um = wanted_u_um
        self._latest: deque[tuple[int, Array, Array]] = deque(maxlen=_LATEST)
        self._targets: list[int] = []
        self._position_mm: Array = np.zeros(0)
        self._first_um: Array | None = None
        self._estimated = 0
        self._enough: Enough | None = None
        self.count = 0

    def add(self, cycle: xr.Dataset) -> Array:
        """Add a finished cycle, a Dataset (direction, target) of one cycle, and return the drift of its targets, (target,) um.

        The targets are those of the first cycle; readings at others are not taken into account.
        """
        if self._first_um is None:
            self._targets = cycle["target"].values.tolist()
            self._position_mm = cycle["position"].values
        aligned = cycle.reindex(target=self._targets)
        deviation, times = aligned["deviation"].values, aligned["time"].values
        if self._first_um is None:
            self._first_um = deviation
        self._latest.append((int(cycle["cycle"]), deviation, times))
        self.count += 1
        # A reading that the first cycle lacks refers to the first one that there is.
        self._first_um = np.where(np.isnan(self._first_um), deviation, self._first_um)
        change = deviation - self._first_um
        known = np.isfinite(change).sum(axis=0)
        return np.asarray(np.where(known, np.nansum(change, axis=0) / np.maximum(known, 1), np.nan))

    def iso230(self) -> tuple[Mapping[str, float], str]:
        """Return the quantities of ISO 230-2 of the last five cycles, um, and the name of this window; empty where it has no scatter."""
        if self.count < 2:
            return {}, ""
        try:
            found = evaluate_iso230(self._deviations(STANDARD_CYCLES))
        except InterferometryError:
            return {}, ""
        values = {name: float(found[name]) for name in QUANTITIES}
        return {name: value for name, value in values.items() if math.isfinite(value)}, str(found.attrs["window"])

    def enough(self) -> Enough | None:
        """Return whether the cycles are enough; None where it cannot be told."""
        if self.count < max(math.ceil(self._estimated * (1.0 + _GROWTH)), 3):
            return self._enough
        self._estimated = self.count
        deviations = self._deviations(_LATEST)
        lacks = " ".join(notice.remedy for notice in lacks_for_model(deviations))
        try:
            plan = plan_cycles(estimate_drift(deviations), deviations, wanted_u_um=self._wanted_u_um)
        except InterferometryError as error:
            self._enough = Enough(self.count, math.nan, 0, lacks or str(error))
            return self._enough
        reached = plan.u_um * math.sqrt(plan.cycles / self.count)
        self._enough = Enough(self.count, reached, plan.cycles, lacks)
        return self._enough

    def _deviations(self, most: int) -> xr.Dataset:
        """Return the latest cycles, at most `most`."""
        numbers, deviation, times = zip(*list(self._latest)[-most:], strict=True)
        return build_deviations(numbers, self._targets, self._position_mm, np.array(deviation), np.array(times))
