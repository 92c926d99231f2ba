"""Planning of a positioning test from a trial: cycles for a wanted uncertainty, target spacing, time until thermally stable."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy
import xarray as xr
from scipy import special

from interferometry.common import Array, InterferometryError, check_dataset

#: Share of the final drift after which it counts as settled.
SETTLED_SHARE = 0.95
#: A spacing this close to a whole number of leads hides the screw's periodic error.
SPACING_TOLERANCE = 0.02
LONGEST_SEARCH_CYCLES = 100_000
SHORTEST_TEST_CYCLES = 10
#: An exponential is reported where it explains a component better than a constant at this level.
SETTLING_LEVEL = 1e-3
#: Rounding of a drift component, relative to its size.
_ROUNDING = 1e-14


@dataclass(frozen=True)
class MeasurementPlan:
    """Length of a positioning test for a wanted uncertainty.

    Attributes
    ----------
    cycles : int
    duration_s : time of these cycles at the pace of the trial, s
    u_um : standard uncertainty of a position against the first one that these cycles reach, um
    warnings : about the target spacing; empty where there is nothing to warn about, or no lead was given
    """

    cycles: int
    duration_s: float
    u_um: float
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Settling:
    """Time after which an exponential drift component has reached 95 % of its final value.

    Attributes
    ----------
    component : name of the drift component
    t95_s : since the first reading, s
    t95_low_s, t95_high_s : limits of the 95 % confidence interval, s; infinite where the test is too short to show the end
    amplitude_um : final drift where the component's loading is 1, um
    """

    component: str
    t95_s: float
    t95_low_s: float
    t95_high_s: float
    amplitude_um: float


def plan_cycles(
    deviations: xr.Dataset, estimated: xr.Dataset, *, wanted_u_um: float, lead_mm: float | None = None
) -> MeasurementPlan:
    """Return the number of cycles that a wanted standard uncertainty needs, on the machine of a trial.

    Parameters
    ----------
    deviations : xarray.Dataset
        The trial (keeps ``contract.DEVIATIONS``): its targets, and the duration of its cycle.
    estimated : xarray.Dataset
        What `estimate_drift` returns for the trial.
    wanted_u_um : float
        Standard uncertainty of every position against the first one, mean of both directions, um.
    lead_mm : float, optional
        Lead of the screw, mm, for the warning about the target spacing; None: no warning.

    Returns
    -------
    MeasurementPlan

    Raises
    ------
    InterferometryError
        ``wanted_u_um`` or ``lead_mm`` is not above 0, more than 100,000 cycles would be needed, or no direction of the trial holds
        every target; or ``deviations`` lack a variable of ``contract.DEVIATIONS``.

    Notes
    -----
    Once the joint estimate has removed the drift, the uncertainty falls with the root of the number of readings (GUM, JCGM 100:2008,
    4.2.3): n = n_trial (u_trial / u_wanted)^2, at least 2.

    Examples
    --------
    A trial of ten cycles over three targets, 60 s each, whose readings scatter by 0.5 um:

    >>> import numpy as np
    >>> from interferometry.deviations import build_deviations
    >>> from interferometry.drift.estimate import estimate_drift
    >>> seconds = 10.0 * np.arange(60.0).reshape(10, 2, 3)
    >>> noise = np.random.default_rng(0).normal(0, 0.5, (10, 2, 3))
    >>> time = np.datetime64("2026-03-09T06:30") + (1e9 * seconds).astype("timedelta64[ns]")
    >>> trial = build_deviations(range(1, 11), [1, 2, 3], np.array([0.0, 150.0, 300.0]), noise, time)
    >>> plan = plan_cycles(trial, estimate_drift(trial), wanted_u_um=0.05, lead_mm=10.0)
    >>> plan.u_um <= 0.05, round(plan.duration_s / plan.cycles)
    (True, 60)
    >>> plan.warnings[0].split(":")[0]
    'every target spacing is a whole number of leads (10 mm)'
    """
    deviations = check_dataset(deviations, "deviations")
    if not wanted_u_um > 0:
        raise InterferometryError(f"wanted_u_um={wanted_u_um} is not above 0")
    measured = int(np.isfinite(deviations["deviation"].values).any(axis=(1, 2)).sum())
    largest_u = _largest_relative_u(estimated)
    cycles = max(2, math.ceil(measured * (largest_u / wanted_u_um) ** 2))
    if cycles > LONGEST_SEARCH_CYCLES:
        raise InterferometryError(
            f"wanted_u_um={wanted_u_um} would need {cycles} cycles with this scatter; allow a larger uncertainty"
        )
    time = deviations["time"].values.astype("datetime64[ns]")
    has_times = (~np.isnat(time)).any(axis=(1, 2))
    starts = np.array([cycle[~np.isnat(cycle)].min() for cycle in time[has_times]])
    numbers = deviations["cycle"].values[has_times]
    period = float(np.median(np.diff(starts).astype("f8") * 1e-9 / np.diff(numbers)))
    warnings = [] if lead_mm is None else spacing_warnings(deviations["position"].values, lead_mm=lead_mm)
    return MeasurementPlan(cycles, cycles * period, largest_u * math.sqrt(measured / cycles), tuple(warnings))


def spacing_warnings(position_mm: Array, *, lead_mm: float) -> list[str]:
    """Return a warning where the target spacing hides the periodic error of the screw."""
    if not lead_mm > 0:
        raise InterferometryError(f"lead_mm={lead_mm} is not above 0")
    leads = np.diff(np.sort(position_mm)) / lead_mm
    is_whole = np.abs(leads - np.round(leads)) < SPACING_TOLERANCE
    if is_whole.all() and np.all(np.round(leads) >= 1):
        return [
            f"every target spacing is a whole number of leads ({lead_mm:g} mm): a periodic screw error looks constant; "
            "add a random part to each position"
        ]
    return []


def _largest_relative_u(estimated: xr.Dataset) -> float:
    """Return the largest standard uncertainty (um) of a position against the first one, mean of both directions."""
    covariance = estimated["covariance"].values
    directions, targets = covariance.shape[:2]
    measured = [d for d in range(directions) if np.isfinite(covariance[d, :, d, :]).all()]
    if not measured:
        raise InterferometryError("no direction holds every target; planning needs a trial with all targets")
    block = covariance[np.ix_(measured, range(targets), measured, range(targets))].mean(axis=(0, 2))
    variance = np.diag(block) + block[0, 0] - 2 * block[0]
    return float(np.sqrt(variance.max()))


def estimate_settling(deviations: xr.Dataset, estimated: xr.Dataset) -> list[Settling]:
    """Fit one exponential to each drift component: the time until it has reached 95 % of its final value."""
    seconds, series = _cycle_components(deviations, estimated)
    if seconds.size < SHORTEST_TEST_CYCLES:
        return []
    names = [str(name) for name in estimated["component"].values]
    fitted = [_fit_exponential(name, seconds, series[:, column]) for column, name in enumerate(names)]
    return [settling for settling in fitted if settling is not None]


def _cycle_components(deviations: xr.Dataset, estimated: xr.Dataset) -> tuple[Array, Array]:
    """Return the middle of each measured cycle (s since the first reading) and its drift components, not smoothed in time."""
    time = deviations["time"].values.astype("datetime64[ns]")
    first = time[~np.isnat(time)].min()
    drift = (deviations["deviation"] - estimated["profile"]).transpose(*deviations["deviation"].dims).values
    share = estimated["drift_share"].transpose("component", *deviations["deviation"].dims[1:]).values
    loadings = share.reshape(share.shape[0], -1).T
    seconds, rows = [], []
    for cycle, values in zip(time, drift, strict=True):
        present = np.isfinite(values.ravel()) & ~np.isnat(cycle.ravel())
        if not present.any() or np.linalg.matrix_rank(loadings[present]) < loadings.shape[1]:
            continue
        rows.append(np.linalg.lstsq(loadings[present], values.ravel()[present], rcond=None)[0])
        seconds.append((cycle.ravel()[present] - first).astype("f8").mean() * 1e-9)
    return np.array(seconds), np.array(rows)


def _fit_exponential(name: str, seconds: Array, series: Array) -> Settling | None:
    """Return the settling of a component (um), None where an exponential explains it no better than a constant."""
    length = float(seconds[-1] - seconds[0])

    def solve(log_tau: float) -> tuple[float, Array, Array]:
        basis = np.column_stack([np.ones(seconds.size), 1 - np.exp(-seconds / math.exp(log_tau))])
        coefficients = np.linalg.lstsq(basis, series, rcond=None)[0]
        residual = series - basis @ coefficients
        return float(residual @ residual), coefficients, residual

    def sum_of_squares(log_tau: float) -> float:
        return solve(log_tau)[0]

    grid = np.linspace(math.log(length / 100), math.log(length * 20), 120)
    nearest = grid[int(np.argmin([sum_of_squares(log_tau) for log_tau in grid]))]
    step = grid[1] - grid[0]
    best = scipy.optimize.minimize_scalar(sum_of_squares, bounds=(nearest - step, nearest + step), method="bounded")
    lowest, coefficients, residual = solve(float(best.x))
    correlation = float((residual[1:] * residual[:-1]).sum() / max(float((residual**2).sum()), 1e-300))
    independent = max(seconds.size * (1 - max(correlation, 0.0)) / (1 + max(correlation, 0.0)), 5.0)
    total = float(((series - series.mean()) ** 2).sum())
    # What is constant to rounding has nothing that settles, whatever share of the rounding an exponential explains.
    if total <= (_ROUNDING * np.abs(series).max(initial=0.0)) ** 2 * series.size:
        return None
    f_ratio = max(total - lowest, 0.0) / 2 / max(lowest / (independent - 3), 1e-300)
    if special.fdtrc(2, independent - 3, f_ratio) > SETTLING_LEVEL:
        return None
    limit = max(lowest, 1e-12) * (1 + 3.84 / (independent - 3))

    def confidence_limit(end: float) -> float:
        """Return where the sum of squares crosses the limit between the best time constant and an end of the search."""
        if sum_of_squares(end) <= limit:
            return end
        return float(scipy.optimize.brentq(lambda log_tau: sum_of_squares(log_tau) - limit, float(best.x), end))

    low, top = math.exp(confidence_limit(grid[0])), confidence_limit(grid[-1])
    high = math.inf if top == grid[-1] else math.exp(top)
    per_tau = -math.log(1 - SETTLED_SHARE)
    tau = math.exp(float(best.x))
    return Settling(name, tau * per_tau, low * per_tau, high * per_tau, amplitude_um=float(coefficients[1]))
