"""A model of the drift: static profile, named terms, and the unexplained drift, fitted to readings.

Terms that depend on more than the readings: on the model's other coefficients, or on fields that have been put right since.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from fusion.analysis.alignment.readings import Readings
from fusion.analysis.effects.effect import Candidate, Effect, Prior
from fusion.common import Array
from interferometry.drift.gls import (
    NO_MEMORY,
    Autoregression,
    DriftFit,
    estimate,
    fit_fixed_effects,
    log_likelihoods,
    memory_of_each,
)
from interferometry.drift.kalman import DriftModelError, DriftSystem, Order

# How much drift there may be: the grids of drift variances over which a likelihood is maximised or drawn from.

#: log10 factors on the variances of a common drift and, below, of a stretch: as estimated, less of one or both, more of one or both.
_SHIFT = (0.0, -1.0, -2.5, 0.0, 0.0, -1.0, -2.5, -6.0, 0.5, 1.0, 0.0, 1.0)
_STRETCH = (0.0, 0.0, 0.0, -1.0, -2.5, -1.0, -2.5, -6.0, 0.5, 0.0, 1.0, 1.0)
SHIFT_AND_STRETCH = tuple(zip(_SHIFT, _STRETCH, strict=True))
#: The same for the single drift of a channel.
SINGLE = ((-6.0,), (-2.5,), (-1.0,), (0.0,), (0.5,), (1.0,))
#: log10 factors among which the variances of simulated data are drawn.
_PLAUSIBLE = np.array([-2.0, -1.0, -0.5, 0.0, 0.5, 1.0])


def scaled_systems(fit: DriftFit, exponents: Sequence[Sequence[float]]) -> list[DriftSystem]:
    """Scale the estimated drift variances of a fit by every set of factors of a grid."""
    centre = np.maximum(fit.system.ratios, least_ratio(fit.system))
    return [replace(fit.system, ratios=centre * np.resize(10.0 ** np.asarray(one), centre.size)) for one in exponents]


def least_ratio(system: DriftSystem) -> float:
    """Variance ratio of a drift that can hardly be told from none."""
    span = float(system.seconds[-1] - system.seconds[0])
    return 0.0625 / span if system.order == 1 else 3.0 * 0.0625 / span**3


def plausible_ratios(fit: DriftFit, rng: np.random.Generator, *, draws: int) -> Array:
    """Draw drift variances that the readings leave possible, in proportion to their restricted likelihood."""
    centre = np.maximum(fit.system.ratios, least_ratio(fit.system))
    components = centre.size
    exponents = np.stack(np.meshgrid(*[_PLAUSIBLE] * components, indexing="ij"), axis=-1).reshape(-1, components)
    tried = centre * 10.0**exponents
    likelihood = log_likelihoods(fit, tried)
    weight = np.exp(likelihood - likelihood.max())
    return tried[rng.choice(weight.size, size=draws, p=weight / weight.sum())]


#: Fewest cycles over which a growth of the noise is looked for, and standard errors of its logarithm by which it must be known.
_FEWEST_CYCLES, _LEAST_GROWTH = 10, 4.0
#: Latest readings of a site whose noise those have that were not used.
_LATEST_READINGS = 5
#: The scatter of a site is trusted like this many further readings with the scatter of all sites.
_SHRINKAGE_READINGS = 20


@dataclass(frozen=True)
class Term:
    """One effect of the model with the candidate that was chosen."""

    effect: str
    candidate: Candidate

    @property
    def width(self) -> int:
        """Number of coefficients."""
        return self.candidate.columns.shape[1]


def place_of(terms: Sequence[Term], term: Term, start: int = 0) -> slice:
    """Where the columns of a term stand among those of all terms."""
    for other in terms:
        if other is term:
            return slice(start, start + term.width)
        start += other.width
    raise KeyError(term.effect)


@dataclass(frozen=True)
class ModelFit:
    """A model fitted to a part of the readings.

    Attributes
    ----------
    readings : all readings
    used : (n,) readings that the fit was made from
    terms : the named effects
    fit : the generalised least-squares fit to the used readings
    profile : (n, k) static columns that the used readings determine
    memory : of the noise of every site over the cycles
    outlying : relative variances (n_used,) of readings far from the others, 1 for the rest
    """

    readings: Readings
    used: NDArray[np.bool_]
    terms: tuple[Term, ...]
    fit: DriftFit
    profile: Array
    memory: Autoregression = NO_MEMORY
    outlying: Array = field(default_factory=lambda: np.ones(1))

    def place(self, term: Term) -> slice:
        """Where the coefficients of a term stand in the fit."""
        return place_of(self.terms, term, self.profile.shape[1])

    def static(self) -> Array:
        """The coefficients as combinations (p, p) of those of the fit: one that something is known of beforehand is that of a machine which
        has settled, the share of its lagged copies included.
        """
        combined = np.eye(self.fit.coefficients.size)
        lags = [term for term in self.terms if term.effect == "thermal_lag"]
        for term in self.terms:
            for lag in lags if term.candidate.prior is not None else ():
                alike = [unit == term.candidate.units[0] for unit in lag.candidate.units]
                combined[self.place(lag), self.place(term).start] = alike
        return combined

    def priors(self) -> list[tuple[Array, Prior]]:
        """Combinations (p,) of coefficients that something is known of beforehand, and what."""
        known = [(self.static()[:, self.place(term).start], term.candidate.prior) for term in self.terms]
        return [(combination, prior) for combination, prior in known if prior is not None]

    def size(self, term: Term) -> float:
        """Half the square of what a term explains beside the static profile, in units of the noise, as the drift leaves it visible."""
        own = term.candidate.columns[self.used] @ self.fit.coefficients[self.place(term)]
        whitened, _ = self.fit.system.whiten(np.column_stack([own, self.profile[self.used]]))
        return 0.5 * residual_squares(whitened[:, 0], whitened[:, 1:]) / self.fit.sigma**2

    def coefficients(self) -> dict[str, float]:
        """First coefficient of every term by effect name; the first term counts where an effect enters twice."""
        first: dict[str, float] = {}
        for term in self.terms:
            first.setdefault(term.effect, float(self.fit.coefficients[self.place(term)][0]))
        return first

    def series(self, term: Term) -> tuple[Array, Array]:
        """Predicted contribution of a term to every reading, um, and its standard uncertainty (n,), (n,)."""
        place = self.place(term)
        columns = term.candidate.columns
        covariance = self.fit.covariance[place, place]
        return columns @ self.fit.coefficients[place], np.sqrt(np.einsum("ni,ij,nj->n", columns, covariance, columns))

    def whole_design(self) -> Array:
        """Columns of the fit for all readings, (n, p)."""
        return self.design_of(self.terms)

    def design_of(self, terms: Sequence[Term]) -> Array:
        """Columns for all readings of the profile, of some terms, and of the drift's rates where it has them, (n, p)."""
        design = np.column_stack([self.profile, *(term.candidate.columns for term in terms)])
        if self.fit.system.order == 1:
            return design
        hours = (self.readings.seconds / 3600.0)[:, None]
        return np.column_stack([design, self.readings.loadings * hours])

    def whole_system(self) -> DriftSystem:
        """All readings under the fitted drift, those that were used marked as observed."""
        site, own, variance = self.readings.site, self.fit.system.variance, np.ones(self.used.size)
        for number in np.unique(site[self.used]):
            # Noise goes on as it was at the end; the median passes over outliers.
            variance[site == number] = np.median(own[site[self.used] == number][-_LATEST_READINGS:])
        variance[self.used] = own
        return DriftSystem(
            self.readings.seconds,
            self.readings.loadings,
            self.fit.system.order,
            self.fit.system.ratios,
            variance,
            self.used,
            memory=self.fit.system.memory,
        )

    def open_loop_errors(self) -> tuple[Array, Array]:
        """Errors of predicting the readings that were not used, um, and the predicted standard deviation, both (n_unused,)."""
        seen = self.whole_system()
        design = self.whole_design()
        errors, spread = seen.innovations(np.column_stack([self.readings.response, design]))
        through = errors[:, 1:]
        missed = errors[:, 0] - through @ self.fit.coefficients
        own = np.einsum("ni,ij,nj->n", through, self.fit.covariance, through)
        site = self.readings.site
        missed = np.where(np.isin(site, np.unique(site[self.used])), missed, np.nan)
        return missed[~self.used], np.sqrt(self.fit.sigma**2 * spread + own)[~self.used]


