"""Differences of neighbouring positions, and the conventional evaluation for comparison.

Equations (1) to (10) and the deviation charts of the paper "Elimination of thermal drift in measuring the positioning accuracy of a
three axis milling machine". What its equations (5) and (6) call a sample standard deviation divides by n (n - 1): it is the standard
uncertainty of a mean, and has that name here, next to the sample standard deviation.

The chain of mean differences telescopes exactly to the mean profile: differencing removes the drift from the standard deviation, not
from the mean. Equations are numbered as in the paper; see docs/method/differences.md.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from scipy import special

from interferometry.common import InterferometryError, check_dataset

#: Probability that two standard deviations of a normal distribution cover; Student's t replaces the 2 below it.
TWO_SIGMA_PROBABILITY = 0.9545
#: Number of repetitions from which the normal distribution may be taken.
ENOUGH_REPETITIONS = 30
#: Time from the start after which a reading may be the reference of a chart, s.
REFERENCE_S = 7200.0


def coverage_factor(repetitions: np.ndarray) -> np.ndarray:
    """Return the coverage factor of borders: 2 from thirty repetitions, Student's t for the same probability (0.9545) below."""
    n = np.asarray(repetitions)
    student = special.stdtrit(np.maximum(n - 1, 1), 0.5 + TWO_SIGMA_PROBABILITY / 2)
    return np.where(n < 2, np.nan, np.where(n < ENOUGH_REPETITIONS, student, 2.0))


