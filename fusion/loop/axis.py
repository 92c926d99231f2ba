"""The closed loop on a positioning campaign: readings along an axis, a hold-out set of the last cycles, a second look at all of them.

The last fifth of the cycles is held out. After the search on the others the hold-out set is opened once: the error before and after is
that of predicting these cycles in open loop with frozen coefficients. What acted only there is searched for in a second look, which has
no held-out error any more.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from operator import is_

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from fusion._typing import Array
from fusion.alignment.readings import Readings
from fusion.diagnosis import remainder
from fusion.effects.effect import Candidate, Effect
from fusion.effects.jumps import cycle_starts
from fusion.effects.library import LIBRARY, library
from fusion.errors import FusionError
from fusion.loop.admissibility import AxisGrounds, refuse
from fusion.loop.axis_pattern import wrong_patterns
from fusion.loop.baselines import ErrorInterval, error_interval, plain_errors
from fusion.loop.closed_loop import (
    HOLD_OUT_SHARE,
    MOST_EFFECTS,
    MOST_EVENTS,
    Progress,
    choose,
    drop_superfluous,
    no_progress,
    open_hold_out,
    search,
    withdraw,
)
from fusion.loop.confirmation import CandidateScorer, ask_hold_out
from fusion.loop.decisions import FINAL, Decision, Reason
from fusion.loop.detectability import detection_limits
from fusion.loop.restless_drift import refuse_in_restless_drift
from fusion.loop.result import AddedEffect, LoopResult, declared_coefficients, nuisance_size, report_steps, rmse
from fusion.loop.scoring import (
    WORTH_CONFIRMING,
    Families,
    collect_candidates,
    kept_on_disk,
    of_same_kind,
    refine,
    score_effects,
)
from fusion.loop.state import Confirmed, HoldOutQuestion, LoopState, Round, Score
from fusion.loop.verdict import has_skill
from fusion.model.fit import ModelFit, Term, again, fit_model, refit_fixed, settled

LEAST_CYCLES = 10
#: Shares of the probability of adding an effect under the null hypothesis, over everything that is tried (2.5 %): the search, and the
#: second look. Every effect that is found opens the search again with the same probability, and a campaign may lack two: half of the 5 %
#: that a wrong name may have.
SEARCH_LEVEL, SECOND_LEVEL = 0.02, 0.005
ENTRY_LEVEL = SEARCH_LEVEL + SECOND_LEVEL
#: An effect with a larger p-value, uncorrected, is not worth a question to the hold-out set.
_WORTH_ASKING = 0.1
_BUILT_IN = frozenset(effect.name for effect in LIBRARY)

AxisState = LoopState[ModelFit]


class LoopError(FusionError):
    """The campaign cannot be modelled; the message says what is missing."""


# Threaded BLAS is many times slower than one thread on matrices of a few dozen columns.
@threadpool_limits.wrap(limits=1, user_api="blas")
def close_loop(
    readings: Readings,
    declared: Sequence[str],
    *,
    seed: int = 1,
    set_aside: Collection[tuple[int, str]] = (),
    effects: Mapping[str, Effect] | None = None,
    progress: Progress = no_progress,
) -> LoopResult:
    """Close the loop on a positioning campaign.

    Parameters
    ----------
    readings : n readings in um with times, targets and directions, and what was seen and logged beside them
    declared : names of the effects the user believes to act
    seed : of the simulated campaigns behind the p-values, so that a run can be repeated
    set_aside : sites (target, direction) whose anomaly has its own diagnosis
    effects : the library by name; the built-in one with the user's own by default
    progress : called with steps done, steps in total, and what is done

    Returns
    -------
    LoopResult
        Steps with their errors on the hold-out set in um, verdict, what remains, and both models.

    Raises
    ------
    LoopError
        if fewer than 10 cycles are there, or a declared effect cannot be computed from these readings.

    Notes
    -----
    Procedure, assumptions and error rates: docs/method/closed-loop.md.
    """
    effects = library() if effects is None else effects
    used, description = hold_out(readings)
    terms = declare(readings, declared, effects)
    progress(0, MOST_EFFECTS + 2, "fitting the declared model")
    problem = AxisProblem(readings, used, effects, np.random.default_rng(seed))
    start = problem.start(terms)
    state = search(problem, start, progress=progress)
    state = keep_right_patterns(problem, state)
    progress(MOST_EFFECTS, MOST_EFFECTS + 2, "opening the hold-out set")
    state = problem.ask_hold_out(open_hold_out(problem, state))
    decided = state.model.terms
    state = replace(state, model=settled(fit_model(readings, decided), effects))
    progress(MOST_EFFECTS + 1, MOST_EFFECTS + 2, "second look, at all cycles")
    state = keep_right_patterns(problem, look_again(problem, state))
    left = examine_remainder(state.model, seed, set_aside)
    steps = report_steps(state, wrong_patterns(state.model, state.added, effects))
    errors = errors_on_hold_out(problem, {"declared": terms, "final": decided}) | plain_errors(readings, used)
    result = LoopResult(
        declared=list(declared),
        declared_coefficients=declared_coefficients(without_doubtful(state, steps), len(terms)),
        held_out=description,
        noise_floor_um=state.model.fit.sigma,
        rmse_declared_um=state.errors_um[0],
        rmse_final_um=state.errors_um[-1],
        hold_out=hold_out_intervals(errors, readings.cycle[~used], seed),
        hold_out_errors=errors,
        skill=problem.has_skill(state),
        steps=steps,
        unnamed=state.unnamed(SECOND_LEVEL),
        remainder=left,
        nuisance=nuisance_size(state.model),
        state=state,
        before=start.model,
        after=state.model,
    )
    progress(MOST_EFFECTS + 2, MOST_EFFECTS + 2, "loop closed")
    return result


class AxisProblem:
    """The readings of a campaign, the training part of them, and the library, for :mod:`fusion.loop.closed_loop`."""

    def __init__(
        self, readings: Readings, used: NDArray[np.bool_], effects: Mapping[str, Effect], rng: np.random.Generator
    ) -> None:
        self.readings, self.used, self.effects, self.rng = readings, used, effects, rng
        self._fits: deque[ModelFit] = deque(maxlen=2 * MOST_EFFECTS)

    def start(self, declared: Sequence[Term]) -> AxisState:
        """The state before the search: the declared model, and the effects that these readings cannot show."""
        present = {term.effect for term in declared}
        missing = {
            name: effect.needs(self.readings) or (None if name in present else effect.masked_by(self.readings))
            for name, effect in self.effects.items()
        }
        return AxisState(self.fitted(declared)).decide(
            *(
                Decision(name, Reason.NOT_AVAILABLE, {"because": because})
                for name, because in missing.items()
                if because is not None
            )
        )

    def fitted(self, terms: Sequence[Term]) -> ModelFit:
        """The model of these terms on the training part, fitted once: the search and the hold-out set ask for the same ones."""
        for model in self._fits:
            if len(model.terms) == len(terms) and all(map(is_, model.terms, terms)):
                return model
        self._fits.append(fit_model(self.readings, terms, used=self.used))
        return self._fits[-1]

    def refit(self, model: ModelFit, terms: Sequence[Term]) -> ModelFit:
        """Fit other terms to the readings that a model was fitted to."""
        if model.used is self.used:
            return self.fitted(terms)
        return fit_model(self.readings, terms, used=model.used)

    def score(self, state: AxisState) -> Round:
        """Score the library; effects worth it are looked at more closely before they are compared, and are confirmed."""
        model = state.model
        scorer = CandidateScorer.of(model, self.rng)
        families, faults = self._families(state)
        if not families:
            return Round((), tuple(faults))
        products = scorer.products([candidate for candidates in families.values() for candidate in candidates])
        scores, decisions = score_effects(families, scorer.gains_by(products), level=SEARCH_LEVEL)
        limits = (
            () if state.rounds else tuple(detection_limits(scorer, products, model, families, scores, self.effects))
        )
        measured = partial(scorer.gains, simulated=False)
        worth = [
            refine(score, partial(self._near, score.name, model), measured)
            for score in scores
            if score.candidate is not None and score.p_value < WORTH_CONFIRMING
        ]
        confirmed = {score.name: score for score in scorer.confirm(worth, families)}
        closer = [confirmed.get(score.name, score) for score in scores]
        return Round(
            tuple(sorted(closer, key=lambda score: -score.excess)),
            (*faults, *decisions),
            detection_limits=limits,
        )

    def entry_level(self, score: Score) -> float:
        """Level of the search before the hold-out set is opened."""
        return SEARCH_LEVEL

    def refuse(self, score: Score, model: ModelFit) -> Decision | None:
        """Refuse an effect that these readings do not identify, and an event that restless drift explains as well."""
        refusal = refuse(score.name, self.effects[score.name].excited_by, score.best, AxisGrounds(model))
        return refusal or refuse_in_restless_drift(score, model)

    def confirm(self, score: Score, state: AxisState) -> Score:
        """Return the score: it was confirmed when it was scored."""
        return score

    def loss_without(self, model: ModelFit, term: Term) -> float:
        """Log-likelihood lost without a term, the drift's variances kept."""
        kept = [other for other in model.terms if other is not term]
        return 0.5 * model.fit.response.size * float(np.log(refit_fixed(model, kept).rss / model.fit.rss))

    def hold_out_error(self, terms: Sequence[Term]) -> float:
        """Open-loop error on the hold-out cycles, root mean square, um."""
        return rmse(self.hold_out_errors(terms))

    def hold_out_errors(self, terms: Sequence[Term]) -> Array:
        """Open-loop errors on the hold-out cycles, um; an event among them is sized on one half of the targets, tested on the other."""
        if not any(self.is_late(term) for term in terms):
            return self.fitted(terms).open_loop_errors()[0]
        half = self.readings.target_index % 2 == 0
        errors = np.full(self.used.size, np.nan)
        for fitted in (half, ~half):
            used = self.used | fitted
            errors[~used] = fit_model(self.readings, terms, used=used).open_loop_errors()[0]
        return errors[~self.used]

    def has_skill(self, state: AxisState) -> bool:
        """Whether the final model predicts the hold-out cycles better than the last values and the means before them."""
        late = any(step.confirmed is Confirmed.SECOND_LOOK for step in state.steps)
        error_um = self.hold_out_error(state.model.terms) if late else state.errors_um[-1]
        plain = {name: rmse(errors) for name, errors in plain_errors(self.readings, self.used).items()}
        return has_skill(error_um, plain["last_value"], plain["mean"], state.model.fit.sigma, remainder.DRIFT_SHARE)

    def ask_hold_out(self, state: AxisState) -> AxisState:
        """Say what the hold-out set thinks of the strongest candidate that the search could not decide on; it enters in no case.

        One question, chosen before the hold-out set is opened, needs no correction for the search.
        """
        blocked = state.blocked()
        for score in state.rounds[-1].scores:
            if score.candidate is None or score.p_value > _WORTH_ASKING or score.name in blocked:
                continue
            refusal = self.refuse(score, state.model)
            if refusal is not None:
                state = state.decide(replace(refusal, evidence={**refusal.evidence, "search_p": score.family_wise_p}))
                continue
            answer = ask_hold_out(state.model, score.best, self.rng)
            return replace(state, question=HoldOutQuestion(score.name, score.best.parameters, *answer))
        return state

    def is_late(self, term: Term) -> bool:
        """Whether a term is an event among the hold-out cycles, of which the cycles before say nothing."""
        first = self.readings.seconds[~self.used].min()
        cycle_s = float(np.median(np.diff(cycle_starts(self.readings))))
        return term.candidate.event_s is not None and term.candidate.event_s >= first - cycle_s

    def _families(self, state: AxisState) -> tuple[Families, list[Decision]]:
        """Candidates of every effect that can be tried beside the model, those without any left out."""
        model, not_tried = state.model, state.not_tried()
        repeating = {name for name, effect in self.effects.items() if effect.repeats}
        present = {term.effect for term in model.terms} - repeating
        # One event happens once, however its column was weighed when it was found.
        happened = {(term.effect, term.candidate.event_s) for term in model.terms if term.candidate.event_s is not None}

        def offer(name: str) -> list[Candidate]:
            offered = self.effects[name].candidates(self.readings, model.coefficients(), None)
            return list(kept_on_disk(one for one in offered if (name, one.event_s) not in happened))

        offers = {name: partial(offer, name) for name in self.effects if name not in not_tried and name not in present}
        families, faults = collect_candidates(offers, self.readings.seconds.size, built_in=_BUILT_IN)
        inside = {name: self._inside(candidates, model) for name, candidates in families.items()}
        return {name: candidates for name, candidates in inside.items() if candidates}, faults

    def _inside(self, candidates: Sequence[Candidate], model: ModelFit) -> list[Candidate]:
        """Candidates whose event, if they have one, has enough cycles on both sides."""
        starts = cycle_starts(self.readings.subset(model.used))
        return [
            candidate
            for candidate in candidates
            if candidate.event_s is None or starts[2] <= candidate.event_s <= starts[-2]
        ]

    def _near(self, name: str, model: ModelFit, chosen: Candidate) -> list[Candidate]:
        """Candidates of an effect about one that was chosen."""
        offered = self.effects[name].candidates(self.readings, model.coefficients(), chosen)
        return self._inside([candidate for candidate in offered if of_same_kind(candidate, chosen)], model)


