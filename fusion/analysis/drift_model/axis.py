"""The closed loop on a positioning campaign: readings along an axis, a hold-out set of the last cycles, a second look at all of them.

The last fifth of the cycles is held out. After the search on the others the hold-out set is opened once: the error before and after is
that of predicting these cycles in open loop with frozen coefficients. What acted only there is searched for in a second look, which has
no held-out error any more.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from operator import is_
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.analysis.alignment.align import cycle_bounds, find_switching_patch
from fusion.analysis.alignment.readings import Readings
from fusion.analysis.diagnosis import residual as remainder
from fusion.analysis.diagnosis.residual import Remainder
from fusion.analysis.drift_model.admissibility import (
    WARM_UP_SHARE,
    AxisGrounds,
    CandidateScorer,
    free_warm_ups,
    inconsistent_patterns,
    is_shown_by_one_warm_up,
    prior_rows,
    refuse,
    refuse_in_heteroscedastic_drift,
    warm_up_share,
)
from fusion.analysis.drift_model.evaluation import (
    Answer,
    Contribution,
    LoopResult,
    Surroundings,
    Unseen,
    answers,
    describe_steps,
    leading_pattern,
    left_out_of_forecast,
    named_in_forecast,
    unsupported_places,
)
from fusion.analysis.drift_model.gains import Products, by_width, orthogonalise, reductions, sum_products
from fusion.analysis.drift_model.model import (
    ModelFit,
    Term,
    coefficient_spread,
    condition,
    fit_model,
    recompute_term,
    refit_fixed,
    scaled_systems,
    size_camera_errors,
    solve,
    unexplained_drift,
    wandering_um,
)
from fusion.analysis.drift_model.predictions import expect_errors, held_out_errors, plain_errors, rmse, track_cycles
from fusion.analysis.drift_model.search import (
    FINAL,
    HOLD_OUT_SHARE,
    LEVEL_TO_CONFIRM,
    MOST_EFFECTS,
    MOST_EVENTS,
    Confirmation,
    Confirmed,
    Decision,
    LoopState,
    Problem,
    Progress,
    Reason,
    Round,
    Score,
    Step,
    blur,
    choose,
    kept_on_disk,
    no_progress,
    open_hold_out,
    parameter_ranges,
    refine,
    score_effects,
    search,
    settled,
    withdraw,
)
from fusion.analysis.effects.effect import Candidate, Effect
from fusion.analysis.effects.events import cycle_starts
from fusion.analysis.effects.laser_and_camera import camera_offset, reflected_source
from fusion.analysis.effects.library import library
from fusion.analysis.levels import SEARCH_LEVEL, SECOND_LEVEL
from fusion.common import Array, FusionError
from fusion.results import loop as schema
from fusion.results.numbers import measured, print_unit
from interferometry.common import one_thread
from interferometry.drift.kalman import DriftModelError
from thermography.large_arrays import empty_array, fill_array, in_pieces

# Detection limits: how large an effect must be to be found in a campaign, and which effects look alike in it.

#: Standard normal quantile of the power: an effect of the stated size is found in 80 % of such campaigns.
_POWER_QUANTILE = 0.84
#: Share of an effect's visible variance from which on another effect is said to look alike.
_ALIKE_SHARE = 0.9
#: Largest size that is looked for, um per reading, and simulated campaigns that suffice for the scatter that a drift leaves.
_LARGEST_UM = 1e3
_DRAWS = 20
#: Share of its size by which a column that never moves differs from its mean: rounding.
_ROUNDING = 1e-9
#: Candidates whose columns are compared with the model together.
_AT_ONCE = 64


def detection_limits(
    scorer: CandidateScorer,
    products: Sequence[Products],
    model: ModelFit,
    families: Mapping[str, Sequence[Candidate]],
    scores: Sequence[Score],
    effects: Mapping[str, Effect],
) -> list[schema.DetectionLimit]:
    """Say for every effect how large it must be to be found and what it looks like."""
    candidates = [candidate for some in families.values() for candidate in some]
    names = np.repeat(list(families), [len(some) for some in families.values()])
    critical = {score.name: score.critical for score in scores}
    wanted = np.array([0.5 * (np.sqrt(2.0 * critical[name]) + _POWER_QUANTILE) ** 2 for name in names])
    own, left, spread = _beside(model, candidates)
    smallest = _smallest(products, spread, wanted)
    # A column that never moves has no size.
    moves = own > 0.0
    sizes = np.where(moves, own, np.inf) * smallest
    share = np.divide(left, own, out=np.full(own.size, np.nan), where=moves)
    # Of every effect the candidate that shows like the median of them.
    places = {name: np.flatnonzero(names == name) for name in families}
    typical = [int(own_places[np.argsort(sizes[own_places])[own_places.size // 2]]) for own_places in places.values()]
    alike = _alike(scorer, candidates, names, typical)
    limits = []
    for row, name in enumerate(families):
        here = sizes[places[name]]
        seen = here[np.isfinite(here)]
        limits.append(
            schema.DetectionLimit(
                effect=name,
                detectable_um=float(np.median(seen)) if seen.size else None,
                best_um=float(seen.min()) if seen.size else None,
                worst_um=float(seen.max()) if seen.size else None,
                visible_share=_median(share[places[name]]),
                confounded_with=tuple(sorted(alike[row] - {name})),
                note=_note(effects[name], candidates[int(places[name][np.argmin(here)])], model, seen.size),
            )
        )
    return limits


def _median(values: Array) -> float | None:
    """Median of the known values, None where there is none."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else None


