"""Parts of a closed loop along an axis as checks and stages meet them: what a test does not name is sound, or not there."""

from __future__ import annotations

from typing import Any

from fusion.results.loop import AxisLine, AxisLoop, AxisStep, AxisUnexplained, Coefficient, DeclaredCoefficient


def coefficient(value: float, u: float, unit: str = "ppm/K", **more: Any) -> Coefficient:
    """A coefficient of an added effect."""
    return Coefficient(value=value, u=u, unit=unit, **more)


def declared_one(effect: str, value: float, u: float, unit: str = "ppm/K", **more: Any) -> DeclaredCoefficient:
    """A coefficient of a declared effect that no part of the test moves."""
    return DeclaredCoefficient(effect=effect, value=value, u=u, unit=unit, **{"jackknife_u": 0.0, **more})


def declared(
    alone: float, alone_u: float, *, moved: float | None = 0.0, stated_u: float = 2.0, offset: float = 1.0
) -> tuple[DeclaredCoefficient, ...]:
    """The declared coefficients where readings that ask for `alone` met the statement of 11.7 ppm/K."""
    weight = 1.0 / alone_u**2 + 1.0 / stated_u**2
    value = (alone / alone_u**2 + 11.7 / stated_u**2) / weight
    return (
        declared_one("table_offset", offset, 0.1, "um/K", jackknife_u=0.2),
        declared_one("axis_expansion", value, weight**-0.5, prior=11.7, prior_u=stated_u, jackknife_u=moved),
    )


def added(effect: str, *coefficients: Coefficient, **more: Any) -> AxisStep:
    """An added effect of 0.3 um that unseen readings bear out."""
    stated = {"parameters": {}, "tied": (), "withheld": "", "rms_um": 0.3, "borne_out": "yes", **more}
    return AxisStep.model_construct(effect=effect, coefficients=coefficients, **stated)


def line(**changed: Any) -> AxisLine:
    """The declared line beside an alternative that is no better than chance."""
    return AxisLine(
        **{
            "alternative": "with deviations of the opposite sign",
            "gain": 3.0,
            "gain_limit": 8.0,
            "alternative_ppm_per_K": (11.2, 11.6),
            "expansion_ppm_per_K": 11.5,
            "expansion_u_ppm_per_K": 0.2,
            "superfluous": (),
            **changed,
        }
    )


def loop(*coefficients: DeclaredCoefficient, **parts: Any) -> AxisLoop:
    """A loop with declared coefficients, which leaves nothing unexplained."""
    nothing = AxisUnexplained.model_construct(shape="", rms_um=0.0, p_value=0.5)
    given = {"steps": (), "unexplained": nothing, "verdict": "partial", "unconfirmed_effects": {}, **parts}
    return AxisLoop.model_construct(declared_coefficients=coefficients, **given)
