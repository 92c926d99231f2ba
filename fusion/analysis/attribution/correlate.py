"""Test which part of the temperature field the drift follows, so that two series that merely both rise are not taken for a finding.

Plan cells, localised thermal modes and regions are tested against the drift channels (common, proportional to position, reversal; on
request every target and direction). Each temperature passes through a bank of first-order lags. The drift that the field does not explain
is a random walk or an integrated random walk whose size is estimated again under every hypothesis, and the statistic is the profile
likelihood ratio. The family-wise p-value compares it with the maxima over all cells, modes, regions, lags and channels in series that are
simulated under the fitted null hypothesis: one error probability for everything that can become a finding.

Two limits are stated with the result. A session that is one warm-up moves every series along one curve; it is tested given free
exponentials, and its best verdict is "not separable"; where a warm-up only dominates, the remaining variation must carry the evidence. And
a map without a finding states its detection limit.

Source: Harris (2020), bioRxiv 2020.11.29.402719 (nonsense correlations); docs/method/attribution.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
import xarray as xr
from numpy.typing import NDArray

from fusion.analysis.alignment.first_order_lag import respond
from fusion.analysis.alignment.readings import check_readings
from fusion.analysis.attribution.drift_channels import (
    ClockedReadings,
    DriftSeries,
    clock_readings,
    reduce_channels,
    target_series,
)
from fusion.analysis.attribution.modes import (
    Excitation,
    Modes,
    Region,
    describe_excitation,
    localise_modes,
    region_courses,
)
from fusion.analysis.attribution.significance import (
    LAGS_S,
    AttributionResult,
    FamilyTest,
    FieldSeries,
    evaluate_candidates,
    screen,
)
from fusion.analysis.levels import ATTRIBUTION_LEVEL, CHECKS
from fusion.common import Array, FusionError
from fusion.results.axis import SourcePart
from fusion.results.parts import AreaPart, Sensitivity
from thermofuse.resources import variables
from thermofuse.units import conform
from thermography.common import FIELD_ATTRIBUTES, FIELDS
from thermography.large_arrays import piece_slices

# Places on the plan as areas: the cells that belong together around a peak, and the rectangle that names them.

#: Cells that reach at least this share of the peak of a mode belong to its place.
IN_MODE = 0.5


def piece_with_peak(strength: Array, inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the connected piece of cells that holds the strongest one."""
    return _pieces(strength, inside)[0]


def _pieces(strength: Array, inside: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], list[tuple[np.intp, ...]]]:
    """The connected piece of cells with the strongest one, and the strongest cell of every other piece."""
    labels, count = scipy.ndimage.label(inside, np.ones((3, 3)))
    leading = labels[np.unravel_index(int(strength.argmax()), strength.shape)]
    others = (np.where(labels == label, strength, -np.inf) for label in range(1, count + 1) if label != leading)
    return labels == leading, [np.unravel_index(int(other.argmax()), strength.shape) for other in others]


def mode_cells(pattern: Array) -> NDArray[np.bool_]:
    """Return the cells of a thermal mode: connected to its peak, with at least half of its strength."""
    strength = np.abs(np.nan_to_num(pattern))
    return piece_with_peak(strength, strength >= IN_MODE)


def area_of(cells: NDArray[np.bool_], plan: xr.Dataset) -> AreaPart | None:
    """Return the rectangle around some cells of a plan with evenly spaced ``x`` and ``y``, mm; None without any cell."""
    if not cells.any():
        return None
    x, y = plan["x"].values, plan["y"].values
    half = float(np.median(np.diff(x))) / 2
    across, along = x[cells.any(axis=0)], y[cells.any(axis=1)]
    return AreaPart(
        x_low_mm=across.min() - half,
        x_high_mm=across.max() + half,
        y_low_mm=along.min() - half,
        y_high_mm=along.max() + half,
    )


