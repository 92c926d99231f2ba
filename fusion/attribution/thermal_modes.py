"""Group the cells of the field: regions, localised thermal modes, and clusters of collinear cells.

Regions and modes are fewer candidates for a source of the drift than single cells, with less noise. The temperature of a region is the mean
of its cells. Thermal modes are the leading spatial patterns of the field, rotated until each is concentrated in one place (varimax), so
that a mode usually is one heat source with its halo; this finds weak and lagged sources where single cells do not.

Cells of one cluster have collinear temperatures: whatever the drift does, these data cannot tell them apart. The condition number of the
leading thermal modes says how many sources the session can separate at all.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from skimage.measure import points_in_poly

from fusion._typing import Array
from fusion.attribution.warm_up import describe_excitation, nuisance_columns, thermal_modes
from fusion.errors import FusionError

#: Rotation stops when the varimax criterion grows by less than this share.
_ROTATION_TOLERANCE = 1e-6
_ROTATION_ROUNDS = 200
#: Corners of a disc that is written as a polygon; its area is then within 0.3 % of the circle's.
_DISC_CORNERS = 48
#: Cells whose temperatures share at least this much of their variance are collinear.
_SHARED_VARIANCE = 0.98
_COLUMNS = ("name", "x_mm", "y_mm")


class RegionError(FusionError):
    """A region that cannot be used; the message names file or place and what to do."""


@dataclass(frozen=True)
class Region:
    """A named part of the plan.

    Attributes
    ----------
    name : str
        Name of the region.
    corners_mm : (corners, 2) ndarray, mm
        Corners (x, y) of its outline, in order.
    """

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
    """Return a round region.

    Parameters
    ----------
    name : str
        Name of the region.
    x_mm, y_mm : float, mm
        Centre on the plan.
    radius_mm : float, mm
        Radius of the circle, which is approximated by a polygon of 48 corners.

    Returns
    -------
    Region
    """
    angle = np.linspace(0.0, 2.0 * np.pi, _DISC_CORNERS, endpoint=False)
    corners = np.column_stack([x_mm + radius_mm * np.cos(angle), y_mm + radius_mm * np.sin(angle)])
    return Region(name, corners)


def read_regions(path: str | Path) -> list[Region]:
    """Read named regions from a CSV file.

    Parameters
    ----------
    path : str or Path
        One line ``name,x_mm,y_mm`` per corner, the corners of a region in order along its outline.

    Returns
    -------
    list of Region
        In the order of their first corners.

    Raises
    ------
    RegionError
        If a column is missing, a coordinate is no number, or a region has fewer than three corners; with file, line and remedy.
    """
    path = Path(path)
    try:
        corners = _read_corners(path)
    except UnicodeDecodeError as error:
        raise RegionError(f"{path}: byte {error.start} is not UTF-8; save the file as CSV in UTF-8") from None
    except csv.Error as error:
        raise RegionError(f"{path}: is not CSV ({error}); save the file as CSV in UTF-8") from None
    for name, points in corners.items():
        if len(points) < 3:
            raise RegionError(f"{path}: region {name!r} has {len(points)} corners; an outline needs at least 3")
    if not corners:
        raise RegionError(f"{path}: lists no region; write one line per corner, or leave plan.regions out")
    return [Region(name, np.array(points)) for name, points in corners.items()]


def _read_corners(path: Path) -> dict[str, list[tuple[float, float]]]:
    """Return the corners of every region, in the order of the lines."""
    corners: dict[str, list[tuple[float, float]]] = {}
    with path.open(newline="", encoding="utf-8-sig") as file:
        reader = csv.DictReader(file)
        header = [column.strip() for column in reader.fieldnames or []]
        missing = [column for column in _COLUMNS if column not in header]
        if missing:
            raise RegionError(
                f"{path}:1: no column {', '.join(missing)}; the first line must read {','.join(_COLUMNS)}"
            )
        reader.fieldnames = header
        for row in reader:
            try:
                point = float(row["x_mm"]), float(row["y_mm"])
            except (TypeError, ValueError):
                point = np.nan, np.nan
            if not np.isfinite(point).all() or not (row["name"] or "").strip():
                raise RegionError(
                    f"{path}:{reader.line_num}: {row['name']!r}, {row['x_mm']!r}, {row['y_mm']!r} is no corner; "
                    "write a name and two numbers in mm"
                )
            corners.setdefault(row["name"].strip(), []).append(point)
    return corners


def region_courses(values: Array, seen: NDArray[np.bool_], plane: xr.DataArray, regions: Sequence[Region]) -> Array:
    """Return the mean temperature of every region.

    Parameters
    ----------
    values : (frames, cells) ndarray, K
        Temperatures of the seen cells.
    seen : (y * x,) ndarray of bool
        Which cells of the plane these are.
    plane : DataArray, (..., y, x)
        For the coordinates of the plan, mm.
    regions : sequence of Region
        Parts of the plan.

    Returns
    -------
    (frames, regions) ndarray, K

    Raises
    ------
    RegionError
        If a region contains no seen cell.
    """
    columns = []
    for region in regions:
        inside = region.cells(plane)[seen]
        if not inside.any():
            x_mm, y_mm = region.centre_mm
            raise RegionError(
                f"region {region.name!r} around x = {x_mm:.0f} mm, y = {y_mm:.0f} mm holds no seen cell; move it or make it larger"
            )
        columns.append(values[:, inside].mean(axis=1))
    return np.column_stack(columns) if columns else np.empty((values.shape[0], 0))


@dataclass(frozen=True)
class Modes:
    """Localised thermal modes.

    Attributes
    ----------
    courses : (frames, modes) ndarray, K
        Temperature of each mode at its strongest cell, minus the mean over time.
    patterns : (modes, cells) ndarray
        Temperature of each cell over that of the strongest cell.
    peaks : (modes,) ndarray of int
        Index of the strongest cell.
    """

    courses: Array
    patterns: Array
    peaks: NDArray[np.int64]


def localise_modes(values: Array, *, limit: int = 6) -> Modes:
    """Find the localised thermal modes of a field.

    Parameters
    ----------
    values : (frames, cells) ndarray, K
        Temperatures, each cell minus its mean over time.
    limit : int
        Largest number of modes.

    Returns
    -------
    Modes
        None of them where nothing stands above the noise.

    Notes
    -----
    Principal components, rotated by the varimax criterion (Kaiser 1958, Psychometrika 23, 187).
    """
    courses, patterns = thermal_modes(values, limit=limit)
    if courses.shape[1] == 0:
        return Modes(courses, patterns, np.zeros(0, np.int64))
    rotation = varimax(patterns.T)
    courses, patterns = courses @ rotation, rotation.T @ patterns
    peaks = np.abs(patterns).argmax(axis=1)
    height = np.take_along_axis(patterns, peaks[:, None], axis=1)
    courses = courses * height.T
    return Modes(courses - courses.mean(axis=0), patterns / height, peaks)


def varimax(loadings: Array) -> NDArray[np.float64]:
    """Return the varimax rotation, which concentrates each column of loadings on few rows.

    Parameters
    ----------
    loadings : (n, k) ndarray
        Patterns as columns, in any unit.

    Returns
    -------
    (k, k) ndarray
        Orthogonal matrix; ``loadings @ rotation`` are the rotated patterns.

    Notes
    -----
    Maximises the variance of the squared loadings of the columns (Kaiser 1958, Psychometrika 23, 187) by repeated singular value
    decompositions.
    """
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


def cluster_cells(field: xr.DataArray, *, shared_variance: float = _SHARED_VARIANCE, limit: int = 12) -> xr.Dataset:
    """Group cells with collinear temperatures, and give the condition number of the thermal modes of the field.

    Parameters
    ----------
    field : DataArray, (time, y, x)
        Temperature in degC or rise in K; cells with NaN are left out.
    shared_variance : float
        Squared correlation from which the temperatures of two cells count as collinear.
    limit : int
        Largest number of clusters.

    Returns
    -------
    Dataset
        ``cluster`` (y, x): 0 none, 1 the cluster of the strongest cell, ...; ``mode_size`` (eigenmode) in K rms; ``condition``: first over
        last mode.

    Notes
    -----
    Temperatures are compared as in the test of the drift: without trend and, where a warm-up dominates, without its exponentials. What
    remains is projected on the modes above the noise, so that noise does not lower the correlation.
    """
    values = field.values.reshape(field.sizes["time"], -1).astype(float)
    seen = np.isfinite(values).all(axis=0)
    centred = values[:, seen] - values[:, seen].mean(axis=0)
    seconds = (field["time"].values - field["time"].values[0]) / np.timedelta64(1, "s")
    nuisance = nuisance_columns(seconds, describe_excitation(centred, seconds))
    centred = centred - nuisance @ np.linalg.lstsq(nuisance, centred, rcond=None)[0]
    courses, patterns = thermal_modes(centred, limit=limit)
    weights = np.sqrt((courses**2).sum(axis=0))
    scores = patterns * weights[:, None]
    size = np.sqrt((scores**2).sum(axis=0))
    label = _label_clusters(scores, size, shared_variance, limit)
    cluster = np.zeros(values.shape[1], np.int16)
    cluster[seen] = label
    mode_size = weights / np.sqrt(values.shape[0])
    condition = float(mode_size[0] / mode_size[-1]) if mode_size.size else float("nan")
    return xr.Dataset(
        {
            "cluster": (("y", "x"), cluster.reshape(field.shape[1:]), {"units": "1"}),
            "mode_size": (
                ("eigenmode",),
                mode_size,
                {"units": "K", "long_name": "rms of each thermal mode over time and cells"},
            ),
            "condition": ((), condition, {"units": "1"}),
        },
        coords={"y": field["y"], "x": field["x"], "eigenmode": np.arange(1, mode_size.size + 1)},
    )


def _label_clusters(scores: Array, size: Array, shared_variance: float, limit: int) -> NDArray[np.int16]:
    """Label cells (columns of scores) by the strongest cell that they are collinear with, at most `limit` labels."""
    label = np.zeros(size.size, np.int16)
    unit = scores / np.where(size > 0, size, 1.0)
    unlabelled = size > 0
    for number in range(1, limit + 1):
        if not unlabelled.any():
            break
        leader = int(np.argmax(np.where(unlabelled, size, -1.0)))
        alike = unlabelled & ((unit[:, leader] @ unit) ** 2 >= shared_variance)
        label[alike] = number
        unlabelled &= ~alike
    return label
