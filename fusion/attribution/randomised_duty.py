"""Randomisation test: does the drift follow the schedule by which the heat sources were switched at random?

Where the duty of every source was drawn from a known random law, other schedules drawn from that law are as likely as the one that was
run. A statistic that is larger for the real schedule than for 95 % of the others therefore rejects the null hypothesis exactly, whatever
the drift does by itself, warm-up included; the drift model behind the statistic only adds power. A significant source is a cause.

Sources: Fisher (1935), *The design of experiments*; for slow series Harris (2020), bioRxiv 2020.11.29.402719 ("pseudosession method").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import special
from threadpoolctl import threadpool_limits

from fusion._typing import Array
from fusion.alignment.first_order_lag import respond
from fusion.attribution.drift_channels import DriftSeries, clock_readings, reduce_channels
from fusion.attribution.family_wise import LEVEL
from fusion.attribution.likelihood_ratio import NullBank, estimate_effects, likelihood_ratios, null_bank, whiten_series
from fusion.errors import FusionError

#: Time constants of the responses to duty, s: one body, or one body followed by another of the second constant.
_RESPONSES_S = tuple((first, second) for second in (0.0, 1800.0) for first in (600.0, 1800.0, 3600.0, 7200.0))
#: Step of the time grid of schedules, s.
GRID_S = 60.0
#: A logged duty within this share of its range from its lowest or highest value is at that level.
_LEVEL_TOLERANCE = 0.05
#: A number of switchings less probable than this under the stated law was drawn from another one.
_IMPOSSIBLE = 1e-4


class RandomisationError(FusionError):
    """A duty that cannot be tested; the message says what is missing."""


@dataclass(frozen=True)
class DutyLaw:
    """Random law by which one source is switched on and off; the first state is either with probability 1/2.

    Attributes
    ----------
    mean_dwell_s : float, s
        Mean time between switchings.
    least_dwell_s : float, s
        Shortest time between switchings; what exceeds it is exponentially distributed.
    """

    mean_dwell_s: float
    least_dwell_s: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.least_dwell_s < self.mean_dwell_s:
            raise RandomisationError(
                f"the mean dwell of {self.mean_dwell_s:g} s must be longer than the least dwell of {self.least_dwell_s:g} s"
            )

    def draw(self, duration_s: float, rng: np.random.Generator) -> tuple[bool, Array]:
        """Draw the first state (True is on) and the times of switching, s, within a duration of `duration_s`."""
        count = int(duration_s / self.mean_dwell_s * 2) + 20
        switching: Array = np.zeros(0)
        while switching.size == 0 or switching[-1] < duration_s:
            dwell = self.least_dwell_s + rng.exponential(self.mean_dwell_s - self.least_dwell_s, count)
            start = switching[-1] if switching.size else 0.0
            switching = np.concatenate([switching, start + np.cumsum(dwell)])
        return bool(rng.integers(2)), switching[switching < duration_s]

    def course(self, seconds: Array, rng: np.random.Generator) -> Array:
        """Draw one schedule: 0 or 1 at the given times (n,), s."""
        first, switching = self.draw(float(seconds[-1] - seconds[0]) + GRID_S, rng)
        return (np.searchsorted(switching, seconds - seconds[0], side="right") + first) % 2.0


def read_duty(drivers: xr.Dataset, names: Sequence[str], law: DutyLaw, *, source: str = "drivers") -> xr.DataArray:
    """Read the switching states of logged columns, and check that the stated law can have made them.

    Parameters
    ----------
    drivers : Dataset
        Logged columns along ``time``, in any unit.
    names : sequence of str
        Columns that were switched at random.
    law : DutyLaw
        The law that they were drawn from, as stated in the campaign file.
    source : str
        Name of the file, for messages.

    Returns
    -------
    DataArray, (time, source)
        0 at the lower level and 1 at the upper one, at the times at which all columns have a value.

    Raises
    ------
    RandomisationError
        If a column is missing, has other than two levels, was switched before the least dwell was over, or so often or so seldom as
        the law makes it in less than one session in ten thousand.
    """
    unknown = [name for name in names if name not in drivers]
    if unknown:
        raise RandomisationError(
            f"{source}: no column {', '.join(unknown)} for drivers.randomised; it has: {', '.join(map(str, drivers.data_vars))}"
        )
    log = drivers[list(names)].dropna("time")
    seconds = (log["time"].values - log["time"].values[0]) / np.timedelta64(1, "s")
    states = []
    for name in names:
        values = log[name].values.astype(float)
        low, high = float(values.min()), float(values.max())
        if low == high:
            raise RandomisationError(f"{source}: {name} was never switched; take it out of drivers.randomised")
        share = (values - low) / (high - low)
        if np.minimum(share, 1.0 - share).max() > _LEVEL_TOLERANCE:
            raise RandomisationError(
                f"{source}: {name} takes levels between {low:g} and {high:g}; the randomisation test is for loads that are switched "
                "between two levels: take it out of drivers.randomised"
            )
        states.append(np.round(share))
        _check_law(f"{source}: {name}", seconds, states[-1], law)
    return xr.DataArray(
        np.column_stack(states), dims=("time", "source"), coords={"time": log["time"], "source": list(names)}
    )


def _check_law(place: str, seconds: Array, states: Array, law: DutyLaw) -> None:
    """Raise if the law cannot have made a course (n,) of 0 and 1, as far as its dwells and their number show."""
    changes = seconds[np.flatnonzero(np.diff(states)) + 1]
    # A change is known to one step of the log, and between two changes both may be late or early.
    step = float(np.diff(seconds).max())
    shortest = float(np.diff(changes).min(initial=np.inf))
    if shortest < law.least_dwell_s - 2.0 * step:
        raise RandomisationError(
            f"{place} was switched again after {shortest:g} s, before the least dwell of {law.least_dwell_s:g} s; state the law that the "
            "schedule was drawn from, or leave drivers.randomised out"
        )
    expected = seconds[-1] / law.mean_dwell_s
    if (
        changes.size
        and min(special.pdtr(changes.size, expected), special.pdtrc(changes.size - 1, expected)) < _IMPOSSIBLE
    ):
        raise RandomisationError(
            f"{place} was switched {changes.size} times in {seconds[-1] / 3600:.1f} h, where a mean dwell of {law.mean_dwell_s:g} s makes "
            f"about {expected:.0f}; state the law that the schedule was drawn from, or leave drivers.randomised out"
        )


def duty_responses(seconds: Array, courses: Array) -> Array:
    """Return the thermal responses to duty for every pair of time constants.

    Parameters
    ----------
    seconds : (n,) ndarray, s
        Times, increasing.
    courses : (n, columns) ndarray
        Duty, 0 to 1, of one source or schedule per column.

    Returns
    -------
    (n, columns, 8) ndarray
        Responses of a body of 600, 1800, 3600 or 7200 s alone, then of the same four followed by another body of 1800 s.
    """
    bodies: dict[float, Array] = {}
    responses = []
    for first, second in _RESPONSES_S:
        if first not in bodies:
            bodies[first] = respond(courses, seconds, time_constant_s=first)
        responses.append(respond(bodies[first], seconds, time_constant_s=second))
    return np.stack(responses, axis=2)


@threadpool_limits.wrap(limits=1, user_api="blas")
def randomisation_test(
    fused_readings: xr.Dataset,
    duty: xr.DataArray,
    law: DutyLaw,
    *,
    draws: int = 499,
    seed: int = 0,
) -> xr.Dataset:
    """Test which switched source moves the axis, against schedules drawn anew from the same law.

    Parameters
    ----------
    fused_readings : Dataset
        ``deviation`` (um) and ``time`` (UTC) over cycle, direction and target, and ``position`` (mm) over target.
    duty : DataArray, (time, source)
        Switching state 0 to 1 as it was run; held between times.
    law : DutyLaw
        The law that the schedule was drawn from, independently for every source.
    draws : int
        Number of schedules drawn anew.
    seed : int
        Seed of these schedules.

    Returns
    -------
    Dataset
        Per source ``p_value`` (family-wise over sources, exact), ``statistic``, ``time_constant`` and ``second_time_constant`` (s) of the
        best response, ``sensitivity`` and ``sensitivity_u`` (um at full duty, at the far end of travel). Attribute ``source`` names the
        most significant source, or is empty.

    Raises
    ------
    RandomisationError
        If a source was never switched.
    ChannelError
        If too few readings lie in the time of the log.
    """
    seconds, grid_time, courses = _hold(duty)
    names = [str(name) for name in duty["source"].values]
    channels = reduce_channels(clock_readings(fused_readings, grid_time))
    series = [channel for channel in channels if channel.name != "reversal"]
    # The test is exact whatever the drift does: a model that could follow any smooth course would only cost power.
    banks = [
        null_bank(
            channel.values, channel.seconds, channel.variance, _level_and_trend(channel.seconds), integrated=False
        )
        for channel in series
    ]
    responses = duty_responses(seconds, courses)
    measured = _statistics(series, banks, responses)
    rng = np.random.default_rng(seed)
    fresh = np.column_stack([law.course(seconds, rng) for _ in range(draws * len(names))])
    null = _statistics(series, banks, duty_responses(seconds, fresh)).max(axis=1).reshape(draws, -1).max(axis=1)
    best, chosen = measured.max(axis=1), measured.argmax(axis=1)
    p_value = (1 + (null[:, None] >= best).sum(axis=0)) / (draws + 1)
    size, size_u = _effects(series, banks, responses[:, np.arange(len(names)), chosen])
    strongest = int(best.argmax())
    attrs = {"source": names[strongest] if p_value[strongest] <= LEVEL else "", "draws": draws}
    return _describe(names, p_value, best, np.array(_RESPONSES_S)[chosen], size, size_u).assign_attrs(attrs)


def _effects(series: Sequence[DriftSeries], banks: Sequence[NullBank], responses: Array) -> tuple[Array, Array]:
    """Drift at full duty at the far end of travel and its standard uncertainty, (sources,) um, from responses (grid, sources)."""
    effects = [
        estimate_effects(bank, np.ascontiguousarray(channel.sampling @ responses, np.float32))
        for channel, bank in zip(series, banks, strict=True)
    ]
    # At the far end of travel, the common drift and that proportional to position add up.
    size = np.sum([effect.coefficient for effect in effects], axis=0)
    return size, np.sqrt(np.sum([effect.coefficient_u**2 for effect in effects], axis=0))


def _describe(
    names: Sequence[str], p_value: Array, statistic: Array, time_constants_s: Array, size: Array, size_u: Array
) -> xr.Dataset:
    """The results of all sources as variables, (sources,) each; time constants (sources, 2)."""
    size_name = "drift at the far end of travel at full duty"
    return xr.Dataset(
        {
            "p_value": (("source",), p_value, {"units": "1", "long_name": "family-wise p against redrawn schedules"}),
            "statistic": (("source",), statistic, {"units": "1"}),
            "time_constant": (("source",), time_constants_s[:, 0], {"units": "s"}),
            "second_time_constant": (("source",), time_constants_s[:, 1], {"units": "s"}),
            "sensitivity": (("source",), size, {"units": "um", "long_name": size_name}),
            "sensitivity_u": (("source",), size_u, {"units": "um"}),
        },
        coords={"source": list(names)},
    )


def _hold(duty: xr.DataArray) -> tuple[Array, NDArray[np.datetime64], Array]:
    """The duty on an even grid: seconds since its first time (n,), times (n,), courses (n, sources)."""
    time = duty["time"].values.astype("datetime64[ns]")
    logged = (time - time[0]) / np.timedelta64(1, "s")
    seconds = np.arange(0.0, logged[-1] + GRID_S / 2, GRID_S)
    held = np.searchsorted(logged, seconds, side="right") - 1
    courses = duty.transpose("time", "source").values.astype(float)[held]
    constant = [str(name) for name, course in zip(duty["source"].values, courses.T, strict=True) if np.ptp(course) == 0]
    if constant:
        raise RandomisationError(f"{', '.join(constant)}: never switched in this session; leave it out of the test")
    return seconds, time[0] + (seconds * 1e9).astype("timedelta64[ns]"), courses


def _level_and_trend(seconds: Array) -> Array:
    centred = (seconds - seconds.mean()) / float(np.ptp(seconds))
    return np.column_stack([np.ones_like(seconds), centred])


def _statistics(series: Sequence[DriftSeries], banks: Sequence[NullBank], responses: Array) -> NDArray[np.float64]:
    """Likelihood ratios (columns, responses) of responses (grid, columns, responses), summed over the series."""
    flat = responses.reshape(responses.shape[0], -1)
    total = np.zeros(flat.shape[1])
    for channel, bank in zip(series, banks, strict=True):
        regressors = np.ascontiguousarray(channel.sampling @ flat, np.float32)
        total += likelihood_ratios(bank, whiten_series(bank, channel.values[None, :]), regressors)[0]
    return total.reshape(responses.shape[1:])
