"""Reasons not to name an effect although it fits: too little excitation, or temperatures too noisy to carry a lag.

A lagged copy of a noisy temperature is a smoother copy, and wins by denoising; one warm-up looks like every other warm-up
(statistics study, sections 3.4 and 3.5). Both make false names, so both are tested before a name is given.
"""

from __future__ import annotations

import numpy as np

from fusion._typing import Array
from fusion.alignment.readings import Readings, Series, sample_noise
from fusion.effects.candidates import Candidate, warm_up
from fusion.effects.library import Effect
from fusion.model.fit import ModelFit
from fusion.model.least_squares import residual_squares
from interferometry.drift.gls import fit_fixed_effects

#: Temperature noise over range beyond which a lag is not believed: where the machine is switched, and for one warm-up only.
_NOISE_SHARE = {"switched": 0.01, "warm-up": 0.003}
#: A state of which one plain warm-up explains more than this share has been excited by nothing else: simulated warm-ups reach 0.991.
WARM_UP_SHARE = 0.99
#: Log-likelihood that must be left beside free warm-ups of every time constant (protected test), and over a smoothed copy.
_PROTECTED_GAIN = 4.0
_SMOOTH_GAIN = 2.0
_PROTECTION_MIN = (10.0, 30.0, 90.0, 170.0)


def blocked_reason(effect: Effect, candidate: Candidate, part: Readings, model: ModelFit) -> str | None:
    """Why this effect must not be named although it fits, or None.

    Parameters
    ----------
    effect, candidate : the candidate, with columns for the readings the model was fitted to
    part : those readings
    model : the model without the candidate
    """
    if not effect.excited_by:
        return None
    share = warm_up_share(part, candidate)
    single = share > WARM_UP_SHARE
    if effect.excited_by == "field":
        noise = noise_share(part.series["mean_rise"])
        limit = _NOISE_SHARE["warm-up" if single else "switched"]
        if noise > limit:
            return (
                f"the noise of the mean rise is {100 * noise:.2f} % of its range; above {100 * limit:.1f} % a lagged, smoother copy "
                "wins by its smoothness alone"
            )
    gain = _gain(model, candidate, protection(part) if single else None)
    if single and gain < _PROTECTED_GAIN:
        return (
            f"one warm-up only excited the machine ({100 * share:.1f} % of the candidate is a plain warm-up), and beside free "
            f"warm-ups it gains only {gain:.1f} in log-likelihood; switch the load on purpose to tell"
        )
    if effect.excited_by == "field" and _follows_the_rate(model, candidate):
        return (
            "beside it the field's own coefficient takes the opposite sign and nearly cancels it: the readings follow the rate at "
            "which the table warms, which is the power of a source, not a lag"
        )
    if effect.excited_by == "field":
        smoothed = smoothed_copy(part, float(candidate.parameters["time_constant_min"]))
        advantage = _gain(model, candidate, None) - _gain(model, smoothed, None)
        if advantage < _SMOOTH_GAIN:
            return (
                f"a copy of the field that is only smoothed, not delayed, fits as well (log-likelihood {advantage:+.1f}): the lag "
                "wins by denoising, not by physics"
            )
    return None


def noise_share(series: Series) -> float:
    """Noise of a sampled series over its range, from its second differences (a smooth course cancels in them)."""
    values = series.values
    if values.size < 5:
        return 1.0
    return sample_noise(values) / max(float(np.ptp(values)), 1e-12)


def protection(part: Readings) -> Array:
    """Free warm-ups of several time constants, common and along the axis, (n, 8)."""
    curves = [warm_up(part, minutes) for minutes in _PROTECTION_MIN]
    return np.column_stack([*curves, *(curve * part.share for curve in curves)])


def smoothed_copy(part: Readings, minutes: float) -> Candidate:
    """The seen temperatures averaged over a centred window as wide as the lag's memory, without delay."""
    columns = [
        part.at(_centred_mean(part.series[name], 60.0 * minutes)) * factor
        for name, factor in (("mean_rise", 1.0), ("axis_integral", 1e-3))
    ]
    return Candidate(np.column_stack(columns), {}, ("um/K", "ppm/K"))


def _centred_mean(series: Series, half_width_s: float) -> Series:
    weights = np.abs(series.seconds[:, None] - series.seconds[None, :]) <= half_width_s
    smoothed = (weights @ series.values.reshape(series.seconds.size, -1)) / weights.sum(axis=1, keepdims=True)
    return Series(series.seconds, smoothed.reshape(series.values.shape), series.units)


def warm_up_share(part: Readings, candidate: Candidate) -> float:
    """Share of the candidate's course at the far end of the travel that one plain warm-up explains (least of its columns)."""
    far = np.abs(part.position_mm) == np.abs(part.position_mm).max()
    curves = [warm_up(part, minutes)[far] for minutes in np.geomspace(5.0, 400.0, 40)]
    return min(1.0 - min(_residual_share(course, curve) for curve in curves) for course in candidate.columns[far].T)


def _residual_share(course: Array, curve: Array) -> float:
    basis = np.column_stack([np.ones(course.size), curve])
    left = course - basis @ np.linalg.lstsq(basis, course, rcond=None)[0]
    return float(left @ left) / max(float(((course - course.mean()) ** 2).sum()), 1e-300)


def _follows_the_rate(model: ModelFit, candidate: Candidate) -> bool:
    """True where the field and its delayed copy enter with opposite signs and little is left in the long run."""
    fit = fit_fixed_effects(
        model.fit.system, model.fit.response, np.column_stack([model.fit.design, candidate.columns])
    )
    at_once = dict(zip(("table_offset", "axis_expansion"), ("um/K", "ppm/K"), strict=True))
    for term in model.terms:
        unit = at_once.get(term.effect)
        if unit not in candidate.units:
            continue
        direct = float(fit.coefficients[model.place(term)][0])
        delayed = float(fit.coefficients[model.fit.design.shape[1] + candidate.units.index(unit)])
        if direct * delayed < 0.0 and abs(direct + delayed) < 0.5 * max(abs(direct), abs(delayed)):
            return True
    return False


def _gain(model: ModelFit, candidate: Candidate, beside: Array | None) -> float:
    """Log-likelihood that the candidate gains beside the model and further columns, the drift's variances kept."""
    base = model.fit.design if beside is None else np.column_stack([model.fit.design, beside])
    whitened, _ = model.fit.system.whiten(np.column_stack([model.fit.response, base, candidate.columns]))
    y, x = whitened[:, 0], whitened[:, 1:]
    # A copy that is smoothed over the whole campaign is a constant, which the model has already.
    without, with_candidate = residual_squares(y, x[:, : base.shape[1]]), residual_squares(y, x)
    return 0.5 * y.size * float(np.log(without / with_candidate))
