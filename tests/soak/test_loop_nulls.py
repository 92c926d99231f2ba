"""Campaigns in which nothing is missing, with noise that is not what least squares assumes: docs/method/closed-loop.md, table of nulls.

The closed loop on campaigns of the twin, the reading noise of 0.35 um in its place: white, Laplace, with a correlation of 0.45 between
readings 6 s apart, with one of 0.5 from cycle to cycle at every position, and growing over the test. Counted is any statement that
something is missing: a name, a remainder, a drift without a cause. THERMOFUSE_RUNS sets the number of campaigns per kind.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from fusion.analysis.alignment.align import AxisGeometry, align
from fusion.analysis.alignment.readings import Readings, read_fused
from fusion.analysis.drift_model.closed_loop import close_loop
from fusion.twin import simulate
from fusion.twin.recipe import Recipe
from fusion.twin.simulate import driver_log, environment_log
from fusion.twin.truth import deviations_of, fields_of
from tests.fusion.loop_bench import DECLARED
from tests.soak.rates import campaigns, first_seed, rate, wilson

pytestmark = pytest.mark.slow
RUNS = campaigns(40)
FIRST_SEED = first_seed(500)
CYCLES = 40
SIGMA_UM = 0.35


def within_a_pass(rng: np.random.Generator, seconds: np.ndarray) -> np.ndarray:
    order = np.argsort(seconds.ravel())
    noise = rng.standard_normal(seconds.size)
    kept = 0.45 ** (np.diff(seconds.ravel()[order]) / 6.0)
    for before, at, share in zip(order[:-1], order[1:], kept, strict=True):
        noise[at] = share * noise[before] + np.sqrt(1.0 - share**2) * noise[at]
    return noise.reshape(seconds.shape)


def over_the_cycles(rng: np.random.Generator, seconds: np.ndarray) -> np.ndarray:
    noise = rng.standard_normal(seconds.shape)
    for cycle in range(1, seconds.shape[0]):
        noise[cycle] = 0.5 * noise[cycle - 1] + np.sqrt(0.75) * noise[cycle]
    return noise


NOISES: dict[str, Callable[[np.random.Generator, np.ndarray], np.ndarray]] = {
    "white": lambda rng, seconds: rng.standard_normal(seconds.shape),
    "laplace": lambda rng, seconds: rng.laplace(0.0, np.sqrt(0.5), seconds.shape),
    "within a pass": within_a_pass,
    "over the cycles": over_the_cycles,
    "growing": lambda rng, seconds: (
        rng.standard_normal(seconds.shape) * np.linspace(0.6, 1.4, len(seconds))[:, None, None]
    ),
}


def readings_of(seed: int, noise: str) -> Readings:
    recipe = Recipe().vary(campaign={"seed": seed}, test={"cycles": CYCLES}, laser={"noise_um": 0.02})
    truth = simulate(recipe)
    deviations = deviations_of(truth)
    seconds = deviations["time"].values.astype("datetime64[ns]").astype("int64") * 1e-9
    made = SIGMA_UM * NOISES[noise](np.random.default_rng(9000 + seed), seconds)
    fused = align(
        deviations.assign(deviation=deviations["deviation"] + made),
        fields_of(truth),
        AxisGeometry((500.0, 90.0), (-1.0, 0.0)),
        environment=environment_log(truth),
        drivers=driver_log(truth),
    )
    return read_fused(fused)


@pytest.mark.parametrize("noise", list(NOISES))
def test_nothing_is_said_to_be_missing(noise: str) -> None:
    found = [close_loop(readings_of(FIRST_SEED + number, noise), list(DECLARED)) for number in range(RUNS)]
    false = sum(bool(one.steps) or bool(one.remainder.shape) for one in found)
    named = sum(bool(one.steps) for one in found)
    rates = [float(one.after.fit.drift_rate[0]) for one in found]
    print(
        f"\n{noise}: false statements {rate(false, RUNS)}, names {rate(named, RUNS)}; drift {np.median(rates):.2f} um/sqrt(h)"
    )
    assert wilson(false, RUNS)[0] <= 0.05
