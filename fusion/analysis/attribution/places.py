"""Places of the drift in two tests of one machine: which of them repeat.

Within one test independent drifts can go with a temperature by chance. Two independent tests do so at the same place, with the same
sign and size, far more rarely. Repetition rules out chance, not a common cause: a load that warms the place and a part that no camera
sees does so in every test.

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

#: Places of the two tests count as the same within this distance: half the width of the halo of a heat source.
_SAME_PLACE_MM = 50.0
#: Quantities of a candidate, and their values where there is none.
_BLANK = {
    "statistic": -1.0, "p_value": 1.0, "sensitivity": 0.0, "sensitivity_u": np.inf, "sensitivity_low": -np.inf, "sensitivity_high": np.inf,
    "lag": 0.0,
}  # fmt: skip
#: Sensitivities disagree where they differ by more than this many standard uncertainties.
_DISAGREEMENT = 3.0


class ComparisonError(FusionError):
    """Campaigns that cannot be compared; the message says in what they differ."""


@dataclass(frozen=True)
class ChannelAgreement:
    """Where the two tests agree best on one part of the drift, and the verdict.

    Attributable where both tests pass at one place with one sign and one size: midway between the places of both tests, where the
    weaker of the two statistics is strongest. The p-value is the larger of the family-wise ones of both tests there.
    """

    channel: str
    verdict: str
    x_mm: float
    y_mm: float
    p_value: float
    sensitivity_um_per_K: tuple[float, float]
    lag_s: tuple[float, float]


@dataclass(frozen=True)
class SourceAgreement:
    """One source that either test shows, and what the first and the second test show near its place.

    ``shown_by`` holds 0 for the first test, 1 for the second. It is `separate` where it leads its test or adds to the leading source;
    otherwise it may only be collinear with it. ``power`` of a source that one test alone shows is the chance that the other one would
    have shown it, had it the same sensitivity there; ``agreed_near_mm`` place and distance of the nearest source on which both agree.
    """

    channel: str
    x_mm: float
    y_mm: float
    shown_by: tuple[int, ...]
    p_value: tuple[float, float]
    sensitivity_um_per_K: tuple[float, float]
    sensitivity_u_um_per_K: tuple[float, float]
    sensitivity_interval_um_per_K: tuple[tuple[float, float], tuple[float, float]]
    lag_s: tuple[float, float]
    agrees: bool
    separate: bool
    power: float | None = None
    agreed_near_mm: tuple[float, float, float] | None = None

    @property
    def repeats(self) -> bool:
        """Whether both tests agree on it, and it is distinguished from the other sources."""
        return self.agrees and self.separate


@dataclass(frozen=True)
class PlaceComparison:
    """Agreement of two tests of one machine: on every part of the drift that both have, and every source that either shows, once.

    ``p_value`` (channel, y, x) of the maps is the larger of both tests' smallest family-wise p-values within 50 mm; ``least_p`` the
    smallest p-values that the numbers of simulations of both tests can show.
    """

    maps: xr.Dataset
    channels: list[ChannelAgreement]
    sources: list[SourceAgreement]
    least_p: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class _Pair:
    """Strongest candidates within reach of every cell, (test, y, x) per quantity, of both tests, for one channel."""

    values: dict[str, Array]

    def at(self, quantity: str, row: int, column: int) -> tuple[float, float]:
        """One quantity of both tests at one place."""
        first, second = self.values[quantity][:, row, column].tolist()
        return first, second

    @property
    def p_value(self) -> Array:
        """Larger p-value of both tests, (y, x)."""
        return np.asarray(self.values["p_value"].max(axis=0))

    @property
    def agree(self) -> NDArray[np.bool_]:
        """Where both tests pass, and their candidates are one place with one sign, and sizes that agree within u, (y, x)."""
        size, u = self.values["sensitivity"], self.values["sensitivity_u"]
        apart = np.hypot(*(np.diff(self.values[axis], axis=0)[0] for axis in ("x", "y")))
        alike = (size.prod(axis=0) > 0) & (np.abs(size[0] - size[1]) <= _DISAGREEMENT * np.hypot(*u))
        return np.asarray((self.p_value <= ATTRIBUTION_LEVEL) & alike & (apart <= _SAME_PLACE_MM), bool)


def compare_places(first: xr.DataTree, second: xr.DataTree) -> PlaceComparison:
    """Compare the sources of the drift in two tests of one machine."""
    for name in ("x", "y"):
        if first.sizes[name] != second.sizes[name] or not np.allclose(first.coords[name], second.coords[name]):
            raise ComparisonError(
                f"the plan grids differ along {name}; give both campaigns the same [plan] size, cell_size and fiducials"
            )
    shared = [str(name) for name in first.coords["channel"].values if name in second.coords["channel"].values]
    if not shared:
        raise ComparisonError("the two campaigns share no drift channel; both need readings at several targets")
    reach = max(1, round(_SAME_PLACE_MM / float(np.median(np.diff(first.coords["x"].values)))))
    pairs = {}
    for channel in shared:
        seen = [_strongest_nearby(_candidates(test, channel), reach) for test in (first, second)]
        pairs[channel] = _Pair({name: np.stack([one[name] for one in seen]) for name in (*_BLANK, "x", "y")})
    separable = any(test.attrs["excitation"] != "warm-up only" for test in (first, second))
    plan = first.to_dataset()
    channels = [_conclude(channel, pair, separable) for channel, pair in pairs.items()]
    return PlaceComparison(
        maps=_maps(plan, pairs, separable),
        channels=channels,
        sources=_with_agreed_places(_list_sources((first, second), pairs), channels, plan, pairs),
        least_p=(1.0 / (int(first.attrs["draws"]) + 1), 1.0 / (int(second.attrs["draws"]) + 1)),
    )


def _with_agreed_places(
    listed: list[SourceAgreement], channels: list[ChannelAgreement], plan: xr.Dataset, pairs: dict[str, _Pair]
) -> list[SourceAgreement]:
    """The same sources and every other place on which the tests agree; those of one test with the nearest such place."""
    agreed = [
        _source_at(pairs, plan, found.channel, (found.x_mm, found.y_mm), (0, 1), False)
        for found in channels
        if found.verdict == "attributable" and not _agreed_at(listed, found.x_mm, found.y_mm)
    ]
    sources = [*listed, *agreed]
    return [one if one.agrees else replace(one, agreed_near_mm=_nearest(one, sources)) for one in sources]


def _list_sources(tests: tuple[xr.DataTree, xr.DataTree], pairs: dict[str, _Pair]) -> list[SourceAgreement]:
    """Every source that either test shows, once."""
    plan = tests[0].to_dataset()
    sources: list[SourceAgreement] = []
    for number, test in enumerate(tests):
        for channel, x_mm, y_mm, separate in _sources_of(test):
            if channel not in pairs or _agreed_at([one for one in sources if one.channel == channel], x_mm, y_mm):
                continue
            cell = _cell_of(plan, x_mm, y_mm)
            shown_by = (0, 1) if pairs[channel].agree[cell] else (number,)
            source = _source_at(pairs, plan, channel, (x_mm, y_mm), shown_by, separate)
            if not source.agrees:
                other = tests[1 - number].to_dataset().sel(channel=channel)
                source = replace(source, power=_power(source.sensitivity_um_per_K[number], other, cell))
            sources.append(source)
    return sources


def _cell_of(plan: xr.Dataset, x_mm: float, y_mm: float) -> tuple[int, int]:
    """Row and column of the cell of a place."""
    return int(np.argmin(np.abs(plan["y"].values - y_mm))), int(np.argmin(np.abs(plan["x"].values - x_mm)))


def _source_at(
    pairs: dict[str, _Pair], plan: xr.Dataset, channel: str, place_mm: tuple[float, float], shown_by: tuple[int, ...], separate: bool
) -> SourceAgreement:  # fmt: skip
    """A source with what both tests show at its cell."""
    pair, cell = pairs[channel], _cell_of(plan, *place_mm)
    low, high = pair.at("sensitivity_low", *cell), pair.at("sensitivity_high", *cell)
    return SourceAgreement(
        channel=channel,
        x_mm=place_mm[0],
        y_mm=place_mm[1],
        shown_by=shown_by,
        p_value=pair.at("p_value", *cell),
        sensitivity_um_per_K=pair.at("sensitivity", *cell),
        sensitivity_u_um_per_K=pair.at("sensitivity_u", *cell),
        sensitivity_interval_um_per_K=((low[0], high[0]), (low[1], high[1])),
        lag_s=pair.at("lag", *cell),
        agrees=len(shown_by) == 2,
        separate=separate,
    )


def _power(sensitivity: float, other: xr.Dataset, cell: tuple[int, int]) -> float | None:
    """Chance that a test detects a sensitivity (um/K) at a cell, from its detection limit there; None where nothing was tested."""
    root, limit = float(np.sqrt(other["threshold"])), float(other["detectable_sensitivity"].values[cell])
    if not (np.isfinite(limit) and limit > 0):
        return None
    u = limit / (root + float(special.ndtri(0.8)))
    return float(special.ndtr(abs(sensitivity) / u - root))


def _agreed_at(sources: Sequence[SourceAgreement], x_mm: float, y_mm: float) -> bool:
    """Whether one of these is a source at this place on which the tests agree."""
    return any(one.agrees and np.hypot(one.x_mm - x_mm, one.y_mm - y_mm) <= _SAME_PLACE_MM for one in sources)


def _nearest(one: SourceAgreement, sources: Sequence[SourceAgreement]) -> tuple[float, float, float] | None:
    """Place and distance of the nearest source of the same part of the drift on which both tests agree, mm."""
    near = [
        (other.x_mm, other.y_mm, float(np.hypot(other.x_mm - one.x_mm, other.y_mm - one.y_mm)))
        for other in sources
        if other.agrees and other.channel == one.channel
    ]
    return min(near, key=lambda place: place[2], default=None)


def _sources_of(test: xr.DataTree) -> list[tuple[str, float, float, bool]]:
    """Part of the drift, place (x, y in mm), and whether it is distinguished from the leading source, of every source of a test."""
    if test.attrs["verdict"] != "attributable":
        return []
    leading = find_source(test)
    if leading.kind != "mode":
        x_mm, y_mm = np.array([leading.x_mm, leading.y_mm], float).tolist()
        return [(leading.part, x_mm, y_mm, True)]
    order = ("channel", "mode")
    modes = test.children["modes"].to_dataset()
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
    """Larger p-value and verdict of both tests over channel, y, x."""
    dims = ("channel", "y", "x")
    p_value = np.stack([pair.p_value for pair in pairs.values()])
    agree = np.stack([pair.agree for pair in pairs.values()])
    verdict = np.where(agree, ATTRIBUTABLE, NOT_ATTRIBUTABLE) if separable else np.full(agree.shape, NOT_SEPARABLE)
    meaning = {"units": "1", "long_name": "larger of both tests' family-wise p values"}
    return xr.Dataset(
        {"p_value": (dims, p_value, meaning), "verdict": (dims, verdict.astype(np.int8), dict(plan["verdict"].attrs))},
        coords={"channel": list(pairs), "y": plan["y"], "x": plan["x"]},
    )


def _candidates(test: xr.DataTree, channel: str) -> dict[str, Array]:
    """Strongest candidate at every place, (y, x) per quantity: the cell itself, or the thermal mode that has its peak there."""
    cells = test.to_dataset().sel(channel=channel)
    # Maps that an older program made have no limits.
    unknown = xr.full_like(cells["statistic"], np.nan)
    strongest = {name: np.nan_to_num(cells.get(name, unknown).values, nan=blank) for name, blank in _BLANK.items()}
    strongest["statistic"] = strongest["statistic"] / float(cells["threshold"])
    modes = test.children["modes"].to_dataset().sel(channel=channel) if "modes" in test.children else xr.Dataset()
    for k in range(modes.sizes.get("mode", 0)):
        mode = modes.isel(mode=k)
        place = _cell_of(cells, float(mode["at_x"]), float(mode["at_y"]))
        ratio = float(mode["statistic"]) / float(mode["threshold"])
        if ratio > strongest["statistic"][place]:
            for name in _BLANK:
                strongest[name][place] = ratio if name == "statistic" else float(mode.get(name, _BLANK[name]))
    y, x = np.meshgrid(cells["y"].values, cells["x"].values, indexing="ij")
    return strongest | {"x": x, "y": y}


def _strongest_nearby(values: dict[str, Array], reach: int) -> dict[str, Array]:
    """Quantities of the strongest candidate within reach (cells) of every cell, its own place included, (y, x) each."""
    rows, columns = values["statistic"].shape
    best, at = values["statistic"], np.arange(rows * columns).reshape(rows, columns)
    padded, places = np.pad(best, reach, constant_values=-np.inf), np.pad(at, reach)
    for down in range(2 * reach + 1):
        for right in range(2 * reach + 1):
            if np.hypot(down - reach, right - reach) <= reach:
                seen = (slice(down, down + rows), slice(right, right + columns))
                stronger = padded[seen] > best
                best, at = np.where(stronger, padded[seen], best), np.where(stronger, places[seen], at)
    return {name: array.ravel()[at] for name, array in values.items()}


def _conclude(channel: str, pair: _Pair, separable: bool) -> ChannelAgreement:
    """Where the tests agree best on one channel, and the verdict."""
    weaker = pair.values["statistic"].min(axis=0)
    # A place where both agree goes before any other, however strong.
    row, column = map(int, np.unravel_index(np.where(pair.agree, weaker + 1e6, weaker).argmax(), weaker.shape))
    found = "attributable" if pair.agree.any() else "not attributable"
    return ChannelAgreement(
        channel=channel,
        verdict=found if separable else "not separable",
        x_mm=float(np.mean(pair.at("x", row, column))),
        y_mm=float(np.mean(pair.at("y", row, column))),
        p_value=float(pair.p_value[row, column]),
        sensitivity_um_per_K=pair.at("sensitivity", row, column),
        lag_s=pair.at("lag", row, column),
    )
