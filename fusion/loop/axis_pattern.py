"""Does an effect act along the axis as its physics says? If the same course in time fits better with another pattern, it has no name.

An effect that is not in the library is fitted by the nearest that is: a scale that differs by direction by a reversal drift, a creep of
one stretch of the guide by a bending. The course in time is then right and the pattern along the axis wrong. So the named pattern is
held against a free one: the same course in time, with a size of its own at every site.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
from scipy import linalg, special

from fusion._typing import Array
from fusion.effects.effect import Effect
from fusion.loop.decisions import Decision, Reason
from fusion.model.fit import ModelFit, Term
from fusion.model.least_squares import residual_squares

#: Chance at which a right effect is denied its name.
LEVEL = 1e-3
#: Share of a column that must lie outside the model for a site to have a say.
_SEPARABLE = 1e-6


def wrong_patterns(model: ModelFit, terms: Sequence[Term], effects: Mapping[str, Effect]) -> dict[int, Decision]:
    """Decide which terms do not act along the axis as their physics says.

    An effect is wrong where a free pattern fits its course in time better; and two patterns of which one course would do are more likely
    one pattern that the library does not have.

    Parameters
    ----------
    model : fitted to the readings
    terms : the added terms of the model
    effects : the library by name

    Returns
    -------
    dict
        Place among ``terms`` and the decision against that effect; events have no pattern to be tested.
    """
    wrong = {}
    courses = {k: _course(model, term) for k, term in enumerate(terms) if term.candidate.event_s is None}
    for k in courses:
        p_value = pattern_p_value(model, terms[k])
        if p_value < LEVEL:
            wrong[k] = Decision(terms[k].effect, Reason.WRONG_PATTERN, {"p_value": p_value})
    told_by_pattern = {name for name, effect in effects.items() if effect.patterned}
    patterned = [k for k in courses if terms[k].effect in told_by_pattern]
    for first, second in combinations(patterned, 2):
        if _one_pattern(model, (terms[first], terms[second]), (courses[first], courses[second])):
            names = {"first": terms[first].effect, "second": terms[second].effect}
            for place in (first, second):
                wrong[place] = Decision(terms[place].effect, Reason.SHARED_PATTERN, names)
    return wrong


def _one_pattern(model: ModelFit, terms: tuple[Term, Term], courses: tuple[Array, Array]) -> bool:
    """Whether one of two courses in time, with a size of its own at every site, fits as well as both terms.

    What so many free sizes gain by chance, half a unit of log-likelihood each, is taken off.
    """
    own = [place for term in terms for place in range(*model.place(term).indices(model.fit.design.shape[1]))]
    design = np.delete(model.fit.design, own, axis=1)
    both = _left(model, model.fit.design)
    for course in courses:
        free = _free_pattern(model, course)
        alone = _left(model, np.column_stack([design, free]))
        more = free.shape[1] - len(own)
        if 0.5 * model.fit.response.size * np.log(both / alone) >= 0.5 * more:
            return True
    return False


def _left(model: ModelFit, design: Array) -> float:
    """Whitened residual sum of squares beside a design whose columns may depend on each other."""
    whitened, _ = model.fit.system.whiten(np.column_stack([model.fit.response, design]))
    return residual_squares(whitened[:, 0], whitened[:, 1:])


def _free_pattern(model: ModelFit, course: Array) -> Array:
    """A course in time (n,) with a size of its own at every site, (n, sites)."""
    readings = model.readings.subset(model.used)
    site = readings.site
    return (site[:, None] == np.unique(site)[None, :]) * course[:, None]


def pattern_p_value(model: ModelFit, term: Term) -> float:
    """Lack-of-fit test of a term's pattern along the axis against a free pattern with the same course in time.

    Parameters
    ----------
    model : fitted to the readings
    term : one of its terms

    Returns
    -------
    float
        p-value (chi-squared) under the hypothesis that the term's pattern is right. The one target that deviates most is left out: a single
        position may have an anomaly of its own.
    """
    readings = model.readings.subset(model.used)
    sites = np.unique(readings.site)
    free = _free_pattern(model, _course(model, term))
    own = np.linalg.lstsq(free, term.candidate.columns[model.used], rcond=None)[0]
    whitened, _ = model.fit.system.whiten(np.column_stack([model.fit.response, model.fit.design, free]))
    p = model.fit.design.shape[1]
    q, _ = np.linalg.qr(whitened[:, 1 : p + 1])
    y, columns = (part - q @ (q.T @ part) for part in (whitened[:, :1], whitened[:, p + 1 :]))
    length = np.maximum(np.linalg.norm(whitened[:, p + 1 :], axis=0), 1e-12)
    # The course is interpolated between visits, so that the term's own pattern times it is not quite in the model: it is no deviation.
    other = linalg.null_space((own * length[:, None]).T)
    u, s, vt = np.linalg.svd((columns / length) @ other, full_matrices=False)
    kept = s**2 > _SEPARABLE
    score = (u[:, kept].T @ y)[:, 0] / model.fit.sigma
    # Each site's share of the statistic, from its smallest-norm size.
    size = other @ (vt[kept].T @ (score / s[kept]))
    share = size * (other @ (vt[kept].T @ (score * s[kept])))
    per_target = np.bincount(sites // 2, share)
    freedom = int(kept.sum())
    # Where one target carries everything, rounding may leave less than nothing.
    left = max(0.0, float(score @ score) - max(0.0, float(per_target.max())))
    return float(special.chdtrc(max(1, freedom - 2), left))


def _course(model: ModelFit, term: Term) -> Array:
    """Course in time of a term's largest column, read at the site where it moves most, at all used readings (n,)."""
    readings = model.readings.subset(model.used)
    site = readings.site
    columns = term.candidate.columns[model.used]
    largest = int(np.argmax(columns.std(axis=0) * np.abs(model.fit.coefficients[model.place(term)])))
    column = columns[:, largest]
    most = site == max(np.unique(site), key=lambda number: column[site == number].std())
    return np.asarray(np.interp(readings.seconds, readings.seconds[most], column[most]))
