"""What the screen *Results* reads of a results folder: small tables at once, the fields of the camera one cycle or one place at a time."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from fusion.products.contracts import read_product, require_kind
from fusion.products.grouped import group, has
from fusion.products.results import RecordLoop, Results, read_results
from fusion.products.store import open_in_file, read_json_object, require_own
from fusion.report.charts.thermal_map import LAYERS, Layer, scale_of

#: Cycles from which the one colour scale of all cycles is taken; of a longer test evenly spaced ones.
_SCALE_CYCLES = 60
#: A fields.nc of up to so many bytes is compared with the hash of its run; reading a larger one takes longer than a screen may wait.
_HASHED_BYTES = 100_000_000


class Products:
    """The products of a run, as a screen shows them.

    Parameters
    ----------
    folder : Path
        Results folder of a finished run.

    Attributes
    ----------
    folder : Path
        The same.
    results : Results
        Content of results.json.

    Raises
    ------
    ResultsError
        If the folder is none.
    DamagedProductError
        If its results.json is not what its run wrote.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.results: Results = read_results(folder)

    def __del__(self) -> None:
        """Close fields.nc where it was opened."""
        if "fields" in self.__dict__ and self.fields is not None:
            self.fields.close()

    @cached_property
    def provenance(self) -> dict[str, Any]:
        """Content of provenance.json; empty where it is missing."""
        return read_json_object(self.folder / "provenance.json")

    @cached_property
    def fields(self) -> xr.Dataset | None:
        """fields.nc, opened and not read; None without a camera."""
        path = self.folder / "fields.nc"
        if not path.is_file():
            return None
        if path.stat().st_size <= _HASHED_BYTES:
            require_own(self.folder, [path.name])
        return require_kind(open_in_file(path), "fields", path)

    @cached_property
    def deviations(self) -> xr.Dataset | None:
        """Content of deviations.nc; None without a laser."""
        return read_product(self.folder, "deviations") if (self.folder / "deviations.nc").is_file() else None

    @cached_property
    def drift(self) -> xr.Dataset | None:
        """The joint estimate of profile and drift; None where the readings have no times, or there are none."""
        read = self.deviations
        return group(read, "drift") if read is not None and has(read, "drift") else None

    @cached_property
    def fusion(self) -> xr.Dataset | None:
        """Root of fusion.nc; None where a run has none."""
        kind = "record" if isinstance(self.results.loop, RecordLoop) else "fusion"
        return read_product(self.folder, kind) if (self.folder / "fusion.nc").is_file() else None

    @cached_property
    def loop(self) -> xr.Dataset | None:
        """The closed loop of an axis; None of a record, and where there was no model."""
        root = self.fusion
        if root is None or isinstance(self.results.loop, RecordLoop) or not has(root, "loop"):
            return None
        return group(root, "loop")

    @property
    def layers(self) -> list[Layer]:
        """The quantities of the map."""
        return [] if self.fields is None else [layer for layer in LAYERS if layer.variable in self.fields]

    @property
    def cycles(self) -> np.ndarray:
        """Numbers of the cycles, of the camera or else of the laser."""
        for product in (self.fields, self.deviations):
            if product is not None:
                return np.asarray(product["cycle"].values, int)
        return np.array([], int)

    @property
    def targets(self) -> list[tuple[int, float]]:
        """Number and position (mm) of every target, in the order of the axis."""
        read = self.deviations
        if read is None:
            return []
        pairs = zip(read["target"].values.tolist(), read["position"].values.tolist(), strict=True)
        return sorted(((int(number), float(place)) for number, place in pairs), key=lambda one: one[1])

    def map_of(self, layer: Layer, cycle: int) -> np.ndarray:
        """Return one quantity in one cycle, (y, x)."""
        assert self.fields is not None
        return np.asarray(self.fields[layer.variable].sel(cycle=cycle).values)

    def scale(self, layer: Layer) -> tuple[dict[str, Any], bool]:
        """Return the one colour scale of a quantity, and whether all cycles entered it; the maps are read one at a time."""
        assert self.fields is not None
        count = self.fields.sizes["cycle"]
        chosen = np.unique(np.linspace(0, count - 1, min(count, _SCALE_CYCLES)).astype(int))
        maps = [self.fields[layer.variable].isel(cycle=int(at)).values for at in chosen]
        return scale_of(np.stack(maps), layer), chosen.size == count

    def place_over_time(self, layer: Layer, x_mm: float, y_mm: float, size_mm: float) -> tuple[np.ndarray, int]:
        """Return the mean of one quantity over a square of the plan in every cycle, (cycle,), and how many cells it has.

        Parameters
        ----------
        layer : Layer
            The quantity.
        x_mm, y_mm : float
            Middle of the square, mm.
        size_mm : float
            Its side; the nearest cell alone where it holds no other.
        """
        assert self.fields is not None
        x, y = self.fields["x"].values, self.fields["y"].values
        columns, rows = (_within(cells, at, size_mm) for cells, at in ((x, x_mm), (y, y_mm)))
        chosen = self.fields[layer.variable].isel(x=columns, y=rows).values
        count = np.isfinite(chosen).sum(axis=(1, 2))
        total = np.nansum(chosen, axis=(1, 2))
        return np.where(count > 0, total / np.maximum(count, 1), np.nan), chosen[0].size

    @cached_property
    def field_hours(self) -> np.ndarray:
        """Mean time of the frames of every cycle, h since the first reading of the laser, or since the first cycle."""
        assert self.fields is not None
        start = self.fields["cycle_time"].values[0]
        if self.deviations is not None:
            read = self.deviations["time"].values
            start = read[~np.isnat(read)].min() if not np.isnat(read).all() else start
        return np.asarray((self.fields["cycle_time"].values - start) / np.timedelta64(1, "h"), float)


def _within(cells: np.ndarray, at: float, size: float) -> slice:
    """Return the cells whose middle lies within half a size of a place, at least the nearest one."""
    inside = np.flatnonzero(np.abs(cells - at) <= size / 2)
    if inside.size == 0:
        inside = np.array([int(np.argmin(np.abs(cells - at)))])
    return slice(int(inside[0]), int(inside[-1]) + 1)
