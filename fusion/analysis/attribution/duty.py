"""Randomisation test: does the drift follow the schedule by which the heat sources were switched at random?

Where the duty of every source was drawn from a known random law, other schedules drawn from that law are as likely as the one that was
run. A statistic that is larger for the real schedule than for 95 % of the others therefore rejects the null hypothesis exactly, whatever
the drift does by itself, warm-up included; the drift model behind the statistic only adds power. A significant source
moves the axis; at which place its heat acts follows only where it warms one place alone.

Sources: Fisher (1935), *The design of experiments*; for slow series Harris (2020), bioRxiv 2020.11.29.402719 ("pseudosession method").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
import xarray as xr
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from fusion.analysis.alignment.first_order_lag import respond
from fusion.analysis.attribution.drift_channels import DriftSeries, clock_readings, reduce_channels
from fusion.analysis.attribution.modes import level_and_trend
from fusion.analysis.attribution.significance import (
    Estimate,
    NullBank,
    combine_fits,
    fit_regressors,
    likelihood_ratios,
    monte_carlo_p,
    null_bank,
    whiten_series,
)
from fusion.analysis.levels import ATTRIBUTION_LEVEL
from fusion.common import Array, FusionError
from interferometry.drift.kalman import drift_system

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

    What a time between switchings exceeds its least value by is exponentially distributed.
    """

    mean_dwell_s: float
    least_dwell_s: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.least_dwell_s < self.mean_dwell_s:
            raise RandomisationError(
                f"the mean dwell of {self.mean_dwell_s:g} s must be longer than the least dwell of {self.least_dwell_s:g} s"
            )

    def course(self, seconds: Array, rng: np.random.Generator) -> Array:
        """Draw one schedule: 0 or 1 at the given times (n,), s."""
        duration_s = float(seconds[-1] - seconds[0]) + GRID_S
        count = int(duration_s / self.mean_dwell_s * 2) + 20
        switching: Array = np.zeros(0)
        while switching.size == 0 or switching[-1] < duration_s:
            dwell = self.least_dwell_s + rng.exponential(self.mean_dwell_s - self.least_dwell_s, count)
            start = switching[-1] if switching.size else 0.0
            switching = np.concatenate([switching, start + np.cumsum(dwell)])
        return (np.searchsorted(switching, seconds - seconds[0], side="right") + rng.integers(2)) % 2.0


def read_duty(drivers: xr.Dataset, names: Sequence[str], law: DutyLaw, *, source: str = "drivers") -> xr.DataArray:
    """Read the switching states of logged columns, and check that the stated law can have made them."""
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
        and min(scipy.special.pdtr(changes.size, expected), scipy.special.pdtrc(changes.size - 1, expected))
        < _IMPOSSIBLE
    ):
        raise RandomisationError(
            f"{place} was switched {changes.size} times in {seconds[-1] / 3600:.1f} h, where a mean dwell of {law.mean_dwell_s:g} s makes "
            f"about {expected:.0f}; state the law that the schedule was drawn from, or leave drivers.randomised out"
        )


def duty_responses(seconds: Array, courses: Array) -> Array:
    """Return the thermal responses to duty for every pair of time constants."""
    firsts = dict.fromkeys(first for first, _ in _RESPONSES_S)
    bodies = {first: respond(courses, seconds, time_constant_s=first) for first in firsts}
    responses = [respond(bodies[first], seconds, time_constant_s=second) for first, second in _RESPONSES_S]
    return np.stack(responses, axis=2)