def _beside(model: ModelFit, candidates: Sequence[Candidate]) -> tuple[Array, Array, Array]:
    """Of every candidate's first column the size about the sites, what the model leaves of it, and its spread, (candidates,) each."""
    site = model.readings.subset(model.used).site
    q, _ = np.linalg.qr(model.fit.design)
    own, left, spread = np.empty((3, len(candidates)))
    for some in np.array_split(np.arange(len(candidates)), 1 + len(candidates) // _AT_ONCE):
        columns = np.column_stack([candidates[k].columns[model.used][:, 0] for k in some])
        for k, column in zip(some, columns.T, strict=True):
            about = _about_sites(site, column)
            own[k] = np.sqrt(np.mean(about**2)) if np.abs(about).max() > _ROUNDING * np.abs(column).max() else 0.0
        left[some] = np.sqrt(np.mean((columns - q @ (q.T @ columns)) ** 2, axis=0))
        spread[some] = columns.std(axis=0)
    return own, left, spread


def _smallest(sums: Sequence[Products], spread: Array, wanted: Array) -> Array:
    """Coefficient of every first column at which its expected gain is as wanted, the drift being free with it and without it."""
    n, energy, noise, penalty = sums[0].readings, [], [], []
    for products in (held.of_candidates() for held in sums):
        freed = orthogonalise(products)
        noise.append(np.mean(freed.squares[1 : 1 + _DRAWS]))
        first = np.empty(wanted.size)
        for group, slots, within in zip(products.groups, products.slots(), products.within, strict=True):
            # Columns that are no evidence stand before the first one.
            along = freed.along_design[:, slots[group.beside]]
            first[group.places] = within[:, group.beside, group.beside] - np.einsum("qm,qm->m", along, along)
        energy.append(np.maximum(first, 0.0))
        penalty.append(products.log_spread)
    scatter, without_name = np.array(noise)[:, None], np.array(penalty)[:, None]
    nothing = np.max(-0.5 * (n * np.log(scatter) + without_name), axis=0)
    low, high = np.zeros(wanted.size), _LARGEST_UM / np.maximum(spread, 1e-12)

    def gain(size: Array) -> Array:
        swallowed = -0.5 * (n * np.log(scatter + size**2 * np.array(energy)) + without_name)
        return np.asarray(nothing - swallowed.max(axis=0))

    never = gain(high) < wanted
    for _ in range(60):
        middle = 0.5 * (low + high)
        enough = gain(middle) >= wanted
        low, high = np.where(enough, low, middle), np.where(enough, middle, high)
    return np.where(never, np.inf, high)


def _alike(
    scorer: CandidateScorer, candidates: Sequence[Candidate], names: NDArray[np.str_], typical: Sequence[int]
) -> list[set[str]]:
    """For every effect's typical candidate the effects of which some candidate explains nearly all that is visible of it."""
    design = scorer.fit.design
    shown = np.column_stack([candidates[k].columns[scorer.used][:, 0] for k in typical])
    shown = shown - design @ np.linalg.lstsq(design, shown, rcond=None)[0]
    (held,) = sum_products([scorer.fit.system], [shown], design, by_width(candidates, scorer.used))
    products = held.of_candidates()
    freed = orthogonalise(products)
    reduced, given, _ = reductions(products, freed)
    alike = reduced - given > _ALIKE_SHARE * np.maximum(freed.squares, 1e-300)[:, None]
    return [set(names[row].tolist()) for row in alike]


def _note(effect: Effect, candidate: Candidate, model: ModelFit, seen: int) -> str:
    """What stands in the way of an effect in this campaign."""
    part = model.readings.subset(model.used)
    if not seen:
        return "the declared model contains it, or nothing excites it"
    if effect.excited_by and warm_up_share(part, candidate.on(model.used)) > WARM_UP_SHARE:
        return "one warm-up is all that excites it; switch the load on purpose to tell it from others"
    return effect.limitation(part)


LEAST_CYCLES = 10
#: Log-likelihood below that of the best up to which a candidate is asked where else the coefficients would lie.
_ABOUT_AS_WELL = 10.0

AxisState = LoopState[ModelFit]


class LoopError(FusionError):
    """The campaign cannot be modelled; the message says what is missing."""


@one_thread
def close_axis(
    readings: Readings,
    declared: Sequence[str],
    *,
    seed: int = 1,
    set_aside: Collection[tuple[int, str]] = (),
    effects: Mapping[str, Effect] | None = None,
    progress: Progress = no_progress,
) -> AxisResult:
    """Close the loop on a positioning campaign, as `close_loop` does."""
    effects = library() if effects is None else effects
    used, description = hold_out(readings)
    terms = declare(readings, declared, effects)
    progress(0, MOST_EFFECTS + 2, "fitting the declared model")
    problem = AxisProblem(readings, used, effects, np.random.default_rng(seed))
    start = problem.start(terms)
    state = simplify_rhythms(problem, search(problem, start, progress=progress))
    state = reject_inconsistent_patterns(problem, state)
    progress(MOST_EFFECTS, MOST_EFFECTS + 2, "opening the hold-out set")
    before = open_hold_out(problem, state)
    state = replace(before, model=size_camera_errors(fit_model(readings, before.model.terms), effects))
    progress(MOST_EFFECTS + 1, MOST_EFFECTS + 2, "second look, at all cycles")
    state = reject_inconsistent_patterns(problem, second_search(problem, state))
    wrong = inconsistent_patterns(state.model, state.added, effects)
    steps = report_steps(state, wrong, problem.ask_hold_out(before, state))
    away = left_out_of_forecast(problem, before, unsupported_places(steps))
    forecast = before.kept(away)
    ahead = problem.forecast(forecast)
    plain = plain_errors(readings, used)
    errors = {
        "declared": problem.hold_out_errors(terms),
        "final": problem.hold_out_errors(forecast),
        **{name: missed[~used] for name, missed in plain.items()},
    }
    late = any(step.is_from_second_search for step in state.steps)
    result = AxisResult(
        state=state,
        held_out=f"{description}, drift carried on at its {'level' if ahead.fit.system.order == 1 else 'rate'}",
        noise_floor_um=state.model.fit.sigma,
        hold_out_errors=errors,
        hold_out=held_out_errors(errors)
        | {
            name: expect_errors(problem.forecast(some), errors[name], seed=seed)
            for name, some in (("declared", terms), ("final", forecast))
        },
        skill_um=problem.hold_out_error(state.model.terms) if late else state.errors_um[-1],
        tracking=track_cycles(problem.fitted(forecast), plain["ridge"]),
        steps=named_in_forecast(steps, away),
        away=frozenset(away),
        remainder=examine_remainder(state.model, seed, set_aside),
        wandering_um=wandering_um(state.model.fit),
        warm_up_only=shown_by_one_warm_up(state.model, len(state.declared)),
        declared_coefficients=coefficients_beside(problem, state, steps),
        before=start.model,
        after=state.model,
    )
    progress(MOST_EFFECTS + 2, MOST_EFFECTS + 2, "loop closed")
    return result


class AxisProblem(Problem[ModelFit]):
    """The readings of a campaign, the training part of them, and the library, for :mod:`fusion.analysis.drift_model.search`."""

    effects: Mapping[str, Effect]
    entry_level = SEARCH_LEVEL

    def __init__(
        self, readings: Readings, used: NDArray[np.bool_], effects: Mapping[str, Effect], rng: np.random.Generator
    ) -> None:
        self.readings, self.used, self.effects, self.rng = readings, used, effects, rng
        self._fits: deque[ModelFit] = deque(maxlen=2 * MOST_EFFECTS)
        self._forecasts: deque[tuple[ModelFit, ModelFit]] = deque(maxlen=2 * MOST_EFFECTS)

    def start(self, declared: Sequence[Term]) -> AxisState:
        """The state before the search: the declared model, and the effects that these readings cannot show."""
        present = {term.effect for term in declared}
        missing = {
            name: effect.needs(self.readings) or (None if name in present else effect.masked_by(self.readings))
            for name, effect in self.effects.items()
        }
        return AxisState(self.fitted(declared)).without_effects(missing)

    def fitted(self, terms: Sequence[Term]) -> ModelFit:
        """The model of these terms on the training part, fitted once: the search and the hold-out set ask for the same ones."""
        for model in self._fits:
            if len(model.terms) == len(terms) and all(map(is_, model.terms, terms)):
                return model
        self._fits.append(fit_model(self.readings, terms, used=self.used))
        return self._fits[-1]

    def forecast(self, terms: Sequence[Term]) -> ModelFit:
        """The model by which the hold-out set is predicted, chosen once: the drift is carried on at its level alone where that predicts the
        later half of the training part better.
        """
        model = self.fitted(terms)
        if model.fit.system.order == 1:
            return model
        for fitted, ahead in self._forecasts:
            if fitted is model:
                return ahead
        level = fit_model(self.readings, terms, used=self.used, order=1)
        self._forecasts.append((model, min((model, level), key=lambda one: rmse(errors_ahead(one)))))
        return self._forecasts[-1][1]

    def refit(self, model: ModelFit, terms: Sequence[Term]) -> ModelFit:
        """Fit other terms to the readings that a model was fitted to."""
        if model.used is self.used:
            return self.fitted(terms)
        return fit_model(self.readings, terms, used=model.used)

    def score(self, state: AxisState) -> Round:
        """Score the library; effects worth it are looked at more closely before they are compared, and are confirmed."""
        model = state.model
        scorer = CandidateScorer.of(model, self.rng)
        families, faults = self.families(state, self.readings.seconds.size)
        if not families:
            return Round((), tuple(faults))
        products = scorer.products([candidate for candidates in families.values() for candidate in candidates])
        scores, decisions = score_effects(families, scorer.gains_by(products), level=SEARCH_LEVEL)
        limits = [] if state.rounds else detection_limits(scorer, products, model, families, scores, self.effects)
        measured = partial(scorer.gains, simulated=False)
        worth = [
            refine(score, partial(self.near, score.name, model), measured)
            for score in scores
            if score.candidate is not None and score.p_value < LEVEL_TO_CONFIRM
        ]
        confirmed = {score.name: score for score in scorer.confirm(worth, families)}
        closer = [confirmed.get(score.name, score) for score in scores]
        best_first = tuple(sorted(closer, key=lambda score: -score.excess))
        return Round(best_first, (*faults, *decisions), detection_limits=tuple(limits))

    def refuse(self, score: Score, model: ModelFit) -> Decision | None:
        """Refuse an effect that these readings do not identify, and an event that faster drift about its instant explains as well."""
        refusal = refuse(score.name, self.effects[score.name].excited_by, score.best, AxisGrounds(model))
        return refusal or refuse_in_heteroscedastic_drift(score, model)

    def loss_without(self, model: ModelFit, term: Term) -> float:
        """Log-likelihood lost without a term, the drift's variances kept."""
        return loss_without(model, term)

    def hold_out_errors(self, terms: Sequence[Term]) -> Array:
        """Open-loop errors on the hold-out cycles, um; an event among them is sized on one half of the targets, tested on the other."""
        if not any(self.is_late(term) for term in terms):
            return self.forecast(terms).open_loop_errors()[0]
        half = self.readings.target_index % 2 == 0
        errors = np.full(self.used.size, np.nan)
        for fitted in (half, ~half):
            used = self.used | fitted
            errors[~used] = fit_model(self.readings, terms, used=used).open_loop_errors()[0]
        return errors[~self.used]

    def ask_hold_out(self, before: AxisState, state: AxisState) -> list[Answer | None]:
        """What the hold-out cycles say of every step; None of an event and of what was found when they had been opened."""
        model = self.fitted(before.model.terms)
        lasting = [place for place, term in enumerate(before.added) if term.candidate.event_s is None]
        here = ~self.used & np.isin(self.readings.site, self.readings.site[self.used])
        readings, nothing = self.readings.subset(here), np.zeros(int(here.sum()))
        share = {id(term): model.series(term)[0][here] for term in model.terms}
        added = [share[id(term)] for term in before.added]
        static = slice(0, model.profile.shape[1])
        known = model.profile[here] @ model.fit.coefficients[static]
        known = known + sum((one for place, one in enumerate(added) if place not in lasting), nothing)
        variances, directions = np.linalg.eigh(model.fit.covariance[static, static])
        uncertain = model.profile[here] @ directions * np.sqrt(np.maximum(variances, 0.0))
        declared = sum((share[id(term)] for term in before.declared), nothing)
        later = [term.candidate.columns[here] for term in state.added[len(before.added) :]]
        beside = np.column_stack([readings.loadings[:, 1:], declared, *later])
        shares = np.array([added[place] for place in lasting]).reshape(len(lasting), nothing.size).T
        rows, left = np.arange(nothing.size), readings.response - known
        asked = answers(
            [Unseen(rows, readings.seconds, readings.loadings, left, beside, shares, uncertain)],
            family=len(state.steps),
        )
        told = dict(zip(lasting, asked, strict=True))
        return [told.get(place) for place in range(len(state.steps))]

    def alike(self, score: Score, model: ModelFit) -> list[Candidate]:
        """Candidates of an effect that fit about as well as the one that was chosen: in the search, and near it."""
        offered = self.effects[score.name].candidates(self.readings, model.coefficients(), None)
        wanted = [parameters for parameters, gain in score.tried if gain > score.gain - _ABOUT_AS_WELL]
        return [one for one in offered if one.parameters in wanted] + self.near(score.name, model, score.best)

    def is_late(self, term: Term) -> bool:
        """Whether a term is an event among the hold-out cycles, of which the cycles before say nothing."""
        first = self.readings.seconds[~self.used].min()
        cycle_s = float(np.median(np.diff(cycle_starts(self.readings))))
        return term.candidate.event_s is not None and term.candidate.event_s >= first - cycle_s

    def offer(self, name: str, model: ModelFit, near: Candidate | None) -> list[Candidate]:
        """Candidates of an effect whose event, if they have one, has enough cycles on both sides and is not in the model."""
        starts = cycle_starts(self.readings.subset(model.used))
        offered = self.effects[name].candidates(self.readings, model.coefficients(), near)
        inside = (one for one in offered if one.event_s is None or starts[2] <= one.event_s <= starts[-2])
        if near is not None:
            return list(inside)
        # One event happens once, however its column was weighed when it was found; a harmonic of a rhythm is that rhythm.
        happened = {(term.effect, term.candidate.event_s) for term in model.terms if term.candidate.event_s is not None}
        rhythms = [float(term.candidate.parameters.get("period_min", 0.0)) for term in model.terms]
        line = 60.0 / float(np.ptp(self.readings.seconds))
        new = (
            one
            for one in inside
            if (name, one.event_s) not in happened
            and not any(is_harmonic(float(one.parameters.get("period_min", np.inf)), of, line) for of in rhythms)
        )
        return list(kept_on_disk(new))


def loss_without(model: ModelFit, term: Term) -> float:
    """Log-likelihood lost without a term, the drift's variances kept."""
    kept = [other for other in model.terms if other is not term]
    return 0.5 * model.fit.response.size * float(np.log(refit_fixed(model, kept).rss / model.fit.rss))


def is_harmonic(period_min: float, of_min: float, line: float) -> bool:
    """Whether a wave is a higher harmonic of another, to the width of a line of the spectrum (1/min)."""
    order = round(of_min / period_min)
    return order > 1 and abs(order / of_min - 1.0 / period_min) < line


def hold_out(readings: Readings) -> tuple[NDArray[np.bool_], str]:
    """Divide the cycles into a training part and a hold-out set."""
    numbers = np.unique(readings.cycle)
    if numbers.size < LEAST_CYCLES:
        raise LoopError(
            f"{numbers.size} cycles are too few to hold some out and to model the others; measure at least {LEAST_CYCLES}, better 50"
        )
    first = numbers[-max(2, round(HOLD_OUT_SHARE * numbers.size))]
    return (
        readings.cycle < first,
        f"cycles {first} to {numbers[-1]} held out; coefficients frozen at cycle {first - 1}",
    )


def declare(readings: Readings, declared: Sequence[str], effects: Mapping[str, Effect]) -> list[Term]:
    """Make the terms of the declared model."""
    terms = []
    for name in declared:
        if name not in effects:
            raise LoopError(f"declared effect {name!r} is not in the library: {', '.join(effects)}")
        reason = effects[name].needs(readings)
        if reason is not None:
            raise LoopError(f"declared effect {name!r} cannot be computed: {reason}")
        candidates = list(effects[name].candidates(readings, {}, None))
        if len(candidates) != 1:
            raise LoopError(
                f"declared effect {name!r} has parameters that are not known beforehand; leave it out of declared, the "
                "search tries it anyway"
            )
        if not np.any(candidates[0].columns):
            raise LoopError(
                f"declared effect {name!r} is zero at every reading: what it follows does not change during the test; check that the "
                "frames are not copies of one (camera frozen) and that the logs move, or leave it out of declared"
            )
        terms.append(Term(name, replace(candidates[0], prior=effects[name].prior)))
    return terms


def second_search(problem: AxisProblem, state: AxisState) -> AxisState:
    """Search once more, in all cycles: what acted only in the hold-out set could not be found before."""
    decided = len(state.steps)
    if any(decision.reason in FINAL for decision in state.decisions):
        return state
    for _ in range(MOST_EFFECTS - decided):
        state, score = choose(problem, state.scored(problem.score(state)), level=SECOND_LEVEL)
        if score is None or state.events + (score.name == "step_event") > MOST_EVENTS:
            return state
        model = size_camera_errors(
            fit_model(problem.readings, [*state.model.terms, Term(score.name, score.best)]), problem.effects
        )
        entered = state.entered(model, score, Confirmed.SECOND_SEARCH)
        before, state = state, settled(problem, state, entered, first=decided)
        if state is before:
            return state
    return state


def simplify_rhythms(problem: AxisProblem, state: AxisState) -> AxisState:
    """Replace a rhythm of harmonics by one of its waves, where that describes as much beside what was found after it."""
    for place, (step, term) in enumerate(zip(state.steps, state.added, strict=True)):
        held = term.candidate
        if "course" not in held.parameters:
            continue
        beside = problem.refit(state.model, state.kept([place]))
        single = {name: value for name, value in held.parameters.items() if name != "course"}
        periods = [float(single["period_min"]) / order for order in range(1, held.columns.shape[1] // 2 + 1)]
        about = [replace(held, parameters={**single, "period_min": period}) for period in periods]
        near = [one for wave in about for one in problem.near(term.effect, beside, wave)]
        waves = [one for one in near if "course" not in one.parameters]
        gain = CandidateScorer.of(beside, problem.rng).gains([held, *waves], simulated=False).gain[:, 0]
        best = int(np.argmax(gain[1:]))
        if gain[1 + best] <= gain[0]:
            continue
        chosen = waves[best]
        tried = [(one.parameters, float(size)) for one, size in zip(waves, gain[1:], strict=True)]
        score = replace(
            step.score, candidate=chosen, ranges=parameter_ranges(tried, chosen.parameters, float(gain[1 + best]))
        )
        terms = [Term(one.effect, chosen) if one is term else one for one in state.model.terms]
        steps = tuple(replace(one, score=score) if one is step else one for one in state.steps)
        state = replace(state, model=problem.refit(state.model, terms), steps=steps)
    return state


def reject_inconsistent_patterns(problem: AxisProblem, state: AxisState) -> AxisState:
    """Withdraw the name of an effect whose pattern along the axis is not what the readings show; it was the nearest, not the cause."""
    wrong = {
        place: decision
        for place, decision in inconsistent_patterns(state.model, state.added, problem.effects).items()
        if not state.errors_um or state.steps[place].is_from_second_search
    }
    if not wrong:
        return state
    first = min(wrong)
    places = range(first, len(state.steps))
    decisions = []
    for place in places:
        step = state.steps[place]
        found_beside = Decision(step.effect, Reason.DEPENDS_ON_WITHDRAWN, {"beside": state.steps[first].effect})
        decisions.append(wrong.get(place, found_beside).on_evidence(search_p=step.score.family_wise_p))
    return reject_inconsistent_patterns(problem, withdraw(problem, state, places, decisions))


def examine_remainder(model: ModelFit, seed: int, set_aside: Collection[tuple[int, str]]) -> remainder.Remainder:
    """Describe what a model leaves: a shape among the sites or, where there is none, an unexplained drift of all of them."""
    rng = np.random.default_rng(seed)
    left = remainder.examine(model.readings, model.fit, rng, memory=model.memory, set_aside=set_aside)
    return left if left.shape else remainder.with_drift(left, model.fit)


def set_aside_sites(result: AxisResult, sites: Collection[tuple[int, str]], *, seed: int = 1) -> AxisResult:
    """Count sites whose anomaly has its own diagnosis no longer as a remainder."""
    return replace(result, remainder=examine_remainder(result.after, seed, sites))


def on_corrected_fields(
    result: AxisResult,
    readings: Readings,
    errors: Collection[str],
    *,
    effects: Mapping[str, Effect] | None = None,
    seed: int = 1,
) -> AxisResult:
    """Fit the model again on fields from which the camera's errors have been taken out."""
    effects = library() if effects is None else effects
    found, coefficients = result.state, result.after.coefficients()
    corrected = [place for place, step in enumerate(found.steps) if step.effect in errors]
    kept = [place for place in range(len(found.steps)) if place not in corrected]

    def again(term: Term) -> Term:
        return recompute_term(term, readings, coefficients, effects)

    used, _ = hold_out(readings)
    problem = AxisProblem(readings, used, effects, np.random.default_rng(seed))
    model = fit_model(readings, [again(term) for term in found.kept(corrected)])
    steps = tuple(_with_tied(found.steps[place], result.steps[place].tied, again) for place in kept)
    state = replace(found, model=model, steps=steps)
    left_out = [at for at, place in enumerate(kept) if place in result.away or found.steps[place].is_from_second_search]
    forecast = state.kept(left_out)
    errors_um = problem.hold_out_errors(forecast)
    return replace(
        result,
        declared_coefficients=coefficients_beside(problem, state, [result.steps[place] for place in kept]),
        noise_floor_um=model.fit.sigma,
        hold_out={**result.hold_out, "final": expect_errors(problem.forecast(forecast), errors_um, seed=seed)},
        hold_out_errors={**result.hold_out_errors, "final": errors_um},
        remainder=examine_remainder(model, seed, ()),
        wandering_um=wandering_um(model.fit),
        warm_up_only=shown_by_one_warm_up(model, len(state.declared)),
        after=model,
    )


def _with_tied(step: Step, tied: Collection[str], again: Callable[[Term], Term]) -> Step:
    """Return a step whose tied rivals are computed again."""
    scores = (
        replace(score, candidate=again(Term(score.name, score.best)).candidate) if score.name in tied else score
        for score in step.round.scores
    )
    return replace(step, round=replace(step.round, scores=tuple(scores)))


# Correction of the fields: errors of the camera that the loop found are taken out of the fields, and all is computed
# again.

#: Standard uncertainties within which the sizes from the drift and from the field agree.
_AGREEMENT = 3.0


class FieldFault(schema.FieldCorrection):
    """One error of the camera, as the loop found it, with the correction of every frame."""

    course_K: Array
    """(time,) K, what is to be added to every frame where the pattern is 1."""
    pattern: Array
    """(y, x) where it is to be added, and which share of it."""


def find_field_errors(result: AxisResult, fields: xr.Dataset, fused: xr.Dataset) -> list[FieldFault]:
    """Return every error of the camera that entered the model, with the correction of the frames."""
    errors = []
    time = fields["time"].values.astype("datetime64[ns]")
    # The loop counts its seconds from the first reading.
    read = fused["time"].values.astype("datetime64[ns]")
    start = read[np.isfinite(fused["deviation"].values) & ~np.isnat(read)].min()
    frame_cycle = _cycle_of(time, fused)
    for step in result.steps:
        if step.effect not in (camera_offset.name, reflected_source.name):
            continue
        size, u = np.array([step.coefficients[0].value, step.coefficients[0].u], float).tolist()
        if step.effect == camera_offset.name:
            size = _agreed(size, u, float(step.parameters["jump_of_the_field_K"]))
            # A microsecond of slack: the instant went through seconds in floating point.
            late = (time - start) / np.timedelta64(1, "s") >= float(step.parameters["time_s"]) - 1e-6
            error, pattern = size * late, np.ones(fields["frame_temperature"].shape[1:])
            text = f"the camera read {size:+.3f} ± {2.0 * u:.3f} K (k = 2) too high"
        else:
            patch = find_switching_patch(fields["frame_temperature"])
            if patch is None:
                continue
            # A warm body adds to what the camera sees: the lowest state is the one without it.
            course = patch.course - patch.course.min()
            size = _agreed(size, u, 1.0)
            error, pattern = size * course, patch.pattern
            height = float(course.max())
            text = f"a reflected source added up to {size * height:.2f} ± {2.0 * u * height:.2f} K (k = 2) over a patch"
            size, u = size * height, u * height
        touched = np.flatnonzero(error)
        first = int(frame_cycle[touched[0]]) if touched.size else int(frame_cycle[-1])
        errors.append(
            FieldFault(
                effect=step.effect,
                text=f"{text} from cycle {first} on",
                size_K=size,
                size_u_K=u,
                first_cycle=first,
                course_K=-np.asarray(error, float),
                pattern=pattern,
            )
        )
    return errors


def _agreed(fitted: float, u: float, seen: float) -> float:
    """The size that the field shows, or that fitted to the drift where both disagree."""
    return seen if abs(seen - fitted) <= _AGREEMENT * u else fitted


def correct_fields(fields: xr.Dataset, errors: list[FieldFault]) -> xr.Dataset:
    """Take the camera's errors out of every frame."""
    if not errors:
        return fields
    frames = fields["frame_temperature"]
    corrected = empty_array(frames.shape, float)
    for (some, values), (_, right) in zip(in_pieces(frames), in_pieces(corrected), strict=True):
        right[:] = values + _correction(errors, some)
    return fields.assign(frame_temperature=frames.copy(data=corrected))


def _correction(errors: Sequence[FieldFault], frames: slice | NDArray[np.bool_]) -> Array:
    """What is to be added to some frames, (some, y, x) K."""
    return np.asarray(np.sum([one.course_K[frames, None, None] * one.pattern for one in errors], axis=0))


def corrected_variables(fields: xr.Dataset, fused: xr.Dataset, errors: list[FieldFault]) -> dict[str, xr.Variable]:
    """Corrected fields per cycle and the correction of every frame, for fusion.nc."""
    frames, cycles = fields["frame_temperature"], fields["temperature"]
    total = fill_array(frames.shape, np.float32, lambda some: _correction(errors, some))
    temperature, rise = (empty_array(cycles.shape, np.float32) for _ in range(2))
    frame_cycle = _cycle_of(fields["time"].values.astype("datetime64[ns]"), fused)

    def of_cycle(cycle: int) -> Array:
        """Mean correction of a cycle's frames, (y, x) K; of one without frames that of the frame before."""
        own = frame_cycle == cycle
        if not own.any():
            own[np.flatnonzero(frame_cycle < cycle)[-1:]] = True
        return np.asarray(_correction(errors, own).mean(axis=0)) if own.any() else np.zeros(errors[0].pattern.shape)

    start = of_cycle(fields["cycle"].values[0])
    pieces = (in_pieces(array) for array in (cycles, temperature, fields["temperature_rise"], rise))
    for (some, mean), (_, right), (_, risen), (_, right_rise) in zip(*pieces, strict=True):
        added = np.stack([of_cycle(cycle) for cycle in fields["cycle"].values[some]])
        right[:], right_rise[:] = mean + added, risen + added - start
    plan = ("plan_y", "plan_x")
    kelvin = {"units": "K", "units_metadata": "temperature: difference"}
    why = "; ".join(one.text for one in errors)
    return {
        "field_correction": xr.Variable(
            ("frame_time", *plan),
            total,
            {**kelvin, "long_name": "to be added to frame_temperature of fields.nc", "comment": why},
        ),
        "temperature_corrected": xr.Variable(
            ("cycle", *plan),
            temperature,
            {"units": "degC", "units_metadata": "temperature: on_scale", "comment": why},
        ),
        "temperature_rise_corrected": xr.Variable(("cycle", *plan), rise, {**kelvin, "comment": why}),
    }


def _cycle_of(frame_time: Array, fused: xr.Dataset) -> Array:
    """Cycle of every frame; those outside all cycles count to the nearest before, or to the first."""
    bounds = cycle_bounds(fused)
    place = np.clip(np.searchsorted(bounds[:, 0], frame_time, side="right") - 1, 0, None)
    return np.asarray(fused["cycle"].values[place])


# What is reported: errors of left-out blocks, and the result.


#: Blocks of cycles, each as long as the hold-out set; all but the first are left out in turn. The first alone knows in which state the
#: machine was when the log began, so that nothing predicts it.
_BLOCKS = 5
#: Parts of the training cycles that are as long as the hold-out set.
_QUARTERS = 4


def cross_errors(model: ModelFit, event_s: float | None = None) -> Array:
    """Errors of predicting blocks of cycles from all others."""
    errors = np.full(int(model.used.sum()), np.nan)
    if event_s is not None:
        blocks = [_around(model, event_s)]
    else:
        # Consecutive fifths of the cycles but the first.
        cycle = model.readings.cycle[model.used]
        numbers = np.unique(cycle)
        fifth = np.searchsorted(numbers, cycle) * _BLOCKS // numbers.size
        blocks = [fifth == number for number in range(1, _BLOCKS)]
    for block in blocks:
        errors[block] = _left_out(model, block)
    return errors


def errors_ahead(model: ModelFit) -> Array:
    """Errors of predicting quarters of the later half of the cycles, each as long as the hold-out set, from the cycles before."""
    cycle = model.readings.cycle[model.used]
    numbers = np.unique(cycle)
    quarter = np.searchsorted(numbers, cycle) * _QUARTERS // numbers.size
    later = range(_QUARTERS // 2, _QUARTERS)
    return np.concatenate([_left_out(model, quarter >= one)[quarter[quarter >= one] == one] for one in later])


def _around(model: ModelFit, event_s: float) -> NDArray[np.bool_]:
    """A fifth of the cycles around an event, fewer where that would leave none on one side."""
    cycle = model.readings.cycle[model.used]
    numbers = np.unique(cycle)
    later = model.readings.seconds[model.used] >= event_s
    at = int(np.searchsorted(numbers, cycle[later][0] if later.any() else numbers[-1]))
    half = max(1, min(numbers.size // (2 * _BLOCKS), at - 1, numbers.size - at - 1))
    place = np.searchsorted(numbers, cycle)
    return (place >= at - half) & (place < at + half)


def _left_out(model: ModelFit, block: NDArray[np.bool_]) -> Array:
    """Errors of predicting the readings of a block from those outside it, um."""
    fit = model.fit
    system = replace(fit.system, observed=~block)
    columns = np.column_stack([fit.response, fit.design])
    whitened, _ = system.whiten(columns)
    y, x = prior_rows(model).append(whitened[:, :1], whitened[:, 1:])
    coefficients = solve(x.T @ x, x.T @ y)[:, 0]
    levels = system.smooth(columns).levels
    drift = np.einsum("nc,ncp->np", fit.system.loadings, levels)
    through = columns[:, 1:] - drift[:, 1:]
    errors = columns[:, 0] - drift[:, 0] - through @ coefficients
    site = model.readings.site[model.used]
    return np.where(np.isin(site, site[~block]), errors, np.nan)[block]


class AddedEffect(schema.AxisStep):
    """An effect that was added, with the errors by which it is judged where the hold-out set says nothing of it.

    An error on the hold-out set is NaN for an effect that entered when that set had been opened.
    """

    cross_errors_before_um: Array
    """(n,) errors of predicting blocks of all cycles from the others without it, NaN where there is none; of an event only its block."""
    cross_errors_after_um: Array
    """(n,) the same with it."""


@dataclass(frozen=True, repr=False)
class AxisResult(LoopResult):
    """Result of the closed loop along an axis: what `LoopResult` holds, and

    Attributes
    ----------
    declared_coefficients : coefficients of the declared effects beside those that are confirmed
    before, after : the declared model on the training part, and the final model on all cycles
    """

    noise_share = remainder.DRIFT_SHARE
    level = SECOND_LEVEL

    state: AxisState
    steps: Sequence[AddedEffect]
    remainder: Remainder
    declared_coefficients: list[schema.DeclaredCoefficient]
    before: ModelFit
    after: ModelFit

    def _summary(self) -> list[tuple[str, str]]:
        """What `LoopResult` tells, led by the coefficients with U (k = 2), which holds what one target or part of the test moves."""
        told = [
            (one.effect, measured(one.value, max(one.u or 0.0, one.jackknife_u or 0.0), print_unit(one.unit)))
            for one in self.declared_coefficients
        ]
        for step in self.steps:
            told += [(step.effect, measured(one.value, one.u, print_unit(one.unit))) for one in step.coefficients]
        return [*told, *super()._summary()]

    def described(
        self,
        residual_tests: schema.ResidualTestsPart,
        *,
        field_corrections: Sequence[schema.FieldCorrection] = (),
        axis_line: schema.AxisLine | None = None,
    ) -> schema.AxisLoop:
        """Return the part ``loop`` of results.json, with what was found beside the loop."""
        return schema.AxisLoop(
            **self._described(),
            declared_coefficients=self.declared_coefficients,
            residual_drift=residual_drift_size(self.after),
            noise=_noise_of(self.after),
            search=[[_score_of(score) for score in scored.scores] for scored in self.state.rounds],
            identifiability=[limit for scored in self.state.rounds for limit in scored.detection_limits],
            field_corrections=field_corrections,
            residual_tests=residual_tests,
            axis_line=axis_line,
        )

    @property
    def _terms(self) -> Sequence[Term]:
        return self.after.terms

    @property
    def _drift(self) -> list[Array]:
        return drift_of(self.after)

    @property
    def unexplained(self) -> schema.AxisUnexplained:
        """What is left, with the effect that explains the largest share of it."""
        added = {step.effect for step in self.steps}
        scores = [score for scored in self.state.rounds for score in scored.scores]
        # What explains a large share by chance alone is no lead.
        others = [
            score
            for score in scores
            if score.candidate and score.name not in added and score.family_wise_p <= LEVEL_TO_CONFIRM
        ]
        nearest: dict[str, Any] = {"closest_effect": "", "closest_effect_p": None, "closest_effect_share": None}
        if self.remainder.shape and others:
            shares = [self.remainder.share_of(np.asarray(score.best.columns)) for score in others]
            best = int(np.argmax(shares))
            nearest = {
                "closest_effect": others[best].name,
                "closest_effect_parameters": others[best].best.parameters,
                "closest_effect_p": others[best].family_wise_p,
                "closest_effect_share": shares[best],
            }
        return schema.AxisUnexplained(**self._left(), **nearest)


def _score_of(score: Score) -> schema.AxisScore:
    confirmation = score.confirmation or Confirmation(False, Confirmed.LATER_CYCLES)
    return schema.AxisScore(
        **score.described(),
        held_out_gain=confirmation.gain,
        held_out_p=confirmation.p_value,
        collinear_share=score.collinear,
    )


def report_steps(
    state: LoopState[ModelFit], wrong: Mapping[int, Decision], held_out: Sequence[Answer | None]
) -> list[AddedEffect]:
    """Describe the steps of a loop whose hold-out set has been opened, with what that set says of them."""
    model = state.model
    averaged = average_over_drifts(model) if held_out else model
    crossed, told = [], []
    for place, (term, asked) in enumerate(zip(state.added, held_out, strict=True)):
        without = fit_model(model.readings, state.kept([place]), used=model.used)
        crossed.append([cross_errors(one, term.candidate.event_s) for one in (without, model)])
        # The drift that is carried into the hold-out set has learnt an early step by then.
        answer = asked or _ask_blocks(model, *crossed[-1])
        told.append(replace(answer, against=wrong[place].sentence) if place in wrong else answer)
    contributions = [_contribution(model, term) for term in state.added]
    beside = Surroundings(
        drift_um=wandering_um(model.fit),
        is_smooth=model.fit.system.order == 2,
        total_um=_rms_about_sites(model.readings, model.readings.response),
    )
    sizes = [model.size(term) for term in state.added]
    cross_um = [(rmse(without), rmse(within)) for without, within in crossed]
    described = describe_steps(state, told, contributions, beside, sizes=sizes, cross_um=cross_um)
    return [
        AddedEffect(
            **described[place],
            coefficients=coefficients_of(averaged, term),
            held_out_p=step.score.confirmation.p_value if step.score.confirmation else 1.0,
            cross_errors_before_um=crossed[place][0],
            cross_errors_after_um=crossed[place][1],
            event_cycle=_cycle_at(model.readings, term.candidate.event_s),
        )
        for place, (step, term) in enumerate(zip(state.steps, state.added, strict=True))
    ]


def _contribution(model: ModelFit, term: Term) -> Contribution:
    series, _ = model.series(term)
    _, _, laid = model.readings.by_site(series)
    return Contribution(_rms_about_sites(model.readings, series), leading_pattern(laid), loss_without(model, term))


def _cycle_at(readings: Readings, event_s: float | None) -> int | None:
    """Cycle of the first reading at or after an event, None for an effect that lasts."""
    if event_s is None:
        return None
    later = np.flatnonzero(readings.seconds >= event_s)
    return int(readings.cycle[later[0] if later.size else -1])


def _ask_blocks(model: ModelFit, before_um: Array, after_um: Array) -> Answer:
    """What the blocks that are left out say of an effect, from their errors without it and with it."""
    here = np.isfinite(before_um) & np.isfinite(after_um)
    readings = model.readings.subset(model.used).subset(here)
    rows, loadings, share = np.arange(int(here.sum())), readings.loadings, (before_um - after_um)[here, None]
    (answer,) = answers([Unseen(rows, readings.seconds, loadings, before_um[here], loadings[:, 1:], share)])
    return replace(answer, where="in blocks that are left out")


#: log10 factors on the variance of each walk that are averaged over: below, at and above what was estimated.
_WALKS = (-0.75, 0.0, 0.75)
#: Courses of a smooth drift, as powers of the time since the first reading: settling, trend, slow rhythm.
_POWERS = (0.5, 1.0, 1.5)
#: Its root mean square in units of a reading's noise: from what no test shows to what hides everything else.
_SMOOTH_DRIFT = tuple((10.0 ** np.arange(-2.0, 1.6, 0.5)).tolist())


def average_over_drifts(model: ModelFit) -> ModelFit:
    """The same model with coefficients and covariance averaged over the drifts that the readings leave possible.

    A warm-up that settles, or the rhythm of a day, looks like the effects themselves, and a random walk as large as what is left of it
    beside them knows nothing of it. Drifts are random walks of scaled variances with a smooth common drift and a smooth stretch, each of
    normal coefficients, weighed by their marginal likelihood (Hoeting et al. 1999, Stat. Sci. 14, 382), beforehand alike over the standard
    deviations of the walks (Gelman 2006, Bayesian Anal. 1, 515).
    """
    fit = model.fit
    seconds, loadings = fit.system.seconds, fit.system.loadings
    powers = ((seconds - seconds[0]) / np.ptp(seconds))[:, None] ** np.array(_POWERS)
    courses = (powers - powers.mean(axis=0)) / powers.std(axis=0)
    smooth = np.hstack([courses * loading[:, None] for loading in loadings.T])
    columns, priors = np.column_stack([fit.response, fit.design, smooth]), prior_rows(model)
    known = np.column_stack([priors.response, priors.design, np.zeros((priors.response.size, smooth.shape[1]))])
    own, other = np.arange(1, 1 + fit.design.shape[1]), np.r_[0, 1 + fit.design.shape[1] : columns.shape[1]]
    freedom = seconds.size + priors.response.size - own.size
    found: list[tuple[float, Array, Array]] = []
    for system in scaled_systems(fit, list(product(_WALKS, repeat=loadings.shape[1]))):
        gram, log_spread = system.normal_equations(columns)
        log_spread -= float(np.log(system.ratios).sum())
        gram += known.T @ known
        normal = gram[np.ix_(own, own)]
        scale = np.sqrt(np.diag(normal))
        log_spread += float(np.linalg.slogdet(normal / np.outer(scale, scale))[1])
        through = solve(normal, gram[np.ix_(own, other)])
        inverse = solve(normal, np.eye(own.size)) * max(model.memory.long_run, 1.0)
        left = gram[np.ix_(other, other)] - gram[np.ix_(other, own)] @ through
        for sizes in product(_SMOOTH_DRIFT, repeat=loadings.shape[1]):
            precision = np.repeat(np.array(sizes) ** -2.0, len(_POWERS))
            inner = left[1:, 1:] + np.diag(precision)
            drift = np.linalg.solve(inner, left[1:, 0])
            squares = float(left[0, 0] - left[1:, 0] @ drift)
            log_size = float(np.linalg.slogdet(inner)[1] - np.log(precision).sum())
            likelihood = -0.5 * (freedom * np.log(squares) + log_spread + log_size)
            covariance = inverse + through[:, 1:] @ np.linalg.solve(inner, through[:, 1:].T)
            found.append((likelihood, through[:, 0] - through[:, 1:] @ drift, squares / freedom * covariance))
    likelihood = np.array([one[0] for one in found])
    weight = np.exp(likelihood - likelihood.max())
    weight /= weight.sum()
    values = np.array([one[1] for one in found])
    mean = weight @ values
    about = values - mean
    covariance = np.tensordot(weight, np.array([one[2] for one in found]), 1) + (about.T * weight) @ about
    return replace(model, fit=replace(fit, coefficients=mean, covariance=covariance))


def drift_of(model: ModelFit) -> list[Array]:
    """What every term of a model of all readings makes of the drift, and last its random drift, about the mean of every site, um."""
    parts = [*(model.series(term)[0] for term in model.terms), unexplained_drift(model.fit)[0].sum(axis=1)]
    return [_about_sites(model.readings.site, part) for part in parts]


def shown_by_one_warm_up(model: ModelFit, declared: int) -> tuple[str, ...]:
    """Return the declared effects that the readings show by one warm-up alone."""
    free, columns = free_warm_ups(model.readings.subset(model.used)), np.arange(model.fit.design.shape[1])
    return tuple(
        term.effect
        for term in model.terms[:declared]
        if is_shown_by_one_warm_up([model.fit], [np.isin(columns, columns[model.place(term)])], [free])
    )


def coefficients_beside(
    problem: AxisProblem, state: AxisState, steps: Sequence[AddedEffect]
) -> list[schema.DeclaredCoefficient]:
    """Coefficients of the declared effects beside the added ones; those that unseen readings do not support must not move them."""
    unsupported = unsupported_places(steps)
    sure = fit_model(problem.readings, state.kept(unsupported)) if unsupported else state.model
    return declared_coefficients(sure, len(state.declared), moved_by_rivals(problem, state, steps, sure))


def moved_by_rivals(problem: AxisProblem, state: AxisState, steps: Sequence[AddedEffect], model: ModelFit) -> Array:
    """Variances (p,) by which coefficients move where an added effect has other parameters, is one of its rivals, or, without a name, is
    not there: the square of each move over twice the log-likelihood that it costs, at most the square, the largest for each effect.

    A cost counts as between rivals, because the library's shape is no better known; the variances of the drift are kept.
    """
    variances = np.zeros(model.fit.coefficients.size)
    declared = slice(0, model.place(model.terms[len(state.declared) - 1]).stop if state.declared else 0)
    before = (model.static().T @ model.fit.coefficients)[declared]
    for step, term, told in zip(state.steps, state.added, steps, strict=True):
        if not any(term is kept for kept in model.terms):
            continue
        blurred = blur(model.size(term))
        others = [[Term(step.effect, one)] for one in problem.alike(step.score, model)]
        others += [[Term(score.name, score.best)] for score in step.round.scores if score.name in told.tied]
        squares = [np.zeros(before.size)]
        for other in [*others, *([[]] if told.withheld else [])]:
            terms = tuple(one for own in model.terms for one in (other if own is term else [own]))
            try:
                fit = refit_fixed(model, terms)
            except DriftModelError:
                # What the other effects of the model contain is no rival.
                continue
            cost = 0.5 * fit.response.size * float(np.log(fit.rss / model.fit.rss)) if other else 0.0
            instead = replace(model, terms=terms, fit=fit)
            for combination, prior in instead.priors():
                fit = condition(fit, combination, prior)
            moved = (instead.static().T @ fit.coefficients)[declared] - before
            squares.append(moved**2 / max(2.0 * cost / blurred, 1.0))
        variances[declared] += np.max(squares, axis=0)
    return variances


def declared_coefficients(
    model: ModelFit, declared: int, moved: Array | float = 0.0
) -> list[schema.DeclaredCoefficient]:
    """Coefficients of the declared effects, lagged copies included, and how far they move when parts of the readings are left out; their
    variances contain those by rivals of the added effects, ``moved`` (p,).
    """
    spread, static = coefficient_spread(model), model.static()
    model = average_over_drifts(model)
    covariance = static.T @ model.fit.covariance @ static + moved * np.eye(static.shape[1])
    model = replace(model, fit=replace(model.fit, coefficients=model.fit.coefficients @ static, covariance=covariance))
    return [
        schema.DeclaredCoefficient(effect=term.effect, jackknife_u=moved, **coefficient.model_dump(exclude_unset=True))
        for term in model.terms[:declared]
        for coefficient, moved in zip(coefficients_of(model, term), spread[model.place(term)], strict=True)
    ]


def coefficients_of(model: ModelFit, term: Term) -> list[schema.Coefficient]:
    """Coefficients of a term with standard uncertainty and unit, and with the prior that went into the first one."""
    place, prior = model.place(term), term.candidate.prior
    values, u = model.fit.coefficients[place], model.fit.coefficients_u[place]
    expected = {} if prior is None else {"prior": prior.mean, "prior_u": prior.u}
    return [
        schema.Coefficient(value=value, u=spread, unit=unit, **({} if k else expected))
        for k, (value, spread, unit) in enumerate(zip(values, u, term.candidate.units, strict=True))
    ]


def _rms_about_sites(readings: Readings, values: Array) -> float:
    """Root mean square of values after their mean at every site is removed."""
    return float(np.sqrt(np.mean(_about_sites(readings.site, values) ** 2)))


def _about_sites(site: NDArray[np.int64], values: Array) -> Array:
    """Values less their mean at every site, (n,)."""
    return np.asarray(values - (np.bincount(site, values) / np.maximum(np.bincount(site), 1))[site])


def _noise_of(model: ModelFit) -> schema.NoisePart:
    """Noise of a reading with its memory within a pass and over the cycles."""
    within = model.fit.system.memory
    return schema.NoisePart(
        reading_um=model.fit.sigma,
        shared_share=within.share if within else 0.0,
        correlation_time_s=within.time_s if within else None,
        cycle_correlation=float(model.memory.weights.sum()),
    )


def residual_drift_size(model: ModelFit) -> schema.ResidualDrift:
    """Size of the unexplained drift beside profile and effects: of its common part and of its stretch."""
    drift, _ = unexplained_drift(model.fit)
    common, stretch = model.fit.drift_rate[:2]
    sizes = {
        "common_rms_um": np.sqrt(np.mean(drift[:, 0] ** 2)),
        "stretch_rms_um": np.sqrt(np.mean(drift[:, 1] ** 2)),
    }
    if model.fit.system.order == 1:
        return schema.ResidualDrift(
            kind="random walk", **sizes, common_um_per_sqrt_h=common, stretch_um_per_sqrt_h=stretch
        )
    return schema.ResidualDrift(
        kind="integrated random walk", **sizes, common_um_in_1_h=common, stretch_um_in_1_h=stretch
    )
