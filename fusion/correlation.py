"""L4 - Which part of the temperature field drives the drift, tested so that two warming series do not pass for cause and effect.

Every plan cell is tested against the drift's channels (common, proportional to position, reversal; on request every target and
direction): the cell's temperature goes through a bank of first-order lags, the drift that the field does not explain is a random or
integrated random walk whose size is estimated anew under every hypothesis, and the statistic is the profile likelihood ratio. The
family-wise p value compares it with the maximum over all cells, lags and channels in series redrawn from the fitted null.

Two limits are built into the answer. A session that is one warm-up moves every series along one curve; it is tested beside free
exponentials and its best verdict is "not separable". And a map without a finding says how large an effect it would have found.

Sources of the procedure: Harris (2020), bioRxiv 2020.11.29.402719 (nonsense correlations); Westfall and Young (1993),
*Resampling-based multiple testing*; Benjamini and Hochberg (1995), J. R. Stat. Soc. B 57, 289.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.attribution_kernel import (
    Array32,
    NullBank,
    estimate_effects,
    likelihood_ratios,
    null_bank,
    resample,
    tiles,
    whiten_series,
)
from fusion.channels import (
    Array,
    ClockedReadings,
    DriftSeries,
    lag_operators,
    read_clock,
    reduce_channels,
    target_series,
)
from fusion.excitation import Excitation, describe_excitation, warm_up_columns

#: Time constants of the first-order lags, s.
LAGS_S = (0.0, 600.0, 1200.0, 2400.0, 3600.0, 5400.0)
#: Family-wise level of the verdicts.
LEVEL = 0.05
#: Verdict codes of the maps, in the order of the CF flag meanings.
NOT_ATTRIBUTABLE, ATTRIBUTABLE, NOT_SEPARABLE = 0, 1, 2
_FLAG_MEANINGS = "not_attributable attributable not_separable"
#: Standard normal quantile of 0.8: an effect is found with 80 % power this many uncertainties above the threshold.
_POWER_80 = 0.8416
#: Bins of the pooled null distribution of one cell's statistic.
_BINS = np.concatenate([np.arange(0.0, 40.0, 0.1), [np.inf]])
#: Cells with gaps in up to this share of the frames are filled by interpolation in time; others are left out.
_GAP_SHARE = 0.2


class CorrelationError(ValueError):
    """The field cannot be correlated with the drift; the message says what is missing."""


@dataclass(frozen=True)
class Film:
    """Temperatures to test: columns over time.

    Attributes
    ----------
    seconds : (frames,) s since the first frame
    values : (frames, columns) temperature minus its mean over time, K
    """

    seconds: Array
    values: Array


@dataclass(frozen=True)
class Tested:
    """What the test of one film found; columns are cells, regions or modes.

    Attributes
    ----------
    names : (channels,) with "joint" (common and proportional together) last where both exist
    statistic, lag_index : (channels, columns) likelihood ratio and the lag that it was reached at
    p_value, q_value : (channels, columns) family-wise over everything tested, and false-discovery rate within the channel
    coefficient, coefficient_u, detectable : (channels, columns) um per K
    threshold : (channels,) of the statistic at the family-wise level
    null_maxima : (draws, channels) maximum statistic of every redrawn null
    false_alarm_rate : share of fresh nulls in which anything passed the threshold
    """

    names: tuple[str, ...]
    statistic: Array
    lag_index: NDArray[np.int64]
    p_value: Array
    q_value: Array
    coefficient: Array
    coefficient_u: Array
    detectable: Array
    threshold: Array
    null_maxima: Array
    false_alarm_rate: float
    banks: tuple[NullBank, ...]


def correlate(
    fused_readings: xr.Dataset,
    field: xr.DataArray,
    *,
    lags_s: Sequence[float] = LAGS_S,
    draws: int = 499,
    per_target: bool = False,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> xr.Dataset:
    """Test every plan cell as a source of the drift.

    Parameters
    ----------
    fused_readings : Dataset
        ``deviation`` (um) and ``time`` (UTC) with dims cycle, direction, target, and ``position`` (mm) per target.
    field : DataArray
        Temperature in degC or rise in K, dims time, y, x (mm), at least 12 frames; NaN where masked.
    lags_s : sequence of float
        Time constants of the first-order response, s.
    draws : int
        Series redrawn from the fitted null.
    per_target : bool
        Also test every target and direction by itself (16 times the work for 16 targets).
    seed : int
        Seed of the redrawn series.
    progress : callable, optional
        Called with the finished share, 0..1.

    Returns
    -------
    Dataset
        Maps over channel, y, x: ``statistic``, ``p_value`` (family-wise), ``q_value`` (false discovery), ``sensitivity`` and
        ``sensitivity_u`` (um/K), ``lag`` (s), ``detectable_sensitivity`` (um/K found with 80 % power), ``verdict``, and
        ``naive_correlation`` for contrast only; per channel ``threshold``, ``noise`` (um), ``unexplained_drift`` (um over one hour),
        ``drift_order``, ``verdict_channel``; scalars ``false_alarm_rate``, ``warm_up_share``; attribute ``verdict``.

    Raises
    ------
    CorrelationError, ChannelError
        if no cell is seen, or too few frames or cycles remain.
    """
    if field.dims != ("time", "y", "x"):
        raise CorrelationError(f"field has dims {field.dims}; expected ('time', 'y', 'x')")
    readings = read_clock(fused_readings, field["time"].values.astype("datetime64[ns]"))
    film, seen = read_film(field, readings.frame_seconds)
    series = reduce_channels(readings)
    excitation = describe_excitation(film.seconds, film.values)
    tested = evaluate_film(
        series, film, excitation, lags_s=lags_s, draws=draws, rng=np.random.default_rng(seed), progress=progress
    )
    dataset = _lay_out(tested, series, film, seen, field, lags_s, excitation)
    dataset.attrs["readings_outside_film"] = readings.outside_film
    if per_target:
        dataset = xr.merge(
            [dataset, _correlate_targets(readings, film, seen, field, excitation, lags_s, draws, seed)],
            combine_attrs="override",
        )
    return dataset


def read_film(field: xr.DataArray, frame_seconds: Array) -> tuple[Film, NDArray[np.bool_]]:
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
    return Film(frame_seconds, values - values.mean(axis=0)), seen


def evaluate_film(
    series: Sequence[DriftSeries],
    film: Film,
    excitation: Excitation,
    *,
    lags_s: Sequence[float] = LAGS_S,
    draws: int = 499,
    rng: np.random.Generator,
    progress: Callable[[float], None] | None = None,
) -> Tested:
    """Test all columns of a film as sources of all series, with one family-wise error over columns, lags and series.

    The first two series, where they are "common" and "proportional", are also tested together at the same lag.
    """
    operators = lag_operators(film.seconds, lags_s)
    responses = [np.stack([one.sampling @ operator for operator in operators]).astype(np.float32) for one in series]
    cells32 = film.values.astype(np.float32)
    banks = tuple(
        null_bank(one.values, one.seconds, one.variance, nuisance_columns(one.seconds, excitation)) for one in series
    )
    names = [one.name for one in series]
    joint = names[:2] == ["common", "proportional"]
    if joint:
        names.append("joint")
    stacks = _draw(series, banks, draws, rng)
    whitened = [whiten_series(bank, stack) for bank, stack in zip(banks, stacks, strict=True)]

    columns, lags = film.values.shape[1], len(lags_s)
    statistic = np.zeros((len(names), columns))
    lag_index = np.zeros((len(names), columns), int)
    maxima = np.zeros((len(names), whitened[0].series.shape[1] - 1))
    pooled = np.zeros((len(names), _BINS.size - 1))
    effects = np.zeros((3, len(names), columns))
    effects[1:] = np.inf
    for tile in tiles(columns * lags, lags):
        cells = slice(tile.start // lags, tile.stop // lags)
        ratios = []
        estimates = []
        for response, bank, white in zip(responses, banks, whitened, strict=True):
            regressors = _respond_tile(response, cells32[:, cells])
            ratios.append(likelihood_ratios(bank, white, regressors).reshape(-1, cells.stop - cells.start, lags))
            estimates.append(estimate_effects(bank, regressors))
        if joint:
            ratios.append(ratios[0] + ratios[1])
        for c, ratio in enumerate(ratios):
            best = ratio.max(axis=2)
            chosen = ratio[0].argmax(axis=1)
            statistic[c, cells] = best[0]
            lag_index[c, cells] = chosen
            maxima[c] = np.maximum(maxima[c], best[1:].max(axis=1))
            pooled[c] += np.histogram(best[1:], _BINS)[0]
            if c < len(series):
                pick = np.arange(best.shape[1]) * lags + chosen
                found = estimates[c]
                effects[:, c, cells] = found.coefficient[pick], found.coefficient_u[pick], found.null_u[pick]
            else:
                # The joint effect is that at the far end of travel: common plus proportional at +1.
                pick = np.arange(best.shape[1]) * lags + chosen
                effects[0, c, cells] = estimates[0].coefficient[pick] + estimates[1].coefficient[pick]
                for row, part in ((1, "coefficient_u"), (2, "null_u")):
                    effects[row, c, cells] = np.hypot(
                        getattr(estimates[0], part)[pick], getattr(estimates[1], part)[pick]
                    )
        if progress is not None:
            progress(tile.stop / (columns * lags))
    # Half of the redrawn nulls set the threshold, the other half, with their own drift size, measure what it lets through.
    calibration, check = maxima[:, :draws], maxima[:, draws:]
    p_value, threshold = _family_wise(statistic, calibration)
    return Tested(
        names=tuple(names),
        statistic=statistic,
        lag_index=lag_index,
        p_value=p_value,
        q_value=np.stack([_false_discovery(row, counts) for row, counts in zip(statistic, pooled, strict=True)]),
        coefficient=effects[0],
        coefficient_u=effects[1],
        detectable=(np.sqrt(threshold)[:, None] + _POWER_80) * effects[2],
        threshold=threshold,
        null_maxima=calibration.T,
        false_alarm_rate=float((check >= threshold[:, None]).any(axis=0).mean()),
        banks=banks,
    )


def nuisance_columns(seconds: Array, excitation: Excitation) -> Array:
    """Columns of every hypothesis: level and trend, and for a session that is one warm-up also free exponentials."""
    centred = (seconds - seconds.mean()) / max(float(np.ptp(seconds)), 1e-9)
    columns = np.column_stack([np.ones_like(seconds), centred])
    if not excitation.warm_up_only:
        return columns
    return np.column_stack([columns, warm_up_columns(seconds)])


def _draw(
    series: Sequence[DriftSeries], banks: Sequence[NullBank], draws: int, rng: np.random.Generator
) -> list[Array]:
    """The measured series, `draws` nulls with permuted residuals, and as many Gaussian nulls from refitted drifts, stacked."""
    longest = max(one.values.size for one in series)
    keys = rng.random((draws, longest))
    stacks = []
    for one, bank in zip(series, banks, strict=True):
        orders = np.argsort(keys[:, : one.values.size], axis=1)
        stacks.append(np.vstack([one.values, resample(bank, orders), resample(bank, orders, rng)]))
    return stacks


def _respond_tile(response: Array32, cells: Array32) -> Array32:
    """Regressors (n, cells * lags), lags innermost, of film cells (frames, cells) under responses (lags, n, frames)."""
    seen = np.tensordot(response, cells, axes=(2, 0))
    return np.ascontiguousarray(seen.transpose(1, 2, 0)).reshape(seen.shape[1], -1)


def _family_wise(statistic: Array, maxima: Array) -> tuple[Array, Array]:
    """Family-wise p (channels, columns) and thresholds (channels,): smallest p over channels against its own null."""
    channels, draws = maxima.shape
    ordered = np.sort(maxima, axis=1)

    def exceed(channel: int, values: Array) -> Array:
        return (draws - np.searchsorted(ordered[channel], values, side="left") + 1.0) / (draws + 1.0)

    smallest = np.sort(np.min([exceed(c, maxima[c]) for c in range(channels)], axis=0))
    single = np.stack([exceed(c, statistic[c]) for c in range(channels)])
    p_value = (np.searchsorted(smallest, single, side="right") + 1.0) / (draws + 1.0)
    # The largest single-channel p that is still significant after the step over channels sets each channel's threshold.
    admitted = smallest[max(int(np.floor(LEVEL * (draws + 1))) - 1, 0)]
    rank = np.clip(np.ceil((1.0 - admitted) * (draws + 1)).astype(int), 1, draws) - 1
    return np.minimum(p_value, 1.0), ordered[:, rank]


def _false_discovery(statistic: Array, counts: Array) -> Array:
    """Benjamini-Hochberg q values of one channel from the pooled null distribution of one cell's statistic."""
    above = np.cumsum(counts[::-1])[::-1]
    place = np.clip(np.searchsorted(_BINS, statistic, side="right") - 1, 0, counts.size - 1)
    p = (above[place] + 1.0) / (counts.sum() + 1.0)
    order = np.argsort(p)
    scaled = p[order] * p.size / np.arange(1, p.size + 1)
    q = np.empty_like(p)
    q[order] = np.minimum(np.minimum.accumulate(scaled[::-1])[::-1], 1.0)
    return q


