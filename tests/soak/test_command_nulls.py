"""The whole command on campaigns in which nothing is missing, whatever the noise and the load: docs/method/closed-loop.md, table of nulls.

Small pictures of the twin, run from files to results as a user runs them; its reading noise is replaced by one of five kinds of 0.35 um
(white, Laplace, a correlation of 0.45 between readings 6 s apart or of 0.5 from cycle to cycle at every position, growing), under a
constant load, a random load, and a room whose temperature has a rhythm. Counted is any statement that is not true: a name, a
remainder, an anomaly, a doubt of the inputs. THERMOFUSE_RUNS campaigns (100 by default) for each of the 15.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pandas as pd
import pytest

from fusion.pipeline.run import run_campaign
from fusion.twin.recipe import Recipe
from tests.soak.lies.campaigns import write
from tests.soak.rates import campaigns, first_seed, rate, wilson
from tests.soak.test_sound_runs import statements_of

pytestmark = pytest.mark.slow
RUNS = campaigns(100)
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
DUTIES: dict[str, dict[str, Any]] = {
    "constant duty": {"duty": {"kind": "constant"}},
    "random duty": {"duty": {"kind": "random", "mean_hold_min": 25.0}},
    "room rhythm": {
        "duty": {"kind": "random", "mean_hold_min": 25.0},
        "room": {"swing_K": 1.0, "swing_period_min": 45.0},
    },
}


def statements(case: tuple[str, str, int]) -> tuple[str, ...]:
    """What the command states of a campaign in which nothing is missing."""
    noise, duty, seed = case
    recipe = Recipe().vary(
        campaign={"seed": seed},
        test={"cycles": 40, "targets": 10, "spacing_mm": 33.0},
        laser={"noise_um": 0.02},
        camera={"columns": 320, "rows": 240, "focal_px": 765.0},
        **DUTIES[duty],
    )
    with tempfile.TemporaryDirectory() as base, contextlib.ExitStack() as stack:
        folder = Path(base) / "campaign"
        write(recipe, folder)
        file = folder / "laser.csv"
        table = pd.read_csv(file)
        shape = table["cycle"].nunique(), 2, table["target"].nunique()
        seconds = (pd.to_datetime(table["time"]) - pd.to_datetime(table["time"][0])).dt.total_seconds().to_numpy()
        # The rows stand in the order of time, a site always at the same place of its cycle.
        made = NOISES[noise](np.random.default_rng([seed, 17]), seconds.reshape(shape)).ravel()
        table["deviation_um"] = (table["deviation_um"] + SIGMA_UM * made).round(3)
        table.to_csv(file, index=False)
        # What is drawn states nothing.
        for drawing in ("report.page.render_report", "pipeline.run._draw_attributed"):
            stack.enter_context(mock.patch(f"fusion.{drawing}", return_value=""))
        results = run_campaign(folder / "campaign.toml", Path(base) / "out")
    assert results.inputs is not None
    return (*statements_of(results), *(f"doubt {check.code} {check.value:.3g}" for check in results.inputs.doubts))


@pytest.mark.parametrize(("noise", "duty"), list(product(NOISES, DUTIES)))
def test_nothing_false_is_stated(noise: str, duty: str, capsys: pytest.CaptureFixture[str]) -> None:
    # Every combination has campaigns of its own.
    first = first_seed(71000) + 1000 * (3 * list(NOISES).index(noise) + list(DUTIES).index(duty))
    said = list[str]()
    cases = [(noise, duty, seed) for seed in range(first, first + RUNS)]
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        for case, one in zip(cases, pool.map(statements, cases), strict=True):
            said += [f"{case[2]}: {'; '.join(one)}"] if one else []
    with capsys.disabled():
        print(f"\n{noise}, {duty}: {rate(len(said), RUNS)}", *said, sep="\n  ", flush=True)
    assert wilson(len(said), RUNS)[0] <= 0.05
