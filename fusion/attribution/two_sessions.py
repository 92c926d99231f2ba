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

from fusion._typing import Array
from fusion.attribution.attribute import ATTRIBUTABLE, NOT_ATTRIBUTABLE, NOT_SEPARABLE
from fusion.attribution.family_wise import LEVEL
from fusion.attribution.leading_source import find_source
from fusion.errors import FusionError

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
    """Where the two sessions agree best on one part of the drift.

    Attributes
    ----------
    channel : str
        Part of the drift.
    verdict : {"attributable", "not attributable", "not separable"}
        Attributable where both sessions pass at one place with one sign and one size.
    x_mm, y_mm : float, mm
        Where the weaker of the two statistics is strongest, midway between the places of both sessions.
    p_value : float
        Larger of the family-wise p-values of both sessions there.
    sensitivity_um_per_K : (float, float), um/K
        Of both sessions.
    lag_s : (float, float), s
        Of both sessions.
    reason : str
        The verdict in words.
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
    """One source that either session shows, and what the other session shows there.

    Attributes
    ----------
    channel : str
        Part of the drift that the source drives.
    x_mm, y_mm : float, mm
        Place in the session that shows it.
    shown_by : tuple of int
        0 for the first session, 1 for the second, or both.
    p_value : (float, float)
        Family-wise p-values of the first and the second session near that place.
    sensitivity_um_per_K, sensitivity_u_um_per_K : (float, float), um/K
        Sensitivities of both sessions and their standard uncertainties.
    lag_s : (float, float), s
        Time constants of both sessions.
    agrees : bool
        Whether both sessions pass there, with one sign and one size.
    separate : bool
        Whether it leads its session, or adds to the leading source; otherwise it may only be collinear with it.
    power : float or None
        Of a source that one session alone shows: chance that the other one would have shown it, had it the same sensitivity there.
    agreed_near_mm : (float, float, float) or None
        Of a source on which the sessions do not agree: place (x, y) of the nearest one on which they do, and its distance; None where
        they agree on none.
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
        """Whether both sessions agree on it, and it is told from the other sources."""
        return self.agrees and self.separate


