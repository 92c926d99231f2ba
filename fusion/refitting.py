"""L4 - Terms that depend on more than the readings: on the model's other coefficients, or on fields that have been put right since."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fusion.effects import Effect
from fusion.model import ModelFit, Term, fit_model
from fusion.readings import Readings

#: Effects that make the field wrong, not the drift; and how often their size and the declared coefficients are fitted in turn.
CAMERA_ERRORS = frozenset({"camera_offset", "reflected_source"})
_SETTLING_ROUNDS = 2


def settled(model: ModelFit, effects: Mapping[str, Effect]) -> ModelFit:
    """The model with errors of the camera sized by the coefficients that hold beside them.

    While such an error was unknown it bent the declared coefficients, by which it is weighed.
    """
    if not any(term.effect in CAMERA_ERRORS for term in model.terms):
        return model
    for _ in range(_SETTLING_ROUNDS):
        known = model.coefficients()
        terms = [
            again(term, model.readings, known, effects) if term.effect in CAMERA_ERRORS else term
            for term in model.terms
        ]
        model = fit_model(model.readings, terms, used=model.used)
    return model


def again(term: Term, readings: Readings, coefficients: Mapping[str, float], effects: Mapping[str, Effect]) -> Term:
    """A term with the columns that the same parameters give now; one that does not offer them again stays."""
    near = term.member if term.member.parameters else None
    offered = effects[term.effect].members(readings, coefficients, near)
    same = (member for member in offered if _same_parameters(member.parameters, term.member.parameters))
    member = next(same, term.member)
    return Term(term.effect, replace(member, prior=term.member.prior))


def _same_parameters(one: Mapping[str, float | str], other: Mapping[str, float | str]) -> bool:
    return one.keys() == other.keys() and all(
        one[name] == value if isinstance(value, str) else np.isclose(float(one[name]), float(value), rtol=1e-9)
        for name, value in other.items()
    )
