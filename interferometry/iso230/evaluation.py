"""Accuracy and repeatability of positioning by ISO 230-2:2014, over any window of cycles, each quantity with its uncertainty.

The acceptance test of the standard has five cycles of a warmed-up axis. In a longer test R and A contain the drift: the window that
was evaluated is part of every result.

Names are those of the standard: x_ij positioning deviation, mean unidirectional positioning deviation at a position, s_i its standard
deviation, B_i reversal error at a position, R_i repeatability at a position; of the axis: reversal error B, mean reversal error,
bidirectional repeatability R, bidirectional systematic positioning error E, mean bidirectional positioning error M, bidirectional
accuracy A.

In this order: the evaluation of one window; windows along a test; other standards.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
import scipy
import xarray as xr

from interferometry.common import InterferometryError, check_dataset
from interferometry.compensation import REFERENCE_TEMPERATURE_DEGC
from interferometry.deviations import DIRECTIONS
from interferometry.iso230.quantities import (
    AXIS,
    CONTRIBUTIONS,
    ONE_WAY,
    SCATTER_ALONE,
    Iso230Budget,
    axis_quantities,
    target_quantities,
    uncertainties,
)

STANDARD_CYCLES = 5
#: Windows of a long test that are evaluated before their results become one.
_WINDOWS_AT_ONCE = 64


def evaluate_iso230(
    deviations: xr.Dataset,
    *,
    cycles: Sequence[int] | None = None,
    budget: Iso230Budget | None = None,
    drift: xr.DataArray | None = None,
    material_degC: xr.DataArray | None = None,
) -> xr.Dataset:
    """Evaluate a window of cycles by ISO 230-2.

    Parameters
    ----------
    deviations : xarray.Dataset
        Positioning deviations (cycle, direction, target) in um, as `build_deviations` returns them; readings may be missing. Of a rotary
        axis they are in arcsec, as the units of ``deviation`` say.
    cycles : sequence of int, optional
        Numbers of the cycles of the window; None: all.
    budget : Iso230Budget, optional
        None: the assumptions of `Iso230Budget`; of a rotary axis the scatter alone, as the budget is one of lengths.
    drift : (cycle, direction, target) DataArray, optional
        Drift of the joint estimate, um: what it does to each quantity within the window is its environmental variation where the budget
        states none. None: without either, the uncertainty holds no environmental variation.
    material_degC : (cycle) DataArray, optional
        Temperature of the material, degC: its mean over the window replaces the difference from 20 degC of the budget.

    Returns
    -------
    xarray.Dataset
        In um (arcsec), each with its standard uncertainty ``<name>_u``.

        - Per direction and target: ``mean_unidirectional``, ``standard_deviation`` (s_i), ``repeatability`` (4 s_i), ``count`` (1).
        - Per target: ``mean_bidirectional``, ``reversal`` (B_i), ``repeatability_bidirectional`` (R_i).
        - Per direction: ``R_unidirectional``, ``E_unidirectional``, ``A_unidirectional``.
        - Of the axis: ``B`` reversal error; ``B_of_scatter``, what scatter alone gives in half of such tests of an axis without reversal
          error (B is the largest of noisy values; no uncertainty); ``mean_reversal`` (signed), ``R`` bidirectional repeatability, ``E``
          bidirectional systematic positioning error, ``M`` mean bidirectional positioning error, ``A`` bidirectional accuracy.
        - Of the budget: ``contribution`` (quantity, contributor) to the standard uncertainty of each quantity of the axis,
          ``<name>_contribution`` (direction, contributor) to that of each quantity per direction;
          ``environmental_variation``, as stated, else ``drift_variation``, the standard deviation of the drift at the position where it is
          largest (NaN where not known), and ``temperature_difference`` (K), that of the material from 20 degC.

        The uncertainties of mean deviations are relative to the first position. Quantities that need both directions are NaN where
        one was not measured; of one cycle, which has no standard deviation, R, A, s_i and all uncertainties are NaN.
        ``attrs["window"]`` names the cycles, says if they are not the five of the standard, and which targets
        are left out because a direction has fewer than two readings there.

    Raises
    ------
    InterferometryError
        ``deviations`` lack a variable of ``contract.DEVIATIONS``, the window names a cycle that was not measured, no target of several
        cycles has two readings in it, or a budget is given for a rotary axis.

    Notes
    -----
    ISO 230-2:2014, clause 3; docs/method/iso230.md. With mean deviations m and their standard deviations s, up and down for the
    directions: B = max(abs(m_up - m_down)), R_i = max(2 s_up + 2 s_down + abs(B_i), 4 s_up, 4 s_down), R = max R_i, E = max m - min m,
    M = range of (m_up + m_down) / 2, A = max(m + 2 s) - min(m - 2 s). Uncertainties by the law of propagation (JCGM 100:2008) with the
    contributions of Annex A.

    Examples
    --------
    >>> import numpy as np
    >>> from interferometry.deviations import build_deviations
    >>> from interferometry.iso230 import QUANTITIES
    >>> deviation = np.array([[[0.0, 5.0], [2.0, 6.0]], [[0.0, 5.0], [2.0, 6.0]]])
    >>> time = np.full(deviation.shape, np.datetime64("NaT", "ns"))
    >>> test = build_deviations([1, 2], [1, 2], np.array([0.0, 100.0]), deviation, time)
    >>> result = evaluate_iso230(test)
    >>> {name: float(result[name]) for name in QUANTITIES}
    {'B': 2.0, 'R': 2.0, 'E': 6.0, 'M': 4.5, 'A': 6.0}
    """
    deviations = check_dataset(deviations, "deviations", rotary=True)
    unit = deviations["deviation"].attrs.get("units", "um")
    if unit == "arcsec" and budget is not None and not budget.is_scatter_alone:
        raise InterferometryError(
            "budget: its contributions are parts per million of a length; leave it out for a rotary axis, where only the scatter enters"
        )
    deviations = deviations.reindex(direction=list(DIRECTIONS))
    x, numbers = _select(deviations, cycles)
    count = np.isfinite(x).sum(axis=0)
    x, count, left_out = _leave_out_single_readings(deviations, x, count)
    coords = {"direction": deviations["direction"].values, "target": deviations["target"].values}
    result = without_drift = xr.Dataset(_quantities(x, count), coords)
    used = _budget_of_window(budget or (SCATTER_ALONE if unit == "arcsec" else Iso230Budget()), material_degC, numbers)
    varied, stated, changes = np.nan, used.environmental_variation_um, {}
    if drift is not None:
        within = drift.reindex_like(deviations["deviation"]).sel(cycle=numbers)
        varied = _drift_variation(within.values)
        if stated is None:
            course = _drift_within(within, deviations["time"].sel(cycle=numbers))
            without_drift = xr.Dataset(_quantities(x - course, count), coords)
            changes = _changes_within(without_drift, course)
    # Without a standard deviation no uncertainty is known either.
    known = 1.0 if len(numbers) > 1 else np.nan
    uncertain = uncertainties(result * known, without_drift * known, changes, deviations["position"].values, used)
    result = result.assign(uncertain).assign(
        environmental_variation=varied if stated is None else stated,
        drift_variation=varied,
        temperature_difference=used.difference_from_20_degC_K,
    )
    result = result.assign_coords(quantity=list(AXIS), contributor=list(CONTRIBUTIONS))
    for name in result.data_vars:
        result[name].attrs["units"] = {"count": "1", "temperature_difference": "K"}.get(str(name), unit)
    result.attrs["window"] = _name_window(numbers, left_out)
    return result


def _drift_variation(within: np.ndarray) -> float:
    """Return the standard deviation of the drift over the cycles of a window, at the position and approach where it is largest, um."""
    known = np.isfinite(within).sum(axis=0) >= 2
    return float(np.nanstd(within[:, known], axis=0, ddof=1).max()) if known.any() else np.nan


def _drift_within(drift: xr.DataArray, time: xr.DataArray) -> np.ndarray:
    """Return the drift of a window from its mean at every target, um; where a reading has none, that of its cycle.

    Approaches minutes apart in one drift differ by what it does meanwhile; a difference at the same time is the reversal of that state.
    """
    drift = drift - drift.mean(("cycle", "direction"))
    if drift.sizes["direction"] == 2:
        half = xr.DataArray([0.5, -0.5], dims="direction")
        drift = drift - half * xr.DataArray(_reversal_at_one_time(drift.values, time.values), dims="target")
    return (
        drift.fillna(drift.mean(("direction", "target"))).fillna(0.0).transpose("cycle", "direction", "target").values
    )


def _reversal_at_one_time(drift: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return the mean difference of both approaches at the times of either (target,), um; 0 where their times do not overlap."""
    seconds = np.where(np.isnat(time) | np.isnan(drift), np.nan, time.astype("datetime64[ns]").astype("f8") * 1e-9)
    found = np.zeros(drift.shape[2])
    for target, (at, values) in enumerate(zip(seconds.transpose(2, 1, 0), drift.transpose(2, 1, 0), strict=True)):
        forth, back = (np.isfinite(one) for one in at)
        if not forth.any() or not back.any():
            continue
        back_at_forth = np.interp(at[0][forth], at[1][back], values[1][back], left=np.nan, right=np.nan)
        forth_at_back = np.interp(at[1][back], at[0][forth], values[0][forth], left=np.nan, right=np.nan)
        differences = np.concatenate([values[0][forth] - back_at_forth, forth_at_back - values[1][back]])
        if np.isfinite(differences).any():
            found[target] = np.nanmean(differences)
    return found