def fit_model(
    readings: Readings, terms: Sequence[Term], *, used: NDArray[np.bool_] | None = None, order: Order | None = None
) -> ModelFit:
    """Fit static profile, terms and drift by restricted maximum likelihood and generalised least squares; the order of the drift is that
    of the larger likelihood where none is given.
    """
    used = np.ones(readings.seconds.size, bool) if used is None else used
    profile = readings.profile
    profile = profile[:, _determined(profile[used])]
    design = np.column_stack([profile, *(term.candidate.columns for term in terms)])[used]
    seconds, loadings, response = readings.seconds[used], readings.loadings[used], readings.response[used]
    first = estimate(seconds, loadings, response, design, order=order, robust=True)
    of_used = readings.subset(used)
    variance = _site_variance(of_used, first) * _growth(of_used, first) * first.system.variance
    fit = estimate(
        seconds,
        loadings,
        response,
        design,
        order=first.system.order,
        memory=True,
        start=first.system.ratios,
        variance=variance,
    )
    _, _, noise = readings.subset(used).by_site(np.clip(fit.white_noise(), -4.0, 4.0))
    memory = memory_of_each(np.nan_to_num(noise).T)
    # Coefficients of slow columns are means over many cycles, which noise with a memory makes less certain.
    fit = replace(fit, covariance=fit.covariance * max(memory.long_run, 1.0))
    model = ModelFit(readings, used, tuple(terms), fit, profile, memory, first.system.variance)
    for combination, prior in model.priors():
        fit = condition(fit, combination, prior)
    return replace(model, fit=fit)


