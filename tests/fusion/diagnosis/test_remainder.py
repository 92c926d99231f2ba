"""The remainder of a model: a planted pattern is found, described and measured; a complete model leaves none."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.diagnosis.remainder import LEVEL, Remainder, examine
from fusion.effects.library import library
from fusion.model.fit import Term, fit_model
from fusion.twin.machine.recipe import EffectRecipe
from tests.fusion.loop_bench import DECLARED, readings_of


def remainder_of(*effects: EffectRecipe, set_aside: tuple[tuple[int, str], ...] = ()) -> Remainder:
    readings = readings_of(*effects, seed=5)
    terms = [Term(name, next(iter(library()[name].candidates(readings, {}, None)))) for name in DECLARED]
    fit = fit_model(readings, terms).fit
    return examine(readings, fit, np.random.default_rng(1), set_aside=set_aside)


def test_complete_model_leaves_no_pattern():
    remainder = remainder_of()
    assert remainder.p_value > LEVEL
    assert (remainder.shape, remainder.rms_um) == ("", 0.0)


@pytest.fixture(scope="module")
def switching() -> Remainder:
    return remainder_of(EffectRecipe("telegraph_switching", amplitude_um=1.0))


def test_planted_pattern_is_found_where_it_acts(switching):
    assert switching.p_value < LEVEL
    assert "negative direction only" in switching.shape
    weight = dict(zip(switching.sites, np.abs(switching.along_sites), strict=True))
    assert min(weight[(target, "negative")] for target in range(9, 13)) > 0.5
    assert max(weight[(target, "positive")] for target in range(1, 17)) < 0.5


def test_pattern_explains_itself_and_noise_does_not(switching, rng):
    assert switching.share_of(switching.series[:, None]) == pytest.approx(1.0, abs=0.01)
    # one column of 1,900 readings explains 1 / 1,900 of anything by chance
    assert switching.share_of(rng.standard_normal((switching.series.size, 1))) < 0.01


def test_sites_that_are_set_aside_are_not_tested():
    aside = tuple((target, "negative") for target in range(9, 13))
    remainder = remainder_of(EffectRecipe("telegraph_switching", amplitude_um=1.0), set_aside=aside)
    assert not set(aside) & set(remainder.sites)
    assert remainder.p_value > LEVEL
