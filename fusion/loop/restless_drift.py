"""An event beside its rival without an event: drift that is restless about that instant, as in a warm-up or when a shift changes.

The drift of the model has the same variance throughout. In a long test it hardly moves most of the time and much faster for a while; a step
is then the best that the library has for the curve which that variance does not allow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.effects.jumps import cycle_starts
from fusion.loop.confirmation import prior_rows
from fusion.loop.decisions import Decision, Reason
from fusion.loop.state import TIE_GAIN, Score
from fusion.model.drift_variances import SHIFT_AND_STRETCH, scaled_systems
from fusion.model.fit import ModelFit
from fusion.model.least_squares import Moments, PriorRows, profile_likelihood
from interferometry.drift.gls import DriftFit
from interferometry.drift.state_space import DriftSystem

#: Half of the shortest restless time, in cycles, because within less no drift can be told from a step; half of the longest, as a share of
#: the test.
_LEAST_CYCLES, _LONGEST_SHARE = 4, 0.25
#: log10 factors on the variances of the drift: within the restless time and throughout, and how far they are moved in a closer look.
_WITHIN, _THROUGHOUT, _CLOSER = (1.0, 2.0, 3.0, 4.0), (0.0, -1.0, -2.0), (-0.5, 0.0, 0.5)


@dataclass(frozen=True)
class RestlessTime:
    """A time in which the drift moves faster than in the rest of the test.

    Attributes
    ----------
    start_s, end_s : of its first and last reading
    within, throughout : log10 factors on the variances of the drift, within this time beside that throughout
    gain : gain in profile log-likelihood over the model whose drift has the same variance throughout; negative where it has
    """

    start_s: float
    end_s: float
    within: float
    throughout: float
    gain: float


def refuse_in_restless_drift(score: Score, model: ModelFit) -> Decision | None:
    """Refuse an event that is not better by odds of 20 to 1 than drift that moves faster about its instant.

    Parameters
    ----------
    score : of the event
    model : without it

    Returns
    -------
    Decision or None
        None where the event is the better explanation, and for an effect that lasts.

    Notes
    -----
    For an event whose instant is searched both explanations have as many parameters: instant and size; duration and factor. An event whose
    instant the field or a log shows (an offset of the camera, a fault of a sensor) has one less, and is asked as strictly. Rates of false
    events with and without this question: docs/method/closed-loop.md.
    """
    if score.best.event_s is None:
        return None
    time = restless_time(model, score.best.event_s)
    advantage = score.gain - time.gain
    if advantage >= TIE_GAIN:
        return None
    evidence: dict[str, float | str] = {
        "start_h": time.start_s / 3600.0,
        "end_h": time.end_s / 3600.0,
        "times": 10.0 ** (time.within / 2.0),
        "drift_gain": time.gain,
        "event_gain": score.gain,
        "advantage": advantage,
        "needed": TIE_GAIN,
    }
    return Decision(score.name, Reason.RESTLESS_DRIFT, evidence)


def restless_time(model: ModelFit, instant_s: float) -> RestlessTime:
    """Find the time about an instant in which faster drift suits the readings best.

    Parameters
    ----------
    model : without an event at that instant
    instant_s : s since the first reading

    Returns
    -------
    RestlessTime
        The best of all widths that are tried, each twice the one before.
    """
    fit = model.fit
    columns = np.column_stack([fit.residual(), fit.design])
    # No draws: nothing is taken from the generator.
    priors = prior_rows(model, np.random.default_rng(), draws=0).beside(fit.coefficients)
    even = max(_likelihood(system, columns, priors) for system in scaled_systems(fit, SHIFT_AND_STRETCH))

    def tried(inside: NDArray[np.bool_], factors: Sequence[tuple[float, float]]) -> list[RestlessTime]:
        start_s, end_s = fit.system.seconds[inside][[0, -1]]
        likelihoods = [_likelihood(_restless(fit, inside, *one), columns, priors) for one in factors]
        return [
            RestlessTime(float(start_s), float(end_s), *one, likelihood - even)
            for one, likelihood in zip(factors, likelihoods, strict=True)
        ]

    found = []
    for half_s in _half_widths(model):
        inside = np.abs(fit.system.seconds - instant_s) <= half_s
        found += tried(inside, list(product(_WITHIN, _THROUGHOUT)))
    best = max(found, key=lambda time: time.gain)
    inside = (fit.system.seconds >= best.start_s) & (fit.system.seconds <= best.end_s)
    closer = [(best.within + more, best.throughout + less) for more, less in product(_CLOSER, _CLOSER)]
    return max(tried(inside, closer), key=lambda time: time.gain)


def _half_widths(model: ModelFit) -> list[float]:
    """Half the durations that are tried, s; in a short test the shortest alone."""
    starts = cycle_starts(model.readings.subset(model.used))
    half_s = _LEAST_CYCLES * float(np.median(np.diff(starts)))
    widths = [half_s]
    while 2.0 * widths[-1] <= _LONGEST_SHARE * float(starts[-1] - starts[0]):
        widths.append(2.0 * widths[-1])
    return widths


def _restless(fit: DriftFit, inside: NDArray[np.bool_], within: float, throughout: float) -> DriftSystem:
    """The drift of a fit with other variances throughout, and faster in some of its readings."""
    (system,) = scaled_systems(fit, [(throughout,)])
    return replace(system, process_noise_scale=np.where(inside, 10.0**within, 1.0))


def _likelihood(system: DriftSystem, columns: Array, priors: PriorRows) -> float:
    """Profile log-likelihood of the first column beside the others."""
    gram, log_spread = system.normal_equations(columns)
    moments = Moments(gram[1:, 1:], gram[1:, :1], gram[:1, 0], columns.shape[0], log_spread)
    return float(profile_likelihood(priors.add_to(moments))[0])
