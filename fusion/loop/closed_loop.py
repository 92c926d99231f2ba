"""The closed loop: search the training part for what a model lacks, then open the hold-out set once to report the error before and after.

One procedure for a campaign along an axis and for a record of channels. What differs between them, how candidates are made, fitted, scored
and predicted, is behind :class:`Problem`. An effect enters only if its gain exceeds what the whole search finds under the null hypothesis,
if it is admissible, and if it is confirmed on readings of the training part that its coefficients were not fitted to. The hold-out set
decides nothing: an effect that it does not support is reported as not confirmed (:mod:`fusion.loop.verdict`). Procedure and error rates:
docs/method/closed-loop.md.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Protocol, TypeVar

import numpy as np

from fusion.loop.decisions import Decision, Reason
from fusion.loop.state import TIE_GAIN, LoopState, Model, Round, Score
from fusion.model.fit import Term

HOLD_OUT_SHARE = 0.2
MOST_EFFECTS = 4
#: More events than this are a switching that the library has no name for.
MOST_EVENTS = 2
#: An effect whose absence costs less log-likelihood than this is superfluous.
SUPERFLUOUS_GAIN = 2.0

Progress = Callable[[int, int, str], None]


def no_progress(done: int, total: int, what: str) -> None:
    """Report nothing.

    Parameters
    ----------
    done, total : steps done and steps in total
    what : what is done
    """


M = TypeVar("M", bound=Model)


class Problem(Protocol[M]):
    """What the procedure asks of the data."""

    def refit(self, model: M, terms: Sequence[Term]) -> M:
        """Fit other terms to the readings that ``model`` was fitted to."""

    def score(self, state: LoopState[M]) -> Round:
        """Score the whole library against the model, best excess first."""

    def entry_level(self, score: Score) -> float:
        """Family-wise p-value up to which an effect may enter."""

    def refuse(self, score: Score, model: M) -> Decision | None:
        """The decision against an effect that is not admissible."""

    def confirm(self, score: Score, state: LoopState[M]) -> Score:
        """The score with its confirmation."""

    def loss_without(self, model: M, term: Term) -> float:
        """Log-likelihood that is lost without one of the model's terms."""

    def hold_out_error(self, terms: Sequence[Term]) -> float:
        """Error of predicting the hold-out set from the training part, root mean square, um."""


def search(problem: Problem[M], state: LoopState[M], *, progress: Progress = no_progress) -> LoopState[M]:
    """Add effects one by one, without a look at the hold-out set.

    Parameters
    ----------
    problem : the data
    state : with the declared model, fitted to the training part
    progress : called with the number of the round, the total, and what is done

    Returns
    -------
    LoopState
        With every round, every decision, and the effects that entered.
    """
    for number in range(1, MOST_EFFECTS + 1):
        progress(number, MOST_EFFECTS + 2, f"searching for effect {number}")
        state, score = choose(problem, state.scored(problem.score(state)))
        if score is None:
            return state
        state = drop_superfluous(problem, enter(problem, state, score))
        if state.events > MOST_EVENTS:
            events = [place for place, step in enumerate(state.steps) if step.effect == "step_event"]
            evidence = {"most": MOST_EVENTS, "search_p": state.steps[-1].score.family_wise_p}
            return withdraw(problem, state, events, [Decision("step_event", Reason.TOO_MANY_EVENTS, evidence)])
    return state


def choose(
    problem: Problem[M], state: LoopState[M], *, level: float | None = None
) -> tuple[LoopState[M], Score | None]:
    """Choose the best effect of the last round that is significant, admissible and confirmed.

    Parameters
    ----------
    problem : the data
    state : with the round that was scored last
    level : family-wise level of entry; that of the problem by default

    Returns
    -------
    state : with the decisions about effects that were passed over
    score : of the chosen effect, None where there is none
    """
    unconfirmed: Score | None = None
    for score in state.rounds[-1].scores:
        limit = problem.entry_level(score) if level is None else level
        if score.candidate is None or score.family_wise_p > limit or state.is_withdrawn(score.name):
            continue
        refusal = problem.refuse(score, state.model)
        if refusal is not None:
            state = state.decide(replace(refusal, evidence={**refusal.evidence, "search_p": score.family_wise_p}))
            continue
        # Where a stronger effect could not be confirmed, a much weaker one may only stand in for it.
        if unconfirmed is not None and score.excess < unconfirmed.excess - TIE_GAIN:
            beside = p_value_beside(problem, state.model, score, unconfirmed)
            # A lasting effect may predict in place of another even where both are significant together; an event happens at its instant.
            if beside > limit or not score.is_event:
                evidence: dict[str, float | str] = {
                    "p_value": score.family_wise_p,
                    "stronger": unconfirmed.name,
                    "beside_p": beside,
                }
                state = state.decide(Decision(score.name, Reason.STANDS_IN, evidence))
                continue
        score = problem.confirm(score, state)
        state = state.rescored(score)
        if score.confirmation is not None and score.confirmation.passed:
            return state, score
        state = state.decide(not_confirmed(score, state.rounds[-1]))
        if unconfirmed is None or score.excess > unconfirmed.excess:
            unconfirmed = score
    return state, None