#: Verdict codes of the maps, in the order of the CF flag meanings.
NOT_ATTRIBUTABLE, ATTRIBUTABLE, NOT_SEPARABLE = 0, 1, 2
_FLAG_MEANINGS = "not_attributable attributable not_separable"
#: Thermal modes get a larger share of the error probability: few, of low noise and each one place, they find what single cells miss, and
#: cells mostly draw the map around them. A quarter of the unit costs the cells 1 % of power and finds 3 % more sources (simulated).
_FAVOUR = {"modes": 0.25}
#: Attributes of every result per channel, column or session; and of targets and directions by themselves.
_MEANINGS: dict[str, dict[str, Any]] = {
    **variables("correlation")[1],
    "verdict": {"flag_values": np.array([0, 1, 2], np.int8), "flag_meanings": _FLAG_MEANINGS},
}
_OF_TARGETS: dict[str, dict[str, Any]] = {**variables("correlation_of_targets")[1]}
#: Cells on which fields are correlated, about.
_CELL_MM = 10.0
#: Cells with gaps in up to this share of the frames are filled by interpolation in time; others are left out.
_GAP_SHARE = 0.2
#: Values (channels or series, columns) by name.
_Quantities = dict[str, NDArray[Any]]


class CorrelationError(FusionError):
    """A field that cannot be correlated with the drift; the message says what is missing."""


