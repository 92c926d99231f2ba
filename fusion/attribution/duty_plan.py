"""Plan the duty schedule of a new test: which switching separates the heat sources of the machine, in how much time, with what power.

For schedules drawn from the random law, the response of each source is whitened by the expected drift of the axis. Its size over the noise
gives the power of the randomisation test in one channel, and the share of it that is not collinear with the responses of the other sources
says whether it will be told from them. The proposed schedule is one plain draw from the law: a selected one might separate better, but
would no longer allow the exact test.

Source: docs/method/attribution.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import special

from fusion._typing import Array
from fusion.alignment.first_order_lag import respond
from fusion.attribution.family_wise import LEVEL
from fusion.attribution.randomised_duty import GRID_S, DutyLaw
from fusion.errors import FusionError
from interferometry.drift.state_space import drift_system

#: Candidate mean dwells, s, and test durations, h.
_DWELLS_S = (600.0, 1200.0, 1800.0, 3600.0, 5400.0)
_HOURS = (3.0, 5.0, 7.0, 10.0, 14.0, 20.0)
_SCHEDULES = 24
#: The search over the responses is worth about as many independent tests per source.
_EFFECTIVE_RESPONSES = 4.0


class DutyPlanError(FusionError):
    """A schedule that cannot be proposed; the message says why."""


@dataclass(frozen=True)
class Machine:
    """Machine and measurement as expected before the test.

    Attributes
    ----------
    sources : tuple of str
        Names of the heat sources that can be switched.
    time_constants_s : tuple of float, s
        Thermal time constant of each source.
    effect_um : float, um
        Smallest drift of one source at full duty that shall be detected.
    drift_um_per_sqrt_h : float, um
        Standard deviation over one hour of the random walk of the axis (the unexplained drift of the report).
    noise_um : float, um
        Standard uncertainty of the mean of one cycle.
    cycle_s : float, s
        Length of one cycle.
    lag_s : float, s
        Time constant between the temperature of a source and the drift.

    Raises
    ------
    DutyPlanError
        If sources and time constants differ in number, a source is named twice, or a quantity is not greater than 0.
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
        values = {f"time constant of {name}": s for name, s in zip(self.sources, self.time_constants_s, strict=True)}
        values |= {"effect": self.effect_um, "noise": self.noise_um, "cycle": self.cycle_s}
        wrong = next((name for name, value in values.items() if not value > 0.0), None)
        if wrong is not None:
            raise DutyPlanError(f"{wrong}: {values[wrong]:g} is not greater than 0; give what the machine has")


def plan_duty(
    machine: Machine,
    *,
    power: float = 0.8,
    hours: Sequence[float] = _HOURS,
    dwells_s: Sequence[float] = _DWELLS_S,
    least_dwell_s: float = 300.0,
    seed: int = 0,
) -> xr.Dataset:
    """Propose a randomised duty schedule.

    Parameters
    ----------
    machine : Machine
        Sources, drift and noise.
    power : float
        Required probability to detect the weakest source.
    hours : sequence of float, h
        Test durations to choose from.
    dwells_s : sequence of float, s
        Mean dwells to choose from.
    least_dwell_s : float, s
        Shortest time between two switchings that the machine tolerates.
    seed : int
        Seed of the schedule; another seed gives another, equally valid schedule.

    Returns
    -------
    Dataset
        ``duty`` (time_s, source) of the shortest test with enough power (of the most powerful one if none has; attribute ``enough``),
        ``power`` (hours, dwell) for the weakest source, ``separation`` (hours, dwell): share of a response that is not collinear with the
        others, from 0 to 1; the chosen ``test_hours`` (h), ``mean_dwell`` and ``least_dwell`` (s).

    Raises
    ------
    DutyPlanError
        If no mean dwell is longer than the least one.
    """
    usable = _usable_dwells(dwells_s, least_dwell_s)
    rng = np.random.default_rng(seed)
    table = np.zeros((len(hours), len(usable)))
    separation = np.zeros_like(table)
    for i, duration in enumerate(hours):
        for j, dwell in enumerate(usable):
            table[i, j], separation[i, j] = _assess(machine, duration, DutyLaw(dwell, least_dwell_s), rng)
    best_dwell = table.argmax(axis=1)
    reached = np.flatnonzero(table.max(axis=1) >= power)
    row = int(reached[0]) if reached.size else int(table.max(axis=1).argmax())
    law = DutyLaw(usable[best_dwell[row]], least_dwell_s)
    seconds = GRID_S * np.arange(int(hours[row] * 3600.0 / GRID_S), dtype=float)
    fresh = np.random.default_rng([seed, 1])
    duty = np.column_stack([law.course(seconds, fresh) for _ in machine.sources])
    return xr.Dataset(
        {
            "duty": (("time_s", "source"), duty, {"units": "1", "long_name": "0 off, 1 on"}),
            "power": (("hours", "dwell"), table, {"units": "1", "long_name": "power for the weakest source"}),
            "separation": (("hours", "dwell"), separation, {"units": "1"}),
            "test_hours": ((), hours[row], {"units": "h"}),
            "mean_dwell": ((), law.mean_dwell_s, {"units": "s"}),
            "least_dwell": ((), law.least_dwell_s, {"units": "s"}),
        },
        coords={
            "time_s": ("time_s", seconds, {"units": "s"}),
            "source": list(machine.sources),
            "hours": list(hours),
            "dwell": ("dwell", usable, {"units": "s"}),
        },
        attrs={"enough": int(reached.size > 0), "seed": seed},
    )


