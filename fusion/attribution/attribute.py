"""Which part of the temperature field drives the drift, tested so that two warming series do not pass for cause and effect.

Plan cells, localised thermal modes and regions are tested against the drift's channels (common, proportional to position, reversal; on
request every target and direction): each temperature goes through a bank of first-order lags, the drift that the field does not explain
is a random or integrated random walk whose size is estimated anew under every hypothesis, and the statistic is the profile likelihood
ratio. The family-wise p value compares it with the maxima over all cells, modes, regions, lags and channels in series redrawn from the
fitted null: one error probability for everything that can become a finding.

Two limits are built into the answer. A session that is one warm-up moves every series along one curve; it is tested beside free
exponentials and its best verdict is "not separable"; where a warm-up only dominates, the rest must carry the evidence. And a map
without a finding says how large an effect it would have found.

Source: Harris (2020), bioRxiv 2020.11.29.402719 (nonsense correlations).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.alignment.first_order_lag import respond
from fusion.attribution.drift_channels import DriftSeries, read_clock, reduce_channels, target_table
from fusion.attribution.family_wise import (
    CHECKS,
    LAGS_S,
    LEVEL,
    AttributionResult,
    FamilyTest,
    FieldSeries,
    evaluate_films,
)
from fusion.attribution.per_target import screen
from fusion.attribution.thermal_modes import Modes, Region, localise_modes, region_courses
from fusion.attribution.warm_up import Excitation, describe_excitation
from fusion.errors import FusionError

#: Verdict codes of the maps, in the order of the CF flag meanings.
NOT_ATTRIBUTABLE, ATTRIBUTABLE, NOT_SEPARABLE = 0, 1, 2
_FLAG_MEANINGS = "not_attributable attributable not_separable"
#: Values (channels or series, columns) and attributes with units, by name.
Quantities = dict[str, tuple[Array | NDArray[Any], dict[str, Any]]]
#: Thermal modes get a larger share of the error probability: few, quiet and each one place, they find what single cells miss, and cells
#: mostly draw the map around them. A quarter of the unit costs the cells 1 % of power and finds 3 % more sources (simulated).
FAVOUR = {"modes": 0.25}
_THRESHOLD = {"units": "1", "long_name": "statistic at a family-wise p of 0.05"}
_RATE = {"units": "1", "long_name": "share of fresh nulls flagged"}
#: Cells with gaps in up to this share of the frames are filled by interpolation in time; others are left out.
_GAP_SHARE = 0.2


class CorrelationError(FusionError):
    """The field cannot be correlated with the drift; the message says what is missing."""


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
        ``deviation`` (um) and ``time`` (UTC) with dims cycle, direction, target, and ``position`` (mm) per target.
    field : DataArray
        Temperature in degC or rise in K, dims time, y, x (mm), at least 12 frames; NaN where masked.
    regions : sequence of Region
        Parts of the plan whose mean temperature is tested as well, each with a name of its own.
    lags_s : sequence of float
        Time constants of the first-order response, s.
    draws : int
        Series redrawn from the fitted null, which set the threshold.
    checks : int
        Fresh nulls on which the rate of false alarms of this threshold is measured.
    per_target : bool
        Also screen every target and direction by itself, with its own family-wise error and the whitening fixed under the null.
    seed : int
        Seed of the redrawn series.
    progress : callable, optional
        Called with the finished share, 0..1.

    Returns
    -------
    DataTree
        Maps over channel, y, x: ``statistic``, ``p_value`` (family-wise), ``q_value`` (false discovery), ``sensitivity`` and
        ``sensitivity_u`` (um/K), ``lag`` (s), ``detectable_sensitivity`` (um/K found with 80 % power), ``verdict``, and
        ``naive_correlation`` for contrast only. Per channel ``threshold``, ``noise`` (um), ``unexplained_drift`` (um over one hour),
        ``drift_order``; scalars ``false_alarm_rate`` (of everything tested), ``cells_false_alarm_rate``, ``warm_up_share``; attribute
        ``verdict``. Group ``modes`` holds the same over channel and mode, with ``pattern`` (1 at the strongest cell, at ``at_x``,
        ``at_y``), ``threshold``, ``false_alarm_rate`` and ``p_beside``, the p value of what a mode adds to the leading one (NaN for that
        one itself, and where none passes); group ``regions`` the same over channel and region. With `per_target`, groups ``targets``
        with maps over series, y, x and ``target_regions`` over series and region.

    Raises
    ------
    CorrelationError, ChannelError, RegionError
        if no cell is seen, too few frames or cycles remain, or a region holds no seen cell.
    """
    if field.dims != ("time", "y", "x"):
        raise CorrelationError(f"field has dims {field.dims}; expected ('time', 'y', 'x')")
    readings = read_clock(fused_readings, field["time"].values.astype("datetime64[ns]"))
    film, seen = read_film(field, readings.frame_seconds)
    series = reduce_channels(readings)
    excitation = describe_excitation(film.seconds, film.values)
    modes = localise_modes(film.values)
    courses = {"modes": modes.courses, "regions": region_courses(film.values, seen, field, regions)}
    films = {"cells": film} | {name: FieldSeries(film.seconds, few) for name, few in courses.items() if few.shape[1]}
    found = evaluate_films(
        series,
        films,
        excitation,
        lags_s=lags_s,
        draws=draws,
        checks=checks,
        favour=FAVOUR,
        rng=np.random.default_rng(seed),
        progress=progress,
    )
    quantities = {
        name: describe(tested, series, films[name], lags_s, excitation) for name, tested in found.sets.items()
    }
    plan = {"y": field["y"], "x": field["x"]}
    cells = describe_session(found, excitation).assign_coords(plan)
    groups = {"/": cells.assign(_over_cells("channel", quantities["cells"], seen, field))}
    if "modes" in quantities:
        beside = _beside_leader(found.sets["modes"], series, films["modes"], excitation, lags_s, draws, seed)
        groups["modes"] = (
            _over_modes(quantities["modes"], modes, seen, field)
            .assign(_describe_set(found.sets["modes"]))
            .assign(p_beside=beside)
        )
    if "regions" in quantities:
        groups["regions"] = _over_regions("channel", quantities["regions"], regions).assign(
            _describe_set(found.sets["regions"])
        )
    if per_target:
        table = target_table(readings)
        single: dict[str, Quantities] = {
            name: _screen_targets(table, films[name], excitation, lags_s, draws, seed + 1)
            for name in ("cells", "regions")
            if name in films
        }
        groups["targets"] = xr.Dataset(_over_cells("series", single["cells"], seen, field), {"series": table[0]})
        if "regions" in single:
            few = _over_regions("series", single["regions"], regions)
            groups["target_regions"] = few.assign_coords(series=table[0])
    groups["/"].attrs["readings_outside_film"] = readings.outside_film
    return xr.DataTree.from_dict(groups)


