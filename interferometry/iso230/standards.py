"""Other evaluations of the same readings: VDI/DGQ 3441 and the Japanese practice of JIS B 6330.

ASME B5.54 takes the quantities of ISO 230-2 and needs no evaluation of its own. The texts of these standards are not open:
docs/method/iso230.md says for each where its definition comes from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from interferometry.deviations import DIRECTIONS

VDI, JIS = "VDI/DGQ 3441", "JIS B 6330"


@dataclass(frozen=True)
class OtherQuantity:
    """A quantity of another standard.

    Attributes
    ----------
    standard : str
        ``VDI/DGQ 3441`` or ``JIS B 6330``.
    name : str
        With its symbol, where it has one.
    value_um : float
        um.
    definition : str
        How it is calculated.
    """

    standard: str
    name: str
    value_um: float
    definition: str


def evaluate_other_standards(deviations: xr.Dataset, *, cycles: Sequence[int]) -> list[OtherQuantity]:
    """Evaluate a window of cycles by VDI/DGQ 3441 and JIS B 6330.

    Parameters
    ----------
    deviations : xarray.Dataset
        Keeps ``contract.DEVIATIONS``.
    cycles : sequence of int
        Numbers of the cycles.

    Returns
    -------
    list of OtherQuantity
        Empty where no target was read at least twice from both sides.

    Notes
    -----
    With mean deviations m and standard deviations s (n - 1) of a target from both sides: mean m = (m_up + m_down) / 2, reversal
    U = abs(m_up - m_down), scatter Ps = 6 (s_up + s_down) / 2; docs/method/iso230.md.
    """
    ordered = deviations.reindex(direction=list(DIRECTIONS)).sel(cycle=list(cycles)).sortby("position")
    x = ordered["deviation"].values
    whole = (np.isfinite(x).sum(axis=0) >= 2).all(axis=0)
    if not whole.any():
        return []
    return [*_by_vdi(x[:, :, whole]), *_by_jis(x[:, :, whole])]


def _by_vdi(x: np.ndarray) -> list[OtherQuantity]:
    """Position uncertainty, scatter, deviation and reversal of deviations (cycle, direction, target)."""
    mean, s = np.nanmean(x, axis=0), np.nanstd(x, axis=0, ddof=1)
    middle, reversal, scatter = mean.mean(axis=0), np.abs(mean[0] - mean[1]), 6 * s.mean(axis=0)
    half = (reversal + scatter) / 2
    rows = (
        (
            "position uncertainty P",
            np.max(middle + half) - np.min(middle - half),
            "range of m ± (U + Ps) / 2 over the targets",
        ),
        ("position deviation Pa", np.ptp(middle), "range of m over the targets"),
        ("largest position scatter Ps max", scatter.max(), "largest 6 s, s the mean of both approaches"),
        ("mean position scatter Ps", scatter.mean(), "mean of 6 s over the targets"),
        ("largest reversal U max", reversal.max(), "largest difference of both approaches' means"),
        ("mean reversal U", reversal.mean(), "mean of these differences, each without its sign"),
    )
    return [OtherQuantity(VDI, name, float(value), definition) for name, value, definition in rows]


def _by_jis(x: np.ndarray) -> list[OtherQuantity]:
    """Positioning accuracy, repeatability and lost motion of deviations (cycle, direction, target), targets by position."""
    starts = np.stack([x[:, 0, :1], x[:, 1, -1:]], axis=1)
    from_start = np.abs(x - starts)
    spread = (np.nanmax(x, axis=0) - np.nanmin(x, axis=0)) / 2
    mean = np.nanmean(x, axis=0)
    rows = (
        (
            "positioning accuracy",
            np.nanmax(from_start),
            "largest deviation from the first target of its pass, over all passes",
        ),
        (
            "positioning repeatability (±)",
            spread.max(),
            "half of the largest range of readings of one target from one side",
        ),
        ("lost motion", np.abs(mean[0] - mean[1]).max(), "largest difference of both approaches' means"),
    )
    return [OtherQuantity(JIS, name, float(value), definition) for name, value, definition in rows]
