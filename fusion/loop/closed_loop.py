"""The closed loop: search for what a model lacks, test it, and prove it on the hold-out set.

One procedure for a campaign along an axis and for a record of channels. What differs between them, how candidates are made, fitted, scored
and predicted, is behind :class:`Problem`. An effect enters only if its gain exceeds what the whole search finds under the null hypothesis,
if it is admissible, and if it is confirmed on readings that its coefficients were not fitted to. Procedure and error rates:
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

    def is_judged_by_hold_out(self, score: Score) -> bool:
        """Whether the hold-out error says anything about an effect."""

    def is_harmless(self, with_it_um: float, without_it_um: float) -> bool:
        """Whether an effect may stay, given the hold-out errors with and without it."""

    def ask_hold_out(self, state: LoopState[M]) -> LoopState[M]:
        """Put one question to the hold-out set where the search could not decide, or return the state as it is."""


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
            return problem.ask_hold_out(state)
        state = drop_superfluous(problem, enter(problem, state, score))
        if state.events > MOST_EVENTS:
            events = [place for place, step in enumerate(state.steps) if step.effect == "step_event"]
            return withdraw(
                problem, state, events, [Decision("step_event", Reason.TOO_MANY_EVENTS, {"most": MOST_EVENTS})]
            )
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
            state = state.decide(refusal)
            continue
        # Where a stronger effect could not be confirmed, a much weaker one only stands in for it.
        if unconfirmed is not None and score.excess < unconfirmed.excess - TIE_GAIN:
            evidence: dict[str, float | str] = {"p_value": score.family_wise_p, "stronger": unconfirmed.name}
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


def drop_superfluous(problem: Problem[M], state: LoopState[M]) -> LoopState[M]:
    """Take out effects that the newest one has made superfluous, one after the other.

    Parameters
    ----------
    problem : the data
    state : after an effect was added
    """
    for place, term in enumerate(state.added[:-1]):
        loss = problem.loss_without(state.model, term)
        if loss < SUPERFLUOUS_GAIN:
            decision = Decision(term.effect, Reason.SUPERFLUOUS, {"loss": loss})
            return drop_superfluous(problem, withdraw(problem, state, [place], [decision]))
    return state


def withdraw(
    problem: Problem[M], state: LoopState[M], places: Collection[int], decisions: Sequence[Decision]
) -> LoopState[M]:
    """Take steps out of the model again and fit what is kept.

    Once the hold-out set is open, the errors are those of the chain of effects that remain.

    Parameters
    ----------
    problem : the data
    state : before
    places : of the steps that are taken out, from 0
    decisions : the reasons
    """
    model = problem.refit(state.model, state.kept(places))
    state = state.without(places, model, decisions)
    return with_hold_out_errors(problem, state) if state.errors_um else state


def with_hold_out_errors(problem: Problem[M], state: LoopState[M]) -> LoopState[M]:
    """Compute the hold-out error of the declared model and after each step.

    Parameters
    ----------
    problem : the data
    state : any
    """
    chain = [[*state.declared, *state.added[:count]] for count in range(len(state.steps) + 1)]
    return replace(state, errors_um=tuple(problem.hold_out_error(terms) for terms in chain))


def open_hold_out(problem: Problem[M], state: LoopState[M]) -> LoopState[M]:
    """Predict the hold-out set with every model in turn, and withdraw effects beside which the others do better without it.

    Every effect is judged beside all others: alone it may make the error larger, as long as what else is missing bends the drift.

    Parameters
    ----------
    problem : the data
    state : after the search

    Returns
    -------
    LoopState
        With the hold-out errors of the effects that remain.
    """
    state = with_hold_out_errors(problem, state)
    without = {
        place: problem.hold_out_error(state.kept([place]))
        for place, step in enumerate(state.steps)
        if problem.is_judged_by_hold_out(step.score)
    }
    worst = min(without, key=lambda place: without[place], default=None)
    if worst is None or problem.is_harmless(state.errors_um[-1], without[worst]):
        return state
    score = state.steps[worst].score
    evidence = {"p_value": score.family_wise_p, "without_um": without[worst], "with_um": state.errors_um[-1]}
    return open_hold_out(
        problem, withdraw(problem, state, [worst], [Decision(score.name, Reason.HOLD_OUT_ERROR, evidence)])
    )


def verdict(*, added: bool, remains: bool) -> str:
    """Word for the outcome.

    Parameters
    ----------
    added : whether effects were added to the declared model
    remains : whether a shape is left in the residual

    Returns
    -------
    str
        ``complete``, ``explained``, ``partial`` or ``unexplained``.
    """
    if added:
        return "partial" if remains else "explained"
    return "unexplained" if remains else "complete"
