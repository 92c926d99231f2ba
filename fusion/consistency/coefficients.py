"""Checks of fitted coefficients against their physics."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from fusion.consistency.checks import Check

#: Standard deviations by which the readings may contradict the stated expansion coefficient.
_LIMIT = 2.5
#: Largest expansion coefficient of a material that tables and frames of machine tools are made of, ppm/K: aluminium alloys, and a tenth.
_LARGEST_PPM_PER_K = 26.0
#: Largest length of a frame that can move the laser against the table, as a multiple of the travel, and its smallest value, mm.
_FRAME_TRAVELS, _LEAST_FRAME_MM = 5.0, 3000.0
#: Log-likelihood by which another line must explain the readings better where it does away with a named cause: odds of 400 to 1. That
#: cause was chosen among as many candidates as there are lines, so that the number of alternatives counts on both sides.
_LINE_GAIN_OVER_CAUSE = 6.0
#: Standard deviations by which a coefficient must lie beyond what is possible.
_BEYOND_SIGMAS = 3.0


def check_coefficients(loop: Mapping[str, Any], *, travel_mm: float) -> list[Check]:
    """Check the coefficients of the final model against physics.

    Parameters
    ----------
    loop : mapping
        Part ``loop`` of results.json.
    travel_mm : float
        Largest distance of a target from the laser's zero, mm.

    Returns
    -------
    list of Check
        The expansion against the stated coefficient, where it is declared; every coefficient per kelvin against the largest one possible;
        the declared line against its alternatives.

    Notes
    -----
    The stated coefficient took part in the fit as one more observation. With the fit's value x and uncertainty u, and the stated value m
    and uncertainty p, the readings alone give 1/u_d^2 = 1/u^2 - 1/p^2 and x_d = u_d^2 (x/u^2 - m/p^2). An effect that the model lacks
    moves x_d by more than u_d; how far is the jackknife's standard deviation j over targets and parts of the test. x_d - m is held against
    (u_d^2 + j^2 + p^2)^(1/2) (GUM 5.1, independent estimates), where u_d contains the scale of the rise.
    """
    declared = loop.get("declared_coefficients", [])
    stated = [entry for entry in declared if entry["effect"] == "axis_expansion" and entry.get("prior") is not None]
    added = [{"effect": step["effect"], **entry} for step in loop.get("steps", []) for entry in step["coefficients"]]
    line = loop.get("axis_line")
    return [
        *(_expansion(entry, absorbed=_absorbed(loop.get("steps", []))) for entry in stated[:1]),
        *_sensitivities([*declared, *added], travel_mm),
        *([] if line is None else [_axis_line(line, loop.get("unnamed", {}))]),
    ]


def _absorbed(steps: Sequence[Mapping[str, Any]]) -> bool:
    """Whether an added effect may be what a wrong coefficient leaves: the compensation of the material acts in proportion to it."""
    return any("material_compensation" in (step["effect"], *step.get("tied", ())) for step in steps)


def _expansion(entry: Mapping[str, Any], *, absorbed: bool) -> Check:
    value, stated, stated_u = entry["value"], entry["prior"], entry["prior_u"]
    u = entry["u"] if entry.get("u_fit") is None else entry["u_fit"]
    weight = 1.0 / u**2 - 1.0 / stated_u**2
    moved = _jackknife_u(entry)
    # The readings say nothing of their own where the fit is no better known than the statement.
    if weight <= 0.0 or math.isinf(moved):
        alone, alone_u = stated, math.inf
    else:
        alone = (value / u**2 - stated / stated_u**2) / weight
        # The stated coefficient has diluted an error of the rise's scale as it has diluted the readings.
        scale_u = (entry.get("u_scale") or 0.0) / (1.0 - u**2 / stated_u**2)
        alone_u = math.hypot(math.sqrt(1.0 / weight), moved, scale_u)
    off = (alone - stated) / math.hypot(alone_u, stated_u)
    passed = abs(off) <= _LIMIT and not absorbed
    beside = (
        " An error of the material compensation was added beside that, which a wrong coefficient imitates."
        if absorbed
        else ""
    )
    return Check(
        "expansion_coefficient",
        off,
        _LIMIT,
        passed,
        f"The readings ask for an expansion of {alone:.3g} ± {alone_u:.2g} ppm/K, stated are {stated:.3g} ± {stated_u:.2g} ppm/K "
        f"({off:+.1f} standard deviations, limit {_LIMIT:g}).{beside}"
        if math.isfinite(alone_u)
        else f"The readings alone do not determine the expansion of the axis; nothing contradicts the stated coefficient.{beside}",
        ""
        if passed
        else (
            "Check expansion_coefficient, the emissivity, origin and direction under [plan.axis], the sign and the unit of the deviations, "
            "the unit of the positions, and the clocks of camera and laser; or the model lacks an effect that goes with the expansion."
        ),
        "the declared coefficients, and every cause that is added beside them",
    )


def _jackknife_u(entry: Mapping[str, Any]) -> float:
    moved = entry.get("jackknife_u", 0.0)
    return math.inf if moved is None else float(moved)


def _sensitivities(coefficients: list[Mapping[str, Any]], travel_mm: float) -> list[Check]:
    """The coefficient per kelvin that lies furthest beyond what expansion can do, or nearest to it."""
    frame_mm = max(_FRAME_TRAVELS * travel_mm, _LEAST_FRAME_MM)
    largest = {"ppm/K": _LARGEST_PPM_PER_K, "um/K": _LARGEST_PPM_PER_K * frame_mm * 1e-3}
    shares = [
        (
            (abs(entry["value"]) - _BEYOND_SIGMAS * math.hypot(entry["u"], _jackknife_u(entry)))
            / largest[entry["unit"]],
            entry,
        )
        for entry in coefficients
        if entry["unit"] in largest
    ]
    if not shares:
        return []
    share, entry = max(shares, key=lambda pair: pair[0])
    passed = share <= 1.0
    unit = entry["unit"]
    named = f"{entry['effect'].replace('_', ' ')} has {entry['value']:.3g} {unit.replace('um', 'µm')}"
    possible = f"{largest[unit]:.3g} {unit.replace('um', 'µm')}"
    return [
        Check(
            "sensitivity",
            max(share, 0.0),
            1.0,
            passed,
            f"{named}, the expansion of a frame of {frame_mm * 1e-3:.2g} m reaches {possible} at most."
            if not passed
            else f"No coefficient per kelvin is beyond what the expansion of a frame of {frame_mm * 1e-3:.2g} m can do.",
            ""
            if passed
            else "Check the scale of the temperatures (emissivity, range, unit), and the units of positions (mm) and deviations (µm).",
            "the coefficients, and every cause that follows the temperature",
        )
    ]


def _axis_line(line: Mapping[str, Any], unnamed: Mapping[str, float]) -> Check:
    limit = _LINE_GAIN_OVER_CAUSE if line["superfluous"] else line["gain_limit"]
    # An effect that is significant but has no name yet is worth about -ln p; a line that explains less is no better explanation.
    limit = max(limit, *(-math.log(max(p, sys.float_info.min)) for p in unnamed.values()), 0.0)
    passed = line["gain"] <= limit
    named = [name.replace("_", " ") for name in line["superfluous"]]
    without = f", and without {', '.join(named)}" if named else ""
    return Check(
        "axis_line",
        line["gain"],
        limit,
        passed,
        _no_better_line(line, limit)
        if passed
        else f"The field explains the readings better {line['alternative']} than as declared (log-likelihood {line['gain']:+.1f}, limit "
        f"{limit:g}), with an expansion of {line['expansion_ppm_per_K']:.3g} ± {line['expansion_u_ppm_per_K']:.2g} ppm/K{without}.",
        ""
        if passed
        else "Check origin and direction under [plan.axis], the plan coordinates of the fiducials, the order of the targets and the sign "
        "of the deviations.",
        "the declared coefficients, the place of every heat source along the axis, and every cause that is added beside them",
    )


def _no_better_line(line: Mapping[str, Any], limit: float) -> str:
    """How well the readings determine the line, where none is clearly better than the declared one."""
    low, high = line["as_well_ppm_per_K"]
    if line["gain"] <= 0.0:
        compared = (
            "No other line on the plan, order of the targets or sign of the deviations explains the readings better"
        )
    else:
        compared = (
            f"Of other lines on the plan, orders of the targets and signs of the deviations none explains the readings better than chance "
            f"or an effect without a name would (log-likelihood {line['gain']:+.1f} {line['alternative']}, limit {limit:.1f})"
        )
    return f"{compared}; lines that do so as well as the declared one ask for {low:.3g} to {high:.3g} ppm/K."
