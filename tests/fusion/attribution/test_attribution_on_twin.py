"""Attribution and diagnosis on the twin, whose heat, drift and readings share nothing with the analysis."""

from __future__ import annotations

import pytest

from fusion.attribution.attribute import correlate
from fusion.diagnosis.diagnose import diagnose
from fusion.twin.machine.recipe import AnomalyRecipe
from tests.fusion.twin_sessions import CAUSES, Flag, session


@pytest.mark.parametrize("kind", list(CAUSES))
def test_a_target_that_misbehaves_gets_its_cause(kind):
    fused, _ = session(3, anomaly=(AnomalyRecipe(5, kind, "both", 0.6),))
    assert diagnose([Flag()], fused)[0].cause == CAUSES[kind]


def test_a_field_that_drives_the_axis_is_found_though_a_warm_up_dominates():
    fused, film = session(0)
    maps = correlate(fused, film, draws=99, checks=1)
    assert maps.attrs["verdict"] == "attributable"
    assert float(maps["p_value"].sel(channel="joint").min()) <= 0.05


def test_drift_that_the_field_does_not_make_is_not_attributed_to_it():
    """The same heat, but an axis that only wanders by itself."""
    still = {"expansion_ppm_per_K": 0.0, "offset_um_per_K": 0.0}
    verdicts = []
    for seed in range(4):
        fused, film = session(seed, drift=still)
        verdicts.append(correlate(fused, film, draws=99, checks=1, seed=seed).attrs["verdict"])
    # At a rate of 0.07 two or more of four have probability 0.03.
    assert verdicts.count("attributable") <= 1