def hold_out(readings: Readings) -> tuple[NDArray[np.bool_], str]:
    """Divide the cycles into a training part and a hold-out set.

    Parameters
    ----------
    readings : n readings

    Returns
    -------
    used : (n,) True for the training part
    description : which cycles are held out, and how they are predicted

    Raises
    ------
    LoopError
        if fewer than 10 cycles are there.
    """
    numbers = np.unique(readings.cycle)
    if numbers.size < LEAST_CYCLES:
        raise LoopError(
            f"{numbers.size} cycles are too few to hold some out and to model the others; measure at least {LEAST_CYCLES}, better 50"
        )
    first = numbers[-max(2, round(HOLD_OUT_SHARE * numbers.size))]
    return (
        readings.cycle < first,
        f"cycles {first} to {numbers[-1]} held out; coefficients frozen at cycle {first - 1}, drift state carried in open loop",
    )


def declare(readings: Readings, declared: Sequence[str], effects: Mapping[str, Effect]) -> list[Term]:
    """Make the terms of the declared model.

    Parameters
    ----------
    readings : n readings
    declared : names of effects
    effects : the library by name

    Raises
    ------
    LoopError
        if a name is unknown, or the effect cannot be computed from these readings, is zero at all of them, or has parameters that are not
        known beforehand.
    """
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
                f"declared effect {name!r} has parameters that are not known beforehand; leave it out of [model] declared, the "
                "search tries it anyway"
            )
        if not np.any(candidates[0].columns):
            raise LoopError(
                f"declared effect {name!r} is zero at every reading: what it follows does not change during the test; check that the "
                "frames are not copies of one (camera frozen) and that the logs move, or leave it out of [model] declared"
            )
        terms.append(Term(name, replace(candidates[0], prior=effects[name].prior)))
    return terms


