"""Confirmation of an effect on readings that its coefficients were not fitted to, and the one question to the hold-out set.

An effect that lasts is confirmed in time: the later half of the cycles is predicted forward from the earlier half. An event cannot be: its
instant and size come from one half of the targets and are tested on the other. Equations: docs/method/closed-loop.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.effects.effect import Candidate
from fusion.loop.scoring import Families, Gains
from fusion.loop.state import Confirmation, Confirmed, Score
from fusion.model.drift_variances import SHIFT_AND_STRETCH, scaled_systems
from fusion.model.fit import ModelFit
from fusion.model.least_squares import (
    Moments,
    PriorRows,
    density_ahead,
    gain_across,
    profile_likelihood,
    solve,
)
from fusion.model.null_simulation import DRAWS, simulate_null
from fusion.model.products import Products, by_width, sum_products, sum_products_apart
from fusion.model.profile_gain import gains_by_products
from interferometry.drift.gls import DriftFit
from interferometry.drift.state_space import DriftSystem
from thermography.fields.tasks.pieces import in_pieces
from thermography.fields.tasks.spool import empty_arrays, give_back

#: Probability that an effect which is absent passes its confirmation; the multiplicity of the search is accounted for before.
CONFIRMATION_LEVEL = 0.1
#: Evidence so strong that an inconclusive confirmation does not stop it: few switchings of a load leave early blocks undecided.
STRONG_LEVEL = 0.001
#: A confirmation with a larger p-value is not inconclusive, it speaks against the effect: half of the campaigns without it gain as much.
#: Then the evidence must be that of five standard deviations.
_CONTRADICTED = 0.5
_FIVE_SIGMA = 2.9e-7
#: Share of the cycles from which the later ones are predicted.
_EARLY_SHARE = 0.5
#: Values of simulated campaigns that are filtered together, 8 MB.
_VALUES_AT_ONCE = 2**20


def prior_rows(model: ModelFit, rng: np.random.Generator, *, draws: int = DRAWS) -> PriorRows:
    """Priors of a model's coefficients in units of the noise; in a simulated response the coefficient is zero and its prior off by chance.

    Parameters
    ----------
    model : the fitted model
    rng : source of random numbers
    draws : number of simulated responses
    """
    priors = model.priors()
    design = np.zeros((len(priors), model.fit.design.shape[1]))
    response = np.zeros(len(priors))
    for row, (place, prior) in enumerate(priors):
        design[row, place] = model.fit.sigma / prior.u
        response[row] = model.fit.sigma * prior.mean / prior.u
    return PriorRows(design, response, model.fit.sigma * rng.standard_normal((len(priors), draws)))


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
            simulate_null(model.fit, rng),
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
        """The same scores, each with its confirmation.

        Which candidate of an effect is confirmed is decided without the readings it is tested on, or its p-value would be too small.
        """
        lasting = [score for score in scores if not score.is_event]
        early = [self._strongest_early(families[score.name]) for score in lasting]
        in_time = iter(self._gains_in_time(early) if early else ())
        confirmed = []
        for score in scores:
            gain = self._event_gain(families[score.name], score.drift_place) if score.is_event else next(in_time)
            p_value = float((1 + (gain[1:] >= gain[0]).sum()) / gain.size)
            confirmed.append(replace(score, confirmation=_judged(score, float(gain[0]), p_value)))
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
        """Gain in log-density of the later half, predicted forward from the readings before, of every candidate (1 + draws,).

        Each model has the drift that suits it best, so that an effect is not given credit for what a wandering drift can explain.
        """
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


def ask_hold_out(model: ModelFit, candidate: Candidate, rng: np.random.Generator) -> tuple[float, float, float]:
    """Put one candidate to the hold-out readings, predicted in open loop.

    Parameters
    ----------
    model : without the candidate, fitted to the training readings
    candidate : with columns for all readings
    rng : source of random numbers

    Returns
    -------
    before, after : hold-out errors without and with the candidate, root mean square, um
    p_value : probability of so small an error after it where the candidate is absent and the model's own drift is all that happens.
        Coefficients, noise and drift come from the training readings alone.
    """
    fit, whole, design = model.fit, model.whole_system(), model.whole_design()
    priors = prior_rows(model, rng)
    null = simulate_null(fit, rng, over=replace(whole, observed=np.ones_like(whole.observed)))
    columns = np.column_stack([design, candidate.columns])
    responses = _in_parts(null, 1 + null.size // _VALUES_AT_ONCE)
    del null
    responses[0] = np.column_stack([model.readings.response, responses[0]])
    likelihood: dict[bool, list[Array]] = {False: [], True: []}
    error: dict[bool, list[Array]] = {False: [], True: []}
    for system in scaled_systems(fit, SHIFT_AND_STRETCH, over=whole):
        seen, x, ahead = _open_loop(system, columns, responses)
        seen = priors.add_to(seen)
        for with_candidate in (False, True):
            moments = seen if with_candidate else seen.first(design.shape[1])
            beta = solve(moments.design, moments.cross)
            likelihood[with_candidate].append(profile_likelihood(moments))
            each = np.split(beta, np.cumsum([some.shape[1] for some in ahead])[:-1], axis=1)
            error[with_candidate].append(
                np.concatenate(
                    [((y - x[:, : beta.shape[0]] @ own) ** 2).mean(axis=0) for y, own in zip(ahead, each, strict=True)]
                )
            )
    before, after = (
        np.sqrt(np.take_along_axis(np.array(error[key]), np.argmax(likelihood[key], axis=0)[None, :], axis=0)[0])
        for key in (False, True)
    )
    return float(before[0]), float(after[0]), float((1 + (after[1:] <= after[0]).sum()) / after.size)


def _in_parts(responses: Array, count: int) -> list[Array]:
    """Responses (n, r) in matrices of some columns each, so that one of them is read without the others."""
    if count == 1:
        return [responses]
    columns = np.array_split(responses, count, axis=1)
    parts = empty_arrays([some.shape for some in columns], float)
    for part, some in zip(parts, columns, strict=True):
        for rows, values in in_pieces(some):
            part[rows] = values
        give_back(part)
    return parts


def _open_loop(system: DriftSystem, design: Array, responses: Sequence[Array]) -> tuple[Moments, Array, list[Array]]:
    """Products over the observed readings, and prediction errors of the others: of the design (m, p) and of all responses (m, some).

    Responses come in matrices (n, some) that are filtered one after another.
    """
    train = system.observed
    errors, spread = system.innovations(design)
    x, roots = errors[train], np.sqrt(spread[train])[:, None]
    x /= roots
    cross, squares, ahead = [], [], []
    for some in responses:
        y, _ = system.innovations(some)
        ahead.append(y[~train])
        seen = y[train]
        seen /= roots
        cross.append(x.T @ seen)
        squares.append((seen**2).sum(axis=0))
        give_back(some)
    log_spread = float(np.log(spread[train]).sum())
    moments = Moments(x.T @ x, np.hstack(cross), np.concatenate(squares), x.shape[0], log_spread)
    return moments, errors[~train], ahead