@threadpool_limits.wrap(limits=1, user_api="blas")
def randomisation_test(
    fused_readings: xr.Dataset, duty: xr.DataArray, law: DutyLaw, *, draws: int = 499, seed: int = 0
) -> xr.Dataset:
    """Test which switched source moves the axis, against schedules drawn again from the same law."""
    seconds, grid_time, courses = _hold(duty)
    names = [str(name) for name in duty["source"].values]
    channels = reduce_channels(clock_readings(fused_readings, grid_time))
    series = [channel for channel in channels if channel.name != "reversal"]
    # The test is exact whatever the drift does: a model that could follow any smooth course would only cost power.
    banks = [
        null_bank(channel.values, channel.seconds, channel.variance, level_and_trend(channel.seconds), integrated=False)
        for channel in series
    ]
    responses = duty_responses(seconds, courses)
    measured = _statistics(series, banks, responses)
    rng = np.random.default_rng(seed)
    fresh = np.column_stack([law.course(seconds, rng) for _ in range(draws * len(names))])
    null = _statistics(series, banks, duty_responses(seconds, fresh)).max(axis=1).reshape(draws, -1).max(axis=1)
    best, chosen = measured.max(axis=1), measured.argmax(axis=1)
    p_value = monte_carlo_p(best, null)
    effect = _effect(series, banks, responses, chosen)
    strongest = int(best.argmax())
    size_name = "drift at the far end of travel at full duty"
    constants_s = np.array(_RESPONSES_S)[chosen]
    return xr.Dataset(
        {
            "p_value": (("source",), p_value, {"units": "1", "long_name": "family-wise p against redrawn schedules"}),
            "statistic": (("source",), best, {"units": "1"}),
            "time_constant": (("source",), constants_s[:, 0], {"units": "s"}),
            "second_time_constant": (("source",), constants_s[:, 1], {"units": "s"}),
            "sensitivity": (("source",), effect.coefficient, {"units": "um", "long_name": size_name}),
            "sensitivity_u": (("source",), effect.coefficient_u, {"units": "um"}),
        },
        coords={"source": names},
        attrs={"source": names[strongest] if p_value[strongest] <= ATTRIBUTION_LEVEL else "", "draws": draws},
    )


def _effect(
    series: Sequence[DriftSeries], banks: Sequence[NullBank], responses: Array, chosen: NDArray[np.int64]
) -> Estimate:
    """Drift at full duty of every source at the far end of travel, um, where common drift and that proportional to position add up."""
    flat = responses.reshape(responses.shape[0], -1)
    fits = [
        fit_regressors(bank, np.ascontiguousarray(channel.sampling @ flat, np.float32))
        for channel, bank in zip(series, banks, strict=True)
    ]
    return combine_fits(fits, chosen)


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


def _statistics(series: Sequence[DriftSeries], banks: Sequence[NullBank], responses: Array) -> NDArray[np.float64]:
    """Likelihood ratios (columns, responses) of responses (grid, columns, responses), summed over the series."""
    flat = responses.reshape(responses.shape[0], -1)
    total = np.zeros(flat.shape[1])
    for channel, bank in zip(series, banks, strict=True):
        regressors = np.ascontiguousarray(channel.sampling @ flat, np.float32)
        total += likelihood_ratios(whiten_series(bank, channel.values[None, :]), regressors)[0]
    return total.reshape(responses.shape[1:])


# Plan the duty schedule of a new test: which switching separates the heat sources of the machine, in how much time,
# with what power.

#: Candidate mean dwells, s, and test durations, h.
_DWELLS_S = (600.0, 1200.0, 1800.0, 3600.0, 5400.0)
_HOURS = (3.0, 5.0, 7.0, 10.0, 14.0, 20.0)
_SCHEDULES = 24
#: Least time between two switchings, s.
_LEAST_S = 300.0
#: The search over the responses is worth about as many independent tests per source.
_EFFECTIVE_RESPONSES = 4.0


class DutyPlanError(FusionError):
    """A schedule that cannot be proposed; the message says why."""


#: What a machine may have: times in s, sizes in um; a test of cycles shorter than these would fill the memory.
_TIMES_S, _SIZES_UM, _CYCLES_S = (1.0, 1e6), (1e-4, 1e4), (30.0, 1e5)


@dataclass(frozen=True)
class Machine:
    """Machine and measurement as expected before the test.

    ``effect_um`` is the smallest drift of one source at full duty that shall be detected, the drift the standard deviation over one hour of
    the random walk of the axis (the unexplained drift of the report), the noise the standard uncertainty of the mean of one cycle,
    ``lag_s`` the time constant between the temperature of a source and the drift.
    """

    sources: tuple[str, ...]
    time_constants_s: tuple[float, ...]
    effect_um: float
    drift_um_per_sqrt_h: float = 0.4
    noise_um: float = 0.1
    cycle_s: float = 252.0
    lag_s: float = 1800.0

    def __post_init__(self) -> None:
        if len(self.sources) == 0 or len(self.sources) != len(self.time_constants_s):
            raise DutyPlanError(
                f"{len(self.sources)} sources and {len(self.time_constants_s)} time constants: name every source once, with one "
                "time constant each"
            )
        repeated = next((name for name in self.sources if self.sources.count(name) > 1), None)
        if repeated is not None:
            raise DutyPlanError(f"source {repeated!r} is named more than once; name every source once")
        values = [
            (f"time constant of {name}", s, *_TIMES_S)
            for name, s in zip(self.sources, self.time_constants_s, strict=True)
        ]
        values += [(name, um, *_SIZES_UM) for name, um in (("effect", self.effect_um), ("noise", self.noise_um))]
        for name, value, low, high in (*values, ("cycle", self.cycle_s, *_CYCLES_S)):
            if not low <= value <= high:
                raise DutyPlanError(f"{name}: {value:g} lies outside {low:g} to {high:g}; give what the machine has")


