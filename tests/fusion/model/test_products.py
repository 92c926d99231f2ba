"""Products of whitened columns against dense algebra, and what candidates explain against one `lstsq` each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.effects.effect import Candidate, Separable
from fusion.model.least_squares import PriorRows, moments_of
from fusion.model.products import (
    beside_design,
    by_width,
    reductions,
    sum_products,
    sum_products_apart,
)
from interferometry.drift.state_space import DriftSystem, drift_system
from tests.fusion.model.test_least_squares import squares_beside


def still(n: int) -> DriftSystem:
    """A drift that is not there: whitened columns are the columns."""
    return drift_system(np.arange(float(n)), np.ones((n, 1)), order=1, ratios=np.zeros(1))


def drifting(n: int) -> DriftSystem:
    """A common drift and a stretch that wander smoothly."""
    loadings = np.column_stack([np.ones(n), np.resize([0.0, 0.5, 1.0], n)])
    return drift_system(7.0 * np.arange(n), loadings, order=2, ratios=np.array([1e-4, 1e-5]))


def explained(candidates: list[Candidate], responses: np.ndarray, model: np.ndarray) -> tuple:
    """Reductions where nothing drifts."""
    n = responses.shape[0]
    (products,) = sum_products([still(n)], [responses], model, by_width(candidates, np.ones(n, bool)))
    return reductions(products, beside_design(products))


def whitened_columns(candidates: list[Candidate], system: DriftSystem) -> np.ndarray:
    """Columns as the groups order them, whitened at once."""
    n = system.seconds.size
    groups = by_width(candidates, np.ones(n, bool))
    return system.whiten(np.concatenate([group.columns(slice(None)) for group in groups], axis=1))[0]


def candidates_of_three_kinds(rng: np.random.Generator, n: int) -> list[Candidate]:
    """Width 1, 2, and 2 of which the last column is no evidence, mixed."""
    widths = [(1, 0), (2, 0), (2, 1), (1, 0), (3, 2)]
    return [Candidate(rng.standard_normal((n, width)), {}, ("um",) * width, beside=beside) for width, beside in widths]


def test_candidates_are_grouped_by_width_with_what_is_no_evidence_first(rng):
    candidates = candidates_of_three_kinds(rng, 6)
    used = np.array([True, False, True, True, True, False])
    groups = by_width(candidates, used)
    assert [(group.width, group.beside, group.places.tolist()) for group in groups] == [
        (1, 0, [0, 3]),
        (2, 0, [1]),
        (2, 1, [2]),
        (3, 2, [4]),
    ]
    np.testing.assert_array_equal(
        groups[0].columns(slice(None)), np.column_stack([candidates[k].columns[used, 0] for k in (0, 3)])
    )
    np.testing.assert_array_equal(groups[1].columns(slice(None)), candidates[1].columns[used])
    np.testing.assert_array_equal(groups[2].columns(slice(None)), candidates[2].columns[used][:, [1, 0]])
    np.testing.assert_array_equal(groups[3].columns(slice(None)), candidates[4].columns[used][:, [1, 2, 0]])


def test_products_are_those_of_columns_that_are_whitened_at_once(monkeypatch, rng):
    """However few readings are whitened together."""
    n = 41
    system, candidates = drifting(n), candidates_of_three_kinds(rng, n)
    responses, model = rng.standard_normal((n, 2)), rng.standard_normal((n, 3))
    groups = by_width(candidates, np.ones(n, bool))
    y, x = (system.whiten(columns)[0] for columns in (responses, model))
    c = whitened_columns(candidates, system)
    for values in (1, 100, 10**6):
        monkeypatch.setattr("fusion.model.products._VALUES_AT_ONCE", values)
        (told,) = sum_products([system], [responses[:, :1], responses[:, 1:]], model, groups)
        # The design enters by combinations of its columns.
        np.testing.assert_allclose(told.design, np.eye(3), atol=1e-9)
        np.testing.assert_allclose(told.cross, told.basis.T @ x.T @ y, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(told.squares, (y**2).sum(axis=0), rtol=1e-9)
        np.testing.assert_allclose(told.with_responses, y.T @ c, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(told.with_design, told.basis.T @ x.T @ c, rtol=1e-9, atol=1e-9)
        slots = told.slots()
        for within, of_group in zip(told.within, slots, strict=True):
            columns = np.stack([c[:, slot] for slot in of_group], axis=2)
            np.testing.assert_allclose(within, np.einsum("nmi,nmj->mij", columns, columns), rtol=1e-9, atol=1e-9)
        assert told.readings == n
        assert told.log_spread == pytest.approx(np.log(system.innovations(model)[1]).sum(), rel=1e-9)


def test_products_apart_are_those_of_each_part_under_the_same_drift(rng):
    n = 41
    system, candidates = drifting(n), candidates_of_three_kinds(rng, n)
    responses, model = rng.standard_normal((n, 2)), rng.standard_normal((n, 3))
    part = rng.random(n) < 0.4
    (told,) = sum_products_apart([system], [responses], model, by_width(candidates, np.ones(n, bool)), part)
    spread = system.innovations(model)[1]
    for products, here in zip(told, (part, ~part), strict=True):
        y, x = (system.whiten(columns)[0][here] for columns in (responses, model))
        models = products.models()
        assert len(models) == 1 + len(candidates)
        # What is no evidence, the last columns of a candidate, stands before the rest.
        ordered = [np.roll(one.columns, one.beside, axis=1) for one in candidates]
        designs = [x, *(np.column_stack([x, system.whiten(columns)[0][here]]) for columns in ordered)]
        for one, design in zip(models, designs, strict=True):
            whole = moments_of(y, design, spread[here])
            np.testing.assert_allclose(one.design, whole.design, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(one.cross, whole.cross, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(one.squares, whole.squares, rtol=1e-9)
            assert one.readings == here.sum()
            assert one.log_spread == pytest.approx(whole.log_spread, rel=1e-9)


def test_products_are_freed_of_the_design_by_its_coefficients(rng):
    n = 30
    columns, y, x = rng.standard_normal((n, 4)), rng.standard_normal((n, 2)), rng.standard_normal((n, 3))
    events = [Candidate(column[:, None], {}, ("um",)) for column in columns.T]
    part = np.arange(n) < 12
    ((first, _),) = sum_products_apart([still(n)], [y], x, by_width(events, np.ones(n, bool)), part)
    of_y, of_c = rng.standard_normal((3, 2)), rng.standard_normal((3, 4))
    crossed, own = first.freed(of_y, of_c)
    free_y, free_c = (y - x @ of_y)[part], (columns - x @ of_c)[part]
    np.testing.assert_allclose(crossed, free_c.T @ free_y, rtol=1e-10)
    np.testing.assert_allclose(own, (free_c**2).sum(axis=0), rtol=1e-10)


def test_responses_are_freed_of_a_design_with_priors_whatever_its_units(rng):
    n = 30
    x = rng.standard_normal((n, 3)) * np.array([1e-6, 1.0, 1e4])
    x = np.column_stack([x, np.zeros(n), 2.0 * x[:, 2]])
    y, candidate = rng.standard_normal((n, 2)), Candidate(rng.standard_normal((n, 1)), {}, ("um",))
    priors = PriorRows(np.array([[3e-6, 1.0, 0.0, 0.0, 0.0]]), np.array([0.7]), np.array([[-0.2]]))
    system = drifting(n)
    (products,) = sum_products([system], [y], x, by_width([candidate], np.ones(n, bool)))
    told = beside_design(products, priors)
    white_y, white_x = (system.whiten(columns)[0] for columns in (y, x))
    all_y, all_x = priors.append(white_y, white_x)
    c = np.vstack([system.whiten(candidate.columns)[0], [[0.0]]])
    scale = np.maximum(np.linalg.norm(all_x, axis=0), 1e-300)
    left = all_y - all_x / scale @ np.linalg.lstsq(all_x / scale, all_y, rcond=1e-12)[0]
    np.testing.assert_allclose(told.squares, (left**2).sum(axis=0), rtol=1e-8)
    np.testing.assert_allclose(told.with_responses, left.T @ c, rtol=1e-8)
    inside = all_x / scale @ np.linalg.lstsq(all_x / scale, c, rcond=1e-12)[0]
    assert (told.along_design**2).sum() == pytest.approx((inside**2).sum(), rel=1e-8)


def test_reductions_equal_one_least_squares_fit_for_every_candidate_and_response(rng):
    n = 40
    candidates = candidates_of_three_kinds(rng, n)
    model, responses = rng.standard_normal((n, 3)), rng.standard_normal((n, 2))
    reduced, given, separable = explained(candidates, responses, model)
    assert separable.all()
    for place, candidate in enumerate(candidates):
        evidence = candidate.columns.shape[1] - candidate.beside
        for k in range(2):
            alone = squares_beside(responses[:, k], model)
            whole = squares_beside(responses[:, k], np.column_stack([model, candidate.columns]))
            started = squares_beside(responses[:, k], np.column_stack([model, candidate.columns[:, evidence:]]))
            assert reduced[k, place] == pytest.approx(alone - whole, rel=1e-8)
            assert given[k, place] == pytest.approx(alone - started if candidate.beside else 0.0, rel=1e-8, abs=1e-12)


@pytest.mark.parametrize(("share", "separable"), [(0.9e-4, False), (1.1e-4, True)])
def test_a_candidate_of_which_the_model_holds_all_but_a_ten_thousandth_explains_nothing(rng, share, separable):
    q, _ = np.linalg.qr(rng.standard_normal((20, 3)))
    model, outside, y = q[:, :1], q[:, 1], q[:, 1:2]
    column = np.sqrt(1.0 - share) * model[:, 0] + np.sqrt(share) * outside
    reduced, _, told = explained([Candidate(5.0 * column[:, None], {}, ("um",))], y, model)
    assert told.tolist() == [separable]
    # What is outside the model points along the response: all of it is explained, or nothing.
    assert reduced[0, 0] == pytest.approx(1.0 if separable else 0.0, abs=1e-6)


@pytest.mark.parametrize("width", [1, 2, 4])
def test_a_candidate_with_a_column_of_zeros_explains_nothing(rng, width):
    """A driver that is logged and never runs makes such columns; the other candidates are not touched by them."""
    columns = rng.standard_normal((20, width))
    columns[:, 0] = 0.0
    candidates = [Candidate(c, {}, ("um",) * width) for c in (columns, rng.standard_normal((20, width)))]
    y = rng.standard_normal((20, 1))
    reduced, _, separable = explained(candidates, y, np.zeros((20, 1)))
    assert separable.tolist() == [False, True]
    assert reduced[0, 0] == 0.0
    assert reduced[0, 1] == pytest.approx(y[:, 0] @ y[:, 0] - squares_beside(y[:, 0], candidates[1].columns))


def waves(rng: np.random.Generator, n: int, count: int) -> list[Candidate]:
    """Candidates of two columns that follow two courses in time at three places, in different shares."""
    place, courses = np.resize([0, 1, 2], n), tuple(rng.standard_normal((2, n)))
    return [
        Candidate(Separable((courses[k % 2],) * 2, place, rng.standard_normal((3, 2))), {}, ("um", "um"))
        for k in range(count)
    ]


def test_few_courses_at_few_places_tell_the_products_of_many_candidates(rng):
    n, used = 60, np.arange(60) % 4 > 0
    candidates = [*candidates_of_three_kinds(rng, n), *waves(rng, n, 9)]
    plain = [replace(one, columns=np.asarray(one.columns)) for one in candidates]
    y, x = rng.standard_normal((45, 2)), rng.standard_normal((45, 3))
    placed, whole = (by_width(some, used) for some in (candidates, plain))
    # Two courses at three places are six columns, those of nine candidates eighteen.
    assert sum(group.held for group in whole) - sum(group.held for group in placed) == 12
    (told,), (expected,) = (sum_products([drifting(45)], [y], x, groups) for groups in (placed, whole))
    for one, other in zip(
        reductions(told.of_candidates(), beside_design(told.of_candidates())),
        reductions(expected.of_candidates(), beside_design(expected)),
        strict=True,
    ):
        np.testing.assert_allclose(one, other, rtol=1e-8)


def test_few_candidates_are_not_told_by_places(rng):
    few = by_width(waves(rng, 60, 3), np.ones(60, bool))
    assert [group.held for group in few] == [6]
    assert sum_products([still(60)], [np.ones((60, 1))], np.ones((60, 1)), few)[0].of_candidates().groups is few
