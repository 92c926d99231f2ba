"""A model of the drift: static profile, named terms, and the unexplained drift, fitted to readings.

Terms that depend on more than the readings: on the model's other coefficients, or on fields that have been put right since.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.alignment.readings import Readings
from fusion.effects.effect import Candidate, Effect, Prior
from interferometry.drift.gls import DriftFit, estimate, fit_fixed_effects
from interferometry.drift.state_space import DriftSystem

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
    """Where the columns of a term stand among those of all terms.

    Parameters
    ----------
    terms : of a model, in order
    term : one of them
    start : place of the first column of the first term

    Raises
    ------
    KeyError
        if the term is not among them.
    """
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
    """

    readings: Readings
    used: NDArray[np.bool_]
    terms: tuple[Term, ...]
    fit: DriftFit
    profile: Array

    def place(self, term: Term) -> slice:
        """Where the coefficients of a term stand in the fit."""
        return place_of(self.terms, term, self.profile.shape[1])

    def priors(self) -> list[tuple[int, Prior]]:
        """Places of the coefficients that something is known of beforehand, and what."""
        known = [(self.place(term).start, term.candidate.prior) for term in self.terms]
        return [(place, prior) for place, prior in known if prior is not None]

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
        columns = [self.profile, *(term.candidate.columns for term in self.terms)]
        design = np.column_stack(columns)
        if self.fit.system.order == 2:
            hours = (self.readings.seconds / 3600.0)[:, None]
            design = np.column_stack([design, self.readings.loadings * hours])
        return design

    def whole_system(self) -> DriftSystem:
        """All readings under the fitted drift, those that were used marked as observed."""
        variance = np.ones(self.used.size)
        variance[self.used] = self.fit.system.variance
        return DriftSystem(
            self.readings.seconds,
            self.readings.loadings,
            self.fit.system.order,
            self.fit.system.ratios,
            variance,
            self.used,
        )

    def open_loop_errors(self) -> tuple[Array, Array]:
        """Errors of predicting the readings that were not used, um, and the predicted standard deviation, both (n_unused,).

        Coefficients are frozen; the drift keeps the value it had at the last used reading. Readings of a site that the fit has
        never seen are NaN.
        """
        seen = self.whole_system()
        design = self.whole_design()
        errors, spread = seen.innovations(np.column_stack([self.readings.response, design]))
        through = errors[:, 1:]
        missed = errors[:, 0] - through @ self.fit.coefficients
        own = np.einsum("ni,ij,nj->n", through, self.fit.covariance, through)
        missed = np.where(self._known_site(), missed, np.nan)
        return missed[~self.used], np.sqrt(self.fit.sigma**2 * spread + own)[~self.used]

    def _known_site(self) -> NDArray[np.bool_]:
        site = self.readings.site
        return np.isin(site, np.unique(site[self.used]))


def fit_model(
    readings: Readings,
    terms: Sequence[Term],
    *,
    used: NDArray[np.bool_] | None = None,
) -> ModelFit:
    """Fit static profile, terms and drift by restricted maximum likelihood and generalised least squares.

    Parameters
    ----------
    readings : n readings
    terms : effects with columns for all readings
    used : (n,) True for the readings of the fit; all by default

    Returns
    -------
    ModelFit
        Readings far from the others are down-weighted, and each site is weighted by its own scatter. A prior enters as one more observation
        of its coefficient. Equations: docs/method/drift-estimation.md.
    """
    used = np.ones(readings.seconds.size, bool) if used is None else used
    profile = readings.profile
    profile = profile[:, _determined(profile[used])]
    design = np.column_stack([profile, *(term.candidate.columns for term in terms)])[used]
    seconds, loadings, response = readings.seconds[used], readings.loadings[used], readings.response[used]
    first = estimate(seconds, loadings, response, design, robust=True)
    variance = _site_variance(readings.subset(used), first) * first.system.variance
    fit = estimate(
        seconds, loadings, response, design, order=first.system.order, start=first.system.ratios, variance=variance
    )
    model = ModelFit(readings, used, tuple(terms), fit, profile)
    for place, prior in model.priors():
        fit = condition(fit, place, prior)
    return replace(model, fit=fit)


def unexplained_drift(fit: DriftFit) -> tuple[Array, Array]:
    """Drift that no static profile and no effect of the model could make.

    A drift that wanders smoothly, its start rate and a slowly growing effect can stand in for one another, so their single sizes are
    badly determined; what is left of the drift beside profile and effects is not.

    Parameters
    ----------
    fit : of n readings

    Returns
    -------
    drift : (n, components) ndarray, um
        Of each component at every reading.
    basis : (n, k) ndarray
        Orthonormal basis of profile and effects.
    """
    levels, _ = fit.drift()
    loadings = fit.system.loadings
    named = fit.design
    drift = levels * loadings
    if fit.system.order == 2:
        components = loadings.shape[1]
        named, rates = fit.design[:, :-components], fit.design[:, -components:]
        drift = drift + rates * fit.coefficients[-components:]
    q, _ = np.linalg.qr(named)
    return np.asarray(drift - q @ (q.T @ drift)), np.asarray(q)


def condition(fit: DriftFit, place: int, prior: Prior) -> DriftFit:
    """Observe one coefficient once more, as its prior says; the variances are kept.

    Parameters
    ----------
    fit : before
    place : of the coefficient
    prior : its mean and standard uncertainty
    """
    gain = fit.covariance[:, place] / (fit.covariance[place, place] + prior.u**2)
    return replace(
        fit,
        coefficients=fit.coefficients + gain * (prior.mean - fit.coefficients[place]),
        covariance=fit.covariance - np.outer(gain, fit.covariance[place]),
    )


def refit_fixed(model: ModelFit, terms: Sequence[Term]) -> DriftFit:
    """Fit another set of terms with the drift's variances kept, for comparing likelihoods of nested models.

    Parameters
    ----------
    model : whose drift is kept
    terms : with columns for all readings
    """
    design = np.column_stack([model.profile, *(term.candidate.columns for term in terms)])[model.used]
    if model.fit.system.order == 2:
        hours = (model.readings.seconds[model.used] / 3600.0)[:, None]
        design = np.column_stack([design, model.readings.loadings[model.used] * hours])
    return fit_fixed_effects(replace(model.fit.system), model.fit.response, design)


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


#: How often errors of the camera and the declared coefficients are sized in turn.
_SETTLING_ROUNDS = 2


def settled(model: ModelFit, effects: Mapping[str, Effect]) -> ModelFit:
    """Size errors of the camera by the coefficients that hold beside them.

    While such an error was unknown it bent the declared coefficients, by which it is weighed.

    Parameters
    ----------
    model : as found
    effects : the library by name

    Returns
    -------
    ModelFit
        The same model where no term is an error of the camera.
    """
    camera_errors = {name for name, effect in effects.items() if effect.errs_camera}
    if not any(term.effect in camera_errors for term in model.terms):
        return model
    for _ in range(_SETTLING_ROUNDS):
        known = model.coefficients()
        terms = [
            again(term, model.readings, known, effects) if term.effect in camera_errors else term
            for term in model.terms
        ]
        model = fit_model(model.readings, terms, used=model.used)
    return model


def again(term: Term, readings: Readings, coefficients: Mapping[str, float], effects: Mapping[str, Effect]) -> Term:
    """Compute a term's columns anew for the same parameters.

    Parameters
    ----------
    term : with the parameters
    readings : perhaps beside corrected fields
    coefficients : of the current model by effect
    effects : the library by name

    Returns
    -------
    Term
        The term itself where the effect does not offer these parameters any more.
    """
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
