"""Admissibility of an effect that fits: sufficient excitation, and a temperature quiet enough to identify a lag.

A lagged copy of a noisy temperature is a smoother copy and fits better by its smoothness; one warm-up is like every other warm-up. Both
produce false names, so both are tested before a name is given. The checks are the same for a campaign along an axis and for a record;
what they ask of the data is answered by the :class:`Grounds` of each. Rates of false names with and without them:
docs/method/closed-loop.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, special

from fusion.analysis.alignment.readings import Readings, Series, sample_noise
from fusion.analysis.drift_model.gains import (
    Gains,
    Products,
    by_width,
    gains_by_products,
    sum_products,
    sum_products_apart,
)
from fusion.analysis.drift_model.model import (
    SHIFT_AND_STRETCH,
    ModelFit,
    Moments,
    PriorRows,
    Term,
    density_ahead,
    gain_across,
    profile_likelihood,
    residual_squares,
    scaled_systems,
    solve,
)
from fusion.analysis.drift_model.null_simulation import DRAWS, rank_p_value, simulate_null
from fusion.analysis.drift_model.search import (
    TIE_GAIN,
    Confirmation,
    Confirmed,
    Decision,
    Families,
    Reason,
    Score,
)
from fusion.analysis.effects.effect import Candidate, Effect, warm_up
from fusion.analysis.effects.events import cycle_starts
from fusion.analysis.levels import CONFIRMATION_LEVEL, DENIAL_LEVEL, STRONG_LEVEL
from fusion.common import Array
from interferometry.drift.gls import DriftFit, fit_fixed_effects
from interferometry.drift.kalman import DriftSystem

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
    """Decide whether an effect that fits must not be named."""
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
            percent = {"noise_percent": 100.0 * noise, "limit_percent": 100.0 * limit}
            return Decision(effect, Reason.TEMPERATURE_NOISE, {"series": series, **percent})
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
        gain = _gain(self._model, on_training, free_warm_ups(self._training))
        if gain >= _PROTECTED_GAIN:
            return None
        return Decision(effect, Reason.SINGLE_WARM_UP, {"share_percent": 100.0 * share, "gain": gain})

    def follows_rate(self, candidate: Candidate) -> bool:
        """Whether the field and its delayed copy enter with opposite signs and nearly cancel in the long run."""
        if candidate.parameters.get("shape") == "bending":
            # A difference of both by its physics.
            return False
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
        half_width_s = 60.0 * float(candidate.parameters["time_constant_min"])
        columns = [
            self._training.at(_centred_mean(self._training.series[name], half_width_s)) * factor
            for name, factor in (("mean_rise", 1.0), ("axis_integral", 1e-3))
        ]
        smoothed = Candidate(np.column_stack(columns), {}, ("um/K", "ppm/K"))
        return _gain(self._model, self._on_training(candidate), None) - _gain(self._model, smoothed, None)

    def _on_training(self, candidate: Candidate) -> Candidate:
        return candidate.on(self._model.used)


def noise_share(series: Series) -> float:
    """Noise of a sampled series over its range."""
    values = series.values
    if values.size < 5:
        return 1.0
    return sample_noise(values) / max(float(np.ptp(values)), 1e-12)


def warm_up_share(readings: Readings, candidate: Candidate) -> float:
    """Share of a candidate's course that one plain warm-up explains."""
    far = np.abs(readings.position_mm) == np.abs(readings.position_mm).max()
    curves = [warm_up(readings, minutes)[far] for minutes in np.geomspace(5.0, 400.0, 40)]
    return min(1.0 - min(_residual_share(course, curve) for curve in curves) for course in candidate.columns[far].T)


def free_warm_ups(readings: Readings) -> Array:
    """Warm-ups of several time constants, common and along the axis, (n, columns)."""
    curves = [warm_up(readings, minutes) for minutes in _PROTECTION_MIN]
    return np.column_stack([*curves, *(curve * readings.share for curve in curves)])


