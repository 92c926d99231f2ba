"""How much a candidate explains, against what the search would find where nothing is missing.

Every candidate is judged by its gain in profile log-likelihood under a drift that is free to explain the same thing: the drift's
variances are re-chosen for each candidate from a grid around their estimate, because a drift fitted without the candidate has
already swallowed part of it (statistics study, section 1.5). The same gains are computed for simulated campaigns in which only the
current model and its drift act, with noise drawn from the residuals; from them come the p-values, corrected for the whole search.

How well the nonlinear parameters of an effect are known: time constants, periods, instants, and the state that it follows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.effects.candidates import Candidate
from fusion.model.fit import ModelFit
from fusion.model.least_squares import (
    by_width,
    density_ahead,
    gain_across,
    moments_of,
    profile_likelihood,
    reductions,
    solve,
    without,
)
from fusion.model.null_simulation import (
    DRAWS,
    critical_gain,
    least_ratio,
    sidak,
    sidak_level,
    simulate_null,
    tail_probability,
)
from interferometry.drift.gls import DriftFit
from interferometry.drift.state_space import DriftSystem

#: log10 factors on the two drift variances: as estimated, less drift in one or both down to none, and as much more as the simulated
#: campaigns may hold, so that a strong drift is not mistaken for an effect there.
_GRID = (
    (0.0, 0.0),
    (-1.0, 0.0),
    (-2.5, 0.0),
    (0.0, -1.0),
    (0.0, -2.5),
    (-1.0, -1.0),
    (-2.5, -2.5),
    (-6.0, -6.0),
    (0.5, 0.5),
    (1.0, 0.0),
    (0.0, 1.0),
    (1.0, 1.0),
)


@dataclass(frozen=True)
class FamilyScore:
    """What the best candidate of an effect explains.

    Attributes
    ----------
    name : the effect
    candidate : its best candidate, or None where no candidate can be told from the model
    gain : gain in log-likelihood of the best candidate
    excess : gain minus the mean gain the same search finds where nothing is missing
    p_value : chance of such a gain where nothing is missing, for this effect alone
    family_wise_p : the same for the best of all effects that were tried
    held_out_gain, held_out_p : gain on readings that were not used for the coefficients, and its chance where nothing is missing
    collinear : share of candidates that the model already contains
    drift_place : which drift of the grid suits the candidate best
    critical : gain from which on the effect enters, as far as chance is concerned
    ranges : values of the parameters that fit as well, where they were looked at closely
    """

    name: str
    candidate: Candidate | None
    gain: float
    excess: float
    p_value: float
    family_wise_p: float
    held_out_gain: float
    held_out_p: float
    collinear: float
    drift_place: int = 0
    critical: float = np.inf
    ranges: Mapping[str, Range] = field(default_factory=dict)


@dataclass(frozen=True)
class PriorRows:
    """Priors of a model's coefficients as further whitened readings, one each, without drift.

    Attributes
    ----------
    design : (k, p)
    response, draws : (k,) and (k, draws)
    """

    design: Array
    response: Array
    draws: Array

    def append(self, y: Array, x: Array) -> tuple[Array, Array]:
        """Whitened responses (n + k, r) and design (n + k, p + q); columns beyond the model's are zero in the priors' rows."""
        responses = np.column_stack([self.response, self.draws])[:, : y.shape[1]]
        design = np.zeros((self.response.size, x.shape[1]))
        design[:, : self.design.shape[1]] = self.design
        return np.vstack([y, responses]), np.vstack([x, design])


def prior_rows(model: ModelFit, rng: np.random.Generator, *, draws: int = DRAWS) -> PriorRows:
    """What the model's priors say, in units of the noise; in a draw every coefficient is zero and its prior off by chance."""
    priors = model.priors()
    design = np.zeros((len(priors), model.fit.design.shape[1]))
    response = np.zeros(len(priors))
    for row, (place, prior) in enumerate(priors):
        design[row, place] = model.fit.sigma / prior.u
        response[row] = model.fit.sigma * prior.mean / prior.u
    return PriorRows(design, response, model.fit.sigma * rng.standard_normal((len(priors), draws)))


