"""Admissibility of an effect that fits: sufficient excitation, and a temperature quiet enough to identify a lag.

A lagged copy of a noisy temperature is a smoother copy and fits better by its smoothness; one warm-up is like every other warm-up. Both
produce false names, so both are tested before a name is given. The checks are the same for a campaign along an axis and for a record;
what they ask of the data is answered by the :class:`Grounds` of each. Rates of false names with and without them:
docs/method/closed-loop.md.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from fusion._typing import Array
from fusion.alignment.readings import Readings, Series, sample_noise
from fusion.effects.effect import Candidate
from fusion.effects.states import warm_up
from fusion.loop.decisions import Decision, Reason
from fusion.model.fit import ModelFit
from fusion.model.least_squares import residual_squares
from interferometry.drift.gls import fit_fixed_effects

#: Largest share of a temperature's range that its noise may be for a lag to be identified: where the load is switched, and for a single
#: warm-up.
NOISE_SHARE, NOISE_SHARE_OF_A_WARM_UP = 0.01, 0.003
#: A state of which one plain warm-up explains more than this share has been excited by nothing else: simulated warm-ups reach 0.991.
WARM_UP_SHARE = 0.99
#: Log-likelihood to be gained beside free warm-ups of every time constant (protected test), and over a smoothed copy.
_PROTECTED_GAIN = 4.0
_SMOOTH_GAIN = 2.0
_PROTECTION_MIN = (10.0, 30.0, 90.0, 170.0)


class Grounds(Protocol):
    """What the data say about the admissibility of a candidate."""

    def at_switching(self, candidate: Candidate) -> float | None:
        """Hours since the start at which a driver was switched together with the candidate's event, None if it was not."""

    def heat_is_logged(self) -> bool:
        """Whether anything that makes heat was logged and varied."""

    def noise_of_lag(self, candidate: Candidate) -> tuple[str, float, float]:
        """Name of the temperature that the candidate delays, its noise over its range, and the largest share that is admissible."""

    def refuse_single_excitation(self, effect: str, excited_by: str, candidate: Candidate) -> Decision | None:
        """The decision against an effect whose state was excited only once."""

    def follows_rate(self, candidate: Candidate) -> bool:
        """Whether the readings follow the rate of the temperature rather than a delayed copy of it."""

    def advantage_over_smoothing(self, candidate: Candidate) -> float:
        """Log-likelihood that the delayed copy gains over a copy that is smoothed but not delayed."""


def refuse(effect: str, excited_by: str, candidate: Candidate, grounds: Grounds) -> Decision | None:
    """Decide whether an effect that fits must not be named.

    Parameters
    ----------
    effect : its name
    excited_by : ``"field"`` or ``"driver"`` where the effect is only identified by switching of that kind, else ``""``
    candidate : its best candidate
    grounds : the data

    Returns
    -------
    Decision or None
        The first check that it fails, None where it is admissible.
    """
    hours = grounds.at_switching(candidate)
    if hours is not None:
        return Decision(effect, Reason.AT_SWITCHING, {"hours": hours})
    if not excited_by:
        return None
    lags = excited_by == "field"
    series = ""
    if lags:
        series, noise, limit = grounds.noise_of_lag(candidate)
        if noise > limit:
            evidence: dict[str, float | str] = {
                "series": series,
                "noise_percent": 100.0 * noise,
                "limit_percent": 100.0 * limit,
            }
            return Decision(effect, Reason.TEMPERATURE_NOISE, evidence)
    single = grounds.refuse_single_excitation(effect, excited_by, candidate)
    if single is not None:
        return single
    if lags and grounds.follows_rate(candidate):
        return Decision(effect, Reason.FOLLOWS_RATE, {"series": series})
    if lags:
        advantage = grounds.advantage_over_smoothing(candidate)
        if advantage < _SMOOTH_GAIN:
            return Decision(effect, Reason.SMOOTHING, {"series": series, "advantage": advantage})
        if not grounds.heat_is_logged():
            return Decision(effect, Reason.UNLOGGED_HEAT)
    return None