def evaluate_conventional(deviations: xr.Dataset) -> xr.Dataset:
    """Evaluate each position on its own, equations (2), (3) and (5)."""
    x = deviations["deviation"]
    count = x.count("cycle")
    spread = _standard_deviation(x)
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
        Positioning deviations (cycle, direction, target) in um, as `build_deviations` returns them; a cycle in which either reading of
        a pair is missing does not count for the pair.

    Returns
    -------
    xarray.Dataset
        Per direction and ``link``, a pair of neighbouring targets labelled by the one further along the axis as in the paper (the first
        position is the reference and has none), in um: ``mean_difference`` (4); ``mean_difference_u``, its standard uncertainty (6);
        ``standard_deviation`` (n - 1); ``position_standard_deviation``, that divided by sqrt 2: of one position, if both scatter
        alike; ``count`` n (1); ``covariance`` (direction, link, other_link; um2) of the mean differences. Neighbouring links share a
        position and are correlated: by -0.5 under white noise.

    Raises
    ------
    InterferometryError
        ``deviations`` lack a variable of ``contract.DEVIATIONS``, or hold fewer than two targets.

    Notes
    -----
    Source: "Elimination of thermal drift in measuring the positioning accuracy of a three axis milling machine", equations (4), (6).

    Examples
    --------
    A drift of 10 um from cycle to cycle leaves the difference of neighbours as it is:

    >>> import numpy as np
    >>> from interferometry.deviations import build_deviations
    >>> deviation = np.array([[[0.0, 1.0], [0.0, 2.0]], [[10.0, 11.0], [10.0, 12.0]]])
    >>> time = np.full(deviation.shape, np.datetime64("NaT", "ns"))
    >>> links = evaluate_neighbours(build_deviations([1, 2], [1, 2], np.array([0.0, 100.0]), deviation, time))
    >>> links["mean_difference"].values.tolist(), links["standard_deviation"].values.tolist()
    ([[-1.0], [-2.0]], [[0.0], [0.0]])
    """
    deviations = check_dataset(deviations, "deviations")
    x = _along_axis(deviations)
    if x.sizes["target"] < 2:
        raise InterferometryError(f"{x.sizes['target']} target has no neighbour; measure at least two target positions")
    near = x.isel(target=slice(None, -1)).rename(target="link").assign_coords(link=x["target"].values[1:])
    far = x.isel(target=slice(1, None)).rename(target="link")
    difference = near - far
    count = difference.count("cycle")
    spread = _standard_deviation(difference)
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


def build_chart(deviations: xr.Dataset, *, reference: str = "time") -> xr.Dataset:
    """Build the deviation chart: a reference value at position 1, then the chain of mean differences."""
    if reference not in ("time", "first_cycle"):
        raise InterferometryError(f"reference={reference!r} is neither 'time' nor 'first_cycle'")
    x = _along_axis(deviations)
    links = evaluate_neighbours(deviations)
    chosen = _reference_cycles(deviations, x, reference)
    start = np.array([x.values[c, d, 0] if c >= 0 else np.nan for d, c in enumerate(chosen)])
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
            "reference_cycle": (("direction",), [int(cycles[c]) if c >= 0 else 0 for c in chosen]),
        },
        coords={"direction": x["direction"].values, "target": x["target"].values},
        attrs={"reference": reference},
    )


def compare(deviations: xr.Dataset, estimated: xr.Dataset | None = None) -> xr.Dataset:
    """Compare the conventional standard deviation of each position with that of the differences, and of the joint estimate.

    Parameters
    ----------
    deviations : xarray.Dataset
        Positioning deviations (cycle, direction, target) in um, as `build_deviations` returns them.
    estimated : xarray.Dataset, optional
        What `estimate_drift` returns for them.

    Returns
    -------
    xarray.Dataset
        Per direction and link (a pair of neighbouring targets, labelled by the further one), in um: ``conventional`` (of the further
        target), ``differenced``, ``differenced_single`` (divided by sqrt 2), ``joint`` (scatter of the joint estimate, if given);
        ``ratio`` of the first two (1).

    Raises
    ------
    InterferometryError
        Fewer than two targets.

    Notes
    -----
    The ratio is a property of the drift, not of an estimator: sqrt(1/2) = 0.71 without any (equation (10) of the paper), 3.09 where the
    standard deviation of the drift is about 4.25 times the random one.

    Examples
    --------
    >>> import numpy as np
    >>> from interferometry.deviations import build_deviations
    >>> deviation = np.random.default_rng(0).normal(0, 1, (1000, 2, 2))
    >>> time = np.full(deviation.shape, np.datetime64("NaT", "ns"))
    >>> test = build_deviations(range(1000), [1, 2], np.array([0.0, 100.0]), deviation, time)
    >>> compare(test)["ratio"].values.round(1).tolist()
    [[0.7], [0.7]]
    """
    deviations = check_dataset(deviations, "deviations")
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


def _along_axis(deviations: xr.Dataset) -> xr.DataArray:
    """Return deviations with targets in the order of their positions, so that neighbours are neighbours."""
    return deviations["deviation"].isel(target=np.argsort(deviations["position"].values, kind="stable"))


def _standard_deviation(x: xr.DataArray) -> xr.DataArray:
    """Return the sample standard deviation over the cycles; NaN, without a warning, where there are fewer than two values."""
    count = x.count("cycle")
    squares = ((x - x.mean("cycle")) ** 2).sum("cycle")
    return (squares / (count - 1).where(count > 1)) ** 0.5


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


def _reference_cycles(deviations: xr.Dataset, x: xr.DataArray, reference: str) -> list[int]:
    """Return, per direction, the index of the cycle that gives the value at position 1; -1 where none was measured."""
    first = int(np.argmin(deviations["position"].values))
    times = deviations["time"].values
    seconds = np.full(times.shape, np.nan)
    if not np.isnat(times).all():
        seconds = (times - np.nanmin(times)) / np.timedelta64(1, "s")
    chosen = []
    for direction in range(x.sizes["direction"]):
        usable = np.flatnonzero(np.isfinite(x.values[:, direction, 0]))
        late = np.empty(0, dtype=int)
        if reference == "time":
            late = usable[seconds[usable, direction, first] >= REFERENCE_S]
            usable = usable[::-1]
        chosen.append(int(late[0]) if late.size else int(usable[0]) if usable.size else -1)
    return chosen