@dataclass(frozen=True)
class CandidateScorer:
    """A fitted model with simulated campaigns in which it is complete.

    Attributes
    ----------
    fit : the current model on the training readings
    draws : (n, draws) responses simulated from its drift and noise alone
    early : (n,) True for the cycles from which the others are predicted when an effect is confirmed in time
    halves : (n,) True for one half of the targets, for events that cannot be confirmed in time
    used : (all readings,) the training readings among those that candidates have columns for
    known : what is known of the model's coefficients beforehand
    """

    fit: DriftFit
    draws: Array
    early: NDArray[np.bool_]
    halves: NDArray[np.bool_]
    used: NDArray[np.bool_]
    known: PriorRows

    def score(self, families: Mapping[str, Sequence[Candidate]], *, level: float = 0.05) -> list[FamilyScore]:
        """Score all candidates of all effects; none is confirmed yet. ``level`` is the chance that any enters where nothing is missing."""
        named = [(name, candidate) for name, candidates in families.items() for candidate in candidates]
        if not named:
            return []
        gains, places, separable = self._gains([candidate for _, candidate in named], self.draws)
        scores: list[FamilyScore] = []
        tried = sum(bool(candidates) for candidates in families.values())
        for name in families:
            rows = np.array([k for k, (family, _) in enumerate(named) if family == name], int)
            if rows.size == 0:
                continue
            usable = rows[separable[rows]]
            collinear = 1.0 - usable.size / rows.size
            if usable.size == 0:
                scores.append(FamilyScore(name, None, 0.0, 0.0, 1.0, 1.0, 0.0, 1.0, collinear))
                continue
            best = usable[np.argmax(gains[usable, 0])]
            null = gains[usable, 1:].max(axis=0)
            gain = float(gains[best, 0])
            p_value, excess = tail_probability(gain, null), gain - float(null.mean())
            place = int(places[best])
            found = FamilyScore(
                name, named[best][1], gain, excess, p_value, 1.0, 0.0, 1.0, collinear, drift_place=place
            )
            scores.append(replace(found, critical=critical_gain(sidak_level(level, tried), null)))
        return [replace(score, family_wise_p=sidak(score.p_value, tried)) for score in scores]

    def refine(self, score: FamilyScore, near: Sequence[Candidate]) -> FamilyScore:
        """The best of some candidates near the one that was found; the p-value stays that of the search."""
        gains, places, separable = self._gains(near, np.empty((self.fit.response.size, 0)))
        best = int(np.argmax(np.where(separable, gains[:, 0], -np.inf)))
        gain = float(gains[best, 0])
        if separable[best] and gain >= score.gain:
            excess = score.excess + gain - score.gain
            score = replace(score, candidate=near[best], gain=gain, excess=excess, drift_place=int(places[best]))
        if score.candidate is None:
            return score
        return replace(score, ranges=parameter_ranges(near, gains[:, 0], score.candidate, score.gain))

    def confirm(self, scores: Sequence[FamilyScore], families: Mapping[str, Sequence[Candidate]]) -> list[FamilyScore]:
        """The same scores with the gain in predictive log-density on unused readings, and its chance where nothing is missing.

        Which candidate of an effect is confirmed is decided without those readings, or their chance would be understated.
        """
        lasting = [score for score in scores if not _is_event(score)]
        early = [self._strongest_early(families[score.name]) for score in lasting]
        in_time = iter(self._gains_in_time(early) if early else ())
        confirmed = []
        for score in scores:
            events = families[score.name]
            gain = self._event_gain(events, score.drift_place) if _is_event(score) else next(in_time)
            chance = float((1 + (gain[1:] >= gain[0]).sum()) / gain.size)
            confirmed.append(replace(score, held_out_gain=float(gain[0]), held_out_p=chance))
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
        judge = replace(self, fit=fit, draws=np.empty((int(early.sum()), 0)), used=used)
        gains, _, separable = judge._gains(candidates, judge.draws)
        return candidates[int(np.argmax(np.where(separable, gains[:, 0], -np.inf)))]

    def systems(self) -> list[DriftSystem]:
        """The fit's drift with every set of variances of the grid."""
        system = self.fit.system
        centre = np.maximum(system.ratios, least_ratio(system))
        return [replace(system, ratios=centre * np.resize(10.0 ** np.asarray(pair), centre.size)) for pair in _GRID]

    def _responses(self) -> Array:
        """The response and every draw, (n, 1 + draws)."""
        return np.column_stack([self.fit.response, self.draws])

    def _gains(
        self, candidates: Sequence[Candidate], draws: Array
    ) -> tuple[Array, NDArray[np.int64], NDArray[np.bool_]]:
        """Log-likelihood gain of every candidate for the response and every draw (candidates, 1 + draws)."""
        groups = by_width(candidates, self.used)
        columns = np.concatenate([group.columns for group in groups], axis=1)
        known = np.column_stack([self.fit.response, draws, self.fit.design])
        n, count = known.shape[0], known.shape[1] - self.fit.design.shape[1]
        best_null = np.full(count, -np.inf)
        best = np.full((count, len(candidates)), -np.inf)
        known_beside = np.array([candidate.beside for candidate in candidates])
        started = np.flatnonzero(known_beside)
        best_started = np.full((count, started.size), -np.inf)
        best_grid = np.zeros(len(candidates), int)
        separable = np.zeros(len(candidates), bool)
        for place, system in enumerate(self.systems()):
            c, spread = system.innovations(columns)
            root, log_determinant = np.sqrt(spread)[:, None], float(np.log(spread).sum())
            c /= root
            whitened = system.innovations(known)[0] / root
            y, x = self.known.append(whitened[:, :count], whitened[:, count:])
            q, _ = np.linalg.qr(x)
            y -= q @ (q.T @ y)
            rss = (y**2).sum(axis=0)
            reduced, given, separate = reductions(c, y[:n], q[:n], groups)
            likelihood = _likelihood(rss, reduced, n, log_determinant)
            best_null = np.maximum(best_null, -0.5 * (n * np.log(rss) + log_determinant))
            best_started = np.maximum(best_started, _likelihood(rss, given[:, started], n, log_determinant))
            better = likelihood[0] > best[0]
            best_grid[better] = place
            np.maximum(best, likelihood, out=best)
            separable |= separate
        # A further coefficient must earn its keep (Akaike): the simpler of two candidates that fit alike is preferred.
        widths = np.array([candidate.columns.shape[1] for candidate in candidates])
        without = np.repeat(best_null[:, None], len(candidates), axis=1)
        without[:, started] = np.maximum(without[:, started], best_started - known_beside[started])
        return (best - without - (widths - 1.0)).T, best_grid, separable

    def _event_gain(self, candidates: Sequence[Candidate], place: int) -> Array:
        """Gain of an event whose instant and size come from one half of the targets on the other half, and back, (1 + draws,)."""
        responses = self._responses()
        columns = np.column_stack([candidate.columns[self.used, 0] for candidate in candidates])
        whitened, _ = self.systems()[place].whiten(np.column_stack([responses, self.fit.design, columns]))
        y, x, c = np.split(whitened, [responses.shape[1], responses.shape[1] + self.fit.design.shape[1]], axis=1)
        n = c.shape[0]
        y, x = self.known.append(y, x)
        c = np.vstack([c, np.zeros((y.shape[0] - n, c.shape[1]))])
        y, c = without(x, y)[:n], without(x, c)[:n]
        return gain_across(y, c, self.halves) / (2.0 * y[:, :1].var())

    def _gains_in_time(self, candidates: Sequence[Candidate]) -> list[Array]:
        """Gain in log-density of the later half, predicted forward from the readings before, of every candidate (1 + draws,).

        Each model has the drift that suits it best, so that a wandering drift is not punished for explaining what it can.
        """
        responses = self._responses()
        count, p = responses.shape[1], self.fit.design.shape[1]
        widths = [candidate.columns.shape[1] for candidate in candidates]
        ends = p + np.cumsum(widths)
        designs = [np.arange(p), *(np.r_[:p, end - width : end] for end, width in zip(ends, widths, strict=True))]
        columns = np.column_stack(
            [responses, self.fit.design, *(candidate.columns[self.used] for candidate in candidates)]
        )
        known: list[list[Array]] = [[] for _ in designs]
        ahead: list[list[Array]] = [[] for _ in designs]
        for system in self.systems():
            errors, spread = system.innovations(columns)
            errors /= np.sqrt(spread)[:, None]
            y, x = errors[:, :count], errors[:, count:]
            # What is known beforehand is known before the early cycles too.
            whole = moments_of(*self.known.append(y, x), spread)
            early = moments_of(*self.known.append(y[self.early], x[self.early]), spread[self.early])
            for k, design in enumerate(designs):
                known[k].append(profile_likelihood(whole.of(design)))
                ahead[k].append(density_ahead(early.of(design), whole.of(design), p))
        chosen = [
            np.take_along_axis(np.array(after), np.argmax(before, axis=0)[None, :], axis=0)[0]
            for before, after in zip(known, ahead, strict=True)
        ]
        return [np.asarray(one - chosen[0]) for one in chosen[1:]]


