"""The closed loop: model the drift, find what the model lacks, name it or leave it unnamed, and prove it on unseen cycles.

The last fifth of the cycles is sealed. On the others the declared model is fitted, the library of effects is searched, and an effect
enters only if its gain exceeds what the whole search finds by chance where nothing is missing, and holds on readings that its
coefficients were not fitted to. Then the seal is opened once: the error before and after is that of predicting the sealed cycles in
open loop with frozen coefficients. Procedure and its error rates: statistics study, section 3.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from fusion.alignment.readings import Readings
from fusion.diagnosis import remainder
from fusion.effects.jumps import cycle_starts
from fusion.effects.library import Effect, library
from fusion.errors import FusionError
from fusion.loop.axis_pattern import wrong_patterns
from fusion.loop.result import LoopResult, Step, coefficients_of, make_step, nuisance_size, persistence, rmse
from fusion.loop.scoring import FamilyScore
from fusion.loop.search import SECOND_LEVEL, Search, candidate_of
from fusion.model.fit import ModelFit, Term, again, fit_model, refit_fixed, settled

SEALED_SHARE = 0.2
MOST_EFFECTS = 4
_SUPERFLUOUS_GAIN = 2.0
#: An effect is withdrawn where the error on the sealed cycles grows by more than this factor with it.
_WORSE = 1.05
#: More events than this are no events but a switching that the library has no name for.
MOST_EVENTS = 2

Progress = Callable[[int, int, str], None]
Chosen = list[tuple[FamilyScore, list[FamilyScore]]]


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
    progress: Progress | None = None,
) -> LoopResult:
    """Close the loop on a positioning campaign.

    Parameters
    ----------
    readings : what was measured, seen and logged
    declared : names of the effects the user believes to act
    seed : of the simulated campaigns behind the p-values, so that a run can be repeated
    set_aside : sites (target, direction) whose anomaly has its own diagnosis
    effects : the library; the built-in one with the user's own by default

    Raises
    ------
    LoopError
        if fewer than 10 cycles are there, or a declared effect cannot be computed from these readings.
    """
    effects = library() if effects is None else effects
    rng = np.random.default_rng(seed)
    report = progress or (lambda done, total, what: None)
    used, description = seal(readings)
    terms = _declare(readings, declared, effects)
    report(0, MOST_EFFECTS + 2, "fitting the declared model")
    search = Search(readings, used, effects, rng)
    models, chosen, rounds = _search_before_seal(search, terms, report)
    report(MOST_EFFECTS, MOST_EFFECTS + 2, "opening the sealed cycles")
    models, chosen, errors = _open_seal(search, models, chosen)
    whole = settled(fit_model(readings, models[-1].terms), effects)
    steps = [
        make_step(whole, whole.terms[len(terms) + k], score, scores, errors[k], errors[k + 1])
        for k, (score, scores) in enumerate(chosen)
    ]
    report(MOST_EFFECTS + 1, MOST_EFFECTS + 2, "second look, at all cycles")
    whole, steps = _second_look(search, whole, steps, errors[-1], rounds)
    whole, steps = _keep_right_patterns(search, whole, steps, len(terms))
    remainder = _remainder(whole, seed, set_aside)
    report(MOST_EFFECTS + 2, MOST_EFFECTS + 2, "loop closed")
    return LoopResult(
        declared=list(declared),
        declared_coefficients=_declared_coefficients(whole, len(terms)),
        held_out=description,
        noise_floor_um=whole.fit.sigma,
        rmse_persistence_um=persistence(readings, used),
        rmse_declared_um=errors[0],
        rmse_final_um=steps[-1].rmse_after_um if steps else errors[0],
        steps=steps,
        verdict=_verdict(bool(steps), bool(remainder.shape)),
        remainder=remainder,
        rounds=rounds,
        not_tried=search.not_tried,
        blocked=search.blocked,
        question=search.question,
        identifiable=search.identifiable,
        nuisance=nuisance_size(whole),
        before=models[0],
        after=whole,
    )


def _search_before_seal(
    search: Search, terms: list[Term], report: Progress
) -> tuple[list[ModelFit], Chosen, list[list[FamilyScore]]]:
    """Add effects one by one on the cycles that are not sealed: every model in turn, what was added, and all scores."""
    models, rounds = [search.fit(terms)], list[list[FamilyScore]]()
    chosen: Chosen = []
    # Effects may be dropped again, so rounds are counted, not effects.
    for number in range(1, MOST_EFFECTS + 1):
        report(number, MOST_EFFECTS + 2, f"searching for effect {number}")
        scores = search.scores(models[-1])
        rounds.append(scores)
        best = search.choose(scores, models[-1])
        if best is None:
            asked = search.ask_sealed(scores, models[-1])
            if asked is not None:
                chosen.append((asked, scores))
                models.append(search.fit([*models[-1].terms, Term(asked.name, candidate_of(asked))]))
            break
        chosen.append((best, scores))
        models.append(search.fit([*models[-1].terms, Term(best.name, candidate_of(best))]))
        models, chosen = _re_examine(search, models, chosen)
        if sum(score.name == "step_event" for score, _ in chosen) > MOST_EVENTS:
            models, chosen = _without_events(search, models, chosen)
            break
    return models, chosen, rounds


def set_aside_sites(found: LoopResult, sites: Collection[tuple[int, str]], *, seed: int = 1) -> LoopResult:
    """The same result with sites (target, direction) whose anomaly has its own diagnosis no longer counted as a remainder."""
    remainder = _remainder(found.after, seed, sites)
    return replace(found, remainder=remainder, verdict=_verdict(bool(found.steps), bool(remainder.shape)))


def on_corrected_fields(
    found: LoopResult,
    readings: Readings,
    errors: Collection[str],
    *,
    effects: Mapping[str, Effect] | None = None,
    seed: int = 1,
) -> LoopResult:
    """The same result with the model fitted again on fields from which the camera's errors have been taken out.

    Parameters
    ----------
    found : with the camera's errors as effects
    readings : the same readings beside the corrected fields
    errors : names of the effects that the correction has made superfluous
    """
    effects = library() if effects is None else effects
    terms = [
        again(term, readings, found.after.coefficients(), effects)
        for term in found.after.terms
        if term.effect not in errors
    ]
    used, _ = seal(readings)
    whole = fit_model(readings, terms)
    remainder = _remainder(whole, seed, ())
    return replace(
        found,
        declared_coefficients=_declared_coefficients(whole, len(found.declared)),
        noise_floor_um=whole.fit.sigma,
        rmse_final_um=_sealed_error(readings, used, terms),
        verdict=_verdict(bool(found.steps), bool(remainder.shape)),
        remainder=remainder,
        nuisance=nuisance_size(whole),
        after=whole,
    )


def _declared_coefficients(whole: ModelFit, declared: int) -> list[dict[str, float | str]]:
    return [
        {"effect": term.effect, **entry} for term in whole.terms[:declared] for entry in coefficients_of(whole, term)
    ]


def _remainder(whole: ModelFit, seed: int, set_aside: Collection[tuple[int, str]]) -> remainder.Remainder:
    """What is left: a shape among the sites, or, where there is none, a drift of all of them that nothing explains."""
    found = remainder.examine(whole.readings, whole.fit, np.random.default_rng(seed), set_aside=set_aside)
    return found if found.shape else remainder.with_drift(found, whole.fit)


def _verdict(added: bool, left: bool) -> str:
    if added:
        return "partial" if left else "explained"
    return "unexplained" if left else "complete"


def seal(readings: Readings) -> tuple[NDArray[np.bool_], str]:
    """Readings that the search may use, and a sentence that says which cycles are sealed."""
    numbers = np.unique(readings.cycle)
    if numbers.size < 10:
        raise LoopError(
            f"{numbers.size} cycles are too few to hold some out and to model the others; measure at least 10, better 50"
        )
    first = numbers[-max(2, round(SEALED_SHARE * numbers.size))]
    used = readings.cycle < first
    return (
        used,
        f"cycles {first}-{numbers[-1]} sealed; coefficients frozen at cycle {first - 1}, drift state carried in open loop",
    )


def _declare(readings: Readings, declared: Sequence[str], effects: Mapping[str, Effect]) -> list[Term]:
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
        terms.append(Term(name, replace(candidates[0], prior=effects[name].prior)))
    return terms


def _open_seal(search: Search, models: list[ModelFit], chosen: Chosen) -> tuple[list[ModelFit], Chosen, list[float]]:
    """Errors on the sealed cycles of every model in turn; an effect beside which the others do better without it is withdrawn.

    Every effect is judged beside all others: alone it may make the error larger, as long as what else is missing bends the drift. An event
    before the seal shifts a level that the carried drift has learnt by then, so it is not judged by this error. What is withdrawn may come
    back in the look at all cycles, where its time constant is known better.
    """
    errors = [rmse(model.open_loop_errors()[0]) for model in models]
    lasting = [k for k, (score, _) in enumerate(chosen) if candidate_of(score).event_s is None]
    without = {k: _rebuild(search, models[0], [pair for j, pair in enumerate(chosen) if j != k]) for k in lasting}
    error_without = {k: rmse(rebuilt[-1].open_loop_errors()[0]) for k, (rebuilt, _) in without.items()}
    worst = min(error_without, key=lambda k: error_without[k], default=None)
    if worst is None or errors[-1] <= _WORSE * error_without[worst]:
        return models, chosen, errors
    score = chosen[worst][0]
    search.blocked[score.name] = (
        f"withdrawn at the seal: it was found before (p = {score.family_wise_p:.2g}), but the error on the sealed cycles rose from "
        f"{error_without[worst]:.3f} to {errors[-1]:.3f} um with it"
    )
    return _open_seal(search, *without[worst])


def _re_examine(search: Search, models: list[ModelFit], chosen: Chosen) -> tuple[list[ModelFit], Chosen]:
    """Drop an effect that a later one has made superfluous: its log-likelihood gain beside the others is below 2."""
    model = models[-1]
    declared = len(models[0].terms)
    for k in range(len(chosen) - 1):
        if _loss(model, [term for j, term in enumerate(model.terms) if j != declared + k]) < _SUPERFLUOUS_GAIN:
            return _rebuild(search, models[0], [pair for j, pair in enumerate(chosen) if j != k])
    return models, chosen


def _without_events(search: Search, models: list[ModelFit], chosen: Chosen) -> tuple[list[ModelFit], Chosen]:
    """Take all events out again: so many of them are a switching without a name."""
    search.blocked["step_event"] = (
        f"more than {MOST_EVENTS} events would be needed: that is a switching, for which the library has no name"
    )
    return _rebuild(search, models[0], [pair for pair in chosen if pair[0].name != "step_event"])


def _rebuild(search: Search, declared: ModelFit, kept: Chosen) -> tuple[list[ModelFit], Chosen]:
    """Fit the declared model and the kept effects again, one after the other."""
    models = [declared]
    for score, _ in kept:
        models.append(search.fit([*models[-1].terms, Term(score.name, candidate_of(score))]))
    return models, kept


def _second_look(
    search: Search, whole: ModelFit, steps: list[Step], error: float, rounds: list[list[FamilyScore]]
) -> tuple[ModelFit, list[Step]]:
    """Search once more with the sealed cycles in view: what acted only there could not be found before.

    Coefficients behind the error after still come from the cycles before the seal, but the name does not; the step says so.
    """
    while len(steps) < MOST_EFFECTS:
        scores = search.scores(whole)
        rounds.append(scores)
        best = search.choose(scores, whole, level=SECOND_LEVEL)
        if best is None or _events(steps) + (best.name == "step_event") > MOST_EVENTS:
            return whole, steps
        term = Term(best.name, candidate_of(best))
        before = whole
        whole = settled(fit_model(search.readings, [*whole.terms, term]), search.effects)
        term = whole.terms[-1]
        after = _sealed_error(search.readings, search.used, whole.terms)
        if _is_late(search.readings, search.used, term):
            confirmed = "found among the sealed cycles; sized on one half of the targets, tested on the other"
        else:
            confirmed = "named with the sealed cycles in view, coefficients from the cycles before: the error after is optimistic"
        if after > _WORSE * error:
            search.blocked[best.name] = (
                f"withdrawn: the error on the sealed cycles rose from {error:.3f} to {after:.3f} um with it"
            )
            whole = before
            continue
        search.blocked.pop(best.name, None)
        step = make_step(whole, term, best, scores, error, after)
        steps = [*steps, replace(step, confirmed=confirmed)]
        whole, steps = _drop_superfluous(search, whole, steps)
        error = steps[-1].rmse_after_um
    return whole, steps


def _drop_superfluous(search: Search, whole: ModelFit, steps: list[Step]) -> tuple[ModelFit, list[Step]]:
    """Drop an earlier effect that the newest has made superfluous, and follow the errors anew."""
    declared = len(whole.terms) - len(steps)
    for k in range(len(steps) - 1):
        terms = [term for j, term in enumerate(whole.terms) if j != declared + k]
        if _loss(whole, terms) < _SUPERFLUOUS_GAIN:
            left = [step for j, step in enumerate(steps) if j != k]
            chained = _chain_errors(search, terms[:declared], terms[declared:], left)
            return _drop_superfluous(search, fit_model(search.readings, terms), chained)
    return whole, steps


def _loss(model: ModelFit, terms: Sequence[Term]) -> float:
    """Log-likelihood that is lost with other terms, the drift's variances kept."""
    return 0.5 * model.fit.response.size * float(np.log(refit_fixed(model, terms).rss / model.fit.rss))


