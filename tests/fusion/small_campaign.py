"""A positioning campaign of a few dozen readings, made by hand: every number can be followed on paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from fusion.analysis.alignment.readings import Readings, Series
from fusion.analysis.drift_model.model import ModelFit, Term
from fusion.analysis.effects.effect import Candidate
from interferometry.drift.gls import drift_system, fit_fixed_effects

#: Time between two readings, and between the last reading of a cycle and the first of the next, s.
STEP_S, PAUSE_S = 10.0, 60.0
#: Variance of a common random walk and of a stretch over that of a reading, 1/s.
RATIOS = np.array([2e-4, 5e-4])


def campaign(
    *,
    cycles: int = 12,
    positions_mm: tuple[float, ...] = (100.0, 200.0, 300.0, 400.0),
    both_directions: bool = True,
    response: np.ndarray | None = None,
    series: Mapping[str, Series] | None = None,
    drivers: tuple[str, ...] = (),
) -> Readings:
    """Cycles that go to every target in positive order, and back in negative order; a response of zero by default."""
    targets = np.arange(1, len(positions_mm) + 1)
    order = np.concatenate([targets, targets[::-1]]) if both_directions else targets
    sign = np.where(np.arange(order.size) < targets.size, 1.0, -1.0)
    period_s = STEP_S * (order.size - 1) + PAUSE_S
    seconds = (period_s * np.arange(cycles)[:, None] + STEP_S * np.arange(order.size)).ravel()
    target = np.tile(order, cycles)
    return Readings(
        seconds=seconds,
        response=np.zeros(seconds.size) if response is None else response,
        cycle=np.repeat(np.arange(1, cycles + 1), order.size),
        target=target,
        position_mm=np.array(positions_mm)[target - 1],
        sign=np.tile(sign, cycles),
        targets=targets,
        positions_mm=np.array(positions_mm),
        series={} if series is None else series,
        drivers=drivers,
        left_out={},
    )


def period_s(readings: Readings) -> float:
    """Time from the start of one cycle to that of the next, s."""
    return float(readings.seconds[readings.cycle == 2][0])


def logged(values: np.ndarray, units: str, *, step_s: float = 30.0) -> Series:
    """A series sampled evenly from the first reading on."""
    return Series(step_s * np.arange(len(values)), np.asarray(values, float), units)


def term(columns: np.ndarray, name: str = "effect", **changes) -> Term:
    """A term of one column (n,) or several (n, q), without parameters by default."""
    columns = columns if columns.ndim == 2 else columns[:, None]
    parameters = changes.pop("parameters", {})
    units = changes.pop("units", ("um",) * columns.shape[1])
    return Term(name, Candidate(columns, parameters, units, **changes))


def model_of(
    readings: Readings,
    terms: Sequence[Term] = (),
    used: np.ndarray | None = None,
    *,
    order: int = 1,
    ratios: np.ndarray = RATIOS,
) -> ModelFit:
    """A model with given drift variances: they are not searched for, so that dense algebra gives the same numbers."""
    used = np.ones(readings.seconds.size, bool) if used is None else used
    design = np.column_stack([readings.profile, *(one.candidate.columns for one in terms)])
    if order == 2:
        design = np.column_stack([design, readings.loadings * (readings.seconds / 3600.0)[:, None]])
    system = drift_system(readings.seconds[used], readings.loadings[used], order=order, ratios=ratios)
    fit = fit_fixed_effects(system, readings.response[used], design[used])
    return ModelFit(readings, used, tuple(terms), fit, readings.profile)


def dense_covariance(readings: Readings, ratios: np.ndarray, order: int = 1) -> np.ndarray:
    """Covariance of the readings over sigma squared: random walks or integrated walks that start at zero, and noise."""
    early = np.minimum.outer(readings.seconds, readings.seconds)
    late = np.maximum.outer(readings.seconds, readings.seconds)
    walk = early if order == 1 else early**2 * (3.0 * late - early) / 6.0
    parts = zip(ratios, readings.loadings.T, strict=True)
    return np.eye(readings.seconds.size) + sum(ratio * np.outer(loading, loading) * walk for ratio, loading in parts)