def p_value_beside(problem: Problem[M], model: M, score: Score, stronger: Score) -> float:
    """The family-wise p-value of an effect with a stronger one in the model; that of the search where it gains as much as by itself.

    The tail of the p-values of the search falls by at most a factor of :math:`e` per nat (docs/method/closed-loop.md, null hypothesis), so
    they grow at most by that for every nat that the stronger effect takes away.

    Parameters
    ----------
    problem : the data
    model : to which neither was added
    score, stronger : of both effects
    """
    weaker = Term(score.name, score.best)
    joint = problem.refit(model, [*model.terms, Term(stronger.name, stronger.best), weaker])
    lost = max(score.gain - problem.loss_without(joint, weaker), 0.0)
    return min(1.0, score.family_wise_p * float(np.exp(lost)))


def not_confirmed(score: Score, scored: Round) -> Decision:
    """The decision about a significant effect that was not confirmed.

    Parameters
    ----------
    score : Score
        Of the effect, with its confirmation.
    scored : Round
        The round in which it was tried.
    """
    after_um = score.confirmation.error_um if score.confirmation is not None else np.nan
    if np.isfinite(after_um):
        evidence = {"p_value": score.family_wise_p, "before_um": scored.start_error_um, "after_um": after_um}
        return Decision(score.name, Reason.NOT_PREDICTED, evidence)
    return Decision(score.name, Reason.NOT_CONFIRMED, {"p_value": score.family_wise_p})


def enter(problem: Problem[M], state: LoopState[M], score: Score) -> LoopState[M]:
    """Add a confirmed effect to the model and fit it again.

    Parameters
    ----------
    problem : the data
    state : before
    score : of the effect, with its confirmation
    """
    assert score.confirmation is not None
    model = problem.refit(state.model, [*state.model.terms, Term(score.name, score.best)])
    return state.entered(model, score, score.confirmation.way)


def drop_superfluous(problem: Problem[M], state: LoopState[M], *, first: int = 0) -> LoopState[M]:
    """Take out effects that the newest one has made superfluous, one after the other.

    Parameters
    ----------
    problem : the data
    state : after an effect was added
    first : place of the first step that may be taken out
    """
    for place, term in enumerate(state.added[:-1]):
        if place < first:
            continue
        loss = problem.loss_without(state.model, term)
        if loss < SUPERFLUOUS_GAIN:
            decision = Decision(term.effect, Reason.SUPERFLUOUS, {"loss": loss})
            return drop_superfluous(problem, withdraw(problem, state, [place], [decision]), first=first)
    return state


def withdraw(
    problem: Problem[M], state: LoopState[M], places: Collection[int], decisions: Sequence[Decision]
) -> LoopState[M]:
    """Take steps out of the model again and fit what is kept.

    Parameters
    ----------
    problem : the data
    state : before
    places : of the steps that are taken out, from 0
    decisions : the reasons
    """
    return state.without(places, problem.refit(state.model, state.kept(places)), decisions)


def open_hold_out(problem: Problem[M], state: LoopState[M]) -> LoopState[M]:
    """Predict the hold-out set once: with the declared model, after each step, and with the last model without each of its effects.

    Nothing follows from these errors but what is reported.

    Parameters
    ----------
    problem : the data
    state : after the search

    Returns
    -------
    LoopState
        With the hold-out errors.
    """
    chain = [[*state.declared, *state.added[:count]] for count in range(len(state.steps) + 1)]
    return replace(
        state,
        errors_um=tuple(problem.hold_out_error(terms) for terms in chain),
        errors_without_um=tuple(problem.hold_out_error(state.kept([place])) for place in range(len(state.steps))),
    )
