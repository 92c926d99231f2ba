"""Other lines on the plan, another order of the targets or the other sign of the deviations, held against the declared ones.

A line drawn the wrong way round, an origin at the wrong place, targets numbered from the other end and deviations of the wrong sign leave
patterns that effects of the library can imitate. Where one of these mistakes explains the readings with fewer effects, it is the likelier.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, combinations

import numpy as np
import xarray as xr
from scipy.interpolate import interp1d

from fusion._typing import Array
from fusion.alignment.align import AxisGeometry, MeasuredLine
from fusion.alignment.readings import Series
from fusion.effects.effect import Candidate, Prior
from fusion.model.fit import ModelFit, Term, place_of, refit_fixed
from interferometry.drift.state_space import DriftModelError

#: Origins that are tried along the plan, evenly spaced from edge to edge: closer than the field changes along a table.
_ORIGINS = 29
#: Shortest shift of the origin that is an alternative, as a share of the plan: a nearer line sees nearly the same field, and differs from
#: the declared one by less than a thermogram's blur and the finite time between frames do.
_LEAST_SHIFT = 0.1
#: Alternatives that are compared beside every choice of the added effects.
_CLOSER_LOOKS = 3
#: Standard deviations from the expected expansion within which an alternative is an explanation.
_PLAUSIBLE = 2.5


@dataclass(frozen=True)
class LineComparison:
    """The declared line against its best alternative.

    Attributes
    ----------
    alternative : str
        The alternative in words.
    gain : float
        What it gains in log-likelihood, every column of an added effect counted as half the logarithm of the number of readings.
    expansion_ppm_per_K, expansion_u_ppm_per_K : float, ppm/K
        Coefficient that the readings alone ask for beside it.
    superfluous : tuple of str
        Added effects that are not needed beside it.
    """

    alternative: str
    gain: float
    expansion_ppm_per_K: float
    expansion_u_ppm_per_K: float
    superfluous: tuple[str, ...]

    def as_json(self) -> dict[str, object]:
        """The entry ``loop.axis_line`` of results.json."""
        return dict(vars(self))


def compare_lines(model: ModelFit, declared: int, fields: xr.Dataset, axis: AxisGeometry) -> LineComparison | None:
    """Compare the declared line with its alternatives.

    Parameters
    ----------
    model : ModelFit
        Final model, fitted to all readings.
    declared : int
        Number of its first terms, which were declared.
    fields : Dataset
        The fields that the model was fitted to: ``frame_temperature`` (degC) over time, y, x (mm).
    axis : AxisGeometry
        The declared line.

    Returns
    -------
    LineComparison or None
        None where the expansion of the axis was not declared with an expected coefficient, or no alternative is plausible.

    Notes
    -----
    A line and a choice among the added effects score their log-likelihood under the drift of the model, less (k/2) ln n for the k columns
    of the effects beside n readings (Schwarz 1978, Ann. Stat. 6, 461), less half the squared distance of the expansion from the expected
    one in standard deviations. The choice is free for the declared line as well.
    """
    comparison = _Comparison.of(model, declared)
    if comparison is None:
        return None
    scored = [(comparison.glance(column), words, column) for words, column in _alternatives(model, fields, axis)]
    closer = sorted(scored, key=lambda tried: -tried[0])[:_CLOSER_LOOKS]
    looked = [(comparison.best(column), words) for value, words, column in closer if np.isfinite(value)]
    if not looked:
        return None
    stated = comparison.best(comparison.expansion.candidate.columns[:, 0], plausible=np.inf)
    best, words = max(looked, key=lambda pair: pair[0].value)
    superfluous = tuple(term.effect for term in stated.kept if all(term is not other for other in best.kept))
    return LineComparison(words, best.value - stated.value, best.coefficient, best.u, superfluous)


@dataclass(frozen=True)
class _Scored:
    """One line with one choice of added effects; minus infinity where the columns are collinear or the expansion is not plausible."""

    value: float
    coefficient: float
    u: float
    kept: tuple[Term, ...]


@dataclass(frozen=True)
class _Comparison:
    """Scores lines beside the other declared terms and any choice among the added ones."""

    model: ModelFit
    expansion: Term
    prior: Prior
    beside: tuple[Term, ...]
    added: tuple[Term, ...]

    @classmethod
    def of(cls, model: ModelFit, declared: int) -> _Comparison | None:
        terms = model.terms[:declared]
        expansion = next((term for term in terms if term.effect == "axis_expansion"), None)
        if expansion is None or expansion.candidate.prior is None:
            return None
        beside = tuple(term for term in terms if term is not expansion)
        return cls(model, expansion, expansion.candidate.prior, beside, model.terms[declared:])

    def glance(self, column: Array) -> float:
        """Score of a line beside all or none of the added effects, whichever is better."""
        return max(self.score(column, kept, _PLAUSIBLE).value for kept in ((), self.added))

    def best(self, column: Array, *, plausible: float = _PLAUSIBLE) -> _Scored:
        """The best choice among the added effects beside a line."""
        choices = chain.from_iterable(combinations(self.added, count) for count in range(len(self.added) + 1))
        return max((self.score(column, kept, plausible) for kept in choices), key=lambda scored: scored.value)

    def score(self, column: Array, kept: tuple[Term, ...], plausible: float) -> _Scored:
        line = Term(self.expansion.effect, Candidate(column[:, None], {}, self.expansion.candidate.units))
        terms = [line, *self.beside, *kept]
        try:
            fit = refit_fixed(self.model, terms)
        except DriftModelError:
            return _Scored(-np.inf, np.nan, np.nan, kept)
        place = place_of(terms, line, self.model.profile.shape[1]).start
        value, u = float(fit.coefficients[place]), float(fit.coefficients_u[place])
        off = abs(value - self.prior.mean) / float(np.hypot(u, self.prior.u))
        if off > plausible:
            return _Scored(-np.inf, value, u, kept)
        count, columns = fit.response.size, sum(term.width for term in kept)
        score = -0.5 * (count * np.log(fit.rss) + columns * np.log(count) + off**2)
        return _Scored(float(score), value, u, kept)


def _alternatives(model: ModelFit, fields: xr.Dataset, axis: AxisGeometry) -> Iterator[tuple[str, Array]]:
    """Words and column (n,), um per ppm/K: lines along the declared one, both ways; the targets from the other end; the other sign."""
    readings = model.readings
    position, seconds = readings.positions_mm, readings.series["axis_integral"].seconds
    along_mm = _on_the_plan(fields, axis)
    temperature = fields["frame_temperature"].values.astype(float)
    line = MeasuredLine(fields, axis, along_mm)
    integral = interp1d(along_mm, line.integrate(line.sample(temperature - temperature[0])), axis=1)

    def column(origin_mm: float, ends_mm: Array) -> Array:
        return readings.at(Series(seconds, 1e-3 * (integral(ends_mm) - integral([origin_mm])), "K m"))

    def inside(ends_mm: Array) -> bool:
        return bool(along_mm[0] <= ends_mm.min() and ends_mm.max() <= along_mm[-1])

    for origin in np.linspace(along_mm[0], along_mm[-1], _ORIGINS):
        x, y = axis.points(np.array([origin]))
        for sign, way in ((1.0, "the same way"), (-1.0, "the other way round")):
            ends = origin + sign * position
            other = sign < 0.0 or abs(origin) >= _LEAST_SHIFT * float(np.ptp(along_mm))
            if other and inside(ends):
                words = f"along a line that runs {way} from x {x[0]:.0f} mm, y {y[0]:.0f} mm"
                yield words, sign * column(float(origin), ends)
    if inside(position):
        mirrored = position.min() + position.max() - position
        yield "with the targets numbered from the other end", column(0.0, mirrored)
        yield "with deviations of the opposite sign", -column(0.0, position)


def _on_the_plan(fields: xr.Dataset, axis: AxisGeometry) -> Array:
    """Axis positions on the plan, mm, one cell apart, position 0 among them."""
    x, y = fields["x"].values, fields["y"].values
    cell = float(np.median(np.diff(x)))
    reach = np.ceil((np.abs(axis.origin_mm).sum() + np.hypot(np.ptp(x), np.ptp(y))) / cell)
    along = cell * np.arange(-reach, reach + 1.0)
    at_x, at_y = axis.points(along)
    within = (at_x >= x[0]) & (at_x <= x[-1]) & (at_y >= y[0]) & (at_y <= y[-1])
    return np.asarray(along[within])