@dataclass(frozen=True)
class SessionComparison:
    """Agreement of two sessions of one machine.

    Attributes
    ----------
    maps : Dataset
        ``p_value`` (channel, y, x): larger of both sessions' smallest family-wise p-values within 50 mm; ``verdict`` as in the maps of one
        session.
    channels : list of ChannelAgreement
        Best agreement on every part of the drift that both sessions have.
    sources : list of SourceAgreement
        Every source that either session shows, once, and places on which both agree without one.
    least_p : (float, float)
        Smallest p-values that the numbers of simulations of both sessions can show.
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
        return np.asarray((self.p_value <= LEVEL) & self.consistent, bool)


def compare_sessions(first: xr.DataTree, second: xr.DataTree) -> SessionComparison:
    """Compare the sources of the drift in two sessions of one machine.

    Parameters
    ----------
    first, second : DataTree
        Results of `fusion.attribution.attribute.correlate` on the same plan grid.

    Returns
    -------
    SessionComparison
        The sources of a session are its thermal modes that pass, each with the part of the drift that it goes with most; where none
        passes, its leading cell. A session that is one warm-up shows none, and two such sessions are not separable.

    Raises
    ------
    SessionComparisonError
        If the grids differ or no channel is common.
    """
    _check_grids(first, second)
    reach = max(1, round(_SAME_PLACE_MM / float(np.median(np.diff(first.coords["x"].values)))))
    pairs = {
        channel: _Pair(*(_strongest_nearby(_candidates(session, channel), reach) for session in (first, second)))
        for channel in _shared_channels(first, second)
    }
    separable = any(session.attrs["excitation"] != "warm-up only" for session in (first, second))
    channels = [_conclude(channel, pair, separable) for channel, pair in pairs.items()]
    return SessionComparison(
        maps=_maps(first.to_dataset(), pairs, separable),
        channels=channels,
        sources=_tell_apart(_list_sources(first, second, pairs), channels, first.to_dataset(), pairs),
        least_p=(_least_p(first), _least_p(second)),
    )


def _least_p(session: xr.DataTree) -> float:
    """Smallest p-value that the number of simulations of a session can show."""
    return 1.0 / (int(session.attrs["draws"]) + 1)


def _list_sources(first: xr.DataTree, second: xr.DataTree, pairs: dict[str, _Pair]) -> list[SourceAgreement]:
    """Every source that either session shows, once."""
    plan = first.to_dataset()
    sources: list[SourceAgreement] = []
    for number, session in enumerate((first, second)):
        for channel, x_mm, y_mm, separate in _sources_of(session):
            if channel not in pairs or _listed(sources, channel, x_mm, y_mm):
                continue
            place = _cell_of(plan, x_mm, y_mm)
            agrees = bool(pairs[channel].agree[place])
            shown_by = (0, 1) if agrees else (number,)
            source = _source_at(pairs[channel], channel, (x_mm, y_mm), place, shown_by, separate)
            if not agrees:
                other = (second, first)[number].to_dataset().sel(channel=channel)
                source = replace(source, power=_power(source.sensitivity_um_per_K[number], other, place))
            sources.append(source)
    return sources


def _cell_of(plan: xr.Dataset, x_mm: float, y_mm: float) -> tuple[int, int]:
    """Row and column of the cell of a place."""
    return int(np.argmin(np.abs(plan["y"].values - y_mm))), int(np.argmin(np.abs(plan["x"].values - x_mm)))


def _source_at(
    pair: _Pair,
    channel: str,
    place_mm: tuple[float, float],
    cell: tuple[int, int],
    shown_by: tuple[int, ...],
    separate: bool,
) -> SourceAgreement:
    """A source with what both sessions show at its cell (row, column)."""
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
    """Chance that a session detects a sensitivity (um/K) at a cell, from its detection limit there; None where nothing was tested.

    The limit is the sensitivity that is detected with 80 % power: the root of the threshold and the quantile of 0.8, in standard
    uncertainties.
    """
    root, limit = float(np.sqrt(other["threshold"])), float(other["detectable_sensitivity"].values[cell])
    if not (np.isfinite(limit) and limit > 0):
        return None
    u = limit / (root + float(special.ndtri(0.8)))
    return float(special.ndtr(abs(sensitivity) / u - root))


def _tell_apart(
    sources: list[SourceAgreement], channels: list[ChannelAgreement], plan: xr.Dataset, pairs: dict[str, _Pair]
) -> list[SourceAgreement]:
    """The same sources and every place on which the sessions agree beside them; those of one session with the nearest agreed place.

    A place on which both agree, and which is no source of its own in either session, may lie on the halo of one.
    """
    agreed = [
        _source_at(
            pairs[found.channel],
            found.channel,
            (found.x_mm, found.y_mm),
            _cell_of(plan, found.x_mm, found.y_mm),
            (0, 1),
            False,
        )
        for found in channels
        if found.verdict == "attributable" and not _known_place(sources, found)
    ]
    every = [*sources, *agreed]
    return [one if one.agrees else replace(one, agreed_near_mm=_nearest(one, every)) for one in every]


def _known_place(sources: Sequence[SourceAgreement], found: ChannelAgreement) -> bool:
    """Whether the sessions agree on a source at this place, be it in another part of the drift."""
    return any(
        source.agrees and np.hypot(source.x_mm - found.x_mm, source.y_mm - found.y_mm) <= _SAME_PLACE_MM
        for source in sources
    )


def _nearest(one: SourceAgreement, sources: Sequence[SourceAgreement]) -> tuple[float, float, float] | None:
    """Place and distance of the nearest source of the same part of the drift on which both sessions agree, mm."""
    near = [
        (other.x_mm, other.y_mm, float(np.hypot(other.x_mm - one.x_mm, other.y_mm - one.y_mm)))
        for other in sources
        if other.agrees and other.channel == one.channel
    ]
    return min(near, key=lambda place: place[2], default=None)


def _sources_of(session: xr.DataTree) -> list[tuple[str, float, float, bool]]:
    """Part of the drift, place (x, y in mm), and whether it is told from the leading source, of every source of a session."""
    if session.attrs["verdict"] != "attributable":
        return []
    leading = find_source(session)
    if leading.kind != "mode":
        return [(leading.channel, leading.x_mm, leading.y_mm, True)]
    order = ("channel", "mode")
    modes = session.children["modes"].to_dataset()
    ratio = (modes["statistic"] / modes["threshold"]).fillna(0.0).transpose(*order).values
    passed = modes["p_value"].transpose(*order).values <= LEVEL
    adds = modes["p_beside"].transpose(*order).fillna(0.0).values <= LEVEL
    sources = []
    for k in np.flatnonzero(passed.any(axis=0)):
        best = int(np.where(passed[:, k], ratio[:, k], -1.0).argmax())
        place = float(modes["at_x"][k]), float(modes["at_y"][k])
        sources.append((str(modes["channel"].values[best]), *place, bool(adds[best, k])))
    return sources


def _listed(sources: list[SourceAgreement], channel: str, x_mm: float, y_mm: float) -> bool:
    """Whether a source at this place is listed as one on which both sessions agree."""
    return any(
        source.agrees
        and source.channel == channel
        and np.hypot(source.x_mm - x_mm, source.y_mm - y_mm) <= _SAME_PLACE_MM
        for source in sources
    )


def _check_grids(first: xr.DataTree, second: xr.DataTree) -> None:
    for name in ("x", "y"):
        if first.sizes[name] != second.sizes[name] or not np.allclose(first.coords[name], second.coords[name]):
            raise SessionComparisonError(
                f"the plan grids differ along {name}; give both campaigns the same [plan] size, cell_size and fiducials"
            )


def _shared_channels(first: xr.DataTree, second: xr.DataTree) -> list[str]:
    channels = [str(name) for name in first.coords["channel"].values if name in second.coords["channel"].values]
    if not channels:
        raise SessionComparisonError("the two campaigns share no drift channel; both need readings at several targets")
    return channels


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
    """Strongest candidate at every place, (y, x) per quantity: the cell itself, or the thermal mode that has its peak there.

    The statistic is divided by its threshold, so that cells and modes compare.
    """
    cells = session.to_dataset().sel(channel=channel)
    strongest = {name: np.nan_to_num(cells[name].values, nan=blank) for name, blank in _BLANK.items()}
    strongest["statistic"] = strongest["statistic"] / float(cells["threshold"])
    modes = session.children["modes"].to_dataset().sel(channel=channel) if "modes" in session.children else xr.Dataset()
    for k in range(modes.sizes.get("mode", 0)):
        mode = modes.isel(mode=k)
        place = (
            int(np.argmin(np.abs(cells["y"].values - float(mode["at_y"])))),
            int(np.argmin(np.abs(cells["x"].values - float(mode["at_x"])))),
        )
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
        verdict, reason = "attributable", "both sessions find this place, with one sign and one size"
    elif p_value <= LEVEL:
        verdict = "not attributable"
        sizes = f"{sensitivity[0]:+.2f} and {sensitivity[1]:+.2f} µm/K"
        reason = f"both sessions find something near here, but not at one place with one size: {sizes}"
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