def unexplained_drift(fit: DriftFit) -> tuple[Array, Array]:
    """Drift that no static profile and no effect of the model could make."""
    loadings, named = fit.system.loadings, fit.design
    drift = fit.smoothed.levels[:, :, 0] * loadings
    if fit.system.order == 2:
        components = loadings.shape[1]
        named, rates = fit.design[:, :-components], fit.design[:, -components:]
        drift = drift + rates * fit.coefficients[-components:]
    q, _ = np.linalg.qr(named)
    return np.asarray(drift - q @ (q.T @ drift)), np.asarray(q)


def wandering_um(fit: DriftFit) -> float:
    """Root mean square of the random drift beside everything that the model names, um."""
    drift, _ = unexplained_drift(fit)
    return float(np.sqrt(np.mean(drift.sum(axis=1) ** 2)))


def condition(fit: DriftFit, combination: Array, prior: Prior) -> DriftFit:
    """Observe one combination (p,) of coefficients once more, as its prior says; the variances are kept."""
    along = fit.covariance @ combination
    gain = along / (combination @ along + prior.u**2)
    return replace(
        fit,
        coefficients=fit.coefficients + gain * (prior.mean - combination @ fit.coefficients),
        covariance=fit.covariance - np.outer(gain, along),
    )


def refit_fixed(model: ModelFit, terms: Sequence[Term]) -> DriftFit:
    """Fit another set of terms with the drift's variances kept, for comparing likelihoods of nested models."""
    return fit_fixed_effects(replace(model.fit.system), model.fit.response, model.design_of(terms)[model.used])


