"""Scores of effects: what the best candidate of each explains, and the p-value of that gain for the whole search.

A candidate is judged by its gain in profile log-likelihood under a drift that is free to explain the same thing. The same gains are
computed for simulated data in which the model is complete; from them come the p-values, family-wise over all effects that were tried.
Equations and error rates: docs/method/closed-loop.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.effects.effect import Candidate, Separable, Wave
from fusion.loop.decisions import Decision, Reason
from fusion.loop.parameter_ranges import DERIVED_WORDS, parameter_ranges
from fusion.loop.state import Score, SearchError
from fusion.model.null_simulation import critical_gain, sidak, sidak_level, tail_probability
from thermography.fields.tasks.spool import IN_MEMORY_BYTES, empty_arrays, give_back

#: Effects with a larger family-unaware p-value are not looked at more closely, because they will not enter anyway.
WORTH_CONFIRMING = 0.1
#: Neighbourhoods that are looked at in turn: the search tries few states for every wave, and the best may be two neighbours away.
#: A gain in log-likelihood below the second number does not justify another one.
_CLOSER_LOOKS = 3
_WORTH_MOVING = 0.1
#: Words that a closer look may change: those that follow from numbers, the state that scales a pattern, and how the load began.
_OPEN_WORDS = DERIVED_WORDS | {"follows", "start"}

Families = Mapping[str, Sequence[Candidate]]


@dataclass(frozen=True)
class Gains:
    """Gains of some candidates, a penalty for every coefficient beyond the first taken off (Akaike).

    Attributes
    ----------
    gain : (candidates, responses) in log-likelihood; the measured response first, then simulated ones
    drift_place : (candidates,) which drift variance of the grid suits each candidate best
    separable : (candidates,) whether a candidate is independent of the model
    """

    gain: Array
    drift_place: NDArray[np.int64]
    separable: NDArray[np.bool_]


def collect_candidates(
    offers: Mapping[str, Callable[[], Sequence[Candidate]]], rows: int, *, built_in: frozenset[str]
) -> tuple[dict[str, list[Candidate]], list[Decision]]:
    """Collect the candidates of all effects and check their columns.

    Parameters
    ----------
    offers : for each effect, what makes its candidates
    rows : number of rows that every column must have
    built_in : effects of the library; a fault in one of them is raised, one in a user's effect is recorded

    Returns
    -------
    families : candidates by effect
    decisions : about a user's effects whose columns cannot be computed
    """
    families: dict[str, list[Candidate]] = {}
    decisions = []
    for name, offer in offers.items():
        try:
            candidates = list(offer())
            _check_columns(candidates, rows)
        except Exception as fault:
            # A user's effect must not end the search for the others; a fault of the library itself must be seen.
            if name in built_in:
                raise
            because = f"{type(fault).__name__}: {fault}"
            decisions.append(Decision(name, Reason.NOT_COMPUTABLE, {"because": because}))
            continue
        families[name] = candidates
    return families, decisions


def kept_on_disk(candidates: Iterable[Candidate]) -> Iterator[Candidate]:
    """Yield the same candidates, their columns in temporary files where many are large: those of a long test fill the memory.

    Parameters
    ----------
    candidates : made one after the other, so that few are in memory at a time
    """
    held: list[Candidate] = []
    for candidate in candidates:
        held.append(candidate)
        if sum(one.columns.nbytes for one in held if isinstance(one.columns, np.ndarray)) > IN_MEMORY_BYTES:
            yield from _moved(held)
            held = []
    yield from held


def _moved(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Candidates with their columns in one temporary file."""
    dense = {k: one.columns for k, one in enumerate(candidates) if isinstance(one.columns, np.ndarray)}
    stored = dict(zip(dense, empty_arrays([columns.shape for columns in dense.values()], float), strict=True))
    for k, columns in dense.items():
        stored[k][...] = columns
    give_back(*stored.values())
    return [replace(one, columns=stored[k]) if k in stored else one for k, one in enumerate(candidates)]