def read_film(field: xr.DataArray, frame_seconds: Array) -> tuple[FieldSeries, NDArray[np.bool_]]:
    """Flatten a field (time, y, x) to the cells that are seen in nearly every frame; short gaps are interpolated in time."""
    values = field.values.reshape(field.sizes["time"], -1).astype(float)
    gaps = ~np.isfinite(values)
    seen = gaps.mean(axis=0) <= _GAP_SHARE
    if not seen.any():
        raise CorrelationError(
            "no plan cell is seen in at least 80 % of the frames; check the registration and the masks"
        )
    values, gaps = values[:, seen], gaps[:, seen]
    for column in np.flatnonzero(gaps.any(axis=0)):
        known = ~gaps[:, column]
        values[~known, column] = np.interp(frame_seconds[~known], frame_seconds[known], values[known, column])
    return FieldSeries(frame_seconds, values - values.mean(axis=0)), seen


def _beside_leader(
    tested: FamilyTest,
    series: Sequence[DriftSeries],
    modes: FieldSeries,
    excitation: Excitation,
    lags_s: Sequence[float],
    draws: int,
    seed: int,
) -> xr.DataArray:
    """Family-wise p (channel, mode) of what each mode adds to the leading one, which is taken as given at its lag.

    Modes that warm with the leading one go with the drift as it does, but add nothing to it.
    """
    count = modes.values.shape[1]
    p_value = np.full((len(tested.names), count), np.nan)
    ratio = tested.statistic / tested.threshold[:, None]
    channel, leader = np.unravel_index(int(np.where(tested.p_value <= LEVEL, ratio, -1.0).argmax()), ratio.shape)
    others = np.flatnonzero(np.arange(count) != leader)
    if tested.p_value[channel, leader] <= LEVEL and others.size and not excitation.warm_up_only:
        lag_s = lags_s[int(tested.lag_index[channel, leader])]
        given = respond(modes.values[:, [leader]], modes.seconds, time_constant_s=lag_s)
        again = evaluate_films(
            series,
            {"modes": FieldSeries(modes.seconds, modes.values[:, others])},
            excitation,
            lags_s=lags_s,
            draws=draws,
            checks=0,
            beside=[one.sampling @ given for one in series],
            rng=np.random.default_rng(seed + 2),
        )
        p_value[:, others] = again.sets["modes"].p_value
    attrs = {"units": "1", "long_name": "family-wise p value of what this mode adds to the leading one"}
    return xr.DataArray(p_value, dims=("channel", "mode"), attrs=attrs)