def _changes_within(axis: xr.Dataset, drift: np.ndarray) -> dict[str, np.ndarray]:
    """Return the standard deviations of the axis's quantities, um, over the thermal states of the cycles of a window."""
    if len(drift) < 2:
        return {}
    states = axis["mean_unidirectional"].values + drift.mean(axis=1, keepdims=True)
    found = axis_quantities(states, np.broadcast_to(axis["standard_deviation"].values, states.shape))
    return {name: values.std(axis=0, ddof=1) for name, values in found.items()}


def _budget_of_window(budget: Iso230Budget, material_degC: xr.DataArray | None, cycles: np.ndarray) -> Iso230Budget:
    """Return the budget with the temperature of the material that was measured during a window."""
    if material_degC is not None:
        mean = float(material_degC.sel(cycle=cycles).mean())
        if np.isfinite(mean):
            budget = replace(budget, difference_from_20_degC_K=abs(mean - REFERENCE_TEMPERATURE_DEGC))
    return budget


def evaluate_windows(
    deviations: xr.Dataset,
    *,
    budget: Iso230Budget | None = None,
    drift: xr.DataArray | None = None,
    material_degC: xr.DataArray | None = None,
) -> xr.Dataset:
    """Evaluate windows of a few cycles laid back from the last whole one, the first cycles, and the whole test as the last window."""
    numbers, length = deviations["cycle"].values.tolist(), STANDARD_CYCLES
    read = deviations["deviation"].count(("direction", "target")).values
    # A test that was broken off ends with a part of a cycle.
    end = int(np.flatnonzero(read >= np.median(read))[-1]) + 1
    starts = sorted({0, *range(end - length, -1, -length)}) if len(numbers) >= length else []
    windows = [numbers[start : start + length] for start in starts]
    repeated = [(deviations["deviation"].sel(cycle=window).count("cycle") >= 2).any() for window in windows]
    windows = [*compress(windows, repeated), numbers]
    parts, names = [], []
    # The results of thousands of windows are very many small objects: those of some windows become one at a time.
    for start in range(0, len(windows), _WINDOWS_AT_ONCE):
        results = [
            evaluate_iso230(deviations, cycles=window, budget=budget, drift=drift, material_degC=material_degC)
            for window in windows[start : start + _WINDOWS_AT_ONCE]
        ]
        names += [result.attrs["window"] for result in results]
        # What was found of the axis as a whole, without the values of single targets.
        of_axis = [one.drop_vars([name for name in one.data_vars if "target" in one[name].dims]) for one in results]
        parts.append(xr.concat(of_axis, dim="window", coords="minimal", compat="override"))
    joined = parts[0] if len(parts) == 1 else xr.concat(parts, dim="window", coords="minimal", compat="override")
    return joined.assign_coords(
        window=names,
        middle_cycle=("window", [float(np.mean(window)) for window in windows]),
        first_cycle=("window", [window[0] for window in windows]),
        last_cycle=("window", [window[-1] for window in windows]),
    ).assign_attrs(window="several")


