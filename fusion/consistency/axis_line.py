"""Other lines on the plan, another order of the targets or the other sign of the deviations, held against the declared ones.

A line drawn the wrong way round, an origin at the wrong place, targets numbered from the other end and deviations of the wrong sign leave
patterns that effects of the library can imitate. Where one of these mistakes explains the readings with fewer effects, it is the likelier.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, combinations

import numpy as np
import xarray as xr

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
#: Share of the tests with the right line in which an alternative may be taken for it, and number of simulated tests that show it.
_FALSE_ALARMS, _DRAWS = 2e-3, 20_000
#: Log-likelihood within which a line explains the readings as well as the declared one.
_AS_WELL = 2.0
#: Share of its whitened length that the other terms must leave of a line for its expansion to be determined.
_DETERMINED = 1e-9


@dataclass(frozen=True)
class LineComparison:
    """The declared line against its best alternative.

    Attributes
    ----------
    alternative : str
        The alternative in words.
    gain : float
        What it gains in log-likelihood, every column of an added effect counted as half the logarithm of the number of readings.
    gain_limit : float
        What an alternative gains by chance in two of a thousand tests with the declared line.
    expansion_ppm_per_K, expansion_u_ppm_per_K : float, ppm/K
        Coefficient that the readings alone ask for beside it.
    superfluous : tuple of str
        Added effects that are not needed beside it.
    as_well_ppm_per_K : (float, float), ppm/K
        Smallest and largest expansion that the readings ask for along lines that explain them as well as the declared one, itself included.
    """

    alternative: str
    gain: float
    gain_limit: float
    expansion_ppm_per_K: float
    expansion_u_ppm_per_K: float
    superfluous: tuple[str, ...]
    as_well_ppm_per_K: tuple[float, float]

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

    The limit is that of a parametric bootstrap (Cox's test of separate families by simulation; D. A. Williams, Biometrics 26 (1970) 23):
    tests with the declared line, the fitted noise, and the fitted expansion or the plausible one nearest to it, of which two in a thousand
    exceed it with the largest gain over all alternatives. It is never below ln(500), which a likelihood ratio exceeds at most as often
    under any law of the noise (Markov).
    """
    comparison = _Comparison.of(model, declared)
    if comparison is None:
        return None
    alternatives = list(_alternatives(model, fields, axis))
    scored = [(comparison.glance(column), words, column) for words, column in alternatives]
    closer = sorted(scored, key=lambda tried: -tried[0])[:_CLOSER_LOOKS]
    looked = [(comparison.best(column), words) for value, words, column in closer if np.isfinite(value)]
    if not looked:
        return None
    stated = comparison.best(comparison.expansion.candidate.columns[:, 0], plausible=np.inf)
    best, words = max(looked, key=lambda pair: pair[0].value)
    superfluous = tuple(term.effect for term in stated.kept if all(term is not other for other in best.kept))
    limit, as_well = comparison.by_chance([column for _, column in alternatives])
    return LineComparison(words, best.value - stated.value, limit, best.coefficient, best.u, superfluous, as_well)


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

    def by_chance(self, columns: Sequence[Array]) -> tuple[float, tuple[float, float]]:
        """Gain that chance exceeds rarely, and the range of the expansion along lines that explain the readings as well."""
        gram, sigma2 = self._whitened([self.expansion.candidate.columns[:, 0], *columns])
        lines, seen = gram[:-1, :-1], gram[:-1, -1]
        gains, expansion = self._gains(np.diag(lines), seen[:, None], sigma2)
        reach = _PLAUSIBLE * self.prior.u
        plausible = np.clip(expansion[0], self.prior.mean - reach, self.prior.mean + reach)
        values, axes = np.linalg.eigh(lines)
        noise = np.random.default_rng(1).standard_normal((len(values), _DRAWS))
        spread = axes * np.sqrt(sigma2 * np.maximum(values, 0.0))
        simulated, _ = self._gains(np.diag(lines), plausible * lines[:, :1] + spread @ noise, sigma2)
        limit = float(np.quantile(simulated.max(axis=0, initial=-np.inf), 1.0 - _FALSE_ALARMS, method="higher"))
        as_well = np.append(expansion[0], expansion[1:][gains >= -_AS_WELL])
        return max(limit, -float(np.log(_FALSE_ALARMS))), (float(as_well.min()), float(as_well.max()))

    def _whitened(self, columns: Sequence[Array]) -> tuple[Array, float]:
        """Products of whitened lines (declared first) and readings beside all other terms, and the variance about the declared line."""
        model, terms = self.model, (*self.beside, *self.added)
        design = [model.profile, *(term.candidate.columns for term in terms)]
        if model.fit.system.order == 2:
            design.append(model.readings.loadings * (model.readings.seconds / 3600.0)[:, None])
        others = np.column_stack(design)[model.used]
        lines = np.column_stack(columns)[model.used]
        whole, _ = model.fit.system.normal_equations(np.column_stack([others, lines, model.fit.response]))
        count = others.shape[1]
        inner, across = whole[:count, :count], whole[:count, count:]
        left = whole[count:, count:] - across.T @ np.linalg.lstsq(inner, across, rcond=1e-12)[0]
        determined = np.diag(left) > _DETERMINED * np.diag(whole)[count:]
        determined[[0, -1]] = True
        left = left[np.ix_(determined, determined)]
        residual = left[-1, -1] - left[0, -1] ** 2 / left[0, 0]
        return left, float(residual) / (model.fit.response.size - count - 1)

    def _gains(self, squares: Array, products: Array, sigma2: float) -> tuple[Array, Array]:
        """Gain of every line over the declared one, (lines - 1, tests), and the expansions, (lines, tests)."""
        length = squares[:, None]
        expansion = products / length
        off = (expansion - self.prior.mean) / np.sqrt(sigma2 / length + self.prior.u**2)
        score = 0.5 * (products**2 / (length * sigma2) - off**2)
        return np.where(np.abs(off[1:]) <= _PLAUSIBLE, score[1:] - score[0], -np.inf), expansion