def _session_verdict(found: AttributionResult, excitation: Excitation) -> int:
    if excitation.warm_up_only:
        return NOT_SEPARABLE
    passed = any((tested.p_value <= LEVEL).any() for tested in found.sets.values())
    return ATTRIBUTABLE if passed else NOT_ATTRIBUTABLE


def _naive(series: DriftSeries, film: FieldSeries) -> Array:
    """Plain correlation (columns,) of a series with the unlagged film: what a map without any of the above would show."""
    seen = series.sampling @ film.values
    seen = seen - seen.mean(axis=0)
    values = series.values - series.values.mean()
    size = np.sqrt((seen**2).sum(axis=0) * (values**2).sum())
    return (values @ seen) / np.where(size > 0, size, 1.0)


def describe(
    tested: FamilyTest,
    series: Sequence[DriftSeries],
    film: FieldSeries,
    lags_s: Sequence[float],
    excitation: Excitation,
) -> Quantities:
    """What the test found per channel and column, by name: values (channels, columns) and attributes with units."""
    verdict = np.where(tested.p_value <= LEVEL, ATTRIBUTABLE, NOT_ATTRIBUTABLE)
    if excitation.warm_up_only:
        verdict = np.full_like(verdict, NOT_SEPARABLE)
    naive = [_naive(one, film) for one in series]
    naive += naive[:1] * (len(tested.names) - len(series))
    per_kelvin = {"units": "um/K"}
    return {
        "statistic": (tested.statistic, {"units": "1", "long_name": "profile likelihood ratio"}),
        "p_value": (tested.p_value, {"units": "1", "long_name": "family-wise p value"}),
        "q_value": (tested.q_value, {"units": "1", "long_name": "false-discovery rate"}),
        "sensitivity": (tested.coefficient, {**per_kelvin, "long_name": "drift per rise of this place"}),
        "sensitivity_u": (tested.coefficient_u, {**per_kelvin, "long_name": "standard uncertainty of the sensitivity"}),
        "detectable_sensitivity": (
            tested.detectable,
            {**per_kelvin, "long_name": "sensitivity found with 80 % power at this place"},
        ),
        "lag": (
            np.asarray(lags_s, float)[tested.lag_index],
            {"units": "s", "long_name": "time constant of the response"},
        ),
        "verdict": (
            verdict.astype(np.int8),
            {"flag_values": np.array([0, 1, 2], np.int8), "flag_meanings": _FLAG_MEANINGS},
        ),
        "naive_correlation": (
            np.stack(naive),
            {"units": "1", "long_name": "plain correlation, for contrast only: two trending series always correlate"},
        ),
    }


def _describe_set(tested: FamilyTest) -> dict[str, tuple[tuple[str, ...], Any, dict[str, str]]]:
    """Threshold per channel and rate of false alarms of one set of candidates, as variables."""
    return {
        "threshold": (("channel",), tested.threshold, _THRESHOLD),
        "false_alarm_rate": ((), tested.false_alarm_rate, _RATE),
    }