def _likelihood(squares: Array, reduced: Array, readings: int, log_determinant: float) -> Array:
    """Log-likelihood (responses, candidates) once ``reduced`` is taken from the sums of squares (responses,); overwrites ``reduced``."""
    # In place: these matrices are large, and fetching memory for new ones takes as long as the sums.
    likelihood = np.subtract(squares[:, None], reduced, out=reduced)
    np.log(np.maximum(likelihood, 1e-12 * squares[:, None], out=likelihood), out=likelihood)
    likelihood *= -0.5 * readings
    likelihood -= 0.5 * log_determinant
    return likelihood


def _is_event(score: FamilyScore) -> bool:
    return score.candidate is not None and score.candidate.event_s is not None


def ask_sealed(model: ModelFit, candidate: Candidate, rng: np.random.Generator) -> tuple[float, float, float]:
    """Put one candidate to the sealed readings, predicted in open loop.

    Parameters
    ----------
    model : without the candidate, fitted to the readings before the seal
    candidate : the candidate, with columns for all readings

    Returns
    -------
    before, after, p_value
        Root mean square errors without and with the candidate, and the chance of so small an error after where the candidate is not
        there and the model's own drift is all that happens. Coefficients, noise and drift come from before the seal alone.
    """
    fit, whole, design = model.fit, model.whole_system(), model.whole_design()
    train = whole.observed
    known = prior_rows(model, rng)
    null = simulate_null(fit, rng, over=replace(whole, observed=np.ones_like(train)))
    responses = np.column_stack([model.readings.response, null])
    p, count = design.shape[1], responses.shape[1]
    centre = np.maximum(fit.system.ratios, least_ratio(fit.system))
    likelihood: dict[bool, list[Array]] = {False: [], True: []}
    error: dict[bool, list[Array]] = {False: [], True: []}
    for pair in _GRID:
        system = replace(whole, ratios=centre * np.resize(10.0 ** np.asarray(pair), centre.size))
        errors, spread = system.innovations(np.column_stack([responses, design, candidate.columns]))
        root = np.sqrt(spread[train])[:, None]
        for with_candidate in (False, True):
            used = slice(count, count + p + (candidate.columns.shape[1] if with_candidate else 0))
            y, x = known.append(errors[train, :count] / root, errors[train, used] / root)
            beta = solve(x.T @ x, x.T @ y)
            variance = ((y - x @ beta) ** 2).mean(axis=0)
            likelihood[with_candidate].append(-0.5 * (y.shape[0] * np.log(variance) + np.log(spread[train]).sum()))
            error[with_candidate].append(((errors[~train, :count] - errors[~train, used] @ beta) ** 2).mean(axis=0))
    before, after = (
        np.sqrt(np.take_along_axis(np.array(error[key]), np.argmax(likelihood[key], axis=0)[None, :], axis=0)[0])
        for key in (False, True)
    )
    return float(before[0]), float(after[0]), float((1 + (after[1:] <= after[0]).sum()) / after.size)


