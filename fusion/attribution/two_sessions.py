"""Two campaigns of one machine: a source is called a cause only where both agree.

One session may be fooled by two series that happen to wander alike; two independent sessions are fooled at the same place, with the
same sign and size, far more rarely (a hundredth of the cases instead of a tenth; for two warm-ups nearly never).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.attribution.attribute import ATTRIBUTABLE, NOT_ATTRIBUTABLE, NOT_SEPARABLE
from fusion.attribution.family_wise import LEVEL
from fusion.attribution.leading_source import find_source
from fusion.errors import FusionError

Mask = NDArray[np.bool_]
#: Strongest candidates near every place, per session.
Places = list[dict[str, Array]]

#: Places of the two sessions count as the same within this distance: half the width of a heat source's halo.
SAME_PLACE_MM = 50.0
#: Quantities of a candidate, and what stands where there is none.
_BLANK = {"statistic": -1.0, "p_value": 1.0, "sensitivity": 0.0, "sensitivity_u": np.inf, "lag": 0.0}
#: Sensitivities disagree where they differ by more than this many standard uncertainties.
_DISAGREEMENT = 3.0


class ConjunctionError(FusionError):
    """Two campaigns cannot be compared; the message says in what they differ."""


@dataclass(frozen=True)
class Common:
    """Verdict on one channel from both sessions.

    Attributes
    ----------
    verdict : "attributable", "not attributable" or "not separable"
    x_mm, y_mm : where the weaker of the two statistics is strongest, midway between both sessions' places
    p_value : the larger of both sessions' family-wise p there (a conjunction needs both)
    sensitivity_um_per_K : of both sessions
    reason : why, in words
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
    """One source that either session shows, and what the other one shows there.

    Attributes
    ----------
    channel : part of the drift that it goes with
    x_mm, y_mm : place in the session that shows it
    shown_by : 0 first session, 1 second, or both
    p_value, sensitivity_um_per_K, sensitivity_u_um_per_K, lag_s : of the first and the second session near that place
    agrees : both sessions pass there, with one sign and one size
    separate : it leads its session, or adds to what leads there; otherwise it may only warm with the leading source
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

    @property
    def cause(self) -> bool:
        """Whether both sessions agree on it, and it is told from the other sources."""
        return self.agrees and self.separate


def compare_sources(first: xr.DataTree, second: xr.DataTree) -> list[SourceAgreement]:
    """Return every source that passes in either of two sessions, once, and whether the other session agrees.

    A session's sources are its thermal modes that pass, each with the part of the drift that it goes with most; where none passes, its
    leading cell. Sessions that are one warm-up show none.

    Raises
    ------
    ConjunctionError
        if the grids differ.
    """
    _refuse_other_grids(first, second)
    reach = _reach(first)
    near = {
        channel: [_strongest_nearby(_candidates(one, channel), reach) for one in (first, second)]
        for channel in _shared_channels(first, second)
    }
    found: list[SourceAgreement] = []
    for at, session in enumerate((first, second)):
        for channel, x_mm, y_mm, separate in _passing(session):
            if channel not in near or _already(found, channel, x_mm, y_mm):
                continue
            row = int(np.argmin(np.abs(first.coords["y"].values - y_mm)))
            column = int(np.argmin(np.abs(first.coords["x"].values - x_mm)))
            places = near[channel]
            p_value = _at(places, "p_value", row, column)
            agrees = max(p_value) <= LEVEL and bool(_consistent(*places)[row, column])
            found.append(
                SourceAgreement(
                    channel=channel,
                    x_mm=x_mm,
                    y_mm=y_mm,
                    shown_by=(0, 1) if agrees else (at,),
                    p_value=p_value,
                    sensitivity_um_per_K=_at(places, "sensitivity", row, column),
                    sensitivity_u_um_per_K=_at(places, "sensitivity_u", row, column),
                    lag_s=_at(places, "lag", row, column),
                    agrees=agrees,
                    separate=separate,
                )
            )
    return found


def _at(places: Places, name: str, row: int, column: int) -> tuple[float, float]:
    """One quantity of both sessions at one place."""
    return float(places[0][name][row, column]), float(places[1][name][row, column])


def _passing(session: xr.DataTree) -> list[tuple[str, float, float, bool]]:
    """Part of the drift, place (x, y in mm), and whether it is told from the leading one, of every source that a session shows."""
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


def _already(found: list[SourceAgreement], channel: str, x_mm: float, y_mm: float) -> bool:
    """Whether a source at this place is listed as one on which both sessions agree."""
    return any(
        one.agrees and one.channel == channel and np.hypot(one.x_mm - x_mm, one.y_mm - y_mm) <= SAME_PLACE_MM
        for one in found
    )


def _refuse_other_grids(first: xr.DataTree, second: xr.DataTree) -> None:
    for name in ("x", "y"):
        if first.sizes[name] != second.sizes[name] or not np.allclose(first.coords[name], second.coords[name]):
            raise ConjunctionError(
                f"the plan grids differ along {name}; give both campaigns the same [plan] size, cell_size and fiducials"
            )


def _shared_channels(first: xr.DataTree, second: xr.DataTree) -> list[str]:
    channels = [str(name) for name in first.coords["channel"].values if name in second.coords["channel"].values]
    if not channels:
        raise ConjunctionError("the two campaigns share no drift channel; both need readings at several targets")
    return channels


def _reach(session: xr.DataTree) -> int:
    """Cells within which places count as the same."""
    return max(1, round(SAME_PLACE_MM / float(np.median(np.diff(session.coords["x"].values)))))


def agree(first: xr.DataTree, second: xr.DataTree) -> tuple[xr.Dataset, list[Common]]:
    """Join the maps of two campaigns.

    Parameters
    ----------
    first, second : Datasets of :func:`fusion.attribution.attribute.correlate` on the same plan grid, from tests of the same machine.

    Returns
    -------
    Dataset
        ``p_value`` (channel, y, x): larger of both sessions' smallest family-wise p within 50 mm; ``verdict`` as in the single maps.
    list of Common
        One verdict per channel.

    Raises
    ------
    ConjunctionError
        if the grids differ or no channel is common.
    """
    _refuse_other_grids(first, second)
    channels = _shared_channels(first, second)
    reach = _reach(first)
    separable = any(one.attrs["excitation"] != "warm-up only" for one in (first, second))
    maps, verdicts, found = [], [], []
    for channel in channels:
        places = [_strongest_nearby(_candidates(one, channel), reach) for one in (first, second)]
        joint_p = np.maximum(places[0]["p_value"], places[1]["p_value"])
        verdict = np.where((joint_p <= LEVEL) & _consistent(*places), ATTRIBUTABLE, NOT_ATTRIBUTABLE)
        maps.append(joint_p)
        verdicts.append(verdict if separable else np.full_like(verdict, NOT_SEPARABLE))
        found.append(_conclude(channel, places, separable))
    dims = ("channel", "y", "x")
    joined = xr.Dataset(
        {
            "p_value": (
                dims,
                np.stack(maps),
                {"units": "1", "long_name": "larger of both sessions' family-wise p values"},
            ),
            "verdict": (dims, np.stack(verdicts).astype(np.int8), dict(first.to_dataset()["verdict"].attrs)),
        },
        coords={"channel": channels, "y": first.coords["y"], "x": first.coords["x"]},
    )
    return joined, found


def _candidates(session: xr.DataTree, channel: str) -> dict[str, Array]:
    """Strongest candidate at every place, (y, x) each: the cell itself, or the thermal mode that has its height there.

    The statistic is divided by its threshold, so that cells and modes compare.
    """
    chosen = session.to_dataset().sel(channel=channel)
    strongest = {name: np.nan_to_num(chosen[name].values, nan=none) for name, none in _BLANK.items()}
    strongest["statistic"] = strongest["statistic"] / float(chosen["threshold"])
    modes = session.children["modes"].to_dataset().sel(channel=channel) if "modes" in session.children else xr.Dataset()
    for k in range(modes.sizes.get("mode", 0)):
        mode = modes.isel(mode=k)
        place = (int(np.argmin(np.abs(chosen["y"].values - float(mode["at_y"])))),
                 int(np.argmin(np.abs(chosen["x"].values - float(mode["at_x"])))))  # fmt: skip
        ratio = float(mode["statistic"]) / float(mode["threshold"])
        if ratio > strongest["statistic"][place]:
            for name in _BLANK:
                strongest[name][place] = ratio if name == "statistic" else float(mode[name])
    y, x = np.meshgrid(chosen["y"].values, chosen["x"].values, indexing="ij")
    return strongest | {"x": x, "y": y}


def _strongest_nearby(values: dict[str, Array], reach: int) -> dict[str, Array]:
    """Quantities of the strongest place within reach (cells) of every cell, its own place included, (y, x) each."""
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


def _consistent(first: dict[str, Array], second: dict[str, Array]) -> Mask:
    """Where both sessions' strongest places nearby are one place, with sensitivities of one sign that agree within u, (y, x)."""
    a, b = first["sensitivity"], second["sensitivity"]
    u = np.hypot(first["sensitivity_u"], second["sensitivity_u"])
    apart = np.hypot(first["x"] - second["x"], first["y"] - second["y"])
    return np.asarray((a * b > 0) & (np.abs(a - b) <= _DISAGREEMENT * u) & (apart <= SAME_PLACE_MM), bool)


