"""Values of the nonlinear parameters of an effect that fit as well as the best: profile likelihood intervals.

Time constants, periods and instants get an interval; words (the state that is followed, how it started) get the alternatives.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from fusion._typing import Array
from fusion.effects.effect import Candidate

#: Log-likelihood by which the best may beat a value that a 95 % interval still holds: half of chi-squared, 1 degree of freedom.
_WITHIN = 1.92
#: Values that differ by less than this share are one value, computed twice.
_SAME = 1e-6
#: Words that only spell out a number: what a wave may be mistaken for, and the time constants of a chain of parts.
DERIVED_WORDS = frozenset({"possible_leads", "chain"})

#: Lowest and highest value, None where what was looked at ends before the likelihood has fallen; or the words that fit as well.
Range = list[float | None] | list[str]


def parameter_ranges(near: Sequence[Candidate], gains: Array, best: Candidate, best_gain: float) -> dict[str, Range]:
    """Values of the parameters that fit as well as the best, by profile likelihood (95 %).

    Parameters
    ----------
    near : candidates around the best one
    gains : (near,) gain in log-likelihood of each
    best, best_gain : the one that was chosen

    Returns
    -------
    dict
        A number's range holds for the words that were chosen (what is followed, and how it started). A parameter that was not varied, and
        a word beside which no other fits as well, are left out.
    """
    alike = [candidate for candidate, gain in zip(near, gains, strict=True) if gain >= best_gain - _WITHIN]
    ranges: dict[str, Range] = {}
    for name, value in best.parameters.items():
        if name in DERIVED_WORDS:
            continue
        if isinstance(value, str):
            words = sorted(
                {str(candidate.parameters[name]) for candidate in alike if name in candidate.parameters} - {value}
            )
            if words:
                ranges[name] = words
            continue
        tried = [_number(candidate, name) for candidate in near if _same_words(candidate, best)]
        fitting = [float(value), *(_number(candidate, name) for candidate in alike if _same_words(candidate, best))]
        if len(set(tried)) > 1:
            ranges[name] = _enclosed(np.array(tried), min(fitting), max(fitting))
    return ranges


def _enclosed(tried: Array, low: float, high: float) -> list[float | None]:
    """The values next to those that fit: the likelihood falls somewhere between, so the interval is rather too wide."""
    below, above = tried[tried < low - _SAME * abs(low)], tried[tried > high + _SAME * abs(high)]
    lowest = float(below.max()) if below.size else 0.0 if low == 0.0 else None
    return [lowest, float(above.min()) if above.size else None]


def _number(candidate: Candidate, name: str) -> float:
    """A parameter's value; a body that is not there has a time constant of zero."""
    return float(candidate.parameters.get(name, 0.0))


def _same_words(candidate: Candidate, best: Candidate) -> bool:
    return _words(candidate.parameters) == _words(best.parameters)


def _words(parameters: Mapping[str, float | str]) -> dict[str, str]:
    return {name: value for name, value in parameters.items() if isinstance(value, str) and name not in DERIVED_WORDS}
