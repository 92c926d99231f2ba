"""Detection limits: they scale with the noise, follow from the critical gain, and say what looks alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.effects.effect import Candidate, Effect
from fusion.effects.library import library
from fusion.effects.states import warm_up
from fusion.loop.confirmation import CandidateScorer
from fusion.loop.detectability import detection_limits
from fusion.loop.state import DetectionLimit, Score
from fusion.model.fit import ModelFit
from tests.fusion.small_campaign import campaign, model_of, term

BARE = campaign(cycles=20, positions_mm=(100.0, 150.0, 200.0, 250.0, 300.0, 350.0))
QUICK = np.sign(np.sin(2.3 * np.arange(BARE.seconds.size)))
REVERSAL = 0.5 * BARE.sign * np.sin(BARE.seconds / 150.0)
CRITICAL = 6.0


def model(*, scale: float = 1.0, terms: tuple = (), used: np.ndarray | None = None) -> ModelFit:
    noise = 0.1 * np.random.default_rng(8).standard_normal(BARE.seconds.size)
    return model_of(replace(BARE, response=scale * noise), terms, used)


def limits_of(fitted: ModelFit, families: dict[str, list[Candidate]], **effects: Effect) -> dict[str, DetectionLimit]:
    scorer = CandidateScorer.of(fitted, np.random.default_rng(1))
    scores = [Score(name, None, critical=CRITICAL) for name in families]
    known = {name: effects.get(name, Effect(name, "", "", lambda *_: iter(()))) for name in families}
    products = scorer.products([one for candidates in families.values() for one in candidates])
    return {limit.effect: limit for limit in detection_limits(scorer, products, fitted, families, scores, known)}


def candidate(columns: np.ndarray, **changes) -> Candidate:
    columns = columns if columns.ndim == 2 else columns[:, None]
    return Candidate(columns, {}, ("um",) * columns.shape[1], **changes)


def test_the_limit_scales_with_the_noise_and_not_with_the_column():
    quiet = limits_of(model(), {"a": [candidate(REVERSAL)], "b": [candidate(50.0 * REVERSAL)]})
    loud = limits_of(model(scale=3.0), {"a": [candidate(REVERSAL)], "b": [candidate(50.0 * REVERSAL)]})
    assert loud["a"].detectable_um == pytest.approx(3.0 * quiet["a"].detectable_um, rel=1e-6)
    assert quiet["b"].detectable_um == pytest.approx(quiet["a"].detectable_um, rel=1e-6)


def test_the_limit_is_the_size_whose_expected_gain_has_eighty_percent_power():
    """A pattern by direction that changes quickly is beyond any drift: sigma squared and the design alone set its limit."""
    column = 0.5 * BARE.sign * QUICK
    fitted = model()
    told = limits_of(fitted, {"a": [candidate(column)]})["a"]
    n, p = fitted.fit.design.shape
    # n/2 log(1 + size**2 E / S) reaches (sqrt(2 c) + 0.84)**2 / 2, with E and S beside the model.
    wanted = 0.5 * (np.sqrt(2.0 * CRITICAL) + 0.84) ** 2
    q, _ = np.linalg.qr(fitted.fit.design)
    energy = ((column - q @ (q.T @ column)) ** 2).sum()
    squares = (n - p) * fitted.fit.sigma**2
    size = np.sqrt(np.expm1(2.0 * wanted / n) * squares / energy)
    site_means = np.array([column[BARE.site == site].mean() for site in range(12)])
    rms = np.sqrt(np.mean((column - site_means[BARE.site]) ** 2))
    assert told.detectable_um == pytest.approx(size * rms, rel=0.1)
    assert told.best_um == told.worst_um == told.detectable_um
    assert told.visible_share == pytest.approx(1.0, abs=1e-9)


def test_a_more_critical_search_needs_a_larger_effect():
    scorer = CandidateScorer.of(model(), np.random.default_rng(1))
    families = {"a": [candidate(REVERSAL)]}
    effects = {"a": Effect("a", "", "", lambda *_: iter(()))}
    sizes = [
        detection_limits(
            scorer, scorer.products(families["a"]), model(), families, [Score("a", None, critical=critical)], effects
        )[0].detectable_um
        for critical in (2.0, 8.0)
    ]
    assert sizes[0] < sizes[1]


def test_a_drift_that_can_stand_in_for_an_effect_makes_its_limit_larger():
    flat = np.sin(BARE.seconds / 600.0)
    told = limits_of(model(), {"flat": [candidate(flat)], "by direction": [candidate(flat * BARE.sign)]})
    assert told["flat"].detectable_um > 2.0 * told["by direction"].detectable_um


def test_the_limits_of_an_effect_are_median_best_and_worst_of_its_candidates():
    columns = [REVERSAL, np.sin(BARE.seconds / 600.0), 0.5 * BARE.sign * QUICK]
    alone = [limits_of(model(), {"a": [candidate(column)]})["a"].detectable_um for column in columns]
    told = limits_of(model(), {"a": [candidate(column) for column in columns]})["a"]
    assert told.best_um == pytest.approx(min(alone)) and told.worst_um == pytest.approx(max(alone))
    assert told.detectable_um == pytest.approx(np.median(alone))


def test_what_the_model_contains_or_what_never_moves_cannot_be_found():
    declared = term(REVERSAL, "declared")
    for column in (3.0 * REVERSAL, np.zeros(BARE.seconds.size)):
        told = limits_of(model(terms=(declared,)), {"a": [candidate(column)]})["a"]
        assert (told.detectable_um, told.best_um, told.worst_um) == (None, None, None)
        assert told.note == "the declared model contains it, or nothing excites it"
        assert told.visible_share == pytest.approx(0.0, abs=1e-6)


def test_the_visible_share_is_what_is_left_beside_the_declared_effects():
    other = 0.5 * BARE.sign * np.cos(BARE.seconds / 150.0)
    half = REVERSAL + other
    fitted = model(terms=(term(other),))
    told = limits_of(fitted, {"a": [candidate(half)]})["a"]
    q, _ = np.linalg.qr(fitted.fit.design)
    site_means = np.array([half[BARE.site == site].mean() for site in range(12)])
    expected = np.linalg.norm(half - q @ (q.T @ half)) / np.linalg.norm(half - site_means[BARE.site])
    assert told.visible_share == pytest.approx(expected, rel=1e-9)
    assert 0.4 < told.visible_share < 0.9


@pytest.mark.parametrize(("mixing", "alike"), [(0.30, True), (0.36, False)])
def test_effects_look_alike_from_nine_tenths_of_the_variance_on(mixing, alike):
    """Of a + m b, a explains 1 / (1 + m**2) where b is as large and independent: 0.917 and 0.885."""
    rng = np.random.default_rng(2)
    first, second = (0.5 * BARE.sign * np.sign(rng.standard_normal(BARE.seconds.size)) for _ in range(2))
    q, _ = np.linalg.qr(np.column_stack([model().fit.design, first]))
    second = second - q @ (q.T @ second)
    second *= np.linalg.norm(first) / np.linalg.norm(second)
    told = limits_of(model(), {"pure": [candidate(first)], "mixed": [candidate(first + mixing * second)]})
    assert told["mixed"].looks_like == (["pure"] if alike else [])
    assert told["pure"].looks_like == (["mixed"] if alike else [])


def test_what_may_be_present_without_an_effect_does_not_make_it_alike():
    told = limits_of(
        model(),
        {"a": [candidate(REVERSAL)], "b": [candidate(np.column_stack([QUICK * BARE.sign, REVERSAL]), beside=1)]},
    )
    assert told["a"].looks_like == []
    without = limits_of(
        model(), {"a": [candidate(REVERSAL)], "b": [candidate(np.column_stack([QUICK * BARE.sign, REVERSAL]))]}
    )
    assert without["a"].looks_like == ["b"]


def test_a_single_warm_up_limits_an_effect_that_needs_switching():
    plain = candidate(warm_up(BARE, 15.0))
    source = Effect("source", "", "", lambda *_: iter(()), excited_by="driver")
    told = limits_of(model(), {"source": [plain], "other": [plain]}, source=source)
    assert (
        told["source"].note == "one warm-up is all that excites it; switch the load on purpose to tell it from others"
    )
    assert told["other"].note == ""
    free = limits_of(model(), {"source": [candidate(REVERSAL)]}, source=source)
    assert free["source"].note == ""


def test_evenly_spaced_targets_limit_a_pitch_error():
    told = limits_of(model(), {"pitch_error": [candidate(REVERSAL)]}, pitch_error=library()["pitch_error"])
    assert told["pitch_error"].note.startswith("evenly spaced targets hide leads of 50, 25, 16.7")
    assert told["pitch_error"].note.endswith("space them unevenly to see all")


def test_only_the_readings_of_the_fit_count():
    """A pattern that moves after the training part alone cannot be found."""
    used = BARE.cycle <= 12
    told = limits_of(model(used=used), {"a": [candidate(np.where(used, 0.0, REVERSAL))]})["a"]
    assert told.detectable_um is None