def describe_session(found: AttributionResult, excitation: Excitation) -> xr.Dataset:
    """What holds for the whole session: thresholds, noise and unexplained drift per channel, false alarms, verdict."""
    cells = found.sets["cells"]
    nulls = list(found.banks) + [found.banks[0]] * (len(cells.names) - len(found.banks))
    per_channel: dict[str, tuple[list[float], dict[str, Any]]] = {
        "threshold": (cells.threshold.tolist(), _THRESHOLD),
        "noise": ([bank.sigma for bank in nulls], {"units": "um", "long_name": "noise of one value of the channel"}),
        "unexplained_drift": (
            [bank.drift_per_hour for bank in nulls],
            {"units": "um", "long_name": "standard deviation over one hour of the drift that nothing explains"},
        ),
        "drift_order": (
            [float(bank.fitted.order) for bank in nulls],
            {"units": "1", "long_name": "0 none, 1 random walk, 2 integrated random walk"},
        ),
    }
    session = _session_verdict(found, excitation)
    return xr.Dataset(
        {name: (("channel",), values, attrs) for name, (values, attrs) in per_channel.items()}
        | {
            "false_alarm_rate": ((), found.false_alarm_rate, _RATE),
            "cells_false_alarm_rate": ((), cells.false_alarm_rate, _RATE),
            "warm_up_share": (
                (),
                excitation.warm_up_share,
                {"units": "1", "long_name": "share of the field's course that one warm-up explains"},
            ),
        },
        coords={"channel": list(cells.names)},
        attrs={
            "verdict": _FLAG_MEANINGS.split()[session].replace("_", " "),
            "excitation": excitation.name,
            "draws": found.draws,
        },
    )


def _over_cells(
    leading: str, quantities: Quantities, seen: NDArray[np.bool_], field: xr.DataArray
) -> dict[str, xr.DataArray]:
    """Quantities (leading, seen cells) as maps; cells that were not tested are NaN, flags there 0."""
    maps = {}
    for name, (values, attrs) in quantities.items():
        flags = values.dtype.kind == "i"
        whole = np.full((values.shape[0], seen.size), 0 if flags else np.nan, values.dtype)
        whole[:, seen] = values if flags else np.where(np.isfinite(values), values, np.nan)
        maps[name] = xr.DataArray(whole.reshape(-1, *field.shape[1:]), dims=(leading, "y", "x"), attrs=attrs)
    return maps


def _over_regions(leading: str, quantities: Quantities, regions: Sequence[Region]) -> xr.Dataset:
    """Quantities (leading, regions), with the places of the regions."""
    centre = np.array([region.centre_mm for region in regions]).reshape(-1, 2)
    return (
        _over_columns(leading, "region", quantities)
        .assign(at_x=(("region",), centre[:, 0], {"units": "mm"}), at_y=(("region",), centre[:, 1], {"units": "mm"}))
        .assign_coords(region=[region.name for region in regions])
    )


def _over_modes(quantities: Quantities, modes: Modes, seen: NDArray[np.bool_], field: xr.DataArray) -> xr.Dataset:
    """Quantities (channel, modes), with the modes' patterns and their strongest cells."""
    row, column = np.divmod(np.flatnonzero(seen)[modes.peaks], field.sizes["x"])
    pattern = _over_cells("mode", {"pattern": (modes.patterns, {"units": "1"})}, seen, field)["pattern"]
    return (
        _over_columns("channel", "mode", quantities)
        .assign(
            pattern=pattern,
            at_x=(("mode",), field["x"].values[column], {"units": "mm"}),
            at_y=(("mode",), field["y"].values[row], {"units": "mm"}),
        )
        .assign_coords(mode=np.arange(1, modes.peaks.size + 1))
    )


def _over_columns(leading: str, trailing: str, quantities: Quantities) -> xr.Dataset:
    return xr.Dataset(
        {
            name: (
                (leading, trailing),
                values if values.dtype.kind == "i" else np.where(np.isfinite(values), values, np.nan),
                attrs,
            )
            for name, (values, attrs) in quantities.items()
        }
    )


def _screen_targets(
    table: tuple[list[str], Array, Array, Array],
    film: FieldSeries,
    excitation: Excitation,
    lags_s: Sequence[float],
    draws: int,
    seed: int,
) -> Quantities:
    """Findings of every target and direction by itself, by name."""
    _, values, seconds, sampling = table
    rng = np.random.default_rng(seed)
    found = screen(values, seconds, sampling, film, excitation, lags_s=lags_s, permutations=draws, rng=rng)
    return {
        "statistic": (found.statistic, {"units": "1", "long_name": "likelihood ratio, whitening fixed under the null"}),
        "p_value": (found.p_value, {"units": "1", "long_name": "family-wise p value over all series"}),
        "sensitivity": (found.sensitivity, {"units": "um/K"}),
        "sensitivity_u": (found.sensitivity_u, {"units": "um/K"}),
        "lag": (np.asarray(lags_s, float)[found.lag_index], {"units": "s"}),
    }