def _check_columns(candidates: Sequence[Candidate], rows: int) -> None:
    """Refuse columns that are not one finite number per row."""
    for candidate in candidates:
        columns = candidate.columns if isinstance(candidate.columns, Separable) else np.asarray(candidate.columns)
        if len(columns.shape) != 2 or columns.shape[0] != rows:
            raise SearchError(f"columns have shape {columns.shape}; expected ({rows}, columns)")
        # Of columns that share courses these are looked at, and all columns only where one is not finite.
        parts = (*map(_made_of, columns.courses), columns.weights) if isinstance(columns, Separable) else (columns,)
        finite = all(np.isfinite(part).all() for part in parts)
        give_back(*parts)
        if not finite:
            not_finite = int((~np.isfinite(np.asarray(columns))).sum())
            raise SearchError(f"{not_finite} values are not finite at {dict(candidate.parameters)}")
        if len(candidate.units) != columns.shape[1]:
            raise SearchError(
                f"{columns.shape[1]} columns but {len(candidate.units)} units at {dict(candidate.parameters)}"
            )


def _made_of(course: Array | Wave) -> Array:
    """The numbers that decide whether a course is finite."""
    return course.seconds if isinstance(course, Wave) else course


def score_effects(
    families: Families,
    gains: Gains,
    *,
    level: float,
    is_admissible: Callable[[Candidate], bool] = lambda candidate: True,
) -> tuple[list[Score], list[Decision]]:
    """Score every effect by its best candidate.

    Parameters
    ----------
    families : candidates by effect, none of them empty
    gains : of all candidates, in the order of the families
    level : family-wise probability of adding an effect under the null hypothesis
    is_admissible : whether a candidate could be named if it were the best; one that could not must not hide one that could, and is
        scored only where an effect has no other

    Returns
    -------
    scores : best excess first, none confirmed yet
    decisions : about effects of which no candidate is independent of the model
    """
    scores, decisions = [], []
    start = 0
    for name, candidates in families.items():
        rows = np.arange(start, start + len(candidates))
        start += len(candidates)
        usable = rows[gains.separable[rows]]
        collinear = 1.0 - usable.size / rows.size
        if usable.size == 0:
            scores.append(Score(name, None, collinear=collinear))
            decisions.append(Decision(name, Reason.COLLINEAR))
            continue
        admissible = [row for row in usable if is_admissible(candidates[row - int(rows[0])])]
        usable = np.array(admissible) if admissible else usable
        best = int(usable[np.argmax(gains.gain[usable, 0])])
        null = gains.gain[usable, 1:].max(axis=0)
        gain = float(gains.gain[best, 0])
        p_value = tail_probability(gain, null)
        scores.append(
            Score(
                name,
                candidates[best - int(rows[0])],
                gain,
                gain - float(null.mean()),
                p_value,
                sidak(p_value, len(families)),
                collinear,
                int(gains.drift_place[best]),
                critical_gain(sidak_level(level, len(families)), null),
            )
        )
    return sorted(scores, key=lambda score: -score.excess), decisions


def refine(
    score: Score, near: Callable[[Candidate], Sequence[Candidate]], gains: Callable[[Sequence[Candidate]], Gains]
) -> Score:
    """Move to the best candidate of the neighbourhood, and of that one's, as long as the gain grows.

    The p-value stays that of the search, which tried the coarser grid.

    Parameters
    ----------
    score : with the best candidate of the search
    near : offers the candidates about one
    gains : of candidates, for the measured response
    """
    for _ in range(_CLOSER_LOOKS):
        before = score.gain
        score = _best_near(score, near(score.best), gains)
        if score.gain < before + _WORTH_MOVING:
            break
    return score


def _best_near(score: Score, near: Sequence[Candidate], gains: Callable[[Sequence[Candidate]], Gains]) -> Score:
    """The same score with the best candidate of a neighbourhood, or with its own where none is better."""
    if not near:
        raise SearchError(
            f"effect {score.name!r} offers no candidate near one it offered before: {dict(score.best.parameters)}"
        )
    looked = gains(near)
    best = int(np.argmax(np.where(looked.separable, looked.gain[:, 0], -np.inf)))
    gain = float(looked.gain[best, 0])
    if looked.separable[best] and gain >= score.gain:
        score = replace(
            score,
            candidate=near[best],
            gain=gain,
            excess=score.excess + gain - score.gain,
            drift_place=int(looked.drift_place[best]),
        )
    return replace(score, ranges=parameter_ranges(near, looked.gain[:, 0], score.best, score.gain))


def of_same_kind(candidate: Candidate, chosen: Candidate) -> bool:
    """Whether two candidates differ in numbers only, or in words that a closer look may change.

    Parameters
    ----------
    candidate : offered near ``chosen``
    chosen : the candidate that is looked at more closely
    """
    words = {
        name: value for name, value in chosen.parameters.items() if isinstance(value, str) and name not in _OPEN_WORDS
    }
    return all(candidate.parameters.get(name) == value for name, value in words.items())
