"""L4 - Which part of the temperature field drives the drift, tested so that two warming series do not pass for cause and effect.

Every plan cell is tested against the drift's channels (common, proportional to position, reversal; on request every target and
direction): the cell's temperature goes through a bank of first-order lags, the drift that the field does not explain is a random or
integrated random walk whose size is estimated anew under every hypothesis, and the statistic is the profile likelihood ratio. The
family-wise p value compares it with the maximum over all cells, lags and channels in series redrawn from the fitted null.

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

from fusion.attribution import LAGS_S, LEVEL, Film, Tested, evaluate_film
from fusion.channels import Array, ClockedReadings, DriftSeries, read_clock, reduce_channels, target_table
from fusion.excitation import Excitation, describe_excitation
from fusion.screening import screen

#: Verdict codes of the maps, in the order of the CF flag meanings.
NOT_ATTRIBUTABLE, ATTRIBUTABLE, NOT_SEPARABLE = 0, 1, 2
_FLAG_MEANINGS = "not_attributable attributable not_separable"
#: Cells with gaps in up to this share of the frames are filled by interpolation in time; others are left out.
_GAP_SHARE = 0.2


class CorrelationError(ValueError):
    """The field cannot be correlated with the drift; the message says what is missing."""


def correlate(
    fused_readings: xr.Dataset,
    field: xr.DataArray,
    *,
    lags_s: Sequence[float] = LAGS_S,
    draws: int = 499,
    checks: int = 199,
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
        Series redrawn from the fitted null, which set the threshold.
    checks : int
        Fresh nulls on which the rate of false alarms of this threshold is measured.
    per_target : bool
        Also screen every target and direction by itself (``target_*`` maps along ``series``), whitening fixed under the null.
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
        series,
        film,
        excitation,
        lags_s=lags_s,
        draws=draws,
        checks=checks,
        rng=np.random.default_rng(seed),
        progress=progress,
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


def describe(
    tested: Tested, series: Sequence[DriftSeries], film: Film, lags_s: Sequence[float], excitation: Excitation
) -> dict[str, tuple[Array, dict[str, Any]]]:
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


def describe_session(tested: Tested, excitation: Excitation) -> xr.Dataset:
    """What holds for the whole session: thresholds, noise and unexplained drift per channel, false alarms, verdict."""
    nulls = list(tested.banks) + [tested.banks[0]] * (len(tested.names) - len(tested.banks))
    per_channel: dict[str, tuple[list[float], dict[str, Any]]] = {
        "threshold": (tested.threshold.tolist(), {"units": "1", "long_name": "statistic at a family-wise p of 0.05"}),
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
    session = _session_verdict(tested.p_value, excitation)
    return xr.Dataset(
        {name: (("channel",), values, attrs) for name, (values, attrs) in per_channel.items()}
        | {
            "false_alarm_rate": (
                (),
                tested.false_alarm_rate,
                {"units": "1", "long_name": "share of fresh nulls flagged"},
            ),
            "warm_up_share": (
                (),
                excitation.warm_up_share,
                {"units": "1", "long_name": "share of the field's course that one warm-up explains"},
            ),
        },
        coords={"channel": list(tested.names)},
        attrs={
            "verdict": _FLAG_MEANINGS.split()[session].replace("_", " "),
            "excitation": excitation.name,
            "draws": tested.null_maxima.shape[0],
        },
    )


def _lay_out(
    tested: Tested,
    series: Sequence[DriftSeries],
    film: Film,
    seen: NDArray[np.bool_],
    field: xr.DataArray,
    lags_s: Sequence[float],
    excitation: Excitation,
) -> xr.Dataset:
    """The findings as maps; cells that were not tested are NaN, their verdict "not attributable"."""
    dataset = describe_session(tested, excitation).assign_coords(y=field["y"], x=field["x"])
    for name, (values, attrs) in describe(tested, series, film, lags_s, excitation).items():
        blank = np.zeros if values.dtype.kind == "i" else _nans
        whole = blank((values.shape[0], seen.size), dtype=values.dtype)
        whole[:, seen] = values if values.dtype.kind == "i" else np.where(np.isfinite(values), values, np.nan)
        dataset[name] = (("channel", "y", "x"), whole.reshape(-1, field.sizes["y"], field.sizes["x"]), attrs)
    return dataset


def _nans(shape: tuple[int, int], dtype: np.dtype[Any]) -> Array:
    return np.full(shape, np.nan, dtype=dtype)


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
    names, values, seconds, sampling = target_table(readings)
    found = screen(
        values,
        seconds,
        sampling,
        film,
        excitation,
        lags_s=lags_s,
        permutations=draws,
        rng=np.random.default_rng(seed + 1),
    )
    maps = {
        "statistic": (found.statistic, {"units": "1", "long_name": "likelihood ratio, whitening fixed under the null"}),
        "p_value": (found.p_value, {"units": "1", "long_name": "family-wise p value over all series"}),
        "sensitivity": (found.sensitivity, {"units": "um/K"}),
        "sensitivity_u": (found.sensitivity_u, {"units": "um/K"}),
        "lag": (np.asarray(lags_s, float)[found.lag_index], {"units": "s"}),
    }
    dataset = xr.Dataset(coords={"series": names, "y": field["y"], "x": field["x"]})
    for name, (columns, attrs) in maps.items():
        whole = np.full((len(names), seen.size), np.nan)
        whole[:, seen] = columns
        dataset[f"target_{name}"] = (("series", "y", "x"), whole.reshape(-1, *field.shape[1:]), attrs)
    return dataset