def _alternatives(model: ModelFit, fields: xr.Dataset, axis: AxisGeometry) -> Iterator[tuple[str, Array]]:
    """Words and column (n,), um per ppm/K: lines along the declared one, both ways; the targets from the other end; the other sign."""
    readings = model.readings
    position, seconds = readings.positions_mm, readings.series["axis_integral"].seconds
    along_mm = _on_the_plan(fields, axis)
    line = MeasuredLine(fields, axis, along_mm)
    known = line.integrate_rise(fields["frame_temperature"])

    def integral(ends_mm: Array) -> Array:
        return _interpolate(ends_mm, along_mm, known)

    def column(origin_mm: float, ends_mm: Array) -> Array:
        return readings.at(Series(seconds, 1e-3 * (integral(ends_mm) - integral(np.array([origin_mm]))), "K m"))

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
    if inside(position) and inside(np.zeros(1)):
        mirrored = position.min() + position.max() - position
        yield "with the targets numbered from the other end", column(0.0, mirrored)
        yield "with deviations of the opposite sign", -column(0.0, position)


def _interpolate(ends: Array, places: Array, known: Array) -> Array:
    """Rows of values that are known at places (k,), rising, interpolated linearly at ends (n,) between them, (rows, n)."""
    after = np.clip(np.searchsorted(places, ends), 1, places.size - 1)
    slope = (known[:, after] - known[:, after - 1]) / (places[after] - places[after - 1])
    return np.asarray(slope * (ends - places[after - 1]) + known[:, after - 1])


def _on_the_plan(fields: xr.Dataset, axis: AxisGeometry) -> Array:
    """Axis positions on the plan, mm, one cell apart, position 0 among them."""
    x, y = fields["x"].values, fields["y"].values
    cell = float(np.median(np.diff(x)))
    reach = np.ceil((np.abs(axis.origin_mm).sum() + np.hypot(np.ptp(x), np.ptp(y))) / cell)
    along = cell * np.arange(-reach, reach + 1.0)
    at_x, at_y = axis.points(along)
    within = (at_x >= x[0]) & (at_x <= x[-1]) & (at_y >= y[0]) & (at_y <= y[-1])
    return np.asarray(along[within])
