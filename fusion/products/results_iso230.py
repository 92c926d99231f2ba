"""Parts of the ISO 230-2 evaluation in results.json that a test sheet shows beside the values: tolerances, conditions, other standards."""

from __future__ import annotations

from typing import Literal

from fusion.products.results_part import Number, ResultPart


class Iso230Tolerance(ResultPart):
    """A quantity judged against its tolerance."""

    quantity: str
    """Symbol of the quantity, with the direction of approach where it is unidirectional."""
    limit_um: float
    """Tolerance, um."""
    value_um: Number
    """Value in the settled window, um."""
    expanded_u_um: Number
    """Its expanded uncertainty (k = 2), um."""
    decision: Literal["pass", "fail", "not decided within the uncertainty", "not measured"]
    """By ISO 14253-1."""


class Iso230Check(ResultPart):
    """A condition that ISO 230-2 asks of a test."""

    name: str
    """What is asked for."""
    met: bool | None
    """Whether it is met; null where the readings do not tell."""
    evidence: str
    """What was found."""


class Iso230Condition(ResultPart):
    """A condition of the test as it was stated or logged."""

    name: str
    """What it is."""
    text: str
    """With its unit; empty where it is not stated."""


class OtherEvaluation(ResultPart):
    """A quantity of the settled window by another standard."""

    standard: str
    """Which standard."""
    name: str
    """Name of the quantity, with its symbol."""
    value_um: Number
    """um."""
    definition: str
    """How it is calculated."""
