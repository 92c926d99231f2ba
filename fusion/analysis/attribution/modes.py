"""Group the cells of the field: regions, localised thermal modes, and clusters of collinear cells.

Regions and modes are fewer candidates for a source of the drift than single cells, with less noise. The temperature of a region is the mean
of its cells. Thermal modes are the leading spatial patterns of the field, rotated until each is concentrated in one place (varimax), so
that a mode usually is one heat source with its halo; this finds weak and lagged sources where single cells do not.

Cells of one cluster have collinear temperatures: whatever the drift does, these data cannot tell them apart. The condition number of the
leading thermal modes says how many sources the session can separate at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from skimage.measure import points_in_poly

from fusion.common import Array, FusionError
from thermography.registration.plan import read_lines

# Measure how much of the field's temporal variation is one warm-up, which no analysis can separate into its sources.

#: Time constants of the exponentials that the warm-up of a machine can be made of, s.
_WARM_UP_CONSTANTS_S = (600.0, 1500.0, 3600.0, 10200.0)
#: A field of which at least this share of the resolved variation follows those exponentials is one warm-up (simulated warm-ups of
#: three sources under a wandering ambient: 0.991 and more; sources switched at random, whatever their time constants: nearly always less).
_ONLY_SHARE = 0.99
#: From this share on a warm-up dominates; the remaining variation is still tested given free exponentials.
_DOMINANT_SHARE = 0.95


@dataclass(frozen=True)
class Excitation:
    """How the field was excited.

    ``warm_up_share`` is the share of the field's resolved temporal variation that exponentials from one common start explain;
    ``warm_up_only`` where it leaves nothing by which sources could be separated.
    """

    warm_up_share: float
    warm_up_only: bool

    @property
    def protected(self) -> bool:
        """Whether a source must explain more than free exponentials of a warm-up do."""
        return self.warm_up_only or self.warm_up_share >= _DOMINANT_SHARE

    @property
    def name(self) -> str:
        """In words: ``"warm-up only"``, ``"mostly warm-up"`` or ``"varied"``."""
        if self.warm_up_only:
            return "warm-up only"
        return "mostly warm-up" if self.protected else "varied"


def warm_up_columns(seconds: Array) -> Array:
    """Return the exponentials of a warm-up that began with the first value."""
    columns = np.exp(-(seconds[:, None] - seconds[0]) / np.array(_WARM_UP_CONSTANTS_S))
    return columns - columns.mean(axis=0)


def level_and_trend(seconds: Array) -> Array:
    """Return a constant, and time from the middle over the length of the session."""
    centred = (seconds - seconds.mean()) / max(float(np.ptp(seconds)), 1e-9)
    return np.column_stack([np.ones_like(seconds), centred])


def nuisance_columns(seconds: Array, excitation: Excitation) -> Array:
    """Return the regressors of every hypothesis, the null hypothesis included."""
    columns = level_and_trend(seconds)
    return np.column_stack([columns, warm_up_columns(seconds)]) if excitation.protected else columns


def thermal_modes(values: Array, *, limit: int = 12) -> tuple[Array, Array]:
    """Return the principal components of a field that stand above its noise."""
    frames, cells = values.shape
    second = np.diff(values, 2, axis=0) if frames > 2 else values
    noise = float(np.sqrt(np.median((second**2).mean(axis=0)) / 6.0))
    # The temporal Gram matrix is small whatever the number of cells.
    power, courses = np.linalg.eigh(values @ values.T)
    size = np.sqrt(np.maximum(power[::-1], 0.0))
    courses = courses[:, ::-1]
    edge = noise * (np.sqrt(frames) + np.sqrt(cells))
    kept = min(int((size > edge).sum()), limit)
    scores = courses[:, :kept] * size[:kept]
    patterns = (courses[:, :kept].T @ values) / size[:kept, None]
    return scores / np.sqrt(cells), patterns * np.sqrt(cells)


def describe_excitation(values: Array, seconds: Array) -> Excitation:
    """Measure how much of a field is one warm-up."""
    courses, _ = thermal_modes(values)
    if courses.shape[1] == 0:
        return Excitation(0.0, False)
    design = np.column_stack([level_and_trend(seconds), warm_up_columns(seconds)])
    rest = courses - design @ np.linalg.lstsq(design, courses, rcond=None)[0]
    share = 1.0 - float((rest**2).sum() / (courses**2).sum())
    return Excitation(share, share >= _ONLY_SHARE)


#: Rotation stops when the varimax criterion grows by less than this share.
_ROTATION_TOLERANCE = 1e-6
_ROTATION_ROUNDS = 200
#: Corners of a disc that is written as a polygon; its area is then within 0.3 % of the circle's.
_DISC_CORNERS = 48
#: Cells whose temperatures share at least this much of their variance are collinear.
_SHARED_VARIANCE = 0.98
_MOST_CLUSTERS = 12
#: Thermal modes that are localised.
_MOST_MODES = 6
_COLUMNS = ("name", "x_mm", "y_mm")


class RegionError(FusionError):
    """A region that cannot be used; the message names file or place and what to do."""


@dataclass(frozen=True)
class Region:
    """A named part of the plan by the corners (x, y) of its outline in order, mm."""

    name: str
    corners_mm: NDArray[np.float64]

    def cells(self, plane: xr.DataArray) -> NDArray[np.bool_]:
        """Return which cells of a plane (..., y, x) have their centre inside, (y * x,) bool."""
        y, x = np.meshgrid(plane["y"].values, plane["x"].values, indexing="ij")
        return np.asarray(points_in_poly(np.column_stack([x.ravel(), y.ravel()]), self.corners_mm), bool)

    @property
    def centre_mm(self) -> tuple[float, float]:
        """Mean of the corners (x, y), mm."""
        x, y = self.corners_mm.mean(axis=0)
        return float(x), float(y)


def disc(name: str, x_mm: float, y_mm: float, radius_mm: float) -> Region:
    """Return a round region."""
    angle = np.linspace(0.0, 2.0 * np.pi, _DISC_CORNERS, endpoint=False)
    corners = np.column_stack([x_mm + radius_mm * np.cos(angle), y_mm + radius_mm * np.sin(angle)])
    return Region(name, corners)


def read_regions(path: str | Path) -> list[Region]:
    """Read named regions from a CSV file."""
    path = Path(path)
    corners: dict[str, list[tuple[float, float]]] = {}
    for line, row in read_lines(path, _COLUMNS, RegionError):
        try:
            point = float(row["x_mm"]), float(row["y_mm"])
        except (TypeError, ValueError):
            point = np.nan, np.nan
        if not np.isfinite(point).all() or not (row["name"] or "").strip():
            raise RegionError(
                f"{path}:{line}: {row['name']!r}, {row['x_mm']!r}, {row['y_mm']!r} is no corner; write a name and two numbers in mm"
            )
        corners.setdefault(row["name"].strip(), []).append(point)
    for name, points in corners.items():
        if len(points) < 3:
            raise RegionError(f"{path}: region {name!r} has {len(points)} corners; an outline needs at least 3")
    if not corners:
        raise RegionError(f"{path}: lists no region; write one line per corner, or leave plan.regions out")
    return [Region(name, np.array(points)) for name, points in corners.items()]


def region_courses(values: Array, seen: NDArray[np.bool_], plane: xr.DataArray, regions: Sequence[Region]) -> Array:
    """Return the mean temperature of every region."""
    columns = [np.empty((values.shape[0], 0))]
    for region in regions:
        inside = region.cells(plane)[seen]
        if not inside.any():
            x_mm, y_mm = region.centre_mm
            raise RegionError(
                f"region {region.name!r} around x = {x_mm:.0f} mm, y = {y_mm:.0f} mm holds no seen cell; move it or make it larger"
            )
        columns.append(values[:, inside].mean(axis=1))
    return np.column_stack(columns)


@dataclass(frozen=True)
class Modes:
    """Localised thermal modes: temperature of each at its peak (the strongest cell) about its mean, K; pattern of each over that cell."""

    courses: Array
    patterns: Array
    peaks: NDArray[np.int64]


def localise_modes(values: Array) -> Modes:
    """Find the localised thermal modes of a field."""
    courses, patterns = thermal_modes(values, limit=_MOST_MODES)
    if courses.shape[1] == 0:
        return Modes(courses, patterns, np.zeros(0, np.int64))
    rotation = varimax(patterns.T)
    courses, patterns = courses @ rotation, rotation.T @ patterns
    peaks = np.abs(patterns).argmax(axis=1)
    height = np.take_along_axis(patterns, peaks[:, None], axis=1)
    courses = courses * height.T
    return Modes(courses - courses.mean(axis=0), patterns / height, peaks)


def varimax(loadings: Array) -> NDArray[np.float64]:
    """Return the varimax rotation, which concentrates each column of loadings on few rows."""
    k = loadings.shape[1]
    rotation = np.eye(k)
    criterion = 0.0
    for _ in range(_ROTATION_ROUNDS):
        rotated = loadings @ rotation
        gradient = loadings.T @ (rotated**3 - rotated * (rotated**2).mean(axis=0))
        left, size, right = np.linalg.svd(gradient)
        rotation = left @ right
        if size.sum() < criterion * (1.0 + _ROTATION_TOLERANCE):
            break
        criterion = float(size.sum())
    return rotation


def cluster_cells(field: xr.DataArray) -> xr.Dataset:
    """Group cells with collinear temperatures, and give the condition number of the thermal modes of the field."""
    values = field.values.reshape(field.sizes["time"], -1).astype(float)
    seen = np.isfinite(values).all(axis=0)
    centred = values[:, seen] - values[:, seen].mean(axis=0)
    seconds = (field["time"].values - field["time"].values[0]) / np.timedelta64(1, "s")
    nuisance = nuisance_columns(seconds, describe_excitation(centred, seconds))
    centred = centred - nuisance @ np.linalg.lstsq(nuisance, centred, rcond=None)[0]
    courses, patterns = thermal_modes(centred)
    weights = np.sqrt((courses**2).sum(axis=0))
    scores = patterns * weights[:, None]
    size = np.sqrt((scores**2).sum(axis=0))
    # Label cells (columns of scores) by the strongest cell that they are collinear with, at most 12 labels.
    label = np.zeros(size.size, np.int16)
    unit = scores / np.where(size > 0, size, 1.0)
    unlabelled = size > 0
    for number in range(1, _MOST_CLUSTERS + 1):
        if not unlabelled.any():
            break
        leader = int(np.argmax(np.where(unlabelled, size, -1.0)))
        alike = unlabelled & ((unit[:, leader] @ unit) ** 2 >= _SHARED_VARIANCE)
        label[alike] = number
        unlabelled &= ~alike
    cluster = np.zeros(values.shape[1], np.int16)
    cluster[seen] = label
    mode_size = weights / np.sqrt(values.shape[0])
    rms = "rms of each thermal mode over time and cells"
    condition = float(mode_size[0] / mode_size[-1]) if mode_size.size else float("nan")
    return xr.Dataset(
        {
            "cluster": (("y", "x"), cluster.reshape(field.shape[1:]), {"units": "1"}),
            "mode_size": (("eigenmode",), mode_size, {"units": "K", "long_name": rms}),
            "condition": ((), condition, {"units": "1"}),
        },
        coords={"y": field["y"], "x": field["x"], "eigenmode": np.arange(1, mode_size.size + 1)},
    )
