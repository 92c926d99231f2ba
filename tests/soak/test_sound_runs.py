"""Sound campaigns run as a user runs them, from files to results: false doubts, and false statements where nothing is missing.

The price of all checks together (docs/method/consistency.md), and the chance that a report on a sound campaign states anything that is
not there: an effect, a position that stands out, or something left. THERMOFUSE_RUNS campaigns (200 by default),
THERMOFUSE_FIRST_SEED; every second one has neither an undeclared effect nor an anomaly.
"""

from __future__ import annotations

import contextlib
import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import numpy as np
import pytest

from fusion.analysis.diagnosis.residual import DRIFT_SHARE
from fusion.common import FusionError
from fusion.pipeline.run import run_campaign
from fusion.results.results import Results
from fusion.twin.recipe import Recipe
from interferometry.common import InterferometryError
from tests.soak.lies.campaigns import write
from tests.soak.lies.outcome import shares_within
from tests.soak.rates import campaigns, first_seed, rate, wilson
from tests.soak.test_sound_inputs import on_any_machine
from thermography.common import ThermographyError

pytestmark = pytest.mark.slow


class Run(NamedTuple):
    """What was said of a sound campaign.

    Attributes
    ----------
    seed : int
    bare : bool
        Whether nothing was there to be found.
    doubts : tuple of str
        Codes of the doubts, or the refusal.
    statements : tuple of str
        What was stated of a campaign with nothing to be found.
    within : dict of str to float
        Share of each figure's values whose error is at most twice its printed uncertainty.
    """

    seed: int
    bare: bool
    doubts: tuple[str, ...]
    statements: tuple[str, ...]
    within: dict[str, float]


def recipe_of(seed: int) -> Recipe:
    """A sound campaign drawn from the twin's options, on any machine; every second one has nothing undeclared."""
    drawn = on_any_machine(seed)
    return drawn.vary(effect=(), anomaly=()) if seed % 2 == 0 else drawn


def run(seed: int) -> Run:
    recipe = recipe_of(seed)
    bare = not recipe.effect and not recipe.anomaly
    with tempfile.TemporaryDirectory() as base, contextlib.ExitStack() as stack:
        folder = Path(base)
        truth = write(recipe, folder / "campaign")
        stack.enter_context(mock.patch("fusion.report.page.render_report", return_value=""))
        try:
            results = run_campaign(folder / "campaign" / "campaign.toml", folder / "out")
        except (FusionError, InterferometryError, ThermographyError) as error:
            return Run(seed, bare, (f"refused: {error}".replace(base, ""),), (), {})
        within = shares_within(truth, results, folder / "out")
    assert results.inputs is not None
    doubts = tuple(f"{check.code} {check.value:.3g}" for check in results.inputs.doubts)
    # The twin's own random walk is undeclared, too: where it is as large as what the loop reports, that it is there is true.
    walk = truth.readings["nuisance"] - truth.readings["nuisance"].mean("cycle")
    is_there = float(np.sqrt((walk**2).mean())) > DRIFT_SHARE * recipe.laser.noise_um
    said = [one for one in statements_of(results) if not (is_there and one.startswith("remainder: a slow,"))]
    return Run(seed, bare, doubts, tuple(said) if bare else (), within)


def statements_of(results: Results) -> tuple[str, ...]:
    """What the results state beyond the declared model."""
    loop = results.loop
    assert loop is not None
    said = [f"effect {step.effect} (p {step.p_value:.2g})" for step in loop.steps]
    said += [f"significant {name} (p {p:.2g})" for name, p in loop.unconfirmed_effects.items()]
    said += [f"remainder: {loop.unexplained.shape} (p {loop.unexplained.p_value})"] if loop.unexplained.shape else []
    said += [f"anomaly at target {anomaly.target} (p {anomaly.p_value:.2g})" for anomaly in results.anomalies or ()]
    return tuple(said)


def test_reports_on_sound_campaigns(capsys: pytest.CaptureFixture[str]) -> None:
    first, runs = first_seed(61000), campaigns(200)
    done = []
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        for one in pool.map(run, range(first, first + runs)):
            done.append(one)
            short = {name: share for name, share in one.within.items() if share < 0.8}
            if one.doubts or one.statements or short:
                with capsys.disabled():
                    print(f"\n{one.seed}: {'; '.join((*one.doubts, *one.statements))} {short or ''}", flush=True)
    doubted = sum(bool(one.doubts) for one in done)
    bare = [one for one in done if one.bare]
    false = sum(bool(one.statements) for one in bare)
    with capsys.disabled():
        print(f"\ndoubted or refused: {rate(doubted, runs)}; something false stated: {rate(false, len(bare))}")
        for name in done[0].within:
            shares = [one.within[name] for one in done if not one.doubts and np.isfinite(one.within.get(name, np.nan))]
            print(f"{name}: {np.mean(shares):.3f} of the values within 2 u, {len(shares)} campaigns")
    assert wilson(doubted, runs)[0] <= 0.02
    assert wilson(false, len(bare))[0] <= 0.05


def test_every_second_campaign_has_nothing_to_be_found() -> None:
    bare = [not recipe.effect and not recipe.anomaly for recipe in map(recipe_of, range(40))]
    assert all(bare[::2]) and np.mean(bare[1::2]) < 0.5