def is_shown_by_one_warm_up(fits: Sequence[DriftFit], own: Sequence[NDArray[np.bool_]], free: Sequence[Array]) -> bool:
    """Whether readings show an effect by its columns (p,) of each fit's design, but not beside free warm-ups (n, q): then whatever else
    warmed alike, and was not logged, is in its coefficients.
    """
    plain = protected = 0.0
    for fit, columns, curves in zip(fits, own, free, strict=True):
        effect, others = fit.design[:, columns], fit.design[:, ~columns]
        by_chance = effect.shape[1] - 1.0
        plain += _gain_beside(fit, effect, others) - by_chance
        protected += _gain_beside(fit, effect, np.column_stack([others, curves])) - by_chance
    return plain >= _PROTECTED_GAIN > protected


def _residual_share(course: Array, curve: Array) -> float:
    """Share of a course's variance that a constant and a curve do not explain."""
    basis = np.column_stack([np.ones(course.size), curve])
    residual = course - basis @ np.linalg.lstsq(basis, course, rcond=None)[0]
    return float(residual @ residual) / max(float(((course - course.mean()) ** 2).sum()), 1e-300)


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
    """Log-likelihood that the candidate gains beside the model and further columns."""
    base = model.fit.design if beside is None else np.column_stack([model.fit.design, beside])
    return _gain_beside(model.fit, np.asarray(candidate.columns), base)


def _gain_beside(fit: DriftFit, columns: Array, base: Array) -> float:
    """Log-likelihood that columns gain beside others, the drift's variances kept."""
    whitened, _ = fit.system.whiten(np.column_stack([fit.response, base, columns]))
    y, x = whitened[:, 0], whitened[:, 1:]
    # A copy that is smoothed over the whole campaign is a constant, which the model has already.
    without, with_columns = residual_squares(y, x[:, : base.shape[1]]), residual_squares(y, x)
    return 0.5 * y.size * float(np.log(without / with_columns))


# Does an effect act along the axis as its physics says? If the same course in time fits better with another pattern,
# it has no name.

#: Share of a column that must lie outside the model for a site to have a say.
_SEPARABLE = 1e-6


def inconsistent_patterns(model: ModelFit, terms: Sequence[Term], effects: Mapping[str, Effect]) -> dict[int, Decision]:
    """Decide which terms do not act along the axis as their physics says."""
    wrong = {}
    courses = {k: _course(model, term) for k, term in enumerate(terms) if term.candidate.event_s is None}
    for k in courses:
        p_value = pattern_p_value(model, terms[k])
        if p_value < DENIAL_LEVEL:
            wrong[k] = Decision(terms[k].effect, Reason.INCONSISTENT_PATTERN, {"p_value": p_value})
    patterned = [k for k in courses if terms[k].effect in effects and effects[terms[k].effect].patterned]
    for first, second in combinations(patterned, 2):
        if _one_pattern(model, (terms[first], terms[second]), (courses[first], courses[second])):
            names = {"first": terms[first].effect, "second": terms[second].effect}
            shared = {k: Decision(terms[k].effect, Reason.SHARED_PATTERN, names) for k in (first, second)}
            wrong.update(shared)
    return wrong


def _one_pattern(model: ModelFit, terms: tuple[Term, Term], courses: tuple[Array, Array]) -> bool:
    """Whether one of two courses in time, with a size of its own at every site, fits as well as both terms."""
    own = [place for term in terms for place in range(*model.place(term).indices(model.fit.design.shape[1]))]
    design = np.delete(model.fit.design, own, axis=1)
    both = _left(model, model.fit.design)
    for course in courses:
        free = _free_pattern(model, course)
        alone = _left(model, np.column_stack([design, free]))
        more = free.shape[1] - len(own)
        if 0.5 * model.fit.response.size * np.log(both / alone) >= 0.5 * more:
            return True
    return False


def _left(model: ModelFit, design: Array) -> float:
    """Whitened residual sum of squares beside a design whose columns may depend on each other."""
    whitened, _ = model.fit.system.whiten(np.column_stack([model.fit.response, design]))
    return residual_squares(whitened[:, 0], whitened[:, 1:])


def _free_pattern(model: ModelFit, course: Array) -> Array:
    """A course in time (n,) with a size of its own at every site, (n, sites)."""
    readings = model.readings.subset(model.used)
    site = readings.site
    return (site[:, None] == np.unique(site)[None, :]) * course[:, None]