def look_again(problem: AxisProblem, state: AxisState) -> AxisState:
    """Search once more, in all cycles: what acted only in the hold-out set could not be found before.

    An effect that enters now has no held-out error, and those that were decided on the training part stay. Where one of those was
    withdrawn for its pattern nothing is searched for: the library does not hold it, and what would be found stands in for it.

    Parameters
    ----------
    problem : the campaign
    state : with a model fitted to all readings and the hold-out errors of its steps
    """
    decided = len(state.steps)
    if any(decision.reason in FINAL for decision in state.decisions):
        return state
    while len(state.steps) < MOST_EFFECTS:
        state, score = choose(problem, state.scored(problem.score(state)), level=SECOND_LEVEL)
        if score is None or state.events + (score.name == "step_event") > MOST_EVENTS:
            return state
        model = settled(
            fit_model(problem.readings, [*state.model.terms, Term(score.name, score.best)]), problem.effects
        )
        state = drop_superfluous(problem, state.entered(model, score, Confirmed.SECOND_LOOK), first=decided)
    return state


def keep_right_patterns(problem: AxisProblem, state: AxisState) -> AxisState:
    """Withdraw the name of an effect whose pattern along the axis is not what the readings show; it was the nearest, not the cause.

    What was found after it goes with it: it was judged beside a pattern that was not there.

    Parameters
    ----------
    problem : the campaign
    state : after the search, or after the second look; what was decided before the hold-out set was opened stays in that case
    """
    open_now = [place for place, step in enumerate(state.steps) if not state.errors_um or step.is_late_entry]
    wrong = wrong_patterns(state.model, state.added, problem.effects)
    wrong = {place: decision for place, decision in wrong.items() if place in open_now}
    if not wrong:
        return state
    first = min(wrong)
    places = range(first, len(state.steps))
    beside = {"beside": state.steps[first].effect}
    decisions = [
        wrong.get(place, Decision(state.steps[place].effect, Reason.BESIDE_WRONG_PATTERN, beside)) for place in places
    ]
    decisions = [
        replace(decision, evidence={**decision.evidence, "search_p": state.steps[place].score.family_wise_p})
        for place, decision in zip(places, decisions, strict=True)
    ]
    return keep_right_patterns(problem, withdraw(problem, state, places, decisions))