def _determined(columns: Array) -> NDArray[np.bool_]:
    """Columns that are not constant zero and, for reversals, not equal to half their target's column."""
    present = np.abs(columns).max(axis=0, initial=0.0) > 0.0
    kept = np.zeros(columns.shape[1], bool)
    seen: set[bytes] = set()
    for k in np.flatnonzero(present):
        # A zero times a negative sign is a negative zero, whose bytes differ: adding zero makes it positive.
        key = (columns[:, k] / columns[np.argmax(np.abs(columns[:, k])), k] + 0.0).tobytes()
        kept[k] = key not in seen
        seen.add(key)
    return kept


def _site_variance(readings: Readings, fit: DriftFit) -> Array:
    """Relative variance of each reading from the scatter of its site (target and direction), (n,), mean 1."""
    noise, share = fit.noise()
    # Readings that were given a larger variance as outliers tell nothing about their site's ordinary scatter.
    ordinary = fit.system.variance == 1.0
    site = readings.site
    relative = np.ones(noise.size)
    for number in np.unique(site):
        here = (site == number) & ordinary
        squares = float((noise[here] ** 2).sum()) / fit.sigma**2 + _SHRINKAGE_READINGS
        relative[site == number] = squares / (float(share[here].sum()) + _SHRINKAGE_READINGS)
    return relative / np.mean(relative)


def _growth(readings: Readings, fit: DriftFit) -> Array:
    """Relative variance of each reading from noise that grows or falls over the test, (n,), mean 1; ones where none is significant."""
    noise, share = fit.noise()
    ordinary = fit.system.variance == 1.0
    if np.unique(readings.cycle[ordinary]).size < _FEWEST_CYCLES:
        return np.ones(noise.size)
    squares = (noise / fit.sigma) ** 2
    slope, variance, middle = noise_growth(readings.cycle[ordinary], squares[ordinary], share[ordinary])
    if abs(slope) < _LEAST_GROWTH * np.sqrt(variance):
        return np.ones(noise.size)
    relative = np.exp(slope * (readings.cycle - middle))
    return np.asarray(relative / relative.mean())


def noise_growth(cycle: NDArray[np.int64], squares: Array, share: Array) -> tuple[float, float, float]:
    """Slope per cycle of the logarithm of the noise's variance, from the squares of its readings (n,) and the share of it that each shows,
    with the variance of that slope and the middle of the cycles.
    """
    cycles, place = np.unique(cycle, return_inverse=True)
    of_cycle, expected = (np.bincount(place, each) for each in (squares, share))
    middle = float(cycles.mean())
    logarithm = np.log(np.maximum(of_cycle, 1e-12) / expected)
    (slope, _), covariance = np.polyfit(cycles - middle, logarithm, 1, cov=True)
    return float(slope), float(covariance[0, 0]), middle


#: How often errors of the camera and the declared coefficients are sized in turn.
_SETTLING_ROUNDS = 2


def size_camera_errors(model: ModelFit, effects: Mapping[str, Effect]) -> ModelFit:
    """Size errors of the camera by the coefficients that hold beside them."""
    of_camera = {term.effect for term in model.terms if term.effect in effects and effects[term.effect].errs_camera}
    for _ in range(_SETTLING_ROUNDS if of_camera else 0):
        terms = [
            recompute_term(term, model.readings, model.coefficients(), effects) if term.effect in of_camera else term
            for term in model.terms
        ]
        model = fit_model(model.readings, terms, used=model.used)
    return model


def recompute_term(
    term: Term, readings: Readings, coefficients: Mapping[str, float], effects: Mapping[str, Effect]
) -> Term:
    """Compute a term's columns again for the same parameters."""
    near = term.candidate if term.candidate.parameters else None
    offered = effects[term.effect].candidates(readings, coefficients, near)
    same = (candidate for candidate in offered if _same_parameters(candidate.parameters, term.candidate.parameters))
    candidate = next(same, term.candidate)
    return Term(term.effect, replace(candidate, prior=term.candidate.prior))


