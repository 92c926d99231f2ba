"""Checks of fitted coefficients against their physics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fusion.consistency.checks import Check

#: Standard deviations by which the readings may contradict the stated expansion coefficient.
_LIMIT = 2.5


def check_expansion(declared: Sequence[Mapping[str, Any]]) -> list[Check]:
    """Check the expansion coefficient that the readings ask for against the stated one.

    Parameters
    ----------
    declared : sequence of mapping
        ``loop.declared_coefficients`` of results.json, in the final model.

    Returns
    -------
    list of Check
        Empty where the expansion of the axis is not declared or nothing is stated of it.

    Notes
    -----
    The stated coefficient took part in the fit as one more observation. With the fit's value x and uncertainty u, and the stated value m
    and uncertainty p, the readings alone give 1/u_d^2 = 1/u^2 - 1/p^2 and x_d = u_d^2 (x/u^2 - m/p^2); x_d - m is held against
    (u_d^2 + p^2)^(1/2) (GUM 5.1, independent estimates).
    """
    for entry in declared:
        if entry["effect"] == "axis_expansion" and entry.get("prior") is not None:
            return [_expansion(entry["value"], entry["u"], entry["prior"], entry["prior_u"])]
    return []


def _expansion(value: float, u: float, stated: float, stated_u: float) -> Check:
    weight = 1.0 / u**2 - 1.0 / stated_u**2
    # The readings say nothing of their own where the fit is no better known than the statement.
    if weight <= 0.0:
        alone, alone_u = stated, float("inf")
    else:
        alone_u = float(np.sqrt(1.0 / weight))
        alone = alone_u**2 * (value / u**2 - stated / stated_u**2)
    off = (alone - stated) / float(np.hypot(alone_u, stated_u)) if np.isfinite(alone_u) else 0.0
    passed = abs(off) <= _LIMIT
    return Check(
        "expansion_coefficient",
        off,
        _LIMIT,
        passed,
        f"The readings ask for an expansion of {alone:.3g} ± {alone_u:.2g} ppm/K, stated are {stated:.3g} ± {stated_u:.2g} ppm/K "
        f"({off:+.1f} standard deviations, limit {_LIMIT:g}).",
        ""
        if passed
        else (
            "Check expansion_coefficient, the emissivity, origin and direction under [plan.axis], the sign and the unit of the deviations, "
            "and the clocks of camera and laser; or the model lacks an effect that goes with the expansion."
        ),
        "the declared coefficients, and every cause that is added beside them",
    )