def without_doubtful(state: AxisState, steps: Sequence[AddedEffect]) -> ModelFit:
    """The final model without the effects that are not confirmed: those must not move the coefficients of the declared ones.

    Parameters
    ----------
    state : after the second look
    steps : its steps as they are reported
    """
    doubtful = [place for place, step in enumerate(steps) if not step.confirmed]
    return state.model if not doubtful else fit_model(state.model.readings, state.kept(doubtful))


def errors_on_hold_out(problem: AxisProblem, models: Mapping[str, Sequence[Term]]) -> dict[str, Array]:
    """Open-loop errors on the hold-out cycles of some models, (n_held_out,) each, um.

    Parameters
    ----------
    problem : the campaign
    models : terms by the name of the model
    """
    return {name: problem.hold_out_errors(terms) for name, terms in models.items()}


def hold_out_intervals(errors: Mapping[str, Array], cycles: NDArray[np.int64], seed: int) -> dict[str, ErrorInterval]:
    """Root mean square errors on the hold-out cycles with their intervals.

    Parameters
    ----------
    errors : (n_held_out,) each, um, by the name of the model or of the plain prediction
    cycles : (n_held_out,) cycle of every reading
    seed : of the bootstrap
    """
    return {name: error_interval(values, cycles, np.random.default_rng(seed)) for name, values in errors.items()}


