"""The fitted expansion coefficient against the stated one, with the statement's own part taken out of the fit."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.consistency.coefficients import check_expansion


def declared(alone: float, alone_u: float, stated: float = 11.7, stated_u: float = 2.0) -> list[dict[str, float | str]]:
    """The entry of a fit in which readings that ask for `alone` met the statement."""
    weight = 1.0 / alone_u**2 + 1.0 / stated_u**2
    value = (alone / alone_u**2 + stated / stated_u**2) / weight
    entry = {"effect": "axis_expansion", "value": value, "u": weight**-0.5, "unit": "ppm/K"}
    return [{"effect": "table_offset", "value": 1.0, "u": 0.1}, {**entry, "prior": stated, "prior_u": stated_u}]


@pytest.mark.parametrize(
    ("alone", "alone_u", "passed"),
    [
        (11.3, 0.2, True),
        (11.3, 3.0, True),
        (6.0, 0.14, False),
        (-7.7, 0.9, False),
        (16.6, 0.3, True),
        (17.2, 0.3, False),
    ],
)
def test_readings_that_contradict_the_statement_are_doubted(alone: float, alone_u: float, passed: bool) -> None:
    (check,) = check_expansion(declared(alone, alone_u))
    # The statement's part is taken out exactly.
    assert check.value == pytest.approx((alone - 11.7) / np.hypot(alone_u, 2.0), rel=1e-6)
    assert check.passed is passed
    assert bool(check.remedy) is not passed


def test_readings_that_say_nothing_contradict_nothing() -> None:
    entry = {"effect": "axis_expansion", "value": 11.7, "u": 2.0, "prior": 11.7, "prior_u": 2.0}
    (check,) = check_expansion([entry])
    assert check.passed and check.value == 0.0


def test_without_a_declared_expansion_there_is_nothing_to_check() -> None:
    assert check_expansion([{"effect": "table_offset", "value": 1.0, "u": 0.1}]) == []
