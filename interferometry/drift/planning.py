"""How long to measure: cycles for a wanted uncertainty, time until thermally stable, spacing against the lead."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy import optimize, stats

from interferometry._typing import Array
from interferometry.drift.estimate import loadings_of
from interferometry.errors import InterferometryError

#: Shares of the final drift whose times are named t63 and t95.
SHARES = {"t63": 1 - math.exp(-1), "t95": 0.95}
#: A spacing this close to a whole number of leads hides the screw's periodic error.
SPACING_TOLERANCE = 0.02
LONGEST_SEARCH_CYCLES = 100_000
SHORTEST_TEST_CYCLES = 10
#: An exponential is reported where it explains a component better than a constant at this level.
SETTLING_LEVEL = 1e-3


@dataclass(frozen=True)
class Plan:
    """What a measurement has to be for a wanted uncertainty.

    Attributes
    ----------
    cycles : int
    duration_s : float
    u_um : float
        Standard uncertainty of a position against the first one that these cycles reach.
    warnings : tuple of str
    """

    cycles: int
    duration_s: float
    u_um: float
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Settling:
    """When an exponential drift has gone 63 % and 95 % of its way, in s since the first reading.

    Attributes
    ----------
    component : str
    t63_s, t95_s : float
    t63_low_s, t63_high_s, t95_low_s, t95_high_s : float
        95 % bands; infinite where the test is too short to see the end.
    amplitude_um : float
        Final drift at the component's full share.
    """

    component: str
    t63_s: float
    t63_low_s: float
    t63_high_s: float
    t95_s: float
    t95_low_s: float
    t95_high_s: float
    amplitude_um: float


def plan_cycles(
    estimated: xr.Dataset,
    deviations: xr.Dataset,
    *,
    wanted_u_um: float,
    lead_mm: float | None = None,
) -> Plan:
    """Return the cycles needed for a wanted standard uncertainty, on the machine that a test has shown.

    The uncertainty of a position against the first one, both directions together, falls with the root of the number of
    readings once the joint estimate has taken the drift out.

    Parameters
    ----------
    estimated : xarray.Dataset
        What `drift.estimate_drift` returns for a trial on this machine.
    deviations : xarray.Dataset
        The trial itself: its targets, and its cycle's duration.
    wanted_u_um : float
    lead_mm : float, optional
        Lead of the screw, for the warning about spacing.

    Raises
    ------
    InterferometryError
        ``wanted_u_um`` is not above 0, or needs more than 100,000 cycles.
    """
    if not wanted_u_um > 0:
        raise InterferometryError(f"wanted_u_um={wanted_u_um} is not above 0")
    measured = int(np.isfinite(deviations["deviation"].values).any(axis=(1, 2)).sum())
    worst = _relative_u_both_directions(estimated)
    cycles = max(2, math.ceil(measured * (worst / wanted_u_um) ** 2))
    if cycles > LONGEST_SEARCH_CYCLES:
        raise InterferometryError(
            f"wanted_u_um={wanted_u_um} would need {cycles} cycles with this scatter; ask for more"
        )
    period = _cycle_period_s(deviations)
    warnings = [] if lead_mm is None else spacing_warnings(deviations["position"].values, lead_mm=lead_mm)
    return Plan(cycles, cycles * period, worst * math.sqrt(measured / cycles), tuple(warnings))


def spacing_warnings(position_mm: Array, *, lead_mm: float) -> list[str]:
    """Return warnings where target spacings hide the screw's periodic error.

    Parameters
    ----------
    position_mm : (target,) ndarray
    lead_mm : float
    """
    if not lead_mm > 0:
        raise InterferometryError(f"lead_mm={lead_mm} is not above 0")
    leads = np.diff(np.sort(position_mm)) / lead_mm
    whole = np.abs(leads - np.round(leads)) < SPACING_TOLERANCE
    if whole.all() and np.all(np.round(leads) >= 1):
        return [
            f"every target spacing is a whole number of leads ({lead_mm:g} mm): a periodic screw error looks constant; "
            "add a random part to each position (equation 1)"
        ]
    return []


def _relative_u_both_directions(estimated: xr.Dataset) -> float:
    """Return the largest standard uncertainty of (position - first position), the mean of both directions."""
    covariance = estimated["covariance"].values
    directions, targets = covariance.shape[:2]
    measured = [d for d in range(directions) if np.isfinite(covariance[d, :, d, :]).all()]
    if not measured:
        raise InterferometryError("no direction holds every target; planning needs a trial with all targets")
    block = covariance[np.ix_(measured, range(targets), measured, range(targets))].mean(axis=(0, 2))
    variance = np.diag(block) + block[0, 0] - 2 * block[0]
    return float(np.sqrt(variance.max()))


def _cycle_period_s(deviations: xr.Dataset) -> float:
    time = deviations["time"].values.astype("datetime64[ns]")
    starts = np.array([cycle[~np.isnat(cycle)].min() for cycle in time if (~np.isnat(cycle)).any()])
    numbers = deviations["cycle"].values[[bool((~np.isnat(cycle)).any()) for cycle in time]]
    return float(np.median(np.diff(starts).astype("f8") * 1e-9 / np.diff(numbers)))


def estimate_settling(estimated: xr.Dataset, deviations: xr.Dataset) -> list[Settling]:
    """Fit one exponential to each drift component and say when it is 63 % and 95 % through.

    Bands come from the profile of the sum of squares over the time constant, with as many independent residuals as the
    serial correlation of the residual leaves.

    Parameters
    ----------
    estimated : xarray.Dataset
        What `drift.estimate_drift` returns.
    deviations : xarray.Dataset

    Returns
    -------
    list of Settling
        One per drift component that settles; none for a stable machine.
    """
    seconds, series = _cycle_components(estimated, deviations)
    if seconds.size < SHORTEST_TEST_CYCLES:
        return []
    names = [str(name) for name in estimated["component"].values]
    fitted = [_fit_exponential(name, seconds, series[:, at]) for at, name in enumerate(names)]
    return [one for one in fitted if one is not None]


def _cycle_components(estimated: xr.Dataset, deviations: xr.Dataset) -> tuple[Array, Array]:
    """Return the middle of each measured cycle (s since the first reading) and its drift components, not smoothed in time."""
    time = deviations["time"].values.astype("datetime64[ns]")
    first = time[~np.isnat(time)].min()
    left = (deviations["deviation"] - estimated["profile"]).transpose(*deviations["deviation"].dims).values
    sign = np.where(deviations["direction"].values == "positive", 1.0, -1.0)[:, None] * np.ones(left.shape[2])
    position = np.broadcast_to(deviations["position"].values, left.shape[1:])
    span = float(deviations["position"].min()), float(deviations["position"].max())
    loadings = loadings_of(sign.ravel(), position.ravel(), estimated["component"].values.tolist(), span)
    seconds, rows = [], []
    for cycle, values in zip(time, left, strict=True):
        present = np.isfinite(values.ravel())
        if not present.any() or np.linalg.matrix_rank(loadings[present]) < loadings.shape[1]:
            continue
        rows.append(np.linalg.lstsq(loadings[present], values.ravel()[present], rcond=None)[0])
        seconds.append((cycle.ravel()[present] - first).astype("f8").mean() * 1e-9)
    return np.array(seconds), np.array(rows)


def _fit_exponential(name: str, seconds: Array, series: Array) -> Settling | None:
    length = float(seconds[-1] - seconds[0])

    def solve(log_tau: float) -> tuple[float, Array, Array]:
        basis = np.column_stack([np.ones(seconds.size), 1 - np.exp(-seconds / math.exp(log_tau))])
        coefficients = np.linalg.lstsq(basis, series, rcond=None)[0]
        left = series - basis @ coefficients
        return float(left @ left), coefficients, left

    grid = np.linspace(math.log(length / 100), math.log(length * 20), 120)
    sums = np.array([solve(one)[0] for one in grid])
    near = grid[int(np.argmin(sums))]
    step = grid[1] - grid[0]
    best = optimize.minimize_scalar(lambda one: solve(one)[0], bounds=(near - step, near + step), method="bounded")
    lowest, coefficients, left = solve(float(best.x))
    lag = float((left[1:] * left[:-1]).sum() / max(float((left**2).sum()), 1e-300))
    independent = max(seconds.size * (1 - max(lag, 0.0)) / (1 + max(lag, 0.0)), 5.0)
    gain = (float(((series - series.mean()) ** 2).sum()) - lowest) / 2 / max(lowest / (independent - 3), 1e-300)
    if stats.f.sf(gain, 2, independent - 3) > SETTLING_LEVEL:
        return None
    limit = max(lowest, 1e-12) * (1 + 3.84 / (independent - 3))

    def side(end: float) -> float:
        """Return where the sum of squares crosses the limit between the best time constant and an end of the search."""
        if solve(end)[0] <= limit:
            return end
        return float(optimize.brentq(lambda one: solve(one)[0] - limit, float(best.x), end))

    low, top = math.exp(side(grid[0])), side(grid[-1])
    high = math.inf if top == grid[-1] else math.exp(top)
    tau = math.exp(float(best.x))
    until = {key: -math.log(1 - share) for key, share in SHARES.items()}
    return Settling(
        component=name,
        t63_s=tau * until["t63"],
        t63_low_s=low * until["t63"],
        t63_high_s=high * until["t63"],
        t95_s=tau * until["t95"],
        t95_low_s=low * until["t95"],
        t95_high_s=high * until["t95"],
        amplitude_um=float(coefficients[1]),
    )