def examine_remainder(model: ModelFit, seed: int, set_aside: Collection[tuple[int, str]]) -> remainder.Remainder:
    """Describe what a model leaves: a shape among the sites or, where there is none, an unexplained drift of all of them.

    Parameters
    ----------
    model : fitted to all readings
    seed : of the permutations
    set_aside : sites (target, direction) whose anomaly has its own diagnosis
    """
    left = remainder.examine(model.readings, model.fit, np.random.default_rng(seed), set_aside=set_aside)
    return left if left.shape else remainder.with_drift(left, model.fit)


def set_aside_sites(result: LoopResult, sites: Collection[tuple[int, str]], *, seed: int = 1) -> LoopResult:
    """Count sites whose anomaly has its own diagnosis no longer as a remainder.

    Parameters
    ----------
    result : of :func:`close_loop`
    sites : (target, direction)
    seed : of the permutations
    """
    return replace(result, remainder=examine_remainder(result.after, seed, sites))


def on_corrected_fields(
    result: LoopResult,
    readings: Readings,
    errors: Collection[str],
    *,
    effects: Mapping[str, Effect] | None = None,
    seed: int = 1,
) -> LoopResult:
    """Fit the model again on fields from which the camera's errors have been taken out.

    Parameters
    ----------
    result : with the camera's errors as effects
    readings : the same readings beside the corrected fields
    errors : names of the effects that the correction has made superfluous
    effects : the library by name; the built-in one with the user's own by default
    seed : of the permutations
    """
    effects = library() if effects is None else effects
    kept = [term for term in result.after.terms if term.effect not in errors]
    terms = [again(term, readings, result.after.coefficients(), effects) for term in kept]
    used, _ = hold_out(readings)
    problem = AxisProblem(readings, used, effects, np.random.default_rng(seed))
    model = fit_model(readings, terms)
    late = {id(term) for term, step in zip(result.state.added, result.state.steps, strict=True) if step.is_late_entry}
    decided = [term for term, old in zip(terms, kept, strict=True) if id(old) not in late]
    errors_now = errors_on_hold_out(problem, {"final": decided})
    hold_out_now = hold_out_intervals(errors_now, readings.cycle[~used], seed)
    return replace(
        result,
        declared_coefficients=declared_coefficients(model, len(result.declared)),
        noise_floor_um=model.fit.sigma,
        rmse_final_um=hold_out_now["final"].rmse_um,
        hold_out={**result.hold_out, **hold_out_now},
        hold_out_errors={**result.hold_out_errors, **errors_now},
        remainder=examine_remainder(model, seed, ()),
        nuisance=nuisance_size(model),
        after=model,
    )