#: Log-likelihood by which the best may beat a value that a 95 % interval still holds: half of chi-squared, 1 degree of freedom.
_WITHIN = 1.92
#: Values that differ by less than this share are one value, computed twice.
_SAME = 1e-6
#: Words that only spell out a number: what a wave may be mistaken for, and the time constants of a chain of parts.
_DERIVED = frozenset({"possible_leads", "chain"})

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
    found: dict[str, Range] = {}
    for name, value in best.parameters.items():
        if name in _DERIVED:
            continue
        if isinstance(value, str):
            words = sorted(
                {str(candidate.parameters[name]) for candidate in alike if name in candidate.parameters} - {value}
            )
            if words:
                found[name] = words
            continue
        tried = [_number(candidate, name) for candidate in near if _same_words(candidate, best)]
        fitting = [float(value), *(_number(candidate, name) for candidate in alike if _same_words(candidate, best))]
        if len(set(tried)) > 1:
            found[name] = _enclosed(np.array(tried), min(fitting), max(fitting))
    return found


def _enclosed(tried: Array, low: float, high: float) -> list[float | None]:
    """The values next to those that fit: the likelihood falls somewhere between, so the interval is rather too wide."""
    below, above = tried[tried < low * (1.0 - _SAME)], tried[tried > high * (1.0 + _SAME)]
    lowest = float(below.max()) if below.size else 0.0 if low == 0.0 else None
    return [lowest, float(above.min()) if above.size else None]


def _number(candidate: Candidate, name: str) -> float:
    """A parameter's value; a body that is not there has a time constant of zero."""
    return float(candidate.parameters.get(name, 0.0))


def _same_words(candidate: Candidate, best: Candidate) -> bool:
    return _words(candidate.parameters) == _words(best.parameters)


def _words(parameters: Mapping[str, float | str]) -> dict[str, str]:
    return {name: value for name, value in parameters.items() if isinstance(value, str) and name not in _DERIVED}
