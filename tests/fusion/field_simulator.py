"""A table seen by a camera and an axis that drifts, by formula: films of smooth modes or of three heat sources, and readings.

It shares no code with the analysis. Cells are 10 mm; a cycle lasts 252 s: 16 targets, 6 s apart, forward and back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import ndimage, signal

Array = NDArray[np.float64]

CYCLES = 100
PERIOD_S = 252.0
ROWS, COLUMNS = 24, 32
SOURCES = ((5, 6), (17, 12), (9, 26))  # row, column
TAU_S = (1200.0, 4500.0, 9000.0)
HALO_CELLS = 5.0
START = np.datetime64("2026-03-09T08:00:00", "ns")
#: Plain correlation beyond this is "significant" at 0.05 for 100 independent values.
NAIVE_LIMIT = 0.1966


@dataclass(frozen=True)
class Session:
    fused: xr.Dataset
    field: xr.DataArray
    responses: Array  # (cycle, source), 0..1


def first_order(values: Array, tau_s: float, step_s: float = PERIOD_S) -> Array:
    decay = np.exp(-step_s / tau_s)
    return signal.lfilter([1.0 - decay], [1.0, -decay], values, axis=0)


def switching(rng: np.random.Generator, dwell_s: float, count: int = CYCLES) -> Array:
    state = float(rng.random() < 0.5)
    course = np.empty(count)
    for k in range(count):
        if rng.random() < 1.0 - np.exp(-PERIOD_S / dwell_s):
            state = 1.0 - state
        course[k] = state
    return course


def source_responses(kind: str, rng: np.random.Generator, dwell_s: float = 1800.0) -> tuple[Array, Array]:
    """Duty (cycle, source) and thermal response (cycle, source)."""
    duty = np.ones((CYCLES, 3)) if kind == "warm" else np.column_stack([switching(rng, dwell_s) for _ in range(3)])
    return duty, np.column_stack([first_order(duty[:, k], TAU_S[k]) for k in range(3)])


def smooth_series(kind: str, rng: np.random.Generator) -> Array:
    """One unit-size series of length CYCLES."""
    steps = rng.standard_normal(CYCLES)
    if kind == "ar":
        series = signal.lfilter([1.0], [1.0, -0.8], rng.standard_normal(CYCLES + 50))[50:]
    elif kind == "rw":
        series = np.cumsum(steps)
    elif kind == "irw":
        series = np.cumsum(np.cumsum(steps))
    elif kind == "duty":
        series = first_order(switching(rng, 1800.0), rng.uniform(1200.0, 7200.0))
    elif kind == "warm":
        time = np.arange(CYCLES) * PERIOD_S
        series = sum(rng.uniform(0.3, 1.0) * (1 - np.exp(-time / tau)) for tau in rng.uniform(900, 12000, 3))
    else:
        raise ValueError(kind)
    series = series - series.mean()
    return series / series.std()


def film(kind: str, rng: np.random.Generator, responses: Array | None = None) -> Array:
    """Temperatures (cycle, row, column), K, with 0.03 K noise per cell."""
    if responses is None and kind in ("ar", "rw", "irw"):
        patterns = [ndimage.gaussian_filter(rng.standard_normal((ROWS, COLUMNS)), 4.0) for _ in range(6)]
        courses = [smooth_series(kind, rng) for _ in range(6)]
        clean = sum(np.multiply.outer(c, p / p.std()) for c, p in zip(courses, patterns, strict=True))
    else:
        if responses is None:
            responses = source_responses(kind, rng)[1]
        row, column = np.mgrid[:ROWS, :COLUMNS]
        ambient = 0.3 * first_order(np.cumsum(rng.standard_normal(CYCLES)) * 0.1, 3600.0)
        clean = np.multiply.outer(ambient, np.ones((ROWS, COLUMNS)))
        for k, (r, c) in enumerate(SOURCES):
            halo = np.exp(-0.5 * ((row - r) ** 2 + (column - c) ** 2) / HALO_CELLS**2)
            clean = clean + 3.0 * np.multiply.outer(responses[:, k], halo)
    return clean + 0.03 * rng.standard_normal((CYCLES, ROWS, COLUMNS))


def session(
    temperatures: Array,
    common: Array,
    slope: Array,
    rng: np.random.Generator,
    *,
    reversal: Array | None = None,
    noise_um: float = 0.4,
    targets: int = 16,
    heavy_tails: bool = False,
) -> Session:
    """Put per-cycle drifts (um; slope at the ends of travel) under readings with real times and noise."""
    reversal = np.zeros(CYCLES) if reversal is None else reversal
    middle = np.arange(CYCLES) * PERIOD_S
    forward = 6.0 * np.arange(targets)
    within = np.stack([forward, 100.0 + forward[::-1]])
    within = within - within.mean()
    seconds = middle[:, None, None] + within
    position = 20.0 * np.arange(targets)
    scaled = np.linspace(-1.0, 1.0, targets)
    sign = np.array([0.5, -0.5])[:, None]
    profile = rng.normal(0.0, 1.0, (2, targets))

    def at(series: Array) -> Array:
        return np.interp(seconds, middle, series)

    noise = rng.standard_t(4, seconds.shape) / np.sqrt(2.0) if heavy_tails else rng.standard_normal(seconds.shape)
    deviation = profile + at(common) + scaled * at(slope) + sign * at(reversal) + noise_um * noise
    time = START + (seconds * 1e9).round().astype("timedelta64[ns]")
    dims = ("cycle", "direction", "target")
    fused = xr.Dataset(
        {
            "deviation": (dims, deviation, {"units": "um"}),
            "time": (dims, time),
            "position": (("target",), position, {"units": "mm"}),
        },
        coords={
            "cycle": np.arange(1, CYCLES + 1),
            "direction": ["positive", "negative"],
            "target": np.arange(1, targets + 1),
        },
    )
    field = xr.DataArray(
        temperatures,
        dims=("time", "y", "x"),
        coords={
            "time": START + (middle * 1e9).astype("timedelta64[ns]"),
            "y": (np.arange(temperatures.shape[1]) + 0.5) * 10.0,
            "x": (np.arange(temperatures.shape[2]) + 0.5) * 10.0,
        },
        attrs={"units": "K"},
    )
    return Session(fused, field, np.zeros((CYCLES, 0)))


def null_session(kind: str, rng: np.random.Generator) -> Session:
    """Film and drift of the same kind, independent of each other; drift sizes as measured on machines (um)."""
    temperatures = film(kind, rng)
    common = 3.0 * smooth_series(kind, rng)
    slope = 2.0 * smooth_series(kind, rng)
    return session(temperatures, common, slope, rng)


def driven_session(
    rng: np.random.Generator,
    *,
    source: int = 0,
    um_per_unit: float = 3.0,
    lag_s: float = 0.0,
    nuisance_um: float = 0.1,
    dwell_s: float = 1800.0,
) -> Session:
    """One of three switched sources drives common and slope through a first-order mechanical lag."""
    _, responses = source_responses("duty", rng, dwell_s)
    temperatures = film("duty", rng, responses)
    driver = responses[:, source] if lag_s == 0 else first_order(responses[:, source], lag_s)
    common = um_per_unit * driver + nuisance_um * np.cumsum(rng.standard_normal(CYCLES))
    slope = um_per_unit * driver + nuisance_um * np.cumsum(rng.standard_normal(CYCLES))
    made = session(temperatures, common, slope, rng)
    return Session(made.fused, made.field, responses)


def distance_cells(row: int, column: int, source: int) -> float:
    """Distance of a cell from a source's centre, in cells."""
    return float(np.hypot(row - SOURCES[source][0], column - SOURCES[source][1]))