def accuracy_with_table(deviations: xr.Dataset, drift: xr.DataArray, windows: Sequence[Sequence[int]]) -> np.ndarray:
    """Return A of every window (windows,), um, had a table of both approaches corrected the profile that the other cycles show.

    NaN where no other cycle holds what the window does: readings that a table was made from say nothing of a test with it.
    """
    x = deviations["deviation"].transpose("cycle", "direction", "target").reindex(direction=list(DIRECTIONS))
    # What is flagged, as a single gross error, enters no table.
    profile = (x - drift).where(deviations["quality_flag"] == 0).transpose(*x.dims)
    found = []
    for window in windows:
        inside = x["cycle"].isin(window)
        left = (x[inside] - profile[~inside].mean("cycle")).values
        count, read = np.isfinite(left).sum(axis=0), np.isfinite(x[inside].values).sum(axis=0)
        mean, s = _mean_and_s(left, np.where(count > 1, count, 0))
        found.append(float(axis_quantities(mean, s)["A"]) if (count == read).all() else np.nan)
    return np.array(found)


def _select(deviations: xr.Dataset, cycles: Sequence[int] | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the readings of the window as (cycle, direction, target), and the numbers of its cycles."""
    numbers = deviations["cycle"].values
    if cycles is None:
        return deviations["deviation"].values, np.asarray(numbers)
    missing = sorted(set(cycles) - set(numbers.tolist()))
    if missing:
        raise InterferometryError(
            f"cycles {missing} of the window were not measured; the test holds {numbers.tolist()}"
        )
    chosen = np.isin(numbers, list(cycles))
    return deviations["deviation"].values[chosen], numbers[chosen]


def _leave_out_single_readings(
    deviations: xr.Dataset, x: np.ndarray, count: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Leave out, by name, positions with fewer than two readings in a measured direction: they have no standard deviation."""
    if x.shape[0] == 1 and count.any():
        return x, count, []
    measured = count.any(axis=1, keepdims=True)
    single = (count < 2) & measured
    if not ((count >= 2) & measured).any():
        raise InterferometryError(
            f"no target has two readings from one side in a window of {x.shape[0]} cycles; ISO 230-2 requires {STANDARD_CYCLES} cycles, "
            "and scatter needs two: measure more, or widen the window"
        )
    names = [
        f"{deviations['target'].values[target]} {deviations['direction'].values[direction]}"
        for direction, target in np.argwhere(single)
    ]
    return np.where(single, np.nan, x), np.where(single, 0, count), names


def _mean_and_s(x: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and sample standard deviation over cycles; NaN where a direction was not measured."""
    filled = np.where(np.isfinite(x), x, 0.0)
    mean = filled.sum(axis=0) / np.where(count > 0, count, np.nan)
    squares = np.where(np.isfinite(x), (x - mean) ** 2, 0.0).sum(axis=0)
    return mean, np.sqrt(squares / np.where(count > 1, count - 1, np.nan))


def _name_window(cycles: np.ndarray, left_out: Sequence[str]) -> str:
    # Of a few cycles with others between them each is named.
    apart = int(cycles[-1] - cycles[0]) >= cycles.size and cycles.size <= STANDARD_CYCLES
    numbers = ", ".join(map(str, cycles)) if apart else f"{cycles[0]} to {cycles[-1]}"
    name = f"cycles {numbers}" if cycles.size > 1 else f"cycle {cycles[0]}"
    if cycles.size != STANDARD_CYCLES:
        counted = "1 cycle" if cycles.size == 1 else f"{cycles.size} cycles"
        name += f" ({counted}, not the {STANDARD_CYCLES} of the standard's acceptance test)"
    return name + (f"; without targets {', '.join(left_out)} (fewer than two readings)" if left_out else "")


def _quantities(x: np.ndarray, count: np.ndarray) -> dict[str, tuple[tuple[str, ...], object]]:
    """Return the quantities of the standard from deviations x and their numbers (cycle, direction, target), as variables."""
    mean, s = _mean_and_s(x, count)
    both, reversal, repeatability = target_quantities(mean, s)
    known = reversal[np.isfinite(reversal)]
    of_axis = axis_quantities(mean, s)
    return {
        "mean_unidirectional": (("direction", "target"), mean),
        "standard_deviation": (("direction", "target"), s),
        "repeatability": (("direction", "target"), 4 * s),
        "count": (("direction", "target"), count),
        "mean_bidirectional": (("target",), both),
        "reversal": (("target",), reversal),
        "repeatability_bidirectional": (("target",), repeatability),
        **{name: (("direction",), values) for name, values in of_axis.items() if name in ONE_WAY},
        **{name: ((), float(value)) for name, value in of_axis.items() if name not in ONE_WAY},
        "B_of_scatter": ((), _reversal_of_scatter(s, count)),
        "mean_reversal": ((), float(np.mean(known)) if known.size else np.nan),
    }


def _reversal_of_scatter(s: np.ndarray, count: np.ndarray) -> float:
    """Return the B that scatter alone gives in half of such tests, um."""
    variance = (s**2 / np.fmax(count, 1)).sum(axis=0)
    both = variance[np.isfinite(variance)]
    return (
        float(scipy.special.ndtri((1.0 + 0.5 ** (1.0 / both.size)) / 2.0) * np.sqrt(both.mean()))
        if both.size
        else np.nan
    )


# Other evaluations of the same readings: VDI/DGQ 3441 and the Japanese practice of JIS B 6330.

VDI, JIS = "VDI/DGQ 3441", "JIS B 6330"


@dataclass(frozen=True)
class OtherQuantity:
    """A quantity of VDI/DGQ 3441 or JIS B 6330, with its symbol where it has one, and how it is calculated."""

    standard: str
    name: str
    value_um: float
    definition: str


def evaluate_other_standards(deviations: xr.Dataset, *, cycles: Sequence[int]) -> list[OtherQuantity]:
    """Evaluate a window of cycles by VDI/DGQ 3441 and JIS B 6330."""
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
    uncertainty = np.max(middle + half) - np.min(middle - half)
    rows = (
        ("position uncertainty P", uncertainty, "range of m ± (U + Ps) / 2 over the targets"),
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
    accuracy = np.nanmax(np.abs(x - starts))
    repeatability = ((np.nanmax(x, axis=0) - np.nanmin(x, axis=0)) / 2).max()
    mean = np.nanmean(x, axis=0)
    lost_motion = np.abs(mean[0] - mean[1]).max()
    from_first = "largest deviation from the first target of its pass, over all passes"
    half_range = "half of the largest range of readings of one target from one side"
    return [
        OtherQuantity(JIS, "positioning accuracy", float(accuracy), from_first),
        OtherQuantity(JIS, "positioning repeatability (±)", float(repeatability), half_range),
        OtherQuantity(JIS, "lost motion", float(lost_motion), "largest difference of both approaches' means"),
    ]