def _session_verdict(p_value: Array, excitation: Excitation) -> int:
    if excitation.warm_up_only:
        return NOT_SEPARABLE
    return ATTRIBUTABLE if (p_value <= LEVEL).any() else NOT_ATTRIBUTABLE


def _naive(series: DriftSeries, film: Film) -> Array:
    """Plain correlation (columns,) of a series with the unlagged film: what a map without any of the above would show."""
    seen = series.sampling @ film.values
    seen = seen - seen.mean(axis=0)
    values = series.values - series.values.mean()
    size = np.sqrt((seen**2).sum(axis=0) * (values**2).sum())
    return (values @ seen) / np.where(size > 0, size, 1.0)


def _lay_out(
    tested: Tested,
    series: Sequence[DriftSeries],
    film: Film,
    seen: NDArray[np.bool_],
    field: xr.DataArray,
    lags_s: Sequence[float],
    excitation: Excitation,
) -> xr.Dataset:
    """The findings as maps with units."""
    shape = (len(tested.names), field.sizes["y"], field.sizes["x"])

    def spread(values: Array) -> Array:
        whole = np.full((values.shape[0], seen.size), np.nan)
        whole[:, seen] = np.where(np.isfinite(values), values, np.nan)
        return whole.reshape(values.shape[0], *shape[1:])

    dims = ("channel", "y", "x")
    verdict = np.where(tested.p_value <= LEVEL, ATTRIBUTABLE, NOT_ATTRIBUTABLE)
    if excitation.warm_up_only:
        verdict = np.full_like(verdict, NOT_SEPARABLE)
    session = _session_verdict(tested.p_value, excitation)
    naive = [_naive(one, film) for one in series]
    if len(tested.names) > len(series):
        naive.append(naive[0])
    lags = np.asarray(lags_s, float)[tested.lag_index]
    nulls = list(tested.banks) + [tested.banks[0]] * (len(tested.names) - len(series))
    per_kelvin = {"units": "um/K"}
    maps: dict[str, tuple[tuple[str, ...], Array, dict[str, Any]]] = {
        "statistic": (dims, spread(tested.statistic), {"units": "1", "long_name": "profile likelihood ratio"}),
        "p_value": (dims, spread(tested.p_value), {"units": "1", "long_name": "family-wise p value"}),
        "q_value": (dims, spread(tested.q_value), {"units": "1", "long_name": "false-discovery rate"}),
        "sensitivity": (dims, spread(tested.coefficient), {**per_kelvin, "long_name": "drift per rise of this cell"}),
        "sensitivity_u": (dims, spread(tested.coefficient_u), per_kelvin),
        "detectable_sensitivity": (
            dims,
            spread(tested.detectable),
            {**per_kelvin, "long_name": "sensitivity found with 80 % power at this place"},
        ),
        "lag": (dims, spread(lags), {"units": "s", "long_name": "time constant of the response"}),
        "verdict": (
            dims,
            np.nan_to_num(spread(verdict.astype(float))).astype(np.int8),
            {"flag_values": np.array([0, 1, 2], np.int8), "flag_meanings": _FLAG_MEANINGS},
        ),
        "naive_correlation": (
            dims,
            spread(np.stack(naive)),
            {"units": "1", "long_name": "plain correlation, for contrast only: two trending series always correlate"},
        ),
        "threshold": (("channel",), tested.threshold, {"units": "1", "long_name": "statistic at p = 0.05"}),
        "noise": (
            ("channel",),
            np.array([bank.sigma for bank in nulls]),
            {"units": "um", "long_name": "noise of one value of the channel"},
        ),
        "unexplained_drift": (
            ("channel",),
            np.array([bank.drift_per_hour for bank in nulls]),
            {"units": "um", "long_name": "drift over one hour that nothing explains"},
        ),
        "drift_order": (
            ("channel",),
            np.array([bank.fitted.order for bank in nulls]),
            {"long_name": "0 none, 1 random walk, 2 integrated random walk"},
        ),
        "false_alarm_rate": ((), np.array(tested.false_alarm_rate), {"units": "1"}),
        "warm_up_share": ((), np.array(excitation.warm_up_share), {"units": "1"}),
    }
    coords = {"channel": list(tested.names), "y": field["y"], "x": field["x"]}
    attrs = {
        "verdict": _FLAG_MEANINGS.split()[session].replace("_", " "),
        "excitation": "warm-up only" if excitation.warm_up_only else "varied",
        "draws": tested.null_maxima.shape[0],
    }
    return xr.Dataset(maps, coords=coords, attrs=attrs)


def _correlate_targets(
    readings: ClockedReadings,
    film: Film,
    seen: NDArray[np.bool_],
    field: xr.DataArray,
    excitation: Excitation,
    lags_s: Sequence[float],
    draws: int,
    seed: int,
) -> xr.Dataset:
    """Maps of every target and direction by itself, family-wise over all of them, named ``target_*`` along ``series``."""
    series = target_series(readings)
    tested = evaluate_film(series, film, excitation, lags_s=lags_s, draws=draws, rng=np.random.default_rng(seed + 1))
    maps = _lay_out(tested, series, film, seen, field, lags_s, excitation)
    kept = ["statistic", "p_value", "sensitivity", "sensitivity_u", "lag", "detectable_sensitivity", "verdict"]
    renamed = maps[kept].rename({"channel": "series"} | {name: f"target_{name}" for name in kept})
    renamed.attrs.clear()
    return renamed