def _conclude(
    channel: str,
    places: Places,
    separable: bool,
) -> Common:
    """Verdict on one channel from the strongest places (per session) near every cell."""
    joint_p = np.maximum(places[0]["p_value"], places[1]["p_value"])
    consistent = _consistent(*places)
    weaker = np.minimum(*[one["statistic"] for one in places])
    candidates = (joint_p <= LEVEL) & consistent
    row, column = np.unravel_index(int(np.where(candidates, weaker + 1e6, weaker).argmax()), weaker.shape)
    p_value = float(joint_p[row, column])
    sensitivity = (float(places[0]["sensitivity"][row, column]), float(places[1]["sensitivity"][row, column]))
    if not separable:
        verdict, reason = "not separable", "both sessions are one warm-up each: switch the heat sources at random times"
    elif candidates.any():
        verdict, reason = "attributable", "both sessions find this place, with one sign and one size"
    elif p_value <= LEVEL:
        verdict = "not attributable"
        sizes = f"{sensitivity[0]:+.2f} and {sensitivity[1]:+.2f} um/K"
        reason = f"both sessions find something near here, but not at one place with one size: {sizes}"
    else:
        verdict, reason = "not attributable", "no place is found by both sessions"
    return Common(
        channel=channel,
        verdict=verdict,
        x_mm=float(np.mean([one["x"][row, column] for one in places])),
        y_mm=float(np.mean([one["y"][row, column] for one in places])),
        p_value=p_value,
        sensitivity_um_per_K=sensitivity,
        lag_s=(float(places[0]["lag"][row, column]), float(places[1]["lag"][row, column])),
        reason=reason,
    )