def plan_duty(
    machine: Machine,
    *,
    power: float = 0.8,
    hours: Sequence[float] = _HOURS,
    dwells_s: Sequence[float] = _DWELLS_S,
    seed: int = 0,
) -> xr.Dataset:
    """Propose a randomised duty schedule."""
    rng = np.random.default_rng(seed)
    table = np.array([[_power(machine, time, DutyLaw(dwell, _LEAST_S), rng) for dwell in dwells_s] for time in hours])
    reached = np.flatnonzero(table.max(axis=1) >= power)
    row = int(reached[0]) if reached.size else int(table.max(axis=1).argmax())
    law = DutyLaw(dwells_s[int(table[row].argmax())], _LEAST_S)
    seconds = GRID_S * np.arange(int(hours[row] * 3600.0 / GRID_S), dtype=float)
    fresh = np.random.default_rng([seed, 1])
    duty = np.column_stack([law.course(seconds, fresh) for _ in machine.sources])
    return xr.Dataset(
        {
            "duty": (("time_s", "source"), duty, {"units": "1", "long_name": "0 off, 1 on"}),
            "power": (("hours", "dwell"), table, {"units": "1", "long_name": "power for the weakest source"}),
            "test_hours": ((), hours[row], {"units": "h"}),
            "mean_dwell": ((), law.mean_dwell_s, {"units": "s"}),
        },
        coords={
            "time_s": ("time_s", seconds, {"units": "s"}),
            "source": list(machine.sources),
            "hours": list(hours),
            "dwell": ("dwell", list(dwells_s), {"units": "s"}),
        },
        attrs={"enough": int(reached.size > 0)},
    )


def switchings(plan: xr.Dataset) -> list[tuple[float, str, str]]:
    """Return the proposed schedule as a list of switchings."""
    events = []
    for name in plan["source"].values:
        course = plan["duty"].sel(source=name).values
        changes = np.flatnonzero(np.diff(course, prepend=1.0 - course[0]))
        events += [(float(plan["time_s"][k]) / 60.0, str(name), "on" if course[k] else "off") for k in changes]
    return sorted(events)


def _power(machine: Machine, hours: float, law: DutyLaw, rng: np.random.Generator) -> float:
    """Power for the weakest source, averaged over drawn schedules."""
    cycles = machine.cycle_s * np.arange(int(hours * 3600.0 / machine.cycle_s), dtype=float)
    fine = GRID_S * np.arange(int(hours * 3600.0 / GRID_S) + 1, dtype=float)
    ratio = (machine.drift_um_per_sqrt_h / machine.noise_um) ** 2 / 3600.0
    system = drift_system(cycles, np.ones((cycles.size, 1)), order=1, ratios=np.array([ratio]))
    white, _ = system.whiten(np.eye(cycles.size))
    trend = white @ np.column_stack([np.ones_like(cycles), cycles - cycles.mean()])
    # Responses (cycles, schedules, sources): each source warms its own body, and the structure lags behind all of them.
    columns = np.stack(
        [_drift_responses(machine, tau, law, fine, cycles, rng) for tau in machine.time_constants_s], axis=2
    )
    threshold = scipy.special.chdtri(1, ATTRIBUTION_LEVEL / (_EFFECTIVE_RESPONSES * len(machine.sources)))
    basis, _ = np.linalg.qr(trend)
    powers = []
    for k in range(_SCHEDULES):
        warmed = white @ columns[:, k]
        size = ((warmed - basis @ (basis.T @ warmed)) ** 2).sum(axis=0)
        powers.append(scipy.special.ndtr(machine.effect_um * np.sqrt(size) / machine.noise_um - np.sqrt(threshold)))
    return float(np.mean(powers, axis=0).min())


def _drift_responses(
    machine: Machine, time_constant_s: float, law: DutyLaw, fine: Array, cycles: Array, rng: np.random.Generator
) -> Array:
    """Drift per unit effect at the cycles under many schedules of one source, (cycles, schedules)."""
    courses = np.column_stack([law.course(fine, rng) for _ in range(_SCHEDULES)])
    drift = respond(respond(courses, fine, time_constant_s=time_constant_s), fine, time_constant_s=machine.lag_s)
    return drift[np.searchsorted(fine, cycles)]
