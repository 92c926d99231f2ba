"""The closed loop on a record: what the quasi-static model of the temperatures lacks, and the error before and after.

Search and hold-out set are those of :mod:`fusion.loop.closed_loop`. In addition every part of the record from the third on is predicted by
the whole procedure from the time before it, every run of several from the other runs; an effect that did not help on the parts of the
training time is withdrawn before the hold-out set is opened.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from fusion._typing import Array
from fusion.effects.effect import Effect
from fusion.loop.closed_loop import MOST_EFFECTS, Progress, no_progress, open_hold_out, withdraw
from fusion.loop.decisions import Decision, Reason
from fusion.model.fit import Term
from fusion.record.baselines import plain_predictions
from fusion.record.blocks import Record
from fusion.record.hold_out import declare, hold_out
from fusion.record.model import columns_of, fit_record
from fusion.record.prediction import channel_rmse, known_mean, predict_left_out
from fusion.record.problem import EARNED, ChainedPart, RecordProblem, RecordState, chain_forward, search_record
from fusion.record.remainder import examine
from fusion.record.result import RecordResult


def close_record(
    record: Record,
    declared: Sequence[str],
    *,
    seed: int = 1,
    effects: Mapping[str, Effect] | None = None,
    progress: Progress = no_progress,
) -> RecordResult:
    """Close the loop on a record.

    Parameters
    ----------
    record : the record on its blocks
    declared : names of the declared effects; ``quasi_static`` is the only one that a record can be declared with
    seed : of the simulated records behind the p-values, so that a run can be repeated
    effects : the library; the built-in one with the user's own by default
    progress : called with steps done, steps in total, and what is done

    Returns
    -------
    RecordResult
        Predictions, errors on the hold-out set in um by channel, and what remains.

    Raises
    ------
    RecordError
        if a name has no meaning for a record, or a channel is too short for the model.

    Notes
    -----
    Procedure and error rates: docs/method/records.md.
    """
    terms = declare(declared, record)
    train, description = hold_out(record)
    problem, state = search_record(record, train, terms, seed=seed, effects=effects, progress=progress)
    chained = chain_forward(record, terms, seed=seed, effects=effects, progress=progress)
    state = open_hold_out(problem, without_unrepeated(problem, state, chained))
    progress(MOST_EFFECTS, MOST_EFFECTS, "examining the residual")
    whole = fit_record(record, state.model.terms, np.ones_like(train))
    chain = [[*state.declared, *state.added[:count]] for count in range(len(state.steps) + 1)]
    predictions = [problem.predict(steps) for steps in chain]
    errors = np.array([channel_rmse(record, one.predicted, ~train) for one in predictions])
    return RecordResult(
        state=state,
        record=record,
        hold_out=~train,
        held_out=description,
        predictions=predictions,
        without=[problem.predict(state.kept([place])) for place in range(len(state.steps))] if record.runs else [],
        errors=errors,
        plain=plain_predictions(record, train),
        left_out=[left_out(problem, [*state.declared, *state.added])]
        + [left_out(problem, state.kept([place])) for place in range(len(state.steps))],
        whole=whole,
        remainder=examine(whole, errors[-1], np.random.default_rng(seed)),
        chained=chained,
    )


def left_out(problem: RecordProblem, terms: Sequence[Term]) -> Array:
    """Prediction of every part of the record from all others, (blocks, channels) um; the penalty is that from the training part.

    Parameters
    ----------
    problem : the record
    terms : of the model
    """
    record = problem.record
    return predict_left_out(record, columns_of(record, terms), problem.predict(terms).penalty)


def without_unrepeated(problem: RecordProblem, state: RecordState, chained: Sequence[ChainedPart]) -> RecordState:
    """Withdraw effects that the same procedure also added on earlier time, and predicted no better with.

    Only parts of the training time count. An event happens once and is not judged by other parts.

    Parameters
    ----------
    problem, state : the record and what was found on its training part
    chained : the earlier parts
    """
    for place, step in enumerate(state.steps):
        tried = [part for part in chained if part.in_training and step.effect in part.effects]
        if not tried or step.score.is_event:
            continue
        before = float(known_mean(np.array([known_mean(part.rmse_declared_um) for part in tried])))
        after = float(known_mean(np.array([known_mean(part.rmse_final_um) for part in tried])))
        if after >= EARNED * before:
            evidence = {
                "p_value": step.score.family_wise_p,
                "parts": len(tried),
                "without_um": before,
                "with_um": after,
                "search_p": step.score.family_wise_p,
            }
            decision = Decision(step.effect, Reason.NOT_REPEATED, evidence)
            return without_unrepeated(problem, withdraw(problem, state, [place], [decision]), chained)
    return state
