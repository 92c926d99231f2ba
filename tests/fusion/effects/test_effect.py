"""What an effect is: its name in words, its defaults, and a candidate at some of the readings."""

from __future__ import annotations

from dataclasses import FrozenInstanceError

import numpy as np
import pytest

from fusion.effects.effect import Candidate, Effect, Prior, Separable
from tests.fusion.small_campaign import campaign


def test_an_effect_is_called_by_its_label_or_by_its_name_with_spaces():
    def none(readings, coefficients, near):
        return iter(())

    assert Effect("bed_bending", "", "", none).words == "bed bending"
    assert Effect("bed_bending", "", "", none, label="the bed bends").words == "the bed bends"


def test_an_effect_can_be_tried_with_any_readings_unless_it_says_otherwise():
    effect = Effect("own", "", "", lambda readings, coefficients, near: iter(()))
    assert effect.needs(campaign()) is None
    assert (effect.declarable, effect.excited_by, effect.prior, effect.remedy) == (False, "", None, "")


def test_a_candidate_keeps_all_but_its_rows_at_some_of_the_readings():
    candidate = Candidate(
        np.arange(6.0).reshape(3, 2), {"minutes": 5.0}, ("um", "um"), event_s=7.0, prior=Prior(1.0, 0.1), beside=1
    )
    part = candidate.on(np.array([True, False, True]))
    np.testing.assert_array_equal(part.columns, [[0.0, 1.0], [4.0, 5.0]])
    assert (part.parameters, part.units, part.event_s, part.prior, part.beside) == (
        {"minutes": 5.0},
        ("um", "um"),
        7.0,
        Prior(1.0, 0.1),
        1,
    )
    assert candidate.columns.shape == (3, 2)
    with pytest.raises(FrozenInstanceError):
        candidate.beside = 0


def test_separable_columns_are_courses_weighed_by_place():
    courses = (np.array([1.0, 2.0, 3.0]), np.array([False, True, True]))
    columns = Separable(courses, np.array([0, 1, 0]), np.array([[2.0, 3.0], [10.0, 20.0]]))
    whole = [[2.0, 0.0], [20.0, 20.0], [6.0, 3.0]]
    assert columns.shape == (3, 2)
    np.testing.assert_array_equal(np.asarray(columns), whole)
    np.testing.assert_array_equal(columns[np.array([2, 1])], [whole[2], whole[1]])
    np.testing.assert_array_equal(columns[np.array([True, False, True])], [whole[0], whole[2]])
    np.testing.assert_array_equal(columns[1:, 1], [20.0, 3.0])
    np.testing.assert_array_equal(np.column_stack([columns, columns]), np.hstack([whole, whole]))
    on_some = Candidate(columns, {}, ("um", "um")).on(np.array([False, True, False]))
    np.testing.assert_array_equal(on_some.columns, [whole[1]])
