"""Compare two sessions of one machine: a source is called a cause only where both agree.

Within one session independent drifts can go with a temperature by chance. Two independent sessions do so at the same place, with the same
sign and size, far more rarely (a hundredth of the cases instead of a tenth; for two warm-ups nearly never).

Source: conjunction of two tests, Nichols et al. (2005), NeuroImage 25, 653 (the larger of both p-values); docs/method/attribution.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import special

from fusion.analysis.attribution.correlate import ATTRIBUTABLE, NOT_ATTRIBUTABLE, NOT_SEPARABLE, find_source
from fusion.analysis.levels import ATTRIBUTION_LEVEL
from fusion.common import Array, FusionError

#: Places of the two sessions count as the same within this distance: half the width of the halo of a heat source.
_SAME_PLACE_MM = 50.0
#: Quantities of a candidate, and their values where there is none.
_BLANK = {"statistic": -1.0, "p_value": 1.0, "sensitivity": 0.0, "sensitivity_u": np.inf, "lag": 0.0}
#: Sensitivities disagree where they differ by more than this many standard uncertainties.
_DISAGREEMENT = 3.0


class SessionComparisonError(FusionError):
    """Two campaigns that cannot be compared; the message says in what they differ."""


@dataclass(frozen=True)
class ChannelAgreement:
    """Where the two sessions agree best on one part of the drift, and the verdict with its reason in words.

    Attributable where both sessions pass at one place with one sign and one size: midway between the places of both sessions, where the
    weaker of the two statistics is strongest. The p-value is the larger of the family-wise ones of both sessions there.
    """

    channel: str
    verdict: str
    x_mm: float
    y_mm: float
    p_value: float
    sensitivity_um_per_K: tuple[float, float]
    lag_s: tuple[float, float]
    reason: str


@dataclass(frozen=True)
class SourceAgreement:
    """One source that either session shows, and what the first and the second session show near its place.

    ``shown_by`` holds 0 for the first session, 1 for the second. It is `separate` where it leads its session or adds to the leading source;
    otherwise it may only be collinear with it. ``power`` of a source that one session alone shows is the chance that the other one would
    have shown it, had it the same sensitivity there; ``agreed_near_mm`` place and distance of the nearest source on which both agree.
    """

    channel: str
    x_mm: float
    y_mm: float
    shown_by: tuple[int, ...]
    p_value: tuple[float, float]
    sensitivity_um_per_K: tuple[float, float]
    sensitivity_u_um_per_K: tuple[float, float]
    lag_s: tuple[float, float]
    agrees: bool
    separate: bool
    power: float | None = None
    agreed_near_mm: tuple[float, float, float] | None = None

    @property
    def cause(self) -> bool:
        """Whether both sessions agree on it, and it is distinguished from the other sources."""
        return self.agrees and self.separate


@dataclass(frozen=True)
class SessionComparison:
    """Agreement of two sessions of one machine: on every part of the drift that both have, and every source that either shows, once.

    ``p_value`` (channel, y, x) of the maps is the larger of both sessions' smallest family-wise p-values within 50 mm; ``least_p`` the
    smallest p-values that the numbers of simulations of both sessions can show.
    """

    maps: xr.Dataset
    channels: list[ChannelAgreement]
    sources: list[SourceAgreement]
    least_p: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class _Pair:
    """Strongest candidates within reach of every cell, (y, x) per quantity, of both sessions, for one channel."""

    first: dict[str, Array]
    second: dict[str, Array]

    def at(self, quantity: str, row: int, column: int) -> tuple[float, float]:
        """One quantity of both sessions at one place."""
        return float(self.first[quantity][row, column]), float(self.second[quantity][row, column])

    @property
    def p_value(self) -> Array:
        """Larger p-value of both sessions, (y, x)."""
        return np.maximum(self.first["p_value"], self.second["p_value"])

    @property
    def consistent(self) -> NDArray[np.bool_]:
        """Where the candidates of both sessions are one place with one sign, and sizes that agree within u, (y, x)."""
        a, b = self.first["sensitivity"], self.second["sensitivity"]
        u = np.hypot(self.first["sensitivity_u"], self.second["sensitivity_u"])
        apart = np.hypot(self.first["x"] - self.second["x"], self.first["y"] - self.second["y"])
        return np.asarray((a * b > 0) & (np.abs(a - b) <= _DISAGREEMENT * u) & (apart <= _SAME_PLACE_MM), bool)

    @property
    def agree(self) -> NDArray[np.bool_]:
        """Where both sessions pass and are consistent, (y, x)."""
        return np.asarray((self.p_value <= ATTRIBUTION_LEVEL) & self.consistent, bool)


def compare_sessions(first: xr.DataTree, second: xr.DataTree) -> SessionComparison:
    """Compare the sources of the drift in two sessions of one machine."""
    for name in ("x", "y"):
        if first.sizes[name] != second.sizes[name] or not np.allclose(first.coords[name], second.coords[name]):
            raise SessionComparisonError(
                f"the plan grids differ along {name}; give both campaigns the same [plan] size, cell_size and fiducials"
            )
    shared = [str(name) for name in first.coords["channel"].values if name in second.coords["channel"].values]
    if not shared:
        raise SessionComparisonError("the two campaigns share no drift channel; both need readings at several targets")
    reach = max(1, round(_SAME_PLACE_MM / float(np.median(np.diff(first.coords["x"].values)))))
    pairs = {
        channel: _Pair(*(_strongest_nearby(_candidates(session, channel), reach) for session in (first, second)))
        for channel in shared
    }
    separable = any(session.attrs["excitation"] != "warm-up only" for session in (first, second))
    plan = first.to_dataset()
    channels = [_conclude(channel, pair, separable) for channel, pair in pairs.items()]
    return SessionComparison(
        maps=_maps(plan, pairs, separable),
        channels=channels,
        sources=_with_agreed_places(_list_sources((first, second), pairs), channels, plan, pairs),
        least_p=(1.0 / (int(first.attrs["draws"]) + 1), 1.0 / (int(second.attrs["draws"]) + 1)),
    )


def _with_agreed_places(
    listed: list[SourceAgreement], channels: list[ChannelAgreement], plan: xr.Dataset, pairs: dict[str, _Pair]
) -> list[SourceAgreement]:
    """The same sources and every other place on which the sessions agree; those of one session with the nearest such place."""
    agreed = [
        _source_at(pairs, plan, found.channel, (found.x_mm, found.y_mm), (0, 1), False)
        for found in channels
        if found.verdict == "attributable" and not _agreed_at(listed, found.x_mm, found.y_mm)
    ]
    sources = [*listed, *agreed]
    return [one if one.agrees else replace(one, agreed_near_mm=_nearest(one, sources)) for one in sources]


def _list_sources(sessions: tuple[xr.DataTree, xr.DataTree], pairs: dict[str, _Pair]) -> list[SourceAgreement]:
    """Every source that either session shows, once."""
    plan = sessions[0].to_dataset()
    sources: list[SourceAgreement] = []
    for number, session in enumerate(sessions):
        for channel, x_mm, y_mm, separate in _sources_of(session):
            if channel not in pairs or _agreed_at([one for one in sources if one.channel == channel], x_mm, y_mm):
                continue
            cell = _cell_of(plan, x_mm, y_mm)
            shown_by = (0, 1) if pairs[channel].agree[cell] else (number,)
            source = _source_at(pairs, plan, channel, (x_mm, y_mm), shown_by, separate)
            if not source.agrees:
                other = sessions[1 - number].to_dataset().sel(channel=channel)
                source = replace(source, power=_power(source.sensitivity_um_per_K[number], other, cell))
            sources.append(source)
    return sources


def _cell_of(plan: xr.Dataset, x_mm: float, y_mm: float) -> tuple[int, int]:
    """Row and column of the cell of a place."""
    return int(np.argmin(np.abs(plan["y"].values - y_mm))), int(np.argmin(np.abs(plan["x"].values - x_mm)))


def _source_at(
    pairs: dict[str, _Pair], plan: xr.Dataset, channel: str, place_mm: tuple[float, float], shown_by: tuple[int, ...], separate: bool
) -> SourceAgreement:  # fmt: skip
    """A source with what both sessions show at its cell."""
    pair, cell = pairs[channel], _cell_of(plan, *place_mm)
    return SourceAgreement(
        channel=channel,
        x_mm=place_mm[0],
        y_mm=place_mm[1],
        shown_by=shown_by,
        p_value=pair.at("p_value", *cell),
        sensitivity_um_per_K=pair.at("sensitivity", *cell),
        sensitivity_u_um_per_K=pair.at("sensitivity_u", *cell),
        lag_s=pair.at("lag", *cell),
        agrees=len(shown_by) == 2,
        separate=separate,
    )


def _power(sensitivity: float, other: xr.Dataset, cell: tuple[int, int]) -> float | None:
    """Chance that a session detects a sensitivity (um/K) at a cell, from its detection limit there; None where nothing was tested."""
    root, limit = float(np.sqrt(other["threshold"])), float(other["detectable_sensitivity"].values[cell])
    if not (np.isfinite(limit) and limit > 0):
        return None
    u = limit / (root + float(special.ndtri(0.8)))
    return float(special.ndtr(abs(sensitivity) / u - root))


def _agreed_at(sources: Sequence[SourceAgreement], x_mm: float, y_mm: float) -> bool:
    """Whether one of these is a source at this place on which the sessions agree."""
    return any(one.agrees and np.hypot(one.x_mm - x_mm, one.y_mm - y_mm) <= _SAME_PLACE_MM for one in sources)


def _nearest(one: SourceAgreement, sources: Sequence[SourceAgreement]) -> tuple[float, float, float] | None:
    """Place and distance of the nearest source of the same part of the drift on which both sessions agree, mm."""
    near = [
        (other.x_mm, other.y_mm, float(np.hypot(other.x_mm - one.x_mm, other.y_mm - one.y_mm)))
        for other in sources
        if other.agrees and other.channel == one.channel
    ]
    return min(near, key=lambda place: place[2], default=None)


def _sources_of(session: xr.DataTree) -> list[tuple[str, float, float, bool]]:
    """Part of the drift, place (x, y in mm), and whether it is distinguished from the leading source, of every source of a session."""
    if session.attrs["verdict"] != "attributable":
        return []
    leading = find_source(session)
    if leading.kind != "mode":
        x_mm, y_mm = np.array([leading.x_mm, leading.y_mm], float).tolist()
        return [(leading.part, x_mm, y_mm, True)]
    order = ("channel", "mode")
    modes = session.children["modes"].to_dataset()
    ratio = (modes["statistic"] / modes["threshold"]).fillna(0.0).transpose(*order).values
    passed = modes["p_value"].transpose(*order).values <= ATTRIBUTION_LEVEL
    adds = modes["p_beside"].transpose(*order).fillna(0.0).values <= ATTRIBUTION_LEVEL
    sources = []
    for k in np.flatnonzero(passed.any(axis=0)):
        best = int(np.where(passed[:, k], ratio[:, k], -1.0).argmax())
        place = float(modes["at_x"][k]), float(modes["at_y"][k])
        sources.append((str(modes["channel"].values[best]), *place, bool(adds[best, k])))
    return sources


def _maps(plan: xr.Dataset, pairs: dict[str, _Pair], separable: bool) -> xr.Dataset:
    """Larger p-value and verdict of both sessions over channel, y, x."""
    dims = ("channel", "y", "x")
    p_value = np.stack([pair.p_value for pair in pairs.values()])
    agree = np.stack([pair.agree for pair in pairs.values()])
    verdict = np.where(agree, ATTRIBUTABLE, NOT_ATTRIBUTABLE) if separable else np.full(agree.shape, NOT_SEPARABLE)
    meaning = {"units": "1", "long_name": "larger of both sessions' family-wise p values"}
    return xr.Dataset(
        {"p_value": (dims, p_value, meaning), "verdict": (dims, verdict.astype(np.int8), dict(plan["verdict"].attrs))},
        coords={"channel": list(pairs), "y": plan["y"], "x": plan["x"]},
    )


def _candidates(session: xr.DataTree, channel: str) -> dict[str, Array]:
    """Strongest candidate at every place, (y, x) per quantity: the cell itself, or the thermal mode that has its peak there."""
    cells = session.to_dataset().sel(channel=channel)
    strongest = {name: np.nan_to_num(cells[name].values, nan=blank) for name, blank in _BLANK.items()}
    strongest["statistic"] = strongest["statistic"] / float(cells["threshold"])
    modes = session.children["modes"].to_dataset().sel(channel=channel) if "modes" in session.children else xr.Dataset()
    for k in range(modes.sizes.get("mode", 0)):
        mode = modes.isel(mode=k)
        place = _cell_of(cells, float(mode["at_x"]), float(mode["at_y"]))
        ratio = float(mode["statistic"]) / float(mode["threshold"])
        if ratio > strongest["statistic"][place]:
            for name in _BLANK:
                strongest[name][place] = ratio if name == "statistic" else float(mode[name])
    y, x = np.meshgrid(cells["y"].values, cells["x"].values, indexing="ij")
    return strongest | {"x": x, "y": y}


def _strongest_nearby(values: dict[str, Array], reach: int) -> dict[str, Array]:
    """Quantities of the strongest candidate within reach (cells) of every cell, its own place included, (y, x) each."""
    rows, columns = values["statistic"].shape
    padded = {name: np.pad(array, reach, constant_values=_BLANK.get(name, 0.0)) for name, array in values.items()}
    best = {name: array.copy() for name, array in values.items()}
    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            if np.hypot(down, right) > reach:
                continue
            part = (slice(reach + down, reach + down + rows), slice(reach + right, reach + right + columns))
            stronger = padded["statistic"][part] > best["statistic"]
            for name, array in padded.items():
                best[name] = np.where(stronger, array[part], best[name])
    return best


def _conclude(channel: str, pair: _Pair, separable: bool) -> ChannelAgreement:
    """Where the sessions agree best on one channel, and the verdict."""
    weaker = np.minimum(pair.first["statistic"], pair.second["statistic"])
    # A place where both agree goes before any other, however strong.
    place = np.unravel_index(int(np.where(pair.agree, weaker + 1e6, weaker).argmax()), weaker.shape)
    row, column = int(place[0]), int(place[1])
    p_value = float(pair.p_value[row, column])
    sensitivity = pair.at("sensitivity", row, column)
    if not separable:
        verdict, reason = "not separable", "both sessions are one warm-up each: switch the heat sources at random times"
    elif pair.agree.any():
        verdict, reason = "attributable", "both sessions find this place, with the same sign and size"
    elif p_value <= ATTRIBUTION_LEVEL:
        verdict = "not attributable"
        sizes = f"{sensitivity[0]:+.2f} and {sensitivity[1]:+.2f} µm/K"
        reason = f"both sessions find a source near here, but not with the same place and size: {sizes}"
    else:
        verdict, reason = "not attributable", "no place is found by both sessions"
    return ChannelAgreement(
        channel=channel,
        verdict=verdict,
        x_mm=float(np.mean(pair.at("x", row, column))),
        y_mm=float(np.mean(pair.at("y", row, column))),
        p_value=p_value,
        sensitivity_um_per_K=sensitivity,
        lag_s=pair.at("lag", row, column),
        reason=reason,
    )