def _same_parameters(one: Mapping[str, float | str], other: Mapping[str, float | str]) -> bool:
    return one.keys() == other.keys() and all(
        one[name] == value if isinstance(value, str) else np.isclose(float(one[name]), float(value), rtol=1e-9)
        for name, value in other.items()
    )


# How far coefficients move when a target or a part of the test is left out: what a fit's own uncertainty cannot know.

#: Parts of the test of equal numbers of cycles: each long enough for a load to switch, and enough of them for a variance.
PARTS = 6


def coefficient_spread(model: ModelFit) -> Array:
    """Standard deviation of every coefficient by the delete-a-group jackknife, the larger of that over targets and that over parts of the
    test, which both hold the noise; of one that something is known of beforehand with the share of its lagged copies.
    """
    readings = model.readings.subset(model.used)
    cycles = np.unique(readings.cycle)
    part = np.searchsorted(cycles, readings.cycle) * PARTS // cycles.size
    return np.maximum(_jackknife(model, readings.target_index), _jackknife(model, part))


def _jackknife(model: ModelFit, group: NDArray[np.int64]) -> Array:
    values = np.array([_without(model, group == number) for number in np.unique(group)])
    static = model.static() != 0.0
    for place in np.flatnonzero(static.sum(axis=0) > 1):
        values[:, place] = values[:, static[:, place]].sum(axis=1)
    count = values.shape[0]
    spread = np.sqrt((count - 1.0) ** 2 / count * values.var(axis=0, ddof=1))
    spread[np.isnan(values).any(axis=0)] = np.inf
    spread[: model.profile.shape[1]] = np.nan
    return spread


def _without(model: ModelFit, left_out: NDArray[np.bool_]) -> Array:
    """Coefficients (p,) from the other readings; NaN for those that they do not determine."""
    fit = model.fit
    kept = (fit.design[~left_out] != 0.0).any(axis=0)
    coefficients = np.full(kept.size, np.nan)
    try:
        rest = fit_fixed_effects(
            replace(fit.system, observed=fit.system.observed & ~left_out), fit.response, fit.design[:, kept]
        )
    except DriftModelError:
        return coefficients
    coefficients[kept] = rest.coefficients
    return coefficients


# What columns explain of responses: by products of columns, beside priors, and block by block in time.

_RIDGE = 1e-9
#: Singular value, relative to the largest, below which a direction of scaled columns counts as given by the others.
_INDEPENDENT = 1e-3


def gain_across(halves: Sequence[tuple[Array, Array]]) -> Array:
    """Gain of an event whose instant and size come from one half of the targets, on the other half, and back."""
    gain = np.zeros(halves[0][0].shape[1])
    for (moment, squares), (along, tested) in (halves, halves[::-1]):
        energy = np.maximum(squares, 1e-12)
        chosen = np.argmax(moment**2 / energy[:, None], axis=0)
        size = np.take_along_axis(moment, chosen[None, :], axis=0)[0] / energy[chosen]
        gain += 2.0 * size * np.take_along_axis(along, chosen[None, :], axis=0)[0] - size**2 * tested[chosen]
    return gain


def residual_squares(y: Array, x: Array) -> float:
    """Residual sum of squares beside columns that may depend on each other."""
    scale = np.maximum(np.linalg.norm(x, axis=0), 1e-12)
    u, s, _ = np.linalg.svd(x / scale, full_matrices=False)
    u = u[:, s > _INDEPENDENT * s[0]]
    left = y - u @ (u.T @ y)
    return float(left @ left)


