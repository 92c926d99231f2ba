"""Speed of the screen at full size, and as a ratio to nilearn on one regressor measured in the same run.

Reproduces figures of docs/measured.csv, on the screen.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable

import numpy as np
import pytest

from fusion.analysis.attribution.drift_channels import TargetSeries
from fusion.analysis.attribution.modes import Excitation
from fusion.analysis.attribution.significance import LAGS_S, FieldSeries, screen

pytestmark = pytest.mark.slow

CYCLES, SERIES = 100, 32
SECONDS = np.arange(CYCLES) * 252.0
VARIED = Excitation(0.5, False)


def film(columns: int, rng: np.random.Generator) -> FieldSeries:
    courses = np.cumsum(rng.standard_normal((CYCLES, 6), dtype=np.float32), axis=0)
    patterns = rng.standard_normal((6, columns), dtype=np.float32)
    values = courses @ patterns + np.float32(0.1) * rng.standard_normal((CYCLES, columns), dtype=np.float32)
    return FieldSeries(SECONDS, values - values.mean(axis=0))


def drifts(rng: np.random.Generator, series: int = SERIES) -> np.ndarray:
    common = np.cumsum(rng.standard_normal(CYCLES))
    return common + 0.4 * rng.standard_normal((series, CYCLES))


def cost(work: Callable[[], object]) -> tuple[float, float]:
    """Wall and processor seconds of one call; on a shared machine the second is what can be compared."""
    wall, processor = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - processor


def run(
    values: np.ndarray, seen: FieldSeries, permutations: int, lags: tuple[float, ...] = LAGS_S
) -> Callable[[], object]:
    directions = ("positive",) * len(values)
    series = TargetSeries(directions, np.arange(1, len(values) + 1), values, SECONDS, np.eye(CYCLES))
    return lambda: screen(series, seen, VARIED, lags_s=lags, permutations=permutations, rng=np.random.default_rng(1))


def test_full_size(rng: np.random.Generator) -> None:
    values = drifts(rng)
    run(values, film(600, rng), 5)()
    wall, processor = cost(run(values, film(10_000, rng), 1000))
    print(f"\n10,000 cells x {CYCLES} cycles x {SERIES} series x {len(LAGS_S)} lags x 1,000 permutations: ", end="")
    print(f"{wall:.1f} s wall, {processor:.1f} s processor, peak {_peak_GB():.2f} GB")
    wall, processor = cost(run(values, film(307_200, rng), 0))
    print(
        f"307,200 pixels without permutations: {wall:.1f} s wall, {processor:.1f} s processor, peak {_peak_GB():.2f} GB"
    )


def test_against_nilearn(rng: np.random.Generator) -> None:
    """nilearn takes one drift series per call: one call is measured and counted 32 times."""
    from nilearn import mass_univariate
    from nilearn.glm import first_level

    columns, permutations = 10_000, 1000
    seen = film(columns, rng)
    values = drifts(rng)
    trend = np.linspace(-1, 1, CYCLES)
    confounds = np.column_stack([np.ones(CYCLES), trend])
    pixels = np.asarray(seen.values, float)
    run(values, film(600, rng), 5, (0.0,))()
    _, ours = cost(run(values, seen, 0, (0.0,)))
    _, theirs = cost(lambda: first_level.run_glm(pixels, np.column_stack([values[0], confounds]), noise_model="ar1"))
    print(f"\n{columns} pixels, {SERIES} series: nilearn run_glm(ar1) / screen = {SERIES * theirs / ours:.0f}")
    _, ours = cost(run(values, seen, permutations, (0.0,)))
    _, theirs = cost(
        lambda: mass_univariate.permuted_ols(values[:1].T, pixels, confounds, n_perm=permutations, verbose=0)
    )
    ratio = SERIES * theirs / ours
    print(
        f"{columns} pixels, {SERIES} series, {permutations} permutations: nilearn permuted_ols / screen = {ratio:.0f}"
    )


def _peak_GB() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