class AxisGrounds:
    """Grounds of a positioning campaign: the readings that a model was fitted to, and the model."""

    def __init__(self, model: ModelFit) -> None:
        self._model = model
        self._training = model.readings.subset(model.used)

    def at_switching(self, candidate: Candidate) -> float | None:
        """Return None: a load that is switched between cycles leaves an event its instant."""
        return None

    def heat_is_logged(self) -> bool:
        """Whether a driver was logged."""
        return bool(self._training.drivers)

    def noise_of_lag(self, candidate: Candidate) -> tuple[str, float, float]:
        """Noise of the mean rise; a single warm-up needs a quieter temperature."""
        single = warm_up_share(self._training, self._on_training(candidate)) > WARM_UP_SHARE
        limit = NOISE_SHARE_OF_A_WARM_UP if single else NOISE_SHARE
        return "the mean rise", noise_share(self._training.series["mean_rise"]), limit

    def refuse_single_excitation(self, effect: str, excited_by: str, candidate: Candidate) -> Decision | None:
        """Refuse what a plain warm-up explains, unless it gains beside free warm-ups of every time constant."""
        on_training = self._on_training(candidate)
        share = warm_up_share(self._training, on_training)
        if share <= WARM_UP_SHARE:
            return None
        gain = _gain(self._model, on_training, _free_warm_ups(self._training))
        if gain >= _PROTECTED_GAIN:
            return None
        return Decision(effect, Reason.SINGLE_WARM_UP, {"share_percent": 100.0 * share, "gain": gain})

    def follows_rate(self, candidate: Candidate) -> bool:
        """Whether the field and its delayed copy enter with opposite signs and nearly cancel in the long run."""
        on_training = self._on_training(candidate)
        model = self._model
        fit = fit_fixed_effects(
            model.fit.system, model.fit.response, np.column_stack([model.fit.design, on_training.columns])
        )
        direct_units = {"table_offset": "um/K", "axis_expansion": "ppm/K"}
        for term in model.terms:
            unit = direct_units.get(term.effect)
            if unit not in candidate.units:
                continue
            direct = float(fit.coefficients[model.place(term)][0])
            delayed = float(fit.coefficients[model.fit.design.shape[1] + candidate.units.index(unit)])
            if direct * delayed < 0.0 and abs(direct + delayed) < 0.5 * max(abs(direct), abs(delayed)):
                return True
        return False

    def advantage_over_smoothing(self, candidate: Candidate) -> float:
        """Gain over the seen temperatures averaged over a window as wide as the lag's memory."""
        smoothed = _smoothed_copy(self._training, float(candidate.parameters["time_constant_min"]))
        return _gain(self._model, self._on_training(candidate), None) - _gain(self._model, smoothed, None)

    def _on_training(self, candidate: Candidate) -> Candidate:
        return candidate.on(self._model.used)


def noise_share(series: Series) -> float:
    """Noise of a sampled series over its range.

    Parameters
    ----------
    series : evenly or unevenly sampled; a smooth course cancels in its second differences

    Returns
    -------
    float
        1 where fewer than five samples are there.
    """
    values = series.values
    if values.size < 5:
        return 1.0
    return sample_noise(values) / max(float(np.ptp(values)), 1e-12)


def warm_up_share(readings: Readings, candidate: Candidate) -> float:
    """Share of a candidate's course that one plain warm-up explains.

    Parameters
    ----------
    readings : n readings
    candidate : with columns (n, q) at these readings

    Returns
    -------
    float
        At the far end of the travel, where a stretch is largest; the least over its columns.
    """
    far = np.abs(readings.position_mm) == np.abs(readings.position_mm).max()
    curves = [warm_up(readings, minutes)[far] for minutes in np.geomspace(5.0, 400.0, 40)]
    return min(1.0 - min(_residual_share(course, curve) for curve in curves) for course in candidate.columns[far].T)


def _residual_share(course: Array, curve: Array) -> float:
    """Share of a course's variance that a constant and a curve do not explain."""
    basis = np.column_stack([np.ones(course.size), curve])
    residual = course - basis @ np.linalg.lstsq(basis, course, rcond=None)[0]
    return float(residual @ residual) / max(float(((course - course.mean()) ** 2).sum()), 1e-300)


def _free_warm_ups(readings: Readings) -> Array:
    """Warm-ups of several time constants, common and along the axis, (n, 8)."""
    curves = [warm_up(readings, minutes) for minutes in _PROTECTION_MIN]
    return np.column_stack([*curves, *(curve * readings.share for curve in curves)])


def _smoothed_copy(readings: Readings, minutes: float) -> Candidate:
    """The seen temperatures averaged over a centred window as wide as the lag's memory, without delay."""
    columns = [
        readings.at(_centred_mean(readings.series[name], 60.0 * minutes)) * factor
        for name, factor in (("mean_rise", 1.0), ("axis_integral", 1e-3))
    ]
    return Candidate(np.column_stack(columns), {}, ("um/K", "ppm/K"))


def _centred_mean(series: Series, half_width_s: float) -> Series:
    """Mean over a window centred at each sample."""
    seconds, values = series.seconds, series.values.reshape(series.seconds.size, -1)
    first = np.searchsorted(seconds, seconds - half_width_s, side="left")
    after = np.searchsorted(seconds, seconds + half_width_s, side="right")
    mean = values.mean(axis=0)
    # Sums about the mean, so that differences of long sums lose nothing.
    total = np.vstack([np.zeros(values.shape[1]), np.cumsum(values - mean, axis=0)])
    smoothed = mean + (total[after] - total[first]) / (after - first)[:, None]
    return Series(seconds, smoothed.reshape(series.values.shape), series.units)


def _gain(model: ModelFit, candidate: Candidate, beside: Array | None) -> float:
    """Log-likelihood that the candidate gains beside the model and further columns, the drift's variances kept."""
    base = model.fit.design if beside is None else np.column_stack([model.fit.design, beside])
    whitened, _ = model.fit.system.whiten(np.column_stack([model.fit.response, base, candidate.columns]))
    y, x = whitened[:, 0], whitened[:, 1:]
    # A copy that is smoothed over the whole campaign is a constant, which the model has already.
    without, with_candidate = residual_squares(y, x[:, : base.shape[1]]), residual_squares(y, x)
    return 0.5 * y.size * float(np.log(without / with_candidate))