def _usable_dwells(dwells_s: Sequence[float], least_dwell_s: float) -> list[float]:
    usable = [dwell for dwell in dwells_s if dwell > least_dwell_s]
    if not usable:
        raise DutyPlanError(
            f"no mean dwell of {list(dwells_s)} s is longer than the least dwell of {least_dwell_s:g} s; allow longer ones"
        )
    return usable


def switchings(plan: xr.Dataset) -> list[tuple[float, str, str]]:
    """Return the proposed schedule as a list of switchings.

    Parameters
    ----------
    plan : Dataset
        Result of `plan_duty`.

    Returns
    -------
    list of (float, str, str)
        Time since the start in min, source, and ``"on"`` or ``"off"``, sorted by time; the first states are at 0 min.
    """
    events = []
    for name in plan["source"].values:
        course = plan["duty"].sel(source=name).values
        changes = np.flatnonzero(np.diff(course, prepend=1.0 - course[0]))
        events += [(float(plan["time_s"][k]) / 60.0, str(name), "on" if course[k] else "off") for k in changes]
    return sorted(events)


def _assess(machine: Machine, hours: float, law: DutyLaw, rng: np.random.Generator) -> tuple[float, float]:
    """Power for the weakest source, and separation of the least separable one, averaged over drawn schedules."""
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
    threshold = special.chdtri(1, LEVEL / (_EFFECTIVE_RESPONSES * len(machine.sources)))
    powers = np.zeros((_SCHEDULES, len(machine.sources)))
    separations = np.zeros_like(powers)
    for k in range(_SCHEDULES):
        free = _without(white @ columns[:, k], trend)
        size = (free**2).sum(axis=0)
        powers[k] = special.ndtr(machine.effect_um * np.sqrt(size) / machine.noise_um - np.sqrt(threshold))
        for j in range(size.size):
            alone = _without(free[:, j], np.delete(free, j, axis=1)) if size.size > 1 else free[:, j]
            separations[k, j] = (alone @ alone) / max(float(size[j]), 1e-30)
    return float(powers.mean(axis=0).min()), float(separations.mean(axis=0).min())


def _drift_responses(
    machine: Machine, time_constant_s: float, law: DutyLaw, fine: Array, cycles: Array, rng: np.random.Generator
) -> Array:
    """Drift per unit effect at the cycles under many schedules of one source, (cycles, schedules)."""
    courses = np.column_stack([law.course(fine, rng) for _ in range(_SCHEDULES)])
    drift = respond(respond(courses, fine, time_constant_s=time_constant_s), fine, time_constant_s=machine.lag_s)
    return drift[np.searchsorted(fine, cycles)]


def _without(columns: Array, others: Array) -> NDArray[np.float64]:
    """Residuals of columns (n, ...) after regression on others (n, k)."""
    basis, _ = np.linalg.qr(others)
    return np.asarray(columns - basis @ (basis.T @ columns), float)
