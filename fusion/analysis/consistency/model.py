"""Checks of fitted coefficients against their physics."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, combinations

import numpy as np
import xarray as xr

from fusion.analysis.alignment.align import AxisGeometry, MeasuredLine
from fusion.analysis.alignment.readings import Series
from fusion.analysis.consistency.checks import CLOCK, LOG, Found, check, judge
from fusion.analysis.drift_model.model import ModelFit, Term, place_of, refit_fixed
from fusion.analysis.drift_model.search import say
from fusion.analysis.effects.effect import Candidate, Effect, Prior
from fusion.analysis.levels import LINE_LEVEL, REMAINDER_LEVEL
from fusion.common import Array
from fusion.results.loop import AxisLine, AxisLoop, AxisStep, Coefficient, DeclaredCoefficient
from fusion.results.parts import determined
from interferometry.drift.kalman import DriftModelError

# Other lines on the plan, another order of the targets or the other sign of the deviations, held against the declared
# ones.

#: Origins that are tried along the plan, evenly spaced from edge to edge: closer than the field changes along a table.
_ORIGINS = 29
#: Shortest shift of the origin that is an alternative, as a share of the plan: a nearer line sees nearly the same field, and differs from
#: the declared one by less than a thermogram's blur and the finite time between frames do.
_LEAST_SHIFT = 0.1
#: Alternatives that are compared for every choice of the added effects.
_CLOSER_LOOKS = 3
#: Standard deviations from the expected expansion within which an alternative is an explanation.
_PLAUSIBLE = 2.5
#: Simulated tests with the right line, which show the gain of its alternatives.
_DRAWS = 20_000
#: Log-likelihood within which a line explains the readings as well as the declared one.
_AS_WELL = 2.0
#: Share of its whitened length that the other terms must leave of a line for its expansion to be determined.
_DETERMINED = 1e-9


def compare_lines(model: ModelFit, declared: int, fields: xr.Dataset, axis: AxisGeometry) -> AxisLine | None:
    """Compare the declared line with its alternatives."""
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
    return AxisLine(
        alternative=words,
        gain=best.value - stated.value,
        gain_limit=limit,
        expansion_ppm_per_K=best.coefficient,
        expansion_u_ppm_per_K=best.u,
        superfluous=superfluous,
        alternative_ppm_per_K=as_well,
    )


@dataclass(frozen=True)
class _Scored:
    """One line with one choice of added effects; minus infinity where the columns are collinear or the expansion is not plausible."""

    value: float
    coefficient: float
    u: float
    kept: tuple[Term, ...]


@dataclass(frozen=True)
class _Comparison:
    """Scores lines together with the other declared terms and any choice among the added ones."""

    model: ModelFit
    expansion: Term
    prior: Prior
    others: tuple[Term, ...]
    added: tuple[Term, ...]

    @classmethod
    def of(cls, model: ModelFit, declared: int) -> _Comparison | None:
        terms = model.terms[:declared]
        expansion = next((term for term in terms if term.effect == "axis_expansion"), None)
        if expansion is None or expansion.candidate.prior is None:
            return None
        others = tuple(term for term in terms if term is not expansion)
        return cls(model, expansion, expansion.candidate.prior, others, model.terms[declared:])

    def glance(self, column: Array) -> float:
        """Score of a line with all or none of the added effects, whichever is better."""
        return max(self.score(column, kept, _PLAUSIBLE).value for kept in ((), self.added))

    def best(self, column: Array, *, plausible: float = _PLAUSIBLE) -> _Scored:
        """The best choice among the added effects for a line."""
        choices = chain.from_iterable(combinations(self.added, count) for count in range(len(self.added) + 1))
        return max((self.score(column, kept, plausible) for kept in choices), key=lambda scored: scored.value)

    def score(self, column: Array, kept: tuple[Term, ...], plausible: float) -> _Scored:
        line = Term(self.expansion.effect, Candidate(column[:, None], {}, self.expansion.candidate.units))
        terms = [line, *self.others, *kept]
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
        limit = float(np.quantile(simulated.max(axis=0, initial=-np.inf), 1.0 - LINE_LEVEL, method="higher"))
        as_well = np.append(expansion[0], expansion[1:][gains >= -_AS_WELL])
        return max(limit, -float(np.log(LINE_LEVEL))), (float(as_well.min()), float(as_well.max()))

    def _whitened(self, columns: Sequence[Array]) -> tuple[Array, float]:
        """Products of whitened lines (declared first) and readings given all other terms, and the variance about the declared line."""
        model, terms = self.model, (*self.others, *self.added)
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
    # Axis positions on the plan, mm, one cell apart, position 0 among them.
    x, y = fields["x"].values, fields["y"].values
    cell = float(np.median(np.diff(x)))
    reach = np.ceil((np.abs(axis.origin_mm).sum() + np.hypot(np.ptp(x), np.ptp(y))) / cell)
    along = cell * np.arange(-reach, reach + 1.0)
    at_x, at_y = axis.points(along)
    within = (at_x >= x[0]) & (at_x <= x[-1]) & (at_y >= y[0]) & (at_y <= y[-1])
    along_mm = np.asarray(along[within])
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


#: Standard deviations by which the readings may contradict the stated expansion coefficient.
_LIMIT = 2.5
#: Largest expansion coefficient of a material that tables and frames of machine tools are made of, ppm/K: aluminium alloys, and a tenth;
#: that of the campaign file, and a tenth, where it is larger.
_LARGEST_PPM_PER_K = 26.0
#: Largest length of a frame that can move the laser against the table, as a multiple of the travel, and its smallest value, mm.
_FRAME_TRAVELS, _LEAST_FRAME_MM = 5.0, 3000.0
#: Log-likelihood by which another line must explain the readings better where it does away with a named cause: odds of 400 to 1. That
#: cause was chosen among as many candidates as there are lines, so that the number of alternatives counts on both sides.
_LINE_GAIN_OVER_CAUSE = 6.0
#: Share of the expansion that lines which fit as well may span for it to be a figure of the declared line alone: half of what the
#: coefficients of steels differ by (10 to 13 ppm/K), which no longer tells one from another.
_LINES_SPAN = 0.1
#: Standard deviations by which a coefficient must lie beyond what is possible.
_BEYOND_SIGMAS = 3.0


def _expansion(loop: AxisLoop) -> DeclaredCoefficient | None:
    """The declared expansion, where a coefficient is stated."""
    declared = loop.declared_coefficients
    return next((one for one in declared if one.effect == "axis_expansion" and one.prior is not None), None)


def withhold_names(loop: AxisLoop, effects: Mapping[str, Effect]) -> AxisLoop:
    """The closed loop without names that what stands beside them contradicts: of a course in time or a shape along the axis where the
    expansion is not the stated one, of which it has taken, or left, a part; and of what is smaller than the structure left.
    """
    stated, left = _expansion(loop), loop.unexplained
    alone, alone_u, off = (0.0, 0.0, 0.0) if stated is None else _asked_for(stated)
    has_structure = bool(left.shape) and determined(left.p_value) < REMAINDER_LEVEL
    structure_um = determined(left.rms_um) if has_structure else 0.0

    def why(step: AxisStep) -> str:
        effect, rms_um = effects[step.effect], determined(step.rms_um)
        if effect.like_expansion and math.isinf(alone_u):
            return say("withheld", "expansion_untold")
        if abs(off) > _LIMIT and (effect.excited_by or effect.like_expansion):
            return say("withheld", "expansion_contradicts", alone=alone, alone_u=alone_u)
        if structure_um > rms_um and not {"time_s", "period_min"} & set(step.parameters):
            return say("withheld", "less_than_is_left", rms_um=rms_um, structure_um=structure_um)
        return ""

    steps = tuple(step.model_copy(update={"withheld": step.withheld or why(step)}) for step in loop.steps)
    named = any(step.keeps_name and not step.withheld for step in steps)
    nameless = steps and not named and loop.verdict in ("explained", "partial")
    return loop.model_copy(update={"steps": steps, "verdict": "unexplained" if nameless else loop.verdict})


def _asked_for(entry: DeclaredCoefficient) -> tuple[float, float, float]:
    """Expansion that the readings alone ask for, its standard uncertainty, and standard deviations from the stated one."""
    stated, stated_u = determined(entry.prior), determined(entry.prior_u)
    of_readings = 1.0 - entry.expected_share
    # The readings say nothing of their own where the fit is no better known than the statement.
    if of_readings <= 0.0 or math.isinf(entry.moved_u):
        alone, alone_u = stated, math.inf
    else:
        alone = (determined(entry.value) - entry.expected) / of_readings
        # The stated coefficient has diluted an error of the rise's scale as it has diluted the readings.
        fit_u, scale_u = entry.fitted_u / math.sqrt(of_readings), (entry.u_scale or 0.0) / of_readings
        alone_u = math.hypot(fit_u, entry.moved_u, scale_u)
    return alone, alone_u, (alone - stated) / math.hypot(alone_u, stated_u)


@check("loop", LOG, waits=True)
def expansion_coefficient(loop: AxisLoop) -> Found | None:
    """The coefficient that the readings ask for, the share of its lagged copies included, against the stated one: within `_LIMIT`
    standard deviations, and without `material_compensation` added, by itself or in a tie: it acts in proportion to the coefficient, and
    imitates a wrong one.
    """
    stated = _expansion(loop)
    if stated is None:
        return None
    alone, alone_u, off = _asked_for(stated)
    # The compensation of the material may be what a wrong coefficient leaves.
    absorbed = any("material_compensation" in (step.effect, *step.tied) for step in loop.steps)
    return judge(
        off,
        _LIMIT,
        passed=abs(off) <= _LIMIT and not absorbed,
        alone=alone,
        alone_u=alone_u if math.isfinite(alone_u) else None,
        stated=stated.prior,
        stated_u=stated.prior_u,
        absorbed=absorbed,
    )


@check("loop", LOG, waits=True)
def sensitivity(loop: AxisLoop, travel_mm: float) -> Found | None:
    """Every coefficient per kelvin, declared or added, less `_BEYOND_SIGMAS` standard deviations, against the largest one possible:
    `_LARGEST_PPM_PER_K` ppm/K along the axis, or 1.1 times the stated coefficient where that is larger (polymers), and that times the
    largest frame (`_FRAME_TRAVELS` travels, at least `_LEAST_FRAME_MM` mm) across it: at most 1.
    """
    declared: list[tuple[str, Coefficient]] = [(entry.effect, entry) for entry in loop.declared_coefficients]
    coefficients = declared + [(step.effect, entry) for step in loop.steps for entry in step.coefficients]
    frame_mm = max(_FRAME_TRAVELS * travel_mm, _LEAST_FRAME_MM)
    stated = [entry.prior for _, entry in coefficients if entry.unit == "ppm/K" and entry.prior is not None]
    ppm_per_K = max([_LARGEST_PPM_PER_K, *(1.1 * value for value in stated)])
    largest = {"ppm/K": ppm_per_K, "um/K": ppm_per_K * frame_mm * 1e-3}

    def share_of(entry: Coefficient) -> float:
        size = abs(determined(entry.value)) - _BEYOND_SIGMAS * math.hypot(determined(entry.u), entry.moved_u)
        return size / largest[entry.unit]

    compared = [(share_of(entry), effect, entry) for effect, entry in coefficients if entry.unit in largest]
    if not compared:
        return None
    share, effect, entry = max(compared, key=lambda one: one[0])
    reach = largest[entry.unit]
    return judge(max(share, 0.0), 1.0, effect=effect, entry=entry, largest=reach, frame_m=frame_mm * 1e-3)


@check("loop", CLOCK, waits=True)
def axis_line(loop: AxisLoop) -> Found | None:
    """Log-likelihood that the best other line on the plan, order of the targets or sign of the deviations gains: at most what is gained
    by chance in `LINE_LEVEL` of `_DRAWS` simulated tests with the declared line, at least ln 500 = 6.2; `_LINE_GAIN_OVER_CAUSE` where it
    makes a named cause superfluous, which was chosen among as many.
    """
    line = loop.axis_line
    if line is None:
        return None
    limit = _LINE_GAIN_OVER_CAUSE if line.superfluous else determined(line.gain_limit)
    # An effect that is significant but has no name yet is worth about -ln p; a line that explains less is no better explanation.
    unconfirmed = map(determined, loop.unconfirmed_effects.values())
    limit = max(limit, *(-math.log(max(p, sys.float_info.min)) for p in unconfirmed), 0.0)
    return judge(determined(line.gain), limit, verified=not lines_differ(line), line=line)


def lines_differ(line: AxisLine) -> bool:
    """Whether lines that explain the readings as well as the declared one ask for expansions that differ."""
    low, high = map(determined, line.alternative_ppm_per_K)
    return high - low > _LINES_SPAN * max(abs(low), abs(high))


def with_line(loop: AxisLoop) -> AxisLoop:
    """Return the closed loop with what the choice of the line adds to the uncertainty of the declared expansion (rectangular,
    JCGM 100:2008, 4.3.7).
    """
    line = loop.axis_line
    if line is None or not lines_differ(line):
        return loop

    def completed(entry: DeclaredCoefficient) -> DeclaredCoefficient:
        if entry.effect != "axis_expansion":
            return entry
        # The expansion that was expected takes part along every line.
        others = ((1.0 - entry.expected_share) * determined(one) + entry.expected for one in line.alternative_ppm_per_K)
        u_line = max(abs(other - determined(entry.value)) for other in others) / math.sqrt(3.0)
        return entry.model_copy(update={"u": math.hypot(determined(entry.u), u_line), "u_line": u_line})

    return loop.model_copy(update={"declared_coefficients": tuple(map(completed, loop.declared_coefficients))})