def solve(normal: Array, moment: Array) -> Array:
    """Solve normal equations for several responses; a small ridge keeps columns that a part of the readings lacks at zero."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-24))
    scaled = normal / np.outer(scale, scale) + _RIDGE * np.eye(scale.size)
    return np.asarray(np.linalg.solve(scaled, moment / scale[:, None]) / scale[:, None])


@dataclass(frozen=True)
class PriorRows:
    """Priors of a model's coefficients as further whitened readings without drift: rows of the design (k, p), prior means (k,) in units of
    the noise, and the same for simulated responses (k, draws).
    """

    design: Array
    response: Array
    draws: Array

    def responses(self, count: int) -> Array:
        """Prior means for the first so many responses, the measured one first, (k, count)."""
        return np.column_stack([self.response, self.draws])[:, :count]

    def beside(self, coefficients: Array) -> PriorRows:
        """The same for the measured response without what these coefficients of the design make of it."""
        return replace(self, response=self.response - self.design @ coefficients)

    def append(self, y: Array, x: Array) -> tuple[Array, Array]:
        """Whitened responses (n + k, r) and design (n + k, p + q); columns beyond the model's are zero in the priors' rows."""
        design = np.zeros((self.response.size, x.shape[1]))
        design[:, : self.design.shape[1]] = self.design
        return np.vstack([y, self.responses(y.shape[1])]), np.vstack([x, design])

    def add_to(self, moments: Moments) -> Moments:
        """Products over some readings and these rows."""
        y, x = self.append(np.empty((0, moments.squares.size)), np.empty((0, moments.design.shape[0])))
        return moments.plus(moments_of(y, x, np.empty(0)))


@dataclass(frozen=True)
class Moments:
    """Products of whitened columns over some readings.

    Attributes
    ----------
    design : (p, p) of the design with itself
    cross : (p, r) of the design with the responses
    squares : (r,) of each response with itself
    readings : number of readings
    log_spread : sum of the logarithms of the innovation variances
    """

    design: Array
    cross: Array
    squares: Array
    readings: int
    log_spread: float

    def first(self, columns: int) -> Moments:
        """The same for the design's first columns alone."""
        return replace(self, design=self.design[:columns, :columns], cross=self.cross[:columns])

    def plus(self, other: Moments) -> Moments:
        """Products over these readings and others."""
        return Moments(
            self.design + other.design,
            self.cross + other.cross,
            self.squares + other.squares,
            self.readings + other.readings,
            self.log_spread + other.log_spread,
        )


def moments_of(y: Array, x: Array, spread: Array) -> Moments:
    """Sum products of responses and design, so that models of some of the columns need not do it again."""
    return Moments(x.T @ x, x.T @ y, (y**2).sum(axis=0), y.shape[0], float(np.log(spread).sum()))


def profile_likelihood(all_of: Moments) -> Array:
    """Log-likelihood under the coefficients and the noise that suit the readings best."""
    left = all_of.squares - (all_of.cross * solve(all_of.design, all_of.cross)).sum(axis=0)
    return np.asarray(-0.5 * (all_of.readings * np.log(left / all_of.readings) + all_of.log_spread))


def density_ahead(early: Moments, all_of: Moments, flat: int) -> Array:
    """Log-density of later readings, predicted from the early ones."""
    prior = np.zeros_like(all_of.design)
    if flat < all_of.design.shape[0]:
        base, cross = all_of.design[:flat, :flat], all_of.design[:flat, flat:]
        own = all_of.design[flat:, flat:] - cross.T @ solve(base, cross)
        prior[flat:, flat:] = own / all_of.readings
    return _evidence(all_of, prior, flat) - _evidence(early, prior, flat)


def _evidence(moments: Moments, prior: Array, flat: int) -> Array:
    """Log-density of the readings with coefficients and noise integrated out, up to a constant of the prior (r,)."""
    normal = moments.design + prior
    left = moments.squares - (moments.cross * solve(normal, moments.cross)).sum(axis=0)
    freedom = moments.readings - flat
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-24))
    _, log_determinant = np.linalg.slogdet(normal / np.outer(scale, scale) + _RIDGE * np.eye(scale.size))
    log_determinant += 2.0 * float(np.log(scale).sum())
    return np.asarray(
        scipy.special.gammaln(0.5 * freedom)
        - 0.5 * (freedom * np.log(np.pi * left) + log_determinant + moments.log_spread)
    )