def _keep_right_patterns(
    search: Search, whole: ModelFit, steps: list[Step], declared: int
) -> tuple[ModelFit, list[Step]]:
    """Withdraw the name of an effect whose pattern along the axis is not what the readings show; it was the nearest, not the cause.

    What was found after it goes with it: it was judged beside a pattern that was not there.
    """
    wrong = wrong_patterns(whole, whole.terms[declared:])
    if not wrong:
        return whole, steps
    first = min(wrong)
    for number, step in enumerate(steps[first:], first):
        beside = f"found beside {steps[first].effect}, whose name was withdrawn: the model it was judged by was wrong"
        search.blocked[step.effect] = f"withdrawn: {wrong.get(number, beside)}"
    kept = range(first)
    added = [whole.terms[declared + k] for k in kept]
    named = list(whole.terms[:declared])
    # Errors of the steps that remain are those without the withdrawn ones.
    chained = _chain_errors(search, named, added, [steps[k] for k in kept])
    return _keep_right_patterns(search, fit_model(search.readings, [*named, *added]), chained, declared)


def _chain_errors(search: Search, declared: list[Term], added: list[Term], steps: list[Step]) -> list[Step]:
    """The same steps with the errors on the sealed cycles that they have one after the other."""
    errors = [_sealed_error(search.readings, search.used, [*declared, *added[:k]]) for k in range(len(added) + 1)]
    return [replace(step, rmse_before_um=errors[k], rmse_after_um=errors[k + 1]) for k, step in enumerate(steps)]


def _events(steps: Sequence[Step]) -> int:
    return sum(step.effect == "step_event" for step in steps)


def _cycle_length(readings: Readings) -> float:
    return float(np.median(np.diff(cycle_starts(readings))))


def _is_late(readings: Readings, used: NDArray[np.bool_], term: Term) -> bool:
    """Whether a term is an event among the sealed cycles, of which the cycles before tell nothing."""
    sealed_from = readings.seconds[~used].min()
    return term.candidate.event_s is not None and term.candidate.event_s >= sealed_from - _cycle_length(readings)


def _sealed_error(readings: Readings, used: NDArray[np.bool_], terms: Sequence[Term]) -> float:
    """Error on the sealed cycles, um; where an event lies among them, it is sized on one half of the targets and tested on the other."""
    if not any(_is_late(readings, used, term) for term in terms):
        return rmse(fit_model(readings, terms, used=used).open_loop_errors()[0])
    half = readings.target_index % 2 == 0
    parts = [fit_model(readings, terms, used=used | fitted) for fitted in (half, ~half)]
    return rmse(np.concatenate([part.open_loop_errors()[0] for part in parts]))
