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
    PriorRows,
    by_width,
    density_ahead,
    gain_across,
    moments_of,
    profile_likelihood,
    solve,
    without,
)
from fusion.model.null_simulation import DRAWS, simulate_null
from fusion.model.profile_gain import profile_gains
from interferometry.drift.gls import DriftFit
from interferometry.drift.state_space import DriftSystem

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
#: Values of candidates' columns that are looked at together, 80 MB of them.
_VALUES_AT_ONCE = 10_000_000


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

    def gains(self, candidates: Sequence[Candidate], *, simulated: bool = True) -> Gains:
        """Gain of every candidate for the measured response and, where asked for, for every simulated one."""
        draws = self.draws if simulated else np.empty((self.fit.response.size, 0))
        responses, systems = np.column_stack([self.fit.response, draws]), self.systems()
        widths = np.array([candidate.columns.shape[1] for candidate in candidates])
        # Of a long test some candidates at a time: their columns are held three times while their gains are computed.
        batch = (np.cumsum(widths) * self.fit.response.size) // _VALUES_AT_ONCE
        gains = [
            profile_gains(
                systems,
                responses,
                self.fit.design,
                by_width([candidates[k] for k in np.flatnonzero(batch == one)], self.used),
                priors=self.priors,
            )
            for one in np.unique(batch)
        ]
        return Gains(
            np.concatenate([some.gain for some in gains]) - (widths - 1.0)[:, None],
            np.concatenate([some.drift_place for some in gains]),
            np.concatenate([some.separable for some in gains]),
        )

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

    def _responses(self) -> Array:
        """The measured response and every simulated one, (n, 1 + draws)."""
        return np.column_stack([self.fit.response, self.draws])

    def _event_gain(self, candidates: Sequence[Candidate], place: int) -> Array:
        """Gain of an event with instant and size from one half of the targets on the other half, and back, (1 + draws,)."""
        responses = self._responses()
        columns = np.column_stack([candidate.columns[self.used, 0] for candidate in candidates])
        whitened, _ = self.systems()[place].whiten(np.column_stack([responses, self.fit.design, columns]))
        y, x, c = np.split(whitened, [responses.shape[1], responses.shape[1] + self.fit.design.shape[1]], axis=1)
        n = c.shape[0]
        y, x = self.priors.append(y, x)
        c = np.vstack([c, np.zeros((y.shape[0] - n, c.shape[1]))])
        y, c = without(x, y)[:n], without(x, c)[:n]
        return gain_across(y, c, self.halves) / (2.0 * y[:, :1].var())

    def _gains_in_time(self, candidates: Sequence[Candidate]) -> list[Array]:
        """Gain in log-density of the later half, predicted forward from the readings before, of every candidate (1 + draws,).

        Each model has the drift that suits it best, so that an effect is not given credit for what a wandering drift can explain.
        """
        responses = self._responses()
        count, p = responses.shape[1], self.fit.design.shape[1]
        widths = [candidate.columns.shape[1] for candidate in candidates]
        ends = p + np.cumsum(widths)
        designs = [np.arange(p), *(np.r_[:p, end - width : end] for end, width in zip(ends, widths, strict=True))]
        columns = np.column_stack(
            [responses, self.fit.design, *(candidate.columns[self.used] for candidate in candidates)]
        )
        likelihood: list[list[Array]] = [[] for _ in designs]
        ahead: list[list[Array]] = [[] for _ in designs]
        for system in self.systems():
            errors, spread = system.innovations(columns)
            errors /= np.sqrt(spread)[:, None]
            y, x = errors[:, :count], errors[:, count:]
            # What is known beforehand is known before the early cycles too.
            whole = moments_of(*self.priors.append(y, x), spread)
            early = moments_of(*self.priors.append(y[self.early], x[self.early]), spread[self.early])
            for k, design in enumerate(designs):
                likelihood[k].append(profile_likelihood(whole.of(design)))
                ahead[k].append(density_ahead(early.of(design), whole.of(design), p))
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
    train = whole.observed
    priors = prior_rows(model, rng)
    null = simulate_null(fit, rng, over=replace(whole, observed=np.ones_like(train)))
    responses = np.column_stack([model.readings.response, null])
    p, count = design.shape[1], responses.shape[1]
    likelihood: dict[bool, list[Array]] = {False: [], True: []}
    error: dict[bool, list[Array]] = {False: [], True: []}
    for system in scaled_systems(fit, SHIFT_AND_STRETCH, over=whole):
        errors, spread = system.innovations(np.column_stack([responses, design, candidate.columns]))
        root = np.sqrt(spread[train])[:, None]
        for with_candidate in (False, True):
            used = slice(count, count + p + (candidate.columns.shape[1] if with_candidate else 0))
            y, x = priors.append(errors[train, :count] / root, errors[train, used] / root)
            beta = solve(x.T @ x, x.T @ y)
            variance = ((y - x @ beta) ** 2).mean(axis=0)
            likelihood[with_candidate].append(-0.5 * (y.shape[0] * np.log(variance) + np.log(spread[train]).sum()))
            error[with_candidate].append(((errors[~train, :count] - errors[~train, used] @ beta) ** 2).mean(axis=0))
    before, after = (
        np.sqrt(np.take_along_axis(np.array(error[key]), np.argmax(likelihood[key], axis=0)[None, :], axis=0)[0])
        for key in (False, True)
    )
    return float(before[0]), float(after[0]), float((1 + (after[1:] <= after[0]).sum()) / after.size)
