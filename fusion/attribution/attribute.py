"""Test which part of the temperature field drives the drift, so that two series that merely both rise are not taken for cause and effect.

Plan cells, localised thermal modes and regions are tested against the drift channels (common, proportional to position, reversal; on
request every target and direction). Each temperature passes through a bank of first-order lags. The drift that the field does not explain
is a random walk or an integrated random walk whose size is estimated anew under every hypothesis, and the statistic is the profile
likelihood ratio. The family-wise p-value compares it with the maxima over all cells, modes, regions, lags and channels in series that are
simulated under the fitted null hypothesis: one error probability for everything that can become a finding.

Two limits are stated with the result. A session that is one warm-up moves every series along one curve; it is tested beside free
exponentials, and its best verdict is "not separable"; where a warm-up only dominates, the remaining variation must carry the evidence. And
a map without a finding states its detection limit.

Source: Harris (2020), bioRxiv 2020.11.29.402719 (nonsense correlations); docs/method/attribution.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.alignment.first_order_lag import respond
from fusion.attribution.drift_channels import (
    ClockedReadings,
    DriftSeries,
    clock_readings,
    reduce_channels,
    target_series,
)
from fusion.attribution.family_wise import (
    CHECKS,
    LAGS_S,
    LEVEL,
    AttributionResult,
    FamilyTest,
    FieldSeries,
    evaluate_candidates,
)
from fusion.attribution.per_target import screen
from fusion.attribution.thermal_modes import Modes, Region, localise_modes, region_courses
from fusion.attribution.warm_up import Excitation, describe_excitation
from fusion.errors import FusionError

#: Verdict codes of the maps, in the order of the CF flag meanings.
NOT_ATTRIBUTABLE, ATTRIBUTABLE, NOT_SEPARABLE = 0, 1, 2
_FLAG_MEANINGS = "not_attributable attributable not_separable"
#: Thermal modes get a larger share of the error probability: few, of low noise and each one place, they find what single cells miss, and
#: cells mostly draw the map around them. A quarter of the unit costs the cells 1 % of power and finds 3 % more sources (simulated).
_FAVOUR = {"modes": 0.25}
_THRESHOLD = {"units": "1", "long_name": "statistic at a family-wise p of 0.05"}
_RATE = {"units": "1", "long_name": "share of fresh nulls flagged"}
#: Cells with gaps in up to this share of the frames are filled by interpolation in time; others are left out.
_GAP_SHARE = 0.2
#: Values (channels or series, columns) and attributes with units, by name.
_Quantities = dict[str, tuple[Array | NDArray[Any], dict[str, Any]]]


class CorrelationError(FusionError):
    """A field that cannot be correlated with the drift; the message says what is missing."""


def correlate(
    fused_readings: xr.Dataset,
    field: xr.DataArray,
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
    fused_readings : Dataset
        ``deviation`` (um) and ``time`` (UTC) over cycle, direction and target, and ``position`` (mm) over target.
    field : DataArray, (time, y, x)
        Temperature in degC or rise in K on the plan (mm), at least 12 frames; NaN where the plan is not seen.
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
        ``sensitivity_u`` and ``detectable_sensitivity`` (um/K; the last with 80 % power), ``lag`` (s), ``verdict``, and
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
    if field.dims != ("time", "y", "x"):
        raise CorrelationError(f"field has dims {field.dims}; expected ('time', 'y', 'x')")
    readings = clock_readings(fused_readings, field["time"].values.astype("datetime64[ns]"))
    candidates = _Candidates.collect(field, readings.frame_seconds, regions)
    session = _Session.prepare(readings, candidates, lags_s, draws, seed)
    return session.describe(session.evaluate(checks, progress), readings, per_target=per_target)


def flatten_field(field: xr.DataArray, frame_seconds: Array) -> tuple[FieldSeries, NDArray[np.bool_]]:
    """Return the courses of the cells that are seen in nearly every frame.

    Parameters
    ----------
    field : DataArray, (time, y, x)
        Temperature in degC or rise in K, NaN where the plan is not seen.
    frame_seconds : (frames,) ndarray, s
        Times of the frames since the first one, increasing.

    Returns
    -------
    FieldSeries
        The seen cells as columns, each minus its mean over time; gaps are interpolated linearly in time.
    (y * x,) ndarray of bool
        Which cells these are.

    Raises
    ------
    CorrelationError
        If no cell is seen in at least 80 % of the frames.
    """
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
    """The temperatures to test, and where they lie on the plan.

    Attributes
    ----------
    sets : ``cells``, and ``modes`` and ``regions`` where there are any
    field : (time, y, x), for the coordinates of the plan
    seen : (y * x,) which cells are the columns of ``cells``
    modes, regions : what the columns of ``modes`` and ``regions`` are
    """

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

    def lay_out(self, name: str, leading: str, quantities: _Quantities) -> xr.Dataset:
        """Quantities (leading, columns) of one set as variables, with the places of its columns."""
        if name == "cells":
            return xr.Dataset(self._maps(leading, quantities), {"y": self.field["y"], "x": self.field["x"]})
        kind = {"modes": "mode", "regions": "region"}[name]
        variables = {
            quantity: ((leading, kind), _without_infinities(values), attrs)
            for quantity, (values, attrs) in quantities.items()
        }
        if name == "regions":
            centre = np.array([region.centre_mm for region in self.regions]).reshape(-1, 2)
            return _placed(xr.Dataset(variables, {"region": [region.name for region in self.regions]}), centre)
        row, column = np.divmod(np.flatnonzero(self.seen)[self.modes.peaks], self.field.sizes["x"])
        peak = np.column_stack([self.field["x"].values[column], self.field["y"].values[row]])
        pattern = self._maps("mode", {"pattern": (self.modes.patterns, {"units": "1"})})
        return _placed(xr.Dataset(variables, {"mode": np.arange(1, peak.shape[0] + 1)}).assign(pattern), peak)

    def _maps(self, leading: str, quantities: _Quantities) -> dict[str, xr.DataArray]:
        """Quantities (leading, seen cells) as maps; cells that were not tested are NaN, flags there 0."""
        maps = {}
        for name, (values, attrs) in quantities.items():
            whole = np.full((values.shape[0], self.seen.size), 0 if values.dtype.kind == "i" else np.nan, values.dtype)
            whole[:, self.seen] = _without_infinities(values)
            maps[name] = xr.DataArray(whole.reshape(-1, *self.field.shape[1:]), dims=(leading, "y", "x"), attrs=attrs)
        return maps


def _placed(columns: xr.Dataset, place_mm: Array) -> xr.Dataset:
    """A Dataset over one kind of candidates with their places (candidates, 2), mm."""
    (kind,) = columns.coords
    mm = {"units": "mm"}
    return columns.assign(at_x=((kind,), place_mm[:, 0], mm), at_y=((kind,), place_mm[:, 1], mm))


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

    @staticmethod
    def prepare(
        readings: ClockedReadings, candidates: _Candidates, lags_s: Sequence[float], draws: int, seed: int
    ) -> _Session:
        cells = candidates.sets["cells"]
        excitation = describe_excitation(cells.values, cells.seconds)
        return _Session(reduce_channels(readings), candidates, excitation, lags_s, draws, seed)

    def evaluate(self, checks: int, progress: Callable[[float], None] | None) -> AttributionResult:
        """Test all candidates together."""
        return evaluate_candidates(
            self.series,
            self.candidates.sets,
            self.excitation,
            lags_s=self.lags_s,
            draws=self.draws,
            checks=checks,
            favour=_FAVOUR,
            rng=np.random.default_rng(self.seed),
            progress=progress,
        )

    def describe(self, result: AttributionResult, readings: ClockedReadings, *, per_target: bool) -> xr.DataTree:
        """Everything that was tested, as `correlate` returns it."""
        groups: dict[str, xr.Dataset] = {}
        for name, test in result.sets.items():
            groups[name] = self.candidates.lay_out(name, "channel", self._quantities(name, test))
            if name != "cells":
                groups[name] = groups[name].assign(_describe_set(test))
        if "modes" in groups:
            groups["modes"]["p_beside"] = self._p_beside_leader(result.sets["modes"])
        if per_target:
            groups |= self._screen_targets(readings)
        root = _describe_session(result, self.excitation).assign(groups.pop("cells"))
        root.attrs["readings_outside_film"] = readings.outside_frames
        return xr.DataTree.from_dict({"/": root, **groups})

    def _quantities(self, name: str, test: FamilyTest) -> _Quantities:
        """What the test found per channel and column."""
        verdict = np.where(test.p_value <= LEVEL, ATTRIBUTABLE, NOT_ATTRIBUTABLE)
        if self.excitation.warm_up_only:
            verdict = np.full_like(verdict, NOT_SEPARABLE)
        naive = [_naive_correlation(channel, self.candidates.sets[name]) for channel in self.series]
        naive += naive[:1] * (len(test.names) - len(naive))
        one, per_kelvin = {"units": "1"}, {"units": "um/K"}
        plain = "plain correlation, for contrast only: two trending series always correlate"
        flags = {"flag_values": np.array([0, 1, 2], np.int8), "flag_meanings": _FLAG_MEANINGS}
        return {
            "statistic": (test.statistic, {**one, "long_name": "profile likelihood ratio"}),
            "p_value": (test.p_value, {**one, "long_name": "family-wise p value"}),
            "q_value": (test.q_value, {**one, "long_name": "false-discovery rate"}),
            "sensitivity": (test.coefficient, {**per_kelvin, "long_name": "drift per rise of this place"}),
            "sensitivity_u": (
                test.coefficient_u,
                {**per_kelvin, "long_name": "standard uncertainty of the sensitivity"},
            ),
            "detectable_sensitivity": (
                test.detectable,
                {**per_kelvin, "long_name": "sensitivity found with 80 % power at this place"},
            ),
            "lag": (
                np.asarray(self.lags_s, float)[test.lag_index],
                {"units": "s", "long_name": "time constant of the response"},
            ),
            "verdict": (verdict.astype(np.int8), flags),
            "naive_correlation": (np.stack(naive), {**one, "long_name": plain}),
        }

    def _p_beside_leader(self, test: FamilyTest) -> xr.DataArray:
        """Family-wise p (channel, mode) of what each mode adds to the leading one, which is taken as given at its lag.

        Modes that are collinear with the leading one go with the drift as it does, but add nothing to it.
        """
        modes = self.candidates.sets["modes"]
        count = modes.values.shape[1]
        p_value = np.full((len(test.names), count), np.nan)
        ratio = test.statistic / test.threshold[:, None]
        channel, leader = np.unravel_index(int(np.where(test.p_value <= LEVEL, ratio, -1.0).argmax()), ratio.shape)
        others = np.flatnonzero(np.arange(count) != leader)
        if test.p_value[channel, leader] <= LEVEL and others.size and not self.excitation.warm_up_only:
            lag_s = self.lags_s[int(test.lag_index[channel, leader])]
            given = respond(modes.values[:, [leader]], modes.seconds, time_constant_s=lag_s)
            again = evaluate_candidates(
                self.series,
                {"modes": FieldSeries(modes.seconds, modes.values[:, others])},
                self.excitation,
                lags_s=self.lags_s,
                draws=self.draws,
                checks=0,
                beside=[channel.sampling @ given for channel in self.series],
                rng=np.random.default_rng(self.seed + 2),
            )
            p_value[:, others] = again.sets["modes"].p_value
        attrs = {"units": "1", "long_name": "family-wise p value of what this mode adds to the leading one"}
        return xr.DataArray(p_value, dims=("channel", "mode"), attrs=attrs)

    def _screen_targets(self, readings: ClockedReadings) -> dict[str, xr.Dataset]:
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
            screening = screen(
                targets,
                self.candidates.sets[name],
                self.excitation,
                lags_s=self.lags_s,
                permutations=self.draws,
                rng=np.random.default_rng(self.seed + 1),
            )
            quantities: _Quantities = {
                "statistic": (
                    screening.statistic,
                    {"units": "1", "long_name": "likelihood ratio, whitening fixed under the null"},
                ),
                "p_value": (screening.p_value, {"units": "1", "long_name": "family-wise p value over all series"}),
                "sensitivity": (screening.sensitivity, {"units": "um/K"}),
                "sensitivity_u": (screening.sensitivity_u, {"units": "um/K"}),
                "lag": (np.asarray(self.lags_s, float)[screening.lag_index], {"units": "s"}),
            }
            groups[group] = self.candidates.lay_out(name, "series", quantities).assign_coords(coords)
        return groups


def _naive_correlation(series: DriftSeries, field: FieldSeries) -> Array:
    """Plain correlation (columns,) of a series with the field without lag: what a map without any of the above would show."""
    regressors = series.sampling @ field.values
    regressors = regressors - regressors.mean(axis=0)
    values = series.values - series.values.mean()
    size = np.sqrt((regressors**2).sum(axis=0) * (values**2).sum())
    return (values @ regressors) / np.where(size > 0, size, 1.0)


def _session_verdict(result: AttributionResult, excitation: Excitation) -> int:
    if excitation.warm_up_only:
        return NOT_SEPARABLE
    passed = any((test.p_value <= LEVEL).any() for test in result.sets.values())
    return ATTRIBUTABLE if passed else NOT_ATTRIBUTABLE


def _describe_set(test: FamilyTest) -> dict[str, tuple[tuple[str, ...], Any, dict[str, str]]]:
    """Threshold per channel and false alarm rate of one set of candidates, as variables."""
    return {
        "threshold": (("channel",), test.threshold, _THRESHOLD),
        "false_alarm_rate": ((), test.false_alarm_rate, _RATE),
    }


def _describe_session(result: AttributionResult, excitation: Excitation) -> xr.Dataset:
    """What holds for the whole session: thresholds, noise and unexplained drift per channel, false alarm rates, verdict."""
    cells = result.sets["cells"]
    nulls = list(result.nulls) + [result.nulls[0]] * (len(cells.names) - len(result.nulls))
    per_channel: dict[str, tuple[Any, dict[str, str]]] = {
        "threshold": (cells.threshold, _THRESHOLD),
        "noise": ([null.sigma for null in nulls], {"units": "um", "long_name": "noise of one value of the channel"}),
        "unexplained_drift": (
            [null.drift_per_hour for null in nulls],
            {"units": "um", "long_name": "standard deviation over one hour of the drift that nothing explains"},
        ),
        "drift_order": (
            [float(null.order) for null in nulls],
            {"units": "1", "long_name": "0 none, 1 random walk, 2 integrated random walk"},
        ),
    }
    share = {"units": "1", "long_name": "share of the field's course that one warm-up explains"}
    session = _session_verdict(result, excitation)
    return xr.Dataset(
        {name: (("channel",), values, attrs) for name, (values, attrs) in per_channel.items()}
        | {
            "false_alarm_rate": ((), result.false_alarm_rate, _RATE),
            "cells_false_alarm_rate": ((), cells.false_alarm_rate, _RATE),
            "warm_up_share": ((), excitation.warm_up_share, share),
        },
        coords={"channel": list(cells.names)},
        attrs={
            "verdict": _FLAG_MEANINGS.split()[session].replace("_", " "),
            "excitation": excitation.name,
            "draws": result.draws,
        },
    )
