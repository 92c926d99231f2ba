"""Differences of neighbouring positions, and the conventional evaluation beside them.

Equations (1) to (10) and the deviation charts of "Elimination of thermal drift in measuring the positioning
accuracy of a three axis milling machine". What equations (5) and (6) call a sample standard deviation divides by
n (n - 1): it is the standard uncertainty of a mean, and bears that name here, beside the real standard deviation.

The chain of mean differences telescopes exactly to the mean profile: differencing cleans the standard deviation of
drift, not the mean.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from scipy import optimize, stats

from interferometry.errors import InterferometryError

#: Probability that two standard deviations of a normal distribution cover; Student's t replaces the 2 below it.
TWO_SIGMA_PROBABILITY = 0.9545
#: Number of repetitions from which the normal distribution may be taken.
ENOUGH_REPETITIONS = 30
DEFAULT_REFERENCE_S = 7200.0


def place_targets(count: int, interval_mm: float, periodic_error_mm: float, rng: np.random.Generator) -> np.ndarray:
    """Return target positions by equation (1): P_i = (i - 1) p + r.

    Parameters
    ----------
    count : int
    interval_mm : float
        Spacing p.
    periodic_error_mm : float
        Amplitude of r, within the possible periodic error of the axis (for a screw, up to its lead).
    rng : numpy.random.Generator

    Returns
    -------
    (count,) ndarray
        Positions in mm.
    """
    return np.arange(count) * interval_mm + rng.uniform(-periodic_error_mm, periodic_error_mm, count)


def coverage_factor(repetitions: np.ndarray) -> np.ndarray:
    """Return 2 from thirty repetitions, Student's t for the same probability below.

    Parameters
    ----------
    repetitions : ndarray of int
        Number n of repetitions; NaN results below 2.
    """
    n = np.asarray(repetitions)
    student = stats.t.ppf(0.5 + TWO_SIGMA_PROBABILITY / 2, np.maximum(n - 1, 1))
    return np.where(n < 2, np.nan, np.where(n < ENOUGH_REPETITIONS, student, 2.0))


def evaluate_conventional(deviations: xr.Dataset) -> xr.Dataset:
    """Evaluate each position on its own, equations (2), (3) and (5).

    Parameters
    ----------
    deviations : xarray.Dataset
        Keeps ``contract.DEVIATIONS``; missing readings are skipped.

    Returns
    -------
    xarray.Dataset
        Per direction and target, in um: mean, standard_deviation (n - 1), mean_u (equation (5), the standard
        uncertainty of the mean), lower and upper border (mean minus and plus k standard deviations); count and k.
    """
    x = deviations["deviation"]
    count = x.count("cycle")
    spread = _standard_deviation(x, "cycle")
    k = xr.apply_ufunc(coverage_factor, count)
    mean = x.mean("cycle")
    return xr.Dataset(
        {
            "mean": mean.assign_attrs(units="um"),
            "standard_deviation": spread.assign_attrs(units="um", long_name="sample standard deviation (n - 1)"),
            "mean_u": (spread / np.sqrt(count)).assign_attrs(units="um", long_name="standard uncertainty of the mean"),
            "lower": (mean - k * spread).assign_attrs(units="um"),
            "upper": (mean + k * spread).assign_attrs(units="um"),
            "count": count.assign_attrs(units="1"),
            "coverage_factor": k.assign_attrs(units="1"),
        }
    )


def evaluate_neighbours(deviations: xr.Dataset) -> xr.Dataset:
    """Evaluate differences x_i - x_(i+1) of neighbouring targets, equations (4) and (6).

    Parameters
    ----------
    deviations : xarray.Dataset
        Keeps ``contract.DEVIATIONS``. Cycles in which either reading of a pair is missing do not count for the pair.

    Returns
    -------
    xarray.Dataset
        Dim ``link``, labelled by its further target as in the paper (the first position is the reference and does not
        count), per direction, in um: mean_difference (4), mean_difference_u (6), standard_deviation (n - 1),
        position_standard_deviation (that divided by sqrt 2: one position's scatter if both positions scatter alike),
        count, and covariance (direction, link, other_link; um2) of the mean differences. Links share a position, so
        they are correlated: white noise gives -0.5.

    Raises
    ------
    InterferometryError
        Fewer than two targets.
    """
    x = _along_axis(deviations)
    if x.sizes["target"] < 2:
        raise InterferometryError(f"{x.sizes['target']} target has no neighbour; measure at least two target positions")
    near = x.isel(target=slice(None, -1)).rename(target="link").assign_coords(link=x["target"].values[1:])
    far = x.isel(target=slice(1, None)).rename(target="link")
    difference = near - far
    count = difference.count("cycle")
    spread = _standard_deviation(difference, "cycle")
    return xr.Dataset(
        {
            "mean_difference": difference.mean("cycle").assign_attrs(units="um"),
            "mean_difference_u": (spread / np.sqrt(count)).assign_attrs(
                units="um", long_name="standard uncertainty of the mean difference, equation (6)"
            ),
            "standard_deviation": spread.assign_attrs(units="um", long_name="sample standard deviation (n - 1)"),
            "position_standard_deviation": (spread / np.sqrt(2)).assign_attrs(units="um"),
            "count": count.assign_attrs(units="1"),
            "covariance": _covariance_of_means(difference).assign_attrs(units="um2"),
        }
    )


def build_chart(
    deviations: xr.Dataset, *, reference: str = "time", reference_s: float = DEFAULT_REFERENCE_S
) -> xr.Dataset:
    """Build the deviation chart: a reference value at position 1, then the chain of mean differences.

    Parameters
    ----------
    deviations : xarray.Dataset
        Keeps ``contract.DEVIATIONS``.
    reference : {"time", "first_cycle"}
        Where the value at position 1 is taken: in the first cycle that reaches ``reference_s``, or in the first cycle.
    reference_s : float
        Seconds since the first reading. The paper advises two hours, when changes have become slow. A shorter test
        gives its last cycle.

    Returns
    -------
    xarray.Dataset
        Per direction and target, in um: chart; border_u, k times equation (6); border_s, k times the standard
        deviation of the differences; chart_u, the standard uncertainty of the chain from position 1 with the full
        covariance of its links. Positions 1 and 2 have the same borders, as the paper draws them. reference_cycle
        (direction) says which cycle gave the value at position 1; 0 where it was never read: there is no chart then.

    Raises
    ------
    InterferometryError
        An unknown reference.
    """
    if reference not in ("time", "first_cycle"):
        raise InterferometryError(f"reference={reference!r} is neither 'time' nor 'first_cycle'")
    x = _along_axis(deviations)
    links = evaluate_neighbours(deviations)
    at = _reference_cycles(deviations, x, reference, reference_s)
    start = np.array([x.values[at[d], d, 0] if at[d] >= 0 else np.nan for d in range(x.sizes["direction"])])
    chain = np.cumsum(links["mean_difference"].values, axis=-1)
    chart = start[:, None] - np.concatenate([np.zeros((start.size, 1)), chain], axis=-1)
    k = coverage_factor(links["count"].values)
    variance = _chain_variance(links["covariance"].values)
    dims = ("direction", "target")
    cycles = deviations["cycle"].values
    return xr.Dataset(
        {
            "chart": (dims, chart, {"units": "um"}),
            "chart_u": (dims, np.sqrt(variance), {"units": "um"}),
            "border_u": (dims, _repeat_first(k * links["mean_difference_u"].values), {"units": "um"}),
            "border_s": (dims, _repeat_first(k * links["standard_deviation"].values), {"units": "um"}),
            "reference_cycle": (("direction",), [int(cycles[one]) if one >= 0 else 0 for one in at]),
        },
        coords={"direction": x["direction"].values, "target": x["target"].values},
        attrs={"reference": reference},
    )


def compare(deviations: xr.Dataset, estimated: xr.Dataset | None = None) -> xr.Dataset:
    """Set conventional and differenced standard deviations side by side, and that of the joint estimate.

    The ratio s_i / s of the differences is a property of the drift: 0.71 without any, 3.09 where the drift's own
    standard deviation is about 4.25 times the random one. It says nothing about an estimator's quality.

    Parameters
    ----------
    deviations : xarray.Dataset
    estimated : xarray.Dataset, optional
        What `drift.estimate_drift` returns.

    Returns
    -------
    xarray.Dataset
        Per direction and link, in um: conventional (of the link's further target), differenced, differenced_single
        (divided by sqrt 2), joint (the scatter of the joint estimate, if given); ratio of the first two.
    """
    links = evaluate_neighbours(deviations)
    numbers = links["link"].values

    def further(values: xr.DataArray) -> xr.DataArray:
        return values.sel(target=numbers).rename(target="link").assign_coords(link=numbers)

    conventional = further(evaluate_conventional(deviations)["standard_deviation"])
    table = xr.Dataset(
        {
            "conventional": conventional.assign_attrs(units="um"),
            "differenced": links["standard_deviation"],
            "differenced_single": links["position_standard_deviation"],
            "ratio": (conventional / links["standard_deviation"]).assign_attrs(units="1"),
        }
    )
    return table if estimated is None else table.assign(joint=further(estimated["scatter"]))


def telescoping_error(deviations: xr.Dataset) -> float:
    """Return max |chain - (mean_1 - mean_i)| in um over the targets: rounding only, where no reading is missing."""
    x = _along_axis(deviations)
    mean = x.mean("cycle").values
    chain = np.cumsum(evaluate_neighbours(deviations)["mean_difference"].values, axis=-1)
    return float(np.nanmax(np.abs(chain - (mean[:, :1] - mean[:, 1:]))))


def resolve_links(pair_s_um: np.ndarray) -> np.ndarray:
    """Resolve standard deviations of neighbour differences into those of positions.

    A position with excess scatter raises both of its links. The squares obey s_link^2 = s_i^2 + s_(i+1)^2, one equation
    fewer than positions: of all non-negative solutions the one is taken in which fewest positions differ from the
    usual one (absolute differences, by iterated reweighting).

    Parameters
    ----------
    pair_s_um : (m - 1,) ndarray

    Returns
    -------
    (m,) ndarray
    """
    variance = np.asarray(pair_s_um, float) ** 2
    links = variance.size
    sums = np.eye(links, links + 1) + np.eye(links, links + 1, 1)
    usual = float(np.median(variance)) / 2
    solution = np.full(links + 1, usual)
    for _ in range(30):
        weak = 0.3 * np.diag((np.maximum(np.abs(solution - usual) / usual, 0.02) / 0.02) ** -0.5)
        solution, _ = optimize.nnls(
            np.vstack([sums, weak]), np.concatenate([variance, weak @ np.full(links + 1, usual)])
        )
    return np.sqrt(solution)


def simulate_derived_sequence(samples: int, rng: np.random.Generator) -> xr.Dataset:
    """Repeat the paper's Monte Carlo of equations (7) to (10): differences of successive normal values.

    Returns
    -------
    xarray.Dataset
        source (sample) and derived (sample - 1) sequences of unit variance, and ratio, s_b / s_a, which tends to
        sqrt 2 (the paper found 1.4076 with 1,000 samples).
    """
    source = rng.standard_normal(samples)
    derived = source[:-1] - source[1:]
    return xr.Dataset(
        {
            "source": (("sample",), source),
            "derived": (("derived_sample",), derived),
            "ratio": ((), derived.std(ddof=1) / source.std(ddof=1)),
        }
    )


def _along_axis(deviations: xr.Dataset) -> xr.DataArray:
    """Return deviations with targets in the order of their positions, so that neighbours are neighbours."""
    return deviations["deviation"].isel(target=np.argsort(deviations["position"].values, kind="stable"))


def _standard_deviation(x: xr.DataArray, dim: str) -> xr.DataArray:
    """Return the sample standard deviation; NaN, without a warning, where fewer than two values are."""
    count = x.count(dim)
    squares = ((x - x.mean(dim)) ** 2).sum(dim)
    spread: xr.DataArray = (squares / (count - 1).where(count > 1)) ** 0.5
    return spread


def _covariance_of_means(difference: xr.DataArray) -> xr.DataArray:
    """Return the covariance of the means of all links from the cycles that two links share."""
    centred = (difference - difference.mean("cycle")).values
    present = np.isfinite(centred)
    filled = np.where(present, centred, 0.0)
    products = np.einsum("cdi,cdj->dij", filled, filled)
    shared = np.einsum("cdi,cdj->dij", present.astype(float), present.astype(float))
    counts = present.sum(axis=0).astype(float)
    pairs = counts[:, :, None] * counts[:, None, :]
    covariance = np.full(products.shape, np.nan)
    usable = shared > 1
    covariance[usable] = products[usable] / (shared[usable] - 1) * shared[usable] / pairs[usable]
    dims = ("direction", "link", "other_link")
    return xr.DataArray(covariance, dims=dims)


def _chain_variance(covariance: np.ndarray) -> np.ndarray:
    """Return the variance of each partial sum of links, 0 at the reference position."""
    directions, links, _ = covariance.shape
    variance = np.zeros((directions, links + 1))
    for end in range(1, links + 1):
        variance[:, end] = np.maximum(covariance[:, :end, :end].sum(axis=(1, 2)), 0.0)
    return variance


def _repeat_first(values: np.ndarray) -> np.ndarray:
    return np.concatenate([values[:, :1], values], axis=-1)


def _reference_cycles(deviations: xr.Dataset, x: xr.DataArray, reference: str, reference_s: float) -> list[int]:
    """Return, per direction, the index of the cycle that gives the value at position 1; -1 where none was measured."""
    first = int(np.argmin(deviations["position"].values))
    times = deviations["time"].values[:, :, first]
    chosen = []
    for direction in range(x.sizes["direction"]):
        usable = np.flatnonzero(np.isfinite(x.values[:, direction, 0]))
        late = np.empty(0, dtype=int)
        if reference == "time":
            since = (times[usable, direction] - np.nanmin(deviations["time"].values)) / np.timedelta64(1, "s")
            late = usable[since >= reference_s]
            usable = usable[::-1]
        chosen.append(int(late[0]) if late.size else int(usable[0]) if usable.size else -1)
    return chosen