def pattern_p_value(model: ModelFit, term: Term) -> float:
    """Lack-of-fit test of a term's pattern along the axis against a free pattern with the same course in time."""
    readings = model.readings.subset(model.used)
    sites = np.unique(readings.site)
    free = _free_pattern(model, _course(model, term))
    own = np.linalg.lstsq(free, term.candidate.columns[model.used], rcond=None)[0]
    whitened, _ = model.fit.system.whiten(np.column_stack([model.fit.response, model.fit.design, free]))
    p = model.fit.design.shape[1]
    q, _ = np.linalg.qr(whitened[:, 1 : p + 1])
    y, columns = (part - q @ (q.T @ part) for part in (whitened[:, :1], whitened[:, p + 1 :]))
    length = np.maximum(np.linalg.norm(whitened[:, p + 1 :], axis=0), 1e-12)
    # The course is interpolated between visits, so that the term's own pattern times it is not quite in the model: it is no deviation.
    other = linalg.null_space((own * length[:, None]).T)
    u, s, vt = np.linalg.svd((columns / length) @ other, full_matrices=False)
    kept = s**2 > _SEPARABLE
    score = (u[:, kept].T @ y)[:, 0] / model.fit.sigma
    # Each site's share of the statistic, from its smallest-norm size.
    size = other @ (vt[kept].T @ (score / s[kept]))
    share = size * (other @ (vt[kept].T @ (score * s[kept])))
    per_target = np.bincount(sites // 2, share)
    freedom = int(kept.sum())
    # Where one target carries everything, rounding may leave less than nothing.
    left = max(0.0, float(score @ score) - max(0.0, float(per_target.max())))
    return float(special.chdtrc(max(1, freedom - 2), left))


def _course(model: ModelFit, term: Term) -> Array:
    """Course in time of a term's largest column, read at the site where it moves most, at all used readings (n,)."""
    readings = model.readings.subset(model.used)
    site = readings.site
    columns = term.candidate.columns[model.used]
    largest = int(np.argmax(columns.std(axis=0) * np.abs(model.fit.coefficients[model.place(term)])))
    column = columns[:, largest]
    most = site == max(np.unique(site), key=lambda number: column[site == number].std())
    return np.asarray(np.interp(readings.seconds, readings.seconds[most], column[most]))


# Confirmation of an effect on readings that its coefficients were not fitted to, and the one question to the hold-out
# set.

#: A confirmation with a larger p-value is not inconclusive, it speaks against the effect: half of the campaigns without it gain as much.
#: Then the evidence must be that of five standard deviations.
_CONTRADICTED = 0.5
_FIVE_SIGMA = 2.9e-7
#: Share of the cycles from which the later ones are predicted.
_EARLY_SHARE = 0.5


def prior_rows(model: ModelFit, rng: np.random.Generator | None = None, *, draws: int = DRAWS) -> PriorRows:
    """Priors of a model's coefficients in units of the noise; in a simulated response the coefficient is zero and its prior off by
    chance. Without a generator there are none for simulated responses.
    """
    priors = model.priors()
    design = np.zeros((len(priors), model.fit.design.shape[1]))
    response = np.zeros(len(priors))
    for row, (combination, prior) in enumerate(priors):
        design[row] = combination * model.fit.sigma / prior.u
        response[row] = model.fit.sigma * prior.mean / prior.u
    by_chance = np.empty((len(priors), 0)) if rng is None else rng.standard_normal((len(priors), draws))
    return PriorRows(design, response, model.fit.sigma * by_chance)


@dataclass(frozen=True)
class CandidateScorer:
    """A fitted model with simulated responses in which it is complete.

    Attributes
    ----------
    fit : the model on the training readings
    draws : (n, draws) responses simulated from its drift and noise alone, um
    early : (n,) True for the cycles from which the others are predicted
    halves : (n,) True for one half of the targets
    used : (all readings,) the training readings among those that candidates have columns for
    priors : what is known beforehand of the model's coefficients
    """

    fit: DriftFit
    draws: Array
    early: NDArray[np.bool_]
    halves: NDArray[np.bool_]
    used: NDArray[np.bool_]
    priors: PriorRows

    @classmethod
    def of(cls, model: ModelFit, rng: np.random.Generator) -> CandidateScorer:
        """Simulate the null hypothesis that ``model`` is complete."""
        training = model.readings.subset(model.used)
        numbers = np.unique(training.cycle)
        early = np.searchsorted(numbers, training.cycle) < _EARLY_SHARE * numbers.size
        return cls(
            model.fit,
            simulate_null(model.fit, rng, memory=model.memory, site=training.site),
            early,
            training.target_index % 2 == 0,
            model.used,
            prior_rows(model, rng),
        )

    def systems(self) -> list[DriftSystem]:
        """The drift of the fit with every set of variances of the grid."""
        return scaled_systems(self.fit, SHIFT_AND_STRETCH)

    def products(self, candidates: Sequence[Candidate], *, simulated: bool = True) -> list[Products]:
        """Products of the candidates with the measured response, freed of the model, and with every simulated one if asked for."""
        measured = self.fit.residual()[:, None]
        responses = [measured, self.draws] if simulated else [measured]
        return sum_products(self.systems(), responses, self.fit.design, by_width(candidates, self.used))

    def gains(self, candidates: Sequence[Candidate], *, simulated: bool = True) -> Gains:
        """Gain of every candidate for the measured response and, where asked for, for every simulated one."""
        return self.gains_by(self.products(candidates, simulated=simulated))

    def gains_by(self, products: Sequence[Products]) -> Gains:
        """The same from products of the candidates."""
        gains = gains_by_products(products, self.priors.beside(self.fit.coefficients))
        widths = np.empty(gains.separable.size)
        for group in products[0].groups:
            widths[group.places] = group.width
        return Gains(gains.gain - (widths - 1.0)[:, None], gains.drift_place, gains.separable)

    def confirm(self, scores: Sequence[Score], families: Families) -> list[Score]:
        """The same scores, each with its confirmation."""
        lasting = [score for score in scores if not score.is_event]
        early = [self._strongest_early(families[score.name]) for score in lasting]
        in_time = iter(self._gains_in_time(early) if early else ())
        confirmed = []
        for score in scores:
            gain = self._event_gain(families[score.name], score.drift_place) if score.is_event else next(in_time)
            confirmed.append(
                replace(score, confirmation=_judged(score, float(gain[0]), rank_p_value(gain[0], gain[1:])))
            )
        return confirmed

    def _strongest_early(self, candidates: Sequence[Candidate]) -> Candidate:
        """The candidate with the largest gain on the early readings alone."""
        system, early = self.fit.system, self.early
        cut = replace(
            system,
            seconds=system.seconds[early],
            loadings=system.loadings[early],
            variance=system.variance[early],
            observed=system.observed[early],
        )
        fit = replace(self.fit, system=cut, response=self.fit.response[early], design=self.fit.design[early])
        used = self.used.copy()
        used[self.used] = early
        gains = replace(self, fit=fit, used=used).gains(candidates, simulated=False)
        return candidates[int(np.argmax(np.where(gains.separable, gains.gain[:, 0], -np.inf)))]

    def _responses(self) -> list[Array]:
        """The measured response and every simulated one, (n, 1) and (n, draws)."""
        return [self.fit.response[:, None], self.draws]

    def _event_gain(self, candidates: Sequence[Candidate], place: int) -> Array:
        """Gain of an event with instant and size from one half of the targets on the other half, and back, (1 + draws,)."""
        system, responses, design = self.systems()[place], self._responses(), self.fit.design
        groups = by_width(candidates, self.used)
        ((one, other),) = sum_products_apart([system], responses, design, groups, self.halves)
        prior_design, prior_responses = self.priors.design, self.priors.responses(1 + self.draws.shape[1])
        normal = one.design + other.design + prior_design.T @ prior_design
        of_responses = solve(normal, one.cross + other.cross + prior_design.T @ prior_responses)
        of_events = solve(normal, one.with_design + other.with_design)
        halves = [half.freed(of_responses, of_events) for half in (one, other)]
        measured = system.whiten(np.column_stack([self.fit.response, design]))[0]
        return gain_across(halves) / (2.0 * (measured[:, 0] - measured[:, 1:] @ of_responses[:, 0]).var())

    def _gains_in_time(self, candidates: Sequence[Candidate]) -> list[Array]:
        """Gain in log-density of the later half, predicted forward from the readings before, of every candidate (1 + draws,)."""
        responses, design = self._responses(), self.fit.design
        groups = by_width(candidates, self.used)
        likelihood: list[list[Array]] = [[] for _ in range(len(candidates) + 1)]
        ahead: list[list[Array]] = [[] for _ in range(len(candidates) + 1)]
        for before, after in sum_products_apart(self.systems(), responses, design, groups, self.early):
            for k, (first, second) in enumerate(zip(before.models(), after.models(), strict=True)):
                # What is known beforehand is known before the early cycles too.
                early, whole = self.priors.add_to(first), self.priors.add_to(first.plus(second))
                likelihood[k].append(profile_likelihood(whole))
                ahead[k].append(density_ahead(early, whole, design.shape[1]))
        chosen = [
            np.take_along_axis(np.array(after), np.argmax(before, axis=0)[None, :], axis=0)[0]
            for before, after in zip(likelihood, ahead, strict=True)
        ]
        return [np.asarray(density - chosen[0]) for density in chosen[1:]]


def _judged(score: Score, gain: float, p_value: float) -> Confirmation:
    """Whether an effect passes its confirmation, or has evidence so strong that it needs none."""
    if p_value <= CONFIRMATION_LEVEL:
        return Confirmation(True, Confirmed.OTHER_TARGETS if score.is_event else Confirmed.LATER_CYCLES, gain, p_value)
    level = STRONG_LEVEL if p_value <= _CONTRADICTED else _FIVE_SIGMA
    return Confirmation(score.family_wise_p <= level, Confirmed.BY_EVIDENCE, gain, p_value)


# An event against a heteroscedastic random walk: drift whose variance is larger about that instant, as in a warm-up.

#: Half of the shortest time of faster drift, in cycles, because within less no drift can be told from a step; half of the longest, as a
#: share of the test.
_LEAST_CYCLES, _LONGEST_SHARE = 4, 0.25
#: log10 factors on the variances of the drift: within that time and throughout, and how far they are moved in a closer look.
_WITHIN, _THROUGHOUT, _CLOSER = (1.0, 2.0, 3.0, 4.0), (0.0, -1.0, -2.0), (-0.5, 0.0, 0.5)


@dataclass(frozen=True)
class HeteroscedasticInterval:
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


def refuse_in_heteroscedastic_drift(score: Score, model: ModelFit) -> Decision | None:
    """Refuse an event that is not better by odds of 20 to 1 than drift that moves faster about its instant."""
    if score.best.event_s is None:
        return None
    time = heteroscedastic_interval(model, score.best.event_s)
    advantage = score.gain - time.gain
    if advantage >= TIE_GAIN:
        return None
    evidence = {
        "start_h": time.start_s / 3600.0,
        "end_h": time.end_s / 3600.0,
        "times": 10.0 ** (time.within / 2.0),
        "drift_gain": time.gain,
        "event_gain": score.gain,
        "advantage": advantage,
        "needed": TIE_GAIN,
    }
    return Decision(score.name, Reason.HETEROSCEDASTIC_DRIFT, evidence)


def heteroscedastic_interval(model: ModelFit, instant_s: float) -> HeteroscedasticInterval:
    """Find the time about an instant in which faster drift suits the readings best."""
    fit = model.fit
    columns = np.column_stack([fit.residual(), fit.design])
    priors = prior_rows(model).beside(fit.coefficients)
    even = max(_likelihood(system, columns, priors) for system in scaled_systems(fit, SHIFT_AND_STRETCH))

    def tried(inside: NDArray[np.bool_], factors: Sequence[tuple[float, float]]) -> list[HeteroscedasticInterval]:
        """Drift with other variances throughout, and faster in some of the readings."""
        start_s, end_s = fit.system.seconds[inside][[0, -1]]
        times = []
        for within, throughout in factors:
            (system,) = scaled_systems(fit, [(throughout,)])
            faster = replace(system, process_noise_scale=np.where(inside, 10.0**within, 1.0))
            gain = _likelihood(faster, columns, priors) - even
            times.append(HeteroscedasticInterval(float(start_s), float(end_s), within, throughout, gain))
        return times

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


def _likelihood(system: DriftSystem, columns: Array, priors: PriorRows) -> float:
    """Profile log-likelihood of the first column beside the others."""
    gram, log_spread = system.normal_equations(columns)
    moments = Moments(gram[1:, 1:], gram[1:, :1], gram[:1, 0], columns.shape[0], log_spread)
    return float(profile_likelihood(priors.add_to(moments))[0])