def correlate(
    fused: xr.Dataset,
    fields: xr.Dataset | xr.DataArray,
    *,
    regions: Sequence[Region] = (),
    lags_s: Sequence[float] = LAGS_S,
    draws: int = 499,
    checks: int = CHECKS,
    per_target: bool = False,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> xr.DataTree:
    """Test plan cells, thermal modes and regions as sources of the drift.

    Parameters
    ----------
    fused : Dataset
        What `align` returns: ``deviation`` (um) and ``time`` (UTC) over cycle, direction and target, and ``position`` (mm) over target.
    fields : Dataset, or DataArray (time, y, x)
        What `reduce_frames` returns, with times on the laser's clock; the field of its frames is averaged to cells of about 10 mm. Or a
        temperature in degC or rise in K on the plan (mm) as it is. At least 12 frames; NaN where the plan is not seen.
    regions : sequence of Region
        Parts of the plan whose mean temperature is tested as well, each with a name of its own.
    lags_s : sequence of float, s
        Time constants of the first-order lags; 0 is no lag.
    draws : int
        Number of series simulated under the fitted null hypothesis, which set the threshold.
    checks : int
        Number of further simulated series on which the false alarm rate of this threshold is measured.
    per_target : bool
        Also test every target and direction by itself, with its own family-wise error and the whitening fixed under the null.
    seed : int
        Seed of the simulated series.
    progress : callable, optional
        Called with the finished share, 0 to 1.

    Returns
    -------
    DataTree
        Root: maps (channel, y, x) ``statistic``, ``p_value`` (family-wise), ``q_value`` (false discovery), ``sensitivity``,
        ``sensitivity_u``, ``sensitivity_low`` and ``sensitivity_high`` (95 % for all places at once, at their lag) and
        ``detectable_sensitivity`` (um/K; the last with 80 % power), ``lag`` (s), ``verdict``, and
        ``naive_correlation`` for contrast only; per channel ``threshold``, ``noise`` (um), ``unexplained_drift`` (um over one hour),
        ``drift_order``; ``false_alarm_rate`` of everything tested, ``cells_false_alarm_rate``, ``warm_up_share``; attribute ``verdict``.
        Group ``modes``: the same over channel and mode, with ``pattern`` (1 at the strongest cell, at ``at_x``, ``at_y``) and
        ``p_beside``, the p-value given the leading mode (NaN for that one, and where none passes). Group ``regions``: over channel and
        region. With `per_target`: groups ``targets`` (series, y, x) and ``target_regions`` (series, region).

    Raises
    ------
    CorrelationError, ChannelError, RegionError
        If no cell is seen, too few frames or cycles remain, or a region contains no seen cell.

    Notes
    -----
    Test, equations and error rates: docs/method/attribution.md.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> time = np.datetime64("2026-03-09T08", "ns") + 300 * np.arange(40) * np.timedelta64(1, "s")
    >>> plan = {"time": time, "y": [0.0, 10.0, 20.0], "x": [0.0, 10.0, 20.0, 30.0]}
    >>> field = xr.DataArray(rng.normal(size=(40, 3, 4)).cumsum(axis=0), plan, tuple(plan))
    >>> drift = field.sel(x=20, y=10).values + 0.1 * rng.normal(size=40)
    >>> readings = xr.Dataset({"deviation": ("cycle", drift), "time": ("cycle", time)}).expand_dims(direction=["positive"], target=[1])
    >>> maps = correlate(readings.assign(position=("target", [0.0]), cycle=range(40)), field, draws=99, checks=0)
    >>> maps.attrs["verdict"], round(float(maps["sensitivity"].sel(channel="common", x=20, y=10)), 2)
    ('attributable', 1.02)
    """
    fused = check_readings(fused, "fused", "align", CorrelationError)
    dims = FIELDS["frame_temperature"][0]
    plan = fields.to_dataset(name="frame_temperature") if isinstance(fields, xr.DataArray) else fields
    described = FIELD_ATTRIBUTES | ({} if isinstance(fields, xr.Dataset) else {"frame_temperature": {}})
    plan = conform(
        plan, {"frame_temperature": dims}, described, name="fields", source="reduce_frames", error=CorrelationError
    )
    field = coarsen_field(plan) if isinstance(fields, xr.Dataset) else plan["frame_temperature"]
    # The drift is a course over the cycles as they were measured.
    readings = clock_readings(fused.sortby("cycle"), field["time"].values.astype("datetime64[ns]"))
    candidates = _Candidates.collect(field, readings.frame_seconds, regions)
    cells = candidates.sets["cells"]
    excitation = describe_excitation(cells.values, cells.seconds)
    session = _Session(reduce_channels(readings), candidates, excitation, lags_s, draws, seed)
    result = session.evaluate(candidates.sets, checks, seed, progress=progress, favour=_FAVOUR)
    groups: dict[str, xr.Dataset] = {}
    for name, test in result.sets.items():
        groups[name] = candidates.lay_out(name, "channel", session.quantities(name, test), _MEANINGS)
        if name != "cells":
            rate = {"false_alarm_rate": _variable("false_alarm_rate", test.false_alarm_rate)}
            groups[name] = groups[name].assign({"threshold": _variable("threshold", test.threshold), **rate})
    if "modes" in groups:
        p_given = session.p_given_leading_mode(result.sets["modes"])
        groups["modes"]["p_beside"] = (("channel", "mode"), p_given, _MEANINGS["p_beside"])
    if per_target:
        groups |= session.screen_targets(readings)
    root = _describe_session(result, excitation).assign(groups.pop("cells"))
    root.attrs["readings_outside_film"] = readings.outside_frames
    return xr.DataTree.from_dict({"/": root, **groups})


def coarsen_field(fields: xr.Dataset) -> xr.DataArray:
    """The field of every frame on cells of about 10 mm, degC; frames are averaged some at a time, as there may be very many."""
    frames = fields["frame_temperature"]
    block = max(1, int(_CELL_MM / float(np.median(np.diff(fields["x"])))))
    parts = [frames[some].coarsen(x=block, y=block, boundary="trim").mean() for some in piece_slices(frames.shape)]
    return xr.concat(parts, "time")


def _variable(name: str, values: Any) -> tuple[tuple[str, ...], Any, dict[str, Any]]:
    """A result per channel, or of the session, as a variable."""
    return (("channel",) if np.ndim(values) else (), values, _MEANINGS[name])


def flatten_field(field: xr.DataArray, frame_seconds: Array) -> tuple[FieldSeries, NDArray[np.bool_]]:
    """Return the courses of the cells that are seen in nearly every frame."""
    values = field.values.reshape(field.sizes["time"], -1).astype(float)
    gaps = ~np.isfinite(values)
    seen = gaps.mean(axis=0) <= _GAP_SHARE
    if not seen.any():
        raise CorrelationError(
            "no plan cell is seen in at least 80 % of the frames; check the registration and the masks"
        )
    values, gaps = values[:, seen], gaps[:, seen]
    for column in np.flatnonzero(gaps.any(axis=0)):
        finite = ~gaps[:, column]
        values[~finite, column] = np.interp(frame_seconds[~finite], frame_seconds[finite], values[finite, column])
    return FieldSeries(frame_seconds, values - values.mean(axis=0)), seen


@dataclass(frozen=True)
class _Candidates:
    """The temperatures to test: ``cells``, ``modes`` and ``regions`` where there are any; `seen` (y * x,) says which cells those are."""

    sets: dict[str, FieldSeries]
    field: xr.DataArray
    seen: NDArray[np.bool_]
    modes: Modes
    regions: Sequence[Region]

    @staticmethod
    def collect(field: xr.DataArray, frame_seconds: Array, regions: Sequence[Region]) -> _Candidates:
        cells, seen = flatten_field(field, frame_seconds)
        modes = localise_modes(cells.values)
        courses = {"modes": modes.courses, "regions": region_courses(cells.values, seen, field, regions)}
        few = {name: FieldSeries(cells.seconds, values) for name, values in courses.items() if values.shape[1]}
        return _Candidates({"cells": cells, **few}, field, seen, modes, regions)

    def lay_out(
        self, name: str, leading: str, quantities: _Quantities, meaning: Mapping[str, dict[str, Any]]
    ) -> xr.Dataset:
        """Quantities (leading, columns) of one set as variables, with the places of its columns."""
        if name == "cells":
            maps = {quantity: self._map(leading, values, meaning[quantity]) for quantity, values in quantities.items()}
            return xr.Dataset(maps, {"y": self.field["y"], "x": self.field["x"]})
        kind, mm = {"modes": "mode", "regions": "region"}[name], {"units": "mm"}
        columns = xr.Dataset(
            {one: ((leading, kind), _without_infinities(values), meaning[one]) for one, values in quantities.items()}
        )
        if name == "regions":
            columns = columns.assign_coords(region=[region.name for region in self.regions])
            place_mm = np.array([region.centre_mm for region in self.regions]).reshape(-1, 2)
        else:
            row, column = np.divmod(np.flatnonzero(self.seen)[self.modes.peaks], self.field.sizes["x"])
            place_mm = np.column_stack([self.field["x"].values[column], self.field["y"].values[row]])
            pattern = self._map("mode", self.modes.patterns, {"units": "1"})
            columns = columns.assign_coords(mode=np.arange(1, row.size + 1)).assign(pattern=pattern)
        return columns.assign(at_x=((kind,), place_mm[:, 0], mm), at_y=((kind,), place_mm[:, 1], mm))

    def _map(self, leading: str, values: NDArray[Any], attrs: dict[str, Any]) -> xr.DataArray:
        """One quantity (leading, seen cells) as maps; cells that were not tested are NaN, flags there 0."""
        whole = np.full((values.shape[0], self.seen.size), 0 if values.dtype.kind == "i" else np.nan, values.dtype)
        whole[:, self.seen] = _without_infinities(values)
        return xr.DataArray(whole.reshape(-1, *self.field.shape[1:]), dims=(leading, "y", "x"), attrs=attrs)


def _without_infinities(values: NDArray[Any]) -> NDArray[Any]:
    return values if values.dtype.kind == "i" else np.where(np.isfinite(values), values, np.nan)


@dataclass(frozen=True)
class _Session:
    """One session ready to be tested: its drift, its candidates, and how they are compared."""

    series: Sequence[DriftSeries]
    candidates: _Candidates
    excitation: Excitation
    lags_s: Sequence[float]
    draws: int
    seed: int

    def evaluate(self, sets: dict[str, FieldSeries], checks: int, seed: int, **options: Any) -> AttributionResult:
        """Test sets of candidates together."""
        return evaluate_candidates(
            self.series, sets, self.excitation, lags_s=self.lags_s, draws=self.draws, checks=checks,
            rng=np.random.default_rng(seed), **options,
        )  # fmt: skip

    def quantities(self, name: str, test: FamilyTest) -> _Quantities:
        """What the test found per channel and column."""
        verdict = np.where(test.p_value <= ATTRIBUTION_LEVEL, ATTRIBUTABLE, NOT_ATTRIBUTABLE)
        if self.excitation.warm_up_only:
            verdict = np.full_like(verdict, NOT_SEPARABLE)
        naive = [_naive_correlation(channel, self.candidates.sets[name]) for channel in self.series]
        naive += naive[:1] * (len(test.names) - len(naive))
        return {
            "statistic": test.statistic,
            "p_value": test.p_value,
            "q_value": test.q_value,
            "sensitivity": test.coefficient,
            "sensitivity_u": test.coefficient_u,
            "sensitivity_low": test.low,
            "sensitivity_high": test.high,
            "detectable_sensitivity": test.detectable,
            "lag": np.asarray(self.lags_s, float)[test.lag_index],
            "verdict": verdict.astype(np.int8),
            "naive_correlation": np.stack(naive),
        }

    def p_given_leading_mode(self, test: FamilyTest) -> Array:
        """Family-wise p (channel, mode) of what each mode adds to the leading one, which is taken as given at its lag."""
        modes = self.candidates.sets["modes"]
        count = modes.values.shape[1]
        p_value = np.full((len(test.names), count), np.nan)
        ratio = test.statistic / test.threshold[:, None]
        channel, leader = np.unravel_index(
            int(np.where(test.p_value <= ATTRIBUTION_LEVEL, ratio, -1.0).argmax()), ratio.shape
        )
        others = np.flatnonzero(np.arange(count) != leader)
        if test.p_value[channel, leader] <= ATTRIBUTION_LEVEL and others.size and not self.excitation.warm_up_only:
            lag_s = self.lags_s[int(test.lag_index[channel, leader])]
            given = respond(modes.values[:, [leader]], modes.seconds, time_constant_s=lag_s)
            rest = {"modes": FieldSeries(modes.seconds, modes.values[:, others])}
            given_series = [channel.sampling @ given for channel in self.series]
            p_value[:, others] = (
                self.evaluate(rest, 0, self.seed + 2, conditional_on=given_series).sets["modes"].p_value
            )
        return p_value

    def screen_targets(self, readings: ClockedReadings) -> dict[str, xr.Dataset]:
        """What every target and direction shows by itself, for cells and regions."""
        targets = target_series(readings)
        coords = {
            "series": list(targets.names),
            "series_direction": ("series", list(targets.directions)),
            "series_target": ("series", targets.targets),
        }
        groups = {}
        for name, group in (("cells", "targets"), ("regions", "target_regions")):
            if name not in self.candidates.sets:
                continue
            found = screen(
                targets, self.candidates.sets[name], self.excitation, lags_s=self.lags_s, permutations=self.draws,
                rng=np.random.default_rng(self.seed + 1),
            )  # fmt: skip
            quantities: _Quantities = {
                "statistic": found.statistic,
                "p_value": found.p_value,
                "sensitivity": found.sensitivity,
                "sensitivity_u": found.sensitivity_u,
                "sensitivity_half_width": found.half_width,
                "lag": np.asarray(self.lags_s, float)[found.lag_index],
            }
            laid_out = self.candidates.lay_out(name, "series", quantities, _OF_TARGETS)
            groups[group] = laid_out.assign_coords(coords)
        return groups


def _naive_correlation(series: DriftSeries, field: FieldSeries) -> Array:
    """Plain correlation (columns,) of a series with the field without lag: what a map without any of the above would show."""
    regressors = series.sampling @ field.values
    regressors = regressors - regressors.mean(axis=0)
    values = series.values - series.values.mean()
    size = np.sqrt((regressors**2).sum(axis=0) * (values**2).sum())
    return (values @ regressors) / np.where(size > 0, size, 1.0)


def _describe_session(result: AttributionResult, excitation: Excitation) -> xr.Dataset:
    """What holds for the whole session: thresholds, noise and unexplained drift per channel, false alarm rates, verdict."""
    cells = result.sets["cells"]
    nulls = list(result.nulls) + [result.nulls[0]] * (len(cells.names) - len(result.nulls))
    values: dict[str, Any] = {
        "threshold": cells.threshold,
        "noise": [null.sigma for null in nulls],
        "unexplained_drift": [null.drift_per_hour for null in nulls],
        "drift_order": [float(null.order) for null in nulls],
        "false_alarm_rate": result.false_alarm_rate,
        "cells_false_alarm_rate": cells.false_alarm_rate,
        "warm_up_share": excitation.warm_up_share,
    }
    passed = any((test.p_value <= ATTRIBUTION_LEVEL).any() for test in result.sets.values())
    flag = NOT_SEPARABLE if excitation.warm_up_only else ATTRIBUTABLE if passed else NOT_ATTRIBUTABLE
    verdict = _FLAG_MEANINGS.split()[flag].replace("_", " ")
    return xr.Dataset(
        {name: _variable(name, value) for name, value in values.items()},
        coords={"channel": list(cells.names)},
        attrs={"verdict": verdict, "excitation": excitation.name, "draws": result.draws},
    )


# Name the leading source of a session: which candidate goes with the drift, where it is, and which places explain the
# drift as well.

#: A place explains the drift as well as the leading one if its likelihood ratio is lower by no more than this (chi-square, 1
#: degree of freedom, 0.95).
_EQUAL_RATIO = 3.84
#: Separate pieces of a mode that reach this share of its peak are places of their own.
_PEAK = 0.7
_QUANTITIES = (
    "p_value", "statistic", "sensitivity", "sensitivity_u", "sensitivity_low", "sensitivity_high", "lag",
    "detectable_sensitivity", "threshold",
)  # fmt: skip
#: Sets of candidates in the order in which they are asked, and the kind of each.
_KINDS = {"modes": "mode", "cells": "cell", "regions": "region"}


def find_source(maps: xr.DataTree) -> SourcePart:
    """Return the leading candidate of a session, whether it passes or not."""
    leaders = {name: _leader(maps, name) for name in _KINDS if name == "cells" or name in maps.children}
    smallest = {name: float(leader["p_value"]) for name, leader in leaders.items()}
    passed = [name for name, p in smallest.items() if p <= ATTRIBUTION_LEVEL]
    chosen = passed[0] if passed else min(smallest, key=lambda name: smallest[name])
    best, kind = leaders[chosen], _KINDS[chosen]
    inside, others = _surroundings(maps, chosen, best)
    value, low, high = (float(best[name]) for name in ("sensitivity", "sensitivity_low", "sensitivity_high"))
    # The strongest of many places is too strong by chance: its interval allows for that, its own uncertainty does not.
    u = max(float(best["sensitivity_u"]), (high - value) / 2.0, (value - low) / 2.0)
    return SourcePart(
        kind=kind,
        name="" if kind == "cell" else str(best[kind].values),
        part=str(best["channel"].values),
        x_mm=float(best["x"]),
        y_mm=float(best["y"]),
        # A region has an outline of its own.
        area=area_of(inside, maps.to_dataset()),
        p_value=float(best["p_value"]),
        sensitivity_um_per_K=Sensitivity(value=value, u=u),
        sensitivity_interval_um_per_K=(low, high),
        lag_s=float(best["lag"]),
        detectable_um_per_K=float(best["detectable_sensitivity"]),
        equivalent_places_mm=others,
    )


def _columns(maps: xr.DataTree, name: str) -> xr.Dataset:
    """Results of one set over channel and candidate, with the places of the candidates as x and y."""
    if name == "cells":
        return maps.to_dataset()[list(_QUANTITIES)].stack(candidate=("y", "x"))
    columns = maps.children[name].to_dataset()
    return columns[list(_QUANTITIES)].assign_coords(x=columns["at_x"], y=columns["at_y"])


def _leader(maps: xr.DataTree, name: str) -> xr.Dataset:
    """The candidate of smallest p-value; equal ones (the resolution of the draws) are ordered by statistic over threshold."""
    columns = _columns(maps, name)
    p_value = columns["p_value"].fillna(1.0).values
    ratio = (columns["statistic"] / columns["threshold"]).transpose(*columns["p_value"].dims).fillna(0.0).values
    place = np.lexsort((-ratio.ravel(), p_value.ravel()))[0]
    channel, column = np.unravel_index(int(place), p_value.shape)
    return columns.isel({"channel": channel, columns["p_value"].dims[1]: column})


def _surroundings(
    maps: xr.DataTree, name: str, best: xr.Dataset
) -> tuple[NDArray[np.bool_], list[tuple[float, float]]]:
    """Cells (y, x) of the leading place, and the other places (x, y in mm) that explain the drift as well."""
    channel, plan = best["channel"].values, maps.to_dataset()
    if name == "cells":
        statistic = np.nan_to_num(plan["statistic"].sel(channel=channel).values, nan=-np.inf)
        return _split(statistic, statistic >= statistic.max() - _EQUAL_RATIO, plan)
    columns = _columns(maps, name).sel(channel=channel)
    kind = _KINDS[name]
    alike = (columns["statistic"] >= best["statistic"] - _EQUAL_RATIO).values & (columns[kind] != best[kind]).values
    others = [(float(x), float(y)) for x, y in zip(columns["x"].values[alike], columns["y"].values[alike], strict=True)]
    if name == "regions":
        return np.zeros((plan.sizes["y"], plan.sizes["x"]), bool), others
    modes = maps.children["modes"].to_dataset()
    pattern = np.abs(np.nan_to_num(modes["pattern"].sel(mode=int(best["mode"])).values))
    _, elsewhere = _split(pattern, pattern >= _PEAK, plan)
    return mode_cells(pattern), [*elsewhere, *others]


def _split(
    strength: Array, equal: NDArray[np.bool_], plan: xr.Dataset
) -> tuple[NDArray[np.bool_], list[tuple[float, float]]]:
    """The connected piece of equal cells with the strongest one, and the strongest cell (x, y in mm) of every other piece."""
    piece, others = _pieces(strength, equal)
    return piece, [(float(plan["x"][column]), float(plan["y"][row])) for row, column in others]
